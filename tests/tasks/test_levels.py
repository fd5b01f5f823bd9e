"""Levels of observations in decibels and their standard deviations."""

from __future__ import annotations

import numpy as np
import pytest

from wrf_mi.core import Prediction
from wrf_mi.core.angles import pixel_directions, solid_angles
from wrf_mi.tasks import TASKS

RAYLEIGH_DB = 10 / np.log(10) * np.pi / np.sqrt(6)
"""Standard deviation of 10 log10 of an exponential variable: 5.57 dB."""
EULER_DB = 10 / np.log(10) * 0.5772156649
"""How far its mean lies below 10 log10 of the mean: 2.51 dB."""
EXACT = 1e-9
DRAWS = 200_000
SAMPLED_DB = 0.6
"""Of Rice's distribution, which Nakagami's only resembles, most at equal mean and deviation; sampling adds 0.02 dB."""


def test_levels_of_signal_strengths_are_themselves() -> None:
    given = Prediction(np.array([-70.0, np.nan]), np.array([2.0, 3.0]))
    assert TASKS["rssi"].level(given) is given


def test_level_of_rayleigh_fading_is_that_of_an_exponential_power() -> None:
    std = np.array([0.1])
    found = TASKS["csi"].level(Prediction(np.zeros((1, 1), complex), std[:, None]))
    assert found.mean[0] == pytest.approx(20 * np.log10(std[0]) - EULER_DB, abs=EXACT)
    assert found.stated_std[0] == pytest.approx(RAYLEIGH_DB, abs=EXACT)


@pytest.mark.parametrize("mean", [1.0, 3.0, 10.0])
def test_level_of_a_rician_coefficient_agrees_with_draws(mean: float) -> None:
    rng = np.random.default_rng(2)
    drawn = mean + (rng.normal(size=DRAWS) + 1j * rng.normal(size=DRAWS)) / np.sqrt(2)
    levels = 20 * np.log10(np.abs(drawn))
    found = TASKS["csi"].level(Prediction(np.full((1, 1), mean + 0j), np.ones((1, 1))))
    assert found.mean[0] == pytest.approx(levels.mean(), abs=SAMPLED_DB)
    assert found.stated_std[0] == pytest.approx(levels.std(), abs=SAMPLED_DB)


def test_channel_gain_is_the_mean_over_antennas_and_subcarriers_whatever_the_phase() -> None:
    coefficients = np.array([[[1.0, 1j], [3.0, -1.0]]], complex)
    assert TASKS["csi"].level(Prediction(coefficients)).mean[0] == pytest.approx(10 * np.log10(3), abs=EXACT)
    assert np.isnan(TASKS["csi"].level(Prediction(0 * coefficients)).mean[0])


def test_level_of_a_spectrum_is_the_mean_power_over_the_solid_angle() -> None:
    """Of a cone about the zenith it is its share of the hemisphere, 1 - cos of half its opening."""
    height, width, half_deg = 90, 360, 30.0
    inside = pixel_directions(height, width)[..., 2] > np.cos(np.radians(half_deg))
    level = TASKS["spectrum"].level(Prediction(np.stack([np.ones((height, width)), inside.astype(float)]))).mean
    assert level[0] == pytest.approx(0, abs=EXACT)
    pixel = 10 / np.log(10) * 2 / half_deg  # the rim of the cone is known to a pixel of one degree
    assert level[1] == pytest.approx(10 * np.log10(1 - np.cos(np.radians(half_deg))), abs=pixel)
    assert solid_angles(height, width).sum() == pytest.approx(2 * np.pi, rel=1e-3)
