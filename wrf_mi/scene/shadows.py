"""Parts of walls, floors and ceilings that the scanner could not see because something stood before them."""

from __future__ import annotations

from typing import Any

import numpy as np
import shapely

from ..core.angles import FloatArray
from .outline import polygons
from .planes import Plane
from .surfaces import Kind

CELL_M = 0.1
BEFORE_M = {"wall": 1.2, "floor": 2.5, "ceiling": 2.5}
"""How far before a surface something may stand that hides it: cupboards; tables and lamps."""
HIDDEN_SHARE = 0.5
"""A gap is filled if things stand before this share of it."""
SMALLEST_GAP_M2 = 0.02


def fill_shadows(plane: Plane, area: Any, kind: Kind, points_m: FloatArray, noise_m: float) -> Any:
    """The area with its shadows filled: gaps within its bounding rectangle before which things stand.

    A scan of points does not tell a shadow from an opening: neither has points. But what casts a shadow was scanned
    itself. A gap with nothing before it (a door, a window, the missing quarter of an L-shaped room) stays.

    Args:
        plane: with its axes set.
        area: shapely, in the plane's coordinates.
        kind: a structural one; areas of kind "other" stay as they are.
        points_m: the thinned cloud [n, 3] without what floors, ceilings and walls have of it: these do not hide, they
            are seen through a gap.
        noise_m: standard deviation of the points.
    """
    if kind == "other":
        return area
    distance = np.abs(plane.distance(points_m))
    before = (distance > max(0.05, 4 * noise_m)) & (distance < BEFORE_M[kind])
    flat = plane.flat(points_m[before])
    filled = [area]
    for gap in polygons(shapely.difference(shapely.envelope(area), area)):
        if gap.area < SMALLEST_GAP_M2:
            continue
        inside = flat[shapely.contains_xy(gap, flat)]
        cells = len(np.unique(np.floor(inside / CELL_M), axis=0))
        if cells * CELL_M**2 >= HIDDEN_SHARE * gap.area:
            filled.append(gap)
    return shapely.union_all(filled, grid_size=1e-5)
