"""Triangles of the polygons of a mesh, concave ones among them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ...core.angles import FloatArray
from ...core.types import IntArray
from .polygon_files import Polygons

FLAT = 1e-9
"""Least ratio of a polygon's second extent to its first; below it has no area."""
COLLINEAR = 1e-6
"""Sine of the angle below which a corner lies in a straight side: rounding of float32."""
GRID = 1e-5
"""Distance relative to a polygon's extent at which its corners and sides touch: that rounding some metres away."""


def triangles_of(polygons: Polygons) -> tuple[IntArray, IntArray]:
    """Triangles that fill polygons.

    Convex polygons are fans about their first corner, as other programs have them. Others become Delaunay triangles in
    their plane, with all corners; a hole that is joined to the outline by an edge there and back stays open. Polygons
    without an area are fans, too.

    Returns:
        Vertex indices of the triangles [t, 3], and the number of each triangle's polygon [t].

    Raises:
        ValueError: a polygon whose edges cross or that covers a place twice, by its place in the file.
    """
    polygons = _without_repeats(polygons)
    first = np.cumsum(polygons.sizes) - polygons.sizes
    faces: list[IntArray] = [np.empty((0, 3), np.int64)]
    owners: list[IntArray] = [np.empty(0, np.int64)]
    for size in np.unique(polygons.sizes):
        chosen = np.flatnonzero(polygons.sizes == size)
        corners = polygons.corners[first[chosen, None] + np.arange(size)]
        convex = np.ones(len(chosen), bool) if size == 3 else _convex(polygons.vertices[corners])
        faces.append(corners[convex][:, _fan(size)].reshape(-1, 3))
        owners.append(np.repeat(chosen[convex], size - 2))
        for polygon, indices in zip(chosen[~convex], corners[~convex], strict=True):
            cut = _cut(polygons.vertices[indices])
            if cut is None:
                text = f"{polygons.place(polygon)}: the edges of the face cross, or it covers a place twice"
                raise ValueError(f"{text}; split it into faces that do not")
            faces.append(indices[cut])
            owners.append(np.full(len(cut), polygon))
    every, owner = np.concatenate(faces), np.concatenate(owners)
    order = np.argsort(owner, kind="stable")  # that of the file
    return every[order], owner[order]


def _without_repeats(polygons: Polygons) -> Polygons:
    """Polygons without corners that lie where the corner before does, unless fewer than three are left."""
    owner = np.repeat(np.arange(len(polygons.sizes)), polygons.sizes)
    first = np.cumsum(polygons.sizes) - polygons.sizes
    before = np.arange(len(owner)) - 1
    before[first] = first + polygons.sizes - 1
    places = polygons.vertices[polygons.corners]
    repeated = (places == places[before]).all(axis=1)
    sizes = np.bincount(owner[~repeated], minlength=len(first))
    repeated &= (sizes >= 3)[owner]
    sizes = np.bincount(owner[~repeated], minlength=len(first))
    return replace(polygons, corners=polygons.corners[~repeated], sizes=sizes)


def _fan(size: int) -> IntArray:
    """Triangles [size - 2, 3] of a polygon's corners about the first."""
    middle = np.arange(1, size - 1)
    return np.stack([np.zeros_like(middle), middle, middle + 1], axis=-1)


def _convex(corners: FloatArray) -> NDArray[np.bool_]:
    """Whether each polygon [n, s, 3] turns one way at all corners, and round once.

    One with a corner in a straight side does not: a fan about its neighbour would have a triangle without an area.
    """
    edges = np.roll(corners, -1, axis=1) - corners
    following = np.roll(edges, -1, axis=1)
    normal = _normal(corners)
    normal = normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), np.finfo(float).tiny)
    size = np.linalg.norm(edges, axis=-1) * np.linalg.norm(following, axis=-1)
    sine = (np.cross(edges, following) * normal[:, None]).sum(axis=-1)
    cosine = (edges * following).sum(axis=-1)
    # A star turns one way at all corners, too, but twice round.
    rounds = np.arctan2(sine, cosine).sum(axis=-1) / (2 * np.pi)
    convex: NDArray[np.bool_] = (sine > COLLINEAR * size).all(axis=-1) & (rounds < 1.5)
    return convex


def _normal(corners: FloatArray) -> FloatArray:
    """Newell's normals [n, 3] of polygons [n, s, 3], twice as long as their areas."""
    about = corners - corners[:, :1]
    return np.cross(about, np.roll(about, -1, axis=1)).sum(axis=1)


def _cut(corners: FloatArray) -> IntArray | None:
    """Corner numbers of triangles [t, 3] that fill a polygon [s, 3]; None if its edges cross."""
    if not np.isfinite(corners).all():
        return _fan(len(corners))  # `mesh_parts` refuses it, with the number of the vertex
    centred = corners - corners.mean(axis=0)
    _, extent, axes = np.linalg.svd(centred, full_matrices=False)
    if extent[1] <= FLAT * extent[0]:
        return _fan(len(corners))
    normal, grid = _normal(corners[None])[0], GRID * extent[0]
    if np.linalg.norm(normal) > grid * extent[0]:
        # The plane of a polygon that is not quite flat is square to its mean normal.
        normal = normal / np.linalg.norm(normal)
        along = axes[0] - normal * (axes[0] @ normal)
        along = along / np.linalg.norm(along)
        axes = np.stack([along, np.cross(normal, along)])
    flat = centred @ axes[:2].T
    # On a grid, corners that lie on another side but for rounding are corners of both.
    sides = shapely.union_all([shapely.linearrings(flat)], grid_size=grid)
    faces = shapely.polygonize([sides])
    parts, face = shapely.get_parts(shapely.constrained_delaunay_triangles(shapely.get_parts(faces)), return_index=True)
    # How often the polygon goes round each face, seen from the middle of a triangle clear of all edges.
    middle = shapely.centroid(parts)
    order = np.lexsort((shapely.distance(middle, sides), face))
    clear = order[np.flatnonzero(np.diff(face[order], append=-1))]
    spokes = flat - shapely.get_coordinates(middle[clear])[:, None]
    angle = np.arctan2(spokes[..., 1], spokes[..., 0])
    step = (np.roll(angle, -1, axis=1) - angle + np.pi) % (2 * np.pi) - np.pi
    rounds = np.round(step.sum(axis=1) / (2 * np.pi)).astype(int)
    # Never in a hole; beside a crossing twice, or both ways.
    if np.ptp([0, *rounds]) > 1:
        return None
    inside = parts[(rounds != 0)[face]]
    _, cut = cKDTree(flat).query(shapely.get_coordinates(inside).reshape(-1, 4, 2)[:, :3])
    return np.asarray(cut, np.int64).reshape(-1, 3)
