"""Planes of a building, which points lie in them, and their roles: floor, ceiling, wall or other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray

from ...core.angles import FloatArray
from .surfaces import Kind

THICKEST_M = 0.3  # a thicker box holds more than a plane
MARGIN_M = 0.15  # a plane may reach this far beyond the patch it was found as
LEVEL = np.cos(np.radians(10))  # cosine of the largest slope of a floor
UPRIGHT = np.sin(np.radians(20))  # sine of the largest lean of a wall
STOREY_M = 1.8  # least height of a room
SLAB_M = 1.0  # largest distance from a ceiling to the floor above it
LARGE_SHARE, LARGE_M2 = 0.2, 6.0
"""Floors and ceilings have at least this share of the largest level plane's area, or this area."""
WALL_SHARE, WALL_HEIGHT_M = 0.7, 2.0
"""Least height of a wall: share of the room's height, or metres where that is not known."""
NARROWEST_WALL_M = 0.15
BORNE_SHARE = 0.5  # least share of a ceiling's outline above walls; a terrace has a cliff at one side

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Plane:
    """A plane n . x = d and the patches that it was found as.

    Attributes:
        normal: unit vector n, shape [3]; its sign has no meaning.
        offset_m: d, metres.
        patches_m: corners of the rectangles where it was found, shape [k, 4, 3], metres.
        centre_m: weighted mean of its points, shape [3].
        angle_error_rad: standard error of the normal's direction.
        u: unit vector in the plane, shape [3].
        sparse: whether it was found by few points far from the scanner.
    """

    normal: FloatArray
    offset_m: float
    patches_m: FloatArray
    centre_m: FloatArray
    angle_error_rad: float
    u: FloatArray = field(default_factory=lambda: np.zeros(3))
    sparse: bool = False

    @property
    def v(self) -> FloatArray:
        """The second unit vector in the plane, n x u."""
        return np.cross(self.normal, self.u)

    def flat(self, points_m: FloatArray) -> FloatArray:
        """Coordinates [..., 2] along u and v of points [..., 3], metres."""
        return points_m @ np.stack([self.u, self.v], axis=1).astype(points_m.dtype)

    def lift(self, flat_m: FloatArray) -> FloatArray:
        """Points [..., 3] of the plane from coordinates [..., 2] in it."""
        return flat_m @ np.stack([self.u, self.v]) + self.normal * self.offset_m

    def distance(self, points_m: FloatArray) -> FloatArray:
        """Signed distance [...] of points from the plane, metres."""
        return points_m @ self.normal.astype(points_m.dtype) - points_m.dtype.type(self.offset_m)

    def shifted(self, distance_m: float) -> Plane:
        """The parallel plane at a distance along the normal, patches included."""
        shift = distance_m * self.normal
        return replace(
            self, offset_m=self.offset_m + distance_m, patches_m=self.patches_m + shift, centre_m=self.centre_m + shift
        )

    def rectangle(self, low_m: FloatArray, high_m: FloatArray) -> FloatArray:
        """Corners [4, 3] of the rectangle between two points [2] in the plane's coordinates."""
        (u0, v0), (u1, v1) = low_m, high_m
        return self.lift(np.array([[u0, v0], [u1, v0], [u1, v1], [u0, v1]]))

    def region(self, margin_m: float = MARGIN_M) -> Any:
        """Area (shapely, in the plane's coordinates) of its patches and a margin around them."""
        hulls = shapely.convex_hull(shapely.multipoints(self.flat(self.patches_m)))
        return shapely.buffer(shapely.union_all(hulls), margin_m, join_style="mitre")


def with_axes(plane: Plane, along: ArrayLike = (1.0, 0.0, 0.0)) -> Plane:
    """The plane with its axes set: u horizontal where it is upright, else the projection of ``along``."""
    n = plane.normal
    level = np.array([-n[1], n[0], 0.0])
    u = level if np.linalg.norm(level) > 0.5 else np.asarray(along) - n * (n @ np.asarray(along))
    return replace(plane, u=u / np.linalg.norm(u))


def near(plane: Plane, points_m: FloatArray, band_m: float, margin_m: float = MARGIN_M) -> Mask:
    """Which points [n] lie within a distance of the plane and over its patches."""
    return over(plane, plane.region(margin_m), points_m, band_m)


def over(plane: Plane, area: Any, points_m: FloatArray, band_m: float) -> Mask:
    """Which points [n] lie within a distance of an area (shapely) of the plane."""
    mask: Mask = np.abs(plane.distance(points_m)) < band_m
    index = np.flatnonzero(mask)
    mask[index] = shapely.contains_xy(area, plane.flat(points_m[index]))
    return mask


@dataclass(frozen=True, eq=False)
class Face:
    """A plane where it was seen: its area (shapely) in the coordinates of the plane."""

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
    """The role of each face, of which the median height of the points separates floors from ceilings if there is one
    alone.

    Level faces that are large are floors and ceilings in turn from the lowest up, at least `STOREY_M` apart; steeper
    large faces over a floor are sloping ceilings. Upright faces that span most of a room's height are walls.
    """
    least_m2 = least_level_area(faces)
    large = [face for face in faces if face.area.area >= least_m2]
    large.sort(key=lambda face: (face.span_m[0], -face.area.area))
    roles = dict[Face, Kind]()
    for face in large:
        if role := _level_role(face, roles, middle_m, faces):
            roles[face] = role
    roles |= {face: "ceiling" for face in large if _is_sloping_ceiling(face, roles, middle_m)}
    roles |= {face: "wall" for face in faces if _is_wall(face, roles)}
    return [roles.get(face, "other") for face in faces]


def _level_role(face: Face, roles: Mapping[Face, Kind], middle_m: float, faces: Sequence[Face]) -> Kind | None:
    """Role of a level face by the highest face below it; None: it is not level, a table, or a second layer."""
    if face.slope <= LEVEL:
        return None
    below = max((other for other in roles if face.overlaps(other)), key=lambda other: other.span_m[0], default=None)
    low = face.span_m[0]
    if below is None:
        is_terrace = "floor" in roles.values() and not _is_borne(face, faces)
        return "floor" if low < middle_m or is_terrace else "ceiling"
    apart_m = low - below.span_m[0]
    if roles[below] == "floor":
        return "ceiling" if apart_m > STOREY_M else None
    return "floor" if apart_m < SLAB_M else "ceiling"


def _is_borne(face: Face, faces: Sequence[Face]) -> bool:
    """Whether walls below most of the outline of a level face bear it: the ceiling of a room, not a higher ground."""
    low = face.span_m[0]
    walls = [
        wall.shadow
        for wall in faces
        if wall.slope < UPRIGHT and wall.span_m[0] < low - STOREY_M and wall.span_m[1] > low - SLAB_M
    ]
    outline = shapely.boundary(face.shadow)
    borne = shapely.intersection(outline, shapely.buffer(shapely.union_all(walls), THICKEST_M))
    return bool(borne.length >= BORNE_SHARE * outline.length)


def _is_sloping_ceiling(face: Face, roles: Mapping[Face, Kind], middle_m: float) -> bool:
    """Whether a face slopes and reaches a storey above the floors below it: the roof of an attic, not a ramp."""
    if not UPRIGHT < face.slope <= LEVEL:
        return False
    top, floors = face.span_m[1], [floor for floor, role in roles.items() if role == "floor"]
    below = [floor.span_m[1] for floor in floors if floor.span_m[1] < top and face.overlaps(floor)]
    return top > max(below, default=middle_m) + STOREY_M


def storey(face: Face, roles: Mapping[Face, Kind]) -> tuple[float, float]:
    """Heights of the floor below and the ceiling above the middle of a face; infinite where there is none."""
    x, y, z = face.plane.lift(np.array(face.area.centroid.coords[0]))
    levels = [
        (role, level.height_at(x, y)) for level, role in roles.items() if shapely.intersects(face.shadow, level.shadow)
    ]
    floor = max((height for role, height in levels if role == "floor" and height < z), default=-np.inf)
    return floor, min((height for role, height in levels if role == "ceiling" and height > z), default=np.inf)


def _is_wall(face: Face, roles: Mapping[Face, Kind]) -> bool:
    """Whether a face is upright and spans most of the height between floor and ceiling at its middle."""
    if face.slope > UPRIGHT:
        return False
    floor, ceiling = storey(face, roles)
    least_m = WALL_SHARE * (ceiling - floor) if np.isfinite(ceiling - floor) else WALL_HEIGHT_M
    left, _, right, _ = face.area.bounds
    return bool(np.ptp(face.span_m) >= least_m and right - left >= NARROWEST_WALL_M)


def least_level_area(faces: Sequence[Face]) -> float:
    """Least area of floors and ceilings, square metres."""
    return min(LARGE_M2, LARGE_SHARE * max((face.area.area for face in faces if face.slope > LEVEL), default=0.0))
