"""Scenes as a folder for plain Sionna RT and Mitsuba, and as one mesh with materials."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import trimesh
from wrf_mi_scenes.mitsuba_xml import ABSORBER, COLOURS, OTHER_COLOUR, PERFECT_CONSTANTS, scene_xml

from ...core import InputError
from ...core.files import atomic_folder, listed, one_line, write_atomically
from ...core.types import IntArray
from ...runs.scene_view import surfaces_of
from ...scene.coordinates import Y_UP
from ...scene.folder import plain_name
from ...scene.mesh.surfaces import Surface
from ...scene.scattering import PATTERN
from ...tracing.paths.corrected_scene import ODD_IN_FILES, check_materials
from ...tracing.sionna.materials import absorbs, conductivity_exponent, in_itu_range, set_frequency
from ...tracing.sionna.scattering import scattering_of
from ...tracing.sionna.scenes import load_scene
from .format import ExportOptions
from .source import Source

logger = logging.getLogger(__name__)

XML, LOOKS, FACTS = "scene.xml", "mitsuba.xml", "materials.json"
GLTF_LOOKS: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": 1.0, "doubleSided": True}


def _parts(scene: Any) -> list[tuple[Surface, str]]:
    """Surfaces of a ``sionna.rt.Scene``, each with its radio material."""
    return [(surface, scene.objects[surface.name].radio_material.name) for surface in surfaces_of(scene)]


def _loaded(source: Source, options: ExportOptions) -> tuple[Any, dict[str, float], dict[str, tuple[float, float]]]:
    scene, material = source.scene()
    return load_scene(scene, material if options.material is None else options.material)


def _colour_bytes(material: str) -> IntArray:
    """Colour in Mitsuba's pictures, RGB in 0..255."""
    return (255 * np.array(COLOURS.get(material, OTHER_COLOUR).split(), float)).round().astype(int)


class _Exported(NamedTuple):
    """Materials of a folder: new names, and by these constants, slabs of ITU-R P.2040, and facts about all."""

    names: dict[str, str]
    constants: dict[str, dict[str, float]]
    slabs: dict[str, tuple[str, dict[str, Any]]]
    facts: dict[str, dict[str, Any]]


def _exported(scene: Any, used: Iterable[str], frequency_hz: float) -> _Exported:
    """Materials of a ``sionna.rt.Scene`` that are used, at a carrier."""
    names, constants, slabs, facts = exported = _Exported({}, {}, {}, {})
    for name in used:
        material = scene.radio_materials[name]
        if absorbs(material):
            names[name], facts[ABSORBER] = ABSORBER, {"absorbs": True}
            continue
        numbers = (material.relative_permittivity, material.conductivity, material.thickness)
        values = dict(zip(PERFECT_CONSTANTS, (float(np.ravel(number)[0]) for number in numbers), strict=True))
        itu: Any = getattr(material, "itu_type", None)
        follows = itu is not None and in_itu_range(itu, frequency_hz)
        new_name = name if follows or itu is None else f"{itu}_{frequency_hz / 1e6:.0f}mhz"
        scattering = scattering_of(material)
        if follows and scattering:
            new_name = f"scattering_{itu}"  # of a name of ITU-R P.2040 Sionna RT drops what is stated of scattering
        names[name] = new_name = plain_name(new_name, ODD_IN_FILES, names.values())
        if follows:
            slabs[new_name] = itu, {"thickness": values["thickness"], **scattering}
        else:
            constants[new_name] = {**values, **scattering}
        if PATTERN in scattering:
            text = "%s: scene.xml cannot state the %s of %s; set it in Python as in %s"
            logger.warning(text, name, PATTERN, new_name, FACTS)
        exponent = conductivity_exponent(material, frequency_hz)
        facts[new_name] = {**values, **scattering, "conductivity_exponent": exponent, "follows_frequency": follows}
    return exported


def write_sionna(source: Source, out: Path, options: ExportOptions) -> dict[str, Any]:
    """Write a scene as a folder for plain Sionna RT (`wrf_mi.apps.exports.source.Write`).

    ``scene.xml`` opens with ``sionna.rt.load_scene``: materials of ITU-R P.2040 follow the frequency and have the
    scene's thicknesses; materials with constants, and those that are not in the range of ITU-R P.2040, have the
    constants of the carrier. ``mitsuba.xml`` has colours alone, for ``mi.load_file`` in any variant. ``materials.json``
    lists the constants at the carrier, and exponents of conductivities. `InputError`: an unknown carrier, a material
    that is neither slab nor absorber, or a folder that exists.
    """
    frequency_hz = source.carrier_hz() if options.frequency_hz is None else options.frequency_hz
    if frequency_hz is None:
        raise InputError(f"{source.name}: a scene; state the carrier of its materials' constants by --frequency HZ")
    scene, stated_m, laws = _loaded(source, options)
    set_frequency(scene, frequency_hz, stated_m, laws)
    check_materials(scene)
    parts = _parts(scene)
    exported = _exported(scene, dict.fromkeys(material for _, material in parts), frequency_hz)
    files = dict[str, tuple[Surface, str]]()
    for surface, material in parts:
        files[plain_name(surface.name, ODD_IN_FILES, files)] = surface, material
    materials = {name: exported.names[material] for name, (_, material) in files.items()}
    with atomic_folder(out, options.replace) as folder:
        (folder / "meshes").mkdir()
        for name, (surface, _) in files.items():
            surface.mesh.export(folder / "meshes" / f"{name}.ply", vertex_normal=False)
        write_atomically(folder / XML, scene_xml(materials, exported.constants, exported.slabs))
        write_atomically(folder / LOOKS, scene_xml(materials, looks=True))
        text = json.dumps({"frequency_hz": frequency_hz, "materials": exported.facts}, indent=1)
        write_atomically(folder / FACTS, f"{text}\n")
    fixed = listed(exported.constants) or "none"
    return {"surfaces": len(parts), "materials": len(exported.facts), f"constants at {frequency_hz / 1e9:g} GHz": fixed}


def write_glb(source: Source, out: Path, options: ExportOptions) -> dict[str, Any]:
    """Write a scene as binary glTF 2.0 (`wrf_mi.apps.exports.source.Write`).

    A node and a mesh for each surface, named like it, and a material for each radio material, named like it. As glTF
    has y up, coordinates x, y, z of the scene are x, z, -y there.
    """
    parts = _parts(_loaded(source, options)[0])
    colours = {name: [*_colour_bytes(name).tolist(), 255] for name in dict.fromkeys(material for _, material in parts)}
    looks = trimesh.visual.material.PBRMaterial
    materials = {name: looks(name=name, baseColorFactor=rgba, **GLTF_LOOKS) for name, rgba in colours.items()}
    scene = trimesh.Scene()
    for surface, material in parts:
        mesh = trimesh.Trimesh(trimesh.transform_points(surface.vertices_m, Y_UP), surface.faces, process=False)
        mesh.visual = trimesh.visual.TextureVisuals(material=materials[material])
        scene.add_geometry(mesh, node_name=surface.name, geom_name=surface.name)
    write_atomically(out, bytes(trimesh.exchange.gltf.export_glb(scene, include_normals=False)))
    return _counts(parts)


def write_mesh(source: Source, out: Path, options: ExportOptions) -> dict[str, Any]:
    """Write a scene as one PLY mesh (`wrf_mi.apps.exports.source.Write`).

    Faces have colours, and the numbers of their ``material`` and ``surface``, whose names are in the header's comments.
    """
    parts = _parts(_loaded(source, options)[0])
    surfaces, materials = zip(*parts, strict=True)
    names = list(dict.fromkeys(materials))
    first = np.cumsum([0, *(len(surface.vertices_m) for surface in surfaces)])
    count = [len(surface.faces) for surface in surfaces]
    mesh = trimesh.Trimesh(
        np.concatenate([surface.vertices_m for surface in surfaces]),
        np.concatenate([surface.faces + at for surface, at in zip(surfaces, first, strict=False)]),
        face_colors=np.repeat(list(map(_colour_bytes, materials)), count, axis=0).astype(np.uint8),
        process=False,
    )
    mesh.face_attributes["material"] = np.repeat(list(map(names.index, materials)), count).astype(np.int32)
    mesh.face_attributes["surface"] = np.repeat(np.arange(len(parts)), count).astype(np.int32)
    comments = ["metres, z up"]
    comments += [f"material {k} {name}" for k, name in enumerate(names)]
    comments += [f"surface {k} {surface.name}" for k, surface in enumerate(surfaces)]
    header, end, content = trimesh.exchange.ply.export_ply(mesh, vertex_normal=False).partition(b"end_header")
    lines = "".join(f"comment {one_line(comment)}\n" for comment in comments)
    write_atomically(out, header + lines.encode() + end + content)
    return _counts(parts)


def _counts(parts: list[tuple[Surface, str]]) -> dict[str, Any]:
    faces, materials = sum(len(surface.faces) for surface, _ in parts), {material for _, material in parts}
    return {"surfaces": len(parts), "faces": faces, "materials": len(materials)}
