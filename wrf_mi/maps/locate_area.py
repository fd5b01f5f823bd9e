"""Candidate positions of a transmitter: a grid inside a run's scene, or around its training rows."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from ..backend.device import to_vectors
from ..core import InputError
from ..core.angles import FloatArray
from ..runs.folder import load_rows
from ..runs.run import Run
from .grid import Grid, area_of, check_height, grid_over, outside_solids, usual_height

STEP_M = 0.25
"""Least distance of neighbouring candidates by default."""
USUAL, MOST = 4000, 10_000
"""Number of candidates of the rectangle that the default step does not exceed, and most candidates: distances between
all of them take 0.8 GB.
"""


@dataclass(frozen=True)
class Candidates:
    """Positions that a transmitter may have.

    Attributes:
        grid: grid over the area's rectangle.
        inside: positions of the grid that are candidates [ny * nx].
    """

    grid: Grid
    inside: NDArray[np.bool_]

    @cached_property
    def positions_m(self) -> FloatArray:
        """Positions of the candidates [p, 3], metres."""
        return self.grid.positions_m[self.inside]

    @cached_property
    def distance_m(self) -> FloatArray:
        """Distances between all candidates [p, p], metres."""
        return np.asarray(cdist(self.positions_m, self.positions_m))

    @property
    def cell_m2(self) -> float:
        """Area of a candidate's cell, square metres."""
        steps = [axis[1] - axis[0] for axis in (self.grid.x_m, self.grid.y_m) if len(axis) > 1]
        return float(steps[0] ** 2) if steps else 0.0

    def nearest(self, positions_m: FloatArray) -> NDArray[np.intp]:
        """Index of the candidate that is nearest in the plan to each position [m, 2 or more]."""
        return np.argmin(cdist(positions_m[:, :2], self.positions_m[:, :2]), axis=1)


def candidates_of(run: Run, step_m: float | None = None, height_m: float | None = None) -> Candidates:
    """Candidates of a run: over a floor of its scene and outside of solids, else in the rectangle of its training rows.

    Args:
        run: a finished run.
        step_m: distance between neighbours; None: `STEP_M`, more for large areas.
        height_m: their height; None: the median of the training rows.

    Raises:
        InputError: a step that is not positive or too small, no candidate, or neither scene nor known positions.
    """
    scene, record = run.problem.opened_scene, run.problem.record
    known = record.tx_pos_m[load_rows(run.folder, record).all_train]
    low, high = area_of(run, known)
    if step_m is None:
        step_m = max(STEP_M, float(np.sqrt(np.prod(high[:2] - low[:2]) / USUAL)))
    height = usual_height(run, known) if height_m is None else height_m
    check_height(run, height, known)
    grid = grid_over(low, high, step_m, height)
    inside = np.ones(len(grid.x_m) * len(grid.y_m), bool) if scene is None else inside_scene(scene, grid.positions_m)
    if not inside.any():
        remedy = "give another --height" if height_m is not None else "give --height"
        raise InputError(f"{run.folder}: no position {grid.height_m:g} m high is over a floor of the scene; {remedy}")
    if inside.sum() > MOST:
        text = f"{inside.sum()} candidate positions, the limit is {MOST}"
        raise InputError(f"step {step_m:g} m: {text}; give a larger step")
    return Candidates(grid, inside)


def inside_scene(scene: Any, positions_m: FloatArray) -> NDArray[np.bool_]:
    """Mask of positions [n, 3] with a surface below them, and not in a solid (``sionna.rt.Scene``)."""
    import mitsuba as mi

    origin = to_vectors(positions_m, mi.Point3f)
    below = np.array(scene.mi_scene.ray_test(mi.Ray3f(origin, mi.Vector3f(0, 0, -1))), bool)
    return below & outside_solids(scene, positions_m)
