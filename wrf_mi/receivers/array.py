"""Antenna arrays: response to a plane wave and Bartlett spectrum.

Conventions (`wrf_mi.core.angles`): elements lie in the array's x-y plane, boresight +z. With the time factor
exp(+j omega t), a wave that arrives *from* unit vector u reaches the element at p with the phase +k p . u
relative to the array's origin.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.constants import speed_of_light
from scipy.spatial.distance import cdist

from ..core.angles import FloatArray, pixel_directions
from ..core.types import IntArray

ComplexArray = NDArray[np.complex128]

TABLE_BYTES = 1 << 25
"""Largest table of responses; 360 x 90 directions of a 4 x 4 array take 8 MB. `KEPT_TABLES` are kept between calls."""
KEPT_TABLES = 4
CHUNK_SIZE = 16  # signals whose spectra are computed together
LINES_FROM = 64  # number of elements from which a planar grid is summed line by line
MIRRORED, ALIGNED = 1e-6, 1e-9
"""Distances within which positions are opposite or on one line, as shares of the array's extent."""


def mirror_order(elements_m: ArrayLike) -> IntArray | None:
    """Element [m] opposite to each of [m, 3] (or [m, 1]) through the array's centre; None where one has no opposite."""
    elements = np.asarray(elements_m, float)
    centre = elements.mean(axis=0)
    distance = cdist(2 * centre - elements, elements)
    extent = max(float(np.ptp(elements, axis=0).max()), np.finfo(float).tiny)
    return distance.argmin(axis=1) if distance.min(axis=1).max() < MIRRORED * extent else None


def array_response(positions_m: ArrayLike, directions: ArrayLike, frequency_hz: float) -> ComplexArray:
    """Element signals exp(+j k p . u) of a plane wave of unit amplitude from unit vector u.

    Args:
        positions_m: positions p of the elements [m, 3] in the array's frame, metres.
        directions: unit vectors u [..., 3] towards the source, in the array's frame.
        frequency_hz: carrier frequency.

    Returns:
        Complex signals [..., m].

    Source: Van Trees, "Optimum Array Processing" (2002), section 2.2, with the direction towards the source.
    """
    wavenumber = 2 * np.pi * frequency_hz / speed_of_light
    response: ComplexArray = np.exp(1j * wavenumber * (np.asarray(directions) @ np.asarray(positions_m).T))
    return response


def bartlett_spectrum(h: ArrayLike, positions_m: ArrayLike, frequency_hz: float, height: int, width: int) -> FloatArray:
    """Magnitude of the Bartlett (delay-and-sum) beam former at every pixel, abs(sum_m h_m exp(-j k p_m . u)).

    Args:
        h: complex element signals [..., m].
        positions_m: elements [m, 3] in the array's frame, metres.
        frequency_hz: carrier frequency.
        height: elevations over the upper hemisphere.
        width: azimuths over the full circle.

    Returns:
        Shape [..., height, width], in the unit of ``h``.

    Source: Van Trees, "Optimum Array Processing" (2002), section 6.2.
    """
    signals, elements = np.asarray(h, dtype=complex), np.asarray(positions_m, float)
    first, second, order = _lines(elements)
    # exp(-j k (x + y) . u) is a product: a planar grid is summed along one line, then along the other.
    grids = signals[..., order].reshape(-1, len(first), len(second))
    images = np.empty((len(grids), height * width))
    step = max(1, TABLE_BYTES // (16 * (len(first) + len(second))))
    together = max(1, CHUNK_SIZE // len(first))
    for begin in range(0, height * width, step):
        block = float(frequency_hz), height, width, begin, begin + step
        outer, inner = (_beams(line.tobytes(), *block) for line in (first, second))
        for start in range(0, len(grids), together):
            rows = slice(start, start + together)
            waves = grids[rows] @ inner
            total = waves[:, 0] if len(first) == 1 else np.einsum("nxd,xd->nd", waves, outer)
            images[rows, begin : begin + step] = np.abs(total)
    return images.reshape(*signals.shape[:-1], height, width)


def _lines(elements_m: FloatArray) -> tuple[FloatArray, FloatArray, IntArray]:
    """Two lines whose sums are the elements of a large planar grid, and the elements' order in the grid."""
    # Of other arrays the origin alone and all elements: one sum is faster for few, and lines have smaller tables.
    ungrouped = np.zeros((1, 3)), elements_m, np.arange(len(elements_m))
    grain = ALIGNED * float(np.ptp(elements_m, axis=0).max())
    if len(elements_m) < LINES_FROM or np.ptp(elements_m[:, 2]) > grain:
        return ungrouped
    (x, column), (y, row) = (np.unique(np.round(part / grain), return_inverse=True) for part in elements_m.T[:2])
    # A grid has each pair of a column and a row once: numbers of places in order then differ by one.
    order = np.lexsort((row, column))
    if len(x) * len(y) != len(elements_m) or (np.diff(column[order] * len(y) + row[order]) != 1).any():
        return ungrouped
    grid = elements_m[order].reshape(len(x), len(y), 3)
    return grid[:, 0], grid[0] - grid[0, 0], order


def steering_matrix(positions_m: ArrayLike, directions: ArrayLike, frequency_hz: float) -> ComplexArray:
    """Factors exp(-j k p_m . u) [m, n] of elements [m, 3] and directions [n, 3]: h times it is the Bartlett sum."""
    return array_response(positions_m, directions, frequency_hz).conj().T


@lru_cache(KEPT_TABLES)
def _beams(elements: bytes, frequency_hz: float, height: int, width: int, begin: int, end: int) -> ComplexArray:
    """Factors exp(-j k p_m . u) [m, pixels] of some of the pixels of a spectrum."""
    directions = pixel_directions(height, width).reshape(-1, 3)[begin:end]
    return steering_matrix(np.frombuffer(elements).reshape(-1, 3), directions, frequency_hz).copy()
