"""Positions to measure next: each is as far as possible from all positions that are measured or planned before it.

With k positions this farthest-first traversal covers the candidates within at most twice the smallest radius that any k
positions reach (Gonzalez, "Clustering to minimize the maximum intercluster distance" (1985), Theoretical Computer
Science 38). It uses no prediction and no model, so that it is the same for every run with these training rows. Choices
that lower the variance of a model's Gaussian process over the map were tried in the eight places of ``wrf-mi bench
plan``: clearly better in two, clearly worse in two.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from ...core import InputError
from ...core.angles import FloatArray
from ...core.files import write_csv
from ...core.types import IntArray
from ...runs.folder import load_rows
from ...runs.run import Run, open_run
from .grid import MARGIN_M, area_of, candidates_of, reachable, with_standing_room

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Plan:
    """Planned measurements in their order.

    Attributes:
        tx_pos_m: positions [k, 3], metres.
        distance_m: distance of the farthest candidate from the nearest measured or planned position, before any and
            after each measurement [k + 1]; the first k are the distances of the planned positions themselves.
        candidates_m: positions among which the planned ones were chosen [m, 3], metres.
        measured_m: positions of the training rows [n, 3], metres.
    """

    tx_pos_m: FloatArray
    distance_m: FloatArray
    candidates_m: FloatArray
    measured_m: FloatArray

    def write(self, file: str | Path) -> Path:
        """Write positions to centimetres with their order and their distance from all measured before them, as CSV."""
        columns = np.arange(1, len(self.tx_pos_m) + 1), *self.tx_pos_m.round(2).T, self.distance_m[:-1].round(2)
        return write_csv(Path(file), ("order", "x", "y", "z", "distance_m"), zip(*columns, strict=True))


def plan(
    run: Run | str | Path,
    count: int = 10,
    *,
    candidates_m: FloatArray | None = None,
    area_m: tuple[FloatArray, FloatArray] | None = None,
    step_m: float | None = None,
    height_m: float | None = None,
) -> Plan:
    """Choose positions to measure next.

    Args:
        run: run of any model, or its folder.
        count: number of positions.
        candidates_m: positions that can be measured [n, 3], metres; None: those of the run's map, half a metre from
            walls, that are reached from training rows without passing a wall.
        area_m: lower and upper corner [2] of the map, metres; None: the scene, or the box of all rows of the data.
        step_m: spacing of the map; None: 0.25 m, more for large areas.
        height_m: height of the map; None: the median of the training rows.

    Raises:
        InputError: positions, or a number of them, that the run cannot be planned with.
    """
    opened = run if isinstance(run, Run) else open_run(run)
    record = opened.problem.record
    measured_m = record.tx_pos_m[load_rows(opened.folder, record).all_train]
    measured_m = measured_m[np.isfinite(measured_m).all(axis=1)]
    if candidates_m is None:
        choices_m = _walkable(opened, measured_m, area_m, step_m, height_m)
    else:
        if any(option is not None for option in (area_m, step_m, height_m)):
            raise InputError("candidates: area, step and height are those of the map; leave them out")
        choices_m = _stated(candidates_m)
    if not 0 < count <= len(choices_m):
        raise InputError(f"count {count}: give a number from 1 to {len(choices_m)}, that of the candidates")
    chosen, distance_m = farthest_points(choices_m, count, measured_m)
    return Plan(choices_m[chosen], distance_m, choices_m, measured_m)


def farthest_points(positions_m: FloatArray, count: int, measured_m: FloatArray) -> tuple[IntArray, FloatArray]:
    """Indices of positions, each the farthest from the measured ones and from those chosen before it.

    Args:
        positions_m: positions [n, 3], metres.
        count: number of choices, at most n.
        measured_m: measured positions [k, 3], metres.

    Returns:
        Indices [count], and the distance of the farthest position from the nearest measured or chosen one before any
        and after each choice [count + 1], metres.

    >>> positions_m = np.arange(9.0)[:, None] * [1, 0, 0]
    >>> chosen, distance_m = farthest_points(positions_m, 3, positions_m[:1])
    >>> chosen.tolist(), distance_m.tolist()
    ([8, 4, 2], [8.0, 4.0, 2.0, 2.0])
    """
    nearest_m, free, chosen = KDTree(measured_m).query(positions_m)[0], np.ones(len(positions_m), bool), list[int]()
    distance_m = [nearest_m.max()]
    for _ in range(count):
        # Positions at the same place as a measured one have distance 0, as have the chosen, which are not repeated.
        best = int(np.where(free, nearest_m, -1.0).argmax())
        chosen.append(best)
        free[best] = False
        nearest_m = np.minimum(nearest_m, np.linalg.norm(positions_m - positions_m[best], axis=1))
        distance_m.append(nearest_m.max())
    return np.asarray(chosen, np.int64), np.asarray(distance_m)


def _walkable(
    run: Run,
    measured_m: FloatArray,
    area_m: tuple[FloatArray, FloatArray] | None,
    step_m: float | None,
    height_m: float | None,
) -> FloatArray:
    """Positions of the map with room to stand, reached from the training rows; how many are not is logged."""
    record, scene = run.problem.record, run.problem.opened_scene
    low, high = area_of(run, record.tx_pos_m) if area_m is None else (np.asarray(corner, float) for corner in area_m)
    if not (low < high).all():
        raise InputError(f"area {low.tolist()} to {high.tolist()}: give lower and then upper x, y in metres")
    room_m = with_standing_room(scene, candidates_of(run, step_m, height_m, (low, high)).positions_m)
    if scene is None and area_m is None:
        # Where no floor is known, the farthest positions would be in the margin around the data, behind its walls.
        inside = ((room_m >= low + MARGIN_M) & (room_m <= high - MARGIN_M))[:, :2].all(axis=1)
        room_m = room_m[inside] if inside.any() else room_m
    reached = reachable(scene, room_m, measured_m)
    if not reached.any():
        remedy = "check the frame of the scene, or give candidates"
        raise InputError(f"{run.folder}: walls are between all training rows and every position of the map; {remedy}")
    if unreached := np.count_nonzero(~reached):
        text = "%d of %d positions are behind walls as seen from all training rows, and are not proposed; "
        logger.warning(text + "give candidates if one can walk there", unreached, len(room_m))
    return room_m[reached]


def _stated(candidates_m: FloatArray) -> FloatArray:
    positions_m = np.atleast_2d(np.asarray(candidates_m, float))
    if positions_m.shape[1] != 3 or not np.isfinite(positions_m).all():
        raise InputError("candidates: give finite x, y, z in metres for each")
    return np.unique(positions_m, axis=0)
