"""Test of candidate paths by rays: those that nothing obstructs, and the faces that they meet."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...core.angles import FloatArray
from ...core.types import IntArray
from .legs import SPECULAR, TRANSMISSION
from .seams import UNKNOWN_FACE, Met, with_crossings
from .surfaces import Surfaces

STEP = 5e-7
"""Length that a ray skips behind each face that it meets, as a share of `screens.scale_m`: eight times
the rounding of a coordinate in single precision, as distances of rays are no more exact."""
CLUSTER = 1e-6
"""Largest distance of consecutive points of reflection, as a share of the same, that rays cannot tell apart: the leg to
the first then ends at whichever plane its ray meets."""
WINDOW = 2 * CLUSTER
"""Distance from a point of reflection within which rays cannot tell sides, as a share of the same:
`wrf_mi.tracing.search.seams` finds what is crossed there."""
MOST_CLUSTERED = 3
"""Reflections in a cluster: three planes meet in a corner."""
NO_PLANE = 0xFFFFFFFF
"""Plane of the end of the last leg, the target."""
REFLECTS = 1 << 31
"""Bit of a face's number that tells a reflection from a transmission."""


def unobstructed(surfaces: Surfaces, vertices_m: FloatArray, plane: IntArray, depth: int, transmission: bool) -> Met:
    """Candidates that are paths.

    A ray follows each leg to the next vertex. The plane that reflects there has to be met at the end of the leg;
    surfaces before are passed, or obstruct the path. Faces are closed (`screens`): a ray that meets an
    edge is obstructed by what ends there. So is a reflection at the foot of a wall that stands between both legs
    (`wrf_mi.tracing.search.seams`).

    Mitsuba's surface interaction takes a call of each shape, which to trace and compile takes longer than the rays:
    points are computed from distances here.

    Args:
        surfaces: surfaces of the scene.
        vertices_m: source, points of reflection and target of each candidate [n, b + 2, 3], metres; vertices beyond the
            target are not read. No vertex but those of reflection may lie on a surface.
        plane: plane of each reflection from the source on [n, b], -1 beyond the last.
        depth: largest number of interactions.
        transmission: whether waves pass surfaces.
    """
    import drjit as dr
    import mitsuba as mi

    from ...backend.device import to_uint, to_vectors

    size, legs = len(plane), plane.shape[1] + 1
    if not size or not len(surfaces.triangles):
        nothing = np.zeros((size, depth), np.uint8)
        return Met(np.arange(size), nothing, nothing.astype(np.int64) - 1, np.full((*nothing.shape, 3), np.nan))
    scene, plane_of = surfaces.screens, surfaces.faces_on_device[1]
    lane = dr.arange(mi.UInt32, size)
    vertices = to_vectors(vertices_m.reshape(-1, 3) - surfaces.centre_m, mi.Point3f)
    # Beyond the last leg, the planes of further reflections of a cluster are read.
    stride = legs + MOST_CLUSTERED - 1
    ends_at = np.pad(plane, ((0, 0), (0, MOST_CLUSTERED)), constant_values=-1)
    planes = to_uint(np.where(ends_at < 0, NO_PLANE, ends_at))
    together = to_uint(clusters(vertices_m, plane, CLUSTER * surfaces.scale_m))
    # Runtime arguments, so that Dr.Jit reuses the kernel for all depths.
    slots, most = dr.opaque(mi.UInt32, depth), dr.opaque(mi.UInt32, 4 * (depth + legs))
    through = dr.opaque(mi.Bool, transmission)
    skip, window = (dr.opaque(mi.Float, share * surfaces.scale_m) for share in (STEP, WINDOW))
    codes = dr.full(mi.UInt32, REFLECTS | UNKNOWN_FACE, size * depth)
    points = dr.zeros(mi.Point3f, size * depth)

    def body(active: Any, reached: Any, leg: Any, step: Any, count: Any, way: Any, last: Any) -> Any:
        start = dr.gather(mi.Point3f, vertices, lane * (legs + 1) + leg, active)
        end = dr.gather(mi.Point3f, vertices, lane * (legs + 1) + leg + 1, active)
        length = dr.norm(end - start)
        direction: Any = (end - start) / length
        expected = [dr.gather(mi.UInt32, planes, lane * stride + leg + k, active) for k in range(MOST_CLUSTERED)]
        cluster = dr.gather(mi.UInt32, together, lane * legs + leg, active)  # reflections at the end of the leg
        origin = start + direction * way
        hit = scene.ray_intersect_preliminary(mi.Ray3f(origin, direction), coherent=False, active=active)
        hits = active & hit.is_valid()
        met: Any = origin + direction * hit.t
        at = way + hit.t
        plane_met = dr.gather(mi.UInt32, plane_of, hit.prim_index, hits)

        arriving: Any = expected[0] == NO_PLANE
        place = mi.UInt32(MOST_CLUSTERED)  # of the plane in the cluster, whose other faces are found afterwards
        for k in reversed(range(MOST_CLUSTERED)):
            place = dr.select(hits & (plane_met == expected[k]) & (k < cluster), mi.UInt32(k), place)
        mirrors: Any = place < MOST_CLUSTERED
        # Rays do not tell a plane that ends at the point of reflection from the one that reflects: either is the end.
        at_end: Any = hits & ~arriving & (at > length - window) & (at < length + window)
        reflects: Any = (mirrors | at_end) & (count + cluster <= slots)
        # A plane beyond the end is not met: the target is reached, or the plane that reflects has no face there.
        ends = active & ~reflects & (~hits | (at >= length + dr.select(arriving, -skip, window)))
        # A straight line meets a plane once: a second hit is a seam of its faces, or rounding.
        again: Any = (plane_met == last[0]) | (plane_met == last[1]) | (plane_met == last[2])
        beside: Any = at < dr.select(leg == 0, 0, window)
        crosses = hits & ~reflects & ~ends & ~again & ~beside
        passes = crosses & through & (count < slots)
        has_face = (reflects & mirrors) | passes
        slot = lane * slots + count + dr.select(reflects, place, mi.UInt32(0))
        code = hit.prim_index + dr.select(reflects, mi.UInt32(REFLECTS), mi.UInt32(0))
        dr.scatter(codes, code, slot, has_face)
        dr.scatter(points, met, slot, has_face)
        none, zero = mi.UInt32(NO_PLANE), mi.UInt32(0)
        # The next leg begins on the planes of the cluster.
        turned = [dr.select(k < cluster, expected[k], none) for k in range(MOST_CLUSTERED)]
        straight = [plane_met, last[0], last[1]]
        return (
            hits & ~ends & (reflects | passes | again | beside) & (step < most),
            reached | (ends & arriving),
            leg + dr.select(reflects, cluster, zero),
            step + 1,
            count + dr.select(reflects, cluster, dr.select(passes, mi.UInt32(1), zero)),
            dr.select(reflects, mi.Float(0), at + skip),
            [dr.select(reflects, t, dr.select(crosses, m, b)) for t, m, b in zip(turned, straight, last, strict=True)],
        )

    none = dr.zeros(mi.UInt32, size)
    begin = dr.full(mi.Bool, True, size), dr.full(mi.Bool, False, size), none, none, none, dr.zeros(mi.Float, size)
    state = (*begin, [dr.full(mi.UInt32, NO_PLANE, size) for _ in range(MOST_CLUSTERED)])
    reached, count = dr.while_loop(state, lambda active, *_: active, body)[1:5:3]
    dr.eval(reached, count, codes, points)
    is_path = np.flatnonzero(reached.numpy())
    code = codes.numpy().reshape(size, depth)[is_path].astype(np.int64)
    used = np.arange(depth) < count.numpy()[is_path, None]
    kinds = np.where(code >= REFLECTS, SPECULAR, TRANSMISSION)
    points_m = np.moveaxis(points.numpy().reshape(3, size, depth), 0, -1)[is_path].astype(float)
    met = Met(
        is_path,
        np.where(used, kinds, 0).astype(np.uint8),
        np.where(used, code % REFLECTS, -1),
        np.where(used[..., None], points_m + surfaces.centre_m, np.nan),
    )
    return with_crossings(surfaces, vertices_m[is_path], plane[is_path], met, transmission)


def clusters(vertices_m: FloatArray, plane: IntArray, apart_m: float) -> IntArray:
    """Number of reflections at the end of each leg [n, b + 1] that no distance tells apart, `MOST_CLUSTERED` at most.

    0 for the leg that ends at the target. For vertices and planes as of `unobstructed`; rays tell points apart that are
    more than ``apart_m`` from each other.
    """
    number = (plane >= 0).astype(np.int64)
    for level in reversed(range(plane.shape[1] - 1)):
        gap = np.linalg.norm(vertices_m[:, level + 2] - vertices_m[:, level + 1], axis=1)
        joined = (plane[:, level + 1] >= 0) & (gap < apart_m)
        number[:, level] += np.where(joined, np.minimum(number[:, level + 1], MOST_CLUSTERED - 1), 0)
    return np.pad(number, ((0, 0), (0, 1)))
