"""Omissions that the benchmark `skips` times change no result."""

from contextlib import nullcontext
from functools import partial

import numpy as np
import pytest
from wrf_mi_bench import skips
from wrf_mi_bench.scaling import opened_room
from wrf_mi_bench.workloads import field, splatting

from wrf_mi.gaussians import tiles
from wrf_mi.tracing.search import images, surfaces


@pytest.mark.parametrize("other", [(images, "possible", skips.every_pair), (surfaces, "FEW_PLANES", 1 << 60)])
def test_paths_are_the_same_without_an_omission(other):
    room = opened_room(1000)
    with skips.replaced(other):
        every = skips.room_powers(room)
    assert every.any()
    np.testing.assert_array_equal(skips.room_powers(room), every)


def test_gaussians_that_reach_no_tile_add_nothing():
    gaussians, receiver = field(100)
    splat = splatting(gaussians, receiver, 30, 120)
    short = np.asarray(splat()[0].numpy())
    with skips.replaced((tiles, "_boxes", skips.whole_plane)):
        np.testing.assert_array_equal(np.asarray(splat()[0].numpy()), short)


def test_row_states_ratio_change_and_counts(monkeypatch):
    monkeypatch.setattr(skips, "REPEATS", 1)
    room = partial(skips.room_powers, opened_room(200))
    row = skips.compared("half", room, nullcontext, lambda: room() / 2)
    assert row["what"] == "half"
    assert "largest change 1;" in row["value"]
    assert "candidates of paths" in row["value"]
