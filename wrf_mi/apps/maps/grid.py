"""Positions of transmitters: a grid over the area of a run, candidates on it, or the centres of the faces of a mesh."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import sparse
from scipy.ndimage import binary_erosion
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from ...backend.device import to_vectors
from ...core import InputError
from ...core.angles import FloatArray, unit_vectors
from ...runs.folder import load_rows
from ...runs.run import Run
from ...scene.coordinates import require_near
from ...scene.mesh.files import mesh_parts

logger = logging.getLogger(__name__)

LARGEST = 10_000_000  # largest number of positions of a grid: 240 MB of coordinates
MARGIN_M = 0.5  # margin around transmitter positions where no scene states the area
ROUNDS = 20  # largest number of times that an edge is halved: a kilometre into millimetres
STANDING_M, DIRECTIONS = 0.5, 16  # least distance to a wall at which a person stands, and rays that look for walls
MOUNTED_M = 0.02  # distance from a surface up to which a receiver is taken to lie before it

HEADINGS = 8
"""Headings over which predictions, or likelihoods, are averaged where none is given, evenly over the circle."""

STEP_M, USUAL_POSITIONS = 0.1, 1_000_000
"""Default spacing of a map, and number of positions of the rectangle that it does not exceed."""
CANDIDATE_STEP_M = 0.25  # least distance of neighbouring candidates by default
USUAL_CANDIDATES, MOST_CANDIDATES = 4000, 10_000
"""Number of candidates of the rectangle that the default step does not exceed, and most candidates: distances between
all of them take 0.8 GB.
"""


@dataclass(frozen=True)
class Grid:
    """Positions at one height."""

    x_m: FloatArray  # coordinates along x [nx], ascending, metres
    y_m: FloatArray  # coordinates along y [ny], ascending, metres
    height_m: float  # height z of all positions, metres

    @property
    def positions_m(self) -> FloatArray:
        """Positions [ny * nx, 3], metres; x varies fastest."""
        y, x = np.meshgrid(self.y_m, self.x_m, indexing="ij")
        return np.stack([x.ravel(), y.ravel(), np.full(x.size, self.height_m)], axis=-1)


@dataclass(frozen=True)
class SurfaceMesh:
    """Triangles at or above whose centres a map is computed."""

    triangles_m: FloatArray  # corners of the triangles [m, 3, 3], metres
    height_m: float = 0.0  # above the centres

    @property
    def positions_m(self) -> FloatArray:
        """Positions [m, 3] above the centres of the triangles, metres."""
        return np.asarray(self.triangles_m.mean(axis=1) + np.array([0, 0, self.height_m]))


def grid_over(low_m: FloatArray, high_m: FloatArray, step_m: float, height_m: float) -> Grid:
    """Grid over a rectangle between two corners [2 or more], metres: square cells whose centres lie in it.

    Where an extent is no multiple of the step, it is rounded to the nearest one, half down: of a last cell that the
    upper side cuts, the centre decides. An extent of up to half a step has one position, in its middle. `InputError`: a
    step that is not positive and finite, or more than `LARGEST` positions.
    """
    _check_step(step_m)
    low = np.asarray(low_m, float)[:2]
    size = np.maximum(np.asarray(high_m, float)[:2] - low, 0.0)
    # The tolerance keeps a centre that rounding alone puts inside off the upper side, which is a wall.
    counts = np.ceil(size / step_m - 0.5 - 1e-9)
    if (positions := np.maximum(counts, 1.0).prod()) > LARGEST:
        text = f"{positions:.3g} positions over {size[0]:.1f} x {size[1]:.1f} m, the limit is {LARGEST}"
        raise InputError(f"step {step_m:g} m: {text}; give a larger step")
    x, y = (
        start + step_m * (np.arange(int(count)) + 0.5) if count >= 1 else np.array([start + extent / 2])
        for start, extent, count in zip(low, size, counts, strict=True)
    )
    return Grid(x, y, float(height_m))


def usual_step(low_m: FloatArray, high_m: FloatArray) -> float:
    """Default spacing of a map over a rectangle between two corners: `STEP_M`, more for large areas."""
    return max(STEP_M, float(np.sqrt(np.prod((high_m - low_m)[:2]) / USUAL_POSITIONS)))


def surface_of(mesh: str | Path, step_m: float | None = None, height_m: float = 0.0) -> SurfaceMesh:
    """Triangles of a mesh file in metres, halved until no edge is longer than a step; None: the faces as they are.

    ``height_m`` is that of the positions above the triangles.

    `InputError`: a file without faces, a coordinate that is not finite, or more than `LARGEST` triangles.
    """
    if not Path(mesh).is_file():
        raise InputError(f"{mesh}: no such file; give a mesh (PLY, STL, OBJ, GLB)")
    parts = [np.asarray(part.triangles, float) for part in mesh_parts(mesh)]
    if not parts:
        raise InputError(f"{mesh}: no faces; give a mesh with triangles")
    triangles = np.concatenate(parts)
    require_near(triangles.reshape(-1, 3), mesh)
    if step_m is not None:
        _check_step(step_m)
        edges = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=-1).max(axis=1)
        # Each halving makes four triangles of one.
        count = (4.0 ** np.ceil(np.log2(np.maximum(edges / step_m, 1)))).sum()
        if count > LARGEST:
            raise InputError(f"step {step_m:g} m: {count:.3g} triangles, the limit is {LARGEST}; give a larger step")
        faces = np.arange(3 * len(triangles)).reshape(-1, 3)
        vertices, faces = trimesh.remesh.subdivide_to_size(triangles.reshape(-1, 3), faces, step_m, max_iter=ROUNDS)
        triangles = vertices[faces]
    return SurfaceMesh(triangles, height_m)


def _check_step(step_m: float) -> None:
    if not (np.isfinite(step_m) and step_m > 0):
        raise InputError(f"step {step_m:g} m: give a positive number of metres")


def area_of(run: Run, tx_pos_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Corners [3], metres, of the box around a run's scene; without one around positions [n, 3] and `MARGIN_M`.

    `InputError`: no scene, and no position that is known.
    """
    if (scene := run.problem.opened_scene) is not None:
        box = scene.mi_scene.bbox()
        return np.array(box.min, float).ravel(), np.array(box.max, float).ravel()
    positions_m = tx_pos_m[np.isfinite(tx_pos_m).all(axis=1)]
    if not len(positions_m):
        raise InputError(f"{run.folder}: neither scene nor transmitter positions are known; train with --scene")
    return positions_m.min(axis=0) - MARGIN_M, positions_m.max(axis=0) + MARGIN_M


def usual_height(run: Run, tx_pos_m: FloatArray) -> float:
    """Median height of positions [n, 3], metres; that of the middle of the run's area where none is known."""
    heights = tx_pos_m[np.isfinite(tx_pos_m[:, 2]), 2]
    return float(np.median(heights) if len(heights) else np.mean([corner[2] for corner in area_of(run, tx_pos_m)]))


def outside_solids(scene: Any, positions_m: FloatArray) -> NDArray[np.bool_]:
    """Mask of positions [n, 3], metres, that are not in a solid object of a ``sionna.rt.Scene``."""
    from ...tracing.search.devices import solid_around  # the tracer is imported where there is a scene
    from ...tracing.search.surfaces import scene_surfaces

    return solid_around(scene_surfaces(scene), positions_m) < 0


def check_height(run: Run, height_m: float, tx_pos_m: FloatArray) -> None:
    """Refuse a plane that the scene's floor or ceiling hides from all receivers; warn of one outside of what is known.

    `InputError`: a height above or below a scene with a surface between it and every receiver, with the scene's.
    """
    scene, low, high = run.problem.opened_scene, *(float(corner[2]) for corner in area_of(run, tx_pos_m))
    if low <= height_m <= high:
        return
    if scene is None:
        logger.warning(
            "height %g m: the data's transmitters were at %.2f to %.2f m, so values are extrapolated",
            *(height_m, low + MARGIN_M, high - MARGIN_M),
        )
        return
    import mitsuba as mi

    text = f"height {height_m:g} m: outside of the scene, which spans z = {low:.2f} to {high:.2f} m"
    up = 1 if height_m > high else -1
    # Receivers are mounted on ceilings, or up to 1 cm behind them (`wrf_mi.tracing.search.devices.before_surfaces`).
    start = np.stack([receiver.position_m for receiver in run.receivers]) - np.array([0.0, 0.0, up * MOUNTED_M])
    ray = mi.Ray3f(to_vectors(start, mi.Point3f), mi.Vector3f(0, 0, up))
    if np.all(np.array(scene.mi_scene.ray_test(ray), bool)):
        raise InputError(f"{run.folder}: {text}; give a height in between")
    logger.warning("%s", text)  # as above the roofs of a city


def warn_of_points_outside(run: Run, positions_m: FloatArray, tx_pos_m: FloatArray) -> None:
    """Warn of positions [m, 3] outside of the box around a run's scene, or around its data, metres."""
    low, high = area_of(run, tx_pos_m)
    outside = np.count_nonzero(((positions_m < low) | (positions_m > high)).any(axis=1))
    if outside:
        what = "data, so values are extrapolated" if run.problem.opened_scene is None else "scene"
        logger.warning("%d of %d points of the surface lie outside of the %s", outside, len(positions_m), what)


@dataclass(frozen=True)
class Candidates:
    """Positions that a transmitter may have."""

    grid: Grid  # grid over the area's rectangle
    inside: NDArray[np.bool_]  # positions of the grid that are candidates [ny * nx]
    area: NDArray[np.bool_] | None = None  # positions over floors, those in solids too [ny * nx]; None: all

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

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.positions_m[:, :2])

    def nearest(self, positions_m: FloatArray) -> NDArray[np.intp]:
        """Index of the candidate that is nearest in the plan to each position [m, 2 or more]."""
        return np.asarray(self._tree.query(positions_m[:, :2])[1])

    def outside(self, positions_m: FloatArray) -> NDArray[np.bool_]:
        """Whether each position [m, 2 or more] is farther in the plan than a cell's diagonal from all candidates."""
        return np.asarray(self._tree.query(positions_m[:, :2])[0] > np.sqrt(2 * self.cell_m2))

    @cached_property
    def at_border(self) -> NDArray[np.bool_]:
        """Whether each candidate [p] is beside a position that is over no floor, or at the edge of the grid."""
        area = np.ones(len(self.inside), bool) if self.area is None else self.area
        shape = len(self.grid.y_m), len(self.grid.x_m)
        return np.asarray(~binary_erosion(area.reshape(shape), np.ones((3, 3))).ravel()[self.inside])


def candidates_of(
    run: Run,
    step_m: float | None = None,
    height_m: float | None = None,
    area_m: tuple[FloatArray, FloatArray] | None = None,
) -> Candidates:
    """Candidates of a run: over a floor of its scene and outside of solids, else in the rectangle of its training rows.

    Plans leave out floors where people were: up to `MARGIN_M` from training rows no floor is needed. ``area_m`` are
    lower and upper corners [2 or more] in place of those of the scene or the rows, metres.

    By default their step is `CANDIDATE_STEP_M`, more for large areas, and their height the training rows' median.
    `InputError`: a step that is not positive or too small, no candidate, or neither scene nor known positions.
    """
    scene, record = run.problem.opened_scene, run.problem.record
    positions_m = record.tx_pos_m[load_rows(run.folder, record).all_train]
    positions_m = positions_m[np.isfinite(positions_m).all(axis=1)]
    low, high = area_of(run, positions_m) if area_m is None else area_m
    if step_m is None:
        step_m = max(CANDIDATE_STEP_M, float(np.sqrt(np.prod(high[:2] - low[:2]) / USUAL_CANDIDATES)))
    height = usual_height(run, positions_m) if height_m is None else height_m
    check_height(run, height, positions_m)
    grid = grid_over(low, high, step_m, height)
    area = inside = np.ones(len(grid.x_m) * len(grid.y_m), bool)
    if scene is not None:
        area = over_floor(scene, grid.positions_m)
        if len(positions_m):
            area |= cKDTree(positions_m[:, :2]).query(grid.positions_m[:, :2])[0] <= MARGIN_M
        inside = area & outside_solids(scene, grid.positions_m)
    if not inside.any():
        remedy = "give another --height" if height_m is not None else "give --height"
        raise InputError(f"{run.folder}: no position {grid.height_m:g} m high is over a floor of the scene; {remedy}")
    if inside.sum() > MOST_CANDIDATES:
        text = f"{inside.sum()} candidate positions, the limit is {MOST_CANDIDATES}"
        raise InputError(f"step {step_m:g} m: {text}; give a larger step")
    return Candidates(grid, inside, area)


def over_floor(scene: Any, positions_m: FloatArray) -> NDArray[np.bool_]:
    """Mask of positions [n, 3] with a surface below them (``sionna.rt.Scene``)."""
    import mitsuba as mi

    ray = mi.Ray3f(to_vectors(positions_m, mi.Point3f), mi.Vector3f(0, 0, -1))
    return np.array(scene.mi_scene.ray_test(ray), bool)


def with_standing_room(scene: Any, positions_m: FloatArray) -> FloatArray:
    """Positions [n, 3], metres, with `STANDING_M` to all sides at their height (``sionna.rt.Scene``, None: all).

    All of them where there is none.
    """
    if scene is None:
        return positions_m
    import mitsuba as mi

    sides = unit_vectors(np.arange(DIRECTIONS) * 2 * np.pi / DIRECTIONS, 0)
    origin = to_vectors(np.repeat(positions_m, DIRECTIONS, axis=0), mi.Point3f)
    ray = mi.Ray3f(origin, to_vectors(np.tile(sides, (len(positions_m), 1)), mi.Vector3f))
    distance_m = np.array(scene.mi_scene.ray_intersect_preliminary(ray).t, float).reshape(-1, DIRECTIONS)
    free = (distance_m >= STANDING_M).all(axis=1)  # infinite where nothing is hit
    return positions_m[free] if free.any() else positions_m


def reachable(scene: Any, positions_m: FloatArray, starts_m: FloatArray) -> NDArray[np.bool_]:
    """Mask of positions [n, 3] at one height that are reached from places [k, 3] without passing a surface.

    One walks at that height over the floors of a ``sionna.rt.Scene``, in steps shorter than a door is wide.
    """
    starts = starts_m[np.isfinite(starts_m[:, :2]).all(axis=1)]
    if scene is None or not len(positions_m) or not len(starts):
        return np.ones(len(positions_m), bool)
    import mitsuba as mi

    starts = np.column_stack([starts[:, :2], np.full(len(starts), positions_m[0, 2])])
    ends = np.concatenate([positions_m, starts])
    low, high = ends.min(axis=0) - MARGIN_M, ends.max(axis=0) + MARGIN_M
    step_m = max(CANDIDATE_STEP_M, usual_step(low, high))
    ways = grid_over(low, high, step_m, ends[0, 2]).positions_m
    nodes = np.concatenate([ends, ways[over_floor(scene, ways) & outside_solids(scene, ways)]])
    # Half a step more, so that places between the nodes of the grid meet several of them.
    pairs = cKDTree(nodes).query_pairs(1.5 * step_m, output_type="ndarray")
    away = nodes[pairs[:, 1]] - nodes[pairs[:, 0]]
    length_m = np.linalg.norm(away, axis=-1)
    directions = away / np.maximum(length_m, np.finfo(float).tiny)[:, None]
    directions[length_m == 0] = (0, 0, 1)
    ray = mi.Ray3f(to_vectors(nodes[pairs[:, 0]], mi.Point3f), to_vectors(directions, mi.Vector3f))
    clear = np.array(scene.mi_scene.ray_intersect_preliminary(ray).t, float) >= length_m
    first, second = pairs[clear].T.astype(np.int32)
    graph = sparse.csr_array((np.ones(len(first), bool), (first, second)), shape=(len(nodes), len(nodes)))
    _, part = connected_components(graph, directed=False)
    return np.isin(part[: len(positions_m)], part[len(positions_m) : len(ends)])
