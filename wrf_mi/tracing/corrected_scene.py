"""Scene folder with planes and materials as training has changed them, which Sionna RT opens."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from wrf_mi_scenes.mitsuba_xml import ABSORBER, PERFECT_CONSTANTS

from ..core import InputError
from ..core.angles import FloatArray
from ..core.types import IntArray
from ..scene.folder import plain_name, write_scene
from ..scene.materials import CARRIER, THICKNESS_M, Materials
from ..scene.materials import EXPONENT as LAW
from ..scene.surfaces import SAME_CORNER_M, Kind, Surface
from .material_parameters import (
    EXPONENT,
    SURFACE,
    MaterialGrouping,
    SlabMaterials,
    name_of,
    read_materials,
    slabs_of_faces,
)
from .materials import absorbs, in_itu_range
from .plane_parameters import SHIFT, TILT
from .surfaces import Surfaces, scene_surfaces
from .walls import moved_planes, plane_centres

FLAT = 0.2
"""Sine of the angle, 11 degrees, within which a plane at a corner counts as parallel to larger ones: their intersection
may lie far from it."""
UNCHANGED = 1e-4
"""Relative change of a constant below which a material keeps its name: less than any measurement supports."""
ODD_IN_FILES, ODD_IN_MATERIALS = r"[^\w.-]", r"[^A-Za-z0-9_]"
"""Characters of other scenes' names that those of surfaces and materials of a scene folder do not have."""
QUANTITIES = {"permittivity": 1.0, "conductivity": 0.0, "thickness": 0.0}
"""Trainable constants of a slab, and the least value of each (`wrf_mi.tracing.material_parameters`)."""


def moved_triangles(surfaces: Surfaces, parameters: Mapping[str, NDArray[Any]]) -> FloatArray:
    """Corners [f, 3, 3] of a scene's faces, in metres, after its planes have moved.

    A corner takes the shortest way to all moved planes that meet there: on a single wall along its normal, at an edge
    or a corner of a room to the new intersection: closed surfaces stay closed. Planes without a common point are met by
    area, the largest first, so that a wall stays flat at the corners of a small face that is almost parallel to it; a
    mesh that only touches another one (a partition on the middle of a floor) does not follow it.

    Args:
        surfaces: surfaces of the scene.
        parameters: ``plane.shift`` [q] and ``plane.tilt`` [q, 2]; missing ones are zero.

    Raises:
        ValueError: parameters of a scene with another number of planes.
    """
    normal, offset = planes_at(surfaces, parameters)

    corners = surfaces.triangles.reshape(-1, 3)
    _, first, same = np.unique(np.round(corners / SAME_CORNER_M), axis=0, return_index=True, return_inverse=True)
    same = same.reshape(-1)
    pairs = np.unique(np.stack([same, np.repeat(surfaces.plane, 3)], axis=1), axis=0)
    bounds = np.searchsorted(pairs[:, 0], np.arange(len(first) + 1))
    area = np.bincount(surfaces.plane, trimesh.triangles.area(surfaces.triangles), len(normal)).astype(float)
    way = np.zeros((len(first), 3))
    for corner, (low, high) in enumerate(pairwise(bounds)):
        plane = _determining(pairs[low:high, 1], area, normal)
        # Relative to the corner: the distance of faces from their planes within the tolerance stays.
        off = offset[plane] - surfaces.offset[plane] - (normal - surfaces.normal)[plane] @ corners[first[corner]]
        way[corner] = np.linalg.lstsq(normal[plane], off)[0]
    return (corners + way[same]).reshape(-1, 3, 3)


def planes_at(surfaces: Surfaces, parameters: Mapping[str, NDArray[Any]]) -> tuple[FloatArray, FloatArray]:
    """Normals [q, 3] and offsets [q] in metres of a scene's planes with the parameters of `moved_triangles`.

    Raises:
        ValueError: parameters of a scene with another number of planes.
    """
    count = len(surfaces.normal)
    shift, tilt = (np.asarray(parameters.get(name, np.zeros(0)), float) for name in (SHIFT, TILT))
    shift, tilt = shift if shift.size else np.zeros(count), tilt if tilt.size else np.zeros((count, 2))
    if shift.shape != (count,) or tilt.shape != (count, 2):
        raise ValueError(f"planes_at: shifts {shift.shape} and tilts {tilt.shape} of a scene of {count} planes")
    change = np.column_stack([shift, tilt])
    return moved_planes(surfaces.normal, surfaces.axes, plane_centres(surfaces)[0], change)


def _determining(planes: IntArray, area: FloatArray, normal: FloatArray) -> IntArray:
    """Of planes at a corner, the largest first, those that are not parallel to what the larger ones span."""
    kept, basis = list[int](), np.zeros((0, 3))
    for plane in planes[np.argsort(-area[planes], kind="stable")]:
        across = normal[plane] - basis.T @ (basis @ normal[plane])
        if (size := float(np.linalg.norm(across))) > FLAT:
            kept.append(plane)
            basis = np.vstack([basis, across / size])
    return np.array(kept)


def check_materials(scene: Any) -> None:
    """Refuse a scene that `write_corrected_scene` cannot write.

    Raises:
        InputError: a material that is neither a slab nor an absorber.
    """
    slabs = read_materials(scene).names
    for name, thing in scene.objects.items():
        if (material := thing.radio_material.name) not in slabs and not absorbs(thing.radio_material):
            raise InputError(f"object {name}: material {material} is not a slab with constants; a folder needs one")


def material_constants(slabs: SlabMaterials, parameters: Mapping[str, NDArray[Any]]) -> FloatArray:
    """Relative permittivity, conductivity in S/m and thickness in metres of n slabs, [n, 3], from ``parameters`` where
    they have them.
    """
    values = np.stack([slabs.permittivity, slabs.conductivity, slabs.thickness_m], axis=1).astype(float)
    for column, (quantity, least) in enumerate(QUANTITIES.items()):
        for index, name in enumerate([SURFACE] if slabs.grouping == "surface" else slabs.names):
            if (found := parameters.get(name_of(name, quantity))) is not None:
                rows = slice(None) if name == SURFACE else slice(index, index + 1)
                values[rows, column] = least + np.exp(np.ravel(np.asarray(found, float)))
    return values


def material_exponents(slabs: SlabMaterials, parameters: Mapping[str, NDArray[Any]]) -> FloatArray:
    """Exponents of the conductivities of n slabs [n], from ``parameters`` where they have them."""
    found = parameters.get(name_of(SURFACE, EXPONENT)) if slabs.grouping == "surface" else None
    return slabs.exponent if found is None else np.asarray(found, float).ravel()


def write_corrected_scene(
    folder: str | Path,
    scene: Any,
    parameters: Mapping[str, NDArray[Any]],
    *,
    grouping: MaterialGrouping = "named",
    kinds: Mapping[str, Kind] = MappingProxyType({}),
    absent: Collection[int] = (),
    replace: bool = False,
) -> Path:
    """Write a scene with moved planes and changed materials as a scene folder.

    Objects whose surfaces differ in material become several. Materials that have not changed keep their names, unless
    Sionna RT does not know them at the carrier that the scene is set to; others have constants, which hold there, and
    the exponent of the conductivity with the frequency.

    Args:
        folder: the new folder.
        scene: a ``sionna.rt.Scene`` as it was trained with.
        parameters: ``plane.*`` (see `moved_triangles`) and ``material.*`` (see
            `wrf_mi.tracing.material_parameters`); others are ignored.
        grouping: grouping of the parameters of materials.
        kinds: kinds of objects by name; by default ``other``.
        absent: slabs, in the order of their parameters, whose surfaces are left out.
        replace: replace an existing folder.

    Returns:
        The folder.

    Raises:
        InputError: a material that is neither a slab nor an absorber, no surface is left, or a folder that exists or
            cannot be written.
        ValueError: see `moved_triangles`.
    """
    check_materials(scene)
    surfaces = scene_surfaces(scene)
    triangles = moved_triangles(surfaces, parameters)
    slabs, slab_of_face = slabs_of_faces(scene, surfaces, grouping)
    stated, fitted = material_constants(slabs, {}), material_constants(slabs, parameters)
    exponent = material_exponents(slabs, parameters)
    changed: NDArray[np.bool_] = np.any(np.abs(fitted - stated) > UNCHANGED * np.abs(stated), axis=1)
    carrier_hz = float(scene.frequency[0])
    parts, thickness = list[Surface](), dict[str, float]()
    entries, constants = dict[str, str](), dict[str, dict[str, float]]()
    fitted_names = dict[str, str]()
    for index, name in enumerate(surfaces.names):
        faces = np.arange(surfaces.first_face[index], surfaces.first_face[index + 1])
        present = [slab for slab in np.unique(slab_of_face[faces]) if slab not in absent]
        for number, slab in enumerate(present):
            part = plain_name(name if len(present) == 1 else f"{name}_{number + 1:02d}", ODD_IN_FILES, entries)
            corners = triangles[faces[slab_of_face[faces] == slab]].reshape(-1, 3)
            vertices, indices = np.unique(corners, axis=0, return_inverse=True)
            parts.append(Surface(part, kinds.get(name, "other"), vertices, indices.reshape(-1, 3)))
            material = scene.objects[name].radio_material.name
            if slab < 0:
                material = ABSORBER
            elif changed[slab] or material not in THICKNESS_M:
                owner = part if grouping == "surface" else material
                if owner not in fitted_names:
                    fitted_names[owner] = plain_name(f"fitted_{owner}", ODD_IN_MATERIALS, constants)
                material = fitted_names[owner]
                law = {LAW: _rounded(exponent[slab]), CARRIER: carrier_hz}
                constants[material] = dict(zip(PERFECT_CONSTANTS, map(_rounded, fitted[slab]), strict=True)) | law
            elif (itu := material.removeprefix("itu_")) != material and not in_itu_range(itu, carrier_hz):
                material = f"{itu}_{carrier_hz / 1e6:.0f}mhz"
                constants[material] = dict(zip(PERFECT_CONSTANTS, map(_rounded, fitted[slab]), strict=True))
            else:
                thickness[material] = float(fitted[slab, 2])
            entries[part] = material
    facts = Materials(surfaces=entries, thickness_m=thickness, constants=constants)
    return write_scene(
        folder,
        parts,
        frame="that of the scene it was made from",
        source=f"a scene corrected by measurements at {carrier_hz / 1e9:.6g} GHz, for which its constants hold",
        materials=facts,
        description="A scene corrected by measurements",
        replace=replace,
    )


def _rounded(value: float) -> float:
    return float(f"{value:.5g}")
