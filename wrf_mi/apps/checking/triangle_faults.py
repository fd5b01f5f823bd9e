"""Faults of triangles: without area, doubled, wound both ways, open solids, and parallel sheets almost in one plane."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import shapely
import trimesh
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components

from ...core.angles import FloatArray
from ...core.types import IntArray
from ...scene.mesh.surfaces import SMALLEST_FACE_M2, Body, shared_edges

NEAREST_M, FARTHEST_M = 3e-6, 3e-3
"""Distances of parallel sheets between which a path that passes both is lost.

A ray that goes on behind a face starts a little off it: sheets nearer than that are passed together. In Sionna RT 2.2
paths were lost up to 7 mm in a room; the bound leaves out panes of glass."""
SHRUNK = 0.98  # size of triangles that are compared, so that neighbours in a plane do not touch
NORMAL_STEP = 2e-3  # step to which normals are rounded: parallel sheets agree to single precision
SIDE = np.array([0.9, 0.41, 0.17])
"""Direction by which one of both normals of a plane is chosen; hardly a wall is parallel to it."""
MOST_OPEN = 0.1  # largest share of open edges of a body that counts as a solid with a hole
FLAT = 1e-3  # largest ratio of the extents across and along a sheet


def copies(corners_m: FloatArray) -> NDArray[np.bool_]:
    """Which triangles [f, 3, 3] have the corners of an earlier one, in any order."""
    corner = np.unique(corners_m.reshape(-1, 3), axis=0, return_inverse=True)[1].reshape(-1, 3)
    _, first = np.unique(np.sort(corner, axis=1), axis=0, return_index=True)
    doubled = np.ones(len(corners_m), bool)
    doubled[first] = False
    return doubled


def wound_both_ways(body: Body) -> bool:
    """Whether the faces of a body that is closed or flat are wound both ways.

    Walls, floor and ceiling of a room as sheets may be wound in any way.
    """
    return (body.closed or is_flat(body)) and bool(_neighbours(body.corners_m)[1].any())


def wound_one_way(corners_m: FloatArray) -> FloatArray:
    """Triangles [f, 3, 3] of which neighbours are wound the same way, as the first of each body is."""
    pairs, same_way = _neighbours(corners_m)
    count = len(corners_m)
    # 1: neighbours agree, 2: one of both has to be turned.
    graph = csr_array((1 + same_way.astype(int), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    graph = (graph + graph.T).tocsr()
    _, label = connected_components(graph, directed=False)
    turned = np.zeros(count, bool)
    for root in np.unique(label, return_index=True)[1]:
        order, before = breadth_first_order(graph, root, directed=False)
        for face in order[1:]:
            turned[face] = turned[before[face]] ^ (graph[face, before[face]] == 2)
    return np.where(turned[:, None, None], corners_m[:, ::-1], corners_m)


def _neighbours(corners_m: FloatArray) -> tuple[IntArray, NDArray[np.bool_]]:
    """Pairs [n, 2] of triangles [f, 3, 3] with a common edge of no third one, and whether both run it the same way."""
    edge, ends = shared_edges(corners_m)
    order = np.argsort(edge, kind="stable")
    pairs = np.flatnonzero(np.bincount(edge) == 2)
    first = np.searchsorted(edge[order], pairs)
    sides = np.stack([order[first], order[first + 1]], axis=1)
    # Neighbours of the same orientation run along their common edge in opposite directions.
    return sides // 3, ends[sides[:, 0], 0] == ends[sides[:, 1], 0]


def is_flat(body: Body) -> bool:
    """Whether all corners of a body lie in a plane: a sheet, and not a room or a solid."""
    corners = body.corners_m.reshape(-1, 3)
    _, extent, _ = np.linalg.svd(np.linalg.qr(corners - corners.mean(axis=0), mode="r"))
    return bool(extent[2] <= FLAT * extent[0])


def open_solids(parts: Sequence[Body]) -> int:
    """Number of bodies that are solids but for a hole: few of their edges have one face alone."""
    count = 0
    for body in parts:
        if body.closed or len(body.corners_m) <= 4:
            continue
        uses = np.bincount(shared_edges(body.corners_m)[0])
        count += bool(np.count_nonzero(uses == 1) <= MOST_OPEN * len(uses))
    return count


def double_sheets(corners_m: FloatArray, owner: IntArray) -> IntArray:
    """Pairs [n, 2] of triangles [f, 3, 3] that overlap in almost one plane and have the same owner (material) [f]."""
    normals = np.cross(corners_m[:, 1] - corners_m[:, 0], corners_m[:, 2] - corners_m[:, 0])
    length = np.linalg.norm(normals, axis=1)
    valid = np.flatnonzero(length >= 2 * SMALLEST_FACE_M2)
    if not len(valid):
        return np.empty((0, 2), np.int64)
    normals = normals[valid] / length[valid, None]
    normals *= np.where(normals @ SIDE < 0, -1, 1)[:, None]
    middle = corners_m[valid].mean(axis=(0, 1))
    centred = corners_m[valid] - middle
    offset_m = (centred.mean(axis=1) * normals).sum(axis=1)
    direction = np.unique(
        np.column_stack([np.round(normals / NORMAL_STEP).astype(np.int64), owner[valid]]), axis=0, return_inverse=True
    )[1].reshape(-1)
    order = np.lexsort((offset_m, direction))
    jumps = (np.diff(direction[order]) != 0) | (np.diff(offset_m[order]) > FARTHEST_M)
    pairs = [np.empty((0, 2), np.int64)]
    for cluster in np.split(order, np.flatnonzero(jumps) + 1):
        if len(cluster) > 1 and np.ptp(offset_m[cluster]) > NEAREST_M:
            pairs.extend(_overlaps(centred[cluster], normals[cluster], offset_m[cluster], valid[cluster]))
    return np.concatenate(pairs)


def _overlaps(
    corners_m: FloatArray, normals: FloatArray, offset_m: FloatArray, numbers: IntArray
) -> Iterator[IntArray]:
    """Pairs of numbers of triangles [f, 3, 3] in nearly one plane that overlap and are neither one nor two sheets."""
    axes = trimesh.geometry.plane_transform([0, 0, 0], normals[0])[:2, :3]
    flat = corners_m @ axes.T
    centre = flat.mean(axis=1, keepdims=True)
    triangles = shapely.polygons(centre + SHRUNK * (flat - centre))
    first, second = shapely.STRtree(triangles).query(triangles, predicate="intersects")
    apart = np.abs(offset_m[first] - offset_m[second])
    kept = (first < second) & (apart > NEAREST_M) & (apart <= FARTHEST_M)
    yield np.stack([numbers[first[kept]], numbers[second[kept]]], axis=1)
