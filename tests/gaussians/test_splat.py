"""Splatting against the float64 oracle, and every gradient against finite differences."""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from wrf_mi_bench import field_oracle as oracle

from wrf_mi.backend.device import to_tensor
from wrf_mi.core import Receiver, pixel_directions, unit_vectors
from wrf_mi.gaussians import FIELDS, Encoding, Gaussians, random_gaussians
from wrf_mi.gaussians.blend import splat
from wrf_mi.gaussians.tiles import perception_plane
from wrf_mi.training.step import device_pose

pytestmark = pytest.mark.all_threads

FLOAT32_TOLERANCE = 1e-4
"""Relative L2 error of an image: float32 rounding of some ten operations, and pixels on the cut-off."""
FLOAT64_TOLERANCE = 1e-12
"""The same arithmetic in another order."""
STEP = 1e-7
"""Of central differences in float64: rounding leaves 1e-7 of the gradient's norm, and no pixel crosses a footprint's
cut-off, where the field jumps."""
GRADIENT_TOLERANCE = 1e-6
"""Error of a derivative along a direction of standard normal numbers, relative to the gradient's norm: the standard
deviation of such derivatives."""
DIRECTIONS = 3

Float64 = dr.float64_array_t(mi.Float)
Tensor64 = dr.tensor_t(Float64)

RECEIVER = Receiver(
    "gateway1", np.array([5.0, 0.26, 0.0]), np.array([0.51291602, -0.48674136, -0.48674136, 0.51291602])
)


def make(model: str, n: int, tensor: Any, seed: int = 0, **encoding: int) -> tuple[Any, dict[str, Any]]:
    rng = np.random.default_rng(seed)
    field = FIELDS[model](encoding=Encoding(**encoding))
    weights = field.init(random_gaussians([RECEIVER], n, rng, opacity=0.4), rng)
    # Not round, so that rotations matter.
    weights["log_scale"] = weights["log_scale"] + rng.normal(0, 0.4, (3, n)).astype(np.float32)
    weights["rotation"] = rng.standard_normal((4, n)).astype(np.float32)
    return field, {name: tensor(np.asarray(w, np.float64)) for name, w in weights.items()}


def through_oracle(gaussians: Any, b: int, height: int, width: int) -> np.ndarray:
    n = gaussians.count
    own = slice(b * n, (b + 1) * n)

    def stack(parts: list[Any]) -> np.ndarray:
        return np.stack([p.numpy()[own].astype(float) for p in parts], axis=1)

    def complex_of(pair: list[Any]) -> np.ndarray:
        return stack(pair) @ np.array([1, 1j])

    mean = np.stack([p.numpy().astype(float) for p in gaussians.position], axis=1)
    blending = (
        {"opacity": gaussians.opacity.numpy()[own].astype(float)}
        if gaussians.opacity is not None
        else {"attenuation": complex_of(gaussians.attenuation)}
    )
    return oracle.render(
        mean,
        stack(gaussians.scale),
        stack(gaussians.rotation),
        complex_of(gaussians.signal),
        RECEIVER,
        pixel_directions(height, width),
        **blending,
    )


@pytest.mark.parametrize("model", ["wrf-gs", "wrf-gs+"])
@pytest.mark.parametrize("size", [(90, 360), (23, 61)])
@pytest.mark.parametrize("single", [True, False])
def test_splat_matches_the_oracle(model, size, single):
    tensor = mi.TensorXf if single else Tensor64
    batch, floats = 2, dr.array_t(tensor)
    field, params = make(model, 60, tensor)
    tx_pos = tensor(np.random.default_rng(1).standard_normal((3, batch)))
    gaussians = field.gaussians(params, tx_pos)
    re, im = splat(gaussians, device_pose(RECEIVER, floats), perception_plane(*size, floats))
    images = (re.numpy() + 1j * im.numpy()).reshape(batch, *size)
    for b in range(batch):
        expected = through_oracle(gaussians.spread(), b, *size)
        # A pixel on the cut-off may fall to either side in float32: at most one here and there.
        off = np.abs(images[b] - expected) > 1e-3 * np.abs(expected).max()
        assert off.mean() < 1e-3
        error = np.linalg.norm((images[b] - expected)[~off]) / np.linalg.norm(expected)
        assert error < (FLOAT32_TOLERANCE if single else FLOAT64_TOLERANCE)


def test_seam_and_zenith():
    """One Gaussian across the azimuth seam and one on the zenith: as round on the sphere as anywhere else."""
    plane = perception_plane(90, 360, Float64)
    for azimuth, elevation in ((0.0, 0.3), (1.0, 1.55), (3.1, 0.02)):
        direction = unit_vectors(azimuth, elevation)
        at = RECEIVER.position_m + RECEIVER.to_world @ direction * 4.0
        one = Gaussians(
            position=[Float64(x) for x in at],
            scale=[Float64(0.3)] * 3,
            rotation=[Float64(x) for x in (0.0, 0.0, 0.0, 1.0)],
            signal=[Float64(1.0), Float64(0.5)],
            opacity=Float64(0.7),
            attenuation=None,
            batch=1,
        )
        re, im = splat(one, device_pose(RECEIVER, Float64), plane)
        angle = np.arccos(np.clip(pixel_directions(90, 360) @ direction, -1, 1))
        sigma = np.hypot(0.3 / 4.0, np.radians(0.3))
        footprint = np.where(np.tan(angle) / sigma < 3, np.exp(-0.5 * (np.tan(angle) / sigma) ** 2), 0) * (angle < 1)
        # Angles come from an arc cosine here, which is good to 1e-8 near zero.
        np.testing.assert_allclose(re.numpy().reshape(90, 360), 0.7 * footprint, atol=1e-6)
        np.testing.assert_allclose(im.numpy().reshape(90, 360), 0.35 * footprint, atol=1e-6)


def test_splat_is_invariant_to_storage_order():
    """Equal depths too: ties go by position."""
    field, params = make("wrf-gs+", 40, Tensor64)
    rng = np.random.default_rng(3)
    depth = rng.choice([2.0, 3.0, 4.0], 40)
    direction = unit_vectors(rng.choice([0.5, 0.6, 0.7, 0.8], 40), rng.choice([0.5, 0.6, 0.7], 40))
    # Symmetric directions about +z in the receiver's frame: exact ties in depth for the same distance.
    params["position"] = Tensor64((RECEIVER.position_m + np.round(direction * depth[:, None] * 8) / 8).T.copy())
    order = rng.permutation(40)
    images = []
    for index in (np.arange(40), order):
        own = {n: Tensor64(p.numpy()[:, index].copy()) if n in field.per_gaussian else p for n, p in params.items()}
        gaussians = field.gaussians(own, Tensor64(np.zeros((3, 1))))
        images.append(splat(gaussians, device_pose(RECEIVER, Float64), perception_plane(45, 90, Float64))[0].numpy())
    np.testing.assert_allclose(images[0], images[1], atol=1e-12)


def test_splat_without_visible_gaussians_is_zero():
    """Gaussians far below the horizon reach no pixel; nor does one that contains the receiver."""
    field, params = make("wrf-gs", 5, mi.TensorXf)
    below = RECEIVER.position_m - RECEIVER.to_world @ np.array([0.0, 0.0, 5.0])
    where = np.tile(below, (5, 1)).T
    where[:, 0] = RECEIVER.position_m + 0.01
    params["position"] = to_tensor(where)
    params["log_scale"] = to_tensor(np.full((3, 5), -2.0))
    re, im = splat(
        field.gaussians(params, to_tensor(np.zeros((3, 1)))),
        device_pose(RECEIVER, mi.Float),
        perception_plane(90, 360, mi.Float),
    )
    assert not re.numpy().any()
    assert not im.numpy().any()


@pytest.mark.gradcheck
@pytest.mark.parametrize("model", ["wrf-gs", "wrf-gs+"])
def test_gradients_match_finite_differences(model):
    # An encoding of positions that hardly changes: it is detached on purpose, so differences alone would see it change.
    field, params = make(model, 30, Tensor64, position_octaves=1, position_scale_m=1e12)
    rng = np.random.default_rng(1)
    tx_pos = Tensor64(rng.standard_normal((3, 2)))
    plane, pose = perception_plane(12, 40, Float64), device_pose(RECEIVER, Float64)
    weight = [Float64(rng.standard_normal(2 * plane.pixels)) for _ in range(2)]

    def loss(own: dict[str, Any]) -> Any:
        re, im = splat(field.gaussians(own, tx_pos), pose, plane)
        return dr.sum(re * weight[0] + im * weight[1])

    for p in params.values():
        dr.enable_grad(p)
    dr.backward(loss(params))
    gradient = {name: dr.grad(p).numpy() for name, p in params.items()}
    params = {name: dr.detach(p) for name, p in params.items()}
    errors = {}
    for name, p in params.items():
        for k in range(DIRECTIONS):
            direction = rng.standard_normal(p.shape)
            ends = [loss(params | {name: Tensor64(p.numpy() + s * STEP * direction)})[0] for s in (1, -1)]
            numeric, analytic = (ends[0] - ends[1]) / (2 * STEP), float((gradient[name] * direction).sum())
            errors[name, k] = abs(numeric - analytic) / np.linalg.norm(gradient[name])
    # Comparisons with NaN, of a gradient that is NaN or vanishes, are false.
    assert all(error < GRADIENT_TOLERANCE for error in errors.values()), errors
