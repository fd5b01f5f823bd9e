"""Fitted parameters of a scene in an edited copy of it: they stay with the surfaces, wherever these have moved."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from ...core import InputError
from ...core.types import FloatArray, IntArray
from ..options import DISC, FACTOR
from ..search.surfaces import Surfaces, scene_surfaces
from .scene_parameters import SHIFT, SURFACE, TILT, name_of, slabs_of_faces
from .surface_gaussians import SAME_PLANE_COS, SAME_PLANE_M

SAME_SHAPE_M = 1e-4  # largest change of an edge's length: rounding of coordinates to single precision, far from origin


def parameters_in(edited: Any, stated: Any, params: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Parameters of a traced field that was fitted in a scene, for the scene with parts moved or removed.

    Materials of surfaces and Gaussians on surfaces (`wrf_mi.tracing.paths.surface_gaussians`) follow their surfaces,
    those of removed ones are left out; all other parameters stay.

    Args:
        edited: ``sionna.rt.Scene`` after the edit.
        stated: the one that the parameters were fitted in.
        params: parameters by the names of `wrf_mi.tracing.paths.traced_field.TracedField.parameters`.

    Raises:
        InputError: a surface that the stated scene does not have in this shape, or trained planes.
    """
    if SHIFT in params or TILT in params:
        raise InputError("planes were trained; edit the corrected scene in the run folder, and trace it")
    before, after = scene_surfaces(stated), scene_surfaces(edited)
    earlier, result = _earlier_faces(before, after), dict(params)
    # Materials by surface: a surface has any of its faces.
    _, slab_before = slabs_of_faces(stated, before, "surface")
    _, slab_after = slabs_of_faces(edited, after, "surface")
    slabs, face = np.unique(slab_after, return_index=True)
    chosen = slab_before[earlier[face[slabs >= 0]]]
    prefix = name_of(SURFACE, "")
    result |= {name: values[chosen] for name, values in params.items() if name.startswith(prefix)}
    if DISC in params and len(before.triangles):
        result |= _moved_discs(before, after, earlier, params)
    return result


def _earlier_faces(before: Surfaces, after: Surfaces) -> IntArray:
    """Face before the edit of each face after it, [f]."""
    earlier = []
    for index, name in enumerate(after.names):
        new = after.triangles[after.first_face[index] : after.first_face[index + 1]]
        number = before.names.index(name) if name in before.names else -1
        old = before.triangles[before.first_face[number] : before.first_face[number + 1]] if number >= 0 else new[:0]
        # A rigid motion keeps all lengths.
        if len(old) != len(new) or (np.abs(_edges_m(old) - _edges_m(new)) > SAME_SHAPE_M).any():
            raise InputError(f"surface {name}: not one of the scene of the fit; edit that scene")
        earlier.append(np.arange(before.first_face[number], before.first_face[number] + len(new)))
    return np.concatenate(earlier) if earlier else np.zeros(0, np.int64)


def _edges_m(triangles: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(np.roll(triangles, -1, axis=1) - triangles, axis=2))


def _moved_discs(
    before: Surfaces, after: Surfaces, earlier: IntArray, params: Mapping[str, NDArray[Any]]
) -> dict[str, NDArray[Any]]:
    """Gaussians on the faces that are left, at their places on these."""
    discs = np.asarray(params[DISC], float)
    face = np.array([_face_of(before, disc) for disc in discs.T], np.int64)
    later = np.full(len(before.plane), -1)
    later[earlier] = np.arange(len(earlier))
    remaining = later[face] >= 0
    discs, old, new = discs[:, remaining], before.triangles[face[remaining]], after.triangles[later[face[remaining]]]
    # Barycentric coordinates, which may lie outside of the face, hold in its plane wherever this moves.
    share = trimesh.triangles.points_to_barycentric(old, discs[:3].T)
    shift = np.einsum("gc,gcx->gx", share, new - old)
    normal = np.where((new == old).all(axis=(1, 2)), discs[3:], _normals(new).T)
    values = np.concatenate([discs[:3] + shift.T, normal]).astype(np.float32)
    return {DISC: values, FACTOR: params[FACTOR][:, remaining]}


def _face_of(surfaces: Surfaces, disc: FloatArray) -> int:
    """The face that a Gaussian [6] lies on, the nearest in its plane."""
    away = np.abs(surfaces.normal @ disc[:3] - surfaces.offset)
    same = (away < SAME_PLANE_M) & (np.abs(surfaces.normal @ disc[3:]) > SAME_PLANE_COS)
    # Means over planes that a scan has twice may be farther from both: then any face counts.
    faces = np.flatnonzero(same[surfaces.plane] | (not same.any()))
    nearest_m = trimesh.triangles.closest_point(surfaces.triangles[faces], np.tile(disc[:3], (len(faces), 1)))
    return int(faces[np.linalg.norm(nearest_m - disc[:3], axis=1).argmin()])


def _normals(triangles: FloatArray) -> FloatArray:
    cross = trimesh.triangles.cross(triangles)
    return np.asarray(cross / np.linalg.norm(cross, axis=1, keepdims=True))
