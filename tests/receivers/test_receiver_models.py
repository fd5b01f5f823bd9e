"""How traced and learned fields combine, against closed forms and the NumPy receivers."""

from typing import Any

import numpy as np
import pytest
from box_room import FREQUENCY_HZ
from random_paths import paths_of
from scipy.constants import speed_of_light

from wrf_mi.backend.device import on_device
from wrf_mi.backend.vectors import Float64
from wrf_mi.graph.evaluations import learned_field
from wrf_mi.receivers.device_paths import TracedPaths
from wrf_mi.receivers.receiver_models import ArrayReceiver, CsiReceiver, PixelReceiver, PowerReceiver

# isort: split
import drjit as dr
import mitsuba as mi

from wrf_mi.backend.vectors import Pose
from wrf_mi.core import Receiver, pixel_directions, unit_vectors
from wrf_mi.core.angles import solid_angles
from wrf_mi.core.arrays import planar_array
from wrf_mi.gaussians import Gaussians
from wrf_mi.gaussians.tiles import perception_plane
from wrf_mi.receivers import antenna_csi, csi
from wrf_mi.receivers.array import array_response, bartlett_spectrum
from wrf_mi.receivers.device_paths import AntennaTones, magnitude, path_sum, power
from wrf_mi.receivers.scaling import minmax_scale

DOUBLE = 1e-11  # float64, sums of a thousand terms, phases of a hundred radians
SINGLE = 2e-5  # the same in float32
ROOT = 2e-4  # `DARK` under the root raises a dark pixel to 1e-4

ORIGIN = np.zeros((1, 3))
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
    re, im, lengths, *directions = (
        Float64(np.ascontiguousarray(a).ravel()) for a in (gain.real, gain.imag, length, *np.moveaxis(arrival, -1, 0))
    )
    return TracedPaths((re, im), lengths, directions, batch, each), {"gain": gain, "length": length, "arrival": arrival}


def signals(arrays: dict[str, np.ndarray], elements: np.ndarray, *hz: float) -> np.ndarray:
    """Spherical waves from the image sources, [batch, m x frequencies], of `FREQUENCY_HZ` where none is named."""
    k = 2 * np.pi * np.array(hz or [FREQUENCY_HZ]) / speed_of_light
    source = arrays["arrival"] * arrays["length"][..., None]
    distance = np.linalg.norm(source[:, :, None] - elements, axis=-1)[..., None]
    waves = (arrays["gain"] * arrays["length"])[..., None, None] / distance * np.exp(-1j * k * distance)
    return waves.sum(axis=1).reshape(len(source), -1)


def learned(batch: int, count: int, float_type: Any = Float64, seed: int = 3) -> tuple[Any, np.ndarray]:
    values = np.random.default_rng(seed).standard_normal((2, batch, count)) * 0.3
    return tuple(on_device(part, float_type) for part in values), values[0] + 1j * values[1]


def whole_sphere(signal: np.ndarray) -> np.ndarray:
    """Integrals [batch, 1] of fields over both halves of the sphere, 6 x 8 pixels each."""
    return (signal * np.tile(solid_angles(6, 8), 2)).sum(axis=1, keepdims=True)


def image(h: np.ndarray) -> np.ndarray:
    return h @ array_response(ELEMENTS_M, DIRECTIONS, FREQUENCY_HZ).conj().T


TONES_HZ = (FREQUENCY_HZ, 1.02 * FREQUENCY_HZ)
INSTRUMENTS = {
    "spectrum": ArrayReceiver(**MODEL, instrument_scale=True),
    "channel": CsiReceiver(6, 8, TONES_HZ),
    "strength": PowerReceiver(6, 8, (FREQUENCY_HZ,), interference=False),
}


def summed(name: str, arrays: dict[str, np.ndarray]) -> np.ndarray:
    """Sums over paths that an instrument observes: element signals, channels, or powers."""
    if name == "spectrum":
        return signals(arrays, ELEMENTS_M)
    if name == "channel":
        return signals(arrays, ORIGIN, *TONES_HZ)
    return (np.abs(arrays["gain"]) ** 2).sum(axis=1, keepdims=True).astype(complex)


@pytest.mark.parametrize("name", INSTRUMENTS)
def test_an_instrument_observes_alike_of_paths_in_numpy_in_drjit_and_of_sums(name: str) -> None:
    model, (traced, arrays) = INSTRUMENTS[name], paths()
    count = arrays["gain"].size
    tx, rx = np.repeat([0, 1], count // 2), np.zeros(count, np.int64)
    arrival = arrays["arrival"].reshape(-1, 3)
    stored = paths_of(tx, rx, arrays["gain"].ravel(), arrays["length"].ravel(), arrival, 2, 1)
    observed = model.observed(stored, Receiver("rx", np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])))
    expected = np.ascontiguousarray(observed).view(float) if np.iscomplexobj(observed) else observed
    for report in (model(traced, None).numpy(), model.signal_observation(summed(name, arrays))):
        np.testing.assert_allclose(report.reshape(2, -1), expected.reshape(2, -1), atol=ROOT)


@pytest.mark.parametrize("name", INSTRUMENTS)
def test_slopes_of_observations_are_finite_differences(name: str) -> None:
    """Of the second row alone, in two parts; the observations of spectra are of single precision."""
    model, signal, step = INSTRUMENTS[name], summed(name, paths()[1]), 1e-3
    rng = np.random.default_rng(7)
    change: Any = rng.normal(size=(1, signal.shape[1])) + 1j * rng.normal(size=(1, signal.shape[1]))
    if name == "strength":
        change = change.real.astype(complex)
    above, below = (model.signal_observation(signal[1:] + side * step * change) for side in (1, -1))
    expected = (above - below) / (2 * step)
    slopes = model.signal_slopes([signal[:1], signal[1:]])(change, np.array([1]))
    np.testing.assert_allclose(slopes, expected, atol=2e-3 * np.abs(expected).max())


def test_path_sum_matches_spherical_waves() -> None:
    traced, arrays = paths()
    re, im = path_sum(traced, AntennaTones(ELEMENTS_M, np.full(len(ELEMENTS_M), FREQUENCY_HZ)))
    np.testing.assert_allclose((re.numpy() + 1j * im.numpy()).reshape(2, -1), signals(arrays, ELEMENTS_M), atol=DOUBLE)


def test_path_sums_of_far_and_faint_paths_keep_phases_at_28_ghz() -> None:
    """Paths of 1 m to 100 km, gains of 1e-15 to 1e15, compared with the receivers in NumPy."""
    rng, each, carrier_hz = np.random.default_rng(0), 50, 28e9
    length, phase = 10 ** rng.uniform(0, 5, each), np.exp(1j * rng.uniform(0, 7, each))
    gain = 10 ** rng.uniform(-15, 15, each) * phase
    arrival = unit_vectors(rng.uniform(0, 7, each), rng.uniform(-1.5, 1.5, each))
    real, imaginary, lengths, *directions = (
        Float64(np.ascontiguousarray(a)) for a in (gain.real, gain.imag, length, *arrival.T)
    )
    traced, first = TracedPaths((real, imaginary), lengths, directions, 1, each), np.zeros(each, np.int64)
    stored = paths_of(first, first, gain, length, arrival, 1, 1)
    elements_m, tones_hz = planar_array(4, 4, 0.005), carrier_hz * np.linspace(0.98, 1.02, 16)
    array = Receiver("array", np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))
    for ports, expected in (
        (AntennaTones(elements_m, np.full(16, carrier_hz)), antenna_csi(stored, array, elements_m, carrier_hz)[..., 0]),
        (AntennaTones(np.zeros((16, 3)), tones_hz), csi(stored, tones_hz)),
    ):
        re, im = path_sum(traced, ports)
        error = np.abs(re.numpy() + 1j * im.numpy() - expected.ravel()).max()
        assert error < 1e-6 * np.abs(gain).sum()


@pytest.mark.parametrize("how", ["coherent", "power"])
def test_pixel_and_array_receivers_add_both_components(how: Any) -> None:
    (traced, arrays), (field, signal) = paths(), learned(2, HEIGHT * WIDTH)
    of_paths = image(signals(arrays, ELEMENTS_M))
    at_array = image((signal * solid_angles(HEIGHT, WIDTH)) @ array_response(ELEMENTS_M, DIRECTIONS, FREQUENCY_HZ))
    for kind, of_field in ((PixelReceiver, signal), (ArrayReceiver, at_array)):
        both = np.abs(of_paths + of_field) if how == "coherent" else np.hypot(np.abs(of_paths), np.abs(of_field))
        model = kind(**MODEL, how=how)
        np.testing.assert_allclose(model(traced, field).numpy(), both.ravel(), atol=ROOT)
        np.testing.assert_allclose(model(None, field).numpy(), np.abs(of_field).ravel(), atol=ROOT)
        expected = bartlett_spectrum(signals(arrays, ELEMENTS_M), ELEMENTS_M, FREQUENCY_HZ, HEIGHT, WIDTH)
        only = model(traced, None).numpy().reshape(expected.shape)
        np.testing.assert_allclose(only, expected, atol=SINGLE * expected.max() + ROOT)
    instrument = ArrayReceiver(**MODEL, how=how, instrument_scale=True)(traced, field).numpy()
    scale = minmax_scale(both.reshape(2, HEIGHT, WIDTH))
    np.testing.assert_allclose(instrument.reshape(scale.shape), scale, atol=ROOT)


def test_learned_plane_wave_equals_traced_plane_wave() -> None:
    """A learned field that is one pixel of the right strength reaches the array as a traced path from afar does."""
    pixel, far = 7 * WIDTH + 11, 1e6
    weight = solid_angles(HEIGHT, WIDTH)[pixel]
    spot = np.zeros(HEIGHT * WIDTH)
    spot[pixel] = 1 / weight
    field = Float64(spot), dr.zeros(Float64, HEIGHT * WIDTH)
    phase = np.exp(2j * np.pi * FREQUENCY_HZ / speed_of_light * far)
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
    traced, arrays = paths()
    count = 2 * 45 * 60
    field = dr.full(Float64, 0.3, 2 * count), dr.full(Float64, -0.1, 2 * count)
    h = signals(arrays, ORIGIN)[:, 0], 4 * np.pi * (0.3 - 0.1j)
    total = np.abs(h[0] + h[1]) ** 2 if how == "coherent" else np.abs(h[0]) ** 2 + np.abs(h[1]) ** 2
    quadrature = 1e-3  # trapezoidal rule over elevations 2 degrees apart: (0.035 rad)^2 / 12 of the integral, in dB
    np.testing.assert_allclose(model(traced, field).numpy(), 10 * np.log10(total), atol=10 * quadrature)
    np.testing.assert_allclose(model(traced, None).numpy(), 10 * np.log10(np.abs(h[0]) ** 2), atol=1e-4)
    silent = dr.zeros(Float64, 2 * count), dr.zeros(Float64, 2 * count)
    np.testing.assert_allclose(model(None, silent).numpy(), -200.0, atol=1e-9)
    # What is observed where nothing arrives changes nothing else, and is no part of a missing gain.
    noisy = PowerReceiver(45, 60, (FREQUENCY_HZ,), how=how, floor=0.1)
    np.testing.assert_allclose(noisy(None, silent).numpy(), -10.0, atol=1e-9)
    np.testing.assert_array_equal(noisy(traced, field).numpy(), model(traced, field).numpy())
    report, observed = np.array([-10.0, -30.0, -40.0]), np.array([40.0, -10.0, -20.0])
    assert noisy.missing_gain(report, observed) == pytest.approx(np.log(10))


def test_power_over_channels_and_without_interference() -> None:
    """The mean over channels of the power of their sums, and the sum of the paths' powers."""
    frequencies = (FREQUENCY_HZ, 1.01 * FREQUENCY_HZ, 1.03 * FREQUENCY_HZ)
    (traced, arrays), (field, signal) = paths(), learned(2, 2 * 6 * 8)
    sphere_signal, powers = whole_sphere(signal), (np.abs(arrays["gain"]) ** 2).sum(axis=1)
    hopping = PowerReceiver(6, 8, frequencies)
    faded = PowerReceiver(6, 8, frequencies, how="power", interference=False)
    # A mean power has no phase: as a complex number it is its root, which the learned component raises or lowers.
    mixed = PowerReceiver(6, 8, frequencies, interference=False)
    for model, addition, expected, atol in (
        (hopping, field, (np.abs(signals(arrays, ORIGIN, *frequencies) + sphere_signal) ** 2).mean(axis=1), DOUBLE),
        (faded, field, powers + np.abs(sphere_signal[:, 0]) ** 2, DOUBLE),
        (faded, None, powers, 1e-4),
        (mixed, field, np.abs(np.sqrt(powers) + sphere_signal[:, 0]) ** 2, DOUBLE),
    ):
        np.testing.assert_allclose(model(traced, addition).numpy(), 10 * np.log10(expected), atol=atol)


@pytest.mark.parametrize(("antennas", "coefficients"), [(1, 0), (1, 4), (3, 4)])
def test_channels_with_and_without_a_basis(antennas: int, coefficients: int) -> None:
    """Learned coefficients times a basis, or a number for all subcarriers, and paths at each antenna and subcarrier."""
    rng, number = np.random.default_rng(4), coefficients or 1
    elements = rng.normal(0, 0.03, (antennas, 3)) if antennas > 1 else ORIGIN
    basis = rng.normal(size=(number, 2 * antennas)) + 1j * rng.normal(size=(number, 2 * antennas))
    how = (elements if antennas > 1 else None, basis) if coefficients else ()
    model = CsiReceiver(6, 8, TONES_HZ, *how)
    (traced, arrays), (field, signal) = paths(), learned(2 * number, 2 * 6 * 8)
    of_field = whole_sphere(signal).reshape(2, number) @ (basis if coefficients else np.ones((1, 2)))
    report = model(traced, field).numpy().reshape(2, -1, 2) @ [1, 1j]
    assert model.shape == ((antennas, 2, 2) if antennas > 1 else (2, 2))
    np.testing.assert_allclose(report, signals(arrays, elements, *TONES_HZ) + of_field, atol=DOUBLE)


@pytest.mark.parametrize("float_type", [mi.Float, Float64])
def test_float_types(float_type: Any) -> None:
    """The learned component's type is that of the observation, and single precision is as good as it can be."""
    (traced, _), (exact, _) = paths(), learned(2, HEIGHT * WIDTH)
    report = ArrayReceiver(**MODEL)(traced, learned(2, HEIGHT * WIDTH, float_type)[0])
    assert type(report) is float_type
    reference = ArrayReceiver(**MODEL)(traced, exact).numpy()
    np.testing.assert_allclose(report.numpy(), reference, atol=SINGLE * reference.max())


def test_receivers_refuse_two_absent_components() -> None:
    with pytest.raises(ValueError, match="neither"):
        CsiReceiver(6, 8, TONES_HZ)(None, None)
    with pytest.raises(ValueError, match="0 components"):
        magnitude(None, None, "coherent")
    field, _ = learned(1, 4)
    with pytest.raises(ValueError, match="'sum'"):
        power(field, field, "sum")  # type: ignore[arg-type]


def test_full_sphere_includes_directions_below_the_horizon() -> None:
    """One Gaussian below the horizon: on the pixel of its direction, dark in the upper half."""
    target = (HEIGHT * WIDTH) + 5 * WIDTH + 13
    directions = np.concatenate([DIRECTIONS, DIRECTIONS * [1, -1, -1]])  # the lower half after half a turn about x
    assert directions[target, 2] < 0
    at = directions[target] * 4
    zero, unit = Float64(0.0), Float64(1.0)
    shape = {"scale": [Float64(0.2)] * 3, "rotation": [zero, zero, zero, unit], "opacity": Float64(0.9)}
    signal = [Float64(0.8), Float64(-0.3)]
    gaussian = Gaussians(position=[Float64(x) for x in at], signal=signal, attenuation=None, batch=1, **shape)
    pose = Pose([zero] * 3, [[unit if i == j else zero for j in range(3)] for i in range(3)])
    plane = perception_plane(HEIGHT, WIDTH, Float64)
    signal = np.array([1, 1j]) @ [part.numpy() for part in learned_field(gaussian, pose, plane, sphere=True)]
    assert np.abs(signal).argmax() == target
    assert signal[target] == pytest.approx(0.9 * (0.8 - 0.3j), abs=1e-9)
    assert not signal[: HEIGHT * WIDTH].any()
    np.testing.assert_array_equal(learned_field(gaussian, pose, plane)[0].numpy(), signal.real[: HEIGHT * WIDTH])
