"""Response of 3D Gaussians along rays from a receiver: the footprint without the projection.

The traced evaluation takes, for each direction u, the largest value of the Gaussian on the ray x_rx + t u, t >= 0.
Splatting takes the covariance in the tangent plane at the Gaussian's direction n. Both are expressed in one frame:
let M be the map that makes the Gaussian round (Sigma^-1 = M^T M), turned such that M n points along its third axis.
With D the distance of the centre, L = |M n| D its Mahalanobis distance and g3 the third row of M / |M n|,

    a, b = D times the first two rows of M,  both perpendicular to n
    r^2 = (a . u)^2 + (b . u)^2
    splatted: m^2 = r^2 / (n . u)^2
    traced:   m^2 = r^2 / ((g3 . u)^2 + r^2 / L^2),   g3 = n + k1 a + k2 b

(by Lagrange's identity |o x d|^2 / |d|^2 for the distance of the ray from the centre, which does not cancel as
o . o - (o . d)^2 / d . d would). The projection thus neglects the Gaussian's lean, k1 and k2, and its extent in depth,
1 / L^2: both vanish with its angular size. As in splatting, the low-pass adds (low D)^2 to each squared scale and G'
= 0 where m >= CUTOFF or n . u <= MIN_COSINE. A ray whose largest value lies behind the receiver (g3 . u < 0) takes
the value at the receiver, m = L.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from wrf_mi.backend.vectors import Pose, centre_distance, cross, dot, principal_axes, tangent_basis
from wrf_mi.gaussians.footprint import CUTOFF, LOG2_E, LOW_PASS_RAD, MIN_COSINE, NEAR_M
from wrf_mi.gaussians.parameters import Gaussians

RAY_FIELDS = 12
"""Numbers of one Gaussian's response along any ray: n, a, b (3 each), k1, k2 and 1 / L^2."""


@dataclass
class RayFootprints:
    """Gaussians as the rays of a receiver meet them, in the receiver's frame, arrays [n].

    Attributes:
        direction: unit vector n to the centre; zero for a Gaussian nearer than ``NEAR_M``, which no ray meets.
        whitened: vectors a and b.
        lean: k1 and k2.
        depth_extent: 1 / L^2.
        depth: distance D of the centre, metres; detached, float64 as in `wrf_mi.gaussians.footprint.Footprints`.
        visible: not nearer than ``NEAR_M``; detached.
    """

    direction: list[Any]
    whitened: tuple[list[Any], list[Any]]
    lean: tuple[Any, Any]
    depth_extent: Any
    depth: Any
    visible: Any

    def columns(self) -> list[Any]:
        """The ``RAY_FIELDS`` numbers of each Gaussian."""
        return [*self.direction, *self.whitened[0], *self.whitened[1], *self.lean, self.depth_extent]


def to_world(pose: Pose, v: list[Any]) -> list[Any]:
    """A vector of the receiver's frame in the world frame (R v)."""
    return [sum((row[k] * v[k] for k in (1, 2)), row[0] * v[0]) for row in pose.to_world]


@dataclass
class Hulls:
    """Ellipsoids around the part of a Gaussian that a ray may meet, arrays [n], metres; detached.

    Attributes:
        centre: three arrays, from the receiver, along the world's axes.
        radius: three arrays, semi-axes along the Gaussian's axes.
        rotation: four arrays, unit quaternion x, y, z, w, Gaussian's axes to world.
    """

    centre: list[Any]
    radius: list[Any]
    rotation: list[Any]

    def at(self, index: Any) -> Hulls:
        """The ellipsoids at ``index``, gathered."""
        return Hulls(
            *([dr.gather(type(c), c, index) for c in part] for part in (self.centre, self.radius, self.rotation))
        )


def _combine(weights: list[Any], vectors: list[list[Any]]) -> list[Any]:
    return [dot(weights, [v[i] for v in vectors]) for i in range(3)]


def ray_footprints(gaussians: Gaussians, pose: Pose) -> RayFootprints:
    """Responses of Gaussians along a receiver's rays. Differentiable in position, scale, rotation and pose.

    Computed in float64 and rounded at the end: a Gaussian of axes 1e5 to 1 has a and b of equally unequal lengths,
    and a lean that multiplies the errors of the shorter. They are turned to be perpendicular, so rounding harms
    neither.

    Args:
        gaussians: Gaussians for one transmitter (batch 1).
        pose: pose of the receiver.
    """
    single: Any = type(gaussians.position[0])
    double: Any = dr.float64_array_t(single)
    position, scales, rotation, place = (
        [double(c) for c in part] for part in (gaussians.position, gaussians.scale, gaussians.rotation, pose.position)
    )
    pose = Pose(place, [[double(c) for c in row] for row in pose.to_world])
    local = pose.to_local([p - x for p, x in zip(position, pose.position, strict=True)])
    depth = dr.sqrt(dot(local, local))
    # As in `project`, so that ties are equal.
    exact = centre_distance(position, pose.position)
    visible = exact >= NEAR_M
    inverse = dr.select(visible, dr.rcp(dr.maximum(depth, NEAR_M)), 0)
    n = [c * inverse for c in local]
    # Any unit vector where nothing is seen; its direction is set to zero at the end.
    safe = [*n[:2], dr.select(visible, n[2], 1)]
    distance = dr.maximum(depth, NEAR_M)

    low = (LOW_PASS_RAD * distance) ** 2
    whiten = [
        [m * dr.rsqrt(scale * scale + low) for m in pose.to_local(axis)]
        for scale, axis in zip(scales, principal_axes(rotation), strict=True)
    ]
    whitened = [dot(row, safe) for row in whiten]
    length = dr.sqrt(dot(whitened, whitened))
    third = [s / length for s in whitened]
    first, second = tangent_basis(third)
    a, b = _perpendicular(*([c * distance for c in _combine(row, whiten)] for row in (first, second)))
    g3 = [c / length for c in _combine(third, whiten)]
    # Dual vectors of a and b in the tangent plane give the lean.
    to_first, to_second = cross(b, safe), cross(safe, a)
    determinant = dot(a, to_first)
    mahalanobis = length * distance
    mask: Any = dr.mask_t(single)
    return RayFootprints(
        direction=[single(dr.select(visible, c, 0)) for c in n],
        whitened=([single(c) for c in a], [single(c) for c in b]),
        lean=(single(dot(g3, to_first) / determinant), single(dot(g3, to_second) / determinant)),
        depth_extent=single(dr.rcp(mahalanobis * mahalanobis)),
        depth=exact,
        visible=mask(visible),
    )


def _perpendicular(a: list[Any], b: list[Any]) -> tuple[list[Any], list[Any]]:
    """Two vectors turned in their plane until they are perpendicular, the longer one first, by a detached angle."""
    p, q = [dr.detach(c) for c in a], [dr.detach(c) for c in b]
    sine, cosine = dr.sincos(0.5 * dr.atan2(2 * dot(p, q), dot(p, p) - dot(q, q)))
    turned = [cosine * x + sine * y for x, y in zip(a, b, strict=True)]
    return turned, [cosine * y - sine * x for x, y in zip(a, b, strict=True)]


def hulls(gaussians: Gaussians, pose: Pose, margin_rad: float) -> Hulls:
    """Ellipsoids that a ray within an angle of u meets wherever the response along u is not zero.

    The cut-off ellipsoid (low-pass included) grown by a ball of radius (D + its largest semi-axis) sin(margin): no
    point of it is farther from the receiver, so no ray within the margin is farther from one that meets it. The sum of
    ellipsoid and ball lies in the one with squared semi-axes (1 + 1/p) r^2 + (1 + p) ball^2 for each p > 0.

    Args:
        gaussians: Gaussians for one transmitter (batch 1).
        pose: pose of the receiver.
        margin_rad: largest angle between a ray and the one traced for it, below a quarter turn.
    """
    centre = [dr.detach(p) - dr.detach(x) for p, x in zip(gaussians.position, pose.position, strict=True)]
    depth = dr.sqrt(dot(centre, centre))
    low = (LOW_PASS_RAD * depth) ** 2
    square = [CUTOFF**2 * (dr.detach(s) ** 2 + low) for s in gaussians.scale]
    if margin_rad > 0:
        largest = dr.sqrt(dr.maximum(dr.maximum(square[0], square[1]), square[2]))
        ball = (depth + largest) * dr.sin(type(depth)(margin_rad))
        p = dr.sqrt((square[0] + square[1] + square[2]) / 3) / ball
        square = [(1 + 1 / p) * s + (1 + p) * ball**2 for s in square]
    quaternion = [dr.detach(q) for q in gaussians.rotation]
    norm = dr.rsqrt(sum((q * q for q in quaternion[1:]), quaternion[0] ** 2))
    return Hulls(centre, [dr.sqrt(s) for s in square], [q * norm for q in quaternion])


def response(record: list[Any], u: list[Any]) -> tuple[Any, Any, Any, Any, Any]:
    """Footprint G' along one ray, and intermediate values for its derivative.

    Args:
        record: the ``RAY_FIELDS`` numbers of a Gaussian.
        u: unit vector of the ray, receiver's frame.

    Returns:
        G' in 0..1; p = a . u; q = b . u; z = g3 . u, zero if negative; and 1 / (z^2 + r^2 / L^2).
    """
    facing, p, q = (dot(record[i : i + 3], u) for i in (0, 3, 6))
    k1, k2, extent = record[9:RAY_FIELDS]
    z = dr.maximum(dr.fma(k1, p, dr.fma(k2, q, facing)), 0)
    square = dr.fma(p, p, q * q)
    inverse = dr.rcp(dr.fma(z, z, square * extent))
    m2 = square * inverse
    inside = (facing > MIN_COSINE) & (m2 < CUTOFF * CUTOFF)
    return dr.select(inside, dr.exp2(-0.5 * LOG2_E * m2), 0), p, q, z, inverse


def response_slope(record: list[Any], u: list[Any], parts: tuple[Any, Any, Any, Any, Any], slope: Any) -> list[Any]:
    """Derivative by the ``RAY_FIELDS`` numbers, times ``slope``, the derivative by G'.

    Args:
        record: the ``RAY_FIELDS`` numbers of a Gaussian.
        u: unit vector of the ray, receiver's frame.
        parts: result of `response`.
        slope: derivative by G'.
    """
    g, p, q, z, inverse = parts
    k1, k2, extent = record[9:RAY_FIELDS]
    square = dr.fma(p, p, q * q)
    by_m2 = dr.select(g > 0, -0.5 * slope * g, 0)
    by_square = by_m2 * inverse * (1 - square * inverse * extent)
    by_z = -2 * by_m2 * square * z * inverse * inverse
    by_extent = -by_m2 * square * square * inverse * inverse
    by_p = dr.fma(2 * p, by_square, k1 * by_z)
    by_q = dr.fma(2 * q, by_square, k2 * by_z)
    vectors = [d * c for d in (by_z, by_p, by_q) for c in u]
    return [*vectors, p * by_z, q * by_z, by_extent]


def peak_distance(depth: Any, parts: tuple[Any, Any, Any, Any, Any]) -> Any:
    """Distance of the Gaussian's strongest point on the ray from the receiver, metres.

    Args:
        depth: distance D of the centre, metres.
        parts: result of `response`.
    """
    return depth * parts[3] * parts[4]
