"""Coherent and incoherent sums over paths against plain loops."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from random_paths import paths_of
from scipy.constants import speed_of_light

from wrf_mi.core import Paths, Receiver
from wrf_mi.core.arrays import planar_array
from wrf_mi.receivers import antenna_csi, channel, csi, received_power, rssi_dbm

EXACT = 1e-12


def random_paths(count: int = 40, n_tx: int = 4, n_rx: int = 3, seed: int = 0) -> Paths:
    """Paths with random values; the last transmitter has none."""
    rng = np.random.default_rng(seed)
    tx, rx = rng.integers(0, n_tx - 1, count), rng.integers(0, n_rx, count)
    length = rng.uniform(2, 900, count)
    order = np.lexsort((length, tx, rx))
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    gain = rng.normal(size=count) + 1j * rng.normal(size=count)
    return paths_of(tx[order], rx[order], gain, length[order], direction, n_tx, n_rx)


def receivers(count: int = 3) -> list[Receiver]:
    rng = np.random.default_rng(5)
    return [Receiver(f"rx{k}", rng.normal(size=3), rng.normal(size=4)) for k in range(count)]


def test_csi_is_the_coherent_sum_per_subcarrier():
    paths, frequencies = random_paths(), np.array([28.0e9, 28.1e9])
    result = csi(paths, frequencies)
    assert result.shape == (3, 4, 2)
    expected = np.zeros_like(result)
    for p in range(len(paths)):
        for k, f in enumerate(frequencies):
            wave = paths.gain[p] * np.exp(-2j * np.pi * f * paths.length_m[p] / speed_of_light)
            expected[paths.rx[p], paths.tx[p], k] += wave
    # 5e5 rad in float64 leave 1e-10: the phase is not taken in single precision.
    np.testing.assert_allclose(result, expected, atol=1e-9)
    assert (result[:, 3] == 0).all()


@pytest.mark.parametrize("size", [1, 1 << 20])
def test_antenna_csi_of_subcarriers_is_that_of_each(size: int, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(channel, "WAVES_PER_CHUNK", size)
    paths, arrays, array_m = random_paths(), receivers(), planar_array(2, 3, 0.06)
    frequencies = 2.4e9 + 1e6 * np.array([0.0, 1.0, 3.0, 4.0, 2.0])  # gaps of several widths
    result = antenna_csi(paths, arrays, array_m, frequencies)
    expected = np.stack([antenna_csi(paths, arrays, array_m, f)[..., 0] for f in frequencies], axis=-1)
    assert result.shape == (3, 4, 6, 5)
    # 5e4 rad in float64 leave 1e-11, gone through once for each subcarrier.
    np.testing.assert_allclose(result, expected, atol=1e-9)
    assert (result[:, 3] == 0).all()


def test_signal_strength_and_power_over_a_wide_band_are_sums_of_powers():
    paths = random_paths()
    power = np.zeros((3, 4))
    for p in range(len(paths)):
        power[paths.rx[p], paths.tx[p]] += abs(paths.gain[p]) ** 2
    np.testing.assert_allclose(received_power(paths), power, rtol=EXACT)
    strength = rssi_dbm(paths)
    np.testing.assert_allclose(strength[:, :3], 10 * np.log10(power[:, :3]), rtol=EXACT)
    assert np.isnan(strength[:, 3]).all()
    # Two equal waves in opposite phase cancel at one frequency; over a wide band they are independent.
    wavelength = 0.5
    frequency = speed_of_light / wavelength
    lengths: dict[str, Any] = {"gain": np.ones(2, complex), "length_m": np.array([10.0, 10.0 + wavelength / 2])}
    paths = replace(random_paths(2, n_tx=2, n_rx=1), tx=np.zeros(2, int), **lengths)
    assert received_power(paths)[0, 0] == pytest.approx(2)
    assert np.abs(csi(paths, frequency)[0, 0, 0]) ** 2 == pytest.approx(0, abs=EXACT)
    band = np.linspace(frequency, 41 * frequency, 4000, endpoint=False)
    assert (np.abs(csi(paths, band)[0, 0]) ** 2).mean() == pytest.approx(2, rel=1e-3)


def test_several_arrays_and_chunks_give_the_same_signals(monkeypatch: pytest.MonkeyPatch):
    paths, arrays = random_paths(), receivers()
    array_m = planar_array(2, 3, 0.1)
    signals = antenna_csi(paths, arrays, array_m, 1e9)[..., 0]
    assert signals.shape == (3, 4, 6)
    for k, receiver in enumerate(arrays):
        of_receiver = paths.select(paths.rx == k)
        alone = replace(of_receiver, rx=np.zeros_like(of_receiver.rx), n_rx=1)
        np.testing.assert_allclose(antenna_csi(alone, receiver, array_m, 1e9)[0, ..., 0], signals[k], rtol=EXACT)
    # The signal of an element at the origin is the channel.
    centre = antenna_csi(paths, arrays, [[0.0, 0, 0]], 1e9)[..., 0, 0]
    np.testing.assert_allclose(centre, csi(paths, 1e9)[..., 0], atol=1e-10)
    coefficients = csi(paths, [1e9, 2e9])
    monkeypatch.setattr(channel, "WAVES_PER_CHUNK", 20)
    np.testing.assert_allclose(antenna_csi(paths, arrays, array_m, 1e9)[..., 0], signals, rtol=EXACT)
    np.testing.assert_allclose(csi(paths, [1e9, 2e9]), coefficients, rtol=EXACT)
