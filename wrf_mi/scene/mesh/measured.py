"""Whether the faces of a mesh were measured (LiDAR of a phone, photogrammetry) or designed.

On a measured wall, noise turns each face against its neighbours, but not the mean of many faces. On a designed surface
neighbours are coplanar, meet at an edge, or, on a tessellated curve, turn by as much as their means do.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import trimesh
from scipy import sparse

from .surfaces import Surface, welded

SHARP_RAD = np.radians(
    40
)  # larger angles between neighbours are edges of things; noise of 10 % of a side turns by less
LEAST_TURN_RAD = np.radians(0.3)  # smaller angles are rounding of coordinates to the millimetre
RINGS = 8  # faces over which means are taken, as often averaged with their neighbours
SMOOTHED = 0.15
"""Largest turn of the means relative to that of the faces: noise leaves 0.1, terrain 0.2, a curve 0.5 or more."""
LEAST_SHARE = 0.5  # least share of the area that is uneven


def is_measured(surfaces: Sequence[Surface]) -> bool:
    """Whether most of the area of a mesh is of flat surfaces whose faces noise has turned."""
    corners = np.concatenate([surface.vertices_m[surface.faces] for surface in surfaces])
    area = trimesh.triangles.area(corners)
    cross = trimesh.triangles.cross(corners)
    normals = cross / np.linalg.norm(cross, axis=-1, keepdims=True)
    first, second = welded(corners).face_adjacency.T  # of edges that two faces share
    cosine = (normals[first] * normals[second]).sum(axis=-1)
    smooth = np.abs(cosine) > np.cos(SHARP_RAD)  # whichever way the normals point
    first, second, sign = first[smooth], second[smooth], np.sign(cosine[smooth])
    if not len(first):
        return False
    count = len(area)
    ends = (np.concatenate([first, second]), np.concatenate([second, first]))
    links = sparse.csr_array((np.concatenate([sign, sign]), ends), shape=(count, count))
    # Diffusion over neighbours, their normals turned to the side of the face; weighted by area, as noise turns small
    # faces most. Only directions matter, and scaling keeps the sums in range.
    mean = normals * area[:, None]
    for _ in range(RINGS):
        mean = mean + links @ mean
        mean /= np.linalg.norm(mean, axis=-1).max()
    mean /= np.maximum(np.linalg.norm(mean, axis=-1, keepdims=True), np.finfo(float).tiny)

    def turns(vectors: np.ndarray) -> np.ndarray:
        """Mean angle of each face to its neighbours [f], radians."""
        chord = np.linalg.norm(vectors[first] - sign[:, None] * vectors[second], axis=-1)
        angle = 2 * np.arcsin(np.minimum(chord / 2, 1))
        total = np.bincount(ends[0], np.concatenate([angle, angle]), count)
        return np.asarray(total / np.maximum(np.bincount(ends[0], minlength=count), 1))

    faces, means = turns(normals), turns(mean)
    uneven = (faces > LEAST_TURN_RAD) & (means < SMOOTHED * faces)
    return bool(area[uneven].sum() >= LEAST_SHARE * area.sum())
