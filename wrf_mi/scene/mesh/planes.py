"""Planes of a building, and which points lie in them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray

from ...core.angles import FloatArray

THICKEST_M = 0.3
"""A thicker box holds more than a plane."""
MARGIN_M = 0.15
"""A plane may reach this far beyond the patch it was found as."""

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
    """

    normal: FloatArray
    offset_m: float
    patches_m: FloatArray
    centre_m: FloatArray
    angle_error_rad: float
    u: FloatArray = field(default_factory=lambda: np.zeros(3))

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
            self,
            offset_m=self.offset_m + distance_m,
            patches_m=self.patches_m + shift,
            centre_m=self.centre_m + shift,
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
