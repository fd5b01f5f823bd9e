"""Meshes of others (CAD, photogrammetry), checked, and split into floor, ceiling, walls and the rest."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np
import shapely
import trimesh

from ...core.angles import FloatArray
from .planes import STOREY_M, THICKEST_M, UPRIGHT, WALL_SHARE, Face, Mask, Plane, kinds, least_level_area, with_axes
from .surfaces import KINDS, Body, Kind, Surface, bodies, bounds, main_extent, number_names

FLAT_M = 0.01  # largest distance of the vertices of a facet's triangles from its plane
PARALLEL = np.cos(np.radians(2))
SMALLEST_M2 = 0.05  # least area of a facet that bounds a room
MOST_FACETS = 400  # facets of a body; the rest of a curved or measured surface stays as it is
INSIDE_M = 0.01
REACHES = 0.95  # least share of the room's height of a solid that is part of the building: a column, a partition
LAYERS_M = 0.5  # largest distance between both faces of a floor or roof


@dataclass(frozen=True, eq=False)
class _Facet(Face):
    """A flat part of a body: its triangles, the number of the body, and which of the body's triangles they are."""

    corners_m: FloatArray
    body: int
    rows: Mask


def planes_of_mesh(surfaces: Sequence[Surface]) -> list[Surface]:
    """The surfaces of a mesh split into floors, ceilings, walls and the rest.

    The roles are those of planes in a scan (`wrf_mi.scene.mesh.planes.kinds`). A closed body within another body, such
    as a cupboard, is furniture unless it reaches from floor to ceiling. The direction of normals has no influence,
    except that a closed body with inward normals within a body with outward normals, clear of its floor and ceiling,
    is a cavity: a room in a solid building.

    Args:
        surfaces: surfaces of a mesh, z upwards, metres.

    Returns:
        Surfaces by kind, the largest first; the triangles are those given. If no plane has a role, the given surfaces.
    """
    mesh_bodies = [body for surface in surfaces for body in bodies(surface.vertices_m[surface.faces])]
    facets = _facets_with_roles(_room_facets(mesh_bodies))
    if not facets:
        return list(surfaces)
    parts = [(role, facet.corners_m) for role, facet in facets]
    without_role = [np.ones(len(body.corners_m), bool) for body in mesh_bodies]
    for _, facet in facets:
        without_role[facet.body] &= ~facet.rows
    parts += [
        ("other", body.corners_m[rows]) for body, rows in zip(mesh_bodies, without_role, strict=True) if rows.any()
    ]
    return _surfaces(parts)


def _facets_with_roles(facets: Sequence[_Facet]) -> list[tuple[Kind, _Facet]]:
    """The facets that are floors, ceilings or walls."""
    if not facets:
        return []
    low, high = bounds(np.concatenate([facet.corners_m for facet in facets]))[:, 2]
    roles = _same_on_both_sides(facets, kinds(facets, float(low + high) / 2))
    return [(role, facet) for role, facet in zip(roles, facets, strict=True) if role != "other"]


def _surfaces(parts: list[tuple[Kind, FloatArray]]) -> list[Surface]:
    """Surfaces by kind, the largest first."""
    parts = sorted(parts, key=lambda part: (KINDS.index(part[0]), -trimesh.triangles.area(part[1]).sum()))
    split = []
    for name, (kind, corners) in zip(number_names([kind for kind, _ in parts]), parts, strict=True):
        vertices, faces = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
        split.append(Surface(name, kind, vertices, faces.reshape(-1, 3)))
    return split


def _room_facets(mesh_bodies: Sequence[Body]) -> list[_Facet]:
    """Facets that may be floors, ceilings and walls: sheets and slabs, and flat parts of bodies that bound rooms."""
    slabs = {index: slab for index, body in enumerate(mesh_bodies) if (slab := _slab(body, index))}
    others = {index: body for index, body in enumerate(mesh_bodies) if index not in slabs}
    shell_m = [bounds(np.concatenate([slab.corners_m for slab in slabs.values()]))] if slabs else []
    facets = [*slabs.values()]
    for index, body in others.items():
        if _bounds_rooms(body, list(others.values()), shell_m):
            facets += _facets(body, index)
    return list(filter(_is_large, facets))


def _slab(body: Body, index: int) -> _Facet | None:
    """A body that is a sheet or slab as one facet in its middle, or None."""
    normal, low, high = main_extent(body.corners_m)
    if high - low > THICKEST_M:
        return None
    return _facet(body, np.ones(len(body.corners_m), bool), normal, (low + high) / 2, index)


def _facets(body: Body, index: int) -> Iterator[_Facet]:
    """Flat parts of a body, whichever way their normals point, each about the largest triangle that is left."""
    cross = trimesh.triangles.cross(body.corners_m)
    size = np.linalg.norm(cross, axis=-1)
    normals = cross / size[:, None]
    unassigned = np.ones(len(size), bool)
    for _ in range(MOST_FACETS):
        if not unassigned.any():
            return
        seed = int(np.argmax(np.where(unassigned, size, 0)))
        normal = normals[seed]
        offset = float(body.corners_m[seed].mean(axis=0) @ normal)
        inside = unassigned & (np.abs(normals @ normal) > PARALLEL)
        inside[inside] = (np.abs(body.corners_m[inside] @ normal - offset) < FLAT_M).all(axis=-1)
        inside[seed] = True  # rounding may put a large triangle's corners out of its own plane
        unassigned &= ~inside
        yield _facet(body, inside, normal, offset, index)


def _facet(body: Body, rows: Mask, normal: FloatArray, offset_m: float, index: int) -> _Facet:
    corners = body.corners_m[rows]
    plane = with_axes(Plane(normal, offset_m, corners[:, [0, 1, 2, 2]], corners.mean(axis=(0, 1)), 0.0))
    flat = shapely.polygons(plane.flat(corners))
    # Triangles seen along their plane have no area, and would make the union invalid.
    return _Facet(plane, shapely.union_all(flat[shapely.area(flat) > 1e-8]), corners, index, rows)


def _is_large(facet: _Facet) -> bool:
    """Whether a facet may bound a room: neither small, nor upright and low as the sides of furniture are."""
    low = facet.slope < UPRIGHT and np.ptp(facet.corners_m[..., 2]) < WALL_SHARE * STOREY_M
    return facet.area.area >= SMALLEST_M2 and not low


def _bounds_rooms(body: Body, others: Sequence[Body], shell_m: Sequence[FloatArray]) -> bool:
    """Whether the facets of a body may bound rooms, among all bodies and in a shell of slabs [2, 3]."""
    if not body.closed:
        return True
    height_m = np.ptp(body.bounds_m[:, 2])
    if height_m < STOREY_M:
        return False
    if any(_is_cavity(body, other) for other in others):
        return True
    outer_m = [box for box in (*shell_m, *(other.bounds_m for other in others)) if _within(body.bounds_m, box)]
    return all(height_m >= REACHES * np.ptp(outer[:, 2]) for outer in outer_m)


def _is_cavity(body: Body, outer: Body) -> bool:
    """Whether a body is a room in a solid around it: normals face each other, and it is clear of floor and ceiling."""
    (low, high), (floor, ceiling) = body.bounds_m[:, 2], outer.bounds_m[:, 2]
    clear = low > floor + INSIDE_M and high < ceiling - INSIDE_M  # furniture stands on the floor
    inward = outer.closed and body.volume_m3 < 0 < outer.volume_m3
    return bool(inward and clear and _within(body.bounds_m, outer.bounds_m))


def _within(inner_m: FloatArray, outer_m: FloatArray) -> bool:
    """Whether a box [2, 3] lies within a larger one."""
    inside = (inner_m[0] > outer_m[0] - INSIDE_M).all() and (inner_m[1] < outer_m[1] + INSIDE_M).all()
    return bool(inside and np.prod(np.ptp(inner_m, axis=0)) < 0.99 * np.prod(np.ptp(outer_m, axis=0)))


def _same_on_both_sides(faces: Sequence[Face], roles: Sequence[Kind]) -> list[Kind]:
    """Roles with both faces of a floor or roof given the same role; a scan sees only one face."""
    same = list(roles)
    height = np.mean([face.span_m for face in faces], axis=1)
    level = np.flatnonzero([face.slope > PARALLEL for face in faces]).tolist()
    least_m2 = least_level_area([faces[i] for i in level])
    ceilings_m = height[level][np.array(roles)[level] == "ceiling"]
    is_top = height + STOREY_M >= ceilings_m.max(initial=-np.inf)
    for i, j in permutations(level, 2):
        # A floor just above a ceiling, without a ceiling over it, is the upper face of a roof.
        is_roof = all((roles[i] == "floor", roles[j] == "ceiling", height[i] > height[j], is_top[i]))
        takes_role = is_roof or roles[i] == "other" != roles[j]
        are_layers = all((takes_role, faces[i].area.area >= least_m2, abs(height[i] - height[j]) <= LAYERS_M))
        if are_layers and faces[i].overlaps(faces[j], 0.5):
            same[i] = roles[j]
    return same
