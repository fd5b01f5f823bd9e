"""Test of candidate paths by rays: those that nothing obstructs, and the faces that they meet."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.angles import FloatArray
from ..core.types import IntArray
from .buffer import SPECULAR, TRANSMISSION
from .surfaces import Surfaces

END_M = 1e-4
"""Distance from the end of a leg within which a surface does not obstruct it."""
NO_PLANE = 0xFFFFFFFF
"""Plane of the end of the last leg, the target."""
REFLECTS = 1 << 31
"""Bit of a face's number that tells a reflection from a transmission."""


class Met(NamedTuple):
    """Paths and what they meet.

    Attributes:
        candidate: indices of the candidates that are paths [k].
        interactions: ``InteractionType`` of each interaction from the source on [k, depth], 0 beyond the last.
        face: faces [k, depth], -1 beyond the last.
        points_m: points in single precision [k, depth, 3], metres, NaN beyond the last.
    """

    candidate: IntArray
    interactions: NDArray[np.uint8]
    face: IntArray
    points_m: FloatArray


def unobstructed(
    scene: Any, surfaces: Surfaces, vertices_m: FloatArray, plane: IntArray, depth: int, transmission: bool
) -> Met:
    """Candidates that are paths.

    A ray follows each leg to the next vertex. The plane that reflects there has to be the first surface at the end of
    the leg; surfaces before are passed, or obstruct the path. Interactions that are not farther apart than Sionna RT's
    ``MIN_SEGMENT_LENGTH`` end a path, as they do in its image method.

    Mitsuba's surface interaction takes a call of each shape, which to trace and compile takes longer than the rays:
    points are computed from distances here.

    Args:
        scene: ``sionna.rt.Scene``.
        surfaces: its surfaces.
        vertices_m: source, points of reflection and target of each candidate [n, b + 2, 3], metres; vertices beyond the
            target are not read.
        plane: plane of each reflection from the source on [n, b], -1 beyond the last.
        depth: largest number of interactions.
        transmission: whether waves pass surfaces.
    """
    import drjit as dr
    import mitsuba as mi
    from sionna.rt.constants import MIN_SEGMENT_LENGTH

    from ..backend.device import to_uint, to_vectors

    size, legs = len(plane), plane.shape[1] + 1
    if not size or not len(surfaces.triangles):
        kept = np.flatnonzero(np.linalg.norm(vertices_m[:, 1] - vertices_m[:, 0], axis=1) > MIN_SEGMENT_LENGTH)
        nothing = np.zeros((len(kept), depth), np.uint8)
        return Met(kept, nothing, nothing.astype(np.int64) - 1, np.full((*nothing.shape, 3), np.nan))
    lane = dr.arange(mi.UInt32, size)
    vertices = to_vectors(vertices_m.reshape(-1, 3), mi.Point3f)
    planes = to_uint(np.pad(np.where(plane < 0, NO_PLANE, plane), ((0, 0), (0, 1)), constant_values=NO_PLANE))
    first_face, plane_of = surfaces.faces_on_device
    # As data, not as code: the same kernel serves all depths.
    slots, most = dr.opaque(mi.UInt32, depth), dr.opaque(mi.UInt32, 2 * (depth + legs))
    through = dr.opaque(mi.Bool, transmission)
    codes = dr.zeros(mi.UInt32, size * depth)
    points = dr.zeros(mi.Point3f, size * depth)

    def body(active: Any, reached: Any, leg: Any, step: Any, count: Any, way: Any, before: Any, last: Any) -> Any:
        start = dr.gather(mi.Point3f, vertices, lane * (legs + 1) + leg, active)
        end = dr.gather(mi.Point3f, vertices, lane * (legs + 1) + leg + 1, active)
        length = dr.norm(end - start)
        direction: Any = (end - start) / length
        expected = dr.gather(mi.UInt32, planes, lane * legs + leg, active)
        origin = start + direction * way
        hit = scene.mi_scene.ray_intersect_preliminary(mi.Ray3f(origin, direction), coherent=False, active=active)
        there = active & hit.is_valid()
        met: Any = origin + direction * hit.t
        shape: Any = dr.reinterpret_array(mi.UInt32, hit.shape)
        face = dr.gather(mi.UInt32, first_face, shape, there) + hit.prim_index
        here = dr.gather(mi.UInt32, plane_of, face, there)

        reflects = there & (here == expected)
        ends = active & ~reflects & (~there | (way + hit.t >= length - END_M))
        meets = reflects | (there & ~ends & (here != before))  # a straight line meets a plane once
        arrives = ends & (expected == NO_PLANE)
        apart = dr.norm(dr.select(arrives, end, met) - last) > MIN_SEGMENT_LENGTH
        taken = meets & (reflects | through) & (count < slots) & apart
        code = face + dr.select(reflects, mi.UInt32(REFLECTS), mi.UInt32(0))
        dr.scatter(codes, code, lane * slots + count, taken)
        dr.scatter(points, met, lane * slots + count, taken)
        # As far as Mitsuba moves the origin of a ray: by an error of rounding that grows with the coordinates.
        beyond = way + hit.t + (1 + dr.max(dr.abs(met))) * mi.math.RayEpsilon
        return (
            there & ~ends & (taken | ~meets) & (step < most),
            reached | (arrives & apart),
            leg + dr.select(reflects, mi.UInt32(1), mi.UInt32(0)),
            step + 1,
            count + dr.select(taken, mi.UInt32(1), mi.UInt32(0)),
            dr.select(reflects, mi.Float(0), beyond),
            dr.select(there, here, before),
            mi.Point3f(dr.select(taken, met, last)),
        )

    none = dr.zeros(mi.UInt32, size)
    source = dr.gather(mi.Point3f, vertices, lane * (legs + 1))
    begin = dr.full(mi.Bool, True, size), dr.full(mi.Bool, False, size), none, none, none, dr.zeros(mi.Float, size)
    state = (*begin, dr.full(mi.UInt32, NO_PLANE, size), source)
    reached, count = dr.while_loop(state, lambda active, *_: active, body)[1:5:3]
    dr.eval(reached, count, codes, points)
    kept = np.flatnonzero(reached.numpy())
    code = codes.numpy().reshape(size, depth)[kept].astype(np.int64)
    found = np.arange(depth) < count.numpy()[kept, None]
    kinds = np.where(code >= REFLECTS, SPECULAR, TRANSMISSION)
    points_m = np.moveaxis(points.numpy().reshape(3, size, depth), 0, -1)[kept].astype(float)
    return Met(
        kept,
        np.where(found, kinds, 0).astype(np.uint8),
        np.where(found, code % REFLECTS, -1),
        np.where(found[..., None], points_m, np.nan),
    )
