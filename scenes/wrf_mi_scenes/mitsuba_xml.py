"""The Mitsuba scene file that Mitsuba and Sionna RT both open, and the radio materials that it may name."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

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
"""What common materials look like when Mitsuba renders the scene."""

OTHER_COLOUR = "0.60 0.60 0.60"

PERFECT = "perfect"
"""Name of a perfect conductor, which reflects without loss and lets nothing pass: what image-method tracers without
materials assume, but for the sign of the field."""
PERFECT_CONDUCTIVITY = 1e13
"""Siemens per metre: so high that the reflection coefficients are -1 and +1 to single precision."""
PERFECT_THICKNESS_M = 0.1


def scene_xml(materials: Mapping[str, str]) -> str:
    """The Mitsuba scene file over ``meshes/<part>.ply``.

    The BSDF names ``mat-itu_*`` are what Sionna RT turns into its ITU radio materials; Mitsuba itself sees
    plain two-sided diffuse ones. `PERFECT` is no material of ITU-R P.2040, so it is Sionna RT's own BSDF with explicit
    constants, which Mitsuba knows after ``import sionna.rt``.

    Args:
        materials: radio material (``itu_*`` or `PERFECT`) of each part, by the part's name.
    """
    lines = ['<scene version="3.0.0">', '    <integrator type="path"/>']
    for material in dict.fromkeys(materials.values()):
        colour = COLOURS.get(material, OTHER_COLOUR)
        if material == PERFECT:
            lines += [
                f'    <bsdf type="radio-material" id="mat-{PERFECT}">',
                '        <float name="relative_permittivity" value="1"/>',
                f'        <float name="conductivity" value="{PERFECT_CONDUCTIVITY:g}"/>',
                f'        <float name="thickness" value="{PERFECT_THICKNESS_M:g}"/>',
                "    </bsdf>",
            ]
            continue
        lines += [
            f'    <bsdf type="twosided" id="mat-{material}">',
            f'        <bsdf type="diffuse"><rgb name="reflectance" value="{colour}"/></bsdf>',
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
