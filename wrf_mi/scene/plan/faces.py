"""Plans drawn as lines, whose walls may be drawn by both of their faces, as those of CAD programs are."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from ...core.angles import FloatArray

WALL, DOOR, GLASS = "wall", "door", "itu_glass"
THICKEST_WALL_M = 0.6  # what is thicker than an outer wall is a block
PARALLEL_RAD = np.radians(0.1)  # largest angle between faces of one wall, and of lines of one direction
SAME_M = 0.002  # offsets and ends of lines that differ by less are equal: drawings are exact but for rounding
LAYER_M = 0.12  # widest layer of a wall beside two faces, such as its insulation
LEAST_PAIRED = 0.5  # least share of the length that has an opposite face in a plan whose walls are drawn by both
MARGIN_M = 0.02  # distance within which an end of a line touches a wall
SAG_M = 0.005  # largest distance of a curve from its chords


def straight_pieces(curves: Iterable[NDArray[Any]]) -> FloatArray:
    """Straight pieces [n, 2, 2] of curves through points [k, 2]."""
    return np.concatenate([np.empty((0, 2, 2)), *(np.stack([xy[:-1], xy[1:]], axis=1) for xy in curves)])


@dataclass(frozen=True)
class PlanLines:
    """Walls of a plan that is drawn as lines.

    Attributes:
        pieces_m: end points [n, 2, 2], metres, by what is drawn: `WALL`, `DOOR`, or a wall's material of ITU-R P.2040.
        by_faces: whether walls may be drawn by both of their faces.
    """

    pieces_m: Mapping[str, FloatArray]
    by_faces: bool = False


def middle_lines(pieces_m: FloatArray, layer_m: float = LAYER_M) -> tuple[FloatArray, FloatArray]:
    """Middle lines [m, 2, 2] of walls drawn by both faces [n, 2, 2], and their thicknesses [m], 0 for single lines.

    Parallel lines up to `THICKEST_WALL_M` apart are faces of a wall, the nearest first, and lines at most ``layer_m``
    beside two faces belong to it. Lines across a wall's end are left out. If less than `LEAST_PAIRED` of the length has
    an opposite face, every line is a wall.
    """
    # Columns: lower and upper offset, start, end; directions are lists, since each has its own axes.
    directions = [(axes, _strips(pieces_m[rows] @ axes.T, layer_m)) for axes, rows in _directions(pieces_m)]
    strips = [(axes, *strip) for axes, of_direction in directions for strip in of_direction]
    lengths = np.array([end - start for *_, start, end in strips])
    thick = np.array([high - low for _, low, high, *_ in strips])
    # Two faces are one strip.
    paired = 2 * lengths[thick > 0].sum()
    if paired < LEAST_PAIRED * (paired + lengths[thick == 0].sum()):
        return pieces_m, np.zeros(len(pieces_m))
    corners = [
        shapely.box(start, low, end, high) if high > low else shapely.linestrings([[start, low], [end, low]])
        for _, low, high, start, end in strips
    ]
    areas = np.array(
        [
            shapely.transform(part, lambda xy, axes=axes: xy @ axes)
            for part, (axes, *_) in zip(corners, strips, strict=True)
        ]
    )
    solid = np.flatnonzero(thick)
    line, wall = shapely.STRtree(areas[solid]).query(areas, predicate="dwithin", distance=MARGIN_M)
    beside = np.zeros(len(strips))
    np.maximum.at(beside, line, thick[solid[wall]])
    # Ends of walls, and stretches of a face that another wall meets or that go round a corner.
    is_wall = (thick > 0) | (lengths > beside + MARGIN_M)
    middles = [np.array([[s, (low + high) / 2], [e, (low + high) / 2]]) @ axes for axes, low, high, s, e in strips]
    return np.array(middles)[is_wall], thick[is_wall]


def _directions(pieces_m: FloatArray) -> Iterator[tuple[FloatArray, NDArray[np.intp]]]:
    """Axes [2, 2] along and across the lines of each direction, and the numbers of these lines."""
    along = pieces_m[:, 1] - pieces_m[:, 0]
    angle = np.arctan2(along[:, 1], along[:, 0]) % np.pi
    left = np.ones(len(angle), bool)
    for first in np.argsort(-np.linalg.norm(along, axis=-1), kind="stable"):
        if left[first]:
            off = np.abs((angle - angle[first] + np.pi / 2) % np.pi - np.pi / 2)
            rows = np.flatnonzero(left & (off <= PARALLEL_RAD))
            left[rows] = False
            c, s = np.cos(angle[first]), np.sin(angle[first])
            yield np.array([[c, s], [-s, c]]), rows


def _strips(lines: FloatArray, layer_m: float) -> list[tuple[float, float, float, float]]:
    """Lower and upper offset, start and end of the walls of parallel lines [n, 2, 2], drawn along the first axis."""
    offset = _snapped(lines[..., 1].mean(axis=1))
    start, end = np.sort(_snapped(lines[..., 0]), axis=1).T
    breaks = np.unique([start, end])
    pieces: dict[tuple[float, float], list[list[float]]] = {}
    for begin, stop in pairwise(breaks.tolist()):
        offsets = np.unique(offset[(start <= begin) & (end >= stop)])
        for pair in _faces(offsets.tolist(), layer_m):
            stretches = pieces.setdefault(pair, [])
            if stretches and stretches[-1][1] == begin:
                stretches[-1][1] = stop
            else:
                stretches.append([begin, stop])
    _bridge(pieces)
    return [(*pair, begin, stop) for pair, stretches in pieces.items() for begin, stop in stretches]


def _snapped(values: FloatArray) -> FloatArray:
    """Values of which those that differ by `SAME_M` from the next are equal, the least of them."""
    order = np.unique(values)
    first = np.diff(order, prepend=-np.inf) > SAME_M
    return np.asarray(order[first][np.cumsum(first)[np.searchsorted(order, values)] - 1])


def _faces(offsets: list[float], layer_m: float) -> list[tuple[float, float]]:
    """Lower and upper offset of each wall at a place where lines have these offsets, in their order; equal for one."""
    walls = [(offset, offset) for offset in offsets]
    while len(walls) > 1:
        gaps = [after[0] - before[1] for before, after in pairwise(walls)]
        singles = [a[0] == a[1] and b[0] == b[1] for a, b in pairwise(walls)]
        most = [THICKEST_WALL_M if single else layer_m for single in singles]
        near = [i for i, gap in enumerate(gaps) if gap <= most[i] and walls[i + 1][1] - walls[i][0] <= THICKEST_WALL_M]
        if not near:
            break
        i = min(near, key=lambda number: gaps[number])
        walls[i : i + 2] = [(walls[i][0], walls[i + 1][1])]
    return walls


def _bridge(pieces: dict[tuple[float, float], list[list[float]]]) -> None:
    """Join stretches of a wall between which one face goes on, where another wall meets it."""
    for (low, high), stretches in list(pieces.items()):
        faces = [pieces.get((side, side), []) for side in (low, high)] if high > low else []
        for single in faces:
            for gap in list(single):
                before = next((part for part in stretches if part[1] == gap[0]), None)
                after = next((part for part in stretches if part[0] == gap[1]), None)
                if before and after and gap[1] - gap[0] <= THICKEST_WALL_M:
                    before[1] = after[1]
                    stretches.remove(after)
                    single.remove(gap)


def without_openings(walls_m: FloatArray, openings_m: FloatArray) -> tuple[FloatArray, NDArray[np.intp]]:
    """Walls [m, 2, 2] of [n, 2, 2] but for stretches beside which a door or window runs, and their numbers [m]."""
    lines, openings = shapely.linestrings(walls_m), shapely.linestrings(openings_m)
    bands = shapely.buffer(openings, THICKEST_WALL_M / 2, cap_style="flat")
    along, across = (part[:, 1] - part[:, 0] for part in (walls_m, openings_m))
    for wall, opening in shapely.STRtree(bands).query(lines, predicate="intersects").T:
        sine = np.abs(along[wall, 0] * across[opening, 1] - along[wall, 1] * across[opening, 0])
        if sine < PARALLEL_RAD * np.linalg.norm(along[wall]) * np.linalg.norm(across[opening]) + 1e-12:
            lines[wall] = shapely.difference(lines[wall], bands[opening])
    parts, number = shapely.get_parts(lines, return_index=True)
    nonempty = ~shapely.is_empty(parts)
    return shapely.get_coordinates(parts[nonempty]).reshape(-1, 2, 2), number[nonempty]
