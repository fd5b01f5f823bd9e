"""Rays from one point, in bundles of similar direction that share one list of Gaussians.

A lane of a vector register owns a few rays of a bundle, and each record of a Gaussian that it reads serves them all.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from wrf_mi.backend.device import on_device
from wrf_mi.gaussians.tiles import LANE_ROWS, TILE_COLUMNS, TILE_ROWS, tiling


@dataclass
class Bundles:
    """Rays from one point, in bundles of similar direction.

    Attributes:
        direction: for each of a lane's rays its unit vector, receiver's frame, three arrays [lanes].
        ray: for each of a lane's rays its number, [lanes].
        active: for each of a lane's rays: False where it only fills the bundle, [lanes].
        place: for each ray its position among all first rays of lanes, then all second ones and so on, [rays].
        bundle: bundle of each lane, [lanes].
        axis: middle direction of each bundle, unit vectors, three arrays [bundles].
        margin_rad: largest angle between a ray and the axis of its bundle, and room for rounding.
    """

    direction: list[list[Any]]
    ray: list[Any]
    active: list[Any]
    place: Any
    bundle: Any
    axis: list[Any]
    margin_rad: float


@dataclass
class RayLists:
    """For each bundle the Gaussians that its rays may meet, from near to far.

    Attributes:
        index: numbers of Gaussians, all lists concatenated.
        begin: begin of each list in ``index``, [bundles].
        end: end of each list, [bundles].
    """

    index: Any
    begin: Any
    end: Any


TILES = ((TILE_ROWS, TILE_COLUMNS, LANE_ROWS), (1, 1, 1))
"""Rows and columns of pixels in a bundle, and rows in a lane: the first with bundles narrow enough is taken."""

WIDEST_RAD = np.radians(15.0)
"""Largest margin of a bundle. Its list holds all Gaussians within the margin, most of them in vain in a wide one."""


def ray_bundles(direction: list[Any], height: int, width: int) -> Bundles:
    """Put the rays of an image into bundles.

    Args:
        direction: unit vectors, receiver's frame, three arrays [height * width], row-major.
        height: rows.
        width: columns.
    """
    float_type: Any = type(direction[0])
    index_type, mask_type = dr.uint32_array_t(float_type), dr.mask_t(float_type)
    for tile in TILES:
        members, lanes, inside = tiling(height, width, tile)
        size = members.shape[1]
        index = on_device(members, index_type)
        rays = [dr.gather(float_type, c, index) for c in direction]
        axis = [dr.block_sum(c, size) for c in rays]
        norm = dr.rsqrt(axis[0] ** 2 + axis[1] ** 2 + axis[2] ** 2)
        axis = [c * norm for c in axis]
        repeated = [dr.repeat(c, size) for c in axis]
        chord = dr.max(sum((a - b) ** 2 for a, b in zip(rays, repeated, strict=True)))
        dr.eval(axis, chord)
        # Rays that point everywhere have no middle: NaN, which is not narrow.
        margin = float(2 * np.arcsin(min(np.sqrt(chord[0]) / 2, 1.0)))
        if margin <= WIDEST_RAD:
            break
    ray = [on_device(r, index_type) for r in lanes]
    result = Bundles(
        direction=[[dr.gather(float_type, c, r) for c in direction] for r in ray],
        ray=ray,
        active=[on_device(i, mask_type) for i in inside],
        place=on_device(np.flatnonzero(inside)[np.argsort(lanes[inside])], index_type),
        bundle=dr.arange(index_type, lanes.shape[1]) // (size // tile[2]),
        axis=axis,
        # A single ray is its own axis; else float32 directions are accurate to 1e-7.
        margin_rad=margin + 1e-5 if size > 1 else 0.0,
    )
    dr.eval(result.direction, result.ray, result.active, result.place, result.bundle)
    return result


def all_lists(order: Any, bundles: Bundles) -> RayLists:
    """Lists that hold every Gaussian: no acceleration, for any number type.

    Args:
        order: Gaussians from near to far, [n].
        bundles: the rays.
    """
    count, n = dr.width(bundles.axis[0]), dr.width(order)
    begin = dr.arange(type(order), count) * n
    return RayLists(dr.tile(order, count), begin, begin + n)
