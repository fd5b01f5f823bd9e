"""Recorded functions and waiting sums where the number of threads changes."""

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from wrf_mi.backend import set_threads
from wrf_mi.backend.device import Recorded

TERMS, SUMS = 1 << 20, 4096
CALLS = 30
"""On four threads, most calls went wrong while sums had room for one."""


def sums(value: Any) -> Any:
    """[SUMS] sums of TERMS / SUMS equal terms."""
    found = dr.zeros(mi.Float, SUMS)
    dr.scatter_reduce(
        dr.ReduceOp.Add, found, value + dr.zeros(mi.Float, TERMS), dr.arange(mi.UInt32, TERMS) & (SUMS - 1)
    )
    return found


def always(call: Callable[[], Any]) -> None:
    """Each call gives the sums of ones."""
    for _ in range(CALLS):
        np.testing.assert_array_equal(call().numpy(), TERMS / SUMS)


def test_functions_are_recorded_again_for_more_threads():
    recorded, one = Recorded(sums), dr.opaque(mi.Float, 1)
    set_threads(1)
    always(lambda: recorded(one))
    assert recorded.frozen.n_recordings == 1
    set_threads(4)
    always(lambda: recorded(one))
    assert recorded.frozen.n_recordings == 1
    set_threads(2)
    always(lambda: recorded(one))
    assert recorded.frozen.n_recordings == 1


@pytest.mark.parametrize(("before", "after"), [(1, 4), (4, 1)])
def test_pending_sums_are_evaluated_before_threads_change(before, after):
    def waited() -> Any:
        set_threads(before)
        found = sums(mi.Float(1))
        set_threads(after)
        return found

    always(waited)
