"""How far a plane reaches: an area with holes from the points that lie in it."""

from __future__ import annotations

from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy import ndimage
from shapely import affinity

from ..core.angles import FloatArray
from .planes import Plane

CELL_RANGE_M = (0.04, 0.25)
POINTS_PER_CELL = 8
"""Cells are as small as gives this many points in the sparse fifth of the area."""
SHARE = 0.2
"""An occupied cell has at least this share of the points of those around it: half of the last cell is on the plane."""
EDGE_SHARE = 0.3
"""Share of a cell by which an edge is found too far out: a last cell filled to a share x of `SHARE` to 1 counts, and
the mean of 1 - x times its chance is 0.32."""
AROUND_CELLS = 5
CLOSED_CELLS = 1
"""Gaps of up to twice this many cells are noise."""
STRAY_SIZE = 0.05
STRAY_DENSITY = 0.25
"""A part of an area is a stray where it is smaller than this share of the whole and sparser than this share."""
SMALL_HOLE_M2 = 0.1
SMALLEST_M2 = 0.04
RECTANGLE_SHARE = 0.88
"""An area that fills its tightest rectangle to this share is that rectangle."""
SCAN_LINES = 31

Mask = NDArray[np.bool_]


def outline(plane: Plane, points_m: FloatArray) -> tuple[Any, float]:
    """The area (shapely, in the plane's coordinates) that its points cover, and the cell it was told with.

    Args:
        plane: with its axes set.
        points_m: its points [n, 3], metres.
    """
    flat = plane.flat(points_m).astype(float)
    cell = cell_size(flat)
    low = flat.min(axis=0) - (CLOSED_CELLS + 2) * cell
    bins = np.ceil((flat.max(axis=0) - low) / cell).astype(int) + CLOSED_CELLS + 2
    index = ((flat - low) / cell).astype(int)
    count = np.bincount(np.ravel_multi_index(tuple(index.T), tuple(bins)), minlength=bins.prod()).reshape(bins)
    mask = _without_strays(_clean(_occupied(count), cell), count)
    area = from_mask(mask, low, cell)
    return _tidy(area, cell), cell


def cell_size(flat_m: FloatArray) -> float:
    """Edge of the cells that suits the density of points [n, 2], metres."""
    coarse = 0.1
    _, count = np.unique(np.floor(flat_m / coarse).astype(int), axis=0, return_counts=True)
    low = np.quantile(count[count > 1], 0.2) if (count > 1).any() else 1.0
    return float(np.clip(coarse * np.sqrt(POINTS_PER_CELL / low), *CELL_RANGE_M))


def from_mask(mask: Mask, low: FloatArray, cell: float) -> Any:
    """The area of the marked cells: the union of one rectangle per run."""
    steps = np.diff(np.pad(mask, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    row, start = np.nonzero(steps == 1)
    _, stop = np.nonzero(steps == -1)
    x, y0, y1 = low[0] + row * cell, low[1] + start * cell, low[1] + stop * cell
    return shapely.union_all(shapely.box(x, y0, x + cell, y1), grid_size=cell * 1e-3)


def polygons(area: Any) -> list[Any]:
    """The polygons of an area, the largest first."""
    parts = [part for part in shapely.get_parts(area) if part.geom_type == "Polygon" and not part.is_empty]
    return sorted(parts, key=lambda part: -part.area)


def _occupied(count: NDArray[Any]) -> Mask:
    """Cells as full as those that the points around them lie in; a stray beside an edge is not."""
    full = count.astype(float)
    total = ndimage.uniform_filter(full, AROUND_CELLS, mode="constant")
    squares = ndimage.uniform_filter(full * full, AROUND_CELLS, mode="constant")
    occupied: Mask = count >= np.maximum(2, SHARE * squares / np.maximum(total, 1e-9))
    return occupied


def _clean(mask: Mask, cell: float) -> Mask:
    disc = np.hypot(*np.mgrid[-CLOSED_CELLS : CLOSED_CELLS + 1, -CLOSED_CELLS : CLOSED_CELLS + 1]) <= CLOSED_CELLS + 0.5
    mask = ndimage.binary_closing(mask, disc)
    mask = ndimage.binary_opening(mask, np.ones((2, 2), bool))
    for inverse, smallest in ((False, SMALLEST_M2), (True, SMALL_HOLE_M2)):
        label, count = ndimage.label(mask != inverse)
        size = np.bincount(label.ravel(), minlength=count + 1) * cell * cell
        mask = mask ^ ((size < smallest)[label] & (label > 0))
    return mask


def _without_strays(mask: Mask, count: NDArray[Any]) -> Mask:
    """The mask without small sparse parts: what a surface that crosses the plane leaves in it."""
    label, parts = ndimage.label(mask)
    if parts < 2:
        return mask
    size = np.bincount(label.ravel())[1:]
    density = np.bincount(label.ravel(), weights=count.ravel())[1:] / size
    stray = (size < STRAY_SIZE * size.sum()) & (density < STRAY_DENSITY * np.median(count[mask]))
    return mask & ~np.concatenate([[False], stray])[label]


def _tidy(area: Any, cell: float) -> Any:
    """Straight edges, moved inwards because a cell that the edge crosses counts as a whole."""
    parts = [_rectangle(part) or part.simplify(1.2 * cell) for part in polygons(area)]
    return shapely.buffer(shapely.union_all(parts), -EDGE_SHARE * cell, join_style="mitre")


def _rectangle(part: Any) -> Any | None:
    """The rectangle that a polygon is but for noise, or None; its sides are where the polygon's are in the median."""
    for tight in (shapely.envelope(part), part.minimum_rotated_rectangle):
        if part.area < RECTANGLE_SHARE * tight.area:
            continue
        (x, y), (x1, y1) = tight.exterior.coords[:2]
        angle, pivot = np.degrees(np.arctan2(y1 - y, x1 - x)), (x, y)
        level = affinity.rotate(part, -angle, pivot)
        left, low, right, high = level.bounds
        rows, columns = (np.linspace(a, b, SCAN_LINES + 2)[1:-1] for a, b in ((low, high), (left, right)))
        across = shapely.linestrings([[(left, t), (right, t)] for t in rows])
        along = shapely.linestrings([[(t, low), (t, high)] for t in columns])
        left, _, right, _ = np.nanmedian(shapely.bounds(shapely.intersection(level, across)), axis=0)
        _, low, _, high = np.nanmedian(shapely.bounds(shapely.intersection(level, along)), axis=0)
        return affinity.rotate(shapely.box(left, low, right, high), angle, pivot)
    return None
