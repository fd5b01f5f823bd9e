"""Checks of edited scenes: parts that leave the scene or are moved into other surfaces."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np
import trimesh

from ..core import InputError
from ..core.angles import FloatArray
from .surfaces import Surface

logger = logging.getLogger(__name__)

TOUCH_M = 0.01
"""Depth up to which parts touch: surfaces of scans stand up to a centimetre in each other."""
PAIRS_PER_CHUNK = 1 << 18
"""Pairs of edge and triangle that are tried together: some 50 MB."""


def check_moves(before: Sequence[Surface], after: Sequence[Surface], names: set[str]) -> None:
    """Refuse a part that is moved out of the scene; warn of parts that are moved partly out, or into others.

    Args:
        before: surfaces of the scene as it was.
        after: those of the edited scene.
        names: names of the parts that were moved.

    Raises:
        InputError: a part lies wholly outside, with the distance; floor, ceiling and walls by more than its size.
    """
    moved, others = ([one for one in after if (one.name in names) == chosen] for chosen in (True, False))
    if not moved or not others:
        return  # a scene that is moved as a whole has no inside
    earlier = {one.name: one for one in before}
    corners = np.concatenate([one.vertices_m for one in before])
    low, high = corners.min(axis=0), corners.max(axis=0)
    for part in moved:
        first, last = part.vertices_m.min(axis=0), part.vertices_m.max(axis=0)
        outside_m = float(np.maximum(low - first, last - high).max())
        gap_m = float(np.maximum(low - last, first - high).max())
        # An outer wall may be moved outwards, which enlarges the room, but not farther than the room is large.
        if gap_m > (0 if part.kind == "other" else (high - low).max()):
            text = f"moved out of the scene, {gap_m:.2f} m beyond it; give a smaller displacement, or --remove"
            raise InputError(f"move {part.name}: {text}")
        if outside_m > TOUCH_M:
            logger.warning("move %s: reaches %.2f m out of the scene", part.name, outside_m)
        for other in others:
            depth_m = crossing_depth(part, other)
            if depth_m > TOUCH_M and depth_m > crossing_depth(earlier[part.name], other) + TOUCH_M:
                logger.warning("move %s: reaches %.2f m through %s", part.name, depth_m, other.name)


def crossing_depth(part: Surface, other: Surface) -> float:
    """How far a surface reaches through another one, metres; 0: it does not, or the two touch.

    Of an edge that is cut, the shorter piece counts; of all such edges of a surface, the longest.
    """
    triangles, cut = part.vertices_m[part.faces], other.vertices_m[other.faces]
    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    # Where surfaces touch, edges lie in faces and rounding decides what is cut: a smaller part touches nothing.
    smaller = np.clip(triangles, np.minimum(low + TOUCH_M, high), np.maximum(high - TOUCH_M, low))
    cut = cut[((cut.max(axis=1) >= low) & (cut.min(axis=1) <= high)).all(axis=1)]  # others are out of reach
    if not any(_depths(smaller, cut)):
        return 0.0
    # Of edges of the part and of the other, the shorter way back counts.
    return min((depth for depth in _depths(triangles, cut) if depth), default=0.0)


def _depths(left: FloatArray, right: FloatArray) -> tuple[float, float]:
    return _depth(left, right), _depth(right, left)


def _depth(triangles: FloatArray, cut: FloatArray) -> float:
    """The depth of `crossing_depth` by the edges of triangles [n, 3, 3] that other triangles [m, 3, 3] are cut by."""
    starts, ends = triangles.reshape(-1, 3), np.roll(triangles, -1, axis=1).reshape(-1, 3)
    normal, proper = trimesh.triangles.normals(cut)  # of triangles with an area alone
    cut = cut[proper]
    depth, step = 0.0, max(1, PAIRS_PER_CHUNK // max(len(cut), 1))
    for first in range(0, len(starts), step):
        start, end = starts[first : first + step, None], ends[first : first + step, None]
        # Signed distances [edges, triangles] of both ends from the planes.
        before, after = (((point - cut[:, 0]) * normal).sum(axis=-1) for point in (start, end))
        edge, triangle = np.nonzero(before * after < 0)
        d = before[edge, triangle], after[edge, triangle]
        met = start[edge, 0] + (d[0] / (d[0] - d[1]))[:, None] * (end - start)[edge, 0]
        within = (trimesh.triangles.points_to_barycentric(cut[triangle], met) >= 0).all(axis=1)
        depth = max(depth, float(np.minimum(np.abs(d[0]), np.abs(d[1]))[within].max(initial=0.0)))
    return depth
