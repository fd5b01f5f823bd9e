"""From Gaussians on the sphere of directions to antenna signals, in closed form.

A Gaussian's footprint around direction n is G(u) = exp(-v^T C^-1 v / 2) with v the central projection of u onto the
tangent plane at n (`wrf_mi.project.footprint`). At the element at p it contributes

    h = integral of G(u) exp(+j k p . u) over solid angle.

With u = (n + v) / sqrt(1 + |v|^2) and du = dv / (1 + |v|^2)^(3/2), to second order in |v| the integrand stays Gaussian:

    h = 2 pi sqrt(det C / det(I + z C)) exp(j k p . n - (k^2 / 2) q^T C (I + z C)^-1 q),   z = 3 + j k p . n,

q the part of p across n. To first order (z = 0) this is exp(j k p . n) exp(-k^2 q^T C q / 2), the footprint's
characteristic function. What is left out: terms of third order, k |q| |v|^3 / 2; the footprint's end at three
deviations and its clipping at the horizon, which a sum over the pixels of a hemisphere has.

Error at the elements of a 4 x 4 array half a wavelength apart, root of the mean square over 40 directions, as a share
of the footprint's integral (docs/receivers.md compares sums over pixels, `tests/test_receive_footprints.py` checks it):

| standard deviation | 1 deg | 3 | 5 | 10 | 20 | 30 |
| --- | --- | --- | --- | --- | --- | --- |
| first order | 1e-3 | 0.011 | 0.027 | 0.08 | 0.19 | 0.29 |
| second order | 4e-6 | 3e-4 | 2e-3 | 0.018 | 0.06 | 0.09 |
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.constants import speed_of_light

ComplexArray = NDArray[np.complex128]


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
    n, spread = np.asarray(directions, float), np.asarray(covariance, float)
    if spread.shape == n.shape[:-1]:
        spread = np.square(spread)[..., None, None] * np.eye(3)
    across = np.eye(3) - n[..., :, None] * n[..., None, :]
    c = across @ spread @ across
    wavenumber = 2 * np.pi * frequency_hz / speed_of_light
    p = np.asarray(positions_m, float)
    along = wavenumber * (n @ p.T)
    q = wavenumber * (across[..., None, :, :] @ p[..., None])[..., 0]
    trace = np.trace(c, axis1=-2, axis2=-1)[..., None]
    determinant = ((trace[..., 0] ** 2 - np.trace(c @ c, axis1=-2, axis2=-1)) / 2)[..., None]
    determinant = np.maximum(determinant, 0)
    width = np.einsum("...mi,...ij,...mj->...m", q, c, q)
    z = 3 + 1j * along if order == 2 else np.zeros_like(along)
    # Of the 2 x 2 matrix B = I + z C: det B, and C B^-1 = (C + z det C I) / det B (Cayley and Hamilton).
    whole = 1 + z * trace + z**2 * determinant
    exponent = 1j * along - (width + z * determinant * np.square(q).sum(axis=-1)) / (2 * whole)
    signals: ComplexArray = 2 * np.pi * np.sqrt(determinant / whole) * np.exp(exponent)
    return signals
