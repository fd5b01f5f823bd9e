"""The linear map from the Gaussians' signals to the perception plane, for Gaussians that stand still.

Blending (`wrf_mi.gaussians.blend`) is a sum R(u) = sum_i w_i T_i S_i whose weights w_i T_i depend on geometry and
attenuation alone. Where those are the same for all transmitters, the weights are a sparse matrix B [pixels, n], real
under alpha and complex under product blending, and a spectrum is one product, R = B S. One walk over the same lists
of the same tiles, front to back, with the same arithmetic, gives it: only the order of the last sum differs.

Where signals are S = C phi(transmitter) with K terms, the images B C are dense [K, pixels] and Gaussians no longer
count. Products are SciPy's (sparse) and NumPy's (dense). Tried for 10,000 Gaussians and 3.7 million weights: SciPy's
sparse product 3.4 ms of a core, a recorded Dr.Jit kernel with a lane for each pixel 16 ms.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array, vstack
from threadpoolctl import ThreadpoolController

from ..backend.device import on_device
from ..core import InputError
from .blend import _along_azimuth, _footprint, pack, read
from .footprint import Footprints, Pose, depth_order, project
from .parameters import Gaussians
from .recurrence import Pair, ahead
from .tiles import LANE_ROWS, LANES, TILE_COLUMNS, TILE_ROWS, Plane, TileLists, build_lists

ComplexArray = NDArray[np.complexfloating[Any, Any]]

MOST_IN_STRIP = 2**32 - 1
"""Entries that the index of one strip of tiles can count."""
BLOCK = 16
"""Transmitters at once: 4 MB of complex numbers for 360 x 90 directions, which stay in the cache."""


def _strips(plane: Plane) -> Iterator[tuple[Plane, int, int]]:
    """The plane cut into rows of tiles: each as a plane of its own, its first pixel and how many it has.

    Pixels keep their numbers in the whole. What is needed beside the result so does not grow with the rows.
    """
    across = -(-plane.width // TILE_COLUMNS)
    index_type: Any = type(plane.tile)
    for first in range(0, plane.tiles, across):
        tiles = dr.arange(index_type, across) + first
        lanes = dr.arange(index_type, across * LANES) + first * LANES

        def of(array: Any, index: Any = lanes) -> Any:
            return dr.gather(type(array), array, index)

        strip = replace(
            plane,
            tile=of(plane.tile) - first,
            azimuth=[of(a) for a in plane.azimuth],
            elevation=[[of(c) for c in e] for e in plane.elevation],
            pixel=[of(p) for p in plane.pixel],
            active=[of(a) for a in plane.active],
            tile_row=of(plane.tile_row, tiles),
            tile_column=of(plane.tile_column, tiles),
        )
        row = first // across * TILE_ROWS
        dr.eval(strip)
        yield strip, row * plane.width, (min(row + TILE_ROWS, plane.height) - row) * plane.width


def _seen(record: list[Any], strip: Plane) -> list[Any]:
    """Footprint of one Gaussian at each pixel of the lanes."""
    along = _along_azimuth(record, strip.azimuth)
    return [_footprint(along, elevation)[0] for elevation in strip.elevation]


def _more(seen: list[Any], footprints: list[Any]) -> list[Any]:
    """One more of those that each pixel sees."""
    return [s + dr.select(g > 0, type(s)(1), type(s)(0)) for s, g in zip(seen, footprints, strict=True)]


@dr.syntax
def _count(table: Any, lists: TileLists, strip: Plane, n: int) -> list[Any]:
    """How many Gaussians each pixel of a lane sees."""
    index_type = type(lists.index)
    j, start, end = index_type(0), lists.begin(strip.tile, n), dr.gather(index_type, lists.length, strip.tile)
    seen = _more([index_type(0)] * LANE_ROWS, [dr.zeros(type(table))] * LANE_ROWS)
    while j < end:
        seen = _more(seen, _seen(read(table, dr.gather(index_type, lists.index, start + j), 9), strip))
        j += 1
    dr.eval(seen)
    return seen


@dataclass
class _Walk:
    """Where the next entry of each pixel of a lane goes, and its transmittance so far."""

    place: list[Any]
    t: list[Pair]


def _store(record: list[Any], i: Any, strip: Plane, walk: _Walk, out: tuple[Any, ...]) -> _Walk:
    """Write one Gaussian's weight at each pixel of a lane that sees it; the walk behind it."""
    result = _Walk([], [])
    for g, active, at, t in zip(_seen(record, strip), strip.active, walk.place, walk.t, strict=True):
        hit = (g > 0) & active
        weight, after = ahead(record[9:], g, t)
        for array, value in zip(out, (i, *weight), strict=True):
            dr.scatter(array, value, at, hit)
        result.place.append(dr.select(hit, at + 1, at))
        result.t.append(after)
    return result


@dr.syntax
def _fill(
    table: Any, lists: TileLists, strip: Plane, n: int, product: bool, place: list[Any], out: tuple[Any, ...]
) -> None:
    """Fill ``out``: Gaussian of each entry and its weight (re, and im under product blending).

    Args:
        table: from `pack`.
        lists: of the strip.
        strip: the pixels.
        n: number of Gaussians.
        product: how they are blended.
        place: where the entries of each pixel of a lane begin.
        out: evaluated arrays.
    """
    float_type, index_type = type(table), type(lists.index)
    j, start, end = index_type(0), lists.begin(strip.tile, n), dr.gather(index_type, lists.length, strip.tile)
    walk = _Walk(place, [(float_type(1), float_type(0)) for _ in place])
    while j < end:
        i = dr.gather(index_type, lists.index, start + j)
        walk = _store(read(table, i, 11 if product else 10), i, strip, walk, out)
        j += 1
    dr.eval(out)


def weight_strips(gaussians: Gaussians, pose: Pose, plane: Plane) -> Iterator[tuple[int, csr_array]]:
    """The weights of the perception plane, one row of tiles after the other.

    Args:
        gaussians: for one transmitter (batch 1); signals are not read.
        pose: of the receiver.
        plane: its perception plane, of the Gaussians' float type.

    Yields:
        The first pixel, and the weights [pixels, n] of it and those that follow: float32 or float64 under alpha
        blending, complex under product blending. In a row Gaussians stand from near to far.

    Raises:
        ValueError: Gaussians for several transmitters.
        InputError: more entries in one row of tiles than 32 bits count.
    """
    if gaussians.batch != 1:
        raise ValueError(f"weights: Gaussians for {gaussians.batch} transmitters; give those of one")
    if not gaussians.count:
        double = type(gaussians.position[0]) is not dr.float32_array_t(type(gaussians.position[0]))
        real, product = (np.float64, np.complex128) if double else (np.float32, np.complex64)
        yield 0, csr_array((plane.pixels, 0), dtype=real if gaussians.attenuation is None else product)
        return
    with dr.suspend_grad():
        footprints = project(gaussians, pose)
        order = depth_order(footprints.depth, gaussians.position)
        own = [gaussians.opacity] if gaussians.attenuation is None else list(gaussians.attenuation)
        table = pack([*footprints.direction, *footprints.whitened[0], *footprints.whitened[1], *own])
        dr.eval(table, footprints, order)
        for strip, first, count in _strips(plane):
            yield first, _weights(table, footprints, order, strip, first, count, gaussians.attenuation is not None)


def _weights(
    table: Any, footprints: Footprints, order: Any, strip: Plane, first: int, count: int, product: bool
) -> csr_array:
    """Weights [count, n] of one row of tiles."""
    n = dr.width(order)
    index_type: Any = type(order)
    lists = build_lists(footprints, order, strip, 1)
    entries = dr.zeros(index_type, count)
    for k, seen in enumerate(_count(table, lists, strip, n)):
        dr.scatter(entries, seen, strip.pixel[k] - first, strip.active[k])
    start: NDArray[np.int64] = np.concatenate([[0], np.cumsum(entries.numpy(), dtype=np.int64)])
    total = int(start[-1])
    if total > MOST_IN_STRIP:
        raise InputError(f"operator: {total} weights in one row of tiles; use fewer or smaller Gaussians")
    begin = on_device(start[:-1], index_type)
    place = [dr.gather(index_type, begin, p - first) for p in strip.pixel]
    # Nothing to see still gives a matrix: with one entry that is left out.
    room = max(total, 1)
    out = (dr.empty(index_type, room), *(dr.empty(type(table), room) for _ in range(2 if product else 1)))
    dr.eval(out)
    _fill(table, lists, strip, n, product, place, out)
    values: NDArray[Any] = out[1].numpy()[:total]
    if product:
        values = values + np.asarray(1j, np.result_type(values, np.complex64)) * out[2].numpy()[:total]
    return csr_array((values, out[0].numpy()[:total].astype(np.int32), start), shape=(count, n))


def pixel_weights(gaussians: Gaussians, pose: Pose, plane: Plane, most_bytes: float = np.inf) -> csr_array:
    """The weights of the whole perception plane [pixels, n], see `weight_strips`.

    Raises:
        MemoryError: they take more than ``most_bytes``; after the strip that does.
    """
    parts, size = [], 0
    for _, part in weight_strips(gaussians, pose, plane):
        parts.append(part)
        size += part.data.nbytes + part.nnz * np.dtype(np.int32).itemsize
        if size > most_bytes:
            raise MemoryError(f"weights of {gaussians.count} Gaussians take more than {most_bytes / 1e6:.0f} MB")
    whole = csr_array(vstack(parts, format="csr"))
    if whole.nnz < 2**31:
        # SciPy counts in 64 bits where it is given those: twice the memory and time of what is read.
        whole.indices, whole.indptr = whole.indices.astype(np.int32), whole.indptr.astype(np.int32)
    return whole


def in_blocks(function: Callable[[NDArray[Any], NDArray[Any]], object], given: NDArray[Any], out: NDArray[Any]) -> None:
    """Call ``function(rows of given, rows of out)`` for `BLOCK` rows at a time, on all processors.

    Products run on one thread each: those of the BLAS wait for each other by spinning, and where a processor is busy
    with something else a product of 0.1 ms then takes 16 ms.
    """
    parts = [slice(i, i + BLOCK) for i in range(0, len(given), BLOCK)]
    with _blas().limit(limits=1, user_api="blas"):
        if len(parts) > 1 and _workers() > 1:
            list(_pool().map(lambda rows: function(given[rows], out[rows]), parts))
        else:
            for rows in parts:
                function(given[rows], out[rows])


@lru_cache(maxsize=1)
def _blas() -> ThreadpoolController:
    return ThreadpoolController()


def _workers() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@lru_cache(maxsize=1)
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(_workers(), "wrf-mi-operator")


class Images:
    """Complex images that add up to a spectrum: R = sum_k c_k image_k.

    Real and imaginary parts are products of one real matrix, a fifth faster than a complex product.

    Args:
        images: [K, height * width].
        height: rows.
        width: columns.
    """

    def __init__(self, images: ArrayLike, height: int, width: int) -> None:
        values = np.asarray(images)
        self.table: NDArray[Any] = np.concatenate([values.real, values.imag])
        self.height, self.width = height, width

    @property
    def kind(self) -> np.dtype[Any]:
        """Complex type of the result."""
        return np.result_type(self.table.dtype, np.complex64)

    def rows(self, coefficients: NDArray[Any]) -> NDArray[Any]:
        """Rows whose product with ``table`` are the real parts of R, then the imaginary ones, [2 * batch, ...]."""
        re, im = coefficients.real, coefficients.imag
        return np.block([[re, -im], [im, re]])

    def _parts(self, coefficients: ArrayLike) -> NDArray[Any]:
        rows = self.rows(np.asarray(coefficients, self.kind))
        # Of one transmitter, two products with a vector: OpenBLAS takes 1.7 times as long for a matrix of two rows.
        both: NDArray[Any] = np.stack([row @ self.table for row in rows]) if len(rows) == 2 else rows @ self.table
        return both

    def field(self, coefficients: ArrayLike) -> ComplexArray:
        """R [batch, height * width] of coefficients [batch, K]."""
        both = self._parts(coefficients)
        field: ComplexArray = both[: len(both) // 2] + self.kind.type(1j) * both[len(both) // 2 :]
        return field

    def power(self, coefficients: NDArray[Any], out: NDArray[Any]) -> None:
        """Write |R|^2 into ``out``, [batch, height * width]."""
        both = self._parts(coefficients)
        np.multiply(both, both, out=both)
        np.add(both[: len(out)], both[len(out) :], out=out)

    def magnitude(self, coefficients: ArrayLike, dark: float = 0.0, scale: bool = False) -> NDArray[Any]:
        """Spectra sqrt(|R|^2 + dark), [batch, height, width].

        Args:
            coefficients: [batch, K].
            dark: added to squares.
            scale: each spectrum to its own minimum and maximum, as `wrf_mi.receivers.minmax_scale`.
        """
        return magnitudes(self, coefficients, dark, scale)


class PixelOperator:
    """From signals to the perception plane through sparse weights.

    Args:
        weights: [pixels, n], see `pixel_weights`.
        height: rows of the plane.
        width: columns.
    """

    def __init__(self, weights: csr_array, height: int, width: int) -> None:
        self.weights, self.height, self.width = weights, height, width

    @classmethod
    def of(cls, gaussians: Gaussians, pose: Pose, plane: Plane) -> PixelOperator:
        """The operator of Gaussians that stand still, as one receiver sees them; see `weight_strips`."""
        return cls(pixel_weights(gaussians, pose, plane), plane.height, plane.width)

    @property
    def nbytes(self) -> int:
        """Memory of the weights."""
        w = self.weights
        return w.data.nbytes + w.indices.nbytes + w.indptr.nbytes

    @property
    def kind(self) -> np.dtype[Any]:
        """Complex type of the result."""
        return np.result_type(self.weights.dtype, np.complex64)

    def field(self, signals: ArrayLike) -> ComplexArray:
        """R [batch, height * width] of complex signals [batch, n]."""
        columns = np.asarray(signals, self.kind).T
        # One column as a vector: SciPy's product with a matrix of one column takes twice as long.
        whole = (self.weights @ columns[:, 0])[None] if columns.shape[1] == 1 else (self.weights @ columns).T
        return np.ascontiguousarray(whole)

    def power(self, signals: NDArray[Any], out: NDArray[Any]) -> None:
        """Write |R|^2 into ``out``, [batch, height * width]."""
        pairs = self.field(signals).view(out.dtype)
        np.multiply(pairs, pairs, out=pairs)
        np.add(pairs[:, ::2], pairs[:, 1::2], out=out)

    def magnitude(self, signals: ArrayLike, dark: float = 0.0, scale: bool = False) -> NDArray[Any]:
        """Spectra [batch, height, width] of complex signals [batch, n], as `Images.magnitude`."""
        return magnitudes(self, signals, dark, scale)

    def composed(self, factors: ArrayLike) -> Images:
        """The images [K, pixels] of signals S = C c, for factors C [n, K]."""
        return Images((self.weights @ np.asarray(factors, self.kind)).T, self.height, self.width)


def magnitudes(of: Images | PixelOperator, given: ArrayLike, dark: float, scale: bool) -> NDArray[Any]:
    """What `Images.magnitude` says, of either."""
    rows = np.asarray(given)
    single = of.kind == np.complex64
    out = np.empty((len(rows), of.height * of.width), np.float32 if single else np.float64)

    def block(part: NDArray[Any], to: NDArray[Any]) -> None:
        of.power(part, to)
        if dark:
            to += to.dtype.type(dark)
        np.sqrt(to, out=to)
        if scale:
            low = to.min(axis=1, keepdims=True)
            span = to.max(axis=1, keepdims=True) - low
            to -= low
            to *= np.divide(1, span, out=np.zeros_like(span), where=span > 0)

    in_blocks(block, rows, out)
    return out.reshape(len(rows), of.height, of.width)
