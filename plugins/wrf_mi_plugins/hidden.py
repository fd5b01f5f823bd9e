"""Removal of Gaussians that opaque walls hide from all rays of a bundle, with a bound on the error.

Blending goes by the distance of centres, walls act at a Gaussian's strongest point on the ray: a Gaussian behind a wall
may precede one before the wall in the list, and hides it. So only the end of a list is cut, from where on all its
Gaussians lie behind walls that pass at most the share p of the power on each of the bundle's rays. The sum cut off is

    |sum_{k >= j} w_k S_k W_k T_k| <= sqrt(p) |T_j| M_j <= sqrt(p) M_j

with M_j the largest |S_k| cut off, as their weights add up to less than one (alpha blending), or their sum (product
blending, where |T| <= 1). Derivatives by S_k, which
are w_k W_k T_k, are below sqrt(p) too.

A Gaussian lies behind anything nearer than its distance less three of its largest standard deviations, low-pass
included: its cut-off ellipsoid ends there, before its strongest point on any ray that sees it.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from wrf_mi.gaussians.footprint import CUTOFF, LOW_PASS_RAD
from wrf_mi.gaussians.parameters import Gaussians

from .blend_rays import Walls
from .bundles import Bundles, RayLists
from .ray_response import RayFootprints

ROUNDING = 1e-5
"""Share of a distance by which a Gaussian must be farther than a wall: some roundings of float32."""


def without_hidden(
    lists: RayLists, bundles: Bundles, gaussians: Gaussians, footprints: RayFootprints, walls: Walls, power: float
) -> RayLists:
    """The lists without the ends that walls hide.

    Args:
        lists: Gaussians of each bundle, near to far.
        bundles: the rays.
        gaussians: Gaussians with batch 1.
        footprints: responses of the Gaussians along rays.
        walls: walls that the rays cross.
        power: largest share of the power that opaque walls pass.
    """
    with dr.suspend_grad():
        far = _opaque_from(walls, bundles, power)
        depth = mi.Float(footprints.depth)
        widest = dr.maximum(dr.maximum(*gaussians.scale[:2]), gaussians.scale[2])
        near = depth - CUTOFF * dr.sqrt(widest * widest + dr.square(LOW_PASS_RAD * depth))
        dr.eval(far, near)
        end = _seen_end(lists, near, far)
        dr.eval(end)
    return RayLists(lists.index, lists.begin, end)


def _opaque_from(walls: Walls, bundles: Bundles, power: float) -> Any:
    """Distance beyond which walls pass at most this share along each ray of a bundle, [bundles]; infinite: none."""
    k = walls.k
    ray = dr.arange(mi.UInt32, dr.width(walls.distance) // k)
    opaque, still = dr.full(mi.Float, dr.inf, dr.width(ray)), mi.Bool(True)
    for crossed in range(k, 0, -1):
        re, im = (dr.gather(mi.Float, f, ray * (k + 1) + crossed) for f in (walls.factor_re, walls.factor_im))
        still &= re * re + im * im <= power
        opaque = dr.select(still, dr.gather(mi.Float, walls.distance, ray * k + (crossed - 1)), opaque)
    far = dr.zeros(mi.Float, dr.width(bundles.axis[0]))
    dr.eval(opaque, far)
    for ray, active in zip(bundles.ray, bundles.active, strict=True):
        dr.scatter_reduce(dr.ReduceOp.Max, far, dr.gather(mi.Float, opaque, ray), bundles.bundle, active)
    return far


@dr.syntax
def _seen_end(lists: RayLists, near: Any, far: Any) -> Any:
    """End of each list behind its last Gaussian that is not hidden, [bundles]."""
    j, end, last = mi.UInt32(lists.begin), mi.UInt32(lists.end), mi.UInt32(lists.begin)
    behind = far * (1 + ROUNDING)
    while j < end:
        hidden = dr.gather(mi.Float, near, dr.gather(mi.UInt32, lists.index, j)) > behind
        j += 1
        last = dr.select(hidden, last, j)
    return last
