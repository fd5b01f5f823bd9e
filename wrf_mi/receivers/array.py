"""Antenna arrays: response to a plane wave, Bartlett spectrum, and the lags that a squared spectrum consists of.

Conventions (`wrf_mi.core.angles`): elements lie in the array's x-y plane, boresight +z. With the time factor
exp(+j omega t), a wave that arrives *from* unit vector u reaches the element at p with the phase +k p . u
relative to the array's origin.

The squared magnitude of sum_m h_m exp(-j k p_m . u) depends on differences of element positions alone,

    P(u) = sum_l r_l exp(-j k l . u),   r_l = sum over pairs p_m - p_n = l of h_m conj(h_n),

and r_-l = conj(r_l). So P is linear in the real vector (r_0, sqrt2 Re r_l, sqrt2 Im r_l) over half of the lags, which
has as many numbers as the array has differences: (2 a - 1)(2 b - 1) of a regular a x b array, 49 of a 4 x 4. Signals
that are not coherent add in r, not in h: lags also describe the mean of many snapshots. Lags are unique only where the
directions distinguish them: neighbours half a wavelength apart or less, and in the plane, as elements of a planar array
do not distinguish u_z from -u_z. Source: Van Trees, "Optimum Array Processing" (2002), sections 3.1.3 and 5.1.
"""

from __future__ import annotations

from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.constants import speed_of_light
from scipy.spatial.distance import cdist

from ..core import InputError
from ..core.angles import FloatArray, pixel_directions
from ..core.types import IntArray

ComplexArray = NDArray[np.complex128]

TABLE_BYTES = 1 << 25  # largest table of responses; `KEPT_TABLES` are kept, of 8 MB for 4 x 4 and 360 x 90 directions
KEPT_TABLES = 12  # two of each block of directions: 200 MB for images of 700,000 pixels and more
CHUNK_SIZE = 16  # signals whose spectra are computed together
LINES_FROM = 64  # number of elements from which a planar grid is summed line by line
MIRRORED, ALIGNED = 1e-6, 1e-9  # distances of opposite, or aligned, positions as shares of the array's extent
SAME_LAG = 1e-6  # differences closer than this share of the array's extent are one: files have six digits
LEAST_CONDITION = 1e-7  # singular values below this share of the greatest: the directions do not distinguish the lags


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


class Lags:
    """The linear map between lags and squared spectra of one array on one grid of directions.

    Args:
        elements_m: elements [m, 3] in the array's frame, metres, in any arrangement.
        frequency_hz: carrier frequency.
        height: elevations over the upper hemisphere.
        width: azimuths over the full circle.

    Attributes:
        shape: height and width.
        elements: number m of elements.
        lag_m: differences of element positions over a half space, zero first, [l, 3].
        basis: squared spectra of the unit vectors of lags, [height * width, count].

    Raises:
        InputError: element positions that are not finite [m, 3].
    """

    def __init__(self, elements_m: ArrayLike, frequency_hz: float, height: int, width: int) -> None:
        elements = np.asarray(elements_m, float)
        if elements.ndim != 2 or elements.shape[1:] != (3,) or not len(elements) or not np.isfinite(elements).all():
            raise InputError(f"lags: elements of shape {elements.shape}; give finite [m, 3] in metres")
        self.shape = height, width
        self.elements = len(elements)
        self.lag_m, self._pair, self._sign = _differences(elements)
        wavenumber = 2 * np.pi * frequency_hz / speed_of_light
        phase = wavenumber * (pixel_directions(height, width).reshape(-1, 3) @ self.lag_m.T)
        # Re(r exp(-j phase)) = Re(r) cos(phase) + Im(r) sin(phase).
        parts = [np.ones((len(phase), 1)), np.sqrt(2) * np.cos(phase[:, 1:]), np.sqrt(2) * np.sin(phase[:, 1:])]
        self.basis: FloatArray = np.concatenate(parts, axis=1)

    @property
    def count(self) -> int:
        """Number of real numbers in a vector of lags."""
        return int(self.basis.shape[1])

    @cached_property
    def pairs(self) -> FloatArray:
        """Matrices [2, m * m, count] that add real and imaginary parts of products h_m conj(h_n) up to lags."""
        half, lag_of, sign = len(self.lag_m) - 1, self._pair.ravel(), self._sign.ravel()
        matrices = np.zeros((2, len(lag_of), self.count))
        same, first = np.flatnonzero((sign > 0) & (lag_of == 0)), np.flatnonzero((sign > 0) & (lag_of > 0))
        matrices[0, same, 0] = 1
        matrices[0, first, lag_of[first]] = matrices[1, first, half + lag_of[first]] = np.sqrt(2)
        return matrices

    def coordinates(self, squared: ArrayLike) -> FloatArray:
        """Coordinates [..., count] in an orthonormal basis of all squared spectra: distances are those of pixels."""
        values = np.asarray(squared, float)
        if values.shape[-2:] != self.shape:
            raise InputError(f"lags: image {values.shape[-2:]}, not {self.shape}; build the lags for its grid")
        coordinates: FloatArray = values.reshape(*values.shape[:-2], -1) @ self._factors[0]
        return coordinates

    def to_coordinates(self, lags: ArrayLike) -> FloatArray:
        """`coordinates` of the squared spectra of lags [..., count], without computing them."""
        return np.asarray(lags, float) @ self._factors[1].T

    def residual(self, image: ArrayLike) -> FloatArray:
        """Part of images [..., height, width] outside the span of this array's squared spectra; the same shape."""
        values = np.asarray(image, float)
        return values - (self.coordinates(values) @ self._factors[0].T).reshape(values.shape)

    @cached_property
    def _factors(self) -> tuple[FloatArray, FloatArray]:
        orthonormal, triangle = np.linalg.qr(self.basis)
        values = np.linalg.svd(triangle, compute_uv=False)
        if len(values) < self.count or values[-1] < LEAST_CONDITION * values[0]:
            text = f"{self.count} lags on {self.shape[0]} x {self.shape[1]} directions cannot be told apart"
            raise InputError(f"lags: {text}; take more directions, or elements no further apart than half a wavelength")
        return orthonormal, triangle


def _differences(elements_m: FloatArray) -> tuple[FloatArray, IntArray, IntArray]:
    """Lags [l, 3] of a half space, zero first; lag of each pair of elements [m, m], and its sign, -1 if mirrored."""
    count = len(elements_m)
    difference = (elements_m[:, None, :] - elements_m[None, :, :]).reshape(-1, 3)
    grain = SAME_LAG * max(float(np.ptp(elements_m, axis=0).max()), np.finfo(float).tiny)
    # Whole steps, so that differences of rounded positions compare as equal.
    steps = np.rint(difference / grain)
    first = np.argmax(steps != 0, axis=1)
    sign = np.where(steps[np.arange(len(steps)), first] < 0, -1, 1)
    # Each leads with a positive number, so zero sorts first.
    _, index, lag = np.unique(sign[:, None] * steps, axis=0, return_index=True, return_inverse=True)
    return sign[index, None] * difference[index], lag.reshape(count, count), sign.reshape(count, count)
