"""From a point cloud to the surfaces of a building."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

import numpy as np
import shapely
import trimesh

from ..core import InputError
from ..core.angles import FloatArray
from ..core.types import IntArray
from .classify import kinds
from .corners import join
from .outline import outline, polygons
from .planes import BAND, Plane, find_planes, fit, near, over, with_axes
from .regular import main_heading, regular
from .shadows import fill_shadows
from .surfaces import KINDS, Surface, number_names
from .thin import thin

logger = logging.getLogger(__name__)

REACH_M = 0.15
"""Gaps and overlaps up to this are closed where walls, floor and ceiling meet."""
STRAIGHT_M = 1e-3
SMALLEST_M2 = 0.05
"""Smaller planes are not worth a surface."""
FEWEST_POINTS = 20
LEAST_CONTRAST = 2.0
"""Points are at least this many times denser in a plane than beside it, or it is one by chance."""


def surfaces_from_points(points_m: FloatArray) -> list[Surface]:
    """The planes of a room or building in a levelled point cloud: floor, ceiling, walls, furniture.

    What is not plane (chairs, plants) is left out: a rough skin over it would reflect in directions that
    nothing measured supports.

    Args:
        points_m: shape [n, 3], metres, z upwards; any origin.

    Returns:
        Surfaces by kind, the largest first; several polygons may make up one. Vertices in the frame of the points.

    Raises:
        InputError: Open3D is missing, or no plane was found.
    """
    # Far from the origin (a national grid) single precision cannot hold millimetres.
    shift = np.floor(np.median(points_m, axis=0))
    points = points_m - shift
    cloud = thin(points)
    planes, noise = find_planes(cloud)
    points = points.astype(np.float32)
    planes = _refined(planes, points, noise)
    kept: list[Plane] = []
    areas, reach = [], []
    # A point where two planes meet goes to the larger one, or a shelf would grow along the wall behind it.
    free = np.ones(len(points), bool)
    for plane in planes:
        own = np.flatnonzero(near(plane, points, 2 * noise) & free)
        if len(own) < FEWEST_POINTS:
            continue
        area, cell = outline(plane, points[own])
        if area.area >= SMALLEST_M2 and _contrast(plane, area, points, noise) >= LEAST_CONTRAST:
            kept.append(plane)
            areas.append(area)
            reach.append(3 * noise + cell)
            free &= ~over(plane, area, points, BAND * noise)
    roles = kinds(kept, areas, float(np.median(cloud.points_m[:, 2])))
    reach = [own if kind == "other" else max(own, REACH_M) for own, kind in zip(reach, roles, strict=True)]
    areas = join(kept, areas, reach)
    things = np.ones(len(cloud.points_m), bool)
    for plane, area, kind in zip(kept, areas, roles, strict=True):
        if kind != "other":
            things &= ~over(plane, area, cloud.points_m, BAND * noise)
    standing = cloud.points_m[things]
    areas = [fill_shadows(*each, standing, noise) for each in zip(kept, areas, roles, strict=True)]
    areas = join(kept, areas, reach)
    logger.info("%d planes in %d points, noise %.1f mm", len(kept), len(points), 1e3 * noise)
    areas = [shapely.simplify(area, STRAIGHT_M) for area in areas]
    order = sorted(range(len(kept)), key=lambda i: (KINDS.index(roles[i]), -areas[i].area))
    meshes = [_triangulated(kept[i], areas[i]) for i in order]
    names = number_names([roles[i] for i in order])
    if not meshes:
        raise InputError("no plane was found; give a denser scan of a room")
    return [
        Surface(name, roles[i], vertices + shift, faces)
        for name, i, (vertices, faces) in zip(names, order, meshes, strict=True)
    ]


def _refined(planes: Sequence[Plane], points: FloatArray, noise_m: float) -> list[Plane]:
    """Planes fitted to all points, set square where these allow it, with their axes."""
    own = [np.flatnonzero(near(plane, points, BAND * noise_m)) for plane in planes]
    claims = np.zeros(len(points), np.uint8)
    for index in own:
        claims[index] += 1
    # Points in the corner of two planes pull both towards the room.
    sole = [index[claims[index] == 1] for index in own]
    chosen = [points[s if len(s) > 0.2 * len(o) else o] for s, o in zip(sole, own, strict=True)]
    weight = [np.ones(len(part)) for part in chosen]
    fitted = [fit(p, w, plane, noise_m) for p, w, plane in zip(chosen, weight, planes, strict=True)]
    square = regular(fitted, noise_m)
    fitted = [
        fit(p, w, plane, noise_m, normal=plane.normal) for p, w, plane in zip(chosen, weight, square, strict=True)
    ]
    heading = main_heading(fitted)
    return [with_axes(plane, heading) for plane in fitted]


def _contrast(plane: Plane, area: Any, points: FloatArray, noise_m: float) -> float:
    """How many times denser points are in the plane than beside it."""
    away = np.abs(plane.distance(points[over(plane, area, points, 6 * noise_m)]))
    inside, beside = np.count_nonzero(away < 2 * noise_m) / 2, np.count_nonzero(away > 3 * noise_m) / 3
    return inside / max(beside, 1)


def _triangulated(plane: Plane, area: Any) -> tuple[FloatArray, IntArray]:
    """Vertices [v, 3] and faces [f, 3] that fill an area."""
    parts = [trimesh.creation.triangulate_polygon(part, engine="earcut") for part in polygons(area)]
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    faces = [np.asarray(f, np.int64) + start for (_, f), start in zip(parts, starts[:-1], strict=True)]
    return plane.lift(np.concatenate([np.asarray(v, float) for v, _ in parts])), np.concatenate(faces)
