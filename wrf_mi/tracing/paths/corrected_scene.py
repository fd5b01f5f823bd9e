"""Scenes with planes and materials as training has changed them: as a folder, and for the search of paths.

Planes that move take paths with them (`wrf_mi.tracing.paths.scene_parameters`), but edges that move uncover some paths
and hide others. Faces, planes and materials of a scene in which paths are searched anew have the numbers of the stated
one, so that paths found there are paths of the stated scene with these parameters.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import mitsuba as mi
import numpy as np
import trimesh
from numpy.typing import NDArray
from wrf_mi_scenes.mitsuba_xml import ABSORBER, PERFECT_CONSTANTS

from ...backend.device import on_device, to_tensor
from ...core import InputError
from ...core.types import FloatArray, IntArray
from ...scene.folder import plain_name, write_scene
from ...scene.materials import CARRIER, Materials
from ...scene.materials import EXPONENT as LAW
from ...scene.mesh.surfaces import SAME_CORNER_M, Kind, Surface
from ...scene.scattering import check_scattering
from ..search.surfaces import Surfaces, largest_face, plane_bounds, scene_surfaces, shape_id
from ..sionna.materials import absorbs, in_itu_range, is_standard
from ..sionna.scattering import scattering_of
from .scene_parameters import QUANTITIES, SHIFT, TILT, MaterialGrouping, read_materials, slabs_of_faces
from .solve import Prepared

FLAT = 0.2  # sine of the angle up to which a plane is parallel to larger ones: their intersection may be far away
FACET_M2, CREASE_COS = 0.01, np.cos(np.radians(30))
"""Area in square metres below which a surface is a facet, and cosine of the bend towards a neighbour below which both
are: sides of boxes are none."""
UNCHANGED = 1e-4  # relative change of a constant below which a material keeps its name: no measurement supports less
ODD_IN_FILES, ODD_IN_MATERIALS = r"[^\w.-]", r"[^A-Za-z0-9_]"
"""Characters of other scenes' names that those of surfaces and materials of a scene folder do not have."""


def moved_triangles(surfaces: Surfaces, parameters: Mapping[str, NDArray[Any]]) -> FloatArray:
    """Corners [f, 3, 3] of a scene's faces, in metres, after its planes have moved.

    A corner takes the shortest way to all moved planes that meet there: on a single wall along its normal, at an edge
    or a corner of a room to the new intersection: closed surfaces stay closed. Planes without a common point are met by
    area, the largest first, so that a wall stays flat at the corners of a small face that is almost parallel to it; a
    mesh that only touches another one (a partition on the middle of a floor) does not follow it.

    Planes have moved by ``plane.shift`` [q] and ``plane.tilt`` [q, 2] of ``parameters``, zero where missing;
    `ValueError` for those of another number of planes.
    """
    # Corners that faces share, and the planes that meet at each.
    normal, offset = planes_at(surfaces, parameters)
    corners = surfaces.triangles.reshape(-1, 3)
    _, first, same = np.unique(np.round(corners / SAME_CORNER_M), axis=0, return_index=True, return_inverse=True)
    same = same.reshape(-1)
    pairs = np.unique(np.stack([same, np.repeat(surfaces.plane, 3)], axis=1), axis=0)
    area = np.bincount(surfaces.plane, trimesh.triangles.area(surfaces.triangles), len(normal)).astype(float)
    planes, count = _determining(pairs, len(first), area, normal)
    # The shortest displacement u with N u = off, of one, two or three planes: u = N^T (N N^T)^-1 off.
    way = np.zeros((len(first), 3))
    for size in range(1, 4):
        corner = np.flatnonzero(count == size)
        plane = planes[corner, :size]
        # Relative to the corner: the distance of faces from their planes within the tolerance stays.
        change = np.einsum("cpx,cx->cp", (normal - surfaces.normal)[plane], corners[first[corner]])
        off = offset[plane] - surfaces.offset[plane] - change
        # N N^T is far from singular: `_determining` leaves out normals that are almost parallel.
        across = normal[plane]
        share = np.linalg.solve(across @ across.swapaxes(1, 2), off[..., None])
        way[corner] = (across.swapaxes(1, 2) @ share)[..., 0]
    return (corners + way[same]).reshape(-1, 3, 3)


def planes_at(surfaces: Surfaces, parameters: Mapping[str, NDArray[Any]]) -> tuple[FloatArray, FloatArray]:
    """Normals [q, 3] and offsets [q] in metres of a scene's planes, with parameters and errors of `moved_triangles`."""
    count = len(surfaces.normal)
    shift, tilt = (np.asarray(parameters.get(name, np.zeros(0)), float) for name in (SHIFT, TILT))
    shift, tilt = shift if shift.size else np.zeros(count), tilt if tilt.size else np.zeros((count, 2))
    if shift.shape != (count,) or tilt.shape != (count, 2):
        raise ValueError(f"planes_at: shifts {shift.shape} and tilts {tilt.shape} of a scene of {count} planes")
    return surfaces.moved_planes(shift, tilt)


def _determining(pairs: IntArray, count: int, area: FloatArray, normal: FloatArray) -> tuple[IntArray, IntArray]:
    """Planes [count, 3] at each corner that are not parallel to what larger ones span, and their numbers [count]."""
    # Gram-Schmidt of the normals at all corners at once, one rank of area after another.
    corner, plane = pairs[np.lexsort((pairs[:, 1], -area[pairs[:, 1]], pairs[:, 0]))].T
    first = np.searchsorted(corner, np.arange(count + 1))
    planes, basis, number = np.zeros((count, 3), np.int64), np.zeros((count, 3, 3)), np.zeros(count, np.int64)
    for rank in range(int(np.diff(first).max(initial=0))):
        row = np.flatnonzero((first[:-1] + rank < first[1:]) & (number < 3))
        candidate = plane[first[row] + rank]
        along = np.einsum("cbx,cx->cb", basis[row], normal[candidate])
        across = normal[candidate] - np.einsum("cb,cbx->cx", along, basis[row])
        size = np.linalg.norm(across, axis=1)
        new = size > FLAT  # the sine of the angle to what larger planes span
        row, place = row[new], number[row[new]]
        planes[row, place], basis[row, place] = candidate[new], across[new] / size[new, None]
        number[row] += 1
    return planes, number


def check_materials(scene: Any) -> None:
    """Refuse (`InputError`) a scene with a material that is neither a slab nor an absorber: no folder can hold it."""
    slabs = read_materials(scene).names
    for name, scene_object in scene.objects.items():
        if (material := scene_object.radio_material.name) not in slabs and not absorbs(scene_object.radio_material):
            raise InputError(f"object {name}: material {material} is not a slab with constants; a folder needs one")


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

    Each surface becomes an object, but facets of an object that have not changed stay one object: those of curved
    furniture are many. Materials that have not changed keep their names, unless Sionna RT does not know them at the
    carrier that the scene is set to; others have constants, which hold there, and the exponent of the conductivity with
    the frequency.

    ``scene`` is a ``sionna.rt.Scene`` as it was trained with. Of ``parameters``, ``plane.*`` (see `moved_triangles`)
    and ``material.*`` (`wrf_mi.tracing.paths.scene_parameters`, in the given ``grouping``) count. ``kinds`` are those
    of objects by name, by default ``other``; surfaces of the slabs ``absent``, in the order of their parameters, are
    left out.

    Raises:
        InputError: a material that is neither a slab nor an absorber, no surface is left, or a folder that exists or
            cannot be written.
    """
    # Which materials have changed, and which surfaces stay together.
    check_materials(scene)
    surfaces = scene_surfaces(scene)
    triangles = moved_triangles(surfaces, parameters)
    slabs, slab_of_face = slabs_of_faces(scene, surfaces, grouping)
    corrected = slabs.fitted(parameters)
    fitted, exponent = corrected.table, corrected.exponent
    # As stated, or as parameters state it: metal has a permittivity of 1, of whose logarithm less one there is none.
    start_tables = [slabs.table, slabs.fitted(slabs.parameters(QUANTITIES)).table]
    differs = [np.any(np.abs(fitted - start) > UNCHANGED * np.abs(start), axis=1) for start in start_tables]
    changed: NDArray[np.bool_] = np.all(differs, axis=0)
    carrier_hz = float(scene.frequency[0])
    parts, thickness = list[Surface](), dict[str, float]()
    entries, constants = dict[str, str](), dict[str, dict[str, float]]()
    fitted_names, scattering = dict[str, str](), dict[str, dict[str, Any]]()
    together = ~changed & _facets(surfaces, slab_of_face, len(slabs.names))
    together[list(absent)] = False
    # Each object in pieces of one material each, which become objects of their own.
    for index, name in enumerate(surfaces.names):
        faces = np.arange(surfaces.first_face[index], surfaces.first_face[index + 1])
        slab_of_part = slab_of_face[faces]
        small = (slab_of_part >= 0) & together[slab_of_part]  # absorbers have no slab
        slab_of_part[small] = slab_of_part[small].min(initial=len(slabs.names))
        order = np.argsort(slab_of_part, kind="stable")
        present, first = np.unique(slab_of_part[order], return_index=True)
        pieces = np.split(faces[order], first[1:])
        written = [(slab, piece) for slab, piece in zip(present, pieces, strict=True) if slab not in absent]
        for number, (slab, piece) in enumerate(written):
            part = plain_name(name if len(written) == 1 else f"{name}_{number + 1:02d}", ODD_IN_FILES, entries)
            corners = triangles[piece].reshape(-1, 3)
            vertices, indices = np.unique(corners, axis=0, return_inverse=True)
            parts.append(Surface(part, kinds.get(name, "other"), vertices, indices.reshape(-1, 3)))
            # Its material: absorbing, fitted, by constants where ITU-R P.2040 has none at the carrier, or by name.
            radio_material = scene.objects[name].radio_material
            material, facts_of_scattering = radio_material.name, scattering_of(radio_material)
            if slab < 0:
                material = ABSORBER
            elif changed[slab] or not is_standard(radio_material):
                owner = part if grouping == "surface" else material
                if owner not in fitted_names:
                    fitted_names[owner] = plain_name(f"fitted_{owner}", ODD_IN_MATERIALS, constants)
                material = fitted_names[owner]
                law = {LAW: float(f"{exponent[slab]:.5g}"), CARRIER: carrier_hz}
                constants[material] = _constants(fitted[slab]) | law
            elif (itu := material.removeprefix("itu_")) != material and not in_itu_range(itu, carrier_hz):
                material = f"{itu}_{carrier_hz / 1e6:.0f}mhz"
                constants[material] = _constants(fitted[slab])
            else:
                thickness[material] = float(fitted[slab, 2])
            entries[part] = material
            if facts_of_scattering:
                scattering[material] = check_scattering(
                    f"object {name}: material {radio_material.name}", facts_of_scattering
                )
    facts = Materials(surfaces=entries, thickness_m=thickness, constants=constants, scattering=scattering)
    source = f"a scene corrected by measurements at {carrier_hz / 1e9:.6g} GHz, for which its constants hold"
    frame, title = "that of the scene it was made from", "A scene corrected by measurements"
    return write_scene(folder, parts, frame=frame, source=source, materials=facts, description=title, replace=replace)


def _facets(surfaces: Surfaces, slab_of_face: IntArray, count: int) -> NDArray[np.bool_]:
    """Mask of ``count`` surfaces that are facets: small, or with a neighbour in their object that bends little."""
    # Curved things have many faces that bend little towards each other, which a cabinet's sides do not.
    in_slab, area = slab_of_face >= 0, trimesh.triangles.area(surfaces.triangles)
    facets: NDArray[np.bool_] = np.bincount(slab_of_face[in_slab], area[in_slab], count) < FACET_M2
    corners = np.round(surfaces.triangles.reshape(-1, 3) / SAME_CORNER_M)
    vertices, same = np.unique(corners, axis=0, return_inverse=True)
    pairs = trimesh.Trimesh(vertices, same.reshape(-1, 3), process=False).face_adjacency
    plane, object_index = surfaces.plane[pairs], surfaces.object_of(pairs)
    bend = np.abs(np.einsum("ij,ij->i", *surfaces.normal[plane].swapaxes(0, 1)))
    smooth = (plane[:, 0] != plane[:, 1]) & (object_index[:, 0] == object_index[:, 1]) & (bend > CREASE_COS)
    smooth &= in_slab[pairs].all(axis=1)
    facets[slab_of_face[pairs[smooth]]] = True
    return facets


def _constants(slab: FloatArray) -> dict[str, float]:
    return {name: float(f"{value:.5g}") for name, value in zip(PERFECT_CONSTANTS, slab, strict=True)}


@dataclass(frozen=True)
class MovedSearch:
    """Where paths are searched for the scene as stated."""

    prepared: Prepared  # shared state of traces in the moved scene
    parameters: Mapping[str, Any]  # parameters of the traced fields, Dr.Jit tensors by name, used to prune weak paths


def moved_search(
    copy: Any, stated: Surfaces, parameters: Mapping[str, NDArray[Any]], absent: Collection[int] = ()
) -> MovedSearch:
    """Move the planes of a scene in place, for the search of paths there.

    The objects of ``copy``, a ``sionna.rt.Scene`` that nothing else may use, are those of the scene as ``stated``,
    perhaps moved before. ``parameters`` are those of `wrf_mi.tracing.paths.traced_field.TracedField`, planes among
    them; no ray shall meet the slabs of surfaces ``absent``, in the order of their parameters.
    """
    triangles = moved_triangles(stated, parameters)
    left_out = np.isin(slabs_of_faces(copy, stated, "surface")[1], list(absent))
    triangles[left_out] = triangles[left_out][:, :1]  # no ray meets a point
    # The faces of the copy take these corners, which they no longer share.
    scene_parameters = copy.mi_scene_params
    for number, name in enumerate(stated.names):
        mesh = copy.objects[name].mi_mesh.id()
        corners = triangles[stated.first_face[number] : stated.first_face[number + 1]].reshape(-1)
        scene_parameters[f"{mesh}.vertex_positions"] = on_device(corners, mi.Float)
        scene_parameters[f"{mesh}.faces"] = on_device(np.arange(len(corners) // 3), mi.UInt32)
    scene_parameters.update()
    # The outline of each plane in its stated axes, and a face of it that stands for it; not one that is left out.
    normal, offset = planes_at(stated, parameters)
    flat = np.einsum("fcx,fax->fca", triangles, stated.axes[stated.plane])
    low, high = plane_bounds(stated.plane, flat, len(normal))
    face = np.where(left_out[stated.face], largest_face(stated.plane, trimesh.triangles.area(triangles)), stated.face)
    shape_ids = np.array([shape_id(copy.objects[name].mi_mesh) for name in stated.names], np.uint32)
    surfaces = replace(
        stated, shape_ids=shape_ids, triangles=triangles, normal=normal, offset=offset, face=face, low=low, high=high
    )
    return MovedSearch(Prepared(copy, surfaces), {name: to_tensor(values) for name, values in parameters.items()})
