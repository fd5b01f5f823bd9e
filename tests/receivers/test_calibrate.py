"""Calibration from stored spectra: what was put into made spectra is found again, and what real ones tell."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from wrf_mi.core import InputError, Receiver, Record, unit_vectors
from wrf_mi.core.arrays import planar_array
from wrf_mi.datasets import load, make_splits
from wrf_mi.receivers import Array, Lags, instrument_report
from wrf_mi.receivers.beams import mirror_order
from wrf_mi.receivers.calibrate import _grid, fit_array, phase_gradient
from wrf_mi.receivers.gains import self_calibrate
from wrf_mi.receivers.retrieve import align_signals, retrieve_signals, unscale

FREQUENCY_HZ = 920e6
ELEMENTS = planar_array(4, 4, 0.16)
HEIGHT, WIDTH = 30, 120
PHASE_DEG = np.array([0, 50, -20, 70, 0, -60, 30, 10, -80, 45, -35, 15, 0, 60, -10, -25])
AMPLITUDE = np.array([1.3, 0.7, 1.0, 0.8, 1.2, 1.1, 0.9, 1.0, 0.8, 1.2, 0.7, 1.1, 0.9, 1.0, 1.3, 0.8])

DATA = os.environ.get("WRF_MI_DATA")
needs_data = pytest.mark.skipif(
    not DATA or not Path(DATA, "rfid-lab").is_dir(), reason="WRF_MI_DATA names no folder with rfid-lab/"
)


def spectra(gain: np.ndarray, rows: int = 50) -> tuple[Record, np.ndarray]:
    """A walk past an array in a room: a direct wave and two echoes whose directions change on the way; and signals."""
    rng = np.random.default_rng(8)
    t = np.linspace(0, 1, rows)
    positions = np.stack([-3 + 6 * t, 2 + np.sin(5 * t), 2.5 + 0.5 * t], axis=1)
    sight = positions / np.linalg.norm(positions, axis=1, keepdims=True)
    echoes = [unit_vectors(4 + t, 0.5 + 0.6 * t), unit_vectors(1 - 2 * t, 0.9 - 0.5 * t)]
    phase = np.exp(1j * (rng.uniform(0, 6, (2, 1)) + np.array([[40.0], [-70]]) * t))
    array = Array(ELEMENTS, FREQUENCY_HZ, gain)
    waves = [array.response(sight)] + [0.6 * p[:, None] * array.response(u) for p, u in zip(phase, echoes, strict=True)]
    signals = sum(waves[1:], waves[0])
    grey = instrument_report(array.image(signals, HEIGHT, WIDTH)).astype(np.float32)
    receiver = Receiver("array", np.zeros(3), np.array([0.0, 0, 0, 1]))
    record = Record(
        "made",
        "spectrum",
        positions,
        (receiver,),
        grey[None],
        frequencies_hz=np.array([FREQUENCY_HZ]),
    ).with_array(ELEMENTS)
    return record, signals


def same_up_to_mirror(found: np.ndarray, truth: np.ndarray) -> float:
    """Largest distance of unit vectors [n, m] after the best common phase of each and one mirror for all."""
    own, other = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in (truth, found))
    mirrored = other[:, mirror_order(ELEMENTS)].conj()
    overlap = [np.abs((own.conj() * x).sum(axis=1)) for x in (other, mirrored)]
    return float(np.sqrt(2 - 2 * np.minimum(max(overlap, key=lambda o: o.min()), 1)).max())


@pytest.fixture(scope="module")
def faulty() -> tuple[Record, np.ndarray]:
    return spectra(AMPLITUDE * np.exp(1j * np.radians(PHASE_DEG)))


def test_scaling_is_undone(faulty):
    """The lowest magnitude to a fifth of a grey level, where it is not nought; what is left are the grey levels."""
    record, signals = faulty
    lags = Lags(ELEMENTS, FREQUENCY_HZ, HEIGHT, WIDTH)
    magnitude = Array(ELEMENTS, FREQUENCY_HZ).image(signals, HEIGHT, WIDTH)
    low = magnitude.min(axis=(1, 2))
    span = magnitude.max(axis=(1, 2)) - low
    found = unscale(record.observation[0], lags)
    np.testing.assert_allclose(found.lowest, low / span, atol=0.2 / 255)
    assert low.max() > 0.02 * span.max()
    np.testing.assert_allclose(found.residual, found.rounding, rtol=0.1)
    scaled = instrument_report(magnitude, bits=None)
    rounded = unscale(np.rint(scaled * 255) / 255, lags, cut=False)
    np.testing.assert_allclose(rounded.lowest, low / span, atol=0.2 / 255)
    # Taken for cut off, half a level is put where none is missing.
    wrong = unscale(np.rint(scaled * 255) / 255, lags)
    assert (rounded.lowest - wrong.lowest).mean() > 0.25 / 255


def test_signals_are_retrieved_from_grey_images(faulty):
    """Relative error of the grey levels' size, 1/255 over a thousand pixels for 16 signals, and a few times that."""
    record, signals = faulty
    lags = Lags(ELEMENTS, FREQUENCY_HZ, HEIGHT, WIDTH)
    found = retrieve_signals(unscale(record.observation[0, :20], lags), lags)
    assert found.found.all()
    aligned = align_signals(found.signals, record.tx_pos_m[:20], ELEMENTS)
    assert same_up_to_mirror(aligned, signals[:20]) < 0.01
    # Two snapshots that are not coherent are no one snapshot's spectrum.
    mixed = Array(ELEMENTS, FREQUENCY_HZ).image(signals, HEIGHT, WIDTH)
    mixed = instrument_report(np.sqrt(mixed[:3] ** 2 + mixed[20:23] ** 2))
    assert not retrieve_signals(unscale(mixed, lags), lags, starts=5).found.any()
    line = Lags(planar_array(1, 6, 0.16), FREQUENCY_HZ, HEIGHT, WIDTH)
    with pytest.raises(InputError, match="two dimensions"):
        retrieve_signals(unscale(record.observation[0], line), line)


def test_gains_and_grid_are_found(faulty):
    """The array truly has 1.002 of the stated spacing. Gains to 0.15 rad: directions lie between points of a grid."""
    record, _ = faulty
    fit = fit_array(record.with_array(ELEMENTS / 1.002), np.arange(50))
    assert fit.spacing.value == pytest.approx(1.002, abs=2e-4)
    assert fit.spacing.half < 5e-4
    np.testing.assert_allclose(fit.elements_m, ELEMENTS, atol=1e-4)
    assert abs(fit.row_offset.value) < 0.01
    assert abs(fit.column_offset.value) < 0.02
    assert fit.cut
    assert fit.calibration is not None
    assert fit.calibration.told
    assert fit.retrieved.found.all()
    true = AMPLITUDE * np.exp(1j * np.radians(PHASE_DEG))
    truths = [true, true[mirror_order(ELEMENTS)].conj()]
    error = [fit.calibration.gain / t for t in truths]
    error = [e * np.exp(-1j * np.angle(e.sum())) / np.sqrt(np.mean(np.abs(e) ** 2)) for e in error]
    assert min(np.abs(e - 1).max() for e in error) < 0.15
    assert fit.array(record).gain is not None
    plain = fit.plain()
    assert plain["gains"]["unexplained"] < 0.3 * plain["gains"]["unexplained_ideal"]
    assert plain["retrieved"] == 1


def test_an_ideal_array_is_not_given_gains():
    record, _ = spectra(np.ones(16))
    fit = fit_array(record, np.arange(0, 50, 2))
    assert fit.calibration is not None
    gain = fit.calibration.gain
    assert np.abs(gain - 1).max() < 0.15
    assert np.abs(phase_gradient(gain, ELEMENTS, FREQUENCY_HZ)).max() < 0.03


def test_gains_are_not_told_from_noise():
    """Signals without any waves: gains explain the rows that they were fitted to, and no others."""
    rng = np.random.default_rng(3)
    h = rng.normal(size=(40, 16)) + 1j * rng.normal(size=(40, 16))
    sight = unit_vectors(rng.uniform(0, 6, 40), rng.uniform(0.2, 1, 40))
    found = self_calibrate(h, ELEMENTS, FREQUENCY_HZ, sight, np.arange(40) // 10)
    assert not found.told
    assert found.unexplained.mean() > 0.97 * found.unexplained_ideal.mean()
    with pytest.raises(InputError, match="one group"):
        self_calibrate(h, ELEMENTS, FREQUENCY_HZ, sight, np.zeros(40))
    with pytest.raises(InputError, match="choose 1 to 5"):
        self_calibrate(h, ELEMENTS, FREQUENCY_HZ, sight, np.arange(40), waves=6)


def test_offsets_of_the_grid():
    """Rows from half a row up and columns from 2.5 columns on: they are found with their signs."""
    _, signals = spectra(np.ones(16), 16)
    azimuth = (np.arange(WIDTH) + 2.5) * 2 * np.pi / WIDTH
    elevation = (np.arange(HEIGHT) + 0.5) * np.pi / 2 / HEIGHT
    steering = Array(ELEMENTS, FREQUENCY_HZ).response(unit_vectors(azimuth[None, :], elevation[:, None]))
    image = instrument_report(np.abs(np.einsum("hwm,nm->nhw", steering.conj(), signals)))
    spacing, row, column = _grid(image, ELEMENTS, FREQUENCY_HZ, 0)
    assert (row.value, column.value) == pytest.approx((0.5, 2.5), abs=0.02)
    assert spacing.value == pytest.approx(1, abs=5e-4)


def test_the_mean_phase_slope_of_gains_is_a_shift():
    wavenumber = 2 * np.pi * FREQUENCY_HZ / 299792458
    gain = np.exp(1j * wavenumber * (ELEMENTS @ [0.1, -0.2, 0]))
    np.testing.assert_allclose(phase_gradient(gain, ELEMENTS, FREQUENCY_HZ), [0.1, -0.2], atol=0.01)


def test_records_that_tell_nothing_are_refused(faulty):
    record, _ = faulty
    with pytest.raises(InputError, match="with their array and carrier"):
        fit_array(record.with_array(None), np.arange(50))
    with pytest.raises(InputError, match="4 rows to calibrate by"):
        fit_array(record, np.arange(4))
    with pytest.raises(InputError, match=f"no receiver 'sensor10'; give one of {record.receivers[0].name}, or its"):
        fit_array(record, np.arange(50), "sensor10")


@needs_data
def test_real_spectra_are_cut_magnitudes_of_single_snapshots():
    """16 rows: what is left outside the lags is what 8 bits explain, and 16 complex numbers make each spectrum."""
    record = load("rfid-lab")
    rows = make_splits(record, "official")[0].all_train[::10]
    lags = Lags(record.receivers[0].array_m, float(record.frequencies_hz[0]), 90, 360)
    found = unscale(record.observation[0, rows], lags)
    assert np.sqrt(np.mean(found.residual**2)) == pytest.approx(np.sqrt(np.mean(found.rounding**2)), rel=0.02)
    assert retrieve_signals(found, lags).found.all()
