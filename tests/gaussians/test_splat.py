"""Splatting against the oracle, its invariances and gradients, and the kernels of a loop of gradient descent."""

from collections.abc import Iterator
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from double_precision import Tensor64
from made_fields import SIZE, device_gaussians, off_edges, oracle_image
from made_spectra import OCTAVES, RECEIVERS, spectra

from wrf_mi.backend.device import to_float, to_tensor
from wrf_mi.backend.vectors import Float64
from wrf_mi.core import Receiver, pixel_directions, unit_vectors
from wrf_mi.gaussians import FIELDS, Encoding, Factorised, Gaussians, WrfGs, WrfGsPlus, random_gaussians
from wrf_mi.gaussians.blend import GROUP, group_size, splat
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
SMALL: dict[str, Any] = {
    "wrf-gs": {"layers": 2, "width": 24, "signal_widths": (24, 12)},
    "wrf-gs+": {"layers": 3, "width": 24, "skip": 1},
    "factorised": {"terms": 4, "layers": 2, "width": 16},
}
"""Networks for finite differences; test_encoding_and_networks.py has the derivatives of their layers."""
RECEIVER = Receiver("r", np.array([5.0, 0.26, 0]), np.array([0.51291602, -0.48674136, -0.48674136, 0.51291602]))


def make(model: str, n: int, tensor: Any, **options: Any) -> tuple[Any, dict[str, Any]]:
    rng, field = np.random.default_rng(0), FIELDS[model](**options)
    weights = field.init(random_gaussians([RECEIVER], n, rng, opacity=0.4), rng)
    # Not round, so that rotations matter.
    weights["log_scale"] = weights["log_scale"] + rng.normal(0, 0.4, (3, n)).astype(np.float32)
    weights["rotation"] = rng.standard_normal((4, n)).astype(np.float32)
    return field, {name: tensor(np.asarray(w, np.float64)) for name, w in weights.items()}


@pytest.mark.parametrize(
    ("model", "size", "single"),
    [
        ("wrf-gs", (90, 360), True),
        ("wrf-gs+", (90, 360), False),
        ("wrf-gs", (23, 61), False),
        ("wrf-gs+", (23, 61), True),
    ],
)
def test_splat_matches_the_oracle(model, size, single):
    tensor: Any = mi.TensorXf if single else Tensor64
    floats, (field, params) = dr.array_t(tensor), make(model, 60, tensor)
    gaussians = field.gaussians(params, tensor(np.random.default_rng(1).standard_normal((3, 2))))
    re, im = splat(gaussians, device_pose(RECEIVER, floats), perception_plane(*size, floats))
    for b, image in enumerate((re.numpy() + 1j * im.numpy()).reshape(2, *size)):
        expected = oracle_image(gaussians.spread(), RECEIVER, size, transmitter=b)
        share_off, error = off_edges(image, expected)
        assert share_off < 1e-3
        assert error < (FLOAT32_TOLERANCE if single else FLOAT64_TOLERANCE)


def test_seam_and_zenith():
    """One Gaussian across the azimuth seam and one on the zenith: as round on the sphere as anywhere else."""
    for azimuth, elevation in ((0.0, 0.3), (1.0, 1.55), (3.1, 0.02)):
        direction = unit_vectors(azimuth, elevation)
        position = RECEIVER.position_m + RECEIVER.to_world @ direction * 4.0
        geometry: dict[str, Any] = {
            "position": position[:, None],
            "scale": np.full((3, 1), 0.3),
            "rotation": np.eye(4)[:, 3:],
        }
        gaussian = device_gaussians(Float64, **geometry, signal=np.array([1 + 0.5j]), opacity=np.array([0.7]))
        re, im = splat(gaussian, device_pose(RECEIVER, Float64), perception_plane(90, 360, Float64))
        angle = np.arccos(np.clip(pixel_directions(90, 360) @ direction, -1, 1))
        offset = np.tan(angle) / np.hypot(0.3 / 4.0, np.radians(0.3))
        footprint = np.where(offset < 3, np.exp(-0.5 * offset**2), 0) * (angle < 1)
        # Angles come from an arc cosine here, which is good to 1e-8 near zero.
        for part, strength in ((re, 0.7), (im, 0.35)):
            np.testing.assert_allclose(part.numpy().reshape(90, 360), strength * footprint, atol=1e-6)


def test_splat_is_invariant_to_storage_order():
    """Equal depths too: ties go by position."""
    (field, params), rng = make("wrf-gs+", 40, Tensor64), np.random.default_rng(3)
    depth = rng.choice([2.0, 3.0, 4.0], 40)
    direction = unit_vectors(rng.choice([0.5, 0.6, 0.7, 0.8], 40), rng.choice([0.5, 0.6, 0.7], 40))
    # Symmetric directions about +z in the receiver's frame: exact ties in depth for the same distance.
    params["position"] = Tensor64((RECEIVER.position_m + np.round(direction * depth[:, None] * 8) / 8).T.copy())
    images = []
    for order in (np.arange(40), rng.permutation(40)):
        params |= {name: Tensor64(params[name].numpy()[:, order].copy()) for name in field.per_gaussian}
        gaussians = field.gaussians(params, Tensor64(np.zeros((3, 1))))
        images.append(splat(gaussians, device_pose(RECEIVER, Float64), perception_plane(45, 90, Float64))[0].numpy())
    np.testing.assert_allclose(images[0], images[1], atol=1e-12)


def test_splat_without_visible_gaussians_is_zero():
    """Gaussians far below the horizon reach no pixel; nor does one that contains the receiver."""
    field, params = make("wrf-gs", 5, mi.TensorXf)
    below = RECEIVER.position_m - RECEIVER.to_world @ [0.0, 0.0, 5.0]
    positions = np.stack([RECEIVER.position_m + 0.01, *[below] * 4], axis=1)
    params |= {"position": to_tensor(positions), "log_scale": to_tensor(np.full((3, 5), -2.0))}
    gaussians = field.gaussians(params, to_tensor(np.zeros((3, 1))))
    for part in splat(gaussians, device_pose(RECEIVER, mi.Float), perception_plane(90, 360, mi.Float)):
        assert not part.numpy().any()


@pytest.mark.gradcheck
@pytest.mark.parametrize("model", SMALL)
def test_gradients_match_finite_differences(model):
    # An encoding of positions that hardly changes: it is detached on purpose, so differences alone would see it change.
    encoding, rng = Encoding(position_octaves=1, position_scale_m=1e12), np.random.default_rng(1)
    field, params = make(model, 30, Tensor64, encoding=encoding, **SMALL[model])
    tx_pos = Tensor64(rng.standard_normal((3, 2)))
    plane, pose = perception_plane(12, 40, Float64), device_pose(RECEIVER, Float64)
    weight = [Float64(rng.standard_normal(2 * plane.pixels)) for _ in range(2)]

    def loss(values: dict[str, Any]) -> Any:
        re, im = splat(field.gaussians(values, tx_pos), pose, plane)
        return dr.sum(re * weight[0] + im * weight[1])

    dr.enable_grad(params)
    dr.backward(loss(params))
    gradient = {name: dr.grad(p).numpy() for name, p in params.items()}
    params = {name: dr.detach(p) for name, p in params.items()}
    errors = {}
    for name, p in params.items():
        direction = rng.standard_normal(p.shape)
        ends = [loss(params | {name: Tensor64(p.numpy() + s * STEP * direction)})[0] for s in (1, -1)]
        numeric, analytic = (ends[0] - ends[1]) / (2 * STEP), float((gradient[name] * direction).sum())
        errors[name] = abs(numeric - analytic) / np.linalg.norm(gradient[name])
    # Comparisons with NaN, of a gradient that is NaN or vanishes, are false.
    assert all(error < GRADIENT_TOLERANCE for error in errors.values()), errors


TOLERANCE = 1e-12
"""Float64 sums of 60 Gaussians, and of as many pixels, in another order."""
GATEWAY = Receiver("gateway1", np.array([5.0, 0.3, 0.0]), np.array([0.0, 0.6, 0.0, 0.8]))
ENCODING = Encoding(2, 4.0, 2, 1.0)
SHARED_FIELDS: dict[str, Any] = {
    "wrf-gs": WrfGs(ENCODING, layers=2, width=16, signal_widths=(16, 8)),
    "wrf-gs+": WrfGsPlus(ENCODING, layers=2, width=16, skip=1, static_geometry=True),
    "factorised": Factorised(ENCODING, terms=4, layers=1, width=16),
}


def drawn(name: str, batch: int) -> tuple[dict[str, Any], Any]:
    rng = np.random.default_rng(0)
    weights = SHARED_FIELDS[name].init(random_gaussians([GATEWAY], 60, rng, size_deg=12.0), rng)
    weights["rotation"] = rng.standard_normal(weights["rotation"].shape)
    weights["log_scale"] = weights["log_scale"] + rng.normal(0, 0.3, weights["log_scale"].shape)
    params = {key: Tensor64(np.asarray(value, float)) for key, value in weights.items()}
    return params, Tensor64(rng.standard_normal((3, batch)))


@pytest.mark.gradcheck
@pytest.mark.parametrize("name", SHARED_FIELDS)
@pytest.mark.parametrize("batch", [2, 5, 8])
def test_shared_geometry_equals_repeated_geometry(name, batch):
    """Spectra, and derivatives by every parameter; batches of half a group, of a prime number, of two groups."""
    plane, rng = perception_plane(*SIZE, Float64), np.random.default_rng(3)
    weight = [Float64(rng.standard_normal(batch * plane.pixels)) for _ in range(2)]
    images, slopes = [], []
    for repeated in (False, True):
        params, tx_pos = drawn(name, batch)
        dr.enable_grad(params)
        gaussians: Gaussians = SHARED_FIELDS[name].gaussians(params, tx_pos)
        assert gaussians.shared
        gaussians = gaussians.spread() if repeated else gaussians
        assert gaussians.shared != repeated
        re, im = splat(gaussians, device_pose(GATEWAY, Float64), plane)
        dr.backward(dr.sum(re * weight[0] + im * weight[1]))
        images.append(np.concatenate([re.numpy(), im.numpy()]))
        slopes.append({key: dr.grad(p).numpy().copy() for key, p in params.items()})
    np.testing.assert_allclose(images[0], images[1], atol=TOLERANCE * np.abs(images[1]).max())
    for key, expected in slopes[1].items():
        np.testing.assert_allclose(slopes[0][key], expected, atol=TOLERANCE * np.abs(expected).max(), err_msg=key)
        assert expected.any(), key


def test_group_size_divides_the_batch():
    sizes = [group_size(batch) for batch in range(1, 13)]
    assert sizes == [1, 2, 3, 4, 1, 3, 1, 4, 3, 2, 1, 4]
    assert max(sizes) == GROUP


STEPS, FIRST = 100, 10  # steps, and those after which all kernels are there
RATE = 1e-3


def gradient_descent(field: Any) -> Iterator[list[dict[str, Any]]]:
    """Kernels of each step of a loop that replaces the parameters and never evaluates them."""
    record = spectra(rows=24)[0]
    rng = np.random.default_rng(0)
    params = {k: to_tensor(v) for k, v in field.init(random_gaussians(RECEIVERS[:1], 8, rng), rng).items()}
    pose, plane = device_pose(RECEIVERS[0]), perception_plane(*record.observation.shape[-2:], mi.Float)
    for step in range(STEPS):
        row = step % len(record)
        condition, truth = to_tensor(record.tx_pos_m[[row]].T.copy()), to_float(record.observation[0, row])
        dr.enable_grad(params)
        re, im = splat(field.gaussians(params, condition), pose, plane)
        dr.backward(dr.mean(dr.square(re * re + im * im - truth)))
        params = {name: dr.detach(value) - RATE * dr.grad(value) for name, value in params.items()}
        yield dr.kernel_history([dr.KernelType.JIT])


@pytest.mark.parametrize("model", FIELDS)
def test_kernels_of_a_loop_of_gradient_descent_do_not_grow(model: str) -> None:
    sizes: dict[str, Any] = {
        "wrf-gs": {"width": 16, "signal_widths": (16, 8)},
        "wrf-gs+": {"width": 16},
        "factorised": {"width": 16},
    }
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        steps = list(gradient_descent(FIELDS[model](encoding=OCTAVES, **sizes[model])))
    first_hashes = {kernel["hash"] for step in steps[:FIRST] for kernel in step}
    assert len(steps) == STEPS
    assert {kernel["hash"] for step in steps[FIRST:] for kernel in step} <= first_hashes
