"""Array response and Bartlett spectrum against closed forms, and against measured spectra."""

import numpy as np
import pytest
from changed_folders import DATA, needs
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.constants import speed_of_light

from wrf_mi.core import pixel_directions, unit_vectors
from wrf_mi.core.arrays import planar_array
from wrf_mi.datasets import load
from wrf_mi.receivers import array as module
from wrf_mi.receivers.array import array_response, bartlett_spectrum, mirror_order

FREQUENCY_HZ = 920e6
SPACING_M = 0.16
EXACT = 1e-9  # sums of 16 terms of size one in float64
ROUNDING_RMS = 0.0013
"""8-bit greys are off by up to 1/510; squared, the real spectra's residual was measured as 0.0012 rms."""

ROUNDING = 1e-12  # sums of some hundred products in double precision, of signals of size 1
SIZE = 14, 31

RNG = np.random.default_rng(0)
ARRAYS = {
    "regular": planar_array(4, 4, 0.16),
    "odd, off the origin": planar_array(3, 5, 0.16) + np.array([0.3, -0.2, 0.1]),
    "two lines": planar_array(9, 8, 0.16) + np.array([0.1, 0, 0]),
    "two lines, odd, shuffled": RNG.permutation(planar_array(9, 9, 0.12)) + np.array([0.3, -0.2, 0.1]),
    "uneven lines": (np.array([[x, y, 0] for x in (0, 0.1, 0.3) for y in range(40)], float) * [1, 0.1, 1]),
    "a grid with a gap": planar_array(9, 9, 0.1)[:-1],
    "not planar": RNG.normal(size=(70, 3)),
    "tilted": planar_array(8, 8, 0.1) @ np.linalg.qr(RNG.normal(size=(3, 3)))[0],
    "single": np.array([[0.2, 0.1, 0.0]]),
    "coinciding": np.array([[0.2, 0, 0], [0.2, 0, 0], [-0.2, 0, 0], [-0.2, 0, 0.0]]),
}


def test_planar_array_is_a_centred_grid_whose_nearer_elements_lead_in_phase():
    array = planar_array(2, 3, 0.1)
    expected = [[x, y, 0] for y in (-0.05, 0.05) for x in (-0.1, 0, 0.1)]
    np.testing.assert_allclose(array, expected, atol=EXACT)
    for wrong in ((0, 4, 0.1), (4, 0, 0.1), (4, 4, 0), (4, 4, float("nan"))):
        with pytest.raises(ValueError, match="positive"):
            planar_array(*wrong)
    # Half a wavelength nearer to the source an element leads by pi; one across the wave is in phase.
    half = speed_of_light / FREQUENCY_HZ / 2
    response = array_response([[0, 0, 0], [half, 0, 0], [0, half, 0], [half / 2, 0, 0]], [1, 0, 0], FREQUENCY_HZ)
    np.testing.assert_allclose(response, [1, -1, 1, 1j], atol=EXACT)


@settings(max_examples=30, deadline=None)
@given(row=st.integers(0, 29), column=st.integers(0, 89), phase=st.floats(0, 6), gain=st.floats(0.1, 10))
def test_spectrum_of_a_plane_wave_peaks_at_its_direction(row: int, column: int, phase: float, gain: float):
    """Height 30 and width 90: the direction of a pixel is a sample, so the peak's value is exact."""
    array = planar_array(4, 4, SPACING_M)
    wave = gain * np.exp(1j * phase) * array_response(array, pixel_directions(30, 90)[row, column], FREQUENCY_HZ)
    spectrum = bartlett_spectrum(wave, array, FREQUENCY_HZ, 30, 90)
    assert spectrum[row, column] == pytest.approx(16 * gain, rel=EXACT)
    assert spectrum.max() <= 16 * gain * (1 + EXACT)


def test_spectrum_of_a_plane_wave_is_the_array_factor():
    """With the wave u, the spectrum at v is the product of two Dirichlet kernels of k d (u - v)."""
    array = planar_array(4, 4, SPACING_M)
    u = unit_vectors(0.7, 0.4)
    steps = 2 * np.pi * FREQUENCY_HZ / speed_of_light * SPACING_M * (u - pixel_directions(9, 36))[..., :2]
    with np.errstate(invalid="ignore"):
        factor = np.abs(np.where(np.abs(steps) < 1e-12, 4, np.sin(2 * steps) / np.sin(steps / 2))).prod(axis=-1)
    spectrum = bartlett_spectrum(array_response(array, u, FREQUENCY_HZ), array, FREQUENCY_HZ, 9, 36)
    np.testing.assert_allclose(spectrum, factor, atol=EXACT)
    several = bartlett_spectrum(np.ones((2, 5, 16)), array, FREQUENCY_HZ, 9, 36)
    assert several.shape == (2, 5, 9, 36)


@needs("rfid-lab")
@pytest.mark.parametrize(("first_row", "obeys"), [(0, True), (1, False)])
def test_measured_spectra_are_bartlett_spectra_of_their_array(first_row: int, obeys: bool):
    """Squared, they lie in the span of the array's 49 lag harmonics; with elevations 1 to 90 they would not."""
    squared = load(DATA / "rfid-lab").observation[0].astype(float).reshape(200, -1) ** 2
    u = unit_vectors(np.radians(np.arange(360))[None, :], np.radians(np.arange(90) + first_row)[:, None])
    lags = np.array([(a, b) for a in range(-3, 4) for b in range(-3, 4) if (a, b) > (0, 0)])
    phase = 2 * np.pi * FREQUENCY_HZ / speed_of_light * SPACING_M * (u.reshape(-1, 3)[:, :2] @ lags.T)
    harmonics, _ = np.linalg.qr(np.concatenate([np.ones((len(phase), 1)), np.cos(phase), np.sin(phase)], axis=1))
    assert harmonics.shape[1] == 49
    residual = squared - (squared @ harmonics) @ harmonics.T
    assert (np.sqrt(np.mean(residual**2)) < ROUNDING_RMS) == obeys


@pytest.mark.parametrize("size", [(14, 31), (9, 24)])
@pytest.mark.parametrize("name", ARRAYS)
def test_spectrum_is_the_plain_sum(name: str, size: tuple[int, int], monkeypatch: pytest.MonkeyPatch):
    elements = ARRAYS[name]
    h = RNG.normal(size=(3, 2, len(elements))) + 1j * RNG.normal(size=(3, 2, len(elements)))
    response = array_response(elements, pixel_directions(*size), FREQUENCY_HZ).reshape(-1, len(elements))
    expected = np.abs(h @ response.conj().T)
    largest = np.abs(h).sum(axis=-1).max()
    spectrum = bartlett_spectrum(h, elements, FREQUENCY_HZ, *size)
    np.testing.assert_allclose(spectrum, expected.reshape(3, 2, *size), rtol=0, atol=ROUNDING * largest)
    monkeypatch.setattr(module, "TABLE_BYTES", 16 * 50 * len(elements))
    monkeypatch.setattr(module, "CHUNK_SIZE", 4)
    blocks = bartlett_spectrum(h, elements, FREQUENCY_HZ, *size)
    np.testing.assert_allclose(blocks, spectrum, rtol=0, atol=ROUNDING * largest)


def test_spectrum_scales_with_signals_of_any_size_and_number():
    h = RNG.normal(size=16) + 1j * RNG.normal(size=16)
    spectrum = bartlett_spectrum(h, ARRAYS["regular"], FREQUENCY_HZ, *SIZE)
    for factor in (0.0, 1e-200, 1e200):
        scaled = bartlett_spectrum(factor * h, ARRAYS["regular"], FREQUENCY_HZ, *SIZE)
        np.testing.assert_allclose(scaled, factor * spectrum, rtol=ROUNDING)
    assert bartlett_spectrum(np.zeros((0, 16)), ARRAYS["regular"], FREQUENCY_HZ, *SIZE).shape == (0, *SIZE)


def test_mirror_order_of_a_line():
    assert mirror_order([[0.0], [1.0], [2.0]]).tolist() == [2, 1, 0]
    assert mirror_order([[0.0], [1.0], [2.1]]) is None
