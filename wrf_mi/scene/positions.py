"""Measured positions against the walls of a scene, which shows whether a plan is mirrored.

The shortest lines that join the measured positions (their minimum spanning tree, which needs no order) stay within
rooms and pass through open doors, so few of them cross a wall. In the reflection of the building many do, or
positions lie outside the floor.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import shapely
import trimesh
from scipy import sparse
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.spatial import cKDTree

from ..core import InputError
from ..core.angles import FloatArray
from ..core.files import listed
from ..datasets import load
from ..datasets.folder_files import read_csv
from .mesh.surfaces import Surface, box_of, cut_lines, level_area, moved
from .plan.grid import PlanGrid
from .plan.storey import LARGEST_GAP_M
from .plan.walked import with_walked_floor
from .register import best_motion, wall_points

logger = logging.getLogger(__name__)

CELL_M = 0.1  # side of the squares of which a single position is used: a robot that stands still adds nothing
REACH_M = 1.0  # longest line between two positions
NEIGHBOURS = 8  # number of nearest positions that lines may lead to
OUTSIDE_M = 0.2  # least distance beyond the floor's edge of a position outside: the blur of a robot's map
WALKING_HEIGHT_M = 1.0
"""Height above the lowest floor at which walls are cut if the positions have no height; doors are open there."""
EDGE_SHARE = 0.1  # share of the walls' height, from below and above, within which they are not cut
TOLERATED, TOLERATED_SHARE = 1, 0.005
"""Tolerated conflicts, and share of positions in conflict: a cupboard taken for a wall, a wrong position. Walls found
from the robot's map of `flat-ble` have 0.4 % on its path, and 10 to 28 % mirrored."""
SHIFT_M, SHIFT_STEP_M = 1.5, 0.25
"""Largest shift of the positions along an axis that is tried where some conflict, and its steps: a picture's margin."""
LARGEST_SHARE = 0.1  # largest share of positions in conflict where no reflection fits better


def read_positions(path: str | Path) -> FloatArray:
    """Measured positions [n, 3], metres, from a data folder or the columns x, y and perhaps z (else NaN) of a CSV file.

    `InputError`: missing, no such column, or a field that is not a finite number.
    """
    path = Path(path)
    if path.is_dir():
        return load(path).tx_pos_m
    if not path.is_file():
        raise InputError(f"{path}: no such file; give measured positions with the header x,y or x,y,z in metres")
    table = read_csv(path, skip_blank=True)
    table = replace(table, header=[name.lower() for name in table.header])
    if not {"x", "y"} <= set(table.header):
        text = f"no columns x and y in metres: {listed(table.header)}; import the file, pixels with --units px, by"
        raise InputError(f"{path}: {text} wrf-mi data import {path} --out DATA, and give --positions DATA")
    z = table.numbers("z") if "z" in table.header else np.full(len(table.rows), np.nan)
    return np.stack([table.numbers("x"), table.numbers("y"), z], axis=-1)


def conflicts(positions_m: FloatArray, surfaces: Sequence[Surface]) -> tuple[int, int]:
    """Number of lines between neighbouring positions that cross a wall, and of positions outside all floors.

    Of positions [n, 3], z NaN where it is not known, and the surfaces of a scene, which must have a wall
    (`InputError`).
    """
    walls = [surface for surface in surfaces if surface.kind == "wall"]
    if not walls:
        raise InputError("the scene has no wall that positions could cross; leave out --positions")
    places = distinct(positions_m)
    lines = shapely.linestrings(_tree(places))
    (low_m, high_m), z_m = box_of(walls)[:, 2], positions_m[:, 2]
    cut_m = box_of(surfaces)[0, 2] + WALKING_HEIGHT_M
    if np.isfinite(z_m).all():
        cut_m = np.median(z_m)
    # Not at the walls' edges, where rounding decides whether they are cut.
    margin = EDGE_SHARE * (high_m - low_m)
    level_m = float(np.clip(cut_m, low_m + margin, high_m - margin))
    cut = shapely.STRtree(shapely.linestrings(np.concatenate([cut_lines(wall, level_m) for wall in walls])))
    crossings = len(np.unique(cut.query(lines, predicate="intersects")[0]))
    level = [surface for surface in surfaces if surface.kind in ("floor", "ceiling")]
    if not level:
        return crossings, 0
    area = shapely.buffer(level_area(level), OUTSIDE_M)
    return crossings, int(np.count_nonzero(~shapely.contains_xy(area, places)))


def check_positions(
    positions_m: FloatArray, surfaces: Sequence[Surface], mirrored: Sequence[tuple[str, Sequence[Surface]]], name: str
) -> None:
    """Refuse a scene that measured positions [n, 3] do not fit, above all a mirrored scene.

    `InputError`: a reflection (`reflections`) fits the positions clearly better, or the positions fit neither.
    """
    count = len(distinct(positions_m))
    crossings, outside = conflicts(positions_m, surfaces)
    others = [(remedy, conflicts(positions_m, reflection)) for remedy, reflection in mirrored]
    remedy, best = min(others, key=lambda pair: sum(pair[1]))
    text = f"{name}: {crossings} lines between neighbouring positions cross walls and {outside} of {count} positions"
    text += f" have no floor below; mirrored it is {best[0]} and {best[1]}"
    tolerated = TOLERATED + TOLERATED_SHARE * count
    if crossings + outside > 2 * sum(best) + tolerated:
        raise InputError(f"{text}: {remedy}")
    if crossings + outside > tolerated + LARGEST_SHARE * count:
        if tolerated < outside == best[1] < count:
            # Not the frame of the positions: a part of the building that is its own mirror image is open.
            rooms = f"rooms that are open to the outside by more than {LARGEST_GAP_M:g} m get no floor"
            raise InputError(f"{text}: {rooms}; close their outer walls in the plan")
        raise InputError(f"{text}: check the registration and the frame of the positions")
    if crossings + outside > tolerated and (moved_by := _better_shift(positions_m, surfaces, tolerated)) is not None:
        shift = "{:g} m in x and {:g} m in y".format(*moved_by)
        logger.warning("%s; positions moved by %s fit: check the origin of the source (--origin)", text, shift)
    elif sum(best) <= crossings + outside:
        # No position lies where the building and its reflection differ.
        logger.warning("%s: positions do not tell the plan from its mirror image; see that it is right", text)
    else:
        logger.info("%s", text)


def _better_shift(positions_m: FloatArray, surfaces: Sequence[Surface], tolerated: float) -> FloatArray | None:
    """The smallest of the shifts [2] in metres by which positions [n, 3] fit a scene best; None if they do not."""
    steps = np.arange(-SHIFT_M, SHIFT_M + SHIFT_STEP_M / 2, SHIFT_STEP_M)
    shifts = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    # The smallest first: of shifts with equal counts `argmin` takes the first one.
    shifts = shifts[np.argsort(np.hypot(*shifts.T), kind="stable")]
    counts = [sum(conflicts(positions_m + np.append(shift, 0.0), surfaces)) for shift in shifts]
    return None if min(counts) > tolerated else np.asarray(shifts[np.argmin(counts)])


def placed(
    surfaces: Sequence[Surface], motion: FloatArray, grid: PlanGrid | None, positions_m: FloatArray | None
) -> list[Surface]:
    """Surfaces moved by a matrix [4, 4], with floor where a grid is free about positions [n, 3] in the new frame."""
    if grid is not None and positions_m is not None:
        surfaces = with_walked_floor(surfaces, grid, in_plan(positions_m, motion))
    return moved(surfaces, motion)


def in_plan(positions_m: FloatArray, motion: FloatArray) -> FloatArray:
    """Places [n, 2] in the frame of a plan that a matrix [4, 4] moves to that of positions [n, 3]."""
    heights = np.nan_to_num(positions_m) * [1, 1, 0]
    return np.asarray(trimesh.transform_points(heights, np.linalg.inv(motion))[:, :2])


def reflections(
    surfaces: Sequence[Surface],
    file: Path,
    grid: PlanGrid | None,
    motion: FloatArray,
    known_walls_m: FloatArray | None,
    positions_m: FloatArray | None = None,
) -> list[tuple[str, list[Surface]]]:
    """Remedies and surfaces of the scenes of a source with its y or its x reversed.

    ``grid`` are the cells of an occupancy grid, ``motion`` moves the source to the scene's frame [4, 4], each
    reflection is registered anew to ``known_walls_m`` [m, 2, 2], if any, and `placed` with positions [n, 3].
    """
    if grid is not None:
        # Rows or columns in the other order keep the middle of the grid, which need not be that of its walls.
        totals = 2 * grid.origin_m + grid.resolution_m * np.array(grid.occupied.shape[::-1])
        remedies = ("reverse its columns", "give the other row_0, in the file or by --row-0")
        if file.suffix.lower() != ".npz":
            remedies = ("flip the picture left to right", "flip the picture upside down")
        flips = [(axis, float(totals[axis]), remedies[axis]) for axis in (1, 0)]
    else:
        totals = box_of(surfaces).sum(axis=0)
        axes = ((1, "y"), (0, "x"))
        flips = [(axis, 0.0, f"change the sign of its {letter}") for axis, letter in axes]
        flips += [
            (axis, totals[axis], f"replace its {letter} by {totals[axis]:.6g} - {letter}") for axis, letter in axes
        ]
    if known_walls_m is not None:
        del flips[1:]  # all reflections are the same once they are registered
    scenes = []
    for axis, total, remedy in flips:
        flip = np.eye(4)
        flip[axis, axis], flip[axis, 3] = -1, total
        mirrored = moved(surfaces, flip)
        placing = motion if known_walls_m is None else best_motion(wall_points(mirrored), known_walls_m)
        scenes.append((remedy, placed(surfaces, placing @ flip, grid, positions_m)))
    return scenes


def distinct(positions_m: FloatArray) -> FloatArray:
    """Positions [k, 2] seen from above, the first of each cell."""
    xy = positions_m[:, :2]
    _, first = np.unique(np.floor(xy / CELL_M).astype(np.int64), axis=0, return_index=True)
    return np.asarray(xy[np.sort(first)])


def _tree(places_m: FloatArray) -> FloatArray:
    """End points [m, 2, 2] of the shortest lines that join neighbouring places [n, 2]."""
    n = len(places_m)
    if n < 2:
        return np.empty((0, 2, 2))
    length, other = cKDTree(places_m).query(places_m, k=min(NEIGHBOURS + 1, n), distance_upper_bound=REACH_M)
    near = np.isfinite(length) & (length > 0)
    row = np.broadcast_to(np.arange(n)[:, None], other.shape)
    # The search refuses 64-bit indices with SciPy 1.15.0 to 1.17.0 and NumPy 2.0.0.
    ends = (row[near].astype(np.int32), other[near].astype(np.int32))
    tree = minimum_spanning_tree(sparse.csr_array((length[near], ends), shape=(n, n))).tocoo()
    return np.stack([places_m[tree.row], places_m[tree.col]], axis=1)
