"""A made-up furnished room, and its bare walls as measured.

The furnished room is the `laboratory` with more furniture, some of it turned against the walls. The measured room has
walls, floor and ceiling alone, of a single generic material, each plane off by the error of the measurement.
"""

from __future__ import annotations

import numpy as np
import trimesh

from .build_laboratory import HEIGHT, LENGTH, WIDTH, Mesh, box, joined, laboratory_parts, sheet, table, wall
from .mitsuba_xml import Parts

GENERIC = "itu_concrete"
"""Material of every surface of the measured room."""


def turned(mesh: Mesh, degrees: float, place: tuple[float, float]) -> Mesh:
    """A mesh around the z axis, turned about it and then moved along x and y (metres)."""
    matrix = trimesh.transformations.rotation_matrix(np.radians(degrees), [0, 0, 1])
    matrix[:2, 3] = place
    moved = mesh.copy()
    moved.apply_transform(matrix)
    return moved


def _chair() -> Mesh:
    seat, back = sheet(2, 0.45, (-0.22, 0.22), (-0.22, 0.22)), sheet(1, 0.22, (-0.2, 0.2), (0.5, 0.95))
    return joined([seat, back])


def furnished_parts() -> Parts:
    """Name of each part of the furnished room with its material and mesh, in metres."""
    chairs = [(4.3, 2.25, 10.0), (4.7, 5.3, 195.0), (1.4, 5.1, -80.0), (7.4, 5.75, 170.0), (2.4, 3.6, 40.0)]
    screens = [(4.2, 1.4, 25.0), (5.0, 6.05, 190.0), (0.45, 4.9, -70.0)]
    return {
        **laboratory_parts(),
        "chairs": ("itu_wood", joined([turned(_chair(), a, (x, y)) for x, y, a in chairs])),
        "screens": (
            "itu_metal",
            joined([turned(box((-0.3, -0.02, 0.85), (0.3, 0.02, 1.2)), a, (x, y)) for x, y, a in screens]),
        ),
        "rack": ("itu_metal", turned(box((-0.3, -0.35, 0.0), (0.3, 0.35, 1.6)), 25.0, (1.6, 6.3))),
        "divider": ("itu_chipboard", turned(sheet(1, 0.0, (-0.8, 0.8), (0.1, 1.6)), 35.0, (5.6, 3.9))),
        "bench": ("itu_wood", turned(table((-0.7, 0.7), (-0.3, 0.3), 0.9), -20.0, (2.9, 4.6))),
        "lamps": (
            "itu_metal",
            joined([sheet(2, 2.7, (x, x + 1.2), (y, y + 0.3)) for x in (1.5, 4.5) for y in (1.8, 4.6)]),
        ),
    }


def measured_parts(error_m: float, seed: int) -> Parts:
    """The bare walls, all of `GENERIC`, each plane displaced by an error of a standard deviation in metres."""
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
