"""Grid of the Gaussians that reach each cell, and a bound on their extinction, for free-flight sampling.

Made on the host, in float64, whenever the Gaussians change. A cell lists every Gaussian whose cut-off reaches into it,
by a lower bound of the Mahalanobis distance between the two: along the Gaussian's axes, scaled to unit deviation, the
cell is enclosed in a box; and along each axis of the world the cell is a slab.
"""

from __future__ import annotations

import heapq
import itertools
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import drjit as dr
import numpy as np

from wrf_mi.core.angles import FloatArray
from wrf_mi.core.types import IntArray
from wrf_mi.gaussians.footprint import CUTOFF

CELLS_PER_GAUSSIAN = 8
"""Approximate number of (cubic) cells per Gaussian."""
MOST_PAIRS = 1_000_000
"""Largest number of pairs of a cell and a Gaussian; if there are more, the grid gets coarser."""
TIGHT = 1.2
"""The bound is refined until it is within this factor of an extinction that occurs ..."""
MOST_SPLIT_PAIRS = 300_000
"""... or until this many pairs of a part of a cell and a Gaussian have been visited."""
SPLIT_PER_CHUNK = 32
"""Cells that are split together, those with the largest sums."""
EIGHT = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
"""Centres of the eight parts of a cell, in half widths of a part."""
MARGIN = 1e-4
"""Relative room for rounding in float32: of a cell's width and of the bound."""


@dataclass(frozen=True)
class HostGaussians:
    """Absorbing Gaussians in float64 on the host.

    Attributes:
        centre_m: shape [n, 3].
        whitening: W = diag(1 / s) R^T, shape [n, 3, 3], 1/m.
        peak: largest extinction, at the centre along the shortest axis, shape [n], 1/m.
    """

    centre_m: FloatArray
    whitening: FloatArray
    peak: FloatArray

    @cached_property
    def deviation_m(self) -> FloatArray:
        """Standard deviations along the world's axes, shape [n, 3]."""
        return np.sqrt((np.linalg.inv(self.whitening) ** 2).sum(axis=2))

    def bounds_m(self) -> tuple[FloatArray, FloatArray]:
        """Corners [3] of the box around everything within the cut-off, a little enlarged."""
        low = (self.centre_m - CUTOFF * self.deviation_m).min(axis=0)
        high = (self.centre_m + CUTOFF * self.deviation_m).max(axis=0)
        return low - MARGIN * (high - low), high + MARGIN * (high - low)

    def squared_distance(self, which: IntArray, middle_m: FloatArray, half_m: FloatArray | float) -> FloatArray:
        """Lower bounds [p] of squared Mahalanobis distances from Gaussians [p] to cubes.

        Args:
            which: Gaussians, shape [p].
            middle_m: centres of the cubes, shape [p, 3].
            half_m: half their width, shape [p, 1] or one number.
        """
        w, offset = self.whitening[which], middle_m - self.centre_m[which]
        box = np.abs(np.einsum("pij,pj->pi", w, offset)) - half_m * np.abs(w).sum(axis=2)
        slab = (np.abs(offset) - half_m) / self.deviation_m[which]
        return np.maximum((np.maximum(box, 0) ** 2).sum(axis=1), np.maximum(slab, 0).max(axis=1) ** 2)

    def extinction(self, which: IntArray, points_m: FloatArray) -> FloatArray:
        """Extinction of Gaussians [p] at points [p, 3] in the direction in which each is densest, 1/m."""
        squared = self.squared_distance(which, points_m, 0.0)
        return np.where(squared < CUTOFF**2, self.peak[which] * np.exp(-0.5 * squared), 0.0)


@dataclass(frozen=True)
class Cells:
    """A grid of cubes with the Gaussians that reach into each; on the host.

    Attributes:
        low_m: corner of the grid, shape [3].
        width_m: width of a cell.
        size: cells along each axis, shape [3].
        first: begin of each cell's list in ``index``, shape [cells + 1]; z runs fastest.
        index: Gaussians, cell by cell.
    """

    low_m: FloatArray
    width_m: float
    size: IntArray
    first: IntArray
    index: IntArray

    def middle_m(self, cell: IntArray) -> FloatArray:
        """Centres [p, 3] of cells [p]."""
        return self.low_m + (np.stack(np.unravel_index(cell, self.size), axis=-1) + 0.5) * self.width_m


def _ranges(start: IntArray, count: IntArray) -> tuple[IntArray, IntArray]:
    """For each row, its number repeated, and the integers from ``start`` to ``start + count``, concatenated."""
    row = np.repeat(np.arange(len(count)), count)
    return row, np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count) + np.repeat(start, count)


def make_cells(gaussians: HostGaussians) -> Cells:
    """The grid over all cut-off ellipsoids."""
    low, high = gaussians.bounds_m()
    reach = CUTOFF * gaussians.deviation_m
    width = float(np.cbrt(np.prod(high - low) / (CELLS_PER_GAUSSIAN * len(reach))))
    while True:
        size = np.ceil((high - low) / width).astype(int)
        begin = np.clip((gaussians.centre_m - reach - low) // width - 1, 0, size - 1).astype(int)
        span = np.clip((gaussians.centre_m + reach - low) // width + 1, 0, size - 1).astype(int) - begin + 1
        count = span.prod(axis=1)
        if size.prod() + count.sum() <= MOST_PAIRS or size.prod() == 1:
            break
        width *= 1.5
    which, inside = _ranges(np.zeros_like(count), count)
    y, z = span[which, 1], span[which, 2]
    place = np.stack([inside // (y * z), inside // z % y, inside % z], axis=-1) + begin[which]
    middle, half = low + (place + 0.5) * width, 0.5 * width * (1 + MARGIN)
    near = gaussians.squared_distance(which, middle, half) < CUTOFF**2
    cell = np.ravel_multi_index(tuple(place[near].T), size)
    order = np.argsort(cell, kind="stable")
    first = np.concatenate([[0], np.cumsum(np.bincount(cell, minlength=int(size.prod())))])
    return Cells(low, width, size, first, which[near][order])


def largest_extinction(gaussians: HostGaussians, cells: Cells) -> float:
    """Upper bound of the extinction, 1/m: at most `TIGHT` times too large, unless `MOST_SPLIT_PAIRS` are visited first.

    Branch and bound: the extinction in a cell is at most the sum of each listed Gaussian's at its nearest point of the
    cell; cells with the largest such sums are split in eight until sums at points come close to it. Every Gaussian is
    taken in its densest direction: where thin ones of several orientations meet the bound is loose by up to their
    number.
    """
    at = np.clip((gaussians.centre_m - cells.low_m) // cells.width_m, 0, cells.size - 1).astype(int)
    home = np.ravel_multi_index(tuple(at.T), cells.size)
    row, entry = _ranges(cells.first[home], np.diff(cells.first)[home])
    which = cells.index[entry]
    reached = float(np.bincount(row, gaussians.extinction(which, gaussians.centre_m[row])).max(initial=0.0))
    cell = np.repeat(np.arange(len(cells.first) - 1), np.diff(cells.first))
    start_half = 0.5 * cells.width_m * (1 + MARGIN)
    squared = gaussians.squared_distance(cells.index, cells.middle_m(cell), start_half)
    most = np.bincount(cell, gaussians.peak[cells.index] * np.exp(-0.5 * squared), minlength=len(cells.first) - 1)
    middle = cells.middle_m(np.arange(len(most)))
    number = itertools.count()  # ties of the heap
    heap = [
        (-most[c], next(number), middle[c], start_half, cells.index[cells.first[c] : cells.first[c + 1]])
        for c in np.flatnonzero(most > TIGHT * reached)
    ]
    heapq.heapify(heap)
    visited = 0
    while heap and -heap[0][0] > TIGHT * reached and visited < MOST_SPLIT_PAIRS:
        boxes = [heapq.heappop(heap) for _ in range(min(len(heap), SPLIT_PER_CHUNK))]
        # Pairs of a part, eight to a box, and a Gaussian, part by part.
        which = np.concatenate([np.tile(listed, 8) for *_, listed in boxes])
        part = np.repeat(np.arange(8 * len(boxes)), np.repeat([len(listed) for *_, listed in boxes], 8))
        half = np.repeat([0.5 * b[3] for b in boxes], 8)
        middle = np.repeat([b[2] for b in boxes], 8, axis=0) + np.tile(EIGHT, (len(boxes), 1)) * half[:, None]
        squared = gaussians.squared_distance(which, middle[part], half[part, None])
        near = squared < CUTOFF**2
        most = np.bincount(part, np.where(near, gaussians.peak[which] * np.exp(-0.5 * squared), 0), minlength=len(half))
        reached = max(reached, np.bincount(part, gaussians.extinction(which, middle[part])).max(initial=0.0))
        visited += len(which)
        edges = np.searchsorted(part, np.arange(len(half) + 1))
        for p in np.flatnonzero(most > TIGHT * reached):
            pairs = slice(edges[p], edges[p + 1])
            heapq.heappush(heap, (-most[p], next(number), middle[p], half[p], which[pairs][near[pairs]]))
    bound = max(-heap[0][0] if heap else 0.0, TIGHT * reached)
    return float(bound * (1 + MARGIN))


@dataclass
class CellLists:
    """A grid of cells on the device (`Cells`).

    Attributes:
        low: corner, three arrays [1], metres.
        per_m: cells per metre, array [1].
        size: cells along each axis, three arrays [1].
        first: array [cells + 1].
        index: array [pairs].
    """

    low: list[Any]
    per_m: Any
    size: list[Any]
    first: Any
    index: Any

    def range_at(self, position: list[Any], active: Any) -> tuple[Any, Any]:
        """Begin and end in ``index`` of the lists of the cells at points [p]; an empty range outside the grid."""
        inside, cell = active, type(self.index)(0)
        for x, low, size in zip(position, self.low, self.size, strict=True):
            place = (x - low) * self.per_m
            inside = inside & (place >= 0) & (place < type(place)(size))
            cell = cell * size + type(size)(dr.select(inside, place, 0))
        begin, end = (dr.gather(type(self.first), self.first, cell + k, inside) for k in (0, 1))
        return begin, end


def to_device(cells: Cells, float_type: Any) -> CellLists:
    """The grid on the device. Its numbers are opaque, so that another grid finds the same kernels."""
    integer = dr.uint32_array_t(float_type)
    return CellLists(
        low=[dr.opaque(float_type, float(x)) for x in cells.low_m],
        per_m=dr.opaque(float_type, 1 / cells.width_m),
        size=[dr.opaque(integer, int(n)) for n in cells.size],
        first=integer(cells.first.astype(np.uint32)),
        index=integer(cells.index.astype(np.uint32)),
    )
