"""Lists of the Gaussians that the rays of a bundle meet, by Mitsuba's ray tracing of the ``ellipsoids`` shape.

A ray through many overlapping ellipsoids costs one trace per hit, and each trace tests those around its start again.
Three measures keep that small:

* one ray is traced for each bundle, through ellipsoids grown by the bundle's width
  (`wrf_mi_plugins.ray_response.hulls`);
* the ellipsoids are distributed over many parts far from each other and traced in each, so that few overlap;
* the caller keeps the lists until the Gaussians' geometry or the receiver changes.

Each ellipsoid is scaled about the receiver so that its centre lies between `NEAREST` and `FARTHEST` by its rank, its
position in the order of distances. Rays meet it as before, but small near ones become as large as far ones relative to
the rounding of float32. Ellipsoids wider than `WIDEST` as the receiver sees them are listed for all rays.

Hits come in order of entry. One sort of numbers (bundle, rank) puts them in order of depth: no buffer limits the
difference between the two orders.

A closest hit hides a second ellipsoid entered at the same point, and the next trace begins a step behind the hit.
So each bundle is traced from both ends: an ellipsoid is lost only if it shares its entry with one ellipsoid of its part
and its exit with one, within `STEP`. Ranks that follow each other lie in different parts, so coincident Gaussians do.
Of 165,000 hits of 4,000 Gaussians of 7 degrees one direction loses some 45, both none: one in 10^7 is to be expected.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from wrf_mi.backend.vectors import Pose
from wrf_mi.gaussians.footprint import depth_order
from wrf_mi.gaussians.parameters import Gaussians

from .bundles import Bundles, RayLists
from .ray_response import Hulls, RayFootprints, hulls, to_world

IN_PART = 64
"""Approximate ellipsoids per part: with fewer, most rays meet none of it; with more, each trace tests many."""

FEWEST_PARTS, MOST_ACROSS = 16, 16
"""Parts at least, and along each side of their cube at most: more would be too far from the origin for float32."""

NEAREST, FARTHEST = 1000.0, 4000.0
"""Distances of the nearest and of the farthest centre in the traced scene.

Mitsuba 3.9 intersects ellipsoids in float32 and loses rays through the middle of those with a semi-axis far below 1: a
quarter of them at 0.016 in a distance of 1, and none at 16 in a distance of 1000.
"""

WIDEST = 2.0
"""Largest semi-axis of an ellipsoid that is traced, in distances of its centre."""

SIZE = FARTHEST * (1 + WIDEST)
"""Radius around the receiver that holds all that is traced."""

STEP = 1e-4 * NEAREST
"""Step behind a hit: some roundings of float32 at the farthest part, and a hundredth of the smallest ellipsoid."""

SPACING = 2 * SIZE + 4 * STEP
"""Distance between parts: rays of one part end before the ellipsoids of the next begin."""

ENTRIES, ENTRIES_EACH = 1 << 18, 8
"""Hits allocated at first, in all and per ellipsoid; if there are more, rays are traced again with enough room.

A thousand Gaussians that overlap as in a default field have 32 each, 100,000 of them 6.
"""


def traced_lists(gaussians: Gaussians, footprints: RayFootprints, pose: Pose, bundles: Bundles) -> RayLists:
    """For each bundle the Gaussians that its rays may meet, near to far, each once.

    Args:
        gaussians: Gaussians with batch 1.
        footprints: responses of these Gaussians from ``pose``.
        pose: pose of the receiver.
        bundles: rays of the receiver.
    """
    order = depth_order(footprints.depth, gaussians.position)
    visible: Any = dr.compress(dr.gather(mi.Bool, footprints.visible, order))
    order = dr.gather(mi.UInt32, order, visible)
    lists = dr.width(bundles.axis[0])
    if dr.width(order) == 0:
        return RayLists(mi.UInt32(0), dr.zeros(mi.UInt32, lists), dr.zeros(mi.UInt32, lists))
    key_type: Any = mi.UInt32 if lists * dr.width(order) < 2**32 else mi.UInt64
    # Numbers that change with the geometry stay on the device: as constants of kernels they would compile new ones.
    count = dr.opaque(key_type, dr.width(order))
    ellipsoids = _scaled(hulls(gaussians, pose, bundles.margin_rad), order)
    widest = dr.maximum(dr.maximum(*ellipsoids.radius[:2]), ellipsoids.radius[2]) / _distance(ellipsoids)
    narrow, wide = (mi.UInt32(dr.compress(m)) for m in (widest <= WIDEST, widest > WIDEST))
    key_arrays = []
    if dr.width(wide) > 0:
        bundle = dr.repeat(dr.arange(mi.UInt32, lists), dr.width(wide))
        key_arrays.append(key_type(bundle) * count + key_type(dr.tile(wide, lists)))
    if dr.width(narrow) > 0:
        key_arrays.append(_hits(ellipsoids, narrow, pose, bundles, count))
    keys = dr.sort(dr.concat(key_arrays))
    number = dr.arange(mi.UInt32, dr.width(keys))
    first = (number == 0) | (keys != dr.gather(key_type, keys, dr.maximum(number, 1) - 1))
    distinct: Any = dr.compress(first)
    keys = dr.gather(key_type, keys, distinct)
    length = dr.zeros(mi.UInt32, lists)
    dr.scatter_add(length, mi.UInt32(1), mi.UInt32(keys // count))
    end = dr.cumsum(length)
    result = RayLists(dr.gather(mi.UInt32, order, mi.UInt32(keys % count)), end - length, end)
    dr.eval(result)
    return result


def _distance(ellipsoids: Hulls) -> Any:
    return dr.norm(mi.Vector3f(*ellipsoids.centre))


def _scaled(ellipsoids: Hulls, order: Any) -> Hulls:
    """The ellipsoids in the order of their ranks, scaled about the receiver."""
    ellipsoids = ellipsoids.at(order)
    rank = dr.arange(mi.Float, dr.width(order)) / dr.opaque(mi.Float, dr.width(order))
    scale = dr.lerp(NEAREST, FARTHEST, rank) / _distance(ellipsoids)
    result = Hulls([c * scale for c in ellipsoids.centre], [r * scale for r in ellipsoids.radius], ellipsoids.rotation)
    dr.eval(result.centre, result.radius, result.rotation)
    return result


def _hits(ellipsoids: Hulls, rank: Any, pose: Pose, bundles: Bundles, count: Any) -> Any:
    """Numbers ``bundle * count + rank`` of the ellipsoids of these ranks that the bundles' axes meet, some twice."""
    ellipsoids = ellipsoids.at(rank)
    # Room for rounding.
    ellipsoids.radius = [r + STEP for r in ellipsoids.radius]
    n, lists, key_type = dr.width(rank), dr.width(bundles.axis[0]), type(count)
    parts = int(np.clip(-(-n // IN_PART), FEWEST_PARTS, MOST_ACROSS**3))
    across = int(np.ceil(round(parts ** (1 / 3), 6)))
    place = _place(dr.arange(mi.UInt32, n) % parts, across)
    columns = [
        *(c + x for c, x in zip(ellipsoids.centre, place, strict=True)),
        *ellipsoids.radius,
        *ellipsoids.rotation,
    ]
    data = dr.concat([mi.TensorXf(c, (n, 1)) for c in columns], axis=1)
    shape = {"type": "ellipsoids", "data": data, "extent": 1.0, "extent_adaptive_clamping": False}
    scene = mi.load_dict({"type": "scene", "hulls": shape})

    # No closest hit reports an ellipsoid from within: rays begin in front of those that hold the receiver.
    distance, radius = _distance(ellipsoids), dr.maximum(dr.maximum(*ellipsoids.radius[:2]), ellipsoids.radius[2])
    behind = dr.max(dr.select(radius + STEP > distance, distance + radius + STEP, 0))
    ray = dr.arange(mi.UInt32, 2 * parts * lists)
    axis = [dr.gather(mi.Float, c, ray % lists) for c in bundles.axis]
    turned = dr.detach(mi.Vector3f(*to_world(pose, axis)))
    back = ray >= parts * lists
    end = SIZE + STEP
    origin = _place((ray // lists) % parts, across) + turned * dr.select(back, end, -behind)
    rays: Any = mi.Ray3f(origin, dr.select(back, -turned, turned), end + behind, 0.0, [])  # type: ignore[call-overload]
    first = key_type(ray % lists) * count
    dr.eval(rays, first, rank)
    room = max(ENTRIES, ENTRIES_EACH * n)
    keys, used = _trace(scene, rays, first, rank, dr.opaque(mi.UInt32, room), room)
    if used > room:
        keys, used = _trace(scene, rays, first, rank, dr.opaque(mi.UInt32, used), used)
    return dr.gather(key_type, keys, dr.arange(mi.UInt32, used))


def _place(part: Any, across: int) -> Any:
    """Position of the receiver in a part."""
    middle = (across - 1) / 2
    x, y, z = mi.Float(part % across), mi.Float(part // across % across), mi.Float(part // across**2)
    return mi.Point3f((x - middle) * SPACING, (y - middle) * SPACING, (z - middle) * SPACING)


@dr.syntax
def _trace(scene: Any, start: Any, first: Any, rank: Any, room: Any, entries: int) -> tuple[Any, int]:
    """Each ray's ``first`` plus the rank of each hit, unsorted, and their number, which may exceed the room.

    ``room`` is ``entries`` as an array of width 1.
    """
    key_type: Any = type(first)
    keys, used = dr.empty(key_type, entries), dr.zeros(mi.UInt32, 1)
    dr.eval(keys, used)
    t = mi.Float(0)
    active = mi.Bool(True)
    while active:
        ray = mi.Ray3f(start.o + t * start.d, start.d)
        ray.maxt = start.maxt - t
        hit = scene.ray_intersect_preliminary(ray, coherent=True, active=active)
        active &= hit.is_valid()
        slot = dr.scatter_inc(used, mi.UInt32(0), active)
        hit_rank = key_type(dr.gather(mi.UInt32, rank, hit.prim_index, active))
        dr.scatter(keys, first + hit_rank, slot, active & (slot < room))
        t += hit.t + STEP
    dr.eval(keys, used)
    return keys, int(used[0])
