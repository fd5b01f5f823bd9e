"""Parallel layers of a plane that the noise of a scan blurs: boards on walls, backs of shelves, recesses.

Two layers that are three standard deviations of the noise apart are one layer to single points. The median of the
points of a cell tells them apart, as its error falls with the root of their number.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from skimage.filters import apply_hysteresis_threshold

from ...core.angles import FloatArray
from ...core.types import IntArray
from ..mesh.planes import Mask, Plane, near
from .planes import SEARCH_M

POINTS_PER_CELL, FEWEST_PER_CELL = 24, 8
"""Mean and least number of points of a cell."""
CELL_RANGE_M = (0.1, 0.4)
AROUND = 6.0
"""Half thickness of the slab about a plane in which layers are sought, in standard deviations of the noise."""
ERRORS, LEAST_STEP = 4.0, 0.6
"""Least distance of a layer from its plane, in standard errors of a cell's median and in deviations of the noise."""
GROWN_ERRORS = 2.0
"""The same of cells beside."""
LEAST_M2, LEAST_CELLS = 0.3, 8
"""Least size of a layer."""
FLATNESS = 2.0
"""Largest spread of the medians of a layer, in their standard errors: what is bent or tilted is not a layer."""
MEDIAN_ERROR = 1.25
"""Standard error of a median, in that of a mean."""
TUKEY = 4.685
"""Constant of the biweight."""


@dataclass(frozen=True)
class Layer:
    """A part of the points about a plane that lies in a parallel one.

    Attributes:
        plane: the parallel plane.
        rows: numbers of its points.
        before: whether it lies on the side of the plane where most points are: the plane goes on behind it.
    """

    plane: Plane
    rows: IntArray
    before: bool


def layers(plane: Plane, points_m: FloatArray, free: Mask, noise_m: float) -> tuple[Plane, list[Layer]]:
    """The plane of most cells, and the layers of others.

    Args:
        plane: a plane with its axes.
        points_m: points of the scan [n, 3], metres.
        free: points that belong to no other plane [n].
        noise_m: standard deviation of points from planes.
    """
    reach = min(AROUND * noise_m, SEARCH_M)
    rows = np.flatnonzero(free & near(plane, points_m, reach))
    if len(rows) < LEAST_CELLS * POINTS_PER_CELL:
        return plane, []
    away, flat = plane.distance(points_m[rows]).astype(float), plane.flat(points_m[rows]).astype(float)
    low = flat.min(axis=0)
    density = len(rows) / max(
        len(np.unique(np.floor((flat - low) / CELL_RANGE_M[0]), axis=0)) * CELL_RANGE_M[0] ** 2, 1e-9
    )
    side = float(np.clip(np.sqrt(POINTS_PER_CELL / density), *CELL_RANGE_M))
    cell = np.floor((flat - low) / side).astype(int)
    shape = tuple(cell.max(axis=0) + 1)
    number = np.ravel_multi_index(tuple(cell.T), shape)
    count = np.bincount(number, minlength=int(np.prod(shape)))
    median = np.full(len(count), np.nan)
    seen = np.flatnonzero(count >= FEWEST_PER_CELL)
    median[seen] = ndimage.median(away, number, seen)
    error = MEDIAN_ERROR * noise_m / np.sqrt(np.maximum(count, 1))
    level = _location(median[seen], error[seen])
    step = median - level
    found = list[tuple[Plane, IntArray, int]]()
    for sign in (1, -1):
        ratio = np.nan_to_num(sign * step / np.maximum(error, LEAST_STEP / ERRORS * noise_m)).reshape(shape)
        mask = apply_hysteresis_threshold(ratio, GROWN_ERRORS, ERRORS)
        parts, most = ndimage.label(ndimage.binary_opening(mask, np.ones((2, 2))))  # strips are rims of neighbours
        for part in range(1, most + 1):
            inside = np.flatnonzero((parts == part).ravel())
            if len(inside) < LEAST_CELLS or len(inside) * side**2 < LEAST_M2:
                continue
            here = float(np.median(step[inside]))
            spread = 1.4826 * float(np.median(np.abs(step[inside] - here)))
            if spread > FLATNESS * float(np.median(error[inside])):
                continue
            chosen = np.isin(number, inside) & (np.abs(away - level - here) < 2 * noise_m)
            corners = np.stack(np.unravel_index(inside, shape), axis=1)
            (u0, v0), (u1, v1) = low + side * corners.min(axis=0), low + side * (corners.max(axis=0) + 1)
            moved = replace(plane, offset_m=plane.offset_m + level + here)
            patch = moved.lift(np.array([[[u0, v0], [u1, v0], [u1, v1], [u0, v1]]]))
            moved = replace(moved, patches_m=patch, centre_m=patch[0].mean(axis=0))
            found.append((moved, rows[chosen], sign))
    if not found:
        return plane, []
    inner = np.sign(np.median(plane.distance(points_m)) - level)
    shift = level * plane.normal
    plane = replace(
        plane, offset_m=plane.offset_m + level, patches_m=plane.patches_m + shift, centre_m=plane.centre_m + shift
    )
    return plane, [Layer(moved, which, bool(sign == inner)) for moved, which, sign in found]


def _location(values: NDArray[np.float64], error: FloatArray) -> float:
    """Weighted location of values by Tukey's biweight, from their median."""
    at = float(np.median(values)) if len(values) else 0.0
    scale = np.maximum(error, 1.4826 * np.median(np.abs(values - at))) if len(values) else error
    for _ in range(10):
        weight = np.clip(1 - ((values - at) / (TUKEY * scale)) ** 2, 0, None) ** 2 / error**2
        if weight.sum() <= 0:
            break
        at = float((weight * values).sum() / weight.sum())
        scale = np.maximum(error, 1.4826 * np.median(np.abs(values - at)[weight > 0]))
    return at
