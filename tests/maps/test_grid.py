"""Grids of positions."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wrf_mi.core import InputError
from wrf_mi.maps.grid import grid_over

ROUNDING_M = 1e-6
"""Rounding of coordinates of at most a hundred metres in float64, with room to spare."""


@given(st.floats(-50, 50), st.floats(0.05, 20), st.floats(0.1, 3))
def test_centres_lie_in_the_rectangle_and_leave_at_most_half_a_cell(low: float, size: float, step: float) -> None:
    grid = grid_over(np.array([low, -low]), np.array([low + size, -low + 2 * size]), step, 1.3)
    for axis, first, last in ((grid.x_m, low, low + size), (grid.y_m, -low, -low + 2 * size)):
        assert first < axis[0]
        assert axis[-1] < last
        if len(axis) > 1 or last - first > step / 2 + ROUNDING_M:
            assert abs(axis[0] - step / 2 - first) < ROUNDING_M
            assert axis[-1] + step / 2 > last - step / 2 - ROUNDING_M
        else:
            assert abs(axis[0] - (first + last) / 2) < ROUNDING_M
    assert grid.positions_m.shape == (len(grid.x_m) * len(grid.y_m), 3)
    np.testing.assert_array_equal(grid.positions_m[: len(grid.x_m), 0], grid.x_m)


@pytest.mark.parametrize(
    ("size", "step", "count"), [(6.0, 0.1, 60), (2.71, 0.1, 27), (2.76, 0.1, 28), (0.35, 0.1, 3), (0.3, 1.0, 1)]
)
def test_extents_are_rounded_to_the_step_half_down(size: float, step: float, count: int) -> None:
    """0.35 m is 3.5 steps: the centre of a fourth cell would lie on the wall."""
    for start in (0.0, -13.7):
        grid = grid_over(np.array([start, start]), np.array([start + size, start + size]), step, 0.0)
        assert (len(grid.x_m), len(grid.y_m)) == (count, count)


@pytest.mark.parametrize("step", [0.0, -1.0, float("nan"), float("inf")])
def test_step_that_is_not_positive_is_refused(step: float) -> None:
    with pytest.raises(InputError, match="positive"):
        grid_over(np.zeros(2), np.ones(2), step, 0.0)


def test_grid_of_too_many_positions_is_refused() -> None:
    with pytest.raises(InputError, match="larger step"):
        grid_over(np.zeros(2), np.full(2, 1e4), 1e-3, 0.0)
