"""From runs of occupied cells to walls: what the space seen empty, and what hides, tell of them.

Each rule asks the grid. A run is seen from a room. Collinear runs with nothing seen empty between them are one wall. A
run that stands close before a longer one, with nothing seen empty between the two, is the front of furniture along the
wall. A wall that ends where something stands before it goes straight on behind it until it meets another wall. Where no
cell is known to be free (points without scans) only narrow holes are closed and nothing is called furniture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import ndimage

from .plan_lines import HALF_WIDTH_M, Run
from .plan_sources import Mask, PlanGrid

SAME_WALL_M = 0.25
"""Parallel runs this near with nothing free between are one wall: the blur of a map, or a partition's two faces."""
SAME_LINE_M = 0.15
"""Runs are collinear when their offsets differ by less."""
NARROW_GAP_M = 0.5
"""A gap that is closed where nothing is known of free space: narrower than any door (0.6 m)."""
HIDDEN_GAP_M = 3.0
"""The longest stretch of wall that is taken to be there though something hides it."""
FURNITURE_DEPTH_M = 0.7
"""Depth of wardrobes, kitchens and sofas along a wall (0.6 m and a little)."""
BESIDE_M = 0.4
"""Free space begins this near to a wall that was seen, the blur of the map between."""
SEEN_SHARE = 0.3
"""Least share of a run beside a room; others were seen through windows and mirrors."""
MOST_ROUNDS = 4
"""A wall that is carried on uncovers furniture before it, and without that another wall goes on."""
HIDING_SHARE = 0.7
"""Least share of a hidden stretch before which something stands."""
FREE_SHARE = 0.1
"""Share of a stretch's length where free cells lie that noise may make."""


@dataclass(frozen=True)
class _Strips:
    """Looks into bands of a turned grid that run along an axis."""

    grid: PlanGrid

    @cached_property
    def hiding(self) -> Mask:
        """Cells that furniture may hide, going by how far the next occupied cell is."""
        away = ndimage.distance_transform_edt(~self.grid.occupied) * self.grid.resolution_m
        return np.asarray(away <= np.sqrt(2) * FURNITURE_DEPTH_M)

    def _band(self, mask: Mask, axis: int, across: tuple[float, float], along: tuple[float, float]) -> Mask:
        """Cells of a band, shape [across, along]; the part inside the grid."""
        step, origin = self.grid.resolution_m, self.grid.origin_m
        image = mask if axis == 0 else mask.T
        low, high = ((v - origin[1 - axis]) / step for v in sorted(across))
        begin, end = ((v - origin[axis]) / step for v in along)
        rows = slice(max(0, int(np.floor(low))), max(0, int(np.ceil(high))))
        return image[rows, max(0, round(begin)) : max(0, round(end))]

    def share(self, mask: Mask, axis: int, across: tuple[float, float], along: tuple[float, float]) -> float:
        """Share of a band's length where the mask is set somewhere across it; 0 for a band without cells."""
        band = self._band(mask, axis, across, along)
        return float(band.any(axis=0).mean()) if band.size else 0.0

    def free_between(self, a: Run, b: Run, along: tuple[float, float]) -> float:
        """Share of a stretch where something free lies between two parallel runs, their own smear left out."""
        low, high = sorted((a.offset, b.offset))
        margin = min(HALF_WIDTH_M, (high - low) / 2)
        return self.share(self.grid.free, a.axis, (low + margin, high - margin), along)

    def free_on(self, axis: int, offset: float, along: tuple[float, float]) -> float:
        """Share of a stretch of a line that is free."""
        step = self.grid.resolution_m
        return self.share(self.grid.free, axis, (offset - step / 2, offset + step / 2), along)

    def beside_room(self, run: Run) -> float:
        """Share of a run that free space begins at."""
        across = (run.offset - BESIDE_M, run.offset + BESIDE_M)
        return self.share(self.grid.free, run.axis, across, (run.start, run.end))

    def hidden(self, axis: int, offset: float, along: tuple[float, float]) -> float:
        """Share of a stretch of a line with something near that can hide it; in a corner it is a diagonal away."""
        step = self.grid.resolution_m
        return self.share(self.hiding, axis, (offset - step / 2, offset + step / 2), along)


def tidy(runs: Sequence[Run], grid: PlanGrid) -> list[Run]:
    """Walls from runs of the same turned grid.

    Args:
        runs: from `wrf_mi.scene.plan_lines.find_runs`.
        grid: where they were found.
    """
    strips = _Strips(grid)
    knows_free = bool(grid.free.any())
    if knows_free:
        runs = [run for run in runs if strips.beside_room(run) >= SEEN_SHARE]
    walls = _bridged(_merged(runs, strips), strips, knows_free)
    if knows_free:
        walls = _without_fronts(walls, strips)
        for _ in range(MOST_ROUNDS):
            before, walls = walls, _without_fronts(_carried_on(walls, strips), strips)
            if walls == before:
                break
    return walls


def _merged(runs: Sequence[Run], strips: _Strips) -> list[Run]:
    """Parallel runs of the same smear as one, at the offset of the longest."""
    walls: list[Run] = []
    for run in sorted(runs, key=lambda r: -r.length):
        for i, wall in enumerate(walls):
            apart = abs(wall.offset - run.offset)
            begin, end = max(wall.start, run.start), min(wall.end, run.end)
            if wall.axis != run.axis or apart > SAME_WALL_M or end - begin < run.length / 2:
                continue
            if strips.free_between(wall, run, (begin, end)) > FREE_SHARE:
                continue
            walls[i] = replace(wall, start=min(wall.start, run.start), end=max(wall.end, run.end))
            break
        else:
            walls.append(run)
    return walls


def _bridged(runs: Sequence[Run], strips: _Strips, knows_free: bool) -> list[Run]:
    """Collinear runs as one where the gap between them is no opening."""
    walls = sorted(runs, key=lambda r: -r.length)
    i = 0
    while i < len(walls):
        partner = next((b for b in walls[i + 1 :] if _one_wall(walls[i], b, strips, knows_free)), None)
        if partner is None:
            i += 1
            continue
        a = walls[i]
        offset = (a.offset * a.length + partner.offset * partner.length) / (a.length + partner.length)
        walls[i] = Run(a.axis, offset, min(a.start, partner.start), max(a.end, partner.end))
        walls.remove(partner)
        i = 0
    return walls


def _one_wall(a: Run, b: Run, strips: _Strips, knows_free: bool) -> bool:
    if a.axis != b.axis or abs(a.offset - b.offset) > SAME_LINE_M:
        return False
    begin, end = min(a.end, b.end), max(a.start, b.start)
    gap = end - begin
    if gap <= 0:
        return True
    if not knows_free:
        return gap <= NARROW_GAP_M
    free = strips.free_on(a.axis, (a.offset + b.offset) / 2, (begin, end))
    return gap <= min(HIDDEN_GAP_M, a.length + b.length) and free <= FREE_SHARE


def _without_fronts(runs: Sequence[Run], strips: _Strips) -> list[Run]:
    """Without the runs that stand before a longer parallel one, nothing free between them."""
    kept = sorted(runs, key=lambda r: r.length)
    for run in tuple(kept):
        covered = np.zeros(max(1, round(run.length / strips.grid.resolution_m)), bool)
        for wall in kept:
            near = 0 < abs(wall.offset - run.offset) <= FURNITURE_DEPTH_M
            along = max(wall.start, run.start), min(wall.end, run.end)
            if wall.axis != run.axis or wall.length <= run.length or not near or along[0] >= along[1]:
                continue
            if strips.free_between(run, wall, along) <= FREE_SHARE:
                first, last = ((v - run.start) / run.length * len(covered) for v in along)
                covered[round(first) : round(last)] = True
        if covered.mean() >= HIDING_SHARE:
            kept.remove(run)
    return kept


def _carried_on(runs: Sequence[Run], strips: _Strips) -> list[Run]:
    """Ends carried on behind what hides them, to the nearest wall across."""
    walls = []
    for run in runs:
        ends = [run.start, run.end]
        for side, sign in enumerate((-1, 1)):
            here = ends[side]
            if any(_meets(run, here, b) for b in runs):
                continue
            reachable = [
                b.offset
                for b in runs
                if b.axis != run.axis
                and 0 < sign * (b.offset - here) <= HIDDEN_GAP_M
                and b.start - FURNITURE_DEPTH_M <= run.offset <= b.end + FURNITURE_DEPTH_M
            ]
            if not reachable:
                continue
            there = min(reachable, key=lambda v: abs(v - here))
            along = (min(here, there), max(here, there))
            if strips.free_on(run.axis, run.offset, along) > FREE_SHARE:
                continue
            if strips.hidden(run.axis, run.offset, along) >= HIDING_SHARE:
                ends[side] = there
        walls.append(replace(run, start=ends[0], end=ends[1]))
    return walls


def _meets(run: Run, here: float, other: Run) -> bool:
    """Whether another wall across passes at a run's end."""
    across = other.axis != run.axis and abs(other.offset - here) <= SAME_WALL_M
    return across and other.start - SAME_WALL_M <= run.offset <= other.end + SAME_WALL_M
