"""Furnished rooms drawn from a seed: size, materials, furniture and the place of an access point.

A room is 3 to 12 m long and wide and has 5 to 20 pieces of furniture that stand apart, half of them turned against the
walls. One room in four is of perfect conductors, as the image method has them; all others have building materials.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh

from .build_laboratory import Mesh, box, sheet, table
from .furnished import turned
from .mitsuba_xml import PERFECT, Parts

LEAST_M, MOST_M = 3.0, 12.0
"""Range of length and width, metres."""
HEIGHTS_M = 2.4, 4.0
FEWEST, MOST = 5, 20
"""Range of the number of pieces of furniture."""
AREA_M2 = 1.2
"""Least floor area of a piece of furniture, metres squared: small rooms hold fewer pieces."""
GAP_M = 0.1
"""Least distance between pieces, and from the walls, metres."""
PERFECT_SHARE = 0.25
"""Share of rooms of perfect conductors."""
MOUNTED_M = 0.08
"""Distance of an access point's antenna from the ceiling or wall that it is mounted on, metres."""
CLEAR_M = 0.4
"""Least distance of an access point from furniture, metres."""
SHELL = ("itu_concrete", "itu_brick", "itu_plasterboard", "itu_glass", "itu_wood")
FURNITURE = ("itu_metal", "itu_wood", "itu_glass", "itu_chipboard", "itu_plasterboard")
MOUNTS = ("ceiling", "wall", "free")


@dataclass(frozen=True)
class RandomRoom:
    """A furnished room.

    Attributes:
        parts: material and mesh of each surface and piece of furniture by its name, metres.
        size_m: length, width and height, metres; the origin is the floor's south-west corner.
        mount: place of the access point, one of `MOUNTS`.
        station_m: position of the access point [3], metres.
        perfect: whether all surfaces are perfect conductors.
    """

    parts: Parts
    size_m: tuple[float, float, float]
    mount: str
    station_m: tuple[float, float, float]
    perfect: bool


def random_room(seed: int) -> RandomRoom:
    """The room of a seed."""
    rng = np.random.default_rng([seed, 0])
    length, width = rng.uniform(LEAST_M, MOST_M, 2)
    size = np.array([length, width, rng.uniform(*HEIGHTS_M)])
    perfect = bool(rng.random() < PERFECT_SHARE)
    pieces = _furniture(size, rng)
    x, y, z = ((0.0, float(side)) for side in size)
    shell = {
        "floor": sheet(2, 0.0, x, y),
        "ceiling": sheet(2, z[1], x, y),
        "wall_west": sheet(0, 0.0, y, z),
        "wall_east": sheet(0, x[1], y, z),
        "wall_south": sheet(1, 0.0, x, z),
        "wall_north": sheet(1, y[1], x, z),
    }
    meshes = {**shell, **{f"piece_{number:02d}": mesh for number, mesh in enumerate(pieces, 1)}}
    drawn = {name: str(rng.choice(SHELL if name in shell else FURNITURE)) for name in meshes}
    parts = {name: (PERFECT if perfect else drawn[name], mesh) for name, mesh in meshes.items()}
    mount = str(rng.choice(MOUNTS))
    station = _station(size, mount, pieces, rng)
    return RandomRoom(parts, (x[1], y[1], z[1]), mount, station, perfect)


def _furniture(size_m: np.ndarray, rng: np.random.Generator) -> list[Mesh]:
    """Pieces whose bounding boxes lie apart and in the room."""
    count = min(int(rng.integers(FEWEST, MOST + 1)), max(FEWEST, int(size_m[0] * size_m[1] / AREA_M2)))
    pieces: list[Mesh] = []
    while len(pieces) < count:
        mesh = turned(_piece(rng), rng.choice([0.0, 90.0, rng.uniform(0, 180)], p=[0.25, 0.25, 0.5]), (0.0, 0.0))
        low, high = mesh.bounds
        first, last = GAP_M - low[:2], size_m[:2] - GAP_M - high[:2]
        if (first > last).any() or high[2] > size_m[2] - GAP_M:
            continue
        mesh.apply_translation([*rng.uniform(first, last), 0.0])
        apart = [
            ((mesh.bounds[0] > other.bounds[1] + GAP_M) | (other.bounds[0] > mesh.bounds[1] + GAP_M))[:2].any()
            for other in pieces
        ]
        if all(apart):
            pieces.append(mesh)
    return pieces


def _piece(rng: np.random.Generator) -> Mesh:
    """A cabinet, a low box, a table, or an upright board, about the z axis."""
    kind = rng.choice(["cabinet", "box", "table", "board"])
    long, deep = rng.uniform(0.5, 1.6), rng.uniform(0.3, 0.8)
    if kind == "table":
        return table((-long / 2, long / 2), (-deep / 2, deep / 2), rng.uniform(0.4, 1.1))
    if kind == "board":
        foot = rng.uniform(0.1, 0.8)
        return sheet(1, 0.0, (-long / 2, long / 2), (foot, foot + rng.uniform(0.6, 1.4)))
    top = rng.uniform(1.0, 2.1) if kind == "cabinet" else rng.uniform(0.3, 0.8)
    # Closed bodies stand clear of the floor: a face within it would be met twice.
    return box((-long / 2, -deep / 2, 0.03), (long / 2, deep / 2, top))


def _station(
    size_m: np.ndarray, mount: str, pieces: list[trimesh.Trimesh], rng: np.random.Generator
) -> tuple[float, float, float]:
    """Position of the access point, clear of furniture."""
    low, high = np.array([0.4, 0.4, 1.2]), size_m - [0.4, 0.4, 0.3]
    while True:
        place = rng.uniform(low, high)
        if mount == "ceiling":
            place[2] = size_m[2] - MOUNTED_M
        elif mount == "wall":
            axis, side = rng.integers(2, size=2)
            place[axis] = MOUNTED_M if side == 0 else size_m[axis] - MOUNTED_M
        place = np.round(place, 4)
        near = [((place > piece.bounds[0] - CLEAR_M) & (place < piece.bounds[1] + CLEAR_M)).all() for piece in pieces]
        if not any(near):
            return float(place[0]), float(place[1]), float(place[2])
