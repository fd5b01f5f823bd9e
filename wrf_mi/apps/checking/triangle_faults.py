"""Faults of triangles: faces that are wound both ways, and parallel sheets almost in one plane."""

from __future__ import annotations

import numpy as np
import shapely
import trimesh

from ...core.angles import FloatArray
from ...core.types import IntArray
from ...scene.mesh.surfaces import Body, bodies, welded, without_area

NEAREST_M, FARTHEST_M = 3e-6, 3e-3
"""Distances of parallel sheets between which a path that passes both is lost.

A ray that goes on behind a face starts a little off it: sheets nearer than that are passed together. In Sionna RT 2.2
paths were lost up to 7 mm in a room; the bound leaves out panes of glass."""
SHRUNK = 0.98  # size of triangles that are compared, so that neighbours in a plane do not touch
NORMAL_STEP = 2e-3  # step to which normals are rounded: parallel sheets agree to single precision
SIDE = np.array([0.9, 0.41, 0.17])
"""Direction by which one of both normals of a plane is chosen; hardly a wall is parallel to it."""
FLAT = 1e-3  # largest ratio of the extents across and along a sheet


def wound_both_ways(body: Body) -> bool:
    """Whether the faces of a body that is closed or flat are wound both ways.

    Walls, floor and ceiling of a room as sheets may be wound in any way.
    """
    return (body.closed or is_flat(body)) and not welded(body.corners_m).is_winding_consistent


def wound_one_way(corners_m: FloatArray) -> FloatArray:
    """Triangles [f, 3, 3] of which neighbours are wound the same way, as the first of each body is."""
    mesh = welded(corners_m)
    before = mesh.faces.copy()
    trimesh.repair.fix_winding(mesh)
    turned = (mesh.faces != before).any(axis=1)
    # trimesh makes faces of a body agree, and leaves open with which of them.
    for body in bodies(corners_m):
        turned[body.faces] ^= turned[body.faces.min()]
    return np.where(turned[:, None, None], corners_m[:, ::-1], corners_m)


def is_flat(body: Body) -> bool:
    """Whether all corners of a body lie in a plane: a sheet, and not a room or a solid."""
    corners = body.corners_m.reshape(-1, 3)
    _, extent, _ = np.linalg.svd(np.linalg.qr(corners - corners.mean(axis=0), mode="r"))
    return bool(extent[2] <= FLAT * extent[0])


def sheet_numbers(corners_m: FloatArray) -> IntArray:
    """Number of the flat body of each triangle [f, 3, 3]; -1 in others."""
    numbers = np.full(len(corners_m), -1)
    for number, body in enumerate(bodies(corners_m)):
        if is_flat(body):
            numbers[body.faces] = number
    return numbers


def double_sheets(corners_m: FloatArray, owner: IntArray) -> IntArray:
    """Pairs [n, 2] of triangles [f, 3, 3] that overlap in almost one plane and have the same owner (material) [f]."""
    valid = np.flatnonzero(~without_area(corners_m))
    if not len(valid):
        return np.empty((0, 2), np.int64)
    normals = trimesh.unitize(trimesh.triangles.cross(corners_m[valid]))
    normals *= np.where(normals @ SIDE < 0, -1, 1)[:, None]
    # About the middle: offsets of planes far from the origin would lose micrometres.
    centred = corners_m[valid] - corners_m[valid].mean(axis=(0, 1))
    offset_m = (centred.mean(axis=1) * normals).sum(axis=1)
    direction = np.unique(
        np.column_stack([np.round(normals / NORMAL_STEP).astype(np.int64), owner[valid]]), axis=0, return_inverse=True
    )[1].reshape(-1)
    # Only faces of one direction and material, with offsets in one run without a gap, can be too near to each other.
    order = np.lexsort((offset_m, direction))
    jumps = (np.diff(direction[order]) != 0) | (np.diff(offset_m[order]) > FARTHEST_M)
    pairs = [np.empty((0, 2), np.int64)]
    for cluster in np.split(order, np.flatnonzero(jumps) + 1):
        if len(cluster) > 1 and np.ptp(offset_m[cluster]) > NEAREST_M:
            pairs.append(valid[cluster][_overlaps(centred[cluster], normals[cluster], offset_m[cluster])])
    return np.concatenate(pairs)


def _overlaps(corners_m: FloatArray, normals: FloatArray, offset_m: FloatArray) -> IntArray:
    """Pairs [n, 2] of triangles [f, 3, 3] in nearly one plane that overlap and are neither one nor two sheets."""
    axes = trimesh.geometry.plane_transform([0, 0, 0], normals[0])[:2, :3]
    flat = corners_m @ axes.T
    centre = flat.mean(axis=1, keepdims=True)
    triangles = shapely.polygons(centre + SHRUNK * (flat - centre))
    first, second = shapely.STRtree(triangles).query(triangles, predicate="intersects")
    apart = np.abs(offset_m[first] - offset_m[second])
    too_near = (first < second) & (apart > NEAREST_M) & (apart <= FARTHEST_M)
    return np.stack([first[too_near], second[too_near]], axis=1)
