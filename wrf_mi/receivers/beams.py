"""Bartlett beams of an array in every pixel of a spectrum, in chunks of directions.

The beam former sum_m h_m exp(-j theta_m), theta_m = k p_m . u, uses real tables of cos theta and sin theta:

- Elements at p and -p (about the array's centre) share one row: h e^(-j theta) + h' e^(j theta) =
  (h + h') cos theta - j (h - h') sin theta.
- For a planar array opposite azimuths have opposite phases: the cosine sum is equal there and the sine sum changes
  sign, so both are computed for half of the circle.
- For a regular planar array, the product of two lines of elements a and b, exp(-j k (a + b) . u) factorises: two small
  tables, and two sums.

Phases are relative to the array's centre, which leaves magnitudes unchanged. Everything is double precision. Products
take `CHUNK_SIZE` bytes at once; the tables of `KEPT_ARRAYS` arrays are kept from call to call, `TABLE_BYTES` of each
at most: larger ones are recomputed for each chunk.

Source: Van Trees, "Optimum Array Processing" (2002), sections 2.4 and 6.2 (conjugate symmetric and planar arrays).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.constants import speed_of_light
from scipy.spatial.distance import cdist

from ..core.angles import FloatArray, azimuth_rad, elevation_rad, unit_vectors
from ..core.types import IntArray

ComplexArray = NDArray[np.complex128]

DIRECTIONS = 4096
"""Directions in a chunk: one transmitter's products then stay in a core's own cache."""
CHUNK_SIZE = 1 << 20
"""Bytes of products at once, or those of one transmitter if that is more."""
TABLE_BYTES = 1 << 25
"""Largest tables that are kept; 360 x 90 directions of a 4 x 4 array take 2 MB, of 32 x 32 elements 8 MB."""
KEPT_ARRAYS = 4
LINES_FROM = 64
"""Number of elements from which a regular array is summed line by line; a small table is faster in one product."""
SAME = 1e-12
"""Share of the array's extent within which positions are equal: rounding of double precision."""


def mirror_order(elements_m: ArrayLike, tolerance: float = 1e-6) -> IntArray | None:
    """Index of the element opposite to each through the array's centre, [m]; None where an element has no opposite.

    Args:
        elements_m: [m, 3], or [m, 1] on a line.
        tolerance: distance from the opposite position, as a share of the extent.
    """
    elements = np.asarray(elements_m, float)
    centre = elements.mean(axis=0)
    distance = cdist(2 * centre - elements, elements)
    opposite = distance.argmin(axis=1)
    extent = max(float(np.ptp(elements, axis=0).max()), np.finfo(float).tiny)
    return opposite if distance.min(axis=1).max() < tolerance * extent else None


class _Line:
    """Tables of cosines and sines of elements [m, 3], a row for each mirrored pair or element without a partner."""

    def __init__(self, elements_m: FloatArray) -> None:
        everything = np.arange(len(elements_m))
        opposite = mirror_order(elements_m, SAME) if len(elements_m) > 1 else None
        # Elements at one position have the same opposite element: no pairs.
        mirrored = opposite is not None and (opposite[opposite] == everything).all()
        partner = opposite if opposite is not None and mirrored else everything
        self._first = np.flatnonzero(everything <= partner)
        self._second, self._paired = partner[self._first], partner[self._first] != self._first
        self._centred = (elements_m - elements_m.mean(axis=0))[self._first]
        self.elements, self.rows = len(elements_m), len(self._first)

    def fold(self, signals: ComplexArray) -> ComplexArray:
        """Coefficients [2, ..., rows] of the cosines and sines for signals [..., m]."""
        first, second = signals[..., self._first], signals[..., self._second] * self._paired
        return np.stack([first + second, -1j * (first - second)])

    def tables(self, directions: FloatArray, wavenumber: float) -> FloatArray:
        """Cosines and sines [2, rows, d] for unit vectors [d, 3]."""
        phase = wavenumber * (self._centred @ directions.T)
        return np.stack([np.cos(phase), np.sin(phase)])


def _lines(elements_m: FloatArray) -> tuple[list[_Line], IntArray]:
    """Two lines whose sums are the elements, else one of all elements; and the order that makes a grid of them."""
    whole = [_Line(elements_m)], np.arange(len(elements_m))
    grain = SAME * max(float(np.ptp(elements_m, axis=0).max()), np.finfo(float).tiny)
    if len(elements_m) < LINES_FROM or np.ptp(elements_m[:, 2]) > grain:
        return whole
    ordered = [np.sort(column) for column in elements_m[:, :2].T]
    values = [column[np.diff(column, prepend=-np.inf) > grain] for column in ordered]
    index = [np.abs(elements_m[:, axis, None] - values[axis]).argmin(axis=1) for axis in range(2)]
    number = index[0] * len(values[1]) + index[1]
    if min(map(len, values)) < 2 or not len(elements_m) == len(values[0]) * len(values[1]) == len(np.unique(number)):
        return whole
    return [_Line(values[axis][:, None] * np.eye(3)[axis]) for axis in range(2)], np.argsort(number)


class Beams:
    """The beam former of one array on one grid of directions.

    Args:
        elements_m: [m, 3] in the array's frame, metres.
        frequency_hz: carrier frequency.
        height: elevations over the upper hemisphere.
        width: azimuths over the full circle.
        table_bytes: largest tables that are kept from one call to the next.
    """

    def __init__(
        self, elements_m: FloatArray, frequency_hz: float, height: int, width: int, table_bytes: int = TABLE_BYTES
    ) -> None:
        self._lines, self._order = _lines(elements_m)
        self._wavenumber = 2 * np.pi * frequency_hz / speed_of_light
        self.height, self.width = height, width
        self._halved = float(np.ptp(elements_m[:, 2])) == 0 and width % 2 == 0
        self._columns = width // 2 if self._halved else width
        size = 2 * 8 * sum(line.rows for line in self._lines) * height * self._columns
        self._kept = self._tables(0, height) if size <= table_bytes else None

    @property
    def size(self) -> int:
        """Bytes of the tables that are kept."""
        return sum(table.nbytes for table in self._kept or ())

    def _tables(self, begin: int, end: int) -> list[FloatArray]:
        azimuth, elevation = azimuth_rad(self.width)[: self._columns], elevation_rad(self.height)[begin:end]
        directions = unit_vectors(azimuth, elevation[:, None]).reshape(-1, 3)
        return [line.tables(directions, self._wavenumber) for line in self._lines]

    def magnitude(
        self, signals: ComplexArray, directions: int = DIRECTIONS, chunk_size: int = CHUNK_SIZE
    ) -> FloatArray:
        """Magnitudes [n, height, width] of complex element signals [n, m].

        Args:
            signals: element signals of each transmitter.
            directions: directions in a chunk, one elevation's at least.
            chunk_size: bytes of a chunk's products, at least those of one transmitter.
        """
        out = np.empty((len(signals), self.height, self.width))
        folded = self._folded(signals)
        second = folded.shape[3]
        # A single vector times a whole table is one pass over it; chunks of it would be as many calls.
        whole = self._kept is not None and len(signals) == second == 1
        step = self.height if whole else min(max(directions // self._columns, 1), self.height)
        size = 2 * second * step * self._columns
        batch = max(min(chunk_size // (8 * size), len(signals)), 1)
        # One buffer for all chunks: the system clears every page of memory that is allocated anew.
        work = np.empty((3, batch * size))
        for begin in range(0, self.height, step):
            end = min(begin + step, self.height)
            if self._kept is None:
                tables = self._tables(begin, end)
            else:
                tables = [table[..., begin * self._columns : end * self._columns] for table in self._kept]
            for first in range(0, len(signals), batch):
                some = slice(first, first + batch)
                self._write(folded[:, some], tables, work, out[some, begin:end])
        return out

    def _folded(self, signals: ComplexArray) -> FloatArray:
        """Coefficients [2, n, 2, s, rows]: cosine or sine of the first line, transmitter, real or imaginary part.

        Axis s holds cosines and sines of the second line, a single number without one.
        """
        count, coefficients = len(signals), signals[:, None]
        if len(self._lines) == 2:
            grid = signals[:, self._order].reshape(count, *(line.elements for line in self._lines))
            second = self._lines[1].fold(grid).transpose(1, 0, 3, 2)
            coefficients = second.reshape(count, -1, second.shape[-1])
        folded = self._lines[0].fold(coefficients)
        return np.stack([folded.real, folded.imag], axis=2)

    def _write(self, folded: FloatArray, tables: list[FloatArray], work: FloatArray, out: FloatArray) -> None:
        """Magnitudes [n, rows, width] in ``out``."""
        even, odd = (_times(*pair) for pair in zip(folded, tables[0], work[:2], strict=True))
        if len(tables) == 2:
            # Cosine times cosine and sine times sine are even in the phase.
            rows = self._lines[1].rows
            cosines, sines = ((part[:, :, :rows], part[:, :, rows:]) for part in (even, odd))
            even, odd = (
                sum(np.einsum("npbd,bd->npd", part, table) for part, table in zip(parts, tables[1], strict=True))
                for parts in ((cosines[0], sines[1]), (sines[0], cosines[1]))
            )
        shape = len(out), 2, out.shape[1], self._columns
        even, odd = even.reshape(shape), odd.reshape(shape)
        if self._halved:
            _magnitude(np.subtract(even, odd, out=work[2, : even.size].reshape(shape)), out[..., self._columns :])
        _magnitude(np.add(even, odd, out=even), out[..., : self._columns])


def _times(parts: FloatArray, table: FloatArray, work: FloatArray) -> FloatArray:
    """Products [n, 2, s, d] of coefficients [n, 2, s, rows] and a table [rows, d], in ``work``."""
    rows = parts.reshape(-1, parts.shape[-1])
    product = work[: len(rows) * table.shape[1]].reshape(len(rows), -1)
    # Two products with a vector: OpenBLAS takes 1.4 times as long for a matrix of two rows.
    for some in range(2) if len(rows) == 2 else (slice(None),):
        np.matmul(rows[some], table, out=product[some])
    return product.reshape(*parts.shape[:-1], -1)


def _magnitude(field: FloatArray, out: FloatArray) -> None:
    """Magnitudes of real and imaginary parts [n, 2, rows, columns], which are overwritten."""
    np.square(field, out=field)
    np.add(field[:, 0], field[:, 1], out=out)
    np.sqrt(out, out=out)


@lru_cache(KEPT_ARRAYS)
def _beams(elements: bytes, frequency_hz: float, height: int, width: int) -> Beams:
    return Beams(np.frombuffer(elements).reshape(-1, 3), frequency_hz, height, width)


def beams(elements_m: ArrayLike, frequency_hz: float, height: int, width: int) -> Beams:
    """The beam former of an array, whose tables are kept for the next call: see `Beams`."""
    return _beams(np.asarray(elements_m, float).tobytes(), float(frequency_hz), height, width)
