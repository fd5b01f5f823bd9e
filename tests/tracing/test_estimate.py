"""Searches that take long are announced or refused before they begin."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest
from traced_rooms import inside, receiver, room

from wrf_mi.core import InputError
from wrf_mi.tracing import TraceOptions
from wrf_mi.tracing.paths import solve
from wrf_mi.tracing.search import chains as search

IMMEDIATE_S = 5.0
"""More than a refusal takes on a busy machine, and less than the shortest search that is refused."""


@pytest.fixture(scope="module")
def closed(tmp_path_factory: pytest.TempPathFactory) -> Any:
    return room(tmp_path_factory.mktemp("closed"))


@pytest.mark.parametrize(
    "options",
    [
        TraceOptions(depth=3, rays=64),
        TraceOptions(depth=4, reflections=2, transmission=True, rays=64),
        TraceOptions(depth=4, reflections=0, transmission=True, rays=64),
        TraceOptions(depth=2, reflection=False, rays=64),
    ],
)
def test_estimate_counts_the_hits_of_the_search(
    options: TraceOptions, closed: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    counts, shoot = [0], search._shoot

    def counted(scene: Any, surfaces: Any, directions: Any, source_m: Any, depth: int, reflecting: Any) -> Any:
        counts[0] += directions.shape[1] * depth
        return shoot(scene, surfaces, directions, source_m, depth, reflecting)

    monkeypatch.setattr(search, "_shoot", counted)
    monkeypatch.setattr(search, "_kept", type(search._kept)())
    solve.Prepared(closed).chains(inside(2), options, 64)
    assert counts[0] == 2 * search.hits(options, 64)


def test_search_of_hours_is_refused_before_it_begins(closed: Any) -> None:
    begun, options = time.perf_counter(), TraceOptions(depth=12, rays=1 << 24, transmission=True)
    with pytest.raises(InputError, match=r"12 reflections: about \d+\.\d hours; give a smaller --depth .12"):
        solve.trace_paths(closed, inside(3), receiver([4.0, 3.0, 2.0]), options)
    assert time.perf_counter() - begun < IMMEDIATE_S


def test_search_of_seconds_is_announced_once(
    closed: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    options, prepared = TraceOptions(depth=2, rays=64), solve.Prepared(closed)
    monkeypatch.setattr(search, "SECONDS_PER_HIT", 20.0 / search.hits(options, 64))
    for seed in range(2):
        solve.trace_paths(closed, inside(3, seed), receiver([4.0, 3.0, 2.0]), options, prepared=prepared)
    message = "search for paths with up to 2 reflections: about 20 s; faster with a smaller --depth"
    assert caplog.text.count(message) == 1
    caplog.clear()
    monkeypatch.setattr(search, "WARN_S", 30.0)
    solve.trace_paths(closed, np.array([[1.0, 1.0, 1.0]]), receiver([4.0, 2.0, 2.0]), options)
    assert caplog.text == ""
