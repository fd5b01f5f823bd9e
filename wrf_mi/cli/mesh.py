"""``wrf-mi mesh``."""

from __future__ import annotations

import argparse
from typing import Any

from .options import Arguments, add_command
from .output import show


def add_parser(commands: Any) -> None:
    """Add ``mesh`` to the commands."""
    text = "make a scene for both tracers from a LiDAR scan, a plan or a mesh"
    parser = add_command(commands, "mesh", mesh_command, text)
    add = parser.add_argument
    add("points", metavar="POINTS", help="scan (PLY, LAS, LAZ, XYZ, NPZ), plan (NPZ, PNG, ROS map YAML, CSV) or mesh")
    add("--out", required=True, metavar="DIR", help="scene folder to make")
    add("--units", default="m", help="unit of the coordinates: m (default), cm, mm or ft")
    add("--up", choices=("y", "z"), help="axis that is up in a scan or mesh (default: y in GLB, else z)")
    text = "point of the source, metres, z up, that becomes the origin, such as 701300,4485500,0"
    add("--origin", type=_point, metavar="X,Y,Z", help=text)
    add("--height", type=float, metavar="M", help="height from floor to ceiling; required for a plan")
    add("--floor", type=float, default=0.0, metavar="M", help="z of a plan's floor (default: 0)")
    add("--resolution", type=float, metavar="M", help="side of a plan's cell where the file has none")
    text = "side of the plan at which the first row of an NPZ grid lies, where the file does not state row_0"
    add("--row-0", choices=("top", "bottom"), help=text)
    add("--materials", metavar="FILE", help="materials.yml with rules and exceptions")
    add("--register-pairs", metavar="CSV", help="move by pairs of points: x,y[,z],to_x,to_y[,to_z]")
    add("--register-walls", metavar="CSV", help="move so that walls lie on those of a layout: x,y")
    text = "measured positions x,y[,z] in the scene's frame: refuse a plan that fits them better when mirrored"
    add("--positions", metavar="CSV", help=text)
    add("--replace", action="store_true", help="replace an existing scene folder")


def mesh_command(a: Arguments) -> int:
    """Make a scene folder."""
    from ..scene.make import make_scene
    from ..scene.register import read_pairs, register_pairs

    pairs = None if a.register_pairs is None else register_pairs(*read_pairs(a.register_pairs), name=a.register_pairs)
    scene = make_scene(
        a.points,
        a.out,
        units=a.units,
        up=a.up,
        origin_m=a.origin,
        materials=a.materials,
        height_m=a.height,
        floor_m=a.floor,
        resolution_m=a.resolution,
        registration=pairs,
        register_walls_of=a.register_walls,
        positions=a.positions,
        row_0=a.row_0,
        replace=a.replace,
    )
    kinds = list(scene.materials.surfaces.values())
    counts = {kind: kinds.count(kind) for kind in ("floor", "ceiling", "wall", "other")}
    facts = {"scene": str(scene.folder), "xml": str(scene.xml), "surfaces": counts, "counts": scene.counts}
    lines = [", ".join(f"{count} {kind}" for kind, count in counts.items()) + f": {scene.folder}"]
    if a.origin is not None:
        point = ", ".join(f"{value:.12g}" for value in a.origin)
        lines.append(f"origin: {point}; subtract it from the positions of the measurements, too")
    lines.append(f"materials: {scene.folder / 'materials.yml'}\npicture: {scene.folder / 'preview.png'}")
    return show(a.json, {**facts, "origin_m": a.origin}, "\n".join(lines))


def _point(text: str) -> tuple[float, ...]:
    try:
        values = tuple(float(value) for value in text.split(","))
    except ValueError:
        values = ()
    if len(values) != 3:
        raise argparse.ArgumentTypeError(f"{text!r} is no point; give X,Y,Z in metres")
    return values
