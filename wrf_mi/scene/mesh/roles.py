"""Floor, ceiling, wall or other: the role of each plane, by its slope, size and height."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import shapely

from .planes import Plane
from .surfaces import Kind

LEVEL = np.cos(np.radians(10))
"""Cosine of the largest slope of a floor."""
UPRIGHT = np.sin(np.radians(20))
"""Sine of the largest lean of a wall."""
STOREY_M = 1.8
"""Least height of a room."""
SLAB_M = 1.0
"""Largest distance from a ceiling to the floor above it."""
LARGE_SHARE, LARGE_M2 = 0.2, 6.0
"""Floors and ceilings have at least this share of the largest level plane's area, or this area."""
WALL_SHARE, WALL_HEIGHT_M = 0.7, 2.0
"""Least height of a wall: share of the room's height, or metres where that is not known."""
NARROWEST_WALL_M = 0.15


@dataclass(frozen=True, eq=False)
class Face:
    """A plane where it was seen.

    Attributes:
        plane: the plane.
        area: shapely, in the coordinates of the plane.
    """

    plane: Plane
    area: Any

    @property
    def slope(self) -> float:
        """Cosine of the angle between the normal and the vertical."""
        return float(abs(self.plane.normal[2]))

    @cached_property
    def shadow(self) -> Any:
        """The area seen from above (shapely, world x and y); a thin strip where the plane is upright."""
        flat = shapely.transform(self.area, lambda uv: self.plane.lift(uv)[:, :2])
        return shapely.buffer(shapely.convex_hull(flat), 0.1)

    @cached_property
    def span_m(self) -> tuple[float, float]:
        """Lowest and highest z."""
        z = self.plane.lift(shapely.get_coordinates(self.area))[:, 2]
        return float(z.min()), float(z.max())

    def overlaps(self, other: Face, share: float = 0.3) -> bool:
        """Whether one of both faces lies above or below at least a share of the other."""
        common = shapely.intersection(self.shadow, other.shadow).area
        return bool(common > share * min(self.shadow.area, other.shadow.area))

    def height_at(self, x: float, y: float) -> float:
        """Height of the plane above a point of the ground: a ceiling may slope."""
        return float((self.plane.offset_m - self.plane.normal[:2] @ (x, y)) / self.plane.normal[2])


def kinds(faces: Sequence[Face], middle_m: float) -> list[Kind]:
    """The role of each face.

    Level faces that are large are floors and ceilings in turn from the lowest up, at least `STOREY_M` apart; steeper
    large faces over a floor are sloping ceilings. Upright faces that span most of a room's height are walls. The median
    height of the points, ``middle_m``, separates floors from ceilings where there is only one of them.
    """
    least_m2 = least_level_area(faces)
    large = sorted((face for face in faces if face.area.area >= least_m2), key=lambda face: face.span_m[0])
    roles = dict[Face, Kind]()
    for face in large:
        if face.slope > LEVEL and (role := _level_role(face, roles, middle_m)):
            roles[face] = role
    floors = [face for face, role in roles.items() if role == "floor"]
    sloping = [face for face in large if UPRIGHT < face.slope <= LEVEL]
    roles |= {face: "ceiling" for face in sloping if _is_high(face, floors, middle_m)}
    upright = [face for face in faces if face.slope <= UPRIGHT]
    roles |= {face: "wall" for face in upright if _spans_room(face, roles)}
    return [roles.get(face, "other") for face in faces]


def _level_role(face: Face, roles: Mapping[Face, Kind], middle_m: float) -> Kind | None:
    """Role of a level face by the highest face below it; None: it is a table, or a second layer."""
    below = max((other for other in roles if face.overlaps(other)), key=lambda other: other.span_m[0], default=None)
    low = face.span_m[0]
    if below is None:
        return "floor" if low < middle_m else "ceiling"
    apart_m = low - below.span_m[0]
    if roles[below] == "floor":
        return "ceiling" if apart_m > STOREY_M else None
    return "floor" if apart_m < SLAB_M else "ceiling"


def _is_high(face: Face, floors: Sequence[Face], middle_m: float) -> bool:
    """Whether a sloping face reaches a storey above the floors below it: the roof of an attic, not a ramp."""
    top = face.span_m[1]
    below = [floor.span_m[1] for floor in floors if floor.span_m[1] < top and face.overlaps(floor)]
    return top > max(below, default=middle_m) + STOREY_M


def _spans_room(face: Face, roles: Mapping[Face, Kind]) -> bool:
    """Whether an upright face spans most of the height between floor and ceiling at its middle."""
    x, y, z = face.plane.lift(np.array(face.area.centroid.coords[0]))
    levels = [
        (role, level.height_at(x, y)) for level, role in roles.items() if shapely.intersects(face.shadow, level.shadow)
    ]
    floor = max((height for role, height in levels if role == "floor" and height < z), default=-np.inf)
    ceiling = min((height for role, height in levels if role == "ceiling" and height > z), default=np.inf)
    least_m = WALL_SHARE * (ceiling - floor) if np.isfinite(ceiling - floor) else WALL_HEIGHT_M
    left, _, right, _ = face.area.bounds
    return bool(np.ptp(face.span_m) >= least_m and right - left >= NARROWEST_WALL_M)


def least_level_area(faces: Sequence[Face]) -> float:
    """Least area of floors and ceilings, square metres."""
    return min(LARGE_M2, LARGE_SHARE * max((face.area.area for face in faces if face.slope > LEVEL), default=0.0))
