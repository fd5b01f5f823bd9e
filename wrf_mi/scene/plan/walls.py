"""Walls of a plan: runs of every direction that the plan shows, merged and extended, corners joined, clutter left out.

Rules for the runs, each checked in the grid: a run is seen from a room; collinear runs with nothing seen empty between
them are a single wall; a run close before a longer run, with nothing seen empty between the two, is the front of
furniture along the wall; a wall that ends where something stands before it continues behind it up to the next wall
across. Where no cell is known to be free (points without scans) only narrow gaps are closed and nothing is called
furniture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import shapely
from scipy import ndimage
from scipy.sparse.csgraph import connected_components

from ...core import InputError
from ...core.angles import FloatArray
from .grid import Mask, PlanGrid
from .lines import CLEARED_M, HALF_WIDTH_M, WallRun, dominant_direction, find_runs, rotation_2d, turned, without_specks

REACH_M = 0.35  # largest way of an end to meet another wall: the blur of a map cuts corners, a door (0.6 m) stays open
SHORTEST_LOOSE_M = 0.8  # a shorter piece has to meet other walls at both ends: legs of tables and chairs do not
SHORTEST_GROUP_M = 2.0  # total length of walls that touch; shorter groups apart from all others are things in the room
MOST_DIRECTIONS = 4
SHORTEST_OBLIQUE_M = 1.0  # least length of runs in the secondary directions: smears leave short pieces
TOUCHING_M = 0.05
LEAST_ANGLE_RAD = np.radians(20)  # least angle of a corner
SAME_WALL_M = 0.25  # largest distance of parallel runs of the same wall: the blur of a map, or a partition's two faces
SAME_LINE_M = 0.15  # largest difference in offset of collinear runs
NARROW_GAP_M = 0.5  # largest gap that is closed where free space is unknown: narrower than any door (0.6 m)
HIDDEN_GAP_M = 3.0  # longest hidden stretch of a wall
FURNITURE_DEPTH_M = 0.7  # depth of wardrobes, kitchens and sofas along a wall, 0.6 m and a margin
BESIDE_M = 0.4  # largest distance of free space from a wall that was seen; between them lies the blur of the map
SEEN_SHARE = 0.3  # least share of a run beside free space; other runs were seen through windows and mirrors
MOST_ROUNDS = 4  # extending a wall uncovers furniture before it, and removing that lets another wall be extended
HIDING_SHARE = 0.7  # least covered share of a hidden stretch or a furniture front
FREE_SHARE = 0.1  # largest share of a stretch with free cells that is attributed to noise


def find_walls(grid: PlanGrid) -> FloatArray:
    """Straight walls of a plan [n, 2, 2], metres, the longest wall first; `InputError`: it shows none.

    Walls along and across the main direction are taken first; the remaining cells may show further directions.
    """
    grid = without_specks(grid)
    unexplained, walls = grid, list[FloatArray]()
    for pass_ in range(MOST_DIRECTIONS):
        if not unexplained.occupied.any():
            break
        angle = dominant_direction(unexplained.occupied)
        view = turned(unexplained, angle)
        runs = find_runs(view) if pass_ == 0 else find_runs(view, SHORTEST_OBLIQUE_M)
        if not runs:
            break
        # Things that hide a wall may already have been explained by another direction: the rules use the whole grid.
        tidy = _tidy(runs, turned(grid, angle))
        pieces = [run.ends_m @ rotation_2d(angle).T for run in (*runs, *tidy)]
        walls += pieces[len(runs) :]
        # The occupied cells that lie at these walls are explained.
        cells = shapely.points(unexplained.centres_m(unexplained.occupied))
        reach = [CLEARED_M + run.thick_m for run in (*runs, *tidy)]
        lines = shapely.linestrings(np.array(pieces))
        near = shapely.STRtree(cells).query(lines, predicate="dwithin", distance=reach)[1]
        occupied = unexplained.occupied.copy()
        row, column = np.nonzero(occupied)
        occupied[row[near], column[near]] = False
        unexplained = without_specks(replace(unexplained, occupied=occupied))
    if not walls:
        raise InputError("no straight wall was found; is the resolution right, and is it a plan of walls?")
    walls_m = _without_clutter(joined(np.array(walls)))
    return walls_m[np.argsort(-np.linalg.norm(walls_m[:, 1] - walls_m[:, 0], axis=-1), kind="stable")]


def joined(walls_m: FloatArray) -> FloatArray:
    """Walls [m, 2, 2] of [n, 2, 2] as `met` moves their ends, without those of which nothing is left."""
    result = met(walls_m)
    return result[np.linalg.norm(result[:, 1] - result[:, 0], axis=-1) > TOUCHING_M]


def met(walls_m: FloatArray) -> FloatArray:
    """Walls [n, 2, 2] whose ends are moved, along the wall, to where it meets another wall within `REACH_M`."""
    result = walls_m.copy()
    along = walls_m[:, 1] - walls_m[:, 0]
    length = np.linalg.norm(along, axis=-1)
    unit = along / length[:, None]
    for i in range(len(walls_m)):
        sine = _cross(unit[i], unit)
        corner = np.abs(sine) > np.sin(LEAST_ANGLE_RAD)
        safe = np.where(corner, sine, 1.0)
        # Where line i meets line j: distance from the start of i along i, and from the start of j along j.
        between = walls_m[:, 0] - walls_m[i, 0]
        meeting = _cross(between, unit) / safe
        other = _cross(between, unit[i]) / safe
        beyond = np.maximum(np.maximum(-other, other - length), 0)
        for end, at in enumerate((0.0, length[i])):
            way = np.where(corner & (beyond <= REACH_M), np.abs(meeting - at), np.inf)
            nearest = int(np.argmin(way))
            if way[nearest] <= REACH_M:
                result[i, end] = walls_m[i, 0] + meeting[nearest] * unit[i]
    return result


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def _without_clutter(walls_m: FloatArray) -> FloatArray:
    """Without short loose pieces and small groups; the largest group stays whatever its size."""
    while True:
        lines = shapely.linestrings(walls_m)
        length = shapely.length(lines)
        ends = shapely.points(walls_m)
        touching = shapely.distance(ends[:, :, None], lines[None, None, :]) <= TOUCHING_M
        touching[np.arange(len(lines)), :, np.arange(len(lines))] = False
        loose = ~touching.any(axis=2).all(axis=1) & (length < SHORTEST_LOOSE_M)
        if not loose.any() or loose.all():
            break
        walls_m = walls_m[~loose]
    _, group = connected_components(touching.any(axis=1), directed=False)
    total = np.bincount(group, length)
    return np.asarray(walls_m[total[group] >= min(SHORTEST_GROUP_M, total.max())])


@dataclass(frozen=True)
class _Strips:
    """Bands of a turned grid that run along an axis."""

    grid: PlanGrid

    @cached_property
    def knows_free(self) -> bool:
        """Whether cells are known to be free: points without scans do not show it."""
        return bool(self.grid.free.any())

    @cached_property
    def hiding(self) -> Mask:
        """Cells near enough to an occupied cell for furniture to hide them; in a corner it is a diagonal away."""
        away = ndimage.distance_transform_edt(~self.grid.occupied) * self.grid.resolution_m
        return np.asarray(away <= np.sqrt(2) * FURNITURE_DEPTH_M)

    def share(self, mask: Mask, axis: int, across: tuple[float, float], along: tuple[float, float]) -> float:
        """Share of a band's length where the mask is set somewhere across it; 0 for a band outside the grid."""
        step, origin = self.grid.resolution_m, self.grid.origin_m
        image = mask if axis == 0 else mask.T
        low, high = ((v - origin[1 - axis]) / step for v in sorted(across))
        begin, end = ((v - origin[axis]) / step for v in along)
        rows = slice(max(0, int(np.floor(low))), max(0, int(np.ceil(high))))
        band = image[rows, max(0, round(begin)) : max(0, round(end))]
        return float(band.any(axis=0).mean()) if band.size else 0.0

    def free_beside(self, run: WallRun) -> float:
        """Share of a run with free cells at its sides."""
        sides = run.offset - BESIDE_M, run.offset + BESIDE_M
        return self.share(self.grid.free, run.axis, sides, (run.start, run.end))

    def free_between(self, a: WallRun, b: WallRun, along: tuple[float, float]) -> float:
        """Share of a stretch where free cells lie between two parallel runs, without their smears."""
        low, high = sorted((a.offset, b.offset))
        margin = min(HALF_WIDTH_M, (high - low) / 2)
        return self.share(self.grid.free, a.axis, (low + margin, high - margin), along)

    def on_line(self, mask: Mask, axis: int, offset: float, along: tuple[float, float]) -> float:
        """Share of a stretch of a line where the mask is set."""
        half = self.grid.resolution_m / 2
        return self.share(mask, axis, (offset - half, offset + half), along)


def _tidy(runs: Sequence[WallRun], grid: PlanGrid) -> list[WallRun]:
    """Walls from runs of the same turned grid."""
    strips = _Strips(grid)
    if not strips.knows_free:
        return _bridged(_merged(runs, strips), strips)
    runs = [run for run in runs if strips.free_beside(run) >= SEEN_SHARE]
    walls = _without_fronts(_bridged(_merged(runs, strips), strips), strips)
    for _ in range(MOST_ROUNDS):
        before, walls = walls, _without_fronts(_extended(walls, strips), strips)
        if walls == before:
            break
    return walls


def _merged(runs: Sequence[WallRun], strips: _Strips) -> list[WallRun]:
    """Parallel runs of the same smear merged, at the offset of the longest."""
    walls: list[WallRun] = []
    # The longest first: its offset has the least error, and shorter runs of its smear take it.
    for run in sorted(runs, key=lambda r: -r.length):
        for i, wall in enumerate(walls):
            apart = abs(wall.offset - run.offset)
            begin, end = max(wall.start, run.start), min(wall.end, run.end)
            if wall.axis != run.axis or apart > SAME_WALL_M or end - begin < run.length / 2:
                continue
            # Two faces of a partition have no free cells between them; two sides of a corridor do.
            if strips.free_between(wall, run, (begin, end)) > FREE_SHARE:
                continue
            walls[i] = replace(wall, start=min(wall.start, run.start), end=max(wall.end, run.end))
            break
        else:
            walls.append(run)
    return walls


def _bridged(runs: Sequence[WallRun], strips: _Strips) -> list[WallRun]:
    """Collinear runs merged where the gap between them is no opening."""
    walls = sorted(runs, key=lambda r: -r.length)
    i = 0
    while i < len(walls):
        partner = next((b for b in walls[i + 1 :] if _same_wall(walls[i], b, strips)), None)
        if partner is None:
            i += 1
            continue
        a = walls[i]
        # Errors of an offset fall with the number of its cells.
        offset = (a.offset * a.length + partner.offset * partner.length) / (a.length + partner.length)
        walls[i] = WallRun(a.axis, offset, min(a.start, partner.start), max(a.end, partner.end))
        walls.remove(partner)
        i = 0  # the longer wall may bridge gaps that its pieces did not
    return walls


def _same_wall(a: WallRun, b: WallRun, strips: _Strips) -> bool:
    if a.axis != b.axis or abs(a.offset - b.offset) > SAME_LINE_M:
        return False
    begin, end = min(a.end, b.end), max(a.start, b.start)
    gap = end - begin
    if gap <= 0:
        return True
    if not strips.knows_free:
        return gap <= NARROW_GAP_M
    free = strips.on_line(strips.grid.free, a.axis, (a.offset + b.offset) / 2, (begin, end))
    return gap <= min(HIDDEN_GAP_M, a.length + b.length) and free <= FREE_SHARE


def _without_fronts(runs: Sequence[WallRun], strips: _Strips) -> list[WallRun]:
    """Runs without those that stand before a longer parallel run with nothing free between them."""
    walls = sorted(runs, key=lambda run: run.length)
    for run in tuple(walls):
        # Share of the run, cell by cell, behind which some longer wall stands: several may share the back.
        covered = np.zeros(max(1, round(run.length / strips.grid.resolution_m)), bool)
        for wall in walls:
            near = 0 < abs(wall.offset - run.offset) <= FURNITURE_DEPTH_M
            along = max(wall.start, run.start), min(wall.end, run.end)
            if wall.axis != run.axis or wall.length <= run.length or not near or along[0] >= along[1]:
                continue
            if strips.free_between(run, wall, along) <= FREE_SHARE:
                first, last = ((v - run.start) / run.length * len(covered) for v in along)
                covered[round(first) : round(last)] = True
        if covered.mean() >= HIDING_SHARE:
            walls.remove(run)
    return walls


def _extended(runs: Sequence[WallRun], strips: _Strips) -> list[WallRun]:
    """Runs extended behind the things that hide their ends, to the nearest wall across."""
    walls = []
    for run in runs:
        ends = {-1: run.start, 1: run.end}
        across = [other for other in runs if other.axis != run.axis]
        for sign, end in tuple(ends.items()):
            target = _hidden_corner(run, sign, end, across)
            if target is None:
                continue
            along = min(end, target), max(end, target)
            free, hidden = (strips.on_line(m, run.axis, run.offset, along) for m in (strips.grid.free, strips.hiding))
            if free <= FREE_SHARE and hidden >= HIDING_SHARE:
                ends[sign] = target
        walls.append(replace(run, start=ends[-1], end=ends[1]))
    return walls


def _hidden_corner(run: WallRun, sign: int, end: float, across: Sequence[WallRun]) -> float | None:
    """Where a run would meet the nearest wall across beyond an end; None: it meets one there, or there is none."""
    for wall in across:
        spans = wall.start - SAME_WALL_M <= run.offset <= wall.end + SAME_WALL_M
        if spans and abs(wall.offset - end) <= SAME_WALL_M:
            return None
    reachable = [
        wall.offset
        for wall in across
        if 0 < sign * (wall.offset - end) <= HIDDEN_GAP_M
        and wall.start - FURNITURE_DEPTH_M <= run.offset <= wall.end + FURNITURE_DEPTH_M
    ]
    return min(reachable, key=lambda offset: abs(offset - end), default=None)
