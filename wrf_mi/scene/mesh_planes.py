"""Floor, ceiling and walls of a mesh: which of its triangles lie in the planes that bound rooms."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
import trimesh
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from ..core.angles import FloatArray
from .classify import LARGE_M2, LARGE_SHARE, STOREY_M, UPRIGHT, WALL_SHARE, footprint, kinds, span
from .planes import THICKEST_M, Plane, with_axes
from .surfaces import KINDS, Kind, Surface, number_names

SAME_VERTEX_M = 1e-4
"""Vertices this near are one: STL has no shared ones."""
FLAT_M = 0.01
"""Triangles whose vertices are this near to a plane lie in it."""
PARALLEL = np.cos(np.radians(2))
SMALLEST_M2 = 0.05
"""Smaller facets bound no room."""
MOST_FACETS = 400
"""Of a body; more is a curved or measured surface, whose rest stays as it is."""
INSIDE_M = 0.01
REACHES = 0.95
"""A solid of this share of the room's height is part of the building: a column, a partition."""
LAYERS_M = 0.5
"""Both faces of a floor or roof are no farther apart."""


@dataclass(frozen=True)
class _Body:
    """Triangles that hang together by their edges.

    Attributes:
        corners_m: shape [f, 3, 3].
        closed: every edge has two faces, so it has an inside.
        volume_m3: signed: positive where the normals of a closed body point outwards, 0 if they disagree.
    """

    corners_m: FloatArray
    closed: bool
    volume_m3: float

    @property
    def bounds_m(self) -> FloatArray:
        """Lowest and highest coordinates, shape [2, 3]."""
        return np.stack([self.corners_m.min(axis=(0, 1)), self.corners_m.max(axis=(0, 1))])

    @property
    def height_m(self) -> float:
        """Extent along z."""
        return float(np.ptp(self.corners_m[..., 2]))


@dataclass(frozen=True)
class _Facet:
    """A flat part of a body."""

    plane: Plane
    area: Any
    corners_m: FloatArray
    body: int


def planes_of_mesh(surfaces: Sequence[Surface]) -> list[Surface]:
    """The surfaces of a mesh split into floors, ceilings, walls and the rest.

    The roles are those of planes in a scan (`wrf_mi.scene.classify.kinds`). A body that is closed and stands within
    another one, such as a cupboard, is furniture unless it reaches from floor to ceiling. Which way normals point has
    no influence, except that a closed body with inward normals within one with outward normals, clear of its floor and
    ceiling, is a cavity: a room in a solid building.

    Args:
        surfaces: of a mesh, z upwards, metres.

    Returns:
        Surfaces by kind, the largest first; the triangles are those given. If no plane has a role, the given surfaces.
    """
    bodies = [body for surface in surfaces for body in _bodies(surface)]
    facets: list[_Facet] = []
    for index, body in enumerate(bodies):
        if (sheet := _slab(body, index)) is not None:
            facets.append(sheet)
    slabs = {facet.body for facet in facets}
    facets = [facet for facet in facets if _large(facet)]
    slab_bounds = _joint([bodies[i].bounds_m for i in slabs])
    for index, body in enumerate(bodies):
        if index not in slabs and _bounds_rooms(index, bodies, slabs, slab_bounds):
            facets += [facet for facet in _facets(body, index) if _large(facet)]
    if not facets:
        return list(surfaces)
    heights = np.concatenate([facet.corners_m[..., 2].ravel() for facet in facets])
    middle = float(heights.min() + heights.max()) / 2
    planes, areas = [facet.plane for facet in facets], [facet.area for facet in facets]
    roles = _both_faces(planes, areas, kinds(planes, areas, middle))
    if set(roles) == {"other"}:
        return list(surfaces)
    parts: list[tuple[Kind, FloatArray]] = [
        (role, facet.corners_m) for role, facet in zip(roles, facets, strict=True) if role != "other"
    ]
    for index, body in enumerate(bodies):
        taken = [f.corners_m for role, f in zip(roles, facets, strict=True) if role != "other" and f.body == index]
        rest = _without(body.corners_m, taken)
        if len(rest):
            parts.append(("other", rest))
    parts.sort(key=lambda part: (KINDS.index(part[0]), -_area(part[1])))
    names = number_names([kind for kind, _ in parts])
    return [_surface(name, kind, corners) for name, (kind, corners) in zip(names, parts, strict=True)]


def _surface(name: str, kind: Kind, corners_m: FloatArray) -> Surface:
    vertices, index = np.unique(corners_m.reshape(-1, 3), axis=0, return_inverse=True)
    return Surface(name, kind, vertices, index.reshape(-1, 3))


def _bodies(surface: Surface) -> Iterator[_Body]:
    corners = surface.vertices_m[surface.faces]
    grid = np.round(surface.vertices_m / SAME_VERTEX_M)
    _, first, same = np.unique(grid, axis=0, return_index=True, return_inverse=True)
    faces = same.reshape(-1)[surface.faces]
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    _, edge = np.unique(edges, axis=0, return_inverse=True)
    edge = edge.reshape(-1)
    count = np.bincount(edge)
    face = np.repeat(np.arange(len(faces)), 3)
    incidence = sparse.csr_array((np.ones(len(edge)), (face, edge)), shape=(len(faces), len(count)))
    _, label = connected_components(incidence @ incidence.T, directed=False)
    unpaired = np.bincount(label, weights=(count[edge] != 2).reshape(-1, 3).any(axis=1))
    order = np.argsort(label, kind="stable")
    for own in np.split(order, np.flatnonzero(np.diff(label[order])) + 1):
        closed = bool(unpaired[label[own[0]]] == 0)
        volume = 0.0
        if closed:
            mesh = trimesh.Trimesh(surface.vertices_m[first], faces[own], process=False)
            volume = float(mesh.volume) if mesh.is_winding_consistent else 0.0
        yield _Body(corners[own], closed, volume)


def _slab(body: _Body, index: int) -> _Facet | None:
    """A body that is a sheet or slab as one facet in its middle, or None."""
    cross = _cross(body.corners_m)
    normal = cross[np.argmax(np.linalg.norm(cross, axis=-1))]
    normal = normal / np.linalg.norm(normal)
    away = body.corners_m @ normal
    if np.ptp(away) > THICKEST_M:
        return None
    return _facet(body.corners_m, normal, float(away.min() + away.max()) / 2, index)


def _facets(body: _Body, index: int) -> Iterator[_Facet]:
    """Flat parts of a body, whichever way their normals point."""
    cross = _cross(body.corners_m)
    size = np.linalg.norm(cross, axis=-1)
    normals = cross / size[:, None]
    free = np.ones(len(size), bool)
    for _ in range(MOST_FACETS):
        if not free.any():
            return
        seed = int(np.argmax(np.where(free, size, 0)))
        normal = normals[seed]
        offset = float(body.corners_m[seed].mean(axis=0) @ normal)
        own = free & (np.abs(normals @ normal) > PARALLEL)
        own[own] = (np.abs(body.corners_m[own] @ normal - offset) < FLAT_M).all(axis=-1)
        own[seed] = True
        free &= ~own
        yield _facet(body.corners_m[own], normal, offset, index)


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
    if body.height_m < STOREY_M:
        return False
    others = [other for i, other in enumerate(bodies) if i != index and i not in slabs]
    around = [other for other in others if _within(body.bounds_m, other.bounds_m)]
    if any(other.closed and body.volume_m3 < 0 < other.volume_m3 and _off_floor(body, other) for other in around):
        return True
    outer = [other.bounds_m for other in around]
    if slab_bounds_m is not None and _within(body.bounds_m, slab_bounds_m):
        outer.append(slab_bounds_m)
    return all(body.height_m >= REACHES * np.ptp(bounds[:, 2]) for bounds in outer)


def _off_floor(body: _Body, outer: _Body) -> bool:
    """Whether a body keeps clear of the floor and ceiling of another one, as a cavity does and furniture does not."""
    (low, high), (floor, ceiling) = body.bounds_m[:, 2], outer.bounds_m[:, 2]
    return bool(low > floor + INSIDE_M and high < ceiling - INSIDE_M)


def _within(inner_m: FloatArray, outer_m: FloatArray) -> bool:
    """Whether a box lies within a larger one."""
    inside = (inner_m[0] > outer_m[0] - INSIDE_M).all() and (inner_m[1] < outer_m[1] + INSIDE_M).all()
    return bool(inside and np.prod(np.ptp(inner_m, axis=0)) < 0.99 * np.prod(np.ptp(outer_m, axis=0)))


def _joint(bounds_m: Sequence[FloatArray]) -> FloatArray | None:
    if not bounds_m:
        return None
    return np.stack([np.min([b[0] for b in bounds_m], axis=0), np.max([b[1] for b in bounds_m], axis=0)])


def _both_faces(planes: Sequence[Plane], areas: Sequence[Any], roles: Sequence[Kind]) -> list[Kind]:
    """Roles in which both faces of a floor or roof are the same; a scan sees only one of them."""
    found = list(roles)
    shadow = [footprint(plane, area) for plane, area in zip(planes, areas, strict=True)]
    height = [float(np.mean(span(plane, area))) for plane, area in zip(planes, areas, strict=True)]
    level = [i for i, plane in enumerate(planes) if abs(plane.normal[2]) > PARALLEL]
    least = min(LARGE_M2, LARGE_SHARE * max((areas[i].area for i in level), default=0.0))
    for i in level:
        if areas[i].area < least:
            continue
        for j in level:
            apart, both = abs(height[i] - height[j]), shapely.intersection(shadow[i], shadow[j]).area
            if i == j or apart > LAYERS_M or both < 0.5 * min(shadow[i].area, shadow[j].area):
                continue
            roof = roles[i] == "floor" and roles[j] == "ceiling" and height[i] > height[j]
            above = any(roles[k] == "ceiling" and height[k] > height[i] + STOREY_M for k in level)
            if (roles[i] == "other" and roles[j] != "other") or (roof and not above):
                found[i] = roles[j]
    return found


def _without(corners_m: FloatArray, taken_m: Sequence[FloatArray]) -> FloatArray:
    """Triangles [f, 3, 3] less those taken."""
    if not taken_m:
        return corners_m
    rows = {corners.tobytes() for corners in np.concatenate(taken_m)}
    return corners_m[[corners.tobytes() not in rows for corners in corners_m]]


def _cross(corners_m: FloatArray) -> FloatArray:
    return np.asarray(np.cross(corners_m[:, 1] - corners_m[:, 0], corners_m[:, 2] - corners_m[:, 0]))


def _area(corners_m: FloatArray) -> float:
    return float(np.linalg.norm(_cross(corners_m), axis=-1).sum() / 2)
