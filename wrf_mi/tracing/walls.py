"""Planes of a scene as mirrors and screens with outlines, in float64; they may be shifted and tilted."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import trimesh
from numpy.typing import NDArray

from ..core.angles import FloatArray
from ..core.types import IntArray
from .surfaces import Surfaces, plane_bounds

ON_LINE_M = 1e-4
"""Distance within which edges lie on one line, along which a triangulation's inner edges cancel."""
PAIRS_PER_CHUNK = 1 << 22
"""Pairs of point and edge in a chunk."""


@dataclass(frozen=True)
class Walls:
    """Planes n . x = d with outlines; q planes, e edges.

    Attributes:
        normal: unit normals [q, 3].
        offset_m: d [q].
        centre_m: centroid of each plane's faces, about which it is tilted [q, 3].
        axes: two unit vectors in each plane [q, 2, 3].
        area_m2: area of each plane's faces [q].
        low_m, high_m: bounds of the faces along ``axes`` from ``centre_m`` [q, 2].
        edge_m: ends of each edge of the outlines, coordinates along ``axes`` from ``centre_m`` [e, 2, 2]; sorted by
            plane.
        first_edge: index of each plane's first edge [q + 1].
    """

    normal: FloatArray
    offset_m: FloatArray
    centre_m: FloatArray
    axes: FloatArray
    area_m2: FloatArray
    low_m: FloatArray
    high_m: FloatArray
    edge_m: FloatArray
    first_edge: IntArray

    def __len__(self) -> int:
        """Number of planes."""
        return len(self.normal)

    def flat(self, plane: IntArray, points_m: FloatArray) -> FloatArray:
        """Coordinates [n, 2] in planes [n] of points [n, 3], metres from the planes' centres."""
        return np.einsum("nad,nd->na", self.axes[plane], points_m - self.centre_m[plane])

    def moved(self, change: FloatArray) -> Walls:
        """Shift the planes along their normals and tilt them about their centres.

        Args:
            change: shift in metres, and tilts in rad towards both axes [q, 3].
        """
        normal, offset = moved_planes(self.normal, self.axes, self.centre_m, change)
        return replace(self, normal=normal, offset_m=offset)

    def inside_m(self, plane: IntArray, flat_m: FloatArray) -> tuple[FloatArray, IntArray]:
        """Distance in metres of points [n, 2] of planes [n] from the outlines, negative outside, and the nearest edges.

        -inf and edge -1 for a plane without outline.
        """
        result, nearest = np.full(len(plane), -np.inf), np.full(len(plane), -1)
        order = np.argsort(plane, kind="stable")
        bounds = np.searchsorted(plane[order], np.arange(len(self) + 1))
        for q in np.unique(plane):
            edges = self.edge_m[self.first_edge[q] : self.first_edge[q + 1]]
            members = order[bounds[q] : bounds[q + 1]]
            step = max(1, PAIRS_PER_CHUNK // max(len(edges), 1))
            for start in range(0, len(members) if len(edges) else 0, step):
                part = members[start : start + step]
                result[part], edge = _inside(edges, flat_m[part])
                nearest[part] = self.first_edge[q] + edge
        return result, nearest


def moved_planes(
    normal: FloatArray, axes: FloatArray, centre_m: FloatArray, change: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Normals [q, 3] and offsets [q] of shifted and tilted planes, see `Walls.moved`."""
    result = normal + np.einsum("qa,qad->qd", change[:, 1:], axes)
    result /= np.linalg.norm(result, axis=1, keepdims=True)
    return result, (result * centre_m).sum(axis=1) + change[:, 0]


def plane_centres(surfaces: Surfaces) -> tuple[FloatArray, FloatArray]:
    """Centroids of the planes' faces, [q, 3] in metres, and the faces' areas [q] in square metres."""
    triangles, plane = surfaces.triangles, surfaces.plane
    count = len(surfaces.normal)
    area = trimesh.triangles.area(triangles)
    total = np.asarray(np.bincount(plane, area, minlength=count), float)
    centre = (
        np.stack([np.bincount(plane, area * c, minlength=count) for c in triangles.mean(axis=1).T], axis=1)
        / np.maximum(total, 1e-30)[:, None]
    )
    # Faces lie in their plane within a tolerance only; so does their centroid.
    centre -= surfaces.normal * ((centre * surfaces.normal).sum(axis=1) - surfaces.offset)[:, None]
    return centre, total


def walls_of(surfaces: Surfaces) -> Walls:
    """Walls of a scene's surfaces."""
    triangles, plane = surfaces.triangles, surfaces.plane
    count = len(surfaces.normal)
    centre, total = plane_centres(surfaces)
    flat = np.einsum("fad,fcd->fca", surfaces.axes[plane], triangles - centre[plane, None])
    low, high = plane_bounds(plane, flat, count)
    # Faces by their planes: a mask of all faces for each plane would take the square of their number.
    order, sizes = np.argsort(plane, kind="stable"), np.bincount(plane, minlength=count)
    parts = np.split(flat[order], np.cumsum(sizes)[:-1]) if count else []
    alone = np.flatnonzero(sizes == 1)
    sides, simple = _sides_of_one(np.array([parts[q][0] for q in alone]).reshape(-1, 3, 2))
    edges: list[FloatArray] = [np.zeros((0, 2, 2))] * count
    for q, outline in zip(alone[simple], sides[simple], strict=True):
        edges[q] = outline
    for q in np.setdiff1d(np.arange(count), alone[simple]):
        edges[q] = outline_edges(parts[q])
    first = np.cumsum([0, *(len(part) for part in edges)])
    return Walls(
        surfaces.normal,
        surfaces.offset,
        centre,
        surfaces.axes,
        total,
        low,
        high,
        np.concatenate([np.zeros((0, 2, 2)), *edges]),
        np.asarray(first, np.int64),
    )


def _sides_of_one(triangles_m: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Sides [f, 3, 2, 2] of single triangles [f, 3, 2] as `outline_edges` has them, and which have no others [f].

    Slivers, of whose sides two may lie on one line, have others. Curved furniture has 100,000 single triangles.
    """
    first, second = triangles_m[:, 1] - triangles_m[:, 0], triangles_m[:, 2] - triangles_m[:, 0]
    twice = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    start = np.where((twice < 0)[:, None, None], triangles_m[:, ::-1], triangles_m)
    along = np.roll(start, -1, axis=1) - start
    length = np.linalg.norm(along, axis=2)
    simple = np.abs(twice) > 4 * ON_LINE_M * length.max(axis=1, initial=0)  # heights above 4 ON_LINE_M
    longest = np.argsort(-length, axis=1, kind="stable")[..., None]
    start, along = (np.take_along_axis(each, longest, axis=1) for each in (start, along))
    length = np.take_along_axis(length, longest[..., 0], axis=1)[..., None]
    end = start + np.round(length / ON_LINE_M) * ON_LINE_M * np.divide(along, length, where=length > 0, out=along)
    return np.stack([start, end], axis=2), simple


def outline_edges(triangles_m: FloatArray) -> FloatArray:
    """Outline edges [e, 2, 2] of the area that triangles [f, 3, 2] cover; inner edges need not meet at corners.

    Along each line, edges of triangles on its two sides cancel; the others are outline.
    """
    first, second = triangles_m[:, 1] - triangles_m[:, 0], triangles_m[:, 2] - triangles_m[:, 0]
    twice = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    turned = np.where((twice < 0)[:, None, None], triangles_m[:, ::-1], triangles_m)[twice != 0]
    start, end = turned.reshape(-1, 2), np.roll(turned, -1, axis=1).reshape(-1, 2)
    along = end - start
    length = np.linalg.norm(along, axis=1)
    keep = length > ON_LINE_M
    start, end, along = start[keep], end[keep], along[keep] / length[keep, None]
    edges = []
    left = np.ones(len(start), bool)
    for index in np.argsort(-length[keep]):
        if not left[index]:
            continue
        t, origin = along[index], start[index]
        n = np.array([-t[1], t[0]])
        near = (np.abs((start - origin) @ n) < ON_LINE_M) & (np.abs((end - origin) @ n) < ON_LINE_M) & left
        left &= ~near
        s0, s1 = (start[near] - origin) @ t, (end[near] - origin) @ t
        stops = np.unique(np.round(np.concatenate([s0, s1]) / ON_LINE_M)) * ON_LINE_M
        middle = (stops[1:] + stops[:-1]) / 2
        covered = ((s0[:, None] < middle) & (middle < s1[:, None])).sum(axis=0)
        covered -= ((s1[:, None] < middle) & (middle < s0[:, None])).sum(axis=0)
        for a, b, net in zip(stops[:-1], stops[1:], covered, strict=True):
            if net:
                edges.append([origin + a * t, origin + b * t])
    return np.asarray(edges, float).reshape(-1, 2, 2)


def _inside(edges_m: FloatArray, points_m: FloatArray) -> tuple[FloatArray, IntArray]:
    """Distance [n] to the nearest of edges [e, 2, 2], negative outside (even-odd rule), and its index."""
    a, b = edges_m[:, 0], edges_m[:, 1]
    along = b - a
    away = points_m[:, None] - a
    share = np.clip((away * along).sum(axis=-1) / np.maximum((along * along).sum(axis=-1), 1e-30), 0, 1)
    square = np.square(away - share[..., None] * along).sum(axis=-1)
    nearest = square.argmin(axis=1)
    near = np.sqrt(square[np.arange(len(points_m)), nearest])
    y = points_m[:, 1:]
    above = (a[:, 1] > y) != (b[:, 1] > y)
    with np.errstate(divide="ignore", invalid="ignore"):
        at = a[:, 0] + (y - a[:, 1]) / along[:, 1] * along[:, 0]
    odd = (above & (points_m[:, :1] < at)).sum(axis=1) % 2 == 1
    return np.where(odd, near, -near), nearest
