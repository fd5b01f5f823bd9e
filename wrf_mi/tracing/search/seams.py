"""Surfaces that paths cross at their points of reflection, such as a wall at whose foot the floor reflects.

Rays in single precision cannot tell on which side of such a wall a reflection is. In float64, heights above the wall's
plane can: a path crosses it where the heights of consecutive vertices have opposite signs, once and on one leg.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from trimesh.triangles import closest_point

from ...core.angles import FloatArray
from ...core.types import IntArray
from .legs import SPECULAR, TRANSMISSION, Legs
from .screens import ENLARGED
from .surfaces import Surfaces

NEAR = 1e-5
"""Distance from a point of reflection up to which crossings are looked for, as a share of `Surfaces.scale_m`: five
times that within which rays do not count them (`wrf_mi.tracing.search.visibility.WINDOW`)."""
SEAM_M, SEAM = 5e-5, 1e-6
"""Distance from a face in metres, and as a share of the scale, within which a point is on it: half the gap that sheets
leave which were modelled one by one, `wrf_mi.scene.surfaces.SAME_CORNER_M`."""
PAIRS_TOGETHER = 1 << 20
"""Pairs of points and planes, or faces, in a chunk."""
UNKNOWN_FACE = (1 << 31) - 1
"""Face of a reflection that rays cannot distinguish from another one at the same point."""


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

    def select(self, which: NDArray[Any]) -> Met:
        """The paths of a mask or of indices."""
        return Met(*(array[which] for array in self))

    @property
    def leg(self) -> IntArray:
        """Leg on which, or at whose end, each interaction is: the number of reflections before it [k, depth]."""
        reflects = self.interactions == SPECULAR
        return np.cumsum(reflects, axis=1) - reflects


class _Crossings(NamedTuple):
    """Crossings [n]: paths, legs, faces, shares of the legs before them, and points [n, 3]."""

    path: IntArray
    leg: IntArray
    face: IntArray
    share: FloatArray
    points_m: FloatArray

    def select(self, which: NDArray[Any]) -> _Crossings:
        return _Crossings(*(array[which] for array in self))


def with_crossings(surfaces: Surfaces, vertices_m: FloatArray, plane: IntArray, met: Met, transmission: bool) -> Met:
    """Paths with the surfaces that they cross at points of reflection; without those that are obstructed there.

    Of k paths with vertices and planes as of `visibility.unobstructed`, and what rays met away from the
    points of reflection, with `UNKNOWN_FACE`.
    """
    met, faces = _with_faces(surfaces, vertices_m, plane, met)
    vertices_m, plane = vertices_m[faces], plane[faces]
    crossings = _crossings(surfaces, vertices_m, plane, met)
    if not len(crossings.path):
        return met
    # Few paths have any: the others stay as they are.
    crossing, path = np.unique(crossings.path, return_inverse=True)
    part = met.select(crossing)
    new = _unrecorded(surfaces, plane.shape[1] + 1, part, crossings._replace(path=path))
    if transmission:
        part, valid = _inserted(part, new, vertices_m[crossing])
    else:
        valid = ~np.isin(np.arange(len(crossing)), new.path)
    met.interactions[crossing], met.face[crossing], met.points_m[crossing] = part[1:]
    unobstructed = np.ones(len(plane), bool)
    unobstructed[crossing[~valid]] = False
    return met if valid.all() else met.select(unobstructed)


def _inserted(met: Met, new: _Crossings, vertices_m: FloatArray) -> tuple[Met, NDArray[np.bool_]]:
    """Paths [k] with further transmissions, and the mask of those that are not too deep."""
    path, slot = np.nonzero(met.interactions)
    mirrors, leg = met.interactions[path, slot] == SPECULAR, met.leg[path, slot]
    start, end = vertices_m[path, leg], vertices_m[path, leg + 1]
    away = np.linalg.norm(met.points_m[path, slot] - start, axis=1) / np.linalg.norm(end - start, axis=1)
    # By their place on the leg, and the reflections of a cluster, which end it together, in their order.
    place = np.concatenate([np.where(mirrors, 2.0, away), new.share])
    paths, legs = np.concatenate([path, new.path]), np.concatenate([leg, new.leg])
    order = np.lexsort((place, legs, paths))
    kinds = np.concatenate([met.interactions[path, slot], np.full(len(new.path), TRANSMISSION, np.uint8)])[order]
    faces = np.concatenate([met.face[path, slot], new.face])[order]
    points = np.concatenate([met.points_m[path, slot], new.points_m])[order]
    paths = paths[order]
    slots = np.arange(len(paths)) - np.searchsorted(paths, paths)
    within = slots < met.face.shape[1]
    longer = Met(met.candidate, np.zeros_like(met.interactions), np.full_like(met.face, -1), met.points_m * np.nan)
    for array, values in ((longer.interactions, kinds), (longer.face, faces), (longer.points_m, points)):
        array[paths[within], slots[within]] = values[within]
    return longer, np.bincount(paths, minlength=len(met.face)) <= met.face.shape[1]


def _with_faces(surfaces: Surfaces, vertices_m: FloatArray, plane: IntArray, met: Met) -> tuple[Met, NDArray[np.bool_]]:
    """Paths with a face for each `UNKNOWN_FACE`, and the mask of those that have one at each point."""
    path, slot = np.nonzero(met.face == UNKNOWN_FACE)
    has_faces = np.ones(len(plane), bool)
    if not len(path):
        return met, has_faces
    level = met.leg[path, slot]
    points = vertices_m[path, level + 1]
    nearest, away_m = nearest_faces(surfaces, plane[path, level], points)
    face, points_m = met.face.copy(), met.points_m.copy()
    face[path, slot], points_m[path, slot] = nearest, points
    has_faces[path[away_m > ENLARGED * surfaces.scale_m]] = False
    return met._replace(face=face, points_m=points_m).select(has_faces), has_faces


def reflect_on_faces(surfaces: Surfaces, legs: Legs) -> NDArray[np.bool_]:
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
            row, candidate = np.repeat(part, len(faces)), np.tile(faces, len(part))
            away = np.linalg.norm(closest_point(surfaces.triangles[candidate], points_m[row]) - points_m[row], axis=1)
            away = away.reshape(len(part), len(faces))
            face[part], away_m[part] = faces[away.argmin(axis=1)], away.min(axis=1)
    return face, away_m


def _crossings(surfaces: Surfaces, vertices_m: FloatArray, plane: IntArray, met: Met) -> _Crossings:
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
    surfaces: Surfaces,
    vertices_m: FloatArray,
    plane: IntArray,
    path: IntArray,
    leg: IntArray,
    near: tuple[IntArray, IntArray, FloatArray],
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


def _near_planes(surfaces: Surfaces, plane: IntArray, points_m: FloatArray) -> tuple[IntArray, IntArray, FloatArray]:
    """Points [n, 3] on planes [n] that are within `NEAR` of another plane whose faces touch those of the first: the
    point's index, the other plane, and the point, for each pair.
    """
    tree, boxes = surfaces.boxes
    groups = list(_by_value(plane))
    mirrors = np.array([mirror for mirror, _ in groups], np.int64)
    query, touching = tree.query(tree.geometries[mirrors])
    above = boxes[touching, 0, 2] <= boxes[mirrors[query], 1, 2]
    above &= boxes[touching, 1, 2] >= boxes[mirrors[query], 0, 2]
    above &= touching != mirrors[query]
    query, touching = query[above], touching[above]
    first = np.searchsorted(query, np.arange(len(mirrors) + 1))
    parts = [(np.zeros(0, np.int64), np.zeros(0, np.int64))]
    for number, (_, rows) in enumerate(groups):
        others = touching[first[number] : first[number + 1]]
        for part in np.array_split(rows, -(-len(rows) * max(len(others), 1) // PAIRS_TOGETHER)):
            height = points_m[part] @ surfaces.normal[others].T - surfaces.offset[others]
            row, other = np.nonzero(np.abs(height) < NEAR * surfaces.scale_m)
            parts.append((part[row], others[other]))
    point, other = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    return point, other, points_m[point]


def _by_value(values: IntArray) -> Iterator[tuple[int, IntArray]]:
    """Distinct values in ascending order, and the indices at which each stands."""
    order = np.argsort(values, kind="stable")
    ordered = values[order]
    for rows in np.split(order, np.flatnonzero(np.diff(ordered)) + 1) if len(values) else ():
        yield int(values[rows[0]]), rows


def _unrecorded(surfaces: Surfaces, legs: int, met: Met, crossings: _Crossings) -> _Crossings:
    """Crossings that rays have not met on the same of a path's legs."""
    path, slot = np.nonzero(met.interactions == TRANSMISSION)
    columns = [(path, met.leg[path, slot], surfaces.plane[met.face[path, slot]])]
    columns += [(crossings.path, crossings.leg, surfaces.plane[crossings.face])]
    # One number for each path, leg and plane: a straight leg crosses a plane once.
    met_by_rays, crossed = ((row * legs + at) * len(surfaces.normal) + plane for row, at, plane in columns)
    return crossings.select(~np.isin(crossed, met_by_rays))
