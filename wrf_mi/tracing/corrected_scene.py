"""Scene folder with planes as training has moved them, which Sionna RT opens."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import InputError
from ..core.angles import FloatArray
from ..scene.folder import write_scene
from ..scene.materials import THICKNESS_M, Materials
from ..scene.surfaces import SAME_CORNER_M, Surface
from .plane_parameters import SHIFT, TILT
from .surfaces import Surfaces, scene_surfaces
from .walls import moved_planes, plane_centres

FLAT = 0.1
"""Share of the largest singular value below which planes at a corner count as parallel: those within 11 degrees do not
determine the corner's position along them."""


def moved_triangles(surfaces: Surfaces, parameters: Mapping[str, NDArray[Any]]) -> FloatArray:
    """Corners [f, 3, 3] of a scene's faces, in metres, after its planes have moved.

    A corner takes the shortest way to all moved planes that meet there: on a single wall along its normal, at an edge
    or a corner of a room to the new intersection: closed surfaces stay closed. Planes without a common point are met in
    the least-squares sense; a mesh that only touches another one (a partition on the middle of a floor) does not
    follow it.

    Args:
        surfaces: surfaces of the scene.
        parameters: ``plane.shift`` [q] and ``plane.tilt`` [q, 2]; missing ones are zero.

    Raises:
        ValueError: parameters of a scene with another number of planes.
    """
    count = len(surfaces.normal)
    shift, tilt = (np.asarray(parameters.get(name, np.zeros(0)), float) for name in (SHIFT, TILT))
    shift, tilt = shift if shift.size else np.zeros(count), tilt if tilt.size else np.zeros((count, 2))
    if shift.shape != (count,) or tilt.shape != (count, 2):
        raise ValueError(f"moved_triangles: shifts {shift.shape} and tilts {tilt.shape} of a scene of {count} planes")
    change = np.column_stack([shift, tilt])
    normal, offset = moved_planes(surfaces.normal, surfaces.axes, plane_centres(surfaces)[0], change)

    corners = surfaces.triangles.reshape(-1, 3)
    _, first, same = np.unique(np.round(corners / SAME_CORNER_M), axis=0, return_index=True, return_inverse=True)
    same = same.reshape(-1)
    pairs = np.unique(np.stack([same, np.repeat(surfaces.plane, 3)], axis=1), axis=0)
    bounds = np.searchsorted(pairs[:, 0], np.arange(len(first) + 1))
    way = np.zeros((len(first), 3))
    for corner, (low, high) in enumerate(pairwise(bounds)):
        plane = pairs[low:high, 1]
        # Relative to the corner: the distance of faces from their planes within the tolerance stays.
        off = offset[plane] - surfaces.offset[plane] - (normal - surfaces.normal)[plane] @ corners[first[corner]]
        way[corner] = np.linalg.lstsq(normal[plane], off, rcond=FLAT)[0]
    return (corners + way[same]).reshape(-1, 3, 3)


def check_materials(scene: Any) -> None:
    """Refuse a scene that `write_corrected_scene` cannot write.

    Raises:
        InputError: a material that is not of ITU-R P.2040.
    """
    for name, thing in scene.objects.items():
        if (material := thing.radio_material.name) not in THICKNESS_M:
            raise InputError(f"object {name}: material {material} is not one of ITU-R P.2040; a folder needs one")


def write_corrected_scene(
    folder: str | Path, scene: Any, parameters: Mapping[str, NDArray[Any]], replace: bool = False
) -> Path:
    """Write a scene with moved planes as a scene folder.

    Materials are those of the scene by name, with their thickness; trained constants of materials are not written, as
    the folder's format has none.

    Args:
        folder: the new folder.
        scene: a ``sionna.rt.Scene`` as it was trained with.
        parameters: see `moved_triangles`; others are ignored.
        replace: replace an existing folder.

    Returns:
        The folder.

    Raises:
        InputError: a material that is not of ITU-R P.2040, or a folder that exists or cannot be written.
        ValueError: see `moved_triangles`.
    """
    check_materials(scene)
    surfaces = scene_surfaces(scene)
    triangles = moved_triangles(surfaces, parameters)
    parts, kinds, thickness = [], {}, {}
    for index, name in enumerate(surfaces.names):
        material = scene.objects[name].radio_material
        corners = triangles[surfaces.first_face[index] : surfaces.first_face[index + 1]].reshape(-1, 3)
        vertices, faces = np.unique(corners, axis=0, return_inverse=True)
        parts.append(Surface(name, "other", vertices, faces.reshape(-1, 3)))
        kinds[name] = material.name
        thickness[material.name] = float(np.ravel(material.thickness)[0])
    return write_scene(
        folder,
        parts,
        frame="that of the scene it was made from",
        source="a scene whose planes training has moved",
        materials=Materials(surfaces=kinds, thickness_m=thickness),
        description="A scene with corrected planes",
        replace=replace,
    )
