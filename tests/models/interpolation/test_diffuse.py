"""Kriging of channels: line of sight and diffuse field, or generic."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.constants import speed_of_light

from wrf_mi.core import Receiver, Record, Split
from wrf_mi.estimators.interpolation.by_receiver import ByReceiver
from wrf_mi.estimators.interpolation.diffuse import LEAST_ROWS, KrigedChannels, direct_wave, fit_diffuse
from wrf_mi.estimators.interpolation.kriging import Kriged, KrigingSettings, UncertainKriged
from wrf_mi.estimators.model import Inputs, Session
from wrf_mi.models import MODELS, Problem
from wrf_mi.tasks.scores import cea_db, inside_interval

FREQUENCY_HZ = 2.4e9
K = 2 * np.pi * FREQUENCY_HZ / speed_of_light
ACCESS_POINT = Receiver("access point", np.array([0.6, 1.1, 2.1]), np.array([0.0, 0.0, 0.0, 1.0]))
KRIGING = MODELS["kriging"].serving("csi", False)
GENERIC = KrigingSettings(generic=True)
DEFAULTS = KrigingSettings()
GAIN = 3 * np.exp(2j)


def record(positions: np.ndarray, channel: np.ndarray) -> Record:
    """Channels [n_rx, n, subcarriers] of receivers at one place."""
    receivers = tuple(replace(ACCESS_POINT, name=f"r{number}") for number in range(len(channel)))
    frequencies_hz = FREQUENCY_HZ + 1e6 * np.arange(float(channel.shape[2]))
    return Record("made", "csi", positions, receivers, channel.astype(np.complex64), frequencies_hz=frequencies_hz)


def fit(data: Record, rows: np.ndarray, settings: KrigingSettings = DEFAULTS) -> ByReceiver:
    session = Session(None, None)
    fitted: Any = KRIGING.fit(Problem(data, settings), Split("rows", 0, rows, rows[:0], rows), session)
    return fitted


@pytest.fixture(scope="module")
def dense() -> Record:
    """Line of sight and 60 plane waves, at a mean distance of a tenth of a wavelength; the second receiver: noise."""
    rng = np.random.default_rng(2)
    positions = np.array([2.0, 3.0, 1.0]) + rng.uniform(-0.06, 0.06, (300, 3))
    direction = rng.normal(size=(60, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    direct = GAIN * direct_wave(positions, ACCESS_POINT.position_m, np.array([K]))
    waves = (rng.normal(size=(60, 2)) @ [1, 1j]) * np.abs(direct).mean() / 12
    noise = rng.normal(size=(300, 2)) @ np.array([[1], [1j]]) * np.abs(direct).mean()
    return record(positions, np.stack([direct + (np.exp(1j * K * positions @ direction.T) @ waves)[:, None], noise]))


@pytest.fixture(scope="module")
def fitted(dense: Record) -> ByReceiver:
    return fit(dense, np.arange(240))


def test_line_of_sight_and_diffuse_field_are_kriged_near_measurements(dense: Record, fitted: ByReceiver) -> None:
    test = np.arange(240, 300)
    channels: Any = fitted.models[0]
    estimate, truth = fitted.predict(Inputs(dense.tx_pos_m[test]), 0), dense.observation[0, test]
    direct = channels.gain * direct_wave(dense.tx_pos_m[test], ACCESS_POINT.position_m, channels.k)
    generic = fit(dense, np.arange(240), GENERIC).predict_mean(Inputs(dense.tx_pos_m[test]), 0)
    accuracy = np.median(cea_db(estimate.mean, truth))
    assert accuracy > np.median(cea_db(direct, truth)) + 15
    assert accuracy > np.median(cea_db(generic, truth)) + 5
    assert estimate.mean.dtype == np.complex64
    # 60 rows.
    assert inside_interval(estimate.mean, estimate.std, truth) > 0.8


def test_the_line_of_sight_reaches_beyond_a_wavelength() -> None:
    """Free space with a gain: interpolation of its phase fails where rows are wavelengths apart."""
    positions, wavenumbers = np.random.default_rng(0).uniform([1, 2, 0], [4, 5, 2], (60, 3)), K + np.array([0.0, 0.1])
    direct = GAIN * direct_wave(positions, ACCESS_POINT.position_m, wavenumbers)
    free = replace(record(positions, direct[None]), frequencies_hz=wavenumbers * speed_of_light / 2 / np.pi)
    model = fit(free, np.arange(40))
    assert isinstance(model.models[0], KrigedChannels)
    assert model.models[0].gain == pytest.approx(GAIN, rel=1e-5)


def test_receivers_without_a_clear_gain_are_kriged_generically_and_noise_is_not_kriged(dense, fitted, tmp_path):
    assert isinstance(fitted.models[1], UncertainKriged)
    assert all(isinstance(model, UncertainKriged) for model in fit(dense, np.arange(LEAST_ROWS - 1)).models)
    again = KRIGING.load(fitted.arrays(), Problem(dense, DEFAULTS), tmp_path)
    for receiver in (0, 1):
        before, after = (model.predict(Inputs(dense.tx_pos_m[240:250]), receiver) for model in (fitted, again))
        np.testing.assert_array_equal(after.mean, before.mean)
        np.testing.assert_array_equal(after.std, before.std)
    assert again.facts() == fitted.facts()
    rng = np.random.default_rng(0)
    values = rng.normal(size=(200, 2)) @ np.array([[1], [1j]])
    assert fit_diffuse(rng.uniform(0, 0.3, (200, 3)), values, K).share == 0


@pytest.mark.parametrize("unknown", ["frequencies", "antennas", "covariance"])
def test_unknown_frequencies_and_several_antennas_are_kriged_generically(unknown: str, dense: Record) -> None:
    data = {
        "frequencies": replace(dense, frequencies_hz=None),
        "antennas": replace(dense, observation=np.repeat(dense.observation[:, :, None], 2, axis=2)),
        "covariance": dense,
    }[unknown]
    model = fit(data, np.arange(40), KrigingSettings(length_m=0.1 if unknown == "covariance" else None))
    assert all(type(kriged) is Kriged for kriged in model.models)
    assert model.predict(Inputs(dense.tx_pos_m[:3]), 1).std is None
