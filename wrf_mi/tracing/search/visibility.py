"""Test of candidate paths: those that nothing obstructs, and the faces that they meet.

Rays in single precision follow the legs. At a point of reflection they cannot tell on which side of a wall it is that
ends there, such as a wall at whose foot the floor reflects. In float64, heights above the wall's plane can: a path
crosses it where the heights of consecutive vertices have opposite signs, once and on one leg.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from trimesh.triangles import closest_point

from ...core.types import FloatArray, IntArray
from .chains import SPECULAR, TRANSMISSION, PathInteractions
from .surfaces import ENLARGED, Surfaces

STEP = 5e-7
"""Length that a ray skips behind each face that it meets, as a share of `Surfaces.scale_m`: eight times
the rounding of a coordinate in single precision, as distances of rays are no more exact."""
CLUSTER = 1e-6
"""Largest distance of consecutive points of reflection, as a share of the same, that rays cannot tell apart: the leg to
the first then ends at whichever plane its ray meets."""
WINDOW = 2 * CLUSTER
"""Distance from a point of reflection within which rays cannot tell sides, as a share of the same:
`with_crossings` finds what is crossed there."""
MOST_CLUSTERED = 3  # reflections in a cluster: three planes meet in a corner
NO_PLANE = 0xFFFFFFFF  # plane of the end of the last leg, the target
REFLECTS = 1 << 31  # bit of a face's number that tells a reflection from a transmission
NEAR = 1e-5
"""Distance from a point of reflection up to which crossings are looked for, as a share of `Surfaces.scale_m`: five
times that within which rays do not count them (`WINDOW`)."""
SEAM_M, SEAM = 5e-5, 1e-6
"""Distance from a face in metres, and as a share of the scale, within which a point is on it: half the gap that sheets
leave which were modelled one by one, `wrf_mi.scene.mesh.surfaces.SAME_CORNER_M`."""
PAIRS_TOGETHER = 1 << 20  # pairs of points and faces in a chunk
UNKNOWN_FACE = (1 << 31) - 1  # face of a reflection that rays cannot distinguish from another one at the same point


class ValidPaths(NamedTuple):
    """Paths and what they meet."""

    candidate: IntArray  # indices of the candidates that are paths [k]
    interactions: NDArray[np.uint8]  # ``InteractionType`` of each one from the source on [k, depth], else 0
    face: IntArray  # faces [k, depth], -1 beyond the last
    points_m: FloatArray  # points in single precision [k, depth, 3], metres, NaN beyond the last

    def select(self, which: NDArray[Any]) -> ValidPaths:
        """The paths of a mask or of indices."""
        return ValidPaths(*(array[which] for array in self))

    @property
    def leg(self) -> IntArray:
        """Leg on which, or at whose end, each interaction is: the number of reflections before it [k, depth]."""
        reflects = self.interactions == SPECULAR
        return np.cumsum(reflects, axis=1) - reflects


def unobstructed(
    surfaces: Surfaces, vertices_m: FloatArray, plane: IntArray, depth: int, transmission: bool
) -> ValidPaths:
    """Candidates that are paths: what obstructs none of their legs, and at each reflection the plane that reflects.

    No vertex but those of reflection of ``vertices_m`` [n, b + 2, 3], source, points of reflection and target in
    metres, may lie on a surface; those beyond the target are not read. ``plane`` [n, b] are the planes of the
    reflections from the source on, -1 beyond the last, ``depth`` is the largest number of interactions, and with
    ``transmission`` waves pass surfaces.
    """
    import drjit as dr
    import mitsuba as mi

    from ...backend.device import to_uint, to_vectors

    size, legs = len(plane), plane.shape[1] + 1
    if not size or not len(surfaces.triangles):
        nothing = np.zeros((size, depth), np.uint8)
        return ValidPaths(np.arange(size), nothing, nothing.astype(np.int64) - 1, np.full((*nothing.shape, 3), np.nan))
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

    # A ray follows each leg to the next vertex. The plane that reflects there has to be met at the end of the leg;
    # surfaces before are passed, or obstruct the path. Faces are closed (`Surfaces.screens`): a ray that meets an edge
    # is obstructed by what ends there. Points are computed from distances, since Mitsuba's surface interaction takes a
    # call of each shape, which to trace and compile takes longer than the rays.
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
    inside = np.where(used[..., None], points_m + surfaces.centre_m, np.nan)
    met = ValidPaths(is_path, np.where(used, kinds, 0).astype(np.uint8), np.where(used, code % REFLECTS, -1), inside)
    return with_crossings(surfaces, vertices_m[is_path], plane[is_path], met, transmission)


def clusters(vertices_m: FloatArray, plane: IntArray, apart_m: float) -> IntArray:
    """Number of reflections at the end of each leg [n, b + 1] that rays cannot tell apart, `MOST_CLUSTERED` at most.

    Of vertices and planes as of `unobstructed`, those nearer than ``apart_m``; 0 for the leg that ends at the target.
    """
    number = (plane >= 0).astype(np.int64)
    for level in reversed(range(plane.shape[1] - 1)):
        gap = np.linalg.norm(vertices_m[:, level + 2] - vertices_m[:, level + 1], axis=1)
        joined = (plane[:, level + 1] >= 0) & (gap < apart_m)
        number[:, level] += np.where(joined, np.minimum(number[:, level + 1], MOST_CLUSTERED - 1), 0)
    return np.pad(number, ((0, 0), (0, 1)))


class _Crossings(NamedTuple):
    """Crossings [n]: paths, legs, faces, shares of the legs before them, and points [n, 3]."""

    path: IntArray
    leg: IntArray
    face: IntArray
    share: FloatArray
    points_m: FloatArray

    def select(self, which: NDArray[Any]) -> _Crossings:
        return _Crossings(*(array[which] for array in self))


_Near = tuple[IntArray, IntArray, FloatArray]  # indices of points on planes, a plane near each, and the points


def with_crossings(
    surfaces: Surfaces, vertices_m: FloatArray, plane: IntArray, met: ValidPaths, transmission: bool
) -> ValidPaths:
    """Paths with the surfaces that they cross at points of reflection; without those that are obstructed there."""
    # Of k paths as of `unobstructed`, and what rays met away from the points of reflection, with `UNKNOWN_FACE`, in
    # whose place the nearest face is put, if there is one at the point.
    path, slot = np.nonzero(met.face == UNKNOWN_FACE)
    if len(path):
        level, has_faces = met.leg[path, slot], np.ones(len(plane), bool)
        points = vertices_m[path, level + 1]
        nearest, away_m = nearest_faces(surfaces, plane[path, level], points)
        face, points_m = met.face.copy(), met.points_m.copy()
        face[path, slot], points_m[path, slot] = nearest, points
        has_faces[path[away_m > ENLARGED * surfaces.scale_m]] = False
        met = met._replace(face=face, points_m=points_m).select(has_faces)
        vertices_m, plane = vertices_m[has_faces], plane[has_faces]
    crossings = _crossings(surfaces, vertices_m, plane, met)
    if not len(crossings.path):
        return met
    # Few paths have any: the others stay as they are.
    crossing, path = np.unique(crossings.path, return_inverse=True)
    part = met.select(crossing)
    # Crossings that rays have not met: one number for each path, leg and plane, as a straight leg crosses a plane once.
    row, slot = np.nonzero(part.interactions == TRANSMISSION)
    columns = [(row, part.leg[row, slot], surfaces.plane[part.face[row, slot]])]
    columns += [(path, crossings.leg, surfaces.plane[crossings.face])]
    legs, planes = plane.shape[1] + 1, len(surfaces.normal)
    met_by_rays, crossed = ((number * legs + leg) * planes + at for number, leg, at in columns)
    further = crossings._replace(path=path).select(~np.isin(crossed, met_by_rays))
    if transmission:
        part, valid = _inserted(part, further, vertices_m[crossing])
    else:
        valid = ~np.isin(np.arange(len(crossing)), further.path)
    met.interactions[crossing], met.face[crossing], met.points_m[crossing] = part[1:]
    is_clear = np.ones(len(plane), bool)
    is_clear[crossing[~valid]] = False
    return met if valid.all() else met.select(is_clear)


def _inserted(met: ValidPaths, further: _Crossings, vertices_m: FloatArray) -> tuple[ValidPaths, NDArray[np.bool_]]:
    """Paths [k] with further transmissions, and the mask of those that are not too deep."""
    path, slot = np.nonzero(met.interactions)
    mirrors, leg = met.interactions[path, slot] == SPECULAR, met.leg[path, slot]
    start, end = vertices_m[path, leg], vertices_m[path, leg + 1]
    away = np.linalg.norm(met.points_m[path, slot] - start, axis=1) / np.linalg.norm(end - start, axis=1)
    # Transmissions by their share of the leg; reflections end it, hence a share beyond 1, those of a cluster in order.
    place = np.concatenate([np.where(mirrors, 2.0, away), further.share])
    paths, legs = np.concatenate([path, further.path]), np.concatenate([leg, further.leg])
    order = np.lexsort((place, legs, paths))
    kinds = np.concatenate([met.interactions[path, slot], np.full(len(further.path), TRANSMISSION, np.uint8)])[order]
    faces = np.concatenate([met.face[path, slot], further.face])[order]
    points = np.concatenate([met.points_m[path, slot], further.points_m])[order]
    paths = paths[order]
    slots = np.arange(len(paths)) - np.searchsorted(paths, paths)
    within = slots < met.face.shape[1]
    longer = ValidPaths(
        met.candidate, np.zeros_like(met.interactions), np.full_like(met.face, -1), met.points_m * np.nan
    )
    for array, values in ((longer.interactions, kinds), (longer.face, faces), (longer.points_m, points)):
        array[paths[within], slots[within]] = values[within]
    return longer, np.bincount(paths, minlength=len(met.face)) <= met.face.shape[1]


def reflect_on_faces(surfaces: Surfaces, legs: PathInteractions) -> NDArray[np.bool_]:
    """Mask of paths [p] whose points of reflection are on faces, and not beside them where rays meet enlarged ones."""
    path, slot = np.nonzero(legs.interactions == SPECULAR)
    points, face = legs.vertices_m[path, slot], legs.face[path, slot]
    normal, offset = surfaces.face_edges
    # Heights above the three edges; beyond one, another face of the plane may go on.
    height = np.einsum("nkc,nc->nk", normal[face], points) - offset[face]
    seam_m = max(SEAM_M, SEAM * surfaces.scale_m)
    beside = np.flatnonzero(height.min(axis=1) < -seam_m)
    away_m = nearest_faces(surfaces, surfaces.plane[face[beside]], points[beside])[1]
    valid = np.ones(len(legs), bool)
    valid[path[beside[away_m > seam_m]]] = False
    return valid


def nearest_faces(surfaces: Surfaces, plane: IntArray, points_m: FloatArray) -> tuple[IntArray, FloatArray]:
    """Nearest face [n] of each plane [n] to points [n, 3], and its distance [n] in metres."""
    face, away_m = np.full(len(plane), -1), np.full(len(plane), np.inf)
    ordered, first = surfaces.faces_by_plane
    for index, rows in _by_value(plane):
        faces = ordered[first[index] : first[index + 1]]
        for part in np.array_split(rows, -(-len(rows) * len(faces) // PAIRS_TOGETHER)):
            # All pairs: planes have few faces, but for those of finely divided meshes, which chunks bound.
            row, candidate = np.repeat(part, len(faces)), np.tile(faces, len(part))
            away = np.linalg.norm(closest_point(surfaces.triangles[candidate], points_m[row]) - points_m[row], axis=1)
            away = away.reshape(len(part), len(faces))
            face[part], away_m[part] = faces[away.argmin(axis=1)], away.min(axis=1)
    return face, away_m


def _crossings(surfaces: Surfaces, vertices_m: FloatArray, plane: IntArray, met: ValidPaths) -> _Crossings:
    """All crossings of faces within `NEAR` of a point where a path meets another surface, each leg and plane once."""
    path, level = np.nonzero(plane >= 0)
    row, slot = np.nonzero(met.interactions == TRANSMISSION)
    mirrored = _near_planes(surfaces, plane[path, level], vertices_m[path, level + 1])
    passed = _near_planes(surfaces, surfaces.plane[met.face[row, slot]], met.points_m[row, slot])
    # At a reflection, both of its legs; at a transmission, which rays do not tell from another one at the same point,
    # the leg that it is on.
    places = ((path, level, mirrored), (path, level + 1, mirrored), (row, met.leg[row, slot], passed))
    parts = [_crossed(surfaces, vertices_m, plane, *place) for place in places]
    crossings = _Crossings(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
    key = np.stack([crossings.path, crossings.leg, surfaces.plane[crossings.face]])
    _, once = np.unique(key, axis=1, return_index=True)
    return crossings.select(once)


def _crossed(
    surfaces: Surfaces, vertices_m: FloatArray, plane: IntArray, path: IntArray, leg: IntArray, near: _Near
) -> _Crossings:
    """Crossings of the planes near points, on one leg [n] of each point's path [n]."""
    point, crossed, points = near
    row, leg = path[point], leg[point]
    normal, offset = surfaces.normal[crossed], surfaces.offset[crossed]
    start, end = vertices_m[row, leg], vertices_m[row, leg + 1]
    before, after = ((ends * normal).sum(axis=1) - offset for ends in (start, end))
    # The planes on which the leg begins and ends have heights of zero, whose signs are rounding.
    ends_on = np.pad(plane, ((0, 0), (1, 1)), constant_values=-1)
    crosses = ((before > 0) != (after > 0)) & (crossed != ends_on[row, leg]) & (crossed != ends_on[row, leg + 1])
    index = np.flatnonzero(crosses)
    share = before[index] / (before[index] - after[index])
    where = start[index] + (end[index] - start[index]) * share[:, None]
    close = np.linalg.norm(where - points[index], axis=1) < NEAR * surfaces.scale_m
    index, where, share = index[close], where[close], share[close]
    face, away_m = nearest_faces(surfaces, crossed[index], where)
    closed = away_m < ENLARGED * surfaces.scale_m
    index = index[closed]
    return _Crossings(row[index], leg[index], face[closed], share[closed], where[closed])


def _near_planes(surfaces: Surfaces, plane: IntArray, points_m: FloatArray) -> _Near:
    point, other = surfaces.near(points_m, NEAR * surfaces.scale_m)
    different = other != plane[point]
    point, other = point[different], other[different]
    return point, other, points_m[point]


def _by_value(values: IntArray) -> Iterator[tuple[int, IntArray]]:
    """Distinct values in ascending order, and the indices at which each stands."""
    order = np.argsort(values, kind="stable")
    ordered = values[order]
    for rows in np.split(order, np.flatnonzero(np.diff(ordered)) + 1) if len(values) else ():
        yield int(values[rows[0]]), rows
