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
"""The second pass closes the corner of three planes."""


def join(planes: Sequence[Plane], areas: Sequence[Any], reach_m: Sequence[float]) -> list[Any]:
    """Extend or cut areas to the lines where their planes meet.

    Where two areas come within ``reach_m`` of the common line along the same stretch of it, an area on one side of the
    line is made to end there; an area on both sides stays, and the other ends at it. The areas (shapely) are in the
    coordinates of their planes.
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

    def to_line(plane: Plane) -> tuple[FloatArray, FloatArray]:
        """Transform to coordinates (t, s): t along the line, s away from it."""
        rows = np.stack([along, np.cross(plane.normal, along)])
        return rows @ np.stack([plane.u, plane.v], axis=1), rows @ (plane.normal * plane.offset_m - point)

    matrix, shift = to_line(a)
    turned, other_turned = _transformed(area, matrix, shift), _transformed(other, *to_line(b))
    stretches = shapely.intersection(
        shapely.buffer(_stretches(other_turned, reach), reach, cap_style="square"), _stretches(turned, reach)
    )
    changed = turned
    for stretch in polygons(stretches):
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
        # The parts of the strip beside the line that the area comes near are filled up to the line.
        near = [part.bounds for part in polygons(shapely.intersection(turned, _box(t0, t1, 0, sign * reach)))]
        fill = [_box(max(s[0], t0), min(s[2], t1), 0, sign * max(abs(s[1]), abs(s[3]))) for s in near]
        cut = _box(t0, t1, 0, -2 * sign * reach)
        changed = shapely.difference(shapely.union_all([changed, *fill]), cut)
    return area if changed is turned else _transformed(changed, matrix.T, -matrix.T @ shift)


def _stretches(turned: Any, reach: float) -> Any:
    """Stretches of the line that an area comes near: a union of boxes of unit height."""
    low, _, high, _ = turned.bounds
    strip = shapely.intersection(turned, shapely.box(low, -reach, high, reach))
    return shapely.union_all([_box(part.bounds[0], part.bounds[2], 0, 1) for part in polygons(strip)])


def _box(t0: float, t1: float, s0: float, s1: float) -> Any:
    return shapely.box(t0, min(s0, s1), t1, max(s0, s1))


def _transformed(area: Any, matrix: FloatArray, shift: FloatArray) -> Any:
    """A transformed area on a fine grid: rounding would let edges that touch cross."""
    return shapely.set_precision(shapely.make_valid(affinity.affine_transform(area, [*matrix.ravel(), *shift])), GRID_M)
