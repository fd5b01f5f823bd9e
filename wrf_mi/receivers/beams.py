"""Bartlett beams of an array in every pixel of a spectrum, in chunks of directions.

The beam former sum_m h_m exp(-j k p_m . u) takes all elements in all directions, but most of it repeats:

- An array that is its own mirror image through its centre has elements in pairs p, -p. With theta = k p . u,
  h e^(-j theta) + h' e^(j theta) = (h + h') cos theta - j (h - h') sin theta: real factors, half of the products.
- In a plane, opposite azimuths have opposite phases: what is even in theta is the same there, what is odd changes sign.
  So sums are made for half of the circle, even and odd parts apart.
- A product of two such lines of elements (every regular planar array) has the steering vectors of the product,
  exp(-j k (a + b) . u): two small tables in place of a large one, and two sums, over the one line and then the other.

Phases are those to the array's centre, wherever its origin is: magnitudes are the same. Double precision throughout,
nothing is approximated. What is at work at once is bounded by `CHUNK_SIZE`, the tables that are kept from call to
call by `KEPT` in all: larger ones are made anew for each chunk.

Source: Van Trees, "Optimum Array Processing" (2002), sections 2.4 and 6.2 (conjugate symmetric and planar arrays).
"""

from __future__ import annotations

from collections import OrderedDict

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.constants import speed_of_light
from scipy.spatial.distance import cdist

from ..core.angles import FloatArray, azimuth_rad, elevation_rad, unit_vectors

ComplexArray = NDArray[np.complex128]

DIRECTIONS = 4096
"""In a chunk: what belongs to one transmitter then stays in a core's own cache."""
CHUNK_SIZE = 1 << 20
"""Bytes of products at once, unless one transmitter takes more."""
KEPT = 1 << 27
"""Bytes of all tables that are kept; 360 x 90 directions of a 4 x 4 array take 2 MB, of 32 x 32 elements 8 MB."""
LINES_FROM = 64
"""Elements from which the product of two lines is summed line by line; a small table is faster in one product."""
SAME = 1e-12
"""Positions closer than this share of the array's extent are one: rounding of double precision, and nothing more."""


def mirror_order(elements_m: ArrayLike, tolerance: float = 1e-6) -> NDArray[np.int64] | None:
    """Which element lies opposite to each through the array's centre, [m]; None where one has no opposite.

    Args:
        elements_m: [m, 3], or [m, 1] on a line.
        tolerance: of the opposite place, as a share of the extent.
    """
    elements = np.asarray(elements_m, float)
    centre = elements.mean(axis=0)
    distance = cdist(2 * centre - elements, elements)
    opposite = distance.argmin(axis=1)
    extent = max(float(np.ptp(elements, axis=0).max()), np.finfo(float).tiny)
    return opposite if distance.min(axis=1).max() < tolerance * extent else None


class _Line:
    """Elements whose steering vectors have two tables of real numbers, even and odd in the phase.

    Args:
        elements_m: [m, 3], or of a line of a product its part in the sum.
    """

    def __init__(self, elements_m: FloatArray) -> None:
        self.elements, self._centred = len(elements_m), elements_m - elements_m.mean(axis=0)
        own = np.arange(len(elements_m))
        opposite = mirror_order(elements_m, SAME) if len(own) > 1 else own
        # Elements at one place have the same one opposite: no pairs.
        self._opposite = opposite if opposite is not None and (opposite[opposite] == own).all() else None
        if self._opposite is not None:
            self._first, self._alone = np.flatnonzero(own < self._opposite), np.flatnonzero(own == self._opposite)

    @property
    def mirrored(self) -> bool:
        """Whether it is its own mirror image; else the even table has all rows."""
        return self._opposite is not None

    @property
    def even(self) -> int:
        """Rows of the even table."""
        return 2 * self.elements if self._opposite is None else len(self._alone) + len(self._first)

    @property
    def rows(self) -> int:
        """Of both tables."""
        return self.elements * (1 if self.mirrored else 2)

    def fold(self, signals: ComplexArray) -> ComplexArray:
        """What the tables' rows are multiplied with, [..., rows], of signals [..., m]."""
        if self._opposite is None:
            return np.concatenate([signals, -1j * signals], axis=-1)
        own, other = signals[..., self._first], signals[..., self._opposite[self._first]]
        return np.concatenate([signals[..., self._alone], own + other, -1j * (own - other)], axis=-1)

    def tables(self, directions: FloatArray, wavenumber: float) -> tuple[FloatArray, FloatArray]:
        """Of unit vectors [d, 3]: [even, d] and [rows - even, d]."""
        if self._opposite is None:
            phase = wavenumber * (self._centred @ directions.T)
            return np.concatenate([np.cos(phase), np.sin(phase)]), np.zeros((0, len(directions)))
        phase = wavenumber * (self._centred[self._first] @ directions.T)
        return np.concatenate([np.ones((len(self._alone), len(directions))), np.cos(phase)]), np.sin(phase)


def _lines(elements_m: FloatArray) -> tuple[list[_Line], NDArray[np.int64]]:
    """Two lines whose sums are the elements, else all elements as one; and the order that makes a grid of them."""
    whole = [_Line(elements_m)], np.arange(len(elements_m))
    if len(elements_m) < LINES_FROM:
        return whole
    grain = SAME * max(float(np.ptp(elements_m, axis=0).max()), np.finfo(float).tiny)
    order, axes = list[NDArray[np.int64]](), list[FloatArray]()
    for axis in range(2):
        sorted_ = np.sort(elements_m[:, axis])
        values = sorted_[np.concatenate([[True], np.diff(sorted_) > grain])]
        order.append(np.abs(elements_m[:, axis, None] - values).argmin(axis=1))
        axes.append(values)
    number = order[0] * len(axes[1]) + order[1]
    regular = len(elements_m) == len(axes[0]) * len(axes[1]) == len(np.unique(number))
    if not regular or np.ptp(elements_m[:, 2]) > grain or min(map(len, axes)) < 2:
        return whole
    lines = [_Line(values[:, None] * np.eye(3)[axis]) for axis, values in enumerate(axes)]
    return (lines, np.argsort(number)) if all(line.mirrored for line in lines) else whole


class Beams:
    """The beam former of one array on one grid of directions.

    Args:
        elements_m: [m, 3] in the array's frame, metres.
        frequency_hz: of the carrier.
        height: elevations over the upper hemisphere.
        width: azimuths over the full circle.
        kept: bytes of tables that may be kept from one call to the next.
    """

    def __init__(self, elements_m: FloatArray, frequency_hz: float, height: int, width: int, kept: int = KEPT) -> None:
        self._lines, self._order = _lines(elements_m)
        self._wavenumber = 2 * np.pi * frequency_hz / speed_of_light
        self.height, self.width = height, width
        planar = float(np.ptp(elements_m[:, 2])) == 0
        self._halved = planar and width % 2 == 0 and all(line.mirrored for line in self._lines)
        self._columns = width // 2 if self._halved else width
        size = 8 * sum(line.rows for line in self._lines) * height * self._columns
        self._tables = self._made(0, height) if size <= kept else None

    @property
    def size(self) -> int:
        """Bytes that are kept."""
        return sum(table.nbytes for line in self._tables or () for table in line)

    def _made(self, begin: int, end: int) -> list[tuple[FloatArray, FloatArray]]:
        azimuth, elevation = azimuth_rad(self.width)[: self._columns], elevation_rad(self.height)[begin:end]
        directions = unit_vectors(azimuth, elevation[:, None]).reshape(-1, 3)
        return [line.tables(directions, self._wavenumber) for line in self._lines]

    def magnitude(self, signals: ComplexArray, directions: int = DIRECTIONS, at_once: int = CHUNK_SIZE) -> FloatArray:
        """Magnitudes [n, height, width] of complex element signals [n, m].

        Args:
            signals: of each transmitter.
            directions: in a chunk, one elevation's at least.
            at_once: bytes of a chunk's products, at least those of one transmitter.
        """
        out = np.empty((len(signals), self.height, self.width))
        parts = self._parts(signals)
        # A single vector times a whole table is one pass over it; chunks of it would be as many calls.
        whole = self._tables is not None and len(parts) == parts.shape[2] == 1
        step = self.height if whole else max(directions // self._columns, 1)
        together = max(at_once // (8 * 2 * parts.shape[2] * min(step, self.height) * self._columns), 1)
        # One place for all chunks: of memory that comes and goes the system takes back, and clears, every page.
        room = 2 * min(together, len(parts)) * parts.shape[2] * min(step, self.height) * self._columns
        work = np.empty((3, room))
        for begin in range(0, self.height, step):
            end = min(begin + step, self.height)
            if self._tables is None:
                tables = self._made(begin, end)
            else:
                own = slice(begin * self._columns, end * self._columns)
                tables = [(even[:, own], odd[:, own]) for even, odd in self._tables]
            for first in range(0, len(signals), together):
                some = slice(first, first + together)
                self._write(parts[some], tables, work, out[some, begin:end])
        return out

    def _parts(self, signals: ComplexArray) -> FloatArray:
        """Real and imaginary parts [n, 2, rows of the second line, rows of the first] of what tables are taken with."""
        folded = signals[:, None]
        if len(self._lines) == 2:
            first, second = (line.elements for line in self._lines)
            grid = signals[:, self._order].reshape(len(signals), first, second)
            folded = self._lines[1].fold(grid).transpose(0, 2, 1)
        folded = self._lines[0].fold(folded)
        return np.stack([folded.real, folded.imag], axis=1)

    def _write(
        self, parts: FloatArray, tables: list[tuple[FloatArray, FloatArray]], work: FloatArray, out: FloatArray
    ) -> None:
        """Magnitudes [n, rows, width] in ``out``."""
        first = self._lines[0].even
        even = _times(parts[..., :first], tables[0][0], work[0])
        odd = _times(parts[..., first:], tables[0][1], work[1])
        if len(tables) == 2:
            # Even times even and odd times odd are even in the phase.
            second = self._lines[1].even
            sums = [
                [np.einsum("npbd,bd->npd", part, table) for part, table in zip(both, tables[1], strict=True)]
                for both in ((even[:, :, :second], odd[:, :, second:]), (odd[:, :, :second], even[:, :, second:]))
            ]
            even, odd = np.add(*sums[0]), np.add(*sums[1])
        shape = len(out), 2, out.shape[1], self._columns
        even, odd = even.reshape(shape), odd.reshape(shape)
        if self._halved:
            _magnitude(np.subtract(even, odd, out=work[2, : even.size].reshape(shape)), out[..., self._columns :])
        _magnitude(np.add(even, odd, out=even), out[..., : self._columns])


def _times(parts: FloatArray, table: FloatArray, work: FloatArray) -> FloatArray:
    """Of parts [n, 2, b, rows] and a table [rows, d]: [n, 2, b, d], in ``work``."""
    count, _, second, inner = parts.shape
    rows = parts.reshape(2 * count * second, inner)
    product = work[: len(rows) * table.shape[1]].reshape(len(rows), -1)
    # Two products with a vector: OpenBLAS takes 1.4 times as long for a matrix of two rows.
    for own in range(2) if len(rows) == 2 else (slice(None),):
        np.matmul(rows[own], table, out=product[own])
    return product.reshape(count, 2, second, -1)


def _magnitude(field: FloatArray, out: FloatArray) -> None:
    """Of real and imaginary parts [n, 2, rows, columns], which are overwritten."""
    np.square(field, out=field)
    np.add(field[:, 0], field[:, 1], out=out)
    np.sqrt(out, out=out)


_beams: OrderedDict[tuple[bytes, float, int, int], Beams] = OrderedDict()


def beams(elements_m: ArrayLike, frequency_hz: float, height: int, width: int) -> Beams:
    """The beam former of an array, whose tables are kept for the next call: see `Beams`."""
    elements = np.ascontiguousarray(elements_m, float)
    key = elements.tobytes(), float(frequency_hz), height, width
    if key not in _beams:
        made = Beams(elements.reshape(-1, 3), frequency_hz, height, width)
        while _beams and made.size + sum(one.size for one in _beams.values()) > KEPT:
            _beams.popitem(last=False)
        if not made.size:
            return made
        _beams[key] = made
    _beams.move_to_end(key)
    return _beams[key]
