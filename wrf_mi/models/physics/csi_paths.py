"""Image sources of an antenna in plane mirrors, and the paths from them that may exist.

Image method (`wrf_mi.tracing.image_method`). Each path has *margins*: its distance in metres from being cut off by an
outline, from which the probability that it exists follows.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.angles import FloatArray
from ...core.types import IntArray
from ...tracing.image_method import image_sources, meeting_point
from ...tracing.walls import Walls

CHUNK_SIZE = 1 << 19
"""Pairs of chain and position that are computed together."""
REACH_M = 0.1
"""Paths with a margin below minus this length are dropped."""
MOUNTED_M = 0.01
"""An antenna so close to a plane is mounted on it: the plane neither hides nor mirrors the antenna."""


@dataclass(frozen=True)
class Images:
    """Chains of planes [c, b] from one antenna, -1 beyond the last plane.

    ``image_m`` [c, b + 1, 3] are images after 0, 1, ... reflections, the last repeated; ``slope`` [c, b, 3, 3] is the
    derivative of the last image by the change (`Walls.moved`) of each plane: level, component, coordinate.
    """

    plane: IntArray
    image_m: FloatArray
    slope: FloatArray

    def __len__(self) -> int:
        """Number of chains."""
        return len(self.plane)


def images_of(walls: Walls, source_m: FloatArray, plane: IntArray) -> Images:
    """Mirror a source [3], or one of each chain [c, 3], at the planes of each chain [c, b] in turn."""
    count, depth = plane.shape
    image = image_sources(walls.normal, walls.offset_m, plane, source_m)
    slope = np.zeros((count, depth, 3, 3))
    for level in range(depth):
        row = np.flatnonzero(plane[:, level] >= 0)
        q, here = plane[row, level], image[row, level]
        n, axes = walls.normal[q], walls.axes[q]
        before = slope[row, :level]
        slope[row, :level] = before - 2 * np.einsum("clkd,cd->clk", before, n)[..., None] * n[:, None, None]
        height = (here * n).sum(axis=1) - walls.offset_m[q]
        tilt = np.einsum("cad,cd->ca", axes, here - walls.centre_m[q])[..., None] * n[:, None]
        slope[row, level] = np.concatenate([2 * n[:, None], -2 * (tilt + height[:, None, None] * axes)], axis=1)
    return Images(plane, image, slope)


@dataclass(frozen=True)
class CandidatePaths:
    """Paths that may exist, sorted by position; p paths of at most b reflections.

    Attributes:
        row: position of each path [p].
        chain: chain of each path [p].
        length_m: unfolded [p].
        point_m: points from the antenna to the position: antenna, reflections, position [p, b + 2, 3]; the position
            repeated after the last.
        inside_m: least distance of its reflections from the mirrors' outlines, positive inside [p]; inf without any.
        clear_m: least distance of its legs from a screen that would hide it [p]; negative where one hides it: the
            shift of the leg, in the screen's plane or through it, that would clear it.
        inside_edge: edge of an outline that decides ``inside_m`` [p], -1 without any.
        clear_edge: edge that decides ``clear_m`` [p], -1 where none is near or the screen's depth decides.
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

    def select(self, which: NDArray[Any]) -> CandidatePaths:
        """The paths of a mask or of ascending indices."""
        return CandidatePaths(*(getattr(self, field.name)[which] for field in fields(self)))


def candidate_paths(walls: Walls, images: Images, positions_m: FloatArray) -> CandidatePaths:
    """Paths from each position [n, 3] in metres to the antenna with margins above -`REACH_M`."""
    step = max(1, CHUNK_SIZE // max(len(images), 1))
    starts = range(0, max(len(positions_m), 1), step)
    parts = [_reflected(walls, images, positions_m, slice(start, start + step)) for start in starts]
    joined = [np.concatenate(column) for column in zip(*parts, strict=True)]
    order = np.lexsort((joined[1], joined[0]))
    row, chain, point, inside, edge = (column[order] for column in joined)
    length = np.linalg.norm(positions_m[row] - images.image_m[chain, -1], axis=1)
    clear, clear_edge = _clear(walls, images.plane[chain], point)
    paths = CandidatePaths(row, chain, length, point, inside, clear, edge, clear_edge)
    return paths.select(clear > -REACH_M)


def _near(walls: Walls, plane: IntArray, flat_m: FloatArray) -> NDArray[np.bool_]:
    """Points [n, 2] of planes [n] whose distance from the bounds is below `REACH_M`."""
    inside = (flat_m > walls.low_m[plane] - REACH_M) & (flat_m < walls.high_m[plane] + REACH_M)
    return np.asarray(inside.all(axis=1))


def _reflected(
    walls: Walls, images: Images, positions_m: FloatArray, chunk: slice
) -> tuple[IntArray, IntArray, FloatArray, FloatArray, IntArray]:
    """Pairs of position and chain that meet their mirrors: row, chain, points, distance inside, nearest edge."""
    depth = images.plane.shape[1]
    bounces = np.count_nonzero(images.plane >= 0, axis=1)
    rows, kept = np.arange(len(positions_m))[chunk], []
    for count in range(depth + 1):
        members = np.flatnonzero(bounces == count)
        row, chain = np.repeat(rows, len(members)), np.tile(members, len(rows))
        points = [positions_m[row]]
        inside, edge = np.full(len(row), np.inf), np.full(len(row), -1)
        for level in reversed(range(count)):
            q = images.plane[chain, level]
            image = images.image_m[chain, level + 1]
            point, here, there = meeting_point(points[-1], image, walls.normal[q], walls.offset_m[q])
            flat = walls.flat(q, point)
            through = np.flatnonzero((here * there < 0) & _near(walls, q, flat))
            within, nearest = walls.inside_m(q[through], flat[through])
            chosen = within > -REACH_M
            through, within, nearest = through[chosen], within[chosen], nearest[chosen]
            edge = np.where(within < inside[through], nearest, edge[through])
            inside = np.minimum(inside[through], within)
            row, chain, points = row[through], chain[through], [part[through] for part in (*points, point)]
        way = [images.image_m[chain, 0], *reversed(points), *([positions_m[row]] * (depth - count))]
        kept.append((row, chain, np.stack(way, axis=1), inside, edge))
    row, chain, point, inside, edge = (np.concatenate(column) for column in zip(*kept, strict=True))
    return row, chain, point, inside, edge


def _clear(walls: Walls, plane: IntArray, point_m: FloatArray) -> tuple[FloatArray, IntArray]:
    """``clear_m`` and ``clear_edge`` of `CandidatePaths`."""
    clear, edge = np.full(len(plane), REACH_M), np.full(len(plane), -1)
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
            mirrored = np.flatnonzero(plane[:, level] >= 0)
            cross[mirrored, plane[mirrored, level]] = False
        path, q = np.nonzero(cross)
        legs = point_m[path, leg], point_m[path, leg + 1]
        point, here, there = meeting_point(*legs, walls.normal[q], walls.offset_m[q])
        flat = walls.flat(q, point)
        near = _near(walls, q, flat)
        path, q, flat = path[near], q[near], flat[near]
        within, nearest = walls.inside_m(q, flat)
        through = np.minimum(np.abs(here), np.abs(there))[near]
        nearest = np.where(within < through, nearest, -1)
        hidden = np.minimum(within, through)
        order = np.argsort(hidden, kind="stable")  # the last written is the most hidden
        best, which = np.full(len(plane), -np.inf), np.full(len(plane), -1)
        best[path[order]], which[path[order]] = hidden[order], nearest[order]
        nearer = -best < clear
        clear, edge = np.where(nearer, -best, clear), np.where(nearer, which, edge)
    return clear, edge
