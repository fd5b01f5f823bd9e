"""Lags: the few real numbers that a squared Bartlett spectrum consists of.

The squared magnitude of sum_m h_m exp(-j k p_m . u) depends on differences of element positions alone,

    P(u) = sum_l r_l exp(-j k l . u),   r_l = sum over pairs p_m - p_n = l of h_m conj(h_n),

and r_-l = conj(r_l). So P is linear in the real vector (r_0, sqrt2 Re r_l, sqrt2 Im r_l) over half of the lags, which
has as many numbers as the array has differences: (2 a - 1)(2 b - 1) of a regular a x b array, 49 of a 4 x 4. Signals
that are not coherent add in r, not in h: lags also describe the mean of many snapshots.

Lags are unique only where the directions distinguish them: neighbours half a wavelength apart or less, and in the
plane, as elements of a planar array do not distinguish u_z from -u_z.

Source: Van Trees, "Optimum Array Processing" (2002), sections 3.1.3 and 5.1 (difference co-array).
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy.constants import speed_of_light

from ..core import InputError
from ..core.angles import FloatArray, pixel_directions
from ..core.types import IntArray

SAME_LAG = 1e-6
"""Differences closer than this share of the array's extent are one lag: positions in files have six digits."""
LEAST_CONDITION = 1e-7  # singular values below this share of the greatest: the directions do not distinguish the lags


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
        self.lag_m, self._pair, self._side = _differences(elements)
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
        half, lag_of, side = len(self.lag_m) - 1, self._pair.ravel(), self._side.ravel()
        matrices = np.zeros((2, len(lag_of), self.count))
        same, first = np.flatnonzero((side > 0) & (lag_of == 0)), np.flatnonzero((side > 0) & (lag_of > 0))
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
        """QR decomposition of the basis."""
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
    side = np.where(steps[np.arange(len(steps)), first] < 0, -1, 1)
    # Each leads with a positive number, so zero sorts first.
    _, index, lag = np.unique(side[:, None] * steps, axis=0, return_index=True, return_inverse=True)
    return side[index, None] * difference[index], lag.reshape(count, count), side.reshape(count, count)
