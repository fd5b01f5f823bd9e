"""Opening of Sionna RT scenes from a name, a scene folder, a Mitsuba XML or a bare mesh."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from wrf_mi_scenes import scenes
from wrf_mi_scenes.mitsuba_xml import PERFECT, THICKNESS_M

from ... import backend
from ...core import InputError
from ...core.yaml_files import read_yaml
from ...scene.coordinates import require_near, warn_of_up
from ...scene.folder import FACTS_FILE, read_scene_folder, scene_file
from ...scene.materials import FILE as MATERIALS_FILE
from ...scene.materials import thicknesses
from ...scene.mesh.files import mesh_parts
from ...scene.mesh.surfaces import sampled
from ...scene.xml_file import read_scene_xml
from .materials import perfect_reflector, set_frequency
from .scene_shapes import check_materials, load_checked, plain_ply, replace_shapes

MESHES = (".stl", ".ply", ".obj", ".glb")
HIGHEST_M = 500.0  # height above which a scene counts as one in millimetres


def open_scene(
    source: str | Path,
    frequency_hz: float,
    thickness_m: Mapping[str, float] | None = None,
    material: str | None = None,
) -> Any:
    """Open a scene in Sionna RT at a carrier frequency.

    Args:
        source: name of a scene that comes with the package, a scene folder, a Mitsuba XML whose BSDFs are radio
            materials (``mat-itu_*``), or a mesh (``.stl``, ``.ply``, ``.obj``, ``.glb``) in metres, z up (GLB: y up).
        frequency_hz: carrier frequency; below a material's range see `set_frequency`.
        thickness_m: slab thickness of materials by name, metres, in place of the scene's.
        material: radio material of a mesh, a name of ITU-R P.2040 (``concrete`` or ``itu_concrete``) or ``perfect``.

    Returns:
        A ``sionna.rt.Scene``.

    Raises:
        InputError: an unknown name, a file that cannot be opened, no surface, coordinates in millimetres or too
            far from the origin, or a material that is missing, unknown or superfluous.
    """
    scene, stated_m, laws = load_scene(source, material)
    set_frequency(scene, frequency_hz, {**stated_m, **(thickness_m or {})}, laws)
    return scene


def load_scene(
    source: str | Path, material: str | None = None
) -> tuple[Any, dict[str, float], dict[str, tuple[float, float]]]:
    """Load a scene in Sionna RT without setting its frequency, with the arguments and errors of `open_scene`.

    Returns a ``sionna.rt.Scene``, and thicknesses and laws of its materials as `set_frequency` takes them.
    """
    backend.init()
    path, stated_m, laws = Path(source), dict[str, float](), dict[str, tuple[float, float]]()
    if not path.exists() and (known := scenes().get(str(source))):
        path, stated_m = known.xml, known.thickness_m
    elif path.is_dir():
        path, stated_m, laws = _folder(path)
    if not path.is_file():
        ways = f"a name ({', '.join(scenes())}), a scene folder, a Mitsuba XML or a mesh ({', '.join(MESHES)})"
        raise InputError(f"{source}: no such scene file; give {ways}")
    mesh = path.suffix.lower() in MESHES
    if mesh and material is None:
        raise InputError(f"{source}: a mesh has no radio material; give one, such as concrete, or {PERFECT}")
    if not mesh and material is not None:
        raise InputError(f"{source}: has radio materials of its own; leave out the material {material}")
    try:
        return _checked(path, source, material if mesh else None), stated_m, laws
    except InputError as error:
        raise InputError(f"{error} (wrf-mi check {source} names every fault)") from None


def _checked(path: Path, source: str | Path, material: str | None) -> Any:
    """A ``sionna.rt.Scene`` of a scene file, or of a mesh with a material; `InputError` for one that traces wrongly."""
    scene = _from_xml(path) if material is None else _from_mesh(path, material)
    if not scene.objects:
        raise InputError(f"{source}: holds no surface; give a scene with triangles")
    bounds = scene.mi_scene.bbox()
    corners_m = np.array([bounds.min, bounds.max], float).reshape(2, 3)
    if (height := float(bounds.max.z - bounds.min.z)) > HIGHEST_M:
        text = f"{height:.0f} m high, as if in millimetres"
        raise InputError(f"{source}: {text}; scale the coordinates to metres (multiply by 0.001)")
    require_near(corners_m, source)
    return scene


def _folder(folder: Path) -> tuple[Path, dict[str, float], dict[str, tuple[float, float]]]:
    """Scene file, thicknesses and laws of a scene folder, from a scan or like those that come with the package."""
    if (folder / MATERIALS_FILE).is_file():
        read = read_scene_folder(folder)
        return read.xml, dict(read.materials.thickness_m), read.materials.laws
    file = folder / FACTS_FILE
    if not file.exists():
        raise InputError(f"{folder}: no {FACTS_FILE} in it, so not a scene folder; give one, or a file")
    facts = read_yaml(file)
    return scene_file(folder, facts), thicknesses(file, facts.get("thickness_m") or {}), {}


def _from_xml(path: Path) -> Any:
    root = read_scene_xml(path)
    check_materials(root, path)
    with tempfile.TemporaryDirectory() as folder:
        replace_shapes(root, path, Path(folder))
        return load_checked(root, path, Path(folder))


def _from_mesh(path: Path, material: str) -> Any:
    from sionna import rt

    if material == PERFECT:
        radio_material: Any = perfect_reflector()
    else:
        name = f"itu_{material.removeprefix('itu_')}"
        if name not in THICKNESS_M:
            known = ", ".join(itu.removeprefix("itu_") for itu in THICKNESS_M)
            raise InputError(f"material {material!r}: unknown; give {PERFECT} or one of ITU-R P.2040: {known}")
        kind = name.removeprefix("itu_")
        radio_material = rt.ITURadioMaterial(name, kind, THICKNESS_M[name])
    parts, scene = mesh_parts(path), rt.load_scene()
    if parts:
        triangles = np.concatenate([np.asarray(part.triangles) for part in parts])
        warn_of_up(sampled(triangles), path)
    with tempfile.TemporaryDirectory() as folder:
        objects = []
        for index, part in enumerate(parts):
            stem = path.stem.replace(".", "_")  # Mitsuba's names have no dots
            name = stem if len(parts) == 1 else f"{stem}_{index}"
            file = Path(folder) / f"{name}.ply"
            file.write_bytes(plain_ply(part))
            objects.append(rt.SceneObject(fname=str(file), name=name, radio_material=radio_material))
        if objects:
            scene.edit(add=objects)
    return scene
