"""Plane waves that leave transmitters in a cone around the line of sight, and what an array observes of them."""

from typing import Any

import numpy as np
from scipy.constants import speed_of_light

from wrf_mi.core import Receiver, Record
from wrf_mi.core.angles import fibonacci_sphere
from wrf_mi.core.arrays import planar_array
from wrf_mi.receivers.array import array_response, bartlett_spectrum
from wrf_mi.receivers.scaling import minmax_scale

FREQUENCY_HZ = 920e6
WAVELENGTH_M = speed_of_light / FREQUENCY_HZ
WAVENUMBER = 2 * np.pi / WAVELENGTH_M
ELEMENTS_M = planar_array(3, 3, 0.45 * WAVELENGTH_M)
SIZE = (16, 32)
CONE_DEG = 70.0
UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])
RECEIVERS = (Receiver("one", np.array([3.0, 1.0, -0.5]), UPRIGHT), Receiver("two", np.array([-1.0, 4.0, 1.0]), UPRIGHT))
"""Some 3 m from the transmitters."""


def positions(count: int, seed: int = 0) -> np.ndarray:
    """Transmitters [count, 3] within 1.2 wavelengths on a side, a third of that in height."""
    return np.random.default_rng([seed, 1]).uniform(-0.2, 0.2, (count, 3)) * [1, 1, 0.35]


def signals(tx_pos_m, towards, elements_m=ELEMENTS_M, seed=0, count=40):
    """Element signals [n, m] of waves of random directions and complex amplitudes, without the line of sight's phase.
    They leave at most `CONE_DEG` from ``towards``, the direction of the receiver.
    """
    rng = np.random.default_rng([seed, 2])
    leaving = fibonacci_sphere(4000)
    leaving = rng.permutation(leaving[leaving @ towards > np.cos(np.radians(CONE_DEG))])[:count]
    arriving = rng.normal(size=(count, 3)) * [1, 1, 0.5]
    arriving[:, 2] = np.abs(arriving[:, 2])
    arriving /= np.linalg.norm(arriving, axis=1, keepdims=True)
    amplitude = rng.normal(size=count) + 1j * rng.normal(size=count)
    waves = np.exp(1j * WAVENUMBER * tx_pos_m @ (leaving - towards).T)
    return (waves * amplitude) @ array_response(elements_m, arriving, FREQUENCY_HZ)


def towards(receiver: Receiver, tx_pos_m: np.ndarray) -> np.ndarray:
    """Unit vector from the middle of the transmitters."""
    way = receiver.position_m - tx_pos_m.mean(axis=0)
    return way / np.linalg.norm(way)


def wave_record(rows: int = 40, held_out: int = 12, receivers: int = 2, seed: int = 0) -> Record:
    """Spectra [receivers, rows, *SIZE] of such signals in 8 bits; the last ``held_out`` rows are the official test."""
    tx_pos = positions(rows, seed)
    spectra = []
    for number, receiver in enumerate(RECEIVERS[:receivers]):
        h = signals(tx_pos, towards(receiver, tx_pos), seed=seed + 10 * number)
        spectra.append(minmax_scale(bartlett_spectrum(h, ELEMENTS_M, FREQUENCY_HZ, *SIZE)))
    every = np.arange(rows)
    observation = (np.floor(255 * np.stack(spectra)) / 255).astype(np.float32)
    rows_of: dict[str, Any] = {"official": (every[:-held_out], every[-held_out:]), "folds": every % 2}
    hz = np.array([FREQUENCY_HZ])
    record = Record("made-waves", "spectrum", tx_pos, RECEIVERS[:receivers], observation, frequencies_hz=hz, **rows_of)
    return record.with_array(ELEMENTS_M)


def without_array(record: Record) -> Record:
    """The same, of an instrument that is not known."""
    return record.with_array(None)
