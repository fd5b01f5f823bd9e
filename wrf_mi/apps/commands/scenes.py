"""``wrf-mi mesh``, ``correct`` and ``edit``: scenes from scans, plans and meshes, corrected and edited."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ...core import InputError
from .options import DATASET, SCENE, Arguments, add_antennas, add_command, add_rows, antenna_options, comma_numbers
from .output import Watch, show

if TYPE_CHECKING:
    from ...scene.edit import Move


def add_parser(commands: Any) -> None:
    """Add ``mesh``, ``correct`` and ``edit`` to the commands."""
    for add in (_add_mesh, _add_correct, _add_edit):
        add(commands)


def _add_mesh(commands: Any) -> None:
    text = "make a scene for both tracers from a LiDAR scan, a plan or a mesh"
    parser = add_command(commands, "mesh", mesh_command, text)
    add = parser.add_argument
    text = "scans of one place (E57, PCD, PTS, PTX, PLY, LAS, LAZ, XYZ, NPZ), a plan (NPZ, PNG, ROS map YAML, CSV, "
    text += "GeoJSON, OSM, DXF) or a mesh (OBJ, STL, GLB, PLY, COLLADA, USD, IFC)"
    add("points", nargs="+", metavar="POINTS", help=text)
    add("--out", required=True, metavar="DIR", help="scene folder to make")
    text = "unit of the coordinates: m, dm, cm, mm, ft or in (default: that of COLLADA, USD and DXF, else m)"
    add("--units", help=text)
    text = "axis that is up in a scan or mesh (default: that of COLLADA and USD, y in GLB, else z)"
    add("--up", choices=("y", "z"), help=text)
    text = "point of the source (of a picture, from its lower left corner), metres, z up, that becomes the origin, "
    text += "such as 701300,4485500,0"
    add("--origin", type=comma_numbers(3, "X,Y,Z"), metavar="X,Y,Z", help=text)
    add("--wall-height", type=float, metavar="M", help="height from floor to ceiling; required for a plan")
    add("--floor", type=float, default=0.0, metavar="M", help="z of a plan's floor (default: 0)")
    add("--resolution", type=float, metavar="M", help="side of a plan's cell where the file has none")
    text = "side of the plan at which the first row of an NPZ grid lies, where the file does not state row_0"
    add("--row-0", choices=("top", "bottom"), help=text)
    text = "width and height of a plan in longitude and latitude, metres, from its lower left corner"
    add("--extent", type=comma_numbers(2, "WIDTH,HEIGHT"), metavar="WIDTH,HEIGHT", help=text)
    text = "layers of walls in a DXF whose names do not say so; * and ? are wildcards"
    add("--layers", type=_names, default=(), metavar="NAME,...", help=text)
    add("--level", metavar="LEVEL", help="level of rooms in a file of OpenStreetMap, or buildings")
    add("--materials", metavar="FILE", help="materials.yml with rules and exceptions")
    add("--register-pairs", metavar="CSV", help="move by pairs of points: x,y[,z],to_x,to_y[,to_z]")
    add("--register-walls", metavar="CSV", help="move so that walls lie on those of a layout: x,y")
    text = "measured positions in the scene's frame, a folder of `data import` or a CSV x,y[,z] in metres: refuse a "
    text += "plan that is mirrored or elsewhere, warn if it fits better when moved"
    add("--positions", metavar="DATA", help=text)
    add("--replace", action="store_true", help="replace an existing scene folder")


def mesh_command(a: Arguments) -> int:
    """Make a scene folder."""
    from ...scene.make import make_scene
    from ...scene.mesh.files import mesh_parts
    from ...scene.mesh.surfaces import KINDS, named_kind
    from ...scene.register import read_pairs, register_pairs
    from ..checking import check_scene

    pairs = None if a.register_pairs is None else register_pairs(*read_pairs(a.register_pairs), name=a.register_pairs)
    source = {"units": a.units, "up": a.up, "origin_m": a.origin, "row_0": a.row_0, "resolution_m": a.resolution}
    storey = {"height_m": a.wall_height, "floor_m": a.floor, "extent_m": a.extent, "materials": a.materials}
    storey |= {"layers": a.layers, "level": a.level}
    frame = {"registration": pairs, "register_walls_of": a.register_walls, "positions": a.positions}
    scene = make_scene(a.points, a.out, **source, **storey, **frame, replace=a.replace)
    kinds = {name: named_kind(name, entry) for name, entry in scene.materials.surfaces.items()}
    counts = {kind: list(kinds.values()).count(kind) for kind in KINDS}
    floors = [name for name, kind in kinds.items() if kind == "floor"]
    parts = [part for name in floors for part in mesh_parts(scene.folder / "meshes" / f"{name}.ply")]
    # Seen from above; a slab has an upper and a lower side.
    level_m2 = [float(np.abs(part.face_normals[:, 2]) @ part.area_faces) for part in parts]
    floor_m2 = sum(area / (1 + part.is_watertight) for area, part in zip(level_m2, parts, strict=True))
    facts: dict[str, Any] = {"scene": str(scene.folder), "xml": str(scene.xml)}
    facts |= {"surfaces": counts, "counts": scene.counts}
    lines = [", ".join(f"{count} {kind}" for kind, count in counts.items()) + f": {scene.folder}"]
    lines.append(f"floor: {floor_m2:.1f} m2")
    if scene.origin_m is not None:
        point = ", ".join(f"{value:.12g}" for value in scene.origin_m)
        lines.append(f"origin: {point} of the source; positions of measurements must be relative to it")
    lines.append(f"materials: {scene.folder / 'materials.yml'}\npicture: {scene.folder / 'preview.png'}")
    check = check_scene(scene.folder)
    if check.of_level("fault") or check.of_level("warning"):
        lines += check.lines()
    next_command = f"wrf-mi train DATASET --scene {scene.folder} --out RUN"
    lines.append(f"next: {next_command}")
    facts |= {"floor_m2": float(floor_m2), "origin_m": scene.origin_m, "check": check.as_dict(), "next": next_command}
    return show(a.json, facts, "\n".join(lines))


def _add_correct(commands: Any) -> None:
    parser = add_command(commands, "correct", correct_command, "correct a scene by measurements")
    add = parser.add_argument
    add("dataset", metavar="DATASET", help=DATASET)
    add("--scene", required=True, metavar="SCENE", help=SCENE)
    add("--out", required=True, metavar="SCENE2", help="scene folder to make")
    groups = "what to fit to training rows, of materials,planes,frame,hidden,phases,gain,pose,patterns"
    default = "materials,planes,frame,hidden; for signal strengths materials,gain"
    add("--calibrate", metavar="LIST", help=f"{groups} (default: {default})")
    add("--depth", type=int, metavar="N", help="largest number of interactions per path (default: 3; strengths: 6)")
    add("--reflections", type=int, metavar="N", help="largest number of reflections (default: 3; strengths: 2)")
    add("--rays", metavar="N", help="number of rays from each receiver (default: 65536), or auto as for train")
    add("--shift-sd", type=float, metavar="M", help="standard deviation of a plane's stated position (default: 0.02 m)")
    add("--material", metavar="NAME", help="radio material of a bare mesh, e.g. concrete")
    add_antennas(parser)
    add_rows(parser)
    add("--replace", action="store_true", help="replace an existing scene folder")


def correct_command(a: Arguments) -> int:
    """Correct a scene, and write its page."""
    from ...runs.scenes import Scene

    if Path(a.out).exists() and not a.replace:  # before the work, not after it
        raise InputError(f"{a.out}: exists; remove it, choose another folder, or give --replace")
    named = {"depth": a.depth, "reflections": a.reflections, "rays": a.rays, "shift_sd_m": a.shift_sd}
    settings = [f"{name}={value}" for name, value in named.items() if value is not None]
    settings += [] if a.calibrate is None else [f"groups=[{a.calibrate}]"]
    names = ("split", "n_train", "material", "deterministic", "replace")
    options: dict[str, Any] = {name: getattr(a, name) for name in names} | {"antennas": antenna_options(a)}
    options |= {"seed": a.seed or 0, "settings": [*settings, *a.set], "progress": sys.stderr.isatty()}
    with Watch() as watch:
        scene = Scene.open(a.scene).correct(a.dataset, a.out, **options, on_progress=watch.on_progress)
    facts = scene.correction
    assert facts is not None
    what = "rows of held-out receivers" if facts["held_out_receivers"] else "held-out rows"
    lines = [f"{facts['score']} of {facts['held_out']} {what}   median    mean"]
    for stage, score in facts["held_out_scores"].items():
        mark = "  kept" if stage == facts["kept"] else ""
        lines.append(f"{stage:<40}{score['median']:8.3f}{score['mean']:8.3f}{mark}")
    lines.append(f"{facts['rows']} training rows, {facts['paths']} paths, {facts['seconds']:.0f} s")
    lines.append(f"scene: {a.out}\npage: {a.out}/correction.md")
    shown = {"scene": a.out, **{key: value for key, value in facts.items() if key != "parameters"}}
    return show(a.json, shown, "\n".join(lines))


def _add_edit(commands: Any) -> None:
    text = "move or remove parts of a scene; `trace` then predicts the changed signals; without --out: list its parts"
    parser = add_command(commands, "edit", edit_command, text)
    add = parser.add_argument
    add("scene", metavar="SCENE", help="scene folder")
    text = "move parts, together, by metres and turn them by degrees about the vertical axis; * and ? are wildcards"
    add("--move", action="append", default=[], metavar="NAME,...:DX,DY,DZ[,DEG]", help=f"{text}; repeatable")
    add("--remove", action="append", default=[], type=_names, metavar="NAME,...", help="leave parts out; repeatable")
    add("--out", metavar="SCENE2", help="scene folder to make")
    add("--replace", action="store_true", help="replace an existing scene folder")


def edit_command(a: Arguments) -> int:
    """Edit a scene, or list its parts."""
    from ...scene.edit import edit_scene

    if a.out is not None:
        removed = [name for names in a.remove for name in names]
        folder = edit_scene(a.scene, a.out, [_move(text) for text in a.move], removed, a.replace)
        return show(a.json, {"scene": str(folder)}, f"scene: {folder}\npicture: {folder / 'preview.png'}")
    if a.move or a.remove or a.replace:
        raise InputError("edit: give the folder of the edited scene (--out)")
    rows, lines = _parts(a.scene)
    return show(a.json, {"scene": a.scene, "parts": rows}, "\n".join(lines))


def _parts(scene: str) -> tuple[list[dict[str, Any]], list[str]]:
    """Name, material and box of each part of a scene, as values and as lines of a table."""
    from ...scene.edit import box_of, read_surfaces

    surfaces, materials = read_surfaces(scene)
    width = max(len(surface.name) for surface in surfaces) + 2
    lines, rows = [f"{'part':<{width}}{'material':<24}{'from x, y, z (m)':<24}to"], []
    for surface in surfaces:
        material, box_m = materials.of(surface.name, surface.kind), box_of([surface]).round(3)
        rows.append({"part": surface.name, "material": material, "box_m": box_m.tolist()})
        low, high = (" ".join(f"{value:7.2f}" for value in corner) for corner in box_m)
        lines.append(f"{surface.name:<{width}}{material:<24}{low:<24}{high}")
    return rows, lines


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())


def _move(text: str) -> Move:
    """Names and numbers of an option such as ``box:0.5,0,0``."""
    from ...scene.edit import Move

    names, _, numbers = text.rpartition(":")
    try:
        values = [float(value) for value in numbers.split(",")]
    except ValueError:
        values = []
    if not _names(names) or len(values) not in (3, 4):
        raise InputError(f"--move {text}: give names, a colon, and DX,DY,DZ in metres, such as box:0.5,0,0")
    return Move(_names(names), (values[0], values[1], values[2]), values[3] if len(values) == 4 else 0.0)
