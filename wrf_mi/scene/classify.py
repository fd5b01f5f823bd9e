"""Floor, ceiling, wall or other: the role of each plane, by its slope, size and height."""

from __future__ import annotations

from collections.abc import Sequence
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


def kinds(planes: Sequence[Plane], areas: Sequence[Any], middle_m: float) -> list[Kind]:
    """The role of each plane.

    Level planes that are large are floors and ceilings in turn from the lowest up, at least `STOREY_M` apart; steeper
    large planes over a floor are sloping ceilings. Upright planes that span most of a room's height are walls.
    The areas (shapely) are in the coordinates of their planes. The median height of the points, ``middle_m``, separates
    floors from ceilings where there is only one of them.
    """
    found: list[Kind] = ["other"] * len(planes)
    shadow = [footprint(plane, area) for plane, area in zip(planes, areas, strict=True)]
    height = [span(plane, area) for plane, area in zip(planes, areas, strict=True)]
    size = [area.area for area in areas]
    slope = [abs(plane.normal[2]) for plane in planes]
    least = least_level_area(planes, areas)
    large = sorted((i for i in range(len(planes)) if slope[i] > LEVEL and size[i] >= least), key=lambda i: height[i][0])
    for i in large:
        below = [j for j in large if found[j] != "other" and _overlap(shadow[i], shadow[j])]
        top = max(below, key=lambda j: height[j][0], default=None)
        if top is None:
            found[i] = "floor" if height[i][0] < middle_m else "ceiling"
        elif found[top] == "floor" and height[i][0] - height[top][0] > STOREY_M:
            found[i] = "ceiling"
        elif found[top] == "ceiling":
            found[i] = "floor" if height[i][0] - height[top][0] < SLAB_M else "ceiling"
    floors = [i for i in large if found[i] == "floor"]
    for i in range(len(planes)):
        if UPRIGHT < slope[i] <= LEVEL and size[i] >= least:
            under = [height[j][1] for j in floors if height[j][1] < height[i][1] and _overlap(shadow[i], shadow[j])]
            if height[i][1] > max(under, default=middle_m) + STOREY_M:
                found[i] = "ceiling"

    def is_wall(i: int) -> bool:
        middle = planes[i].lift(np.array(areas[i].centroid.coords[0]))
        near = [j for j in range(len(planes)) if found[j] != "other" and shapely.intersects(shadow[i], shadow[j])]
        # Heights of floors and ceilings where the wall stands: a ceiling may slope.
        level = {j: (planes[j].offset_m - planes[j].normal[:2] @ middle[:2]) / planes[j].normal[2] for j in near}
        floors = [level[j] for j in near if found[j] == "floor" and level[j] < middle[2]]
        ceilings = [level[j] for j in near if found[j] == "ceiling" and level[j] > middle[2]]
        least = WALL_SHARE * (min(ceilings) - max(floors)) if floors and ceilings else WALL_HEIGHT_M
        u0, _, u1, _ = areas[i].bounds
        return bool(height[i][1] - height[i][0] >= least and u1 - u0 >= NARROWEST_WALL_M)

    for i in [i for i in range(len(planes)) if slope[i] <= UPRIGHT and is_wall(i)]:
        found[i] = "wall"
    return found


def least_level_area(planes: Sequence[Plane], areas: Sequence[Any]) -> float:
    """Least area of floors and ceilings, square metres."""
    level = (area.area for plane, area in zip(planes, areas, strict=True) if abs(plane.normal[2]) > LEVEL)
    return min(LARGE_M2, LARGE_SHARE * max(level, default=0.0))


def footprint(plane: Plane, area: Any) -> Any:
    """The area seen from above (shapely, world x and y); a thin strip where the plane is upright."""
    flat = shapely.transform(area, lambda uv: plane.lift(uv)[:, :2])
    return shapely.buffer(shapely.convex_hull(flat), 0.1)


def span(plane: Plane, area: Any) -> tuple[float, float]:
    """Lowest and highest point of an area, metres."""
    z = plane.lift(shapely.get_coordinates(area))[:, 2]
    return float(z.min()), float(z.max())


def _overlap(a: Any, b: Any) -> bool:
    return bool(shapely.intersection(a, b).area > 0.3 * min(a.area, b.area))
