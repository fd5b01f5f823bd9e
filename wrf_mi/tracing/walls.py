"""Planes of a scene that are shifted and tilted about their centres, in float64."""

from __future__ import annotations

import numpy as np
import trimesh

from ..core.angles import FloatArray
from .surfaces import Surfaces


def moved_planes(
    normal: FloatArray, axes: FloatArray, centre_m: FloatArray, change: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Normals and offsets of planes after shifts along their normals and tilts about their centres.

    Args:
        normal: unit normals [q, 3].
        axes: two unit vectors in each plane [q, 2, 3].
        centre_m: centroid of each plane's faces [q, 3].
        change: shift in metres, and tilts in rad towards both axes [q, 3].

    Returns:
        Normals [q, 3] and offsets [q], metres.
    """
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
