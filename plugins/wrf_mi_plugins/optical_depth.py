"""Gaussians as an absorbing medium: extinction at a point, and its integral along a ray in closed form.

A field gives the transmission through the centre of a Gaussian, 1 - alpha or |delta|, for every direction alike. An
extinction that depends on position alone cannot do that for a Gaussian that is not round, because the length of the way
through it differs. The extinction therefore depends on the ray's direction d too, as in media of microflakes (Jakob et
al. 2010), and is equal forwards and backwards:

    sigma(x, d) = sum_i w_i(d) exp(-m_i(x)^2 / 2) where m_i(x) < CUTOFF, else 0
    w_i(d)      = tau_i |W_i d| / (sqrt(2 pi) erf(CUTOFF / sqrt(2))),   m_i(x) = |W_i (x - mu_i)|
    tau_i       = -log(1 - alpha_i) or -log |delta_i|,                  W_i = diag(1 / s_i) R_i^T

The optical depth along any line through the centre is tau_i, whatever the Gaussian's shape, and tau_i G with
G = exp(-m^2 / 2) along a line at Mahalanobis distance m, up to the cut-off. The medium passes (1 - alpha)^G there and
blending 1 - alpha G: equal at the centre, far from it, and to first order in alpha.

The depth between two points of a ray is a difference of error functions. Depths are logarithms: their sum does not
underflow. The phase of delta has no effect.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from wrf_mi.backend.vectors import dot, principal_axes
from wrf_mi.gaussians.footprint import CUTOFF
from wrf_mi.gaussians.parameters import Gaussians, each

from .extinction_cells import CellLists, HostGaussians

LEAST_PASSED = 2.0**-24
"""Transmission of the most opaque Gaussian, an optical depth of 16.6: a smaller 1 - alpha is zero in float32."""

CENTRE_LINE = math.erf(CUTOFF / math.sqrt(2))
"""Share of a Gaussian's line integral that lies within the cut-off, 0.9973; divided out."""

PEAK = 1 / (math.sqrt(2 * math.pi) * CENTRE_LINE)
"""Largest extinction of a Gaussian in units of optical depth per standard deviation along the ray."""

_SHORTEST_HALF_CHORD = 1e-3
"""Shortest half chord in standard deviations: it bounds the derivative of the chord, which is infinite where a ray
grazes the cut-off."""

Vector = list[Any]


@dataclass
class Attenuators:
    """Gaussians as attenuation, arrays [n] of any float type.

    Attributes:
        centre: three arrays, world frame, metres.
        whitening: rows of W = diag(1 / s) R^T, three times three arrays, 1/m.
        depth: optical depth through the centre.
    """

    centre: Vector
    whitening: list[Vector]
    depth: Any

    def at(self, index: Any) -> Attenuators:
        """The Gaussians at ``index``, gathered. Differentiable."""

        def take(a: Any) -> Any:
            return dr.gather(type(a), a, index)

        return Attenuators(each(take, self.centre), [each(take, row) for row in self.whitening], take(self.depth))

    def whiten(self, v: Vector) -> Vector:
        """Vectors W v."""
        return [dot(row, v) for row in self.whitening]


def attenuators(gaussians: Gaussians) -> Attenuators:
    """The attenuation of a field's Gaussians for one transmitter. Differentiable.

    The optical depth is -log(1 - alpha) or -log |delta|, at most 16.6.

    Args:
        gaussians: Gaussians with batch 1.

    Raises:
        ValueError: Gaussians for several transmitters.
    """
    if gaussians.batch != 1:
        raise ValueError(f"attenuators: Gaussians for {gaussians.batch} transmitters; give those of one")
    blending: list[Any] = gaussians.blending
    if len(blending) == 1:
        depth = -dr.log(dr.maximum(1 - blending[0], LEAST_PASSED))
    else:
        re, im = blending
        depth = dr.maximum(-0.5 * dr.log(dr.maximum(re * re + im * im, LEAST_PASSED**2)), 0)
    axes = principal_axes(gaussians.rotation)
    rows = [[a / s for a in axis] for s, axis in zip(gaussians.scale, axes, strict=True)]
    return Attenuators(list(gaussians.position), rows, depth)


def on_host(of: Attenuators) -> HostGaussians:
    """Gaussians in float64 on the host, each with its largest extinction in any direction."""
    dr.eval(of.centre, of.whitening, of.depth)  # one kernel, not one for each

    def plain(arrays: Vector) -> Any:
        return np.stack([dr.detach(a).numpy().astype(float) for a in arrays], axis=-1)

    whitening = np.stack([plain(row) for row in of.whitening], axis=1)
    # The rows of W are orthogonal: the longest is its norm.
    densest = np.linalg.norm(whitening, axis=2).max(axis=1)
    return HostGaussians(plain(of.centre), whitening, plain([of.depth])[:, 0] * densest * PEAK)


def closest_approach(of: Attenuators, origin: Vector, direction: Vector) -> tuple[Any, Any, Any]:
    """Passage of each line by one Gaussian: (m^2, t, c). Differentiable.

    m is the smallest Mahalanobis distance of the line from the centre, t the distance in metres along it to that point,
    and c the number of standard deviations per metre along it.
    """
    # From the point nearest to the centre, in metres: whitening a far origin would cost a needle its digits.
    offset = [o - c for o, c in zip(origin, of.centre, strict=True)]
    near = -dot(offset, direction)
    p = of.whiten([dr.fma(near, d, o) for o, d in zip(offset, direction, strict=True)])
    q = of.whiten(direction)
    square = dot(q, q)
    further = -dot(p, q) / square
    p = [dr.fma(further, b, a) for a, b in zip(p, q, strict=True)]
    return dot(p, p), near + further, dr.sqrt(square)


def depth_between(of: Attenuators, origin: Vector, direction: Vector, near_m: Any, far_m: Any) -> Any:
    """Optical depth of each ray through one Gaussian each, see `optical_depth`."""
    square, t, per_metre = closest_approach(of, origin, direction)
    left = CUTOFF * CUTOFF - square
    half = dr.select(left > _SHORTEST_HALF_CHORD**2, dr.sqrt(dr.maximum(left, _SHORTEST_HALF_CHORD**2)), 0)
    reach = half / per_metre
    # Cut off in metres: scaled, an infinite distance would have no derivative.
    start, end = ((dr.clip(x, t - reach, t + reach) - t) * per_metre for x in (near_m, far_m))
    passed = dr.erf(end * math.sqrt(0.5)) - dr.erf(start * math.sqrt(0.5))
    return of.depth * dr.exp(-0.5 * square) * passed * (0.5 / CENTRE_LINE)


def extinction_of(of: Attenuators, position: Vector, direction: Vector) -> Any:
    """Extinction at each point by one Gaussian each, see `extinction`."""
    p = of.whiten([x - c for x, c in zip(position, of.centre, strict=True)])
    q = of.whiten(direction)
    square = dot(p, p)
    return dr.select(square < CUTOFF * CUTOFF, of.depth * dr.sqrt(dot(q, q)) * dr.exp(-0.5 * square) * PEAK, 0)


@dr.syntax
def _sum(term: Callable[..., Any], i: Any, last: Any, at: list[Any], total: Any) -> Any:
    """Sum of ``term(i, at)`` from ``i`` up to ``last``.

    Variables of the loop have one width: ``at`` holds arrays that differ between lanes; tables are not among them.
    """
    while dr.hint(i < last, max_iterations=-1):
        total += term(i, at)
        i += 1
    return total


def optical_depth(of: Attenuators, origin: Vector, direction: Vector, near_m: Any, far_m: Any) -> Any:
    """Optical depth of rays between two distances: minus the logarithm of the transmittance, in closed form.

    Every Gaussian is visited for every ray, some 10 ns each on two cores; memory does not grow with their number.
    Differentiable in both modes with respect to Gaussians and rays.

    Args:
        of: attenuation of n Gaussians.
        origin: three arrays [r], metres.
        direction: three arrays [r], unit vectors.
        near_m: array [r], begin of the segment, metres from the origin.
        far_m: array [r], end of the segment; may be infinite.

    Returns:
        Array [r], at least 0.
    """
    Float = type(of.depth)
    rays = max(dr.width(v) for v in (*origin, *direction, near_m, far_m))
    first = dr.zeros(dr.uint32_array_t(Float), rays)

    def term(i: Any, at: list[Any]) -> Any:
        return depth_between(of.at(i), *at)

    at = [origin, direction, near_m, far_m]
    return _sum(term, first, type(first)(dr.width(of.depth)), at, dr.zeros(Float, rays))


def extinction(of: Attenuators, cells: CellLists, position: Vector, direction: Vector, active: Any = True) -> Any:
    """Extinction sigma at points for rays through them, from the Gaussians listed in each point's cell. Differentiable.

    Args:
        of: attenuation of the Gaussians that ``cells`` were made from.
        cells: grid from `wrf_mi_plugins.extinction_cells.to_device`.
        position: three arrays [p], metres.
        direction: three arrays [p], unit vectors; its sign does not matter.
        active: mask [p].

    Returns:
        Array [p], 1/m; 0 outside the cells.
    """

    def term(i: Any, at: list[Any]) -> Any:
        return extinction_of(of.at(dr.gather(type(i), cells.index, i)), *at)

    first, last = cells.range_at(position, active)
    return _sum(term, first, last, [position, direction], dr.zeros(type(of.depth), dr.width(first)))
