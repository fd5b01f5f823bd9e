"""Wall segments of a plan: runs of every direction the plan shows, corners joined, clutter left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import shapely
from scipy.sparse.csgraph import connected_components

from ..core import InputError
from ..core.angles import FloatArray
from .plan_lines import CLEARED_M, dominant_direction, find_runs, rotation_2d, turned, without_specks
from .plan_sources import PlanGrid
from .plan_tidy import tidy

REACH_M = 0.35
"""Ends are moved by no more to meet another wall: the blur of a map cuts corners, a door (0.6 m) stays open."""
SHORTEST_LOOSE_M = 0.8
"""A shorter piece has to meet other walls at both ends: legs of tables and chairs do not."""
SHORTEST_GROUP_M = 2.0
"""Walls that touch one another and together are shorter than this, apart from all others, are things in the room."""
MOST_DIRECTIONS = 4
SHORTEST_OBLIQUE_M = 1.0
"""Walls in other than the plan's main directions are looked for in what those leave; smears leave short pieces."""
TOUCHING_M = 0.05
LEAST_ANGLE_RAD = np.radians(20)
"""Walls at a smaller angle are no corner."""


def find_walls(grid: PlanGrid, name: str = "plan") -> FloatArray:
    """Straight walls of a plan.

    The main direction comes from the data, and walls along and across it are taken first. What they leave may show
    further directions; a plan without right angles is made of those.

    Args:
        grid: where things stand, and where free space was seen if that is known.
        name: of the source, for errors.

    Returns:
        End points [n, 2, 2] in metres, the longest wall first.

    Raises:
        InputError: no wall was found.
    """
    grid = without_specks(grid)
    left, found = grid, []
    for pass_ in range(MOST_DIRECTIONS):
        if not left.occupied.any():
            break
        angle = dominant_direction(left.occupied)
        view = turned(left, angle)
        runs = find_runs(view) if pass_ == 0 else find_runs(view, SHORTEST_OBLIQUE_M)
        if not runs:
            break
        # What hides a wall may already have been explained by another direction.
        walls = [run.ends_m @ rotation_2d(angle).T for run in tidy(runs, turned(grid, angle))]
        pieces = [run.ends_m @ rotation_2d(angle).T for run in runs]
        found += walls
        left = _unexplained(left, np.array(pieces + walls))
    if not found:
        raise InputError(f"{name}: no straight wall was found; is the resolution right, and is it a plan of walls?")
    walls_m = _without_clutter(joined(np.array(found)))
    return walls_m[np.argsort(-np.linalg.norm(walls_m[:, 1] - walls_m[:, 0], axis=-1), kind="stable")]


def _unexplained(grid: PlanGrid, walls_m: FloatArray) -> PlanGrid:
    """The grid without the occupied cells that lie at walls."""
    row, column = np.nonzero(grid.occupied)
    lines = shapely.STRtree(shapely.linestrings(walls_m))
    near = lines.query(shapely.points(grid.centres_m(grid.occupied)), predicate="dwithin", distance=CLEARED_M)[0]
    occupied = grid.occupied.copy()
    occupied[row[near], column[near]] = False
    return without_specks(replace(grid, occupied=occupied))


def joined(walls_m: FloatArray, reach_m: float = REACH_M) -> FloatArray:
    """Walls whose ends are moved, along the wall, to where it meets another one nearby.

    Args:
        walls_m: end points [n, 2, 2].
        reach_m: the longest way an end is moved, and the farthest the other wall may be from there.
    """
    result = walls_m.copy()
    along = walls_m[:, 1] - walls_m[:, 0]
    length = np.linalg.norm(along, axis=-1)
    unit = along / length[:, None]
    for i in range(len(walls_m)):
        sine = _cross(unit[i], unit)
        corner = np.abs(sine) > np.sin(LEAST_ANGLE_RAD)
        safe = np.where(corner, sine, 1.0)
        # Where line i meets line j: distance from the start of i along i, and from the start of j along j.
        between = walls_m[:, 0] - walls_m[i, 0]
        own = _cross(between, unit) / safe
        other = _cross(between, unit[i]) / safe
        beyond = np.maximum(np.maximum(-other, other - length), 0)
        for end, here in enumerate((0.0, length[i])):
            way = np.where(corner & (beyond <= reach_m), np.abs(own - here), np.inf)
            nearest = int(np.argmin(way))
            if way[nearest] <= reach_m:
                result[i, end] = walls_m[i, 0] + own[nearest] * unit[i]
    return result[np.linalg.norm(result[:, 1] - result[:, 0], axis=-1) > TOUCHING_M]


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def _without_clutter(walls_m: FloatArray) -> FloatArray:
    """Without short loose pieces and small groups; the largest group stays whatever its size."""
    while True:
        lines = shapely.linestrings(walls_m)
        length = shapely.length(lines)
        ends = shapely.points(walls_m)
        touching = shapely.distance(ends[:, :, None], lines[None, None, :]) <= TOUCHING_M
        touching[np.arange(len(lines)), :, np.arange(len(lines))] = False
        loose = ~touching.any(axis=2).all(axis=1) & (length < SHORTEST_LOOSE_M)
        if not loose.any() or loose.all():
            break
        walls_m = walls_m[~loose]
    _, group = connected_components(touching.any(axis=1), directed=False)
    total = np.bincount(group, length)
    return np.asarray(walls_m[total[group] >= min(SHORTEST_GROUP_M, total.max())])
