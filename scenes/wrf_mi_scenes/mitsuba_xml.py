"""Scene folders that Mitsuba and Sionna RT both open, and their radio materials."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import trimesh
import yaml

from .registry import content_sha256

Parts = Mapping[str, tuple[str, trimesh.Trimesh]]
"""Radio material and mesh of each part of a scene by its name."""

THICKNESS_M: Mapping[str, float] = MappingProxyType(
    {
        "itu_vacuum": 0.1,
        "itu_concrete": 0.25,
        "itu_brick": 0.20,
        "itu_plasterboard": 0.10,
        "itu_ceiling_board": 0.02,
        "itu_wood": 0.03,
        "itu_glass": 0.012,
        "itu_clear_acrylic": 0.01,
        "itu_chipboard": 0.02,
        "itu_plywood": 0.02,
        "itu_marble": 0.03,
        "itu_floorboard": 0.03,
        "itu_vinyl_tile": 0.003,
        "itu_carpet_tile": 0.008,
        "itu_asphalt_concrete": 0.1,
        "itu_metal": 0.002,
        "itu_very_dry_ground": 1.0,
        "itu_medium_dry_ground": 1.0,
        "itu_wet_ground": 1.0,
    }
)
"""Every radio material of ITU-R P.2040 that Sionna RT knows, with a slab thickness in metres: ordinary building
practice. Mitsuba's scene file cannot hold a thickness."""

COLOURS: Mapping[str, str] = MappingProxyType(
    {
        "itu_concrete": "0.45 0.45 0.45",
        "itu_brick": "0.65 0.55 0.45",
        "itu_plasterboard": "0.80 0.80 0.76",
        "itu_ceiling_board": "0.90 0.90 0.88",
        "itu_wood": "0.50 0.33 0.18",
        "itu_glass": "0.55 0.70 0.80",
        "itu_metal": "0.35 0.36 0.40",
    }
)
"""Colours of common materials in Mitsuba's pictures."""

OTHER_COLOUR = "0.60 0.60 0.60"

PERFECT = "perfect"
"""Name of a perfect conductor, which image-method tracers without materials assume, except for the sign of the
field."""
PERFECT_CONDUCTIVITY = 1e13
"""Siemens per metre: so high that the reflection coefficients are -1 and +1 to single precision."""
PERFECT_THICKNESS_M = 0.1
ABSORBER = "perfect_absorber"
"""Name of Sionna RT's absorber, which neither reflects nor transmits and has no constants."""


Constants = Mapping[str, Mapping[str, float]]
"""``relative_permittivity``, ``conductivity`` (S/m) and ``thickness`` (m) of materials by their names; further numbers
are left out of the scene file."""
PERFECT_CONSTANTS = {
    "relative_permittivity": 1.0,
    "conductivity": PERFECT_CONDUCTIVITY,
    "thickness": PERFECT_THICKNESS_M,
}
SCATTERING = ("scattering_coefficient", "xpd_coefficient")  # numbers that a BSDF of Sionna RT may have, too


def scene_xml(
    materials: Mapping[str, str],
    constants: Constants = MappingProxyType({}),
    slabs: Mapping[str, tuple[str, Mapping[str, float]]] = MappingProxyType({}),
    looks: bool = False,
) -> str:
    """The Mitsuba scene file over ``meshes/<part>.ply``.

    Sionna RT replaces the BSDFs ``mat-itu_*`` by its ITU radio materials; Mitsuba uses plain two-sided diffuse BSDFs.
    `PERFECT`, `ABSORBER` and materials with constants are not of ITU-R P.2040, so they are BSDFs of Sionna RT, which
    Mitsuba knows after ``import sionna.rt``.

    Args:
        materials: radio material (``itu_*``, `PERFECT`, `ABSORBER` or a key of ``constants``) of each part by name.
        constants: constants of further materials, and numbers of `SCATTERING`.
        slabs: ITU material (without ``itu_``), and thickness in metres and numbers of `SCATTERING`, of materials; those
            with one are radio materials of Sionna RT with these numbers, as plain ``sionna.rt.load_scene`` takes 0.1 m
            for all others.
        looks: write the colours of all materials and no radio material, for pictures by Mitsuba alone.
    """
    material_constants = {} if looks else {PERFECT: PERFECT_CONSTANTS, **constants}
    lines = ['<scene version="3.0.0">', '    <integrator type="path"/>']
    for material in dict.fromkeys(materials.values()):
        colour = COLOURS.get(material, OTHER_COLOUR)
        look = f'<rgb name="color" value="{colour}"/>'
        if material in material_constants:
            kind = "radio-material"
            content = _floats(material_constants[material])
        elif material == ABSORBER and not looks:
            kind, content = "absorber-radio-material", [look]
        elif material in slabs and not looks:
            itu, numbers = slabs[material]
            kind, content = "itu-radio-material", [f'<string name="type" value="{itu}"/>', *_floats(numbers), look]
        else:
            kind = "twosided"
            content = [f'<bsdf type="diffuse"><rgb name="reflectance" value="{colour}"/></bsdf>']
        lines += [
            f'    <bsdf type="{kind}" id="mat-{material}">',
            *(f"        {line}" for line in content),
            "    </bsdf>",
        ]
    for name, material in materials.items():
        lines += [
            f'    <shape type="ply" id="mesh-{name}">',
            f'        <string name="filename" value="meshes/{name}.ply"/>',
            '        <boolean name="face_normals" value="true"/>',
            f'        <ref id="mat-{material}" name="bsdf"/>',
            "    </shape>",
        ]
    return "\n".join([*lines, "</scene>", ""])


def _floats(numbers: Mapping[str, float]) -> list[str]:
    entries = [(name, value) for name, value in numbers.items() if name in (*PERFECT_CONSTANTS, *SCATTERING)]
    return [f'<float name="{name}" value="{value:.9g}"/>' for name, value in entries]


def write_scene(
    folder: Path, parts: Parts, description: str, origin: str = "wrf_mi_scenes.furnished", xml: str = "scene.xml"
) -> Path:
    """Write parts as a scene folder: the scene file, ``meshes/`` and ``scene.yml``.

    Args:
        folder: path of the folder.
        parts: radio material and mesh of each part by its name.
        description: one line.
        origin: module that made the parts.
        xml: name of the scene file.

    Returns:
        Path of the scene file.
    """
    meshes = folder / "meshes"
    meshes.mkdir(parents=True, exist_ok=True)
    for name, (_, mesh) in parts.items():
        mesh.export(meshes / f"{name}.ply", vertex_normal=False)
    materials = {name: material for name, (material, _) in parts.items()}
    (folder / xml).write_text(scene_xml(materials), encoding="utf-8", newline="\n")
    facts = {
        "description": description,
        "licence": "MIT",
        "origin": f"made by {origin}",
        "frame": "right-handed; x east, y north, z up; origin at the floor's south-west corner",
        "units": "m",
        "xml": xml,
        "thickness_m": {material: THICKNESS_M[material] for material in THICKNESS_M if material in materials.values()},
        "sha256": content_sha256(folder, xml),
    }
    text = yaml.safe_dump(facts, sort_keys=False, width=110)
    (folder / "scene.yml").write_text(text, encoding="utf-8", newline="\n")
    return folder / xml
