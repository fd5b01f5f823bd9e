"""The linear map from signals to pixels, array elements and sectors: equal to blending on hard fields, and linear."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from wrf_mi.backend.device import on_device
from wrf_mi.core import Receiver, pixel_directions, unit_vectors
from wrf_mi.core.angles import FloatArray
from wrf_mi.core.arrays import planar_array
from wrf_mi.gaussians import (
    Gaussians,
    oracle,
)
from wrf_mi.gaussians.footprint import Pose
from wrf_mi.gaussians.operator import BLOCK, PixelOperator, pixel_weights, weight_strips
from wrf_mi.gaussians.render import splat
from wrf_mi.gaussians.tiles import perception_plane
from wrf_mi.graph.combine import ArrayReceiver, PowerReceiver
from wrf_mi.graph.evaluations import learned_field
from wrf_mi.graph.operator import ArrayOperator, SectorOperator, sector_of
from wrf_mi.receivers import bartlett_spectrum, minmax_scale

SINGLE = 1e-5
"""Relative L2 error in float32: the weights are the same numbers, a sum of some hundred terms in another order."""
ARRAY = 1e-4
"""What is asked of spectra of an array: sums over thousands of directions that nearly cancel at its elements, in single
precision on the other side."""
DOUBLE = 1e-12
"""The same arithmetic in another order."""
DECIBEL = 1e-3
"""Of a power whose amplitude is good to 1e-4."""

Float64 = dr.float64_array_t(mi.Float)
RECEIVER = Receiver(
    "gateway1", np.array([5.0, 0.26, 0.0]), np.array([0.51291602, -0.48674136, -0.48674136, 0.51291602])
)
SIZES = [(90, 360), (23, 61)]


def pose_of(float_type: Any) -> Pose:
    return Pose(
        [float_type(float(x)) for x in RECEIVER.position_m],
        [[float_type(float(x)) for x in row] for row in RECEIVER.to_world],
    )


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


def complex_of(pair: tuple[Any, Any]) -> np.ndarray:
    return pair[0].numpy() + 1j * pair[1].numpy()


def error(found: Any, expected: Any) -> float:
    return float(np.linalg.norm(np.asarray(found) - expected) / np.linalg.norm(expected))


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("product", [True, False])
@pytest.mark.parametrize("single", [True, False])
def test_weights_times_signals_equal_blending(product: bool, size: tuple[int, int], single: bool) -> None:
    floats = mi.Float if single else Float64
    gaussians, signal = hard(product, floats)
    plane = perception_plane(*size, floats)
    operator = PixelOperator.of(gaussians, pose_of(floats), plane)
    assert (
        operator.weights.dtype
        == {
            (True, True): np.complex64,
            (True, False): np.float32,
            (False, True): np.complex128,
            (False, False): np.float64,
        }[single, product]
    )
    direct = complex_of(splat(gaussians, pose_of(floats), plane))
    assert error(operator.field(signal[None])[0], direct) < (SINGLE if single else DOUBLE)
    spectrum = operator.magnitude(np.stack([signal, 2 * signal]))
    assert error(spectrum[1].ravel(), 2 * np.abs(direct)) < (SINGLE if single else DOUBLE)


@pytest.mark.parametrize("product", [True, False])
def test_weights_match_the_oracle(product: bool) -> None:
    gaussians, signal = hard(product, Float64)
    weights = pixel_weights(gaussians, pose_of(Float64), perception_plane(45, 120, Float64))

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
def test_any_field_and_size(seed: int, product: bool, height: int, width: int) -> None:
    gaussians, signal = hard(product, Float64, n=12, seed=seed)
    plane = perception_plane(height, width, Float64)
    weights = pixel_weights(gaussians, pose_of(Float64), plane)
    direct = complex_of(splat(gaussians, pose_of(Float64), plane))
    np.testing.assert_allclose(weights @ signal, direct, atol=1e-12 * np.abs(signal).sum())


def test_operator_without_visible_gaussians_is_zero() -> None:
    """Far below the horizon: no weights, and dark."""
    gaussians, signal = hard(False, mi.Float)
    below = RECEIVER.position_m - 90 * RECEIVER.to_world[:, 2]
    gaussians.position = [mi.Float([float(c)] * 40) for c in below]
    operator = PixelOperator.of(gaussians, pose_of(mi.Float), perception_plane(23, 61, mi.Float))
    assert operator.weights.nnz == 0
    assert not operator.magnitude(signal[None]).any()


@pytest.mark.parametrize("product", [True, False])
def test_no_gaussians(product: bool) -> None:
    """All pruned: dark as well."""

    def none() -> Any:
        return dr.zeros(mi.Float, 0)

    blending = (
        {"opacity": None, "attenuation": [none(), none()]} if product else {"opacity": none(), "attenuation": None}
    )
    parts = ([none() for _ in range(k)] for k in (3, 3, 4, 2))
    empty = Gaussians(*parts, **blending, batch=1)
    pose, plane = pose_of(mi.Float), perception_plane(23, 61, mi.Float)
    operator = PixelOperator.of(empty, pose, plane)
    assert operator.weights.shape == (23 * 61, 0)
    assert not operator.magnitude(np.zeros((2, 0), np.complex64)).any()
    array = ArrayOperator.of(empty, pose, plane, planar_array(2, 2, 0.16), 920e6)
    assert not array.spectrum(np.zeros((1, 0), np.complex64)).any()


def test_batches_and_factors() -> None:
    """More transmitters than a block, one by one and together, through factors and without; all linear."""
    gaussians, _ = hard(True, mi.Float)
    operator = PixelOperator.of(gaussians, pose_of(mi.Float), perception_plane(23, 61, mi.Float))
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
    assert error(operator.magnitude(signals, scale=True), minmax_scale(operator.magnitude(signals))) < SINGLE
    a, b = signals[:1], signals[1:2]
    mixed = operator.field(2 * a - 3j * b)
    assert error(mixed, 2 * operator.field(a) - 3j * operator.field(b)) < SINGLE


@pytest.mark.parametrize("scale", [False, True])
@pytest.mark.parametrize("product", [True, False])
def test_array_operator_matches_quadrature_and_bartlett(product: bool, scale: bool) -> None:
    gaussians, signal = hard(product, mi.Float)
    elements, pose, plane = planar_array(4, 4, 0.16), pose_of(mi.Float), perception_plane(90, 360, mi.Float)
    operator = ArrayOperator.of(gaussians, pose, plane, elements, 920e6)
    model = ArrayReceiver(90, 360, elements, 920e6, instrument_scale=scale)
    direct = model(None, splat(gaussians, pose, plane)).numpy().reshape(90, 360)
    assert error(operator.spectrum(signal[None], scale)[0], direct) < ARRAY
    factors = np.stack([signal, signal.conj(), 1j * signal], axis=1)
    c = np.array([[0.5, 0, -0.5j], [1, 2, 3j]])
    assert error(operator.composed(factors).spectrum(c), operator.spectrum(c @ factors.T)) < SINGLE


@pytest.mark.parametrize("arrangement", ["even", "off its origin", "with a middle", "not mirrored"])
def test_spectrum_of_element_signals(arrangement: str) -> None:
    """With the identity for a matrix, the spectrum is the processor's of its input."""
    elements = {
        "even": planar_array(2, 4, 0.16),
        "off its origin": planar_array(2, 4, 0.16) + np.array([0.3, -0.2, 0.1]),
        "with a middle": planar_array(3, 3, 0.16),
        "not mirrored": planar_array(3, 2, 0.16)[:-1],
    }[arrangement]
    rng = np.random.default_rng(4)
    h = rng.standard_normal((5, len(elements))) + 1j * rng.standard_normal((5, len(elements)))
    operator = ArrayOperator(np.eye(len(elements)), elements, 920e6, 20, 31)
    expected = bartlett_spectrum(h, elements, 920e6, 20, 31)
    assert error(operator.spectrum(h), expected) < SINGLE
    assert error(operator.spectrum(h[:1]), expected[:1]) < SINGLE


@pytest.mark.parametrize("product", [True, False])
def test_sectors(product: bool) -> None:
    gaussians, signal = hard(product, mi.Float)
    pose, plane = pose_of(mi.Float), perception_plane(30, 90, mi.Float)
    sphere = learned_field(gaussians, pose, plane, sphere=True)
    one = SectorOperator.of(gaussians, pose, plane)
    expected = PowerReceiver(30, 90, (920e6,))(None, sphere).numpy()
    np.testing.assert_allclose(one.power_db(signal[None]), expected, atol=DECIBEL)
    # Powers of sectors by hand: the lower hemisphere's directions are mirrored in y and z.
    upper = pixel_directions(30, 90).reshape(-1, 3)
    directions = np.concatenate([upper, upper * [1, -1, -1]])
    elevation = np.abs(np.arcsin(np.clip(directions[:, 2], -1, 1)))
    weight = np.cos(elevation) * (np.pi / 60) * (2 * np.pi / 90) * np.where(elevation < 1e-9, 0.5, 1)

    def pattern(unit: FloatArray) -> FloatArray:
        return np.sqrt(np.maximum(unit[..., 2], 0))

    field = complex_of(sphere) * weight * pattern(directions)
    inside = sector_of(directions, 6, 4)
    assert set(inside) == set(range(24))
    power = sum(abs(field[inside == s].sum()) ** 2 for s in range(24))
    many = SectorOperator.of(gaussians, pose, plane, 6, 4, pattern)
    np.testing.assert_allclose(many.power_db(signal[None]), 10 * np.log10(power), atol=DECIBEL)
    both = many.composed(np.stack([signal, 1j * signal], axis=1)).power_db(np.array([[1, 0], [0, 2]]))
    np.testing.assert_allclose(both, 10 * np.log10(power * np.array([1, 4])), atol=DECIBEL)


def test_operator_refuses_excess_memory_and_several_transmitters() -> None:
    gaussians, _ = hard(False, mi.Float)
    plane = perception_plane(23, 61, mi.Float)
    with pytest.raises(MemoryError, match="weights of 40 Gaussians take more than 0 MB"):
        pixel_weights(gaussians, pose_of(mi.Float), plane, 1000)
    gaussians.batch = 2
    with pytest.raises(ValueError, match="for 2 transmitters; give those of one"):
        next(weight_strips(gaussians, pose_of(mi.Float), plane))
