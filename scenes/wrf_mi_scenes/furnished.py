"""Two descriptions of one made-up room: as it is, furnished, and as somebody measured its bare walls.

The furnished room is the `laboratory` with more furniture in it, some of it turned against the walls. The measured one
has its walls, floor and ceiling alone: without furniture, windows and doors, of one generic material, and each plane
off by the error of the measurement. A model that is given the second has to make up for what it lacks.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import trimesh
import yaml

from .build_laboratory import HEIGHT, LENGTH, WIDTH, Mesh, box, laboratory_parts, sheet, table, wall
from .mitsuba_xml import THICKNESS_M, scene_xml
from .registry import content_sha256

SHELL = ("floor", "ceiling", "wall_south", "wall_north", "wall_west", "wall_east")
"""Parts of the furnished room that bound it."""
GENERIC = "itu_concrete"
"""What every surface of the measured room is said to be of."""

Parts = Mapping[str, tuple[str, Mesh]]


def turned(mesh: Mesh, degrees: float, place: tuple[float, float]) -> Mesh:
    """A mesh around the z axis, turned about it and then moved along x and y (metres)."""
    matrix = trimesh.transformations.rotation_matrix(np.radians(degrees), [0, 0, 1])
    matrix[:2, 3] = place
    moved = mesh.copy()
    moved.apply_transform(matrix)
    return moved


def _chair() -> Mesh:
    seat, back = sheet(2, 0.45, (-0.22, 0.22), (-0.22, 0.22)), sheet(1, 0.22, (-0.2, 0.2), (0.5, 0.95))
    return trimesh.util.concatenate([seat, back])


def furnished_parts() -> dict[str, tuple[str, Mesh]]:
    """Name of each part of the furnished room with its material and mesh, in metres."""
    chairs = [(4.3, 2.25, 10.0), (4.7, 5.3, 195.0), (1.4, 5.1, -80.0), (7.4, 5.75, 170.0), (2.4, 3.6, 40.0)]
    screens = [(4.2, 1.4, 25.0), (5.0, 6.05, 190.0), (0.45, 4.9, -70.0)]
    return laboratory_parts() | {
        "chairs": ("itu_wood", trimesh.util.concatenate([turned(_chair(), a, (x, y)) for x, y, a in chairs])),
        "screens": (
            "itu_metal",
            trimesh.util.concatenate(
                [turned(box((-0.3, -0.02, 0.85), (0.3, 0.02, 1.2)), a, (x, y)) for x, y, a in screens]
            ),
        ),
        "rack": ("itu_metal", turned(box((-0.3, -0.35, 0.0), (0.3, 0.35, 1.6)), 25.0, (1.6, 6.3))),
        "divider": ("itu_chipboard", turned(sheet(1, 0.0, (-0.8, 0.8), (0.1, 1.6)), 35.0, (5.6, 3.9))),
        "bench": ("itu_wood", turned(table((-0.7, 0.7), (-0.3, 0.3), 0.9), -20.0, (2.9, 4.6))),
        "lamps": (
            "itu_metal",
            trimesh.util.concatenate(
                [sheet(2, 2.7, (x, x + 1.2), (y, y + 0.3)) for x in (1.5, 4.5) for y in (1.8, 4.6)]
            ),
        ),
    }


def measured_parts(error_m: float, seed: int) -> dict[str, tuple[str, Mesh]]:
    """The bare walls with the measurement's error, all of `GENERIC`.

    Args:
        error_m: standard deviation of each plane's displacement along its normal, metres.
        seed: of the displacements.
    """
    rng = np.random.default_rng(seed)
    off = rng.normal(0, error_m, 8)
    x, y, z = (off[0], LENGTH + off[1]), (off[2], WIDTH + off[3]), (off[4], HEIGHT + off[5])
    inner_x, inner_y = 6.2 + off[6], 5.0 + off[7]
    meshes = {
        "floor": sheet(2, z[0], x, y),
        "ceiling": sheet(2, z[1], x, y),
        "wall_south": sheet(1, y[0], x, z),
        "wall_north": sheet(1, y[1], x, z),
        "wall_west": sheet(0, x[0], y, z),
        "wall_east": sheet(0, x[1], y, z),
        "inner_wall_south": sheet(1, inner_y, (inner_x, x[1]), z),
        "inner_wall_west": wall(0, inner_x, (inner_y, y[1]), z, [((5.3, 6.2), (z[0], 2.1))]),
    }
    return {name: (GENERIC, mesh) for name, mesh in meshes.items()}


def write_scene(folder: Path, parts: Parts, description: str, origin: str = "wrf_mi_scenes.furnished") -> Path:
    """Write parts as a scene folder that Mitsuba and Sionna RT both open: ``scene.xml``, ``meshes/`` and ``scene.yml``.

    Args:
        folder: to write into.
        parts: radio material and mesh of each part by its name.
        description: one line.
        origin: the module that made them.

    Returns:
        The scene file.
    """
    meshes = folder / "meshes"
    meshes.mkdir(parents=True, exist_ok=True)
    for name, (_, mesh) in parts.items():
        mesh.export(meshes / f"{name}.ply", vertex_normal=False)
    materials = {name: material for name, (material, _) in parts.items()}
    xml = folder / "scene.xml"
    xml.write_text(scene_xml(materials), encoding="utf-8", newline="\n")
    facts = {
        "description": description,
        "licence": "MIT",
        "origin": f"made by {origin}",
        "frame": "right-handed; x east, y north, z up; origin at the floor's south-west corner",
        "units": "m",
        "xml": xml.name,
        "thickness_m": {material: THICKNESS_M[material] for material in THICKNESS_M if material in materials.values()},
        "sha256": content_sha256(folder, xml.name),
    }
    text = yaml.safe_dump(facts, sort_keys=False, width=110)
    (folder / "scene.yml").write_text(text, encoding="utf-8", newline="\n")
    return xml
