"""Image sources of an antenna in plane mirrors, and how clearly each is seen from where.

Image method (`wrf_mi.tracing.image_method`). Beside the length of each path come its *margins*: how far, in metres, it
is from being cut off by an outline, by which a hard decision turns into a probability.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.angles import FloatArray
from ...core.types import IntArray
from ...tracing.image_method import image_sources, meeting_point
from ...tracing.walls import Walls

CHUNK_SIZE = 1 << 19
"""Pairs of chain and position that are worked on at once."""
REACH_M = 0.1
"""A path that misses an outline by more than that, or is hidden by more, is none."""
MOUNTED_M = 0.01
"""An antenna so close to a plane is mounted on it: it does not hide the antenna, and mirrors nothing of it."""


@dataclass(frozen=True)
class Images:
    """Chains of planes from one antenna; c chains of at most b reflections.

    Attributes:
        plane: planes in their order from the antenna [c, b], -1 beyond the last.
        image_m: of the antenna after 0, 1, ... reflections [c, b + 1, 3]; the last one repeated.
        slope: derivative of the last image by the change (`Walls.moved`) of each of its planes [c, b, 3, 3]:
            level, component of the change, coordinate.
    """

    plane: IntArray
    image_m: FloatArray
    slope: FloatArray

    def __len__(self) -> int:
        """Number of chains."""
        return len(self.plane)

    @property
    def bounces(self) -> IntArray:
        """Reflections of each chain."""
        return np.count_nonzero(self.plane >= 0, axis=1)


def images_of(walls: Walls, source_m: FloatArray, plane: IntArray) -> Images:
    """Mirror a source [3], or one of each chain [c, 3], at the planes of each chain [c, b] in turn."""
    count, depth = plane.shape
    image = image_sources(walls.normal, walls.offset_m, plane, source_m)
    slope = np.zeros((count, depth, 3, 3))
    for level in range(depth):
        used = plane[:, level] >= 0
        q = np.where(used, plane[:, level], 0)
        if not len(walls):
            break
        n, centre, axes = walls.normal[q], walls.centre_m[q], walls.axes[q]
        here = image[:, level]
        height = (here * n).sum(axis=1) - walls.offset_m[q]
        before = slope[:, :level] - 2 * np.einsum("clkd,cd->clk", slope[:, :level], n)[..., None] * n[:, None, None]
        slope[:, :level] = np.where(used[:, None, None, None], before, slope[:, :level])
        tilt = np.einsum("cad,cd->ca", axes, here - centre)[..., None] * n[:, None] + height[:, None, None] * axes
        own = np.concatenate([2 * n[:, None], -2 * tilt], axis=1)
        slope[:, level] = np.where(used[:, None, None], own, 0)
    return Images(plane, image, slope)


@dataclass(frozen=True)
class Seen:
    """Paths that may be there, sorted by position; p paths of at most b reflections.

    Attributes:
        row: position of each [p].
        chain: of each [p].
        length_m: unfolded [p].
        point_m: points from the antenna to the position: antenna, reflections, position [p, b + 2, 3]; the position
            repeated after the last.
        inside_m: how far its reflections lie inside the mirrors' outlines, the least of them [p]; inf without any.
        clear_m: how far its legs are from the nearest screen, the least [p]: negative where one hides it, and then how
            far the leg would have to move, in the screen's plane or through it.
        inside_edge: edge of an outline that decides ``inside_m`` [p], -1 without any.
        clear_edge: the same of ``clear_m``, -1 where none is near or the screen's depth decides.
    """

    row: IntArray
    chain: IntArray
    length_m: FloatArray
    point_m: FloatArray
    inside_m: FloatArray
    clear_m: FloatArray
    inside_edge: IntArray
    clear_edge: IntArray

    def __len__(self) -> int:
        """Number of paths."""
        return len(self.row)

    def select(self, which: NDArray[Any]) -> Seen:
        """The paths of a mask or of ascending indices."""
        return Seen(*(getattr(self, field.name)[which] for field in fields(self)))


def seen_from(walls: Walls, images: Images, positions_m: FloatArray, reach_m: float = REACH_M) -> Seen:
    """Paths from each position [n, 3] to the antenna that are there or nearly.

    Args:
        walls: the planes.
        images: the antenna's.
        positions_m: of the other end.
        reach_m: paths that miss an outline, or are hidden, by less are kept, with negative margins.
    """
    parts = [_part(walls, images, positions_m, rows, reach_m) for rows in _rows(len(images), len(positions_m))]
    joined = [np.concatenate(column) for column in zip(*parts, strict=True)]
    order = np.lexsort((joined[1], joined[0]))
    row, chain, point, inside, edge = (column[order] for column in joined)
    length = np.linalg.norm(positions_m[row] - images.image_m[chain, -1], axis=1)
    clear, clear_edge = _clear(walls, images.plane[chain], point, reach_m)
    seen = Seen(row, chain, length, point, inside, clear, edge, clear_edge)
    return seen.select(clear > -reach_m)


def _rows(chains: int, count: int) -> Iterator[IntArray]:
    step = max(1, CHUNK_SIZE // max(chains, 1))
    for start in range(0, max(count, 1), step):
        yield np.arange(start, min(start + step, count))


def _part(
    walls: Walls, images: Images, positions_m: FloatArray, rows: IntArray, reach_m: float
) -> tuple[IntArray, IntArray, FloatArray, FloatArray, IntArray]:
    """Pairs of position and chain whose mirrors are met, with their points."""
    depth = images.plane.shape[1]
    bounces = images.bounces
    kept = []
    for count in range(depth + 1):
        members = np.flatnonzero(bounces == count)
        pair = np.broadcast_to(np.arange(len(members)), (len(rows), len(members)))
        row, chain = np.repeat(rows, len(members)), members[pair.reshape(-1)]
        place = positions_m[row]
        points = [place]
        inside, edge = np.full(len(row), np.inf), np.full(len(row), -1)
        for level in reversed(range(count)):
            q = images.plane[chain, level]
            image = images.image_m[chain, level + 1]
            place, here, there = meeting_point(place, image, walls.normal[q], walls.offset_m[q])
            flat = walls.flat(q, place)
            through = here * there < 0
            through &= ((flat > walls.low_m[q] - reach_m) & (flat < walls.high_m[q] + reach_m)).all(axis=1)
            row, chain, place, flat, q = row[through], chain[through], place[through], flat[through], q[through]
            within, nearest = walls.inside_m(q, flat)
            inside, edge = inside[through], np.where(within < inside[through], nearest, edge[through])
            inside = np.minimum(inside, within)
            points = [*(part[through] for part in points), place]
            near = within > -reach_m
            row, chain, place, inside, edge = row[near], chain[near], place[near], inside[near], edge[near]
            points = [part[near] for part in points]
        way = [images.image_m[chain, 0], *reversed(points), *([positions_m[row]] * (depth - count))]
        kept.append((row, chain, np.stack(way, axis=1), inside, edge))
    row, chain, point, inside, edge = (np.concatenate(column) for column in zip(*kept, strict=True))
    return row, chain, point, inside, edge


def _clear(walls: Walls, plane: IntArray, point_m: FloatArray, reach_m: float) -> tuple[FloatArray, IntArray]:
    """How far each path is from being hidden, and by which edge: see `Seen`."""
    clear, edge = np.full(len(plane), reach_m), np.full(len(plane), -1)
    depth = plane.shape[1]
    side = np.einsum("pkd,qd->pkq", point_m, walls.normal) - walls.offset_m
    mounted = np.abs(side[:, 0]) < MOUNTED_M
    for leg in range(depth + 1):
        before, after = side[:, leg], side[:, leg + 1]
        cross = before * after < 0
        if leg == 0:
            cross &= ~mounted
        # A mirror does not hide its own reflection.
        for level in {leg - 1, leg} & set(range(depth)):
            own = np.flatnonzero(plane[:, level] >= 0)
            cross[own, plane[own, level]] = False
        path, q = np.nonzero(cross)
        ends = point_m[path, leg], point_m[path, leg + 1]
        place, here, there = meeting_point(*ends, walls.normal[q], walls.offset_m[q])
        flat = walls.flat(q, place)
        near = ((flat > walls.low_m[q] - reach_m) & (flat < walls.high_m[q] + reach_m)).all(axis=1)
        path, q, flat = path[near], q[near], flat[near]
        within, nearest = walls.inside_m(q, flat)
        through = np.minimum(np.abs(here), np.abs(there))[near]
        nearest = np.where(within < through, nearest, -1)
        hidden = np.minimum(within, through)
        order = np.argsort(hidden, kind="stable")  # the last one written is the most hidden
        best, which = np.full(len(plane), -np.inf), np.full(len(plane), -1)
        best[path[order]], which[path[order]] = hidden[order], nearest[order]
        nearer = -best < clear
        clear, edge = np.where(nearer, -best, clear), np.where(nearer, which, edge)
    return clear, edge
