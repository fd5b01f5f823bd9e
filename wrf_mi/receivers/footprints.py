"""From Gaussians on the sphere of directions to antenna signals, in closed form.

A Gaussian's footprint around direction n is G(u) = exp(-v^T C^-1 v / 2) with v the central projection of u onto the
tangent plane at n (`wrf_mi.gaussians.footprint`). At the element at p it contributes

    h = integral of G(u) exp(+j k p . u) over solid angle.

With u = (n + v) / sqrt(1 + |v|^2) and du = dv / (1 + |v|^2)^(3/2), to second order in |v| the integrand stays Gaussian:

    h = 2 pi sqrt(det C / det(I + z C)) exp(j k p . n - (k^2 / 2) q^T C (I + z C)^-1 q),   z = 3 + j k p . n,

q the part of p across n. To first order (z = 0) this is exp(j k p . n) exp(-k^2 q^T C q / 2), the footprint's
characteristic function. What is left out: terms of third order, k |q| |v|^3 / 2; the footprint's end at three
deviations and its clipping at the horizon, which a sum over the pixels of a hemisphere has.

Error at the elements of a 4 x 4 array half a wavelength apart, root of the mean square over 40 directions, as a share
of the footprint's integral (docs/receivers.md compares sums over pixels, `tests/receivers/test_array_footprints.py`
checks it):

| standard deviation | 1 deg | 3 | 5 | 10 | 20 | 30 |
| --- | --- | --- | --- | --- | --- | --- |
| first order | 1e-3 | 0.011 | 0.027 | 0.08 | 0.19 | 0.29 |
| second order | 4e-6 | 3e-4 | 2e-3 | 0.018 | 0.06 | 0.09 |
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.constants import speed_of_light

from ..core.angles import FloatArray

ComplexArray = NDArray[np.complex128]

PAIRS_PER_CHUNK = 1 << 16
"""Pairs of Gaussian and element at once: 1 MB of complex numbers for each of some arrays, in the cache of a core."""


def gaussian_signals(
    directions: ArrayLike, covariance: ArrayLike, positions_m: ArrayLike, frequency_hz: float, order: int = 2
) -> ComplexArray:
    """Element signals of Gaussian footprints of peak 1, integrated over solid angle.

    Args:
        directions: unit vectors n of the centres [..., 3], in the array's frame.
        covariance: [..., 3, 3] in that frame, rad^2: of a 3D Gaussian its covariance over its squared distance; the
            part along n does not count. Or standard deviations [...] in rad of round footprints.
        positions_m: elements [m, 3] in the array's frame, metres.
        frequency_hz: of the carrier.
        order: 2, or 1 for the characteristic function alone.

    Returns:
        Complex, steradian, [..., m].

    Raises:
        ValueError: another order.
    """
    if order not in (1, 2):
        raise ValueError(f"gaussian_signals: order {order}; give 1 or 2")
    n, spread, p = np.asarray(directions, float), np.asarray(covariance, float), np.asarray(positions_m, float)
    shape = n.shape[:-1]
    spread = spread.ravel() if spread.shape == shape else np.broadcast_to(spread, (*shape, 3, 3)).reshape(-1, 3, 3)
    n = n.reshape(-1, 3)
    wavenumber = 2 * np.pi * frequency_hz / speed_of_light
    out = np.empty((len(n), len(p)), complex)
    step = max(PAIRS_PER_CHUNK // max(len(p), 1), 1)
    for first in range(0, len(n), step):
        own = slice(first, first + step)
        out[own] = _signals(n[own], spread[own], wavenumber * p, order)
    return out.reshape(*shape, len(p))


def _signals(n: FloatArray, spread: FloatArray, p: FloatArray, order: int) -> ComplexArray:
    """Of directions [n, 3], covariances [n, 3, 3] or deviations [n], and positions times the wave number [m, 3]."""
    if spread.ndim == 1:
        spread = np.square(spread)[:, None, None] * np.eye(3)
    across = np.eye(3) - n[:, :, None] * n[:, None, :]
    c = across @ spread @ across
    along = n @ p.T
    # The part across n is p less the part along: of it only quadratic forms are needed.
    square = np.square(p).sum(axis=1) - np.square(along)
    trace = np.trace(c, axis1=1, axis2=2)[:, None]
    determinant = np.maximum((trace**2 - np.trace(c @ c, axis1=1, axis2=2)[:, None]) / 2, 0)
    # C n = 0, so the form of p is that of its part across.
    width = np.einsum("nmi,mi->nm", p @ c, p)
    z = 3 + 1j * along if order == 2 else np.zeros_like(along)
    # Of the 2 x 2 matrix B = I + z C: det B, and C B^-1 = (C + z det C I) / det B (Cayley and Hamilton).
    whole = 1 + z * trace + z**2 * determinant
    exponent = 1j * along - (width + z * determinant * square) / (2 * whole)
    signals: ComplexArray = 2 * np.pi * np.sqrt(determinant / whole) * np.exp(exponent)
    return signals
