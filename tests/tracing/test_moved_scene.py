"""Paths in a scene whose planes have moved."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from correction_rooms import CARRIER_HZ, HEIGHT, LENGTH, WIDTH, true_scene

from wrf_mi.core import Receiver
from wrf_mi.tracing import TraceOptions, TraceResult, open_scene, trace_paths
from wrf_mi.tracing.paths.corrected_scene import moved_search
from wrf_mi.tracing.paths.scene_parameters import SHIFT, TILT, slabs_of_faces
from wrf_mi.tracing.paths.solve import Prepared

RECEIVER = Receiver("anchor", np.array([1.0, 1.1, 2.2]), np.array([0, 0, 0, 1.0]))
OPTIONS = TraceOptions(transmission=True, depth=3, rays=1 << 15)
POSITIONS = np.random.default_rng(0).uniform([0.4, 0.4, 0.4], [LENGTH - 0.4, WIDTH - 0.4, HEIGHT - 0.4], (40, 3))
AT_EDGES = 0.005
"""Share of paths that meet a surface within the rounding of its single-precision corners from an edge."""
ROUNDED_M = 1e-4
"""Lengths of paths through a scene that was written and read, and through one that was moved in memory."""


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, Any, Any, dict[str, Any]]:
    """The room as stated, twice, as it is, and the parameters of its planes."""
    folder = tmp_path_factory.mktemp("moved")
    true, shift, tilt = true_scene(folder)
    stated, copy, moved = (open_scene(place, CARRIER_HZ) for place in (folder / "base", folder / "base", true))
    return stated, copy, moved, {SHIFT: shift.astype(np.float32), TILT: tilt.astype(np.float32)}


def traced(prepared: Prepared) -> TraceResult:
    return trace_paths(prepared.scene, POSITIONS, RECEIVER, OPTIONS, prepared=prepared)


def shared(one: TraceResult, other: TraceResult) -> float:
    """Share of the paths of the longer of two lists that both have: kinds and objects met, and equal lengths."""

    def names(trace: TraceResult) -> list[tuple[Any, ...]]:
        met = np.stack([trace.paths.interactions.astype(int), trace.paths.objects], axis=-1)
        rows = np.concatenate([trace.paths.tx[:, None], met.reshape(len(met), -1)], axis=1)
        return [tuple(row) for row in rows]

    lengths = dict(zip(names(other), other.paths.length_m, strict=True))
    both = [
        abs(lengths.get(name, np.inf) - length) < ROUNDED_M
        for name, length in zip(names(one), one.paths.length_m, strict=True)
    ]
    return float(np.sum(both) / max(len(one.paths), len(other.paths)))


def test_paths_are_those_of_the_scene_with_its_planes_moved(scenes: Any) -> None:
    stated, copy, moved, planes = scenes
    before = Prepared(stated)
    found = traced(moved_search(copy, before.surfaces, planes).prepared)
    assert shared(traced(Prepared(moved)), found) > 1 - AT_EDGES
    assert shared(traced(before), found) < 0.5


def test_a_surface_that_is_absent_is_not_met(scenes: Any) -> None:
    stated, copy, _, planes = scenes
    surfaces = Prepared(stated).surfaces
    board = surfaces.names.index("board")
    slab = slabs_of_faces(stated, surfaces, "surface")[1][surfaces.first_face[board]]
    with_board, without = (traced(moved_search(copy, surfaces, planes, absent).prepared) for absent in ((), (slab,)))
    assert (with_board.paths.objects == board).any()
    assert not (without.paths.objects == board).any()


def test_a_scene_is_moved_from_where_it_was_stated_and_back(scenes: Any) -> None:
    stated, copy, _, planes = scenes
    before = Prepared(stated)
    moved_search(copy, before.surfaces, planes, (0,))
    assert shared(traced(before), traced(moved_search(copy, before.surfaces, {}).prepared)) == 1
