"""Projection, footprint and blending in float64 NumPy: the reference of the fast kernels' tests.

One loop over the Gaussians, no tiles, no culling. It fixes choices that the WRF-GS papers leave open:

* the covariance is taken in the tangent plane at the Gaussian's direction and evaluated at each pixel's
  unit vector through the central projection, so that neither the azimuth seam nor the zenith is special;
* a Gaussian is skipped when its centre is nearer than ``NEAR_M``, and is otherwise treated like any other,
  however large: it may contain the receiver;
* equal depths are ordered by the centre's world coordinates, not by storage order.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wrf_mi.core import Receiver, rotation_matrix
from wrf_mi.core.angles import FloatArray
from wrf_mi.core.types import IntArray
from wrf_mi.gaussians.footprint import CUTOFF, LOW_PASS_RAD, MIN_COSINE, NEAR_M

ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class Projection:
    """Gaussians in a receiver's frame and on its sphere of directions."""

    centre_m: FloatArray  # shape [n, 3], metres
    depth_m: FloatArray  # shape [n], distance of the centre
    direction: FloatArray  # shape [n, 3], unit vector to the centre
    basis: FloatArray  # shape [n, 2, 3], orthonormal vectors of the tangent plane: eastwards and towards the zenith
    covariance: FloatArray  # shape [n, 2, 2], in that basis, radians squared, low-pass included
    order: IntArray  # the Gaussians that have a footprint, near to far


def covariance_matrix(scale_m: ArrayLike, quaternion_xyzw: ArrayLike) -> FloatArray:
    """Covariances [n, 3, 3] in m^2, R diag(s^2) R^T, of scales [n, 3] in metres and quaternions [n, 4].

    Source: Kerbl et al., "3D Gaussian splatting" (2023), eq. 6.
    """
    turn = rotation_matrix(quaternion_xyzw)
    return turn * np.asarray(scale_m, float)[:, None, :] ** 2 @ np.swapaxes(turn, -1, -2)


def tangent_basis(direction: ArrayLike) -> FloatArray:
    """Eastward and zenithward unit vectors [..., 2, 3] at unit vectors [..., 3]; east is +y at the poles."""
    n = np.asarray(direction, float)
    horizontal = np.hypot(n[..., 0], n[..., 1])
    at_pole = horizontal == 0
    safe = np.where(at_pole, 1.0, horizontal)
    cosine, sine = np.where(at_pole, 1.0, n[..., 0] / safe), np.where(at_pole, 0.0, n[..., 1] / safe)
    east = np.stack([-sine, cosine, np.zeros_like(sine)], axis=-1)
    return np.stack([east, np.cross(n, east)], axis=-2)


def project(mean_m: ArrayLike, scale_m: ArrayLike, quaternion_xyzw: ArrayLike, receiver: Receiver) -> Projection:
    """Project Gaussians onto a receiver's sphere of directions; the order omits Gaussians nearer than ``NEAR_M``.

    Means [n, 3] in the world frame and standard deviations [n, 3] along the Gaussians' axes are in metres, quaternions
    [n, 4] turn these axes to the world.
    """
    mean = np.asarray(mean_m, float)
    to_world = receiver.to_world
    centre = (mean - receiver.position_m) @ to_world  # each row R^T (mu - x_rx)
    # In the world frame: after rotation equal depths differ in the last digit.
    depth = np.linalg.norm(mean - receiver.position_m, axis=-1)
    near = depth < NEAR_M
    direction = np.where(near[:, None], [1.0, 0.0, 0.0], centre / np.where(near, 1.0, depth)[:, None])
    basis = tangent_basis(direction)
    sigma = to_world.T @ covariance_matrix(scale_m, quaternion_xyzw) @ to_world
    in_plane = basis @ sigma @ np.swapaxes(basis, -1, -2) / np.where(near, 1.0, depth)[:, None, None] ** 2
    by_depth = np.lexsort((mean[:, 2], mean[:, 1], mean[:, 0], depth))
    covariance = in_plane + LOW_PASS_RAD**2 * np.eye(2)
    return Projection(centre, depth, direction, basis, covariance, order=by_depth[~near[by_depth]])


def reach(projection: Projection, index: int, directions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Squared Mahalanobis distances of Gaussian ``index`` at unit vectors [..., 3], and cosines to its direction.

    The distance is taken in the tangent plane, where the pixel's ray meets it (central projection).
    """
    cosine = directions @ projection.direction[index]
    # Behind the receiver there is no such point; the divisor only avoids warnings.
    point = directions @ projection.basis[index].T / np.where(cosine > MIN_COSINE, cosine, 1.0)[..., None]
    return np.einsum("...i,ij,...j->...", point, np.linalg.inv(projection.covariance[index]), point), cosine


def footprint(projection: Projection, index: int, directions: FloatArray) -> FloatArray:
    """Footprint G' in 0..1 of Gaussian ``index`` at unit vectors [..., 3] in the receiver's frame.

    exp(-m^2 / 2) for a Mahalanobis distance m (`reach`) below ``CUTOFF``, else 0.
    """
    if projection.depth_m[index] < NEAR_M:
        return np.zeros(directions.shape[:-1])
    squared, cosine = reach(projection, index, directions)
    return np.where((cosine > MIN_COSINE) & (squared < CUTOFF**2), np.exp(-squared / 2), 0.0)


def blend_product(footprints: ArrayLike, signal: ArrayLike, attenuation: ArrayLike) -> ComplexArray:
    """WRF-GS: R = sum_i G'_i S_i prod_{j<i} (1 - G'_j (1 - delta_j)), the complex field [...] at each direction.

    Footprints [n, ...] are near to far, signals S [n] complex, attenuations delta [n] complex with magnitude at most 1.

    Source: WRF-GS, eq. 12 and 13, where footprints are 0 or 1; G' interpolates between passing a Gaussian
    by (factor 1) and crossing its centre (factor delta).
    """
    g = np.asarray(footprints, float)
    received, passed = np.zeros(g.shape[1:], complex), np.ones(g.shape[1:], complex)
    for g_i, s_i, delta_i in zip(g, np.asarray(signal), np.asarray(attenuation), strict=True):
        received += g_i * s_i * passed
        passed *= 1 - g_i * (1 - delta_i)
    return received


def blend_alpha(footprints: ArrayLike, signal: ArrayLike, opacity: ArrayLike) -> ComplexArray:
    """WRF-GS+: R = sum_i S_i alpha_i prod_{j<i} (1 - alpha_j) with alpha_i = o_i G'_i, as `blend_product`.

    Signals S [n] are static part and deviation together, opacities o [n] are in 0..1.

    Source: WRF-GS+, complex-valued alpha blending.
    """
    o = np.asarray(opacity)
    return blend_product(footprints, o * np.asarray(signal), 1 - o)


def render(
    mean_m: ArrayLike,
    scale_m: ArrayLike,
    quaternion_xyzw: ArrayLike,
    signal: ArrayLike,
    receiver: Receiver,
    directions: FloatArray,
    *,
    attenuation: ArrayLike | None = None,
    opacity: ArrayLike | None = None,
) -> ComplexArray:
    """Complex field [H, W] at a receiver; give ``attenuation`` for WRF-GS or ``opacity`` for WRF-GS+.

    Gaussians are as of `project`, signals as of `blend_product` and `blend_alpha`; directions [H, W, 3] are unit
    vectors in the receiver's frame, as of ``core.pixel_directions``. `TypeError` for neither or both.
    """
    if (attenuation is None) == (opacity is None):
        raise TypeError("give either attenuation (WRF-GS) or opacity (WRF-GS+)")
    view = project(mean_m, scale_m, quaternion_xyzw, receiver)
    footprints = np.array([footprint(view, i, directions) for i in view.order]).reshape(-1, *directions.shape[:-1])
    sorted_signal = np.asarray(signal)[view.order]
    if opacity is not None:
        return blend_alpha(footprints, sorted_signal, np.asarray(opacity)[view.order])
    return blend_product(footprints, sorted_signal, np.asarray(attenuation)[view.order])
