"""The linear map from the Gaussians' signals to the perception plane, for Gaussians of static geometry.

Blending (`wrf_mi.gaussians.blend`) is a sum R(u) = sum_i w_i T_i S_i whose weights w_i T_i depend on geometry and
attenuation alone. Where those are common to all transmitters, the weights are a sparse matrix B [pixels, n], real
under alpha and complex under product blending, and a spectrum is one product, R = B S. The weights come from one walk
over the tiles' lists, front to back, with the arithmetic of blending: only the order of the last sum differs.

Where signals are S = C phi(transmitter) with K terms, the images B C are dense [K, pixels] and the cost does not
depend on the number of Gaussians. Products are SciPy's (sparse) and NumPy's (dense).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any, cast

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array, vstack

from ..backend.device import Recorded, on_device, to_tensor
from ..backend.vectors import Complex, Pose
from ..core import InputError
from ..parallel.threads import one_blas_thread, processors
from .blend import along_azimuth, columns_of, footprint_at, pack, read
from .fields import Factorised, WrfGs
from .footprint import Footprints, depth_order, project
from .network import dense, linear
from .parameters import Gaussians
from .recurrence import forward_step
from .tiles import LANE_ROWS, LANES, TILE_COLUMNS, TILE_ROWS, TiledPlane, TileLists, build_lists

ComplexArray = NDArray[np.complexfloating[Any, Any]]

MOST_IN_STRIP = 2**32 - 1  # largest number of entries of one row of tiles
BLOCK = 16  # transmitters at once: 4 MB of complex numbers for 360 x 90 directions, which stay in the cache
PAIRS_PER_CHUNK = 1 << 15  # pairs of Gaussian and transmitter at once: 16 MB of a layer of 128

Coefficients = Callable[[NDArray[np.float32]], NDArray[np.complex64]]  # of transmitters [m, 3], metres: [m, K or n]


def _strips(plane: TiledPlane) -> Iterator[tuple[TiledPlane, int, int]]:
    """The plane cut into rows of tiles, each as a plane with its first pixel and their number."""
    # Pixels keep their numbers in the whole. The memory beside the result therefore does not grow with the rows.
    across = -(-plane.width // TILE_COLUMNS)
    index_type: Any = type(plane.tile)
    for first in range(0, plane.tiles, across):
        tiles = dr.arange(index_type, across) + first
        lanes = dr.arange(index_type, across * LANES) + first * LANES

        def at(index: Any, array: Any) -> Any:
            return dr.gather(type(array), array, index)

        strip = replace(
            plane,
            tile=at(lanes, plane.tile) - first,
            azimuth=[at(lanes, a) for a in plane.azimuth],
            elevation=[[at(lanes, c) for c in e] for e in plane.elevation],
            pixel=[at(lanes, p) for p in plane.pixel],
            active=[at(lanes, a) for a in plane.active],
            tile_row=at(tiles, plane.tile_row),
            tile_column=at(tiles, plane.tile_column),
        )
        row = first // across * TILE_ROWS
        dr.eval(strip)
        yield strip, row * plane.width, (min(row + TILE_ROWS, plane.height) - row) * plane.width


def _footprints(record: list[Any], strip: TiledPlane) -> list[Any]:
    along = along_azimuth(record, strip.azimuth)
    return [footprint_at(along, elevation)[0] for elevation in strip.elevation]


def _counted(counts: list[Any], footprints: list[Any]) -> list[Any]:
    return [s + dr.select(g > 0, type(s)(1), type(s)(0)) for s, g in zip(counts, footprints, strict=True)]


@dr.syntax
def _count(table: Any, lists: TileLists, strip: TiledPlane, n: int) -> list[Any]:
    """Number of Gaussians that each pixel of a lane sees."""
    index_type = type(lists.index)
    j, start, end = index_type(0), lists.begin(strip.tile, n), dr.gather(index_type, lists.length, strip.tile)
    counts = [dr.zeros(index_type, dr.width(strip.tile)) for _ in range(LANE_ROWS)]
    while j < end:
        counts = _counted(counts, _footprints(read(table, dr.gather(index_type, lists.index, start + j), 9), strip))
        j += 1
    dr.eval(counts)
    return counts


def _store(
    record: list[Any], i: Any, strip: TiledPlane, slots: list[Any], t: list[Complex], out: tuple[Any, ...]
) -> tuple[list[Any], list[Complex]]:
    """Write one Gaussian's weight at each pixel of a lane that sees it; next slots and T behind the Gaussian."""
    next_slots, behind = [], []
    for g, active, slot, before in zip(_footprints(record, strip), strip.active, slots, t, strict=True):
        hit = (g > 0) & active
        weight, after = forward_step(record[9:], g, before)
        for array, value in zip(out, (i, *weight), strict=True):
            dr.scatter(array, value, slot, hit)
        # The entries of a pixel are consecutive: the next Gaussian that it sees goes to the next slot.
        next_slots.append(dr.select(hit, slot + 1, slot))
        behind.append(after)
    return next_slots, behind


@dr.syntax
def _fill(
    table: Any, lists: TileLists, strip: TiledPlane, n: int, fields: int, slots: list[Any], out: tuple[Any, ...]
) -> None:
    """Fill ``out``: Gaussian of each entry and its weight; ``slots`` are the first entries of each pixel of a lane."""
    float_type, index_type = type(table), type(lists.index)
    j, start, end = index_type(0), lists.begin(strip.tile, n), dr.gather(index_type, lists.length, strip.tile)
    t = [(float_type(1), float_type(0)) for _ in slots]
    while j < end:
        i = dr.gather(index_type, lists.index, start + j)
        slots, t = _store(read(table, i, fields), i, strip, slots, t, out)
        j += 1
    dr.eval(out)


def _weights(
    table: Any, fields: int, footprints: Footprints, order: Any, strip: TiledPlane, first: int, count: int
) -> csr_array:
    """Weights [count, n] of one row of tiles."""
    n = dr.width(order)
    index_type: Any = type(order)
    lists = build_lists(footprints, order, strip, 1)
    entries = dr.zeros(index_type, count)
    for k, visible_count in enumerate(_count(table, lists, strip, n)):
        dr.scatter(entries, visible_count, strip.pixel[k] - first, strip.active[k])
    # Counted before they are stored, as a compressed sparse row matrix needs the begin of each pixel's entries; on the
    # host in 64 bits, as a sum in 32 bits would wrap around unnoticed.
    start: NDArray[np.int64] = np.concatenate([[0], np.cumsum(entries.numpy(), dtype=np.int64)])
    total = int(start[-1])
    if total > MOST_IN_STRIP:
        raise InputError(f"operator: {total} weights in one row of tiles; use fewer or smaller Gaussians")
    begin = on_device(start[:-1], index_type)
    slots = [dr.gather(index_type, begin, p - first) for p in strip.pixel]
    # Dr.Jit needs at least one entry, which an empty matrix does not read.
    room = max(total, 1)
    out = (dr.empty(index_type, room), *(dr.empty(type(table), room) for _ in range(fields - 9)))
    dr.eval(out)
    _fill(table, lists, strip, n, fields, slots, out)
    values: NDArray[Any] = out[1].numpy()[:total]
    # Alpha blending has real weights, product blending complex ones.
    if len(out) == 3:
        values = values + np.asarray(1j, np.result_type(values, np.complex64)) * out[2].numpy()[:total]
    return csr_array((values, out[0].numpy()[:total].astype(np.int32), start), shape=(count, n))


def pixel_weights(gaussians: Gaussians, pose: Pose, plane: TiledPlane, most_bytes: float = np.inf) -> csr_array:
    """The weights of Gaussians for one transmitter on the perception plane, one row of tiles after the other.

    Returns a matrix [pixels, n]: float32 or float64 under alpha blending, complex under product blending. Entries of a
    row are ordered from near to far. `ValueError` for several transmitters, `InputError` for more entries in a row of
    tiles than 32 bits count, `MemoryError` for more than ``most_bytes``, after the row of tiles with which they are.
    """
    if gaussians.batch != 1:
        raise ValueError(f"weights: Gaussians for {gaussians.batch} transmitters; give those of one")
    if not gaussians.count:
        double = type(gaussians.position[0]) is not dr.float32_array_t(type(gaussians.position[0]))
        real, product = (np.float64, np.complex128) if double else (np.float32, np.complex64)
        return csr_array((plane.pixels, 0), dtype=real if gaussians.attenuation is None else product)
    parts, size = [], 0
    with dr.suspend_grad():
        footprints = project(gaussians, pose)
        order = depth_order(footprints.depth, gaussians.position)
        columns = columns_of(footprints, gaussians.blending)
        table = pack(columns)
        dr.eval(table, footprints, order)
        for strip, first, count in _strips(plane):
            parts.append(_weights(table, len(columns), footprints, order, strip, first, count))
            size += parts[-1].data.nbytes + parts[-1].nnz * np.dtype(np.int32).itemsize
            # Checked strip by strip: what does not fit is refused before it fills the memory.
            if size > most_bytes:
                raise MemoryError(f"weights of {gaussians.count} Gaussians take more than {most_bytes / 1e6:.0f} MB")
    matrix = csr_array(vstack(parts, format="csr"))
    if matrix.nnz < 2**31:
        # SciPy keeps indices of 64 bits where it is given those: twice the memory and time.
        matrix.indices, matrix.indptr = matrix.indices.astype(np.int32), matrix.indptr.astype(np.int32)
    return matrix


_POOL = ThreadPoolExecutor(processors(), "wrf-mi-operator")  # without a thread until its first use


class _Operator(ABC):
    """A linear map from complex numbers [batch, K] to the pixels of an image."""

    kind: np.dtype[Any]
    """Complex type of the result."""
    height: int
    width: int

    @abstractmethod
    def power(self, signals: NDArray[Any], out: NDArray[Any]) -> None:
        """Write |R|^2 into ``out``, [batch, height * width]."""

    def magnitude(self, signals: ArrayLike, dark: float = 0.0) -> NDArray[Any]:
        """Spectra sqrt(|R|^2 + dark), [batch, height, width], of complex numbers [batch, K]."""
        # Blocks of `BLOCK` spectra are computed on all processors, their products on one thread each: threads of the
        # BLAS wait for each other by spinning, and where a processor is busy otherwise a product of 0.1 ms then takes
        # 16 ms.
        rows = np.asarray(signals)
        single = self.kind == np.complex64
        out = np.empty((len(rows), self.height * self.width), np.float32 if single else np.float64)

        def compute(first: int) -> None:
            to = out[first : first + BLOCK]
            self.power(rows[first : first + BLOCK], to)
            if dark:
                to += to.dtype.type(dark)
            np.sqrt(to, out=to)

        blocks = range(0, len(rows), BLOCK)
        with one_blas_thread():
            list(_POOL.map(compute, blocks) if len(blocks) > 1 and processors() > 1 else map(compute, blocks))
        return out.reshape(len(rows), self.height, self.width)


class Images(_Operator):
    """Complex images [K, height * width] that add up to a spectrum: R = sum_k c_k image_k."""

    # Real and imaginary parts are products of one real matrix, a fifth faster than a complex product.

    def __init__(self, images: ArrayLike, height: int, width: int) -> None:
        values = np.asarray(images)
        self.table: NDArray[Any] = np.concatenate([values.real, values.imag])
        self.kind, self.height, self.width = np.result_type(self.table.dtype, np.complex64), height, width

    def power(self, signals: NDArray[Any], out: NDArray[Any]) -> None:
        """Write |R|^2 into ``out``, [batch, height * width]."""
        c = np.asarray(signals, self.kind)
        # The product of these rows are the real parts of R, then the imaginary ones.
        rows = np.block([[c.real, -c.imag], [c.imag, c.real]])
        # For one transmitter two products with a vector: OpenBLAS takes 1.7 times as long for a matrix of two rows.
        both: NDArray[Any] = np.stack([row @ self.table for row in rows]) if len(rows) == 2 else rows @ self.table
        np.multiply(both, both, out=both)
        np.add(both[: len(out)], both[len(out) :], out=out)


class PixelOperator(_Operator):
    """Map from signals [batch, n] to the perception plane by sparse weights [pixels, n] (`pixel_weights`)."""

    def __init__(self, weights: csr_array, height: int, width: int) -> None:
        self.weights, self.height, self.width = weights, height, width
        self.kind = np.result_type(weights.dtype, np.complex64)

    def field(self, signals: ArrayLike) -> ComplexArray:
        """R [batch, height * width] of complex signals [batch, n]."""
        columns = np.asarray(signals, self.kind).T
        # One column as a vector: SciPy's product with a matrix of one column takes twice as long.
        fields = (self.weights @ columns[:, 0])[None] if columns.shape[1] == 1 else (self.weights @ columns).T
        return np.ascontiguousarray(fields)

    def power(self, signals: NDArray[Any], out: NDArray[Any]) -> None:
        """Write |R|^2 into ``out``, [batch, height * width]."""
        pairs = self.field(signals).view(out.dtype)
        np.multiply(pairs, pairs, out=pairs)
        np.add(pairs[:, ::2], pairs[:, 1::2], out=out)

    def composed(self, factors: ArrayLike) -> Images:
        """The images [K, pixels] of signals S = C c, for factors C [n, K]."""
        return Images((self.weights @ np.asarray(factors, self.kind)).T, self.height, self.width)


def static_signals(field: Any, params: Mapping[str, Any]) -> tuple[NDArray[np.complex64] | None, Coefficients]:
    """Signals S = C c of a field: factors C [n, K], or None where the coefficients are the signals, and c."""
    # Other classes, subclasses included, may compute signals otherwise; theirs are `recorded_signals`.
    # In NumPy: the start of a recorded Dr.Jit function takes longer than these small products.
    if type(field) is Factorised:
        factors, functions = _complex(params["signal"].reshape(2, field.terms, -1)).T, cast(Any, field.functions)
        return factors, lambda tx_pos_m: _complex(functions(params, tx_pos_m.T).reshape(2, field.terms, -1)).T
    return None, (_wrf_gs_signals if type(field) is WrfGs else recorded_signals)(field, params)


def _complex(pair: Any) -> Any:
    return pair[0] + np.complex64(1j) * pair[1]


def _wrf_gs_signals(field: Any, params: Mapping[str, Any]) -> Coefficients:
    # The part of the second network's first layer that depends on the Gaussians alone is computed once.
    products: Any = linear(params, "signal.0", field.features(params), "feature")
    count = products.shape[1]

    def coefficients(tx_pos_m: Any) -> NDArray[np.complex64]:
        out, step = np.empty((len(tx_pos_m), count), np.complex64), max(1, PAIRS_PER_CHUNK // count)
        for first in range(0, len(tx_pos_m), step):
            encoded = field.encoding.transmitter(tx_pos_m[first : first + step].T)
            hidden = products[None]
            if len(encoded):  # without octaves there is no matrix
                hidden = hidden + (params["signal.0.transmitter"] @ encoded).T[:, :, None]
            pair: Any = linear(params, "signal.out", dense(params, "signal.1", np.maximum(hidden, 0)))
            out[first : first + step] = _complex(pair.swapaxes(0, 1))
        return out

    return coefficients


def recorded_signals(field: Any, params: Mapping[str, Any]) -> Coefficients:
    """Signals [m, n] of transmitters [m, 3] by the field's Dr.Jit function, recorded, one transmitter at a time."""
    tensors = {name: to_tensor(values) for name, values in params.items()}

    @Recorded
    def signals(params: Mapping[str, Any], tx_pos: Any) -> Any:
        with dr.suspend_grad():
            return field.gaussians(params, tx_pos).signal

    def coefficients(tx_pos_m: Any) -> NDArray[np.complex64]:
        per_transmitter = (signals(tensors, to_tensor(position[:, None])) for position in tx_pos_m)
        return np.stack([_complex([part.numpy() for part in pair]) for pair in per_transmitter])

    return coefficients
