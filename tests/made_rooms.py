"""Small rooms of known planes, and points on them as a scanner would see or measure them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import trimesh
from wrf_mi_scenes.build_laboratory import box, sheet, wall
from wrf_mi_scenes.mitsuba_xml import scene_xml

Mesh = trimesh.Trimesh


def closed_box(x: float = 5.0, y: float = 4.0, z: float = 2.8) -> list[Mesh]:
    """Floor, ceiling and four walls, the origin in a corner."""
    return [box((0, 0, 0), (x, y, z))]


def l_shape(z: float = 2.7) -> list[Mesh]:
    """A room of 6 x 5 m less a quarter of 3 x 2.5 m."""
    flat = [(0.0, 6.0), (0.0, 2.5)], [(0.0, 3.0), (2.5, 5.0)]
    parts = [sheet(2, h, *span) for h in (0.0, z) for span in flat]
    across_x, across_y = (
        {0.0: (0.0, 5.0), 6.0: (0.0, 2.5), 3.0: (2.5, 5.0)},
        {0.0: (0.0, 6.0), 2.5: (3.0, 6.0), 5.0: (0.0, 3.0)},
    )
    return parts + [
        sheet(k, at, span, (0.0, z)) for k, of in enumerate((across_x, across_y)) for at, span in of.items()
    ]


def attic(x: float = 5.0, y: float = 4.0, low: float = 2.2, high: float = 3.4) -> list[Mesh]:
    """A room whose ceiling rises from ``low`` at y = 0 to ``high``."""
    v = np.array(
        [(0, 0, 0), (x, 0, 0), (x, y, 0), (0, y, 0), (0, 0, low), (x, 0, low), (x, y, high), (0, y, high)], float
    )
    quads = [(0, 1, 2, 3), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)]
    faces = [f for a, b, c, d in quads for f in ((a, b, c), (a, c, d))]
    return [Mesh(v, faces, process=False)]


def two_rooms(z: float = 2.6) -> list[Mesh]:
    """Rooms of 4 x 4 m and 3 x 4 m on both sides of a partition of 12 cm with a doorway of 0.9 x 2.1 m."""
    door = ((1.5, 2.4), (0.0, 2.1))
    x, y, up = (0.0, 7.12), (0.0, 4.0), (0.0, z)
    return [
        sheet(2, 0.0, x, y),
        sheet(2, z, x, y),
        *(sheet(1, at, x, up) for at in y),
        *(sheet(0, at, y, up) for at in x),
        *(wall(0, at, y, up, [door]) for at in (4.0, 4.12)),
    ]


def joined(parts: Sequence[Mesh]) -> Mesh:
    """One mesh of all parts."""
    mesh: Any = trimesh.util.concatenate(list(parts))
    return mesh


def sampled(parts, count=150000, noise_m=0.01, strays=0.01, seed=1):
    """Points [n, 3] spread evenly over all surfaces, with noise across them, and strays all over the room."""
    rng = np.random.default_rng(seed)
    mesh = joined(parts)
    points, face = trimesh.sample.sample_surface(mesh, count, seed=seed)
    points = points + mesh.face_normals[face] * rng.normal(0, noise_m, count)[:, None]
    low, high = mesh.bounds
    return np.concatenate([points, rng.uniform(low, high, (int(strays * count), 3))])


def scene_file(folder: Path, parts: list[Mesh]) -> Path:
    """The parts as a Mitsuba scene file."""
    (folder / "meshes").mkdir(parents=True, exist_ok=True)
    names = [f"part_{i}" for i in range(len(parts))]
    for name, mesh in zip(names, parts, strict=True):
        mesh.export(folder / "meshes" / f"{name}.ply", vertex_normal=False)
    (folder / "room.xml").write_text(scene_xml(dict.fromkeys(names, "itu_concrete")), encoding="utf-8")
    return folder / "room.xml"


def write_las(file, points, scale=0.001, vlrs=(), mark=None, **version):
    """Points in steps of a scale, with records on their coordinates; ``mark`` sets their classes and flags."""
    header = laspy.LasHeader(**({"point_format": 0, "version": "1.2"} | version))
    header.scales, header.offsets = np.full(3, scale), np.floor(points.min(axis=0))
    header.vlrs.extend(vlrs)
    cloud = laspy.LasData(header)
    cloud.xyz = points
    if mark is not None:
        mark(cloud)
    cloud.write(file)
    return file


def by_kind(surfaces: list[Any]) -> dict[str, list[Any]]:
    """Surfaces by their kind."""
    return {kind: [s for s in surfaces if s.kind == kind] for kind in ("floor", "ceiling", "wall", "other")}
