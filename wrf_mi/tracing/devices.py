"""Checks of antenna positions: outside the scene, inside solids, near surfaces, behind outer walls."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from trimesh.triangles import closest_point

from ..core import InputError
from ..core.angles import FloatArray
from ..core.types import IntArray
from .surfaces import Surfaces

logger = logging.getLogger(__name__)

NEAREST_M = 0.01
"""Shortest segment of a path that Sionna RT keeps."""
INSIDE_M = 1e-4
"""Distance before a wall from which an antenna is traced that lies behind the wall on which it is mounted."""
ON_M = 1e-6
"""Distance from a plane within which float32 does not resolve its sides; Sionna RT then takes the right one."""
OUTSIDE_M = 1.0
"""Distance beyond the box around the scene from which an antenna is named: a scan may leave out what is nearer."""
PAIRS_PER_CHUNK = 1 << 20


def check_devices(surfaces: Surfaces, positions_m: FloatArray, names: Sequence[str]) -> None:
    """Refuse antennas inside a solid object; warn of those outside the scene or so close to a surface that paths are
    lost.

    Args:
        surfaces: surfaces of the scene.
        positions_m: positions [n, 3], metres.
        names: names of the antennas in messages, such as ``transmitter 3``.

    Raises:
        InputError: the first antenna inside a solid object.
    """
    thing = solid_around(surfaces, positions_m)
    if (thing >= 0).any():
        first = int(np.argmax(thing >= 0))
        at = ", ".join(f"{x:.2f}" for x in positions_m[first])
        what = surfaces.called(int(thing[first]))
        raise InputError(f"{names[first]} at ({at}) m is inside the solid {what}; move one of them")
    beyond = _beyond(surfaces, positions_m)
    outside = np.flatnonzero(beyond > OUTSIDE_M)
    if len(outside):
        text = "%d of %d antennas lie outside the scene (first: %s, by %.1f m): check its frame and the unit, metres"
        logger.warning(text, len(outside), len(positions_m), names[outside[0]], beyond[outside[0]])
    near = np.flatnonzero(_near(surfaces, positions_m))
    if len(near):
        text = "%d of %d antennas stand within 1 cm of a surface (first: %s): reflections there are not traced"
        logger.warning(text, len(near), len(positions_m), names[near[0]])


def before_walls(surfaces: Surfaces, positions_m: FloatArray) -> FloatArray:
    """Move antennas that are mounted on the scene's outer walls, but lie behind them, before the walls.

    Errors of a mesh, a millimetre in one from a scan, put such antennas behind their wall, where no path arrives. Only
    walls with all of the scene on one side count.

    Args:
        surfaces: surfaces of the scene.
        positions_m: positions [n, 3], metres.

    Returns:
        Corrected positions [n, 3].
    """
    moved = positions_m.copy()
    for point, plane in _pairs_near(surfaces, positions_m):
        for index in np.unique(plane):
            normal, offset = surfaces.normal[index], surfaces.offset[index]
            scene = surfaces.triangles @ normal - offset
            side = 1.0 if scene.max() > -scene.min() else -1.0
            if (side * scene).min() < -NEAREST_M or (side * scene).max() < NEAREST_M:
                continue  # not an outer wall, or the only wall
            near = point[plane == index]
            behind = near[side * (moved[near] @ normal - offset) < -ON_M]
            moved[behind] += (side * INSIDE_M - (moved[behind] @ normal - offset))[:, None] * normal
    return moved


def solid_around(surfaces: Surfaces, positions_m: FloatArray) -> IntArray:
    """Object of the solid around each position [n, 3], -1 for none; see `wrf_mi.tracing.surfaces.Surfaces`."""
    thing = np.full(len(positions_m), -1)
    for face in surfaces.solids:
        thing[winding_number(surfaces.triangles[face], positions_m) > 0.5] = surfaces.object_of(face[:1])[0]
    return thing


def winding_number(triangles: FloatArray, points: FloatArray) -> FloatArray:
    """Absolute winding number of a closed surface about each point: 1 inside, 0 outside; shape [n].

    Source: van Oosterom and Strackee, "The solid angle of a plane triangle" (1983), IEEE Trans. Biomed. Eng. 30(2).
    """
    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    number = np.zeros(len(points))
    candidates = np.flatnonzero(((points >= low) & (points <= high)).all(axis=1))
    step = max(1, PAIRS_PER_CHUNK // len(triangles))
    for start in range(0, len(candidates), step):
        part = candidates[start : start + step]
        a, b, c = (triangles[None, :, k] - points[part, None] for k in range(3))
        la, lb, lc = (np.linalg.norm(v, axis=-1) for v in (a, b, c))
        dot = lambda u, v: (u * v).sum(axis=-1)  # noqa: E731
        solid = np.arctan2(dot(a, np.cross(b, c)), la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb)
        number[part] = np.abs(solid.sum(axis=1)) / (2 * np.pi)
    return number


def _beyond(surfaces: Surfaces, points: FloatArray) -> FloatArray:
    """Distance [n] of points beyond the box around the scene along the worst axis, at most 0 inside; 0 without one."""
    if not len(surfaces.triangles):
        return np.zeros(len(points))
    low, high = surfaces.triangles.min(axis=(0, 1)), surfaces.triangles.max(axis=(0, 1))
    return np.asarray(np.maximum(low - points, points - high).max(axis=1))


def _near(surfaces: Surfaces, points: FloatArray) -> NDArray[np.bool_]:
    """Mask of points with a surface within `NEAREST_M`; bounds of planes include doorways, their triangles do not."""
    close = np.zeros(len(points), bool)
    for point, plane in _pairs_near(surfaces, points):
        for index in np.unique(plane):
            faces = surfaces.triangles[surfaces.plane == index]
            for row in point[plane == index]:
                away = closest_point(faces, np.broadcast_to(points[row], (len(faces), 3))) - points[row]
                close[row] |= np.linalg.norm(away, axis=1).min() < NEAREST_M
    return close


def _pairs_near(surfaces: Surfaces, points: FloatArray) -> Iterator[tuple[IntArray, IntArray]]:
    """Pairs of points and planes within `NEAREST_M`, inside the bounds of the plane's faces, in chunks."""
    step = max(1, PAIRS_PER_CHUNK // max(len(surfaces.normal), 1))
    for start in range(0, len(points), step):
        part = points[start : start + step]
        point, plane = np.nonzero(np.abs(part @ surfaces.normal.T - surfaces.offset) < NEAREST_M)
        along = np.einsum("pac,pc->pa", surfaces.axes[plane], part[point])
        within = ((along > surfaces.low[plane] - NEAREST_M) & (along < surfaces.high[plane] + NEAREST_M)).all(axis=1)
        yield start + point[within], plane[within]
