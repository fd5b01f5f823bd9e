"""Meshes of others (CAD, photogrammetry), checked, and split into floor, ceiling, walls and the rest."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import shapely
import trimesh

from ...core.angles import FloatArray
from .planes import THICKEST_M, Plane, with_axes
from .roles import STOREY_M, UPRIGHT, WALL_SHARE, Face, kinds, least_level_area
from .surfaces import KINDS, Kind, Surface, number_names
from .surfaces import bodies as connected_bodies

FLAT_M = 0.01
"""Largest distance of the vertices of a facet's triangles from its plane."""
PARALLEL = np.cos(np.radians(2))
SMALLEST_M2 = 0.05
"""Least area of a facet that bounds a room."""
MOST_FACETS = 400
"""Facets of a body; the rest of a curved or measured surface stays as it is."""
INSIDE_M = 0.01
REACHES = 0.95
"""Least share of the room's height of a solid that is part of the building: a column, a partition."""
LAYERS_M = 0.5
"""Largest distance between both faces of a floor or roof."""


@dataclass(frozen=True)
class _Body:
    """Triangles [f, 3, 3] that are connected by their edges, see `wrf_mi.scene.mesh.surfaces.bodies`."""

    corners_m: FloatArray
    closed: bool
    volume_m3: float

    @property
    def bounds_m(self) -> FloatArray:
        """Lowest and highest coordinates, shape [2, 3]."""
        return np.stack([self.corners_m.min(axis=(0, 1)), self.corners_m.max(axis=(0, 1))])


@dataclass(frozen=True, eq=False)
class _Facet(Face):
    """A flat part of a body, with its triangles and the body's number."""

    corners_m: FloatArray
    body: int


def planes_of_mesh(surfaces: Sequence[Surface]) -> list[Surface]:
    """The surfaces of a mesh split into floors, ceilings, walls and the rest.

    The roles are those of planes in a scan (`wrf_mi.scene.mesh.roles.kinds`). A closed body within another body, such
    as a cupboard, is furniture unless it reaches from floor to ceiling. The direction of normals has no influence,
    except that a closed body with inward normals within a body with outward normals, clear of its floor and ceiling,
    is a
    cavity: a room in a solid building.

    Args:
        surfaces: surfaces of a mesh, z upwards, metres.

    Returns:
        Surfaces by kind, the largest first; the triangles are those given. If no plane has a role, the given surfaces.
    """
    bodies = []
    for surface in surfaces:
        corners = surface.vertices_m[surface.faces]
        bodies += [_Body(corners[faces], closed, volume) for faces, closed, volume in connected_bodies(corners)]
    sheets = [sheet for index, body in enumerate(bodies) if (sheet := _slab(body, index)) is not None]
    slabs = {sheet.body for sheet in sheets}
    facets = [sheet for sheet in sheets if _large(sheet)]
    slab_bounds = None
    if sheets:
        corners = np.concatenate([sheet.corners_m.reshape(-1, 3) for sheet in sheets])
        slab_bounds = np.stack([corners.min(axis=0), corners.max(axis=0)])
    for index, body in enumerate(bodies):
        if index not in slabs and _bounds_rooms(index, bodies, slabs, slab_bounds):
            facets += [facet for facet in _facets(body, index) if _large(facet)]
    if not facets:
        return list(surfaces)
    heights = np.concatenate([facet.corners_m[..., 2].ravel() for facet in facets])
    middle = float(heights.min() + heights.max()) / 2
    roles = _both_faces(facets, kinds(facets, middle))
    if set(roles) == {"other"}:
        return list(surfaces)
    parts: list[tuple[Kind, FloatArray]] = []
    taken: list[set[bytes]] = [set() for _ in bodies]
    for role, facet in zip(roles, facets, strict=True):
        if role != "other":
            parts.append((role, facet.corners_m))
            taken[facet.body] |= {corners.tobytes() for corners in facet.corners_m}
    for body, gone in zip(bodies, taken, strict=True):
        rest = body.corners_m[[corners.tobytes() not in gone for corners in body.corners_m]]
        if len(rest):
            parts.append(("other", rest))
    parts.sort(key=lambda part: (KINDS.index(part[0]), -trimesh.triangles.area(part[1]).sum()))
    found = []
    for name, (kind, corners) in zip(number_names([kind for kind, _ in parts]), parts, strict=True):
        vertices, faces = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
        found.append(Surface(name, kind, vertices, faces.reshape(-1, 3)))
    return found


def _slab(body: _Body, index: int) -> _Facet | None:
    """A body that is a sheet or slab as one facet in its middle, or None."""
    cross = trimesh.triangles.cross(body.corners_m)
    normal = cross[np.argmax(np.linalg.norm(cross, axis=-1))]
    normal = normal / np.linalg.norm(normal)
    away = body.corners_m @ normal
    if np.ptp(away) > THICKEST_M:
        return None
    return _facet(body.corners_m, normal, float(away.min() + away.max()) / 2, index)


def _facets(body: _Body, index: int) -> Iterator[_Facet]:
    """Flat parts of a body, whichever way their normals point."""
    cross = trimesh.triangles.cross(body.corners_m)
    size = np.linalg.norm(cross, axis=-1)
    normals = cross / size[:, None]
    free = np.ones(len(size), bool)
    for _ in range(MOST_FACETS):
        if not free.any():
            return
        seed = int(np.argmax(np.where(free, size, 0)))
        normal = normals[seed]
        offset = float(body.corners_m[seed].mean(axis=0) @ normal)
        inside = free & (np.abs(normals @ normal) > PARALLEL)
        inside[inside] = (np.abs(body.corners_m[inside] @ normal - offset) < FLAT_M).all(axis=-1)
        inside[seed] = True
        free &= ~inside
        yield _facet(body.corners_m[inside], normal, offset, index)


def _large(facet: _Facet) -> bool:
    """Whether a facet may bound a room, by its area and, if it is upright, its height."""
    low = abs(facet.plane.normal[2]) < UPRIGHT and np.ptp(facet.corners_m[..., 2]) < WALL_SHARE * STOREY_M
    return facet.area.area >= SMALLEST_M2 and not low


def _facet(corners_m: FloatArray, normal: FloatArray, offset_m: float, body: int) -> _Facet:
    plane = with_axes(Plane(normal, offset_m, corners_m[:, [0, 1, 2, 2]], corners_m.mean(axis=(0, 1)), 0.0))
    flat = shapely.polygons(plane.flat(corners_m))
    flat = flat[shapely.area(flat) > 1e-8]
    return _Facet(plane, shapely.union_all(flat), corners_m, body)


def _bounds_rooms(index: int, bodies: Sequence[_Body], slabs: set[int], slab_bounds_m: FloatArray | None) -> bool:
    """Whether the facets of a body may be floors, ceilings and walls."""
    body = bodies[index]
    if not body.closed:
        return True
    low, high = body.bounds_m[:, 2]
    if high - low < STOREY_M:
        return False
    others = [other for i, other in enumerate(bodies) if i != index and i not in slabs]
    around = [other for other in others if _within(body.bounds_m, other.bounds_m)]
    for other in around:
        # A cavity is clear of floor and ceiling, furniture is not.
        floor, ceiling = other.bounds_m[:, 2]
        clear = low > floor + INSIDE_M and high < ceiling - INSIDE_M
        if other.closed and body.volume_m3 < 0 < other.volume_m3 and clear:
            return True
    outer = [other.bounds_m for other in around]
    if slab_bounds_m is not None and _within(body.bounds_m, slab_bounds_m):
        outer.append(slab_bounds_m)
    return all(high - low >= REACHES * np.ptp(bounds[:, 2]) for bounds in outer)


def _within(inner_m: FloatArray, outer_m: FloatArray) -> bool:
    """Whether a box lies within a larger one."""
    inside = (inner_m[0] > outer_m[0] - INSIDE_M).all() and (inner_m[1] < outer_m[1] + INSIDE_M).all()
    return bool(inside and np.prod(np.ptp(inner_m, axis=0)) < 0.99 * np.prod(np.ptp(outer_m, axis=0)))


def _both_faces(faces: Sequence[Face], roles: Sequence[Kind]) -> list[Kind]:
    """Roles with both faces of a floor or roof given the same role; a scan sees only one face."""
    found = list(roles)
    height = [float(np.mean(face.span_m)) for face in faces]
    level = [i for i, face in enumerate(faces) if face.slope > PARALLEL]
    least = least_level_area([faces[i] for i in level])
    for i in level:
        if faces[i].area.area < least:
            continue
        for j in level:
            apart, shadows = abs(height[i] - height[j]), (faces[i].shadow, faces[j].shadow)
            if i == j or apart > LAYERS_M or shapely.intersection(*shadows).area < 0.5 * min(s.area for s in shadows):
                continue
            roof = roles[i] == "floor" and roles[j] == "ceiling" and height[i] > height[j]
            above = any(roles[k] == "ceiling" and height[k] > height[i] + STOREY_M for k in level)
            if (roles[i] == "other" and roles[j] != "other") or (roof and not above):
                found[i] = roles[j]
    return found
