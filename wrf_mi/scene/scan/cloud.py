"""Surfaces of a building from a point cloud."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import shapely

from ...core import InputError
from ...core.angles import FloatArray
from ..mesh.outline import fill_shadows, join, outline, triangulated
from ..mesh.planes import Face, Plane, kinds, near, over, with_axes
from ..mesh.surfaces import KINDS, Surface, number_names
from .planes import BAND, find_planes, fit, layers
from .points import thin

logger = logging.getLogger(__name__)

REACH_M = 0.15  # gaps and overlaps up to this are closed where walls, floor and ceiling meet
STRAIGHT_M = 1e-3
SMALLEST_M2 = 0.05  # least area of a surface
FEWEST_POINTS = 20
LEAST_CONTRAST = 2.0
"""Least density of points in a plane relative to the density beside it; chance alignments have less."""
TOLERANCE_RANGE_RAD = np.radians(0.3), np.radians(4.0)
"""Bounds of the angle by which planes are turned: a levelled scanner and its registration leave the lower."""
ERRORS = 3.0  # angle by which planes are turned, in standard errors of their direction


@dataclass(frozen=True, eq=False)
class _Piece(Face):
    """A face, the distance within which its corners are closed, and areas (shapely) of recesses in it."""

    reach_m: float
    recesses: Sequence[Any] = ()


def surfaces_from_points(points_m: FloatArray) -> list[Surface]:
    """The planes of a room or building in a levelled point cloud: floor, ceiling, walls, furniture.

    Things that are not flat (chairs, plants) are left out: a rough skin over them would reflect in directions that
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
    pieces = _pieces(planes, points.astype(np.float32), noise)
    if not pieces:
        raise InputError("no plane was found; give a denser scan of a room")
    planes, areas = [piece.plane for piece in pieces], [piece.area for piece in pieces]
    roles = kinds(pieces, float(np.median(cloud.points_m[:, 2])))
    reach = [max(p.reach_m, 0 if kind == "other" else REACH_M) for p, kind in zip(pieces, roles, strict=True)]
    areas = join(planes, areas, reach)
    # Shadows are those of things: points of floors, ceilings and walls are seen through a gap and hide nothing.
    things = np.ones(len(cloud.points_m), bool)
    for plane, area, kind in zip(planes, areas, roles, strict=True):
        if kind != "other":
            things &= ~over(plane, area, cloud.points_m, BAND * noise)
    for i, (piece, kind) in enumerate(zip(pieces, roles, strict=True)):
        areas[i] = fill_shadows(piece.plane, areas[i], kind, cloud.points_m[things], noise)
        if piece.recesses:
            areas[i] = shapely.difference(areas[i], shapely.union_all(piece.recesses))
    areas = [shapely.simplify(area, STRAIGHT_M) for area in join(planes, areas, reach)]
    logger.info("%d planes in %d points, noise %.1f mm", len(planes), len(points), 1e3 * noise)
    order = sorted(range(len(planes)), key=lambda i: (KINDS.index(roles[i]), -areas[i].area))
    surfaces = []
    for name, i in zip(number_names([roles[i] for i in order]), order, strict=True):
        vertices, faces = triangulated(areas[i])
        surfaces.append(Surface(name, roles[i], planes[i].lift(vertices) + shift, faces))
    return surfaces


def _pieces(planes: Sequence[Plane], points: FloatArray, noise_m: float) -> list[_Piece]:
    """Planes and their parallel layers with the areas that points [n, 3] cover, those of most points first."""
    pieces = list[_Piece]()
    free = np.ones(len(points), bool)
    for refined in _refined(planes, points, noise_m):
        plane, parallel = layers(refined, points, free, noise_m)
        recesses = []
        for layer in parallel:
            area, cell = outline(layer.plane, points[layer.rows])
            if area.area >= SMALLEST_M2:
                pieces.append(_Piece(layer.plane, area, 3 * noise_m + cell))
                free[layer.rows] = False
                recesses += [] if layer.before else [area]
        in_plane = near(plane, points, 2 * noise_m) & free
        for layer in parallel:
            in_plane[layer.rows] = layer.before  # a wall goes on behind a board
        rows = np.flatnonzero(in_plane)
        if len(rows) < FEWEST_POINTS:
            continue
        area, cell = outline(plane, points[rows])
        # Densities per standard deviation of distance: within 2, and from 3 to 6, on both sides.
        away = np.abs(plane.distance(points[over(plane, area, points, 6 * noise_m)]))
        inside, beside = np.count_nonzero(away < 2 * noise_m) / 2, np.count_nonzero(away > 3 * noise_m) / 3
        if area.area >= SMALLEST_M2 and inside >= LEAST_CONTRAST * max(beside, 1):
            pieces.append(_Piece(plane, area, 3 * noise_m + cell, recesses))
            free &= ~over(plane, area, points, BAND * noise_m)  # or a shelf would grow along the wall behind it
    return pieces


def _refined(planes: Sequence[Plane], points: FloatArray, noise_m: float) -> list[Plane]:
    """Planes fitted to all points, turned to right angles where these allow it, with their axes."""
    index = [np.flatnonzero(near(plane, points, BAND * noise_m)) for plane in planes]
    claims = np.zeros(len(points), np.uint8)
    for rows in index:
        claims[rows] += 1
    # Points in the corner of two planes pull both towards the room.
    sole = [rows[claims[rows] == 1] for rows in index]
    chosen = [points[s if len(s) > 0.2 * len(rows) else rows] for s, rows in zip(sole, index, strict=True)]
    fitted = [fit(part, np.ones(len(part)), plane, noise_m) for part, plane in zip(chosen, planes, strict=True)]
    fitted = [
        fit(part, np.ones(len(part)), plane, noise_m, normal=plane.normal)
        for part, plane in zip(chosen, _regular(fitted, noise_m), strict=True)
    ]
    # The axes follow the most certain upright plane.
    heading = next((plane.normal for plane in fitted if abs(plane.normal[2]) < 1e-6), np.array([1.0, 0.0, 0.0]))
    return [with_axes(plane, heading) for plane in fitted]


def _regular(planes: Sequence[Plane], noise_m: float) -> list[Plane]:
    """Planes turned to be level, upright, and parallel or square to earlier planes, each about its centre."""
    up = np.array([0.0, 0.0, 1.0])
    headings: list[FloatArray] = []
    turned = []
    for plane in planes:
        side = np.ptp(plane.flat(plane.patches_m.reshape(-1, 3)), axis=0).min()
        # A plane is turned only within the uncertainty of its points: three standard errors of its direction, or one
        # standard deviation of the noise over its shorter side (edges and neighbours shift a fit by that much). A real
        # slope stays.
        error = max(ERRORS * plane.angle_error_rad, noise_m / max(side, noise_m))
        tolerance = float(np.clip(error, *TOLERANCE_RANGE_RAD))
        n = plane.normal
        if np.arccos(min(abs(n @ up), 1.0)) < tolerance:
            n = up * np.sign(n @ up)
        elif np.arcsin(min(abs(n @ up), 1.0)) < tolerance:
            n = n - up * (n @ up)
            n = n / np.linalg.norm(n)
            for heading in headings:
                pair = np.stack([heading, np.cross(up, heading)])
                best = pair[np.argmax(np.abs(pair @ n))]
                if np.arccos(min(abs(best @ n), 1.0)) < tolerance:
                    n = best * np.sign(best @ n)
                    break
            else:
                headings.append(n)
        turned.append(replace(plane, normal=n, offset_m=float(n @ plane.centre_m)))
    return turned
