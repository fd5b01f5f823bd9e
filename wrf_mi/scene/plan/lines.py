"""Straight runs of occupied cells, the pieces of a plan's walls.

The plan is turned so that the direction of most walls is axis-parallel, and runs are taken greedily, the best supported
first, along rows and columns. A run is as wide as the blur of the map, so that a thick smear gives a single wall.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from skimage.transform import hough_line

from ...core.angles import FloatArray
from ..mesh.outline import large_parts
from .faces import THICKEST_WALL_M
from .grid import Mask, PlanGrid

HALF_WIDTH_M = 0.1  # largest distance of cells that support a line: half the width of a blurred wall
CLEARED_M = 0.2
"""Largest distance of cells that are explained by a run; they support no other run along the same stretch."""
LARGEST_HOLE_M = 0.25  # largest hole in a run, narrower than any door
SHORTEST_RUN_M = 0.4  # least length of a run; shorter pieces may be clutter
SOLID = 0.9  # least share of occupied cells in each row of a wall that is drawn thicker than the blur of a map
FILLED = 0.6  # least share of a run's length that holds occupied cells
LARGEST_RISE_M = 0.2  # cells that rise by more across a run climb through its window: a wall of another direction
SMALLEST_BLOB_CELLS = 4  # least number of connected occupied cells; fewer are stray returns
SMALLEST_ROOM_M2 = 1.0  # least area of a room; smaller free areas are gaps that beams went through
PEAK = 0.1  # share of the range of the sharpness, from the top, that counts as its peak
DIRECTION_STEP_RAD = np.radians(0.25)
ALONG_ROWS = np.array([[0, 0, 0], [1, 1, 1], [0, 0, 0]])


@dataclass(frozen=True)
class WallRun:
    """An axis-parallel piece of wall in a turned plan, along x (axis 0, its offset is a y) or along y (axis 1).

    Cells within `CLEARED_M` and ``thick_m``, which is above zero for walls thicker than a map's blur, belong to it.
    """

    axis: int
    offset: float
    start: float
    end: float
    thick_m: float = 0.0

    @property
    def length(self) -> float:
        """Length, metres."""
        return self.end - self.start

    @property
    def ends_m(self) -> FloatArray:
        """Both ends (x, y), shape [2, 2], in the turned plan."""
        along, across = np.array([self.start, self.end]), np.full(2, self.offset)
        return np.stack([along, across] if self.axis == 0 else [across, along], axis=-1)


def without_specks(grid: PlanGrid) -> PlanGrid:
    """The grid without stray returns, and free only in rooms, not where beams pass a gap or a window."""
    occupied = large_parts(grid.occupied, SMALLEST_BLOB_CELLS, np.ones((3, 3)))
    free = ndimage.binary_opening(grid.free, np.ones((2, 2)))
    return replace(grid, occupied=occupied, free=large_parts(free, SMALLEST_ROOM_M2 / grid.resolution_m**2))


def dominant_direction(occupied: Mask) -> float:
    """The angle in [0, pi/2) from +x, up to quarter turns, of most straight pieces of a mask [rows, columns].

    There the Hough transform is sharpest: the sum of its squares over all offsets of a direction and its perpendicular
    (Censi, Iocchi & Grisetti 2005, "Scan matching in the Hough domain"). Rows run with y.
    """
    # A line of direction a has its normal at a + pi/2, which is the angle of the transform.
    quarter = np.arange(0, np.pi / 2, DIRECTION_STEP_RAD)
    normals = np.concatenate([quarter, quarter - np.pi / 2])
    votes, _, _ = hough_line(occupied, theta=normals)
    # Squares: votes of one offset of a wall's direction are its length, while other directions spread them evenly.
    sharp = np.square(votes.astype(float)).sum(axis=0).reshape(2, -1).sum(axis=0)
    # The middle of the peak: its top is uncertain by degrees in smeared plans.
    middle = len(quarter) // 2
    around = np.roll(sharp, middle - int(np.argmax(sharp)))
    weight = np.maximum(around - (sharp.max() - PEAK * np.ptp(sharp)), 0)
    parts, _ = ndimage.label(weight > 0)
    peak = (parts == parts[middle]) & (parts > 0)
    off = float(np.sum((np.arange(len(around)) - middle) * weight * peak) / max(np.sum(weight * peak), 1e-12))
    return float((int(np.argmax(sharp)) + off) * DIRECTION_STEP_RAD % (np.pi / 2))


def turned(grid: PlanGrid, angle: float) -> PlanGrid:
    """The grid in axes turned by an angle, with coordinates R(-angle) x: the angle's direction becomes x."""
    rotation = rotation_2d(angle)
    step = grid.resolution_m
    rows, columns = grid.occupied.shape
    corners = grid.origin_m + step * np.array([[0, 0], [columns, 0], [0, rows], [columns, rows]])
    low, high = (corners @ rotation).min(axis=0), (corners @ rotation).max(axis=0)
    width, height = np.ceil((high - low) / step).astype(int)
    # Each new cell takes the value of the old one that its centre lies in.
    new = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1) * step + low
    cells, within = grid.cell_indices(new @ rotation.T)
    return PlanGrid(grid.occupied[cells] & within, grid.free[cells] & within, step, low)


def rotation_2d(angle: float) -> FloatArray:
    """Rotation [2, 2] by an angle from +x towards +y."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


def find_runs(grid: PlanGrid, shortest_m: float = SHORTEST_RUN_M) -> list[WallRun]:
    """Axis-parallel runs of occupied cells of a turned grid, the best supported first."""
    step = grid.resolution_m
    half, rim, hole = (max(0, round(m / step)) for m in (HALF_WIDTH_M, CLEARED_M, LARGEST_HOLE_M))
    occupied, thickest = np.pad(grid.occupied, half), THICKEST_WALL_M / step
    unexplained = occupied.copy()
    low = grid.origin_m - half * step
    runs: list[WallRun] = []
    while True:
        images = unexplained, unexplained.T
        best = [(_best(image, half, hole, shortest_m / step), axis) for axis, image in enumerate(images)]
        # Greedily: the best supported run of both directions first, so that its cells support no worse one.
        (score, row, begin, end), axis = max(best, key=lambda run: run[0][0])
        if score <= 0:
            return runs
        image = images[axis]
        first = max(0, row - half)
        across, along = np.nonzero(image[first : row + half + 1, begin:end])
        # Slope of the line through the run's cells, as a rise over its length.
        rise = np.polyfit(along, across, 1)[0] * (end - begin) * step
        if abs(rise) > LARGEST_RISE_M:
            # The next direction may explain it.
            image[first : row + half + 1, begin:end] = False
            continue
        middle, thick = float(np.median(across)) + first, 0.0
        low_row, high_row = _solid_rows((occupied if axis == 0 else occupied.T)[:, begin:end], round(middle))
        if thickest >= high_row - low_row > 2 * half + 1:
            # The window saw a part of a thick wall.
            middle, thick = (low_row + high_row - 1) / 2, (high_row - low_row) / 2 - half
        offset = low[1 - axis] + (middle + 0.5) * step
        runs.append(WallRun(axis, offset, low[axis] + begin * step, low[axis] + end * step, thick * step))
        low_row, high_row = int(middle - thick) - rim, int(np.ceil(middle + thick)) + rim + 1
        image[max(0, low_row) : high_row, max(0, begin - 1) : end + 1] = False


def _solid_rows(image: Mask, row: int) -> tuple[int, int]:
    """First and last + 1 row of the solid wall about a row of an image; both are the row where it is not solid."""
    solid = image.mean(axis=1) >= SOLID
    if not solid[row]:
        return row, row
    gaps = np.flatnonzero(~solid)
    position = int(np.searchsorted(gaps, row))
    return int(gaps[position - 1]) + 1 if position else 0, int(gaps[position]) if position < len(gaps) else len(solid)


def _best(image: Mask, half: int, hole: int, shortest: float) -> tuple[float, int, int, int]:
    """Score, row, first and last + 1 column of the best run along the rows of an image; score 0 if there is none."""
    window = 2 * half + 1
    # A row is supported by the cells within the blur of a wall on both sides of it.
    near = ndimage.maximum_filter1d(image, window, axis=0)
    padded = np.pad(near, ((0, 0), (hole + 1, hole + 1)))
    closed = ndimage.binary_closing(padded, np.ones((1, hole + 1)))[:, hole + 1 : -hole - 1]
    pieces, count = ndimage.label(closed, ALONG_ROWS)
    if not count:
        return 0.0, 0, 0, 0
    flat: NDArray[np.intp] = pieces.ravel()
    length = np.bincount(flat, minlength=count + 1)
    support = np.bincount(flat, near.ravel(), count + 1)
    # Cells near the middle of the window count more: of all rows through a smear the middle one is the wall.
    mass = np.bincount(flat, ndimage.uniform_filter1d(image.astype(float), window, axis=0).ravel(), count + 1)
    score = np.where((length >= shortest) & (support >= FILLED * length), support + mass, 0.0)
    score[0] = 0.0
    winner = int(np.argmax(score))
    row, column = np.nonzero(pieces == winner)
    return float(score[winner]), int(row[0]), int(column.min()), int(column.max()) + 1
