"""Delay spread, angular spread and K-factor of paths in closed form."""

from dataclasses import astuple

import numpy as np
import pytest
from scipy.constants import speed_of_light

from wrf_mi.receivers.spreads import PathStatistics, joined

ROUNDING = 1e-6  # of float64 sums; angles near zero lose half the digits


def statistics(power: list[float], length_m: list[float], azimuth_deg: list[float], elevation_deg: float = 0.0):
    az, el = np.radians(azimuth_deg), np.radians(elevation_deg)
    arrival = np.stack([np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), np.full(len(az), np.sin(el))], axis=-1)
    rows = np.zeros(len(power), np.int64)
    return PathStatistics.of_paths(rows, 1, np.array(power), np.array(length_m), arrival)


def test_spreads_and_k_factor_of_one_to_three_paths() -> None:
    spreads = statistics([0.5e-8, 0.5e-8], [10.0, 13.0], [0.0, 90.0])
    assert spreads.path_gain_db[0] == pytest.approx(-80, abs=ROUNDING)
    assert spreads.delay_spread_s[0] == pytest.approx(1.5 / speed_of_light, rel=ROUNDING)
    assert spreads.k_factor_db[0] == pytest.approx(0, abs=ROUNDING)
    # The mean of two unit vectors at a right angle has length 1 / sqrt(2): sqrt(-2 ln) of it is sqrt(ln 2).
    assert spreads.azimuth_spread_deg[0] == pytest.approx(np.degrees(np.sqrt(np.log(2))), rel=ROUNDING)
    three = statistics([8e-9, 1e-9, 1e-9], [5.0, 6.0, 7.0], [0.0, 1.0, 2.0])
    assert three.k_factor_db[0] == pytest.approx(10 * np.log10(4), abs=ROUNDING)
    alone = statistics([1e-9], [7.0], [33.0])
    assert (alone.delay_spread_s[0], alone.azimuth_spread_deg[0], alone.k_factor_db[0]) == (0, 0, np.inf)


def test_azimuth_spread_ignores_turns_elevation_and_vertical_paths() -> None:
    plain = statistics([3e-9, 1e-9, 1e-9], [5.0, 6.0, 7.0], [350.0, 10.0, 60.0])
    turned = statistics([3e-9, 1e-9, 1e-9], [5.0, 6.0, 7.0], [90.0, 110.0, 160.0], elevation_deg=50.0)
    assert turned.azimuth_spread_deg[0] == pytest.approx(plain.azimuth_spread_deg[0], rel=ROUNDING)
    arrival = np.array([[1.0, 0, 0], [0, 0, 1.0]])
    vertical = PathStatistics.of_paths(np.zeros(2, np.int64), 1, np.ones(2), np.array([4.0, 5.0]), arrival)
    assert vertical.azimuth_spread_deg[0] == 0


def test_transmitters_without_paths_are_not_a_number_and_rows_are_placed() -> None:
    rows = np.array([2, 2], np.int64)
    spreads = PathStatistics.of_paths(rows, 4, np.array([1e-9, 0.0]), np.array([4.0, 1.0]), np.eye(3)[:2])
    for values in astuple(spreads):
        np.testing.assert_array_equal(np.isnan(values), [True, True, False, True])
    placed = spreads.rows(np.array([2, 0])).placed(np.array([3, 1]), 5)
    np.testing.assert_array_equal(np.isnan(placed.path_gain_db), [True, True, True, False, True])
    assert joined([spreads, placed]).delay_spread_s.shape == (9,)
