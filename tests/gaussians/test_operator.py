"""The linear map from signals to pixels: equal to blending on hard fields, and linear."""

from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from made_fields import Float64, device_gaussians, oracle_image

from wrf_mi.core import Receiver, unit_vectors
from wrf_mi.gaussians import Gaussians
from wrf_mi.gaussians.blend import splat
from wrf_mi.gaussians.operator import BLOCK, PixelOperator, pixel_weights
from wrf_mi.gaussians.tiles import perception_plane
from wrf_mi.training.step import device_pose

SINGLE = 1e-5
"""Relative L2 error in float32: the weights are the same numbers, a sum of some hundred terms in another order."""
DOUBLE = 1e-12
"""The same arithmetic in another order."""
RECEIVER = Receiver("r", np.array([5.0, 0.26, 0]), np.array([0.51291602, -0.48674136, -0.48674136, 0.51291602]))
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
    blending = {"attenuation": delta} if product else {"opacity": opacity}
    arrays = {"position": position.T, "scale": scale, "rotation": rotation, "signal": signal}
    return device_gaussians(float_type, **arrays, **blending), signal


def operator_of(gaussians: Gaussians, size: tuple[int, int], float_type: Any = mi.Float) -> PixelOperator:
    plane = perception_plane(*size, float_type)
    return PixelOperator(pixel_weights(gaussians, device_pose(RECEIVER, float_type), plane), *size)


def splatted(gaussians: Gaussians, size: tuple[int, int], float_type: Any) -> np.ndarray:
    re, im = splat(gaussians, device_pose(RECEIVER, float_type), perception_plane(*size, float_type))
    return re.numpy() + 1j * im.numpy()


def error(image: Any, expected: Any) -> float:
    return float(np.linalg.norm(np.asarray(image) - expected) / np.linalg.norm(expected))


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize(
    ("product", "floats", "kind"),
    [
        (True, mi.Float, np.complex64),
        (False, mi.Float, np.float32),
        (True, Float64, np.complex128),
        (False, Float64, np.float64),
    ],
)
def test_weights_times_signals_equal_blending(product, size, floats, kind):
    gaussians, signal = hard(product, floats)
    operator, direct = operator_of(gaussians, size, floats), splatted(gaussians, size, floats)
    assert operator.weights.dtype == kind
    tolerance = SINGLE if floats is mi.Float else DOUBLE
    assert error(operator.field(signal[None])[0], direct) < tolerance
    spectrum = operator.magnitude(np.stack([signal, 2 * signal]))
    assert error(spectrum[1].ravel(), 2 * np.abs(direct)) < tolerance


@pytest.mark.parametrize("product", [True, False])
def test_weights_match_the_oracle(product):
    gaussians, signal = hard(product, Float64)
    weights = operator_of(gaussians, (45, 120), Float64).weights
    assert error(weights @ signal, oracle_image(gaussians, RECEIVER, (45, 120)).ravel()) < DOUBLE


@settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.integers(0, 2**31), st.booleans(), st.sampled_from([(1, 1), (1, 40), (12, 1), (5, 23)]))
def test_any_field_and_size(seed, product, size):
    gaussians, signal = hard(product, Float64, n=12, seed=seed)
    weights, direct = operator_of(gaussians, size, Float64).weights, splatted(gaussians, size, Float64)
    np.testing.assert_allclose(weights @ signal, direct, atol=1e-12 * np.abs(signal).sum())


def test_operator_without_visible_gaussians_is_zero():
    """Far below the horizon: no weights, and dark."""
    gaussians, signal = hard(False, mi.Float)
    below = RECEIVER.position_m - 90 * RECEIVER.to_world[:, 2]
    gaussians.position = [mi.Float([float(c)] * 40) for c in below]
    operator = operator_of(gaussians, SIZES[1])
    assert operator.weights.nnz == 0
    assert not operator.magnitude(signal[None]).any()


@pytest.mark.parametrize("product", [True, False])
def test_no_gaussians(product):
    """All pruned: dark as well."""
    blending = {"attenuation": np.zeros(0, complex)} if product else {"opacity": np.zeros(0)}
    rows = {"position": np.zeros((3, 0)), "scale": np.zeros((3, 0)), "rotation": np.zeros((4, 0))}
    operator = operator_of(device_gaussians(mi.Float, signal=np.zeros(0, complex), **rows, **blending), SIZES[1])
    assert operator.weights.shape == (23 * 61, 0)
    assert not operator.magnitude(np.zeros((2, 0), np.complex64)).any()


def test_batches_and_factors():
    """More transmitters than a block, one by one and together, through factors and without; all linear."""
    operator, rng = operator_of(hard(True, mi.Float)[0], SIZES[1]), np.random.default_rng(1)
    factors, c = (
        (rng.standard_normal((n, 5)) + 1j * rng.standard_normal((n, 5))).astype(np.complex64)
        for n in (40, 2 * BLOCK + 3)
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
    with pytest.raises(MemoryError, match="weights of 40 Gaussians take more than 0 MB"):
        pixel_weights(gaussians, device_pose(RECEIVER, mi.Float), perception_plane(23, 61, mi.Float), 1000)
    gaussians.batch = 2
    with pytest.raises(ValueError, match="for 2 transmitters; give those of one"):
        operator_of(gaussians, SIZES[1])
