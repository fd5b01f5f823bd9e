"""How traced and learned fields combine, against closed forms and the NumPy receivers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from box_room import FREQUENCY_HZ
from scipy.constants import speed_of_light

from wrf_mi.backend.device import on_device
from wrf_mi.graph.evaluations import learned_field
from wrf_mi.receivers.device_paths import TracedPaths
from wrf_mi.receivers.receiver_models import ArrayReceiver, CsiReceiver, PixelReceiver, PowerReceiver

# isort: split
import drjit as dr
import mitsuba as mi

from wrf_mi.backend.vectors import Pose
from wrf_mi.core import Paths, Receiver, pixel_directions, unit_vectors
from wrf_mi.core.angles import solid_angles
from wrf_mi.core.arrays import planar_array
from wrf_mi.gaussians import Gaussians
from wrf_mi.gaussians.tiles import perception_plane
from wrf_mi.receivers.array import array_response, bartlett_spectrum
from wrf_mi.receivers.device_paths import Ports, path_sum
from wrf_mi.receivers.receiver_models import magnitude, power
from wrf_mi.receivers.reports import minmax_scale, scaled

Float64 = dr.float64_array_t(mi.Float)

DOUBLE = 1e-11
"""Float64, sums of a thousand terms, phases of a hundred radians."""
SINGLE = 2e-5
"""The same in float32."""
ROOT = 2e-4
"""`DARK` under the root raises a dark pixel to 1e-4."""

K = 2 * np.pi * FREQUENCY_HZ / speed_of_light
HEIGHT, WIDTH = 18, 40
ELEMENTS_M = planar_array(4, 3, 0.16)
DIRECTIONS = pixel_directions(HEIGHT, WIDTH).reshape(-1, 3)
MODEL: dict[str, Any] = {"height": HEIGHT, "width": WIDTH, "elements_m": ELEMENTS_M, "frequency_hz": FREQUENCY_HZ}


def paths(batch: int = 2, each: int = 3, seed: int = 0) -> tuple[TracedPaths, dict[str, np.ndarray]]:
    """Random paths from 3 to 8 m away, and the same as NumPy arrays [batch, each, ...]."""
    rng = np.random.default_rng(seed)
    gain = rng.standard_normal((batch, each)) + 1j * rng.standard_normal((batch, each))
    gain[1, -1] = 0  # a place holder
    length = rng.uniform(3, 8, (batch, each))
    arrival = unit_vectors(rng.uniform(0, 7, (batch, each)), rng.uniform(0.1, 1.4, (batch, each)))
    flat = [Float64(a.ravel()) for a in (gain.real.copy(), gain.imag.copy(), length)]
    directions = [Float64(np.ascontiguousarray(arrival[..., i]).ravel()) for i in range(3)]
    made = TracedPaths((flat[0], flat[1]), flat[2], directions, batch, each)
    return made, {"gain": gain, "length": length, "arrival": arrival}


def signals(found: dict[str, np.ndarray], elements: np.ndarray, k: float = K) -> np.ndarray:
    """Spherical waves from the image sources, [batch, m]."""
    source = found["arrival"] * found["length"][..., None]
    distance = np.linalg.norm(source[:, :, None] - elements, axis=-1)
    waves = (found["gain"] * found["length"])[..., None] / distance * np.exp(-1j * k * distance)
    return waves.sum(axis=1)


def learned(batch: int, count: int, float_type: Any = Float64, seed: int = 3) -> tuple[Any, np.ndarray]:
    values = np.random.default_rng(seed).standard_normal((2, batch, count)) * 0.3
    return tuple(on_device(part, float_type) for part in values), values[0] + 1j * values[1]


def image(h: np.ndarray) -> np.ndarray:
    return h @ array_response(ELEMENTS_M, DIRECTIONS, FREQUENCY_HZ).conj().T


TONES_HZ = (FREQUENCY_HZ, 1.02 * FREQUENCY_HZ)
INSTRUMENTS = {
    "spectrum": ArrayReceiver(**MODEL, instrument_scale=True),
    "channel": CsiReceiver(6, 8, TONES_HZ),
    "strength": PowerReceiver(6, 8, (FREQUENCY_HZ,), interference=False),
}


def summed(name: str, arrays: dict[str, np.ndarray]) -> np.ndarray:
    """Sums over paths that an instrument reports: element signals, channels, or powers."""
    if name == "spectrum":
        return signals(arrays, ELEMENTS_M)
    if name == "channel":
        return np.concatenate([signals(arrays, np.zeros((1, 3)), K * hz / FREQUENCY_HZ) for hz in TONES_HZ], axis=1)
    return (np.abs(arrays["gain"]) ** 2).sum(axis=1, keepdims=True).astype(complex)


@pytest.mark.parametrize("name", INSTRUMENTS)
def test_an_instrument_reports_alike_of_paths_in_numpy_in_drjit_and_of_sums(name: str) -> None:
    model, (traced, arrays) = INSTRUMENTS[name], paths()
    size = arrays["gain"].size
    none = np.zeros((size, 0))
    stored = Paths(
        tx=np.repeat([0, 1], size // 2),
        rx=np.zeros(size, np.int64),
        gain=arrays["gain"].ravel(),
        length_m=arrays["length"].ravel(),
        departure=-arrays["arrival"].reshape(-1, 3),
        arrival=arrays["arrival"].reshape(-1, 3),
        interactions=none.astype(np.uint8),
        vertices_m=np.zeros((size, 0, 3)),
        objects=none.astype(np.int32),
        object_names=(),
        n_tx=2,
        n_rx=1,
    )
    observed = model.observed(stored, Receiver("rx", np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])))
    expected = np.ascontiguousarray(observed).view(float) if np.iscomplexobj(observed) else observed
    for report in (model(traced, None).numpy(), model.signal_report(summed(name, arrays))):
        np.testing.assert_allclose(report.reshape(2, -1), expected.reshape(2, -1), atol=ROOT)


@pytest.mark.parametrize("name", INSTRUMENTS)
def test_slopes_of_reports_are_finite_differences(name: str) -> None:
    """Of the second row alone, in two parts; the reports of spectra are of single precision."""
    model, signal, step = INSTRUMENTS[name], summed(name, paths()[1]), 1e-3
    rng = np.random.default_rng(7)
    change = rng.normal(size=(1, signal.shape[1])) + 1j * rng.normal(size=(1, signal.shape[1]))
    if name == "strength":
        change = change.real.astype(complex)
    above, below = (model.signal_report(signal[1:] + side * step * change) for side in (1, -1))
    expected = (above - below) / (2 * step)
    slopes = model.signal_slopes([signal[:1], signal[1:]])(change, np.array([1]))
    np.testing.assert_allclose(slopes, expected, atol=2e-3 * np.abs(expected).max())


def test_path_sum_matches_spherical_waves() -> None:
    made, found = paths()
    re, im = path_sum(made, Ports(ELEMENTS_M, np.full(len(ELEMENTS_M), FREQUENCY_HZ)))
    np.testing.assert_allclose((re.numpy() + 1j * im.numpy()).reshape(2, -1), signals(found, ELEMENTS_M), atol=DOUBLE)


@pytest.mark.parametrize("how", ["coherent", "power"])
def test_pixel_receiver(how: Any) -> None:
    (made, found), (field, signal) = paths(), learned(2, HEIGHT * WIDTH)
    traced = image(signals(found, ELEMENTS_M))
    report = PixelReceiver(**MODEL, how=how)(made, field).numpy().reshape(2, -1)
    both = {"coherent": np.abs(traced + signal), "power": np.hypot(np.abs(traced), np.abs(signal))}
    np.testing.assert_allclose(report, both[how], atol=ROOT)
    np.testing.assert_allclose(PixelReceiver(**MODEL, how=how)(None, field).numpy(), np.abs(signal).ravel(), atol=ROOT)
    only = PixelReceiver(**MODEL, how=how)(made, None).numpy().reshape(2, HEIGHT, WIDTH)
    expected = bartlett_spectrum(signals(found, ELEMENTS_M), ELEMENTS_M, FREQUENCY_HZ, HEIGHT, WIDTH)
    np.testing.assert_allclose(only, expected, atol=SINGLE * expected.max() + ROOT)


@pytest.mark.parametrize("how", ["coherent", "power"])
def test_array_receiver(how: Any) -> None:
    (made, found), (field, signal) = paths(), learned(2, HEIGHT * WIDTH)
    response = array_response(ELEMENTS_M, DIRECTIONS, FREQUENCY_HZ)
    h = [signals(found, ELEMENTS_M), (signal * solid_angles(HEIGHT, WIDTH)) @ response]
    both = {"coherent": np.abs(image(h[0] + h[1])), "power": np.hypot(*(np.abs(image(part)) for part in h))}
    report = ArrayReceiver(**MODEL, how=how)(made, field).numpy().reshape(2, -1)
    np.testing.assert_allclose(report, both[how], atol=ROOT)
    instrument = ArrayReceiver(**MODEL, how=how, instrument_scale=True)(made, field).numpy()
    expected = minmax_scale(both[how].reshape(2, HEIGHT, WIDTH))
    np.testing.assert_allclose(instrument.reshape(2, HEIGHT, WIDTH), expected, atol=ROOT)
    alone = ArrayReceiver(**MODEL, how=how)(None, field).numpy()
    np.testing.assert_allclose(alone, np.abs(image(h[1])).ravel(), atol=ROOT)


def test_learned_plane_wave_equals_traced_plane_wave() -> None:
    """A learned field that is one pixel of the right strength reaches the array as a traced path from afar does."""
    pixel, far = 7 * WIDTH + 11, 1e6
    weight = solid_angles(HEIGHT, WIDTH)[pixel]
    spot = np.zeros(HEIGHT * WIDTH)
    spot[pixel] = 1 / weight
    field = Float64(spot), dr.zeros(Float64, HEIGHT * WIDTH)
    phase = np.exp(1j * K * far)
    path = TracedPaths(
        (Float64(phase.real), Float64(phase.imag)), Float64(far), [Float64(x) for x in DIRECTIONS[pixel]], 1, 1
    )
    model = ArrayReceiver(**MODEL)
    # Curvature over the array, k a^2 / 2 d, and float64's rounding of a phase of 2e7 rad.
    np.testing.assert_allclose(model(None, field).numpy(), model(path, None).numpy(), rtol=SINGLE, atol=ROOT)
    double = model(path, field).numpy()
    np.testing.assert_allclose(double, 2 * model(None, field).numpy(), atol=2 * ROOT)


@pytest.mark.parametrize("how", ["coherent", "power"])
def test_power_receiver(how: Any) -> None:
    """The integral of a constant over the full sphere is 4 pi."""
    model = PowerReceiver(45, 60, (FREQUENCY_HZ,), how=how)
    made, found = paths()
    count = 2 * 45 * 60
    field = dr.full(Float64, 0.3, 2 * count), dr.full(Float64, -0.1, 2 * count)
    h = [signals(found, np.zeros((1, 3)))[:, 0], 4 * np.pi * (0.3 - 0.1j)]
    total = np.abs(h[0] + h[1]) ** 2 if how == "coherent" else np.abs(h[0]) ** 2 + np.abs(h[1]) ** 2
    quadrature = 1e-3  # trapezoidal rule over elevations 2 degrees apart: (0.035 rad)^2 / 12 of the integral, in dB
    np.testing.assert_allclose(model(made, field).numpy(), 10 * np.log10(total), atol=10 * quadrature)
    np.testing.assert_allclose(model(made, None).numpy(), 10 * np.log10(np.abs(h[0]) ** 2), atol=1e-4)
    silent = dr.zeros(Float64, 2 * count), dr.zeros(Float64, 2 * count)
    np.testing.assert_allclose(model(None, silent).numpy(), -200.0, atol=1e-9)
    # What is reported where nothing arrives changes nothing else, and is no part of a missing gain.
    noisy = PowerReceiver(45, 60, (FREQUENCY_HZ,), how=how, floor=0.1)
    np.testing.assert_allclose(noisy(None, silent).numpy(), -10.0, atol=1e-9)
    np.testing.assert_array_equal(noisy(made, field).numpy(), model(made, field).numpy())
    report, observed = np.array([-10.0, -30.0, -40.0]), np.array([40.0, -10.0, -20.0])
    assert noisy.missing_gain(report, observed) == pytest.approx(np.log(10))


def test_power_over_channels_and_without_interference() -> None:
    """The mean over channels of the power of their sums, and the sum of the paths' powers."""
    frequencies = (FREQUENCY_HZ, 1.01 * FREQUENCY_HZ, 1.03 * FREQUENCY_HZ)
    (made, found), (field, signal) = paths(), learned(2, 2 * 6 * 8)
    origin = np.zeros((1, 3))
    traced = np.concatenate([signals(found, origin, K * f / FREQUENCY_HZ) for f in frequencies], axis=1)
    whole = (signal * np.tile(solid_angles(6, 8), 2)).sum(axis=1, keepdims=True)
    hopping = PowerReceiver(6, 8, frequencies)(made, field).numpy()
    np.testing.assert_allclose(hopping, 10 * np.log10((np.abs(traced + whole) ** 2).mean(axis=1)), atol=DOUBLE)
    faded = PowerReceiver(6, 8, frequencies, how="power", interference=False)
    powers = (np.abs(found["gain"]) ** 2).sum(axis=1)
    expected = 10 * np.log10(powers + np.abs(whole[:, 0]) ** 2)
    np.testing.assert_allclose(faded(made, field).numpy(), expected, atol=DOUBLE)
    np.testing.assert_allclose(faded(made, None).numpy(), 10 * np.log10(powers), atol=1e-4)
    # A mean power has no phase: as a complex number it is its root, which the learned side raises or lowers.
    mixed = PowerReceiver(6, 8, frequencies, interference=False)
    expected = 20 * np.log10(np.abs(np.sqrt(powers) + whole[:, 0]))
    np.testing.assert_allclose(mixed(made, field).numpy(), expected, atol=DOUBLE)


@pytest.mark.parametrize("antennas", [1, 3])
def test_channels_of_a_basis(antennas: int) -> None:
    """Learned coefficients times a basis, and paths at every antenna and subcarrier."""
    frequencies, rng = (FREQUENCY_HZ, 1.01 * FREQUENCY_HZ), np.random.default_rng(4)
    elements = rng.normal(0, 0.03, (antennas, 3))
    basis = rng.normal(size=(4, 2 * antennas)) + 1j * rng.normal(size=(4, 2 * antennas))
    model = CsiReceiver(6, 8, frequencies, elements if antennas > 1 else None, basis)
    (made, found), (field, signal) = paths(), learned(2 * 4, 2 * 6 * 8)
    places = elements if antennas > 1 else np.zeros((1, 3))
    traced = np.stack([signals(found, places, K * f / FREQUENCY_HZ) for f in frequencies], axis=-1).reshape(2, -1)
    coefficients = (signal * np.tile(solid_angles(6, 8), 2)).sum(axis=1).reshape(2, 4)
    expected = traced + coefficients @ basis
    report = model(made, field).numpy().reshape(2, -1, 2)
    assert model.shape == ((antennas, 2, 2) if antennas > 1 else (2, 2))
    np.testing.assert_allclose(report[..., 0] + 1j * report[..., 1], expected, atol=DOUBLE)


def test_csi_receiver() -> None:
    """Two subcarriers see the same paths at other phases."""
    frequencies = (FREQUENCY_HZ, 1.02 * FREQUENCY_HZ)
    model = CsiReceiver(6, 8, frequencies)
    made, found = paths()
    field, signal = learned(2, 2 * 6 * 8)
    origin = np.zeros((1, 3))
    traced = np.concatenate([signals(found, origin, K * f / FREQUENCY_HZ) for f in frequencies], axis=1)
    whole = (signal * np.tile(solid_angles(6, 8), 2)).sum(axis=1, keepdims=True)
    report = model(made, field).numpy().reshape(2, 2, 2) @ [1, 1j]
    np.testing.assert_allclose(report, traced + whole, atol=DOUBLE)
    with pytest.raises(ValueError, match="neither"):
        model(None, None)


@pytest.mark.parametrize("float_type", [mi.Float, Float64])
def test_float_types(float_type: Any) -> None:
    """The learned side's type is that of the report, and single precision is as good as it can be."""
    (made, _), (exact, _) = paths(), learned(2, HEIGHT * WIDTH)
    field, _ = learned(2, HEIGHT * WIDTH, float_type)
    report = ArrayReceiver(**MODEL)(made, field)
    assert type(report) is float_type
    reference = ArrayReceiver(**MODEL)(made, exact).numpy()
    np.testing.assert_allclose(report.numpy(), reference, atol=SINGLE * reference.max())


def test_weights_and_scaling() -> None:
    assert solid_angles(90, 360).sum() == pytest.approx(2 * np.pi, rel=1e-4)
    values = np.random.default_rng(0).uniform(2, 5, (3, 4, 5))
    values[2] = 1.5
    np.testing.assert_allclose(scaled(Float64(values.ravel()), 20).numpy().reshape(values.shape), minmax_scale(values))


def test_receivers_refuse_two_absent_sides() -> None:
    with pytest.raises(ValueError, match="0 sides"):
        magnitude(None, None, "coherent")
    field, _ = learned(1, 4)
    with pytest.raises(ValueError, match="'sum'"):
        power(field, field, "sum")  # type: ignore[arg-type]


def test_full_sphere_includes_directions_below_the_horizon() -> None:
    """One Gaussian below the horizon: on the pixel of its direction, dark in the upper half."""
    target = (HEIGHT * WIDTH) + 5 * WIDTH + 13
    upper = pixel_directions(HEIGHT, WIDTH).reshape(-1, 3)
    directions = np.concatenate([upper, upper * [1, -1, -1]])  # the lower half after half a turn about x
    assert directions[target, 2] < 0
    at = directions[target] * 4
    zero, one = Float64(0.0), Float64(1.0)
    gaussian = Gaussians(
        position=[Float64(x) for x in at],
        scale=[Float64(0.2)] * 3,
        rotation=[zero, zero, zero, one],
        signal=[Float64(0.8), Float64(-0.3)],
        opacity=Float64(0.9),
        attenuation=None,
        batch=1,
    )
    pose = Pose([zero] * 3, [[one if i == j else zero for j in range(3)] for i in range(3)])
    plane = perception_plane(HEIGHT, WIDTH, Float64)
    re, im = (part.numpy() for part in learned_field(gaussian, pose, plane, sphere=True))
    signal = re + 1j * im
    assert np.abs(signal).argmax() == target
    assert signal[target] == pytest.approx(0.9 * (0.8 - 0.3j), abs=1e-9)
    assert not signal[: HEIGHT * WIDTH].any()
    upper = learned_field(gaussian, pose, plane)
    np.testing.assert_array_equal(upper[0].numpy(), re[: HEIGHT * WIDTH])
