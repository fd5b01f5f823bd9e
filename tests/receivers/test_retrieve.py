"""Retrieval of element signals from stored spectra, for spectra made from known signals and for measured ones."""

import numpy as np
import pytest
from changed_folders import needs

from wrf_mi.core import InputError, unit_vectors
from wrf_mi.core.arrays import planar_array
from wrf_mi.datasets import load, make_splits
from wrf_mi.receivers import Lags, array_response, bartlett_spectrum, minmax_scale
from wrf_mi.receivers.array import mirror_order
from wrf_mi.receivers.retrieve import align_signals, retrieve_signals, unscale

FREQUENCY_HZ = 920e6
ELEMENTS = planar_array(4, 4, 0.16)
HEIGHT, WIDTH = 30, 120
PHASE_DEG = np.array([0, 50, -20, 70, 0, -60, 30, 10, -80, 45, -35, 15, 0, 60, -10, -25])
AMPLITUDE = np.array([1.3, 0.7, 1.0, 0.8, 1.2, 1.1, 0.9, 1.0, 0.8, 1.2, 0.7, 1.1, 0.9, 1.0, 1.3, 0.8])

LAGS = Lags(ELEMENTS, FREQUENCY_HZ, HEIGHT, WIDTH)


def walk(rows: int = 50) -> tuple[np.ndarray, np.ndarray]:
    """Positions on a walk past an array with unequal elements, and its signals: a direct wave and two echoes."""
    rng = np.random.default_rng(8)
    t = np.linspace(0, 1, rows)
    positions = np.stack([-3 + 6 * t, 2 + np.sin(5 * t), 2.5 + 0.5 * t], axis=1)
    sight = positions / np.linalg.norm(positions, axis=1, keepdims=True)
    echoes = [unit_vectors(4 + t, 0.5 + 0.6 * t), unit_vectors(1 - 2 * t, 0.9 - 0.5 * t)]
    phase = np.exp(1j * (rng.uniform(0, 6, (2, 1)) + np.array([[40.0], [-70]]) * t))
    waves = array_response(ELEMENTS, sight, FREQUENCY_HZ)
    for turn, u in zip(phase, echoes, strict=True):
        waves = waves + 0.6 * turn[:, None] * array_response(ELEMENTS, u, FREQUENCY_HZ)
    return positions, waves * AMPLITUDE * np.exp(1j * np.radians(PHASE_DEG))


def stored(magnitude: np.ndarray) -> np.ndarray:
    """Magnitudes scaled to 0..1 and cut to 8 bits."""
    return np.floor(minmax_scale(magnitude) * 255 * (1 + 1e-15)) / 255


def largest_error(found: np.ndarray, truth: np.ndarray) -> float:
    """Largest distance of unit vectors [n, m] after the best common phase of each and one mirror image for all."""
    unit, other = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in (truth, found))
    mirrored = other[:, mirror_order(ELEMENTS)].conj()
    overlap = [np.abs((unit.conj() * x).sum(axis=1)) for x in (other, mirrored)]
    return float(np.sqrt(2 - 2 * np.minimum(max(overlap, key=lambda o: o.min()), 1)).max())


def test_lowest_magnitude_is_found_to_a_fifth_of_a_grey_level():
    magnitude = bartlett_spectrum(walk()[1], ELEMENTS, FREQUENCY_HZ, HEIGHT, WIDTH)
    low, high = magnitude.min(axis=(1, 2)), magnitude.max(axis=(1, 2))
    images = unscale(stored(magnitude), LAGS)
    np.testing.assert_allclose(images.lowest, low / (high - low), atol=0.2 / 255)
    assert low.max() > 0.02 * (high - low).max()
    np.testing.assert_allclose(images.residual, images.rounding, rtol=0.1)


def test_signals_are_retrieved_from_grey_images():
    """Relative error of the grey levels' size, 1/255 over a thousand pixels for 16 signals, and a few times that."""
    positions, signals = walk()
    magnitude = bartlett_spectrum(signals, ELEMENTS, FREQUENCY_HZ, HEIGHT, WIDTH)
    retrieved = retrieve_signals(unscale(stored(magnitude[:20]), LAGS), LAGS)
    assert retrieved.explained.all()
    aligned = align_signals(retrieved.signals, positions[:20], ELEMENTS)
    assert largest_error(aligned, signals[:20]) < 0.01
    # Two incoherent snapshots have no spectrum of a single snapshot.
    mixed = stored(np.sqrt(magnitude[:3] ** 2 + magnitude[20:23] ** 2))
    assert not retrieve_signals(unscale(mixed, LAGS), LAGS, starts=5).explained.any()
    line = Lags(planar_array(1, 6, 0.16), FREQUENCY_HZ, HEIGHT, WIDTH)
    with pytest.raises(InputError, match="two dimensions"):
        retrieve_signals(unscale(stored(magnitude[:1]), line), line)


@needs("rfid-lab")
def test_measured_spectra_are_cut_magnitudes_of_single_snapshots():
    """16 rows: the residual outside the lags is that of 8 bits, and 16 complex numbers explain each spectrum."""
    record = load("rfid-lab")
    rows = make_splits(record, "official")[0].all_train[::10]
    lags = Lags(record.receivers[0].array_m, float(record.frequencies_hz[0]), 90, 360)
    unscaled = unscale(record.observation[0, rows], lags)
    assert np.sqrt(np.mean(unscaled.residual**2)) == pytest.approx(np.sqrt(np.mean(unscaled.rounding**2)), rel=0.02)
    assert retrieve_signals(unscaled, lags).explained.all()
