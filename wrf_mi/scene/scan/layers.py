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
NORMAL_MAD = 1.4826
"""Standard deviation of a normal distribution in its median absolute deviations."""


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
    counted = np.flatnonzero(count >= FEWEST_PER_CELL)
    median[counted] = ndimage.median(away, number, counted)
    error = MEDIAN_ERROR * noise_m / np.sqrt(np.maximum(count, 1))
    level = _location(median[counted], error[counted])
    step = median - level
    parallels = list[tuple[Plane, IntArray, int]]()
    for sign in (1, -1):
        ratio = np.nan_to_num(sign * step / np.maximum(error, LEAST_STEP / ERRORS * noise_m)).reshape(shape)
        mask = apply_hysteresis_threshold(ratio, GROWN_ERRORS, ERRORS)
        parts, most = ndimage.label(ndimage.binary_opening(mask, np.ones((2, 2))))  # strips are rims of neighbours
        for part in range(1, most + 1):
            inside = np.flatnonzero((parts == part).ravel())
            if len(inside) < LEAST_CELLS or len(inside) * side**2 < LEAST_M2:
                continue
            depth = float(np.median(step[inside]))
            spread = NORMAL_MAD * float(np.median(np.abs(step[inside] - depth)))
            if spread > FLATNESS * float(np.median(error[inside])):
                continue
            chosen = np.isin(number, inside) & (np.abs(away - level - depth) < 2 * noise_m)
            corners = np.stack(np.unravel_index(inside, shape), axis=1)
            parallel = plane.shifted(level).shifted(depth)
            patch = parallel.rectangle(low + side * corners.min(axis=0), low + side * (corners.max(axis=0) + 1))
            parallel = replace(parallel, patches_m=patch[None], centre_m=patch.mean(axis=0))
            parallels.append((parallel, rows[chosen], sign))
    if not parallels:
        return plane, []
    room_side = np.sign(np.median(plane.distance(points_m)) - level)
    return plane.shifted(level), [Layer(layer, which, bool(sign == room_side)) for layer, which, sign in parallels]


def _location(values: NDArray[np.float64], error: FloatArray) -> float:
    """Weighted location of values by Tukey's biweight, from their median."""
    if not len(values):
        return 0.0
    at, weight = float(np.median(values)), np.ones(len(values))
    for _ in range(10):
        scale = np.maximum(error, NORMAL_MAD * np.median(np.abs(values - at)[weight > 0]))
        weight = np.clip(1 - ((values - at) / (TUKEY * scale)) ** 2, 0, None) ** 2 / error**2
        if weight.sum() <= 0:
            break
        at = float((weight * values).sum() / weight.sum())
    return at
