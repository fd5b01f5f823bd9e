"""From a plan (occupancy grid, LiDAR returns in a plane, wall vertices) to walls, floor and ceiling of a scene."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely
import trimesh
from shapely.geometry import Polygon
from shapely.geometry.base import BaseGeometry

from ..core import InputError
from ..core.angles import FloatArray
from .plan_align import grid_from_scans
from .plan_sources import PlanGrid, PlanPoints, grid_from_points, read_layout, read_plan
from .plan_walls import find_walls
from .surfaces import Kind, Surface, number_names

CLOSING_M = (0.3, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0)
"""Half-widths of openings that are closed to find the floor: doors first, then what was not seen."""
COVERED = 0.9
"""Least share of the walls that stand on the floor or at its edge."""
EDGE_M = 0.1
"""A wall this near to the floor's edge stands at it."""
SMALLEST_FLOOR_M2 = 0.5


@dataclass(frozen=True)
class Plan:
    """Walls and floor of a storey.

    Attributes:
        walls_m: end points of straight walls, shape [n, 2, 2].
        floor: a polygon or several; the ceiling has the same shape.
    """

    walls_m: FloatArray
    floor: BaseGeometry


def read_walls(path: str | Path) -> FloatArray:
    """The walls of a layout file, ``x,y`` of consecutive vertices: end points [n, 2, 2], each stretch once.

    Raises:
        InputError: see `wrf_mi.scene.plan_sources.read_layout`.
    """
    return layout_walls(read_layout(path))


def layout_walls(vertices_m: FloatArray) -> FloatArray:
    """Straight walls of a path of vertices [n, 2] that may double back and cross: end points [m, 2, 2]."""
    pieces = np.stack([vertices_m[:-1], vertices_m[1:]], axis=1)
    pieces = pieces[np.linalg.norm(pieces[:, 1] - pieces[:, 0], axis=-1) > 0]
    # The union cuts at crossings and keeps doubled stretches once; merging undoes needless cuts.
    lines = shapely.line_merge(shapely.unary_union(shapely.linestrings(pieces)))
    walls = [
        np.stack([xy[:-1], xy[1:]], axis=1)
        for line in shapely.get_parts(lines)
        for xy in [shapely.get_coordinates(shapely.simplify(line, 1e-6))]
    ]
    return np.concatenate(walls)


def floor_of(walls_m: FloatArray, name: str = "plan") -> BaseGeometry:
    """The area that walls enclose, openings between them closed; outlines without inner yards.

    Args:
        walls_m: end points [n, 2, 2].
        name: of the source, for errors.

    Raises:
        InputError: they enclose nothing.
    """
    lines = shapely.unary_union(shapely.linestrings(walls_m))
    rooms = shapely.unary_union(shapely.get_parts(shapely.polygonize([lines])))
    areas = [_filled(rooms)]
    for half in CLOSING_M:
        grown = shapely.buffer(lines, half, cap_style="square", join_style="mitre")
        areas.append(shapely.buffer(_filled(grown), -half, join_style="mitre"))
    for area in areas:
        covered = shapely.length(shapely.intersection(lines, shapely.buffer(area, EDGE_M)))
        if area.area >= SMALLEST_FLOOR_M2 and covered >= COVERED * lines.length:
            return shapely.simplify(area, EDGE_M / 2)
    raise InputError(f"{name}: the {len(walls_m)} walls found enclose no floor; give a plan that shows whole rooms")


def _filled(area: BaseGeometry) -> BaseGeometry:
    """Polygons without their holes."""
    outlines = [Polygon(part.exterior) for part in shapely.get_parts(area) if isinstance(part, Polygon)]
    return shapely.unary_union(outlines) if outlines else Polygon()


def make_plan(
    source: str | Path | PlanGrid | PlanPoints | FloatArray,
    resolution_m: float | None = None,
    name: str | None = None,
) -> Plan:
    """Walls and floor from a plan.

    Points whose scans are told apart by time are aligned with one another first, and free space is found from where the
    sensor stood (`wrf_mi.scene.plan_align`).

    Args:
        source: a file (`wrf_mi.scene.plan_sources.read_plan`), a grid, points, or wall vertices [n, 2] in metres.
        resolution_m: side of a cell, for a grid without it, or to count points in.
        name: of the source, for errors.

    Raises:
        InputError: unreadable, no wall, or walls that enclose nothing.
    """
    if isinstance(source, str | Path):
        name = name or str(source)
        source = read_plan(source, resolution_m)
    name = name or "plan"
    if isinstance(source, PlanPoints):
        if source.time_s is None:
            source = grid_from_points(source.xy_m, resolution_m, name)
        else:
            source = grid_from_scans(source.xy_m, source.time_s, name)
    walls_m = find_walls(source, name) if isinstance(source, PlanGrid) else layout_walls(np.asarray(source, float))
    return Plan(walls_m, floor_of(walls_m, name))


def plan_surfaces(
    source: str | Path | PlanGrid | PlanPoints | FloatArray | Plan,
    *,
    height_m: float,
    floor_m: float = 0.0,
    resolution_m: float | None = None,
    name: str | None = None,
) -> list[Surface]:
    """Surfaces of a storey: walls extruded from floor to ceiling, and both of these.

    Args:
        source: as in `make_plan`, or a plan.
        height_m: from floor to ceiling, above zero.
        floor_m: z of the floor.
        resolution_m: side of a cell, for a grid without it.
        name: of the source, for errors.

    Returns:
        Floor, ceiling, and walls from the longest to the shortest; vertices in the frame of the source.

    Raises:
        InputError: bad height, or as `make_plan`.
    """
    if not (np.isfinite(height_m) and height_m > 0 and np.isfinite(floor_m)):
        raise InputError(f"height {height_m} m above {floor_m} m: give a height above zero (--height, metres)")
    plan = source if isinstance(source, Plan) else make_plan(source, resolution_m, name)
    flat = _triangulated(plan.floor)
    parts: list[tuple[Kind, Any, Any]] = [
        ("floor", _at(flat[0], floor_m), flat[1]),
        ("ceiling", _at(flat[0], floor_m + height_m), flat[1]),
    ]
    for ends in plan.walls_m:
        vertices = np.concatenate([_at(ends, floor_m), _at(ends[::-1], floor_m + height_m)])
        parts.append(("wall", vertices, np.array([[0, 1, 2], [0, 2, 3]])))
    names = number_names([kind for kind, _, _ in parts])
    return [Surface(n, kind, v, f) for n, (kind, v, f) in zip(names, parts, strict=True)]


def _at(xy_m: FloatArray, z_m: float) -> FloatArray:
    """Points [n, 2] at a height, [n, 3]."""
    return np.column_stack([xy_m, np.full(len(xy_m), z_m)])


def _triangulated(area: BaseGeometry) -> tuple[FloatArray, Any]:
    """Vertices [v, 2] and faces [f, 3] that fill polygons."""
    meshes = [trimesh.creation.triangulate_polygon(part, engine="earcut") for part in shapely.get_parts(area)]
    starts = np.cumsum([0, *(len(v) for v, _ in meshes)])
    faces = [np.asarray(f, int) + start for (_, f), start in zip(meshes, starts[:-1], strict=True)]
    return np.concatenate([np.asarray(v, float) for v, _ in meshes]), np.concatenate(faces)
