"""The linear map from signals to pixels: equal to blending on hard fields, and linear."""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from wrf_mi_bench import field_oracle as oracle

from wrf_mi.backend.device import on_device
from wrf_mi.backend.vectors import Pose
from wrf_mi.core import Receiver, pixel_directions, unit_vectors
from wrf_mi.gaussians import Gaussians
from wrf_mi.gaussians.blend import splat
from wrf_mi.gaussians.operator import BLOCK, PixelOperator, pixel_weights
from wrf_mi.gaussians.tiles import TiledPlane, perception_plane
from wrf_mi.training.step import device_pose

SINGLE = 1e-5
"""Relative L2 error in float32: the weights are the same numbers, a sum of some hundred terms in another order."""
DOUBLE = 1e-12
"""The same arithmetic in another order."""

Float64 = dr.float64_array_t(mi.Float)
RECEIVER = Receiver(
    "gateway1", np.array([5.0, 0.26, 0.0]), np.array([0.51291602, -0.48674136, -0.48674136, 0.51291602])
)
SIZES = [(90, 360), (23, 61)]


def hard(product: bool, float_type: Any, n: int = 40, seed: int = 0) -> tuple[Gaussians, np.ndarray]:
    """Gaussians on the seam, on the zenith, below the horizon, around the receiver, needles, and others at random."""
    rng = np.random.default_rng(seed)
    azimuth, elevation = rng.uniform(0, 2 * np.pi, n), np.arcsin(rng.uniform(-0.2, 1, n))
    distance, scale = rng.uniform(1, 8, n), rng.uniform(0.05, 0.6, (3, n))
    azimuth[:3], elevation[:3] = (0.0, 1e-4, 2 * np.pi - 0.01), (0.3, 0.0, 0.6)
    elevation[3:6] = np.pi / 2, 1.55, -0.1
    # The receiver inside: one that has no footprint, one that covers all in front of it.
    distance[6:8], scale[:, 7] = (0.03, 0.4), 3.0
    scale[:, 8] = 0.002, 0.002, 2.0
    position = RECEIVER.position_m + (unit_vectors(azimuth, elevation) * distance[:, None]) @ RECEIVER.to_world.T
    rotation = rng.standard_normal((4, n))
    signal = rng.standard_normal(n) + 1j * rng.standard_normal(n)
    delta = np.sqrt(rng.uniform(0, 1, n)) * 0.99 * np.exp(1j * rng.uniform(-np.pi, np.pi, n))
    opacity = rng.uniform(0.01, 0.99, n)
    return Gaussians(
        position=[on_device(c, float_type) for c in position.T],
        scale=[on_device(c, float_type) for c in scale],
        rotation=[on_device(c, float_type) for c in rotation],
        signal=[on_device(signal.real, float_type), on_device(signal.imag, float_type)],
        opacity=None if product else on_device(opacity, float_type),
        attenuation=[on_device(delta.real, float_type), on_device(delta.imag, float_type)] if product else None,
        batch=1,
    ), signal


def operator_of(gaussians: Gaussians, pose: Pose, plane: TiledPlane) -> PixelOperator:
    return PixelOperator(pixel_weights(gaussians, pose, plane), plane.height, plane.width)


def complex_of(pair: tuple[Any, Any]) -> np.ndarray:
    return pair[0].numpy() + 1j * pair[1].numpy()


def error(found: Any, expected: Any) -> float:
    return float(np.linalg.norm(np.asarray(found) - expected) / np.linalg.norm(expected))


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("product", [True, False])
@pytest.mark.parametrize("single", [True, False])
def test_weights_times_signals_equal_blending(product, size, single):
    floats = mi.Float if single else Float64
    gaussians, signal = hard(product, floats)
    plane = perception_plane(*size, floats)
    operator = operator_of(gaussians, device_pose(RECEIVER, floats), plane)
    assert (
        operator.weights.dtype
        == {
            (True, True): np.complex64,
            (True, False): np.float32,
            (False, True): np.complex128,
            (False, False): np.float64,
        }[single, product]
    )
    direct = complex_of(splat(gaussians, device_pose(RECEIVER, floats), plane))
    assert error(operator.field(signal[None])[0], direct) < (SINGLE if single else DOUBLE)
    spectrum = operator.magnitude(np.stack([signal, 2 * signal]))
    assert error(spectrum[1].ravel(), 2 * np.abs(direct)) < (SINGLE if single else DOUBLE)


@pytest.mark.parametrize("product", [True, False])
def test_weights_match_the_oracle(product):
    gaussians, signal = hard(product, Float64)
    weights = pixel_weights(gaussians, device_pose(RECEIVER, Float64), perception_plane(45, 120, Float64))

    def columns(parts: Any) -> np.ndarray:
        return np.stack([p.numpy() for p in parts], axis=1)

    blending = (
        {"attenuation": columns(gaussians.attenuation) @ [1, 1j]} if product else {"opacity": gaussians.opacity.numpy()}
    )
    geometry = (columns(part) for part in (gaussians.position, gaussians.scale, gaussians.rotation))
    expected = oracle.render(*geometry, signal, RECEIVER, pixel_directions(45, 120), **blending)
    assert error(weights @ signal, expected.ravel()) < DOUBLE


@settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(seed=st.integers(0, 2**31), product=st.booleans(), height=st.integers(1, 12), width=st.integers(1, 40))
def test_any_field_and_size(seed, product, height, width):
    gaussians, signal = hard(product, Float64, n=12, seed=seed)
    plane = perception_plane(height, width, Float64)
    weights = pixel_weights(gaussians, device_pose(RECEIVER, Float64), plane)
    direct = complex_of(splat(gaussians, device_pose(RECEIVER, Float64), plane))
    np.testing.assert_allclose(weights @ signal, direct, atol=1e-12 * np.abs(signal).sum())


def test_operator_without_visible_gaussians_is_zero():
    """Far below the horizon: no weights, and dark."""
    gaussians, signal = hard(False, mi.Float)
    below = RECEIVER.position_m - 90 * RECEIVER.to_world[:, 2]
    gaussians.position = [mi.Float([float(c)] * 40) for c in below]
    operator = operator_of(gaussians, device_pose(RECEIVER, mi.Float), perception_plane(23, 61, mi.Float))
    assert operator.weights.nnz == 0
    assert not operator.magnitude(signal[None]).any()


@pytest.mark.parametrize("product", [True, False])
def test_no_gaussians(product):
    """All pruned: dark as well."""

    def none() -> Any:
        return dr.zeros(mi.Float, 0)

    blending = (
        {"opacity": None, "attenuation": [none(), none()]} if product else {"opacity": none(), "attenuation": None}
    )
    parts = ([none() for _ in range(k)] for k in (3, 3, 4, 2))
    empty = Gaussians(*parts, **blending, batch=1)
    operator = operator_of(empty, device_pose(RECEIVER, mi.Float), perception_plane(23, 61, mi.Float))
    assert operator.weights.shape == (23 * 61, 0)
    assert not operator.magnitude(np.zeros((2, 0), np.complex64)).any()


def test_batches_and_factors():
    """More transmitters than a block, one by one and together, through factors and without; all linear."""
    gaussians, _ = hard(True, mi.Float)
    operator = operator_of(gaussians, device_pose(RECEIVER, mi.Float), perception_plane(23, 61, mi.Float))
    rng = np.random.default_rng(1)
    factors, c = (
        (rng.standard_normal(s) + 1j * rng.standard_normal(s)).astype(np.complex64)
        for s in ((40, 5), (2 * BLOCK + 3, 5))
    )
    signals = c @ factors.T
    together = operator.magnitude(signals, dark=1e-3)
    alone = np.concatenate([operator.magnitude(row[None], dark=1e-3) for row in signals])
    assert error(together, alone) < SINGLE
    assert error(operator.composed(factors).magnitude(c, dark=1e-3), together) < SINGLE
    a, b = signals[:1], signals[1:2]
    mixed = operator.field(2 * a - 3j * b)
    assert error(mixed, 2 * operator.field(a) - 3j * operator.field(b)) < SINGLE


def test_operator_refuses_excess_memory_and_several_transmitters():
    gaussians, _ = hard(False, mi.Float)
    plane = perception_plane(23, 61, mi.Float)
    with pytest.raises(MemoryError, match="weights of 40 Gaussians take more than 0 MB"):
        pixel_weights(gaussians, device_pose(RECEIVER, mi.Float), plane, 1000)
    gaussians.batch = 2
    with pytest.raises(ValueError, match="for 2 transmitters; give those of one"):
        pixel_weights(gaussians, device_pose(RECEIVER, mi.Float), plane)
