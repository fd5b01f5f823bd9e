"""Checks of antenna positions: outside the scene, inside solids, on surfaces and a little behind them."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence

import numpy as np
from trimesh.triangles import closest_point

from ...core import InputError
from ...core.types import FloatArray, IntArray
from ...scene.mesh.surfaces import Body, bounds
from .surfaces import Surfaces

logger = logging.getLogger(__name__)

BEHIND_M = 0.01  # distance behind an outer wall, or inside a solid, up to which an antenna counts as mounted on it
BEFORE_M = 1e-4  # least distance before a surface from which an antenna on it is traced
CLEAR = 2.5e-5  # that distance as a share of `Surfaces.scale_m`: twice as far as `images.displaced` moves an antenna
ON_M = 1e-6  # distance from a sheet within which rounding decides an antenna's side; it then takes that of the normal
ON_SHARE = 0.1  # depth behind a surface, as a share of `clear_m`, up to which an antenna is on it but for rounding
OUTSIDE_M = 0.02  # distance beyond the scene's box from which an antenna is named: a wall may let no path pass
PAIRS_PER_CHUNK = 1 << 20  # pairs of a position and a triangle in a chunk: bounds the memory


def check_devices(surfaces: Surfaces, positions_m: FloatArray, names: Sequence[str]) -> None:
    """Warn of antennas at positions [n, 3], metres, outside the scene; `InputError` names the first inside a solid."""
    enclosing = solid_around(surfaces, positions_m)
    if (enclosing >= 0).any():
        first = int(np.argmax(enclosing >= 0))
        at = ", ".join(f"{x:.2f}" for x in positions_m[first])
        solid = surfaces.called(int(enclosing[first]))
        raise InputError(f"{names[first]} at ({at}) m is inside the solid {solid}; move one of them")
    if not len(surfaces.triangles):
        return
    low, high = surfaces.box_m
    beyond = np.maximum(low - positions_m, positions_m - high).max(axis=1)
    outside = np.flatnonzero(beyond > OUTSIDE_M)
    if len(outside):
        text = "%d of %d antennas lie outside the scene (first: %s, by %.2f m): check its frame and the unit, metres; "
        text += "estimated positions may"
        logger.warning(text, len(outside), len(positions_m), names[outside[0]], beyond[outside[0]])


def clear_m(surfaces: Surfaces) -> float:
    """Distance before a surface, in metres, from which antennas that are on it are traced."""
    return max(BEFORE_M, CLEAR * surfaces.scale_m)


def before_surfaces(surfaces: Surfaces, positions_m: FloatArray) -> FloatArray:
    """Move antennas at positions [n, 3] that are mounted on a surface before it, so that they have a side."""
    # Outer walls, with all of the scene on one side, and solids have a right side, to which antennas up to `BEHIND_M`
    # behind are moved; at other sheets an antenna keeps its side.
    # Errors of a mesh, a millimetre in one from a scan, put antennas behind the wall on which they are mounted, where
    # no path arrives, or inside a cabinet.
    moved, clear = _outside_solids(surfaces, positions_m), clear_m(surfaces)
    point, plane = surfaces.near(moved, BEHIND_M)
    along = np.einsum("pac,pc->pa", surfaces.axes[plane], moved[point])
    within = ((along > surfaces.low[plane] - BEHIND_M) & (along < surfaces.high[plane] + BEHIND_M)).all(axis=1)
    point, plane = point[within], plane[within]
    for index in np.unique(plane):
        normal, offset = surfaces.normal[index], surfaces.offset[index]
        corner_heights, near = surfaces.triangles @ normal - offset, point[plane == index]
        inner_side = 1.0 if corner_heights.max() > -corner_heights.min() else -1.0
        inwards = inner_side * corner_heights
        height = moved[near] @ normal - offset
        # An outer wall has the whole scene before it; any other sheet may carry antennas on both sides.
        outer = inwards.min() >= -BEHIND_M and inwards.max() >= BEHIND_M
        sides = np.full(len(near), inner_side) if outer else np.where(height < -ON_M, -1.0, 1.0)
        low = sides * height < clear
        moved[near[low]] += (sides * clear - height)[low, None] * normal
    return moved


def from_behind(surfaces: Surfaces, positions_m: FloatArray) -> FloatArray:
    """Positions [n, 3] of which those behind a surface, not those on it, are moved as by `before_surfaces`."""
    moved = before_surfaces(surfaces, positions_m)
    behind = np.linalg.norm(moved - positions_m, axis=1) > (1 + ON_SHARE) * clear_m(surfaces)
    return np.where(behind[:, None], moved, positions_m)


def _near_solids(
    surfaces: Surfaces, positions_m: FloatArray, margin_m: float
) -> Iterator[tuple[Body, FloatArray, IntArray]]:
    """Solids, with their normals, and the positions [n, 3] that lie within their bounds and a margin."""
    low, high = surfaces.solid_bounds_m
    near = np.ones((len(positions_m), len(low)), bool)
    # Axis by axis: furnished scenes have hundreds of solids, and predictions few positions.
    for axis, coordinate in enumerate(positions_m.T):
        near &= (coordinate[:, None] >= low[:, axis] - margin_m) & (coordinate[:, None] <= high[:, axis] + margin_m)
    for number in np.flatnonzero(near.any(axis=0)):
        yield *surfaces.solids[number], np.flatnonzero(near[:, number])


def _outside_solids(surfaces: Surfaces, positions_m: FloatArray) -> FloatArray:
    """Positions [n, 3], moved before the nearest face where they are on a solid, or up to `BEHIND_M` inside."""
    moved, clear = positions_m.copy(), clear_m(surfaces)
    # What one solid moves may come to lie at the next one.
    for solid, normal, rows in _near_solids(surfaces, positions_m, BEHIND_M + 2 * clear):
        if len(normal) < len(corners := solid.corners_m):
            continue
        # Distances from planes are computed faster than those from faces, and rule out most positions.
        height = moved[rows] @ normal.T - (corners[:, 0] * normal).sum(axis=1)
        inside = winding_number(corners, moved[rows]) > 0.5
        for row, limit in zip(rows, np.where(inside, BEHIND_M, clear), strict=True):
            if np.abs(height[rows == row]).min() < limit:
                closest = closest_point(corners, np.broadcast_to(moved[row], (len(corners), 3)))
                away = np.linalg.norm(closest - moved[row], axis=1)
                if away.min() < limit:
                    moved[row] = closest[away.argmin()] + clear * normal[away.argmin()]
    return moved


def solid_around(surfaces: Surfaces, positions_m: FloatArray) -> IntArray:
    """Object of the solid around each position [n, 3], -1 for none; see `wrf_mi.tracing.search.surfaces.Surfaces`."""
    enclosing = np.full(len(positions_m), -1)
    for solid, _, rows in _near_solids(surfaces, positions_m, 0.0):
        inside = winding_number(solid.corners_m, positions_m[rows]) > 0.5
        enclosing[rows[inside]] = surfaces.object_of(solid.faces[:1])[0]
    return enclosing


def winding_number(triangles: FloatArray, points: FloatArray) -> FloatArray:
    """Absolute winding number of a closed surface about each point: 1 inside, 0 outside; shape [n].

    Source: van Oosterom and Strackee, "The solid angle of a plane triangle" (1983), IEEE Trans. Biomed. Eng. 30(2).
    """
    low, high = bounds(triangles)
    number = np.zeros(len(points))
    candidates = np.flatnonzero(((points >= low) & (points <= high)).all(axis=1))
    step = max(1, PAIRS_PER_CHUNK // len(triangles))
    for start in range(0, len(candidates), step):
        part = candidates[start : start + step]
        a, b, c = (triangles[None, :, k] - points[part, None] for k in range(3))
        la, lb, lc = (np.linalg.norm(v, axis=-1) for v in (a, b, c))
        ab, bc, ca = ((u * v).sum(axis=-1) for u, v in ((a, b), (b, c), (c, a)))
        # tan(omega / 2) = a . (b x c) / (|a| |b| |c| + (a . b) |c| + (b . c) |a| + (c . a) |b|), in the quadrant of
        # both terms; the solid angles omega of a closed surface add up to 4 pi inside it, and to 0 outside.
        half_angle = np.arctan2((a * np.cross(b, c)).sum(axis=-1), la * lb * lc + ab * lc + bc * la + ca * lb)
        number[part] = np.abs(half_angle.sum(axis=1)) / (2 * np.pi)
    return number
