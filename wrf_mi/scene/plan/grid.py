"""Plans in square cells, and the lines of a drawing that are not walls."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ...core.angles import FloatArray
from ...core.types import IntArray
from .faces import THICKEST_WALL_M

logger = logging.getLogger(__name__)

Mask = NDArray[np.bool_]
THINNEST_WALL_M = 0.05  # thinner lines of a drawing are door leaves, dimensions and letters
SMALLEST_PART_M = 0.8  # smaller parts that touch no others are letters, symbols and pillars


@dataclass(frozen=True)
class PlanGrid:
    """A plan in square cells; cell (row, column) has its centre at origin + resolution (column + 1/2, row + 1/2).

    Attributes:
        occupied: cells where something stands, shape [rows, columns].
        free: cells seen empty, same shape; without any, openings and hidden places are unknown.
        resolution_m: side of a cell.
        origin_m: lower left corner, shape [2].
        yaw_rad: angle by which the map is turned about (0, 0) in the frame of its file.
    """

    occupied: Mask
    free: Mask
    resolution_m: float
    origin_m: FloatArray
    yaw_rad: float = 0.0

    @property
    def unmapped(self) -> Mask:
        """Cells of which it is not known what is there [rows, columns]."""
        return ~(self.occupied | self.free)

    def cell_indices(self, xy_m: FloatArray) -> tuple[tuple[IntArray, IntArray], Mask]:
        """Row and column [...] of the cells of points [..., 2], and whether they lie in the grid; (0, 0) outside it."""
        column, row = np.moveaxis(np.floor((xy_m - self.origin_m) / self.resolution_m).astype(int), -1, 0)
        rows, columns = self.occupied.shape
        within = np.asarray((row >= 0) & (row < rows) & (column >= 0) & (column < columns))
        return (np.where(within, row, 0), np.where(within, column, 0)), within

    def centres_m(self, mask: Mask) -> FloatArray:
        """Centres [n, 2] of the cells of a mask."""
        row, column = np.nonzero(mask)
        return self.origin_m + self.resolution_m * (np.stack([column, row], axis=-1) + 0.5)


def without_thin_lines(grid: PlanGrid, name: str = "plan") -> PlanGrid:
    """A drawing without lines thinner than `THINNEST_WALL_M`, whose cells are free; how many is logged.

    So are parts smaller than `SMALLEST_PART_M` that touch no others, such as letters. Where less than half remains,
    walls are drawn as lines: narrow spaces between two of them are filled, as both are faces of a wall, and a drawing
    of which less than half remains even so is returned as it is.
    """
    lines = _thin_lines(grid)
    if not lines.any():
        return grid
    share = lines.sum() / grid.occupied.sum()
    if share > 0.5:
        filled = replace(grid, occupied=grid.occupied | _between_faces(grid))
        lines = _thin_lines(filled)
        if lines.sum() <= 0.5 * filled.occupied.sum():
            text = "%s: walls are drawn by both faces; other lines are not walls (door leaves, furniture, dimensions)"
            logger.warning(text, name)
            return replace(filled, occupied=filled.occupied & ~lines, free=filled.free | lines)
        logger.warning("%s: walls are drawn as lines thinner than %g m, so every line is a wall", name, THINNEST_WALL_M)
        return grid
    text = "%s: lines thinner than %g m, %.2g %% of the dark cells, are not walls (door leaves, dimensions, letters)"
    logger.warning(f"{text}; draw those thicker that are", name, THINNEST_WALL_M, 100 * share)
    return replace(grid, occupied=grid.occupied & ~lines, free=grid.free | lines)


def _thin_lines(grid: PlanGrid) -> Mask:
    """Dark cells of lines thinner than `THINNEST_WALL_M`, and of small parts that touch no others."""
    # A disk, so that walls of any direction remain; of even diameter, too, hence the half cells.
    cells = max(1, int(np.ceil(THINNEST_WALL_M / grid.resolution_m - 1e-6)))
    offset = np.arange(cells) - (cells - 1) / 2
    disk = np.hypot(offset[:, None], offset) <= cells / 2
    thick = ndimage.binary_opening(grid.occupied, disk)
    parts, _ = ndimage.label(thick, np.ones((3, 3)))
    boxes = ndimage.find_objects(parts)
    sides_m = np.array([[0.0, 0.0], *([(axis.stop - axis.start) for axis in box] for box in boxes)]) * grid.resolution_m
    if (sides_m.max(axis=1) >= SMALLEST_PART_M).any():
        thick &= (sides_m.max(axis=1) >= SMALLEST_PART_M)[parts]
    return np.asarray(grid.occupied & ~ndimage.binary_dilation(thick, np.ones((3, 3))))


def _between_faces(grid: PlanGrid) -> Mask:
    """Cells of spaces that lines enclose and that are nowhere wider than a wall."""
    spaces, count = ndimage.label(~grid.occupied)
    half_m = ndimage.distance_transform_edt(~grid.occupied) * grid.resolution_m
    widest_m = ndimage.maximum(half_m, spaces, np.arange(count + 1))
    return np.asarray((2 * widest_m <= THICKEST_WALL_M)[spaces] & ~grid.occupied)
