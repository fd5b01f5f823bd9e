"""Builds the `laboratory` scene: a room of 9 x 7 x 3 m with furniture and a small inner room.

Run ``python -m wrf_mi_scenes.build_laboratory`` after a change; it rewrites ``laboratory/``. The room is made up.
Walls, boards and panes are single sheets, because Sionna RT treats a surface as a slab whose thickness belongs to the
material (`mitsuba_xml.THICKNESS_M`); only the metal cabinets are closed boxes.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path
from typing import cast

import numpy as np
import trimesh

from .mitsuba_xml import Parts, write_scene

LENGTH, WIDTH, HEIGHT = 9.0, 7.0, 3.0
"""The room's inner size along x, y and z in metres; the origin is the floor's south-west corner."""

Span = tuple[float, float]
Mesh = trimesh.Trimesh


def sheet(axis: int, at: float, first: Span, second: Span) -> Mesh:
    """A rectangle across ``axis`` (0 = x, 1 = y, 2 = z) at coordinate ``at``.

    ``first`` and ``second`` are its extents along the other two axes in ascending order.
    """
    others = [a for a in range(3) if a != axis]
    corners = np.full((4, 3), float(at))
    corners[:, others[0]] = [first[0], first[1], first[1], first[0]]
    corners[:, others[1]] = [second[0], second[0], second[1], second[1]]
    return Mesh(vertices=corners, faces=[[0, 1, 2], [0, 2, 3]], process=False)


def wall(axis: int, at: float, along: Span, up: Span, openings: Iterable[tuple[Span, Span]] = ()) -> Mesh:
    """An upright wall with rectangular openings, each given by its extents along the wall and in height.

    The openings may not overlap along the wall.
    """
    pieces: list[Mesh] = []
    start = along[0]
    for (left, right), (low, high) in sorted(openings):
        if left > start:
            pieces.append(sheet(axis, at, (start, left), up))
        if low > up[0]:
            pieces.append(sheet(axis, at, (left, right), (up[0], low)))
        if high < up[1]:
            pieces.append(sheet(axis, at, (left, right), (high, up[1])))
        start = right
    if start < along[1]:
        pieces.append(sheet(axis, at, (start, along[1]), up))
    return joined(pieces)


def joined(meshes: Iterable[Mesh]) -> Mesh:
    """One mesh of several."""
    return cast(Mesh, trimesh.util.concatenate(list(meshes)))


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> Mesh:
    """A closed box between two corners."""
    return trimesh.creation.box(bounds=[low, high])


def table(x: Span, y: Span, top: float) -> Mesh:
    """A table: its top and one closed side panel at each end of its longer side."""
    longer = 0 if x[1] - x[0] >= y[1] - y[0] else 1
    ends, across = (x, y) if longer == 0 else (y, x)
    panels = [sheet(longer, end, across, (0.0, top)) for end in (ends[0] + 0.1, ends[1] - 0.1)]
    return joined([sheet(2, top, x, y), *panels])


def shelf(x: Span, y: Span, boards: Iterable[float], top: float, back_axis: int, back_at: float) -> Mesh:
    """A metal shelf: boards at the given heights and a back sheet."""
    back = sheet(back_axis, back_at, y if back_axis == 0 else x, (0.0, top))
    return joined([back, *(sheet(2, z, x, y) for z in boards)])


def laboratory_parts() -> Parts:
    """Name of each part with its material and mesh, in metres."""
    x, y, z = (0.0, LENGTH), (0.0, WIDTH), (0.0, HEIGHT)
    windows = [((1.0, 3.4), (0.9, 2.4)), ((4.0, 5.4), (0.9, 2.4))]
    door = ((7.7, 8.6), (0.0, 2.1))
    # The inner room takes the north-east corner: a wall along x with a pane, one along y with a doorway.
    inner_x, inner_y = 6.2, 5.0
    pane = ((6.8, 8.2), (1.0, 2.2))
    doorway = ((5.3, 6.2), (0.0, 2.1))
    return {
        "floor": ("itu_concrete", sheet(2, 0.0, x, y)),
        "ceiling": ("itu_ceiling_board", sheet(2, HEIGHT, x, y)),
        "wall_south": ("itu_brick", wall(1, 0.0, x, z, [door])),
        "wall_north": ("itu_brick", wall(1, WIDTH, x, z, windows)),
        "wall_west": ("itu_brick", wall(0, 0.0, y, z)),
        "wall_east": ("itu_brick", wall(0, LENGTH, y, z)),
        "windows": ("itu_glass", joined([sheet(1, WIDTH, *w) for w in windows])),
        "door": ("itu_wood", sheet(1, 0.0, *door)),
        "inner_room": (
            "itu_plasterboard",
            joined(
                [
                    wall(1, inner_y, (inner_x, LENGTH), z, [pane]),
                    wall(0, inner_x, (inner_y, WIDTH), z, [doorway]),
                ]
            ),
        ),
        "inner_pane": ("itu_glass", sheet(1, inner_y, *pane)),
        "tables": (
            "itu_wood",
            joined(
                [
                    table((3.4, 5.2), (1.1, 1.9), 0.74),
                    table((3.8, 5.6), (5.6, 6.4), 0.74),
                    table((0.2, 1.0), (4.2, 6.0), 0.74),
                    table((6.6, 8.4), (6.1, 6.9), 0.74),
                ]
            ),
        ),
        "shelves": (
            "itu_metal",
            joined(
                [
                    shelf((0.05, 0.45), (0.6, 2.4), (0.2, 0.7, 1.2, 1.7), 1.9, 0, 0.05),
                    shelf((5.0, 6.6), (0.05, 0.45), (0.2, 0.8, 1.4), 1.8, 1, 0.05),
                ]
            ),
        ),
        "cabinets": (
            "itu_metal",
            joined([box((8.5, 0.9, 0.0), (8.95, 2.1, 1.9)), box((3.2, 0.05, 0.0), (4.95, 0.5, 2.0))]),
        ),
        "whiteboard": ("itu_metal", sheet(0, 0.02, (2.8, 4.0), (0.9, 2.1))),
    }


def build(folder: Path) -> None:
    """Write the scene's files into a folder: ``laboratory.xml``, ``meshes/*.ply`` and ``scene.yml``."""
    description = "Made-up laboratory, 9 x 7 x 3 m: brick walls, windows, tables, metal shelves, an inner room"
    write_scene(folder, laboratory_parts(), description, "wrf_mi_scenes.build_laboratory", "laboratory.xml")


def main() -> None:
    """Write the scene into the package, or into another folder."""
    parser = argparse.ArgumentParser(description="Build the laboratory scene.")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "laboratory")
    build(parser.parse_args().out)


if __name__ == "__main__":
    main()
