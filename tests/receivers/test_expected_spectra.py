"""Spectra of paths with uncertain phases: against plain Monte Carlo, in its limits, and row by row."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from random_paths import paths_of

from wrf_mi.core import Paths, Receiver
from wrf_mi.core.arrays import planar_array
from wrf_mi.core.paths import ARRAYS
from wrf_mi.receivers.instruments import Instrument

CARRIER_HZ, SIZE = 2.4e9, (12, 36)
RX = Receiver("rx", np.zeros(3), np.array([0.0, 0, 0, 1]), array_m=planar_array(4, 4, 0.06))
EXPECTATION = 0.03  # mean difference of 16 draws from 1,024; greys of 0..1


def instrument(phase_error: float) -> Instrument:
    return Instrument("array", (RX,), np.array([CARRIER_HZ]), size=SIZE, phase_error=phase_error)


def made_paths(seed: int, n_tx: int = 5, each: int = 6) -> Paths:
    """The direct path and some with up to three interactions for each transmitter but the last, which has none."""
    rng = np.random.default_rng(seed)
    count = each * (n_tx - 1)
    up = rng.normal(size=(count, 3))
    up[:, 2] = np.abs(up[:, 2])
    direction = up / np.linalg.norm(up, axis=1, keepdims=True)
    kinds = rng.choice([0, 1, 1, 4], size=(count, 3))
    kinds[::each] = 0
    tx, rx = np.repeat(np.arange(n_tx - 1), each), np.zeros(count, np.int64)
    gain = rng.normal(size=count) + 1j * rng.normal(size=count)
    length_m = np.sort(rng.uniform(2, 9, (n_tx - 1, each)), axis=1).ravel()
    return paths_of(tx, rx, gain, length_m, direction, n_tx, 1, np.sort(kinds, axis=1)[:, ::-1])


@pytest.mark.parametrize("phase_error", [0.3, 1.0, 2.5])
def test_spectra_are_the_mean_over_random_phases(phase_error: float) -> None:
    """Phases are independent and normal, of variance phase_error^2 for each reflection; transmissions add none."""
    paths, copies, rounds = made_paths(seed=1), 512, 2
    repeated: dict[str, Any] = {name: np.concatenate([getattr(paths, name)] * copies) for name in ARRAYS}
    many = replace(paths, **repeated)
    first_tx = np.repeat(paths.n_tx * np.arange(copies), len(paths))
    many = replace(many, tx=many.tx + first_tx, n_tx=copies * paths.n_tx)
    deviation = phase_error * np.sqrt((many.interactions == 1).sum(axis=1))
    rng, plain, mean = np.random.default_rng(3), instrument(0.0), 0
    for _ in range(rounds):
        drawn = plain.observe(replace(many, gain=many.gain * np.exp(1j * deviation * rng.normal(size=len(many)))))
        mean += drawn.reshape(1, copies, paths.n_tx, *SIZE).mean(axis=1) / rounds
    spectra = instrument(phase_error).observe(paths)
    assert np.abs(spectra - mean).mean() < EXPECTATION
    assert np.abs(plain.observe(paths) - mean).mean() > 2 * np.abs(spectra - mean).mean()


def test_certain_phases_change_nothing() -> None:
    paths = made_paths(seed=2)
    direct = replace(paths, interactions=np.where(paths.interactions == 1, 4, paths.interactions).astype(np.uint8))
    # 16 float32 means of the same spectrum.
    np.testing.assert_allclose(instrument(1.0).observe(direct), instrument(0.0).observe(direct), atol=1e-6)
    np.testing.assert_array_equal(instrument(1e-12).observe(paths)[0, -1], 0)  # reached by no path


def test_a_spectrum_does_not_depend_on_the_other_transmitters() -> None:
    paths = made_paths(seed=4)
    every = instrument(1.0).observe(paths)
    for row in range(paths.n_tx):
        alone = replace(paths.select(paths.tx == row), n_tx=1)
        alone = replace(alone, tx=np.zeros_like(alone.tx))
        np.testing.assert_allclose(instrument(1.0).observe(alone)[:, 0], every[:, row], atol=1e-6)
