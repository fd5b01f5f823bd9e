"""Planes that end where they meet: closed corners between walls, floor and ceiling."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import shapely
from shapely import affinity

from ..core.angles import FloatArray
from .outline import polygons
from .planes import Plane

STEEPEST = np.cos(np.radians(20))
"""Planes that meet at a smaller angle have no reliable line in common."""
GRID_M = 1e-5
PASSES = 2
"""The second one closes the corner of three planes."""


def join(planes: Sequence[Plane], areas: Sequence[Any], reach_m: Sequence[float]) -> list[Any]:
    """Extend or cut areas to the lines where their planes meet.

    Where two areas come within ``reach_m`` of the common line along the same stretch of it, an area that lies on
    one side of the line is made to end there; one that lies on both sides stays (the other one butts against it).

    Args:
        planes: p planes with their axes set.
        areas: the area of each (shapely), in the plane's coordinates.
        reach_m: the largest gap or overlap that is closed.
    """
    areas = list(areas)
    for _ in range(PASSES):
        for i, a in enumerate(planes):
            for j, b in enumerate(planes):
                if i != j and abs(a.normal @ b.normal) < STEEPEST:
                    areas[i] = _end_at(a, areas[i], b, areas[j], min(reach_m[i], reach_m[j]))
    return areas


def _end_at(a: Plane, area: Any, b: Plane, other: Any, reach: float) -> Any:
    along = np.cross(a.normal, b.normal)
    along /= np.linalg.norm(along)
    point = np.linalg.solve(np.stack([a.normal, b.normal, along]), np.array([a.offset_m, b.offset_m, 0.0]))
    # Coordinates (t, s): t along the line, s away from it.
    turned, other_turned = _turned(a, area, along, point), _turned(b, other, along, point)
    stretches = shapely.intersection(
        shapely.buffer(_stretches(other_turned, reach), reach, cap_style="square"), _stretches(turned, reach)
    )
    changed = turned
    for stretch in shapely.get_parts(stretches):
        if stretch.geom_type != "Polygon" or stretch.is_empty:
            continue
        t0, _, t1, _ = stretch.bounds
        if t1 - t0 < reach:
            continue
        share = [
            shapely.intersection(turned, shapely.box(t0, s, t1, s + reach)).area / (reach * (t1 - t0))
            for s in (reach, -2 * reach)
        ]
        if (share[0] > 0.25) == (share[1] > 0.25):
            continue
        sign = 1 if share[0] > share[1] else -1
        fill = _box(t0, t1, 0, sign * reach)
        cut = _box(t0, t1, 0, -2 * sign * reach)
        changed = shapely.difference(shapely.union(changed, _near(turned, fill, sign)), cut)
    if changed is turned:
        return area
    return _back(a, changed, along, point)


def _near(area: Any, fill: Any, sign: int) -> Any:
    """The part of a strip beside the line that the area reaches up to."""
    t0, _, t1, _ = fill.bounds
    own = shapely.intersection(area, fill)
    spans = [part.bounds for part in polygons(own)]
    boxes = [_box(max(s[0], t0), min(s[2], t1), 0, sign * max(abs(s[1]), abs(s[3]))) for s in spans]
    return shapely.union_all(boxes) if boxes else shapely.Polygon()


def _stretches(turned: Any, reach: float) -> Any:
    """Where along the line an area comes near it: a union of boxes of unit height."""
    low, _, high, _ = turned.bounds
    strip = shapely.intersection(turned, shapely.box(low, -reach, high, reach))
    bounds = [part.bounds for part in polygons(strip)]
    return shapely.union_all([shapely.box(t0, 0, t1, 1) for t0, _, t1, _ in bounds])


def _box(t0: float, t1: float, s0: float, s1: float) -> Any:
    return shapely.box(t0, min(s0, s1), t1, max(s0, s1))


def _matrix(plane: Plane, along: FloatArray, point: FloatArray) -> tuple[FloatArray, FloatArray]:
    across = np.cross(plane.normal, along)
    rows = np.stack([along, across])
    basis = np.stack([plane.u, plane.v], axis=1)
    return rows @ basis, rows @ (plane.normal * plane.offset_m - point)


def _turned(plane: Plane, area: Any, along: FloatArray, point: FloatArray) -> Any:
    m, shift = _matrix(plane, along, point)
    return _valid(affinity.affine_transform(area, [*m.ravel(), *shift]))


def _back(plane: Plane, area: Any, along: FloatArray, point: FloatArray) -> Any:
    m, shift = _matrix(plane, along, point)
    inverse = m.T
    return _valid(affinity.affine_transform(area, [*inverse.ravel(), *(-inverse @ shift)]))


def _valid(area: Any) -> Any:
    """The area on a fine grid: turning it lets edges that touch cross by a rounding error."""
    return shapely.set_precision(shapely.make_valid(area), GRID_M)
