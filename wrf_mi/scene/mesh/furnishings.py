"""Doors, large furniture and images of mirrors among the planes of a scanned building."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely

from .outline import GRID_M, polygons
from .planes import LEVEL, THICKEST_M, Face, storey
from .surfaces import Kind

DOOR_WIDTH_M, DOOR_HEIGHT_M = (0.55, 1.3), (1.85, 2.3)
FOOT_M = 0.3  # largest height of the lower end of a door or cupboard
BELOW_CEILING_M = 0.1  # least distance of the top of furniture from the ceiling
PARALLEL = np.cos(np.radians(5))
BESIDE_M = 0.25  # distance from furniture at which the floor goes on
GAP_M = 0.3  # largest gap between parts of a floor that people walk on: a threshold


def furnishings(faces: Sequence[Face], roles: Sequence[Kind]) -> list[str]:
    """Names of faces: their role, but ``door`` for closed doors and ``other`` for furniture as high as a wall.

    Both end below the ceiling. A door stands in or before a wall, and furniture on a floor that goes on behind it.
    """
    levels: dict[Face, Kind] = {
        face: role for face, role in zip(faces, roles, strict=True) if face.slope > LEVEL and role != "other"
    }
    floors = shapely.union_all([_plan(face) for face, role in levels.items() if role == "floor"])
    walls = [face for face, role in zip(faces, roles, strict=True) if role == "wall" and not face.area.is_empty]
    names = list[str]()
    for face, role in zip(faces, roles, strict=True):
        name: str = role
        if role == "wall" and not face.area.is_empty:
            floor, ceiling = storey(face, levels)
            low, high = face.span_m
            left, _, right, _ = face.area.bounds
            if np.isfinite(floor + ceiling) and high < ceiling - BELOW_CEILING_M and low < floor + FOOT_M:
                is_door = _within(right - left, DOOR_WIDTH_M) and _within(high - floor, DOOR_HEIGHT_M)
                if is_door and any(_is_before(face, wall) for wall in walls if wall.span_m[1] > high + BELOW_CEILING_M):
                    name = "door"
                elif _stands_on(face, floors):
                    name = "other"
        names.append(name)
    return names


def reached(faces: Sequence[Face], roles: Sequence[Kind]) -> list[Face]:
    """Faces without images in mirrors: parts that do not adjoin the floor on which people walk, seen from above."""
    floors = [_plan(face) for face, role in zip(faces, roles, strict=True) if role == "floor"]
    parts = [part for floor in floors for part in polygons(floor)]
    if not parts:
        return list(faces)
    walked, area_m2 = max(parts, key=lambda part: float(part.area)), 0.0
    while walked.area > area_m2 + GRID_M:
        area_m2 = walked.area
        walked = shapely.union_all([part for part in parts if shapely.distance(part, walked) < GAP_M])
    near = []
    for face in faces:
        apart = [Face(face.plane, part) for part in polygons(face.area)]
        inside = [part.area for part in apart if shapely.distance(_plan(part), walked) < GAP_M]
        near.append(face if len(inside) == len(apart) else Face(face.plane, shapely.union_all(inside)))
    return near


def _plan(face: Face) -> shapely.Geometry:
    """The area of a face, seen from above."""
    return shapely.make_valid(shapely.transform(face.area, lambda uv: face.plane.lift(uv)[:, :2]))


def _within(value: float, limits: tuple[float, float]) -> bool:
    return limits[0] <= value <= limits[1]


def _is_before(face: Face, wall: Face) -> bool:
    """Whether a face lies in a parallel wall's plane, or in its opening, within the wall's thickness."""
    if wall is face or abs(wall.plane.normal @ face.plane.normal) < PARALLEL:
        return False
    middle = face.plane.lift(np.array(face.area.centroid.coords[0]))
    about = shapely.envelope(wall.area)
    return bool(abs(wall.plane.distance(middle)) < THICKEST_M and shapely.contains_xy(about, *wall.plane.flat(middle)))


def _stands_on(face: Face, floors: shapely.Geometry) -> bool:
    """Whether the floor goes on before and behind the middle of an upright face."""
    middle, across = face.plane.lift(np.array(face.area.centroid.coords[0]))[:2], face.plane.normal[:2]
    return all(shapely.contains_xy(floors, *(middle + side * BESIDE_M * across)) for side in (-1, 1))
