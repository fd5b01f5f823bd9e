"""Footprints of 3D Gaussians on the sphere of directions around a receiver.

The paper projects to an equirectangular ("Mercator") plane and takes the covariance there. The azimuth
derivative of that map grows as 1 / cos(elevation), so the plane's Gaussian is wrong near the zenith, the direction of
the strongest lobe of real data. Here the covariance is taken in the tangent plane at the Gaussian's direction
n, and the footprint is evaluated at each pixel's unit vector u:

    v = (e1 . u, e2 . u) / (n . u),   G' = exp(-v^T C^-1 v / 2),   C = [e1 e2]^T Sigma [e1 e2] / d^2 + low-pass

which equals the paper's form to first order at low elevation and has neither seam nor pole.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr

from ..backend.vectors import Pose, centre_distance, dot, principal_axes, tangent_basis
from .parameters import Gaussians

LOW_PASS_RAD = math.radians(0.3)  # added in quadrature to each footprint: 0.3 pixel at a degree per pixel

CUTOFF = 3.0  # Mahalanobis radius beyond which a footprint is zero; the jump there is exp(-4.5) = 0.011

NEAR_M = 0.05  # a Gaussian whose centre is closer to the receiver than this has no footprint

MIN_COSINE = 0.1
"""Cosine of the largest angle, about 84 degrees, between a Gaussian's direction and a pixel it reaches.

The central projection onto the tangent plane diverges at 90 degrees and would mirror what lies behind.
"""

LOG2_E = math.log2(math.e)  # footprints are powers of two, which processors compute faster than exp


@dataclass
class Footprints:
    """Footprints in a receiver's frame, arrays [batch * n], batch-major."""

    direction: list[dr.ArrayBase]  # unit vector n
    # two vectors a, b with v^T C^-1 v = ((a . u)^2 + (b . u)^2) / (n . u)^2
    whitened: tuple[list[dr.ArrayBase], list[dr.ArrayBase]]
    radius: dr.ArrayBase  # angular radius that holds the whole footprint, radians; detached
    visible: dr.ArrayBase  # far enough from the receiver to have a footprint; detached
    # distance from the receiver, metres, [n], common to all transmitters; detached. Float64, because it decides the
    # order, which rounding to float32 would change for nearly equal depths
    depth: dr.ArrayBase


def project(gaussians: Gaussians, pose: Pose) -> Footprints:
    """Footprints of Gaussians as a receiver sees them. Differentiable in position, scale and rotation."""
    # A Gaussian whose centre is nearer than ``NEAR_M`` contains the receiver and has no footprint; any other keeps its
    # footprint however large it is.
    batch = gaussians.batch
    offset = [p - x for p, x in zip(gaussians.position, pose.position, strict=True)]
    local = pose.to_local(offset)
    exact = centre_distance(gaussians.position, pose.position)
    visible = exact >= NEAR_M
    depth = dr.sqrt(dot(local, local))
    inverse = dr.select(visible, dr.rcp(dr.maximum(depth, NEAR_M)), 0)
    n = [c * inverse for c in local]
    # A Gaussian without footprint gets the direction +z: a zero vector has no tangent basis.
    n[2] = dr.select(visible, n[2], 1)
    e1, e2 = tangent_basis(n)
    n, e1, e2 = ([dr.tile(c, batch) for c in v] for v in (n, e1, e2))
    inverse = dr.tile(inverse, batch)

    # Columns of [e1 e2]^T R diag(s) / d: C = sum of their outer products + low-pass.
    columns = []
    for scale, axis in zip(gaussians.scale, principal_axes(gaussians.rotation), strict=True):
        m, f = pose.to_local(axis), scale * inverse
        columns.append((dot(e1, m) * f, dot(e2, m) * f))
    low = LOW_PASS_RAD**2
    (p0, q0), (p1, q1), (p2, q2) = columns
    s11, s22 = p0**2 + p1 * p1 + p2 * p2, q0**2 + q1 * q1 + q2 * q2
    c11, c22, c12 = s11 + low, s22 + low, p0 * q0 + p1 * q1 + p2 * q2
    # det C by Lagrange's identity: a sum of squares, where c11 c22 - c12^2 would cancel for needles.
    minors = (p0 * q1 - p1 * q0) ** 2 + (p0 * q2 - p2 * q0) ** 2 + (p1 * q2 - p2 * q1) ** 2
    determinant = minors + low * (s11 + s22) + low * low
    # C = L L^T; the rows of L^-1 [e1 e2]^T whiten the tangent plane.
    l11 = dr.rsqrt(c11)
    l22 = dr.sqrt(c11) * dr.rsqrt(determinant)
    slope = c12 / c11
    a = [p * l11 for p in e1]
    b = [(q - slope * p) * l22 for p, q in zip(e1, e2, strict=True)]

    # The larger eigenvalue of C bounds the footprint's radius; it only selects tiles, so it takes no gradient.
    d11, d22, d12 = dr.detach(c11), dr.detach(c22), dr.detach(c12)
    largest = 0.5 * (d11 + d22 + dr.sqrt((d11 - d22) ** 2 + 4 * d12 * d12))
    return Footprints(
        direction=n,
        whitened=(a, b),
        radius=dr.atan(CUTOFF * dr.sqrt(largest)),
        visible=dr.tile(visible, batch),
        depth=exact,
    )


def depth_order(depth: dr.ArrayBase, position: list[dr.ArrayBase]) -> dr.ArrayBase:
    """Indices of Gaussians from near to far; equal depths are ordered by x, then y, then z, not by storage order."""
    keys = [dr.detach(key) for key in (depth, *position)]
    if dr.backend_v(depth) is dr.JitBackend.CUDA and dr.flag(dr.JitFlag.FreezingScope):
        # Dr.Jit 1.5 records its sort on CUDA, but the replay ends the process (`block_mkperm`).
        return ranked_order(keys)
    order = dr.arange(dr.uint32_array_t(type(depth)), dr.width(depth))
    # Stable sorts from the last key to the first.
    for key in reversed(keys):
        order = dr.gather(type(order), order, dr.argsort(dr.gather(type(key), key, order)))
    return order


@dr.syntax
def ranked_order(keys: list[dr.ArrayBase]) -> dr.ArrayBase:
    """Indices in ascending order of the first key, ties by those that follow, then by index."""
    # Every lane counts the entries before its own: one kernel of n^2 comparisons.
    index_type: Any = dr.uint32_array_t(type(keys[0]))
    n = dr.width(keys[0])
    lane = dr.arange(index_type, n)
    other, rank = dr.zeros(index_type, n), dr.zeros(index_type, n)
    while other < n:
        rank = dr.select(_precedes(keys, other, lane), rank + 1, rank)
        other += 1
    # Of keys that are no numbers none is before another: their places hold the first entry.
    order = dr.zeros(index_type, n)
    dr.scatter(order, lane, rank)
    return order


def _precedes(keys: list[dr.ArrayBase], other: dr.ArrayBase, lane: dr.ArrayBase) -> dr.ArrayBase:
    """Whether the entry of index ``other`` comes before ``lane``, the lanes' indices in order."""
    mask_type: Any = dr.mask_t(keys[0])
    before, equal = mask_type(False), mask_type(True)
    for key in keys:
        # Where the entries already differ nothing is read.
        value = dr.gather(type(key), key, other, equal)
        before |= equal & (value < key)
        equal &= value == key
    return before | (equal & (other < lane))
