"""Random rooms with one fault of a kind that ``wrf-mi check`` names, and scenes without a fault."""

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from wrf_mi_scenes.mitsuba_xml import write_scene
from wrf_mi_scenes.random_rooms import random_room

from wrf_mi.core import Receiver, Record

ROOMS, WHOLE_ROOMS, SOLIDS = 20, 15, 14
SHEETS = ("wall_west", "wall_east", "wall_south", "wall_north", "ceiling")
BOX_AT_M = np.array([2.0, 2.0, 1.0])
REF, SHAPE_END, FILE = r'<ref id="mat-\w+" name="bsdf"/>', "    </shape>", r"meshes/(\w+)\.ply"
MOVED = '<transform name="to_world"><translate x="1"/></transform>'
BRICK = '<string name="type" value="brick"/></bsdf>'
RADIO = '<bsdf type="radio-material" id="mat-new">'
PERMITTIVITY = '<float name="relative_permittivity" value="5"/>'
PLY = (
    "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n"
    "element face 1\nproperty list uchar int vertex_indices\nend_header\n{}\n"
)

Edits = tuple[tuple[str, str], ...]  # patterns and what replaces their first match; a turn takes one of them


def edits(pattern: str, *replacements: str) -> Edits:
    return tuple((pattern, new) for new in replacements)


def appended(end: str, *elements: str) -> Edits:
    return edits(end, *(f"        {element}\n{end}" for element in elements))


IN_FILE: Mapping[str, Edits] = {
    "xml": (
        *(("(?s)(.{300}).*", r"\1"), ("</shape>", "</shap>"), ("mesh-", "mesh-&")),
        ("^", '<!DOCTYPE scene [<!ENTITY a "x">]>'),
        ('<scene version="3.0.0">', "<scene>"),
        *appended("</scene>", "<mesh/>", '<emitter type="lamp"/>', '<include filename="other.xml"/>'),
    ),
}
"""Faults of the scene as a whole."""
IN_SHAPE: Mapping[str, Edits] = {
    "parameter": (*appended(SHAPE_END, MOVED * 2), (FILE, "$mesh")),
    "unknown-parameter": appended(
        SHAPE_END,
        MOVED.replace("to_world", "toWorld"),
        '<boolean name="faceNormals" value="true"/>',
        '<float name="size" value="1"/>',
    ),
    "transform": appended(
        SHAPE_END,
        *(
            f'<transform name="to_world">{step}</transform>'
            for step in ('<scale x="0"/>', '<translate x="nan"/>', '<rotate angle="ninety"/>', '<matrix value="1 0"/>')
        ),
    ),
    "missing-file": edits(FILE, r"meshes\\\1.ply", r"\1.ply", r"meshes/\1.PLY", "meshes/gone.ply"),
    "outside-folder": edits("meshes/", "../meshes/"),
    "duplicate-id": (
        (rf"(?s)^(.*){FILE}(.*)$", r"\g<0>\1meshes/floor.ply\3"),
        (rf"(?s)^(.*)mesh-(\w+)(.*){FILE}(.*)$", r"\g<0>\1\2\3meshes/floor.ply\5"),
    ),
    "no-material": edits(REF, ""),
    "unknown-reference": edits(REF, '<ref id="mat-gone" name="bsdf"/>'),
    "bsdf-id": edits(REF, f'<bsdf type="itu-radio-material">{BRICK}'),
    "two-materials": appended(SHAPE_END, f'<bsdf type="itu-radio-material" id="mat-second">{BRICK}'),
    "shape-type": edits(
        r'(?s)type="ply"( id="[^"]*">).*(<ref[^>]*/>)',
        *(rf'type="{kind}"\1\2' for kind in ("sphere", "cylinder", "disk")),
    ),
    "unsupported-shape": edits(
        'type="ply"', *(f'type="{kind}"' for kind in ("stl", "instance", "bsplinecurve", "heightfield", "Ply"))
    ),
}
"""Faults of the element of a shape."""
BSDFS: Mapping[str, tuple[str, ...]] = {
    "not-radio": (
        '<bsdf type="diffuse" id="mat-new"><rgb name="reflectance" value="0.5 0.5 0.5"/></bsdf>',
        '<bsdf type="twosided" id="mat-new"><bsdf type="principled"/></bsdf>',
        f'<bsdf type="twosided" id="mat-new"><bsdf type="itu-radio-material" id="mat-inner">{BRICK}</bsdf>',
        '<bsdf type="mask" id="mat-new"><bsdf type="diffuse"/></bsdf>',
    ),
    "material-range": tuple(
        f'<bsdf type="itu-radio-material" id="mat-new"><string name="type" value="{name}"/></bsdf>'
        for name in ("clear_acrylic", "floorboard")
    ),
    "unknown-material": tuple(
        f'<bsdf type="diffuse" id="mat-{name}"/>' for name in ("itu_concret", "itu_stone", "concrete", "brick")
    ),
    "material-values": tuple(
        f'{RADIO}{PERMITTIVITY}<float name="{name}" value="{value}"/></bsdf>'
        for name, value in (("conductivity", -1), ("thickness", -0.1), ("alpha", 1), ("scattering_coefficient", 2))
    ),
    "no-constants": (f'{RADIO}<float name="conductivity" value="0.1"/></bsdf>',),
}
"""BSDFs that a shape refers to."""
AT_SHAPE = ("not-radio", "material-range")  # kinds of `BSDFS` that are named at the shape


def bad_mesh(content: bytes, turn: int) -> bytes:
    changes: tuple[Callable[[], bytes], ...] = (
        lambda: content[:-7],
        lambda: re.sub(rb"element face \d+", b"element face 1000000000000", content),
        lambda: bytes(np.random.default_rng(turn).integers(0, 256, 500, dtype=np.uint8)),
        lambda: PLY.format(3, "0 0 0\n1 0 0\n0 1 0\n3 0 1 7").encode(),
        lambda: content.replace(b"property float x", b"property blob x", 1),
        lambda: re.sub(rb"element vertex \d+", b"element vertex 99999", content),
    )
    return changes[turn % len(changes)]()


CONTENTS: Mapping[str, Callable[[bytes, int], bytes]] = {
    "mesh": bad_mesh,
    "empty-mesh": lambda *_: PLY.format(3, "0 0 0\n1 0 0\n0 1 0").replace("face 1", "face 0").encode(),
    "polygons": lambda *_: PLY.format(5, "0 0 1\n2 0 1\n2 2 1\n1 0.5 1\n0 2 1\n5 0 1 2 3 4").encode(),
}
"""Faults of the content of a mesh file."""


def not_finite(v: Any, f: Any, turn: int) -> tuple[Any, Any]:
    v[turn % len(v), turn % 3] = (np.nan, np.inf)[turn % 2]
    return v, f


def double_sheet(v: Any, f: Any, turn: int) -> tuple[Any, Any]:
    away = trimesh.Trimesh(v, f).face_normals[0] * (1e-4, 1e-3, 2e-3)[turn % 3]
    return np.concatenate([v, v + away]), np.concatenate([f, f + len(v)])


MESHES: Mapping[str, Callable[[Any, Any, int], tuple[Any, Any]]] = {
    "not-finite": not_finite,
    "zero-area": lambda v, f, _: (v, [*f, [*f[0, :2], f[0, 1]]]),
    "duplicate-faces": lambda v, f, turn: (v, [*f, *np.roll(f[: 1 + turn % len(f)], 1, axis=1)]),
    "mixed-winding": lambda v, f, _: (v, [f[0, ::-1], *f[1:]]),
    "double-sheet": double_sheet,
    "far": lambda v, f, turn: (v + np.array([3e5 + 4e4 * turn, 4e6, 0]), f),
    "device-inside": lambda *_: ((box := trimesh.creation.box((1.0, 0.6, 1.5))).vertices + BOX_AT_M, box.faces),
}
"""Faults of vertices and faces."""
EVERYWHERE: Mapping[str, Any] = {
    "units": 1000 * np.eye(3),
    "up-axis": np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]) @ np.diag([1.0, 2.0, 1.0]),  # its longest side is upright
}
"""Matrices of all meshes."""
DAMAGES = (*IN_FILE, *IN_SHAPE, *BSDFS, *CONTENTS, *MESHES, *EVERYWHERE)


@dataclass
class Damaged:
    """A scene: its folder, the content of the scene file, id of the shape to be named ("": none), measurements."""

    folder: Path
    text: str
    at: str = ""
    record: Record | None = None


def damaged_scene(kind: str, turn: int, folder: Path, damage: bool = True) -> Damaged:
    """Write a room of walls, floor, ceiling and two boxes with a fault of a kind, or the same room without it."""
    rng = np.random.default_rng([turn, DAMAGES.index(kind)])
    parts = random_room(int(rng.integers(ROOMS))).parts
    boxes = [name for name, (_, mesh) in parts.items() if len(mesh.faces) == 12][:2]
    flat = [name for name, (_, mesh) in parts.items() if len(mesh.faces) == 2 and "piece" not in name]
    shape = str(rng.choice([name for name in parts if name in SHEETS]))
    xml = write_scene(folder, {name: parts[name] for name in parts if name in (*boxes, *flat)}, "damaged room")
    (folder / "scene.yml").unlink()
    damaged, file = Damaged(folder, xml.read_text("utf-8"), f"mesh-{shape}"), folder / "meshes" / f"{shape}.ply"
    block = next(b for b in re.findall(r"(?s)    <shape .*?</shape>\n", damaged.text) if f'"mesh-{shape}"' in b)
    changed, kind = block, kind if damage else ""
    if kind in IN_FILE or kind in IN_SHAPE:
        choices = {**IN_FILE, **IN_SHAPE}[kind]
        pattern, new = choices[turn % len(choices)]
        if kind in IN_FILE:
            damaged.text, damaged.at = re.sub(pattern, new, damaged.text, count=1), ""
        else:
            changed = re.sub(pattern, new, block, count=1)
            damaged.at = re.findall(r'<shape [^>]*id="([^"]*)"', changed)[-1]
    elif kind in BSDFS:
        bsdf = BSDFS[kind][turn % len(BSDFS[kind])]
        name = re.findall(r'id="([^"]*)"', bsdf)[0]
        changed = re.sub(REF, f'<ref id="{name}" name="bsdf"/>', block)
        damaged.text = damaged.text.replace("</scene>", f"    {bsdf}\n</scene>")
        damaged.at = damaged.at if kind in AT_SHAPE else f"<bsdf> {name}"
    elif kind in CONTENTS:
        file.write_bytes(CONTENTS[kind](file.read_bytes(), turn))
    elif kind in MESHES:
        mesh = trimesh.load_mesh(file, process=False)
        vertices, faces = MESHES[kind](np.array(mesh.vertices), np.array(mesh.faces), turn)
        trimesh.Trimesh(vertices, faces, process=False).export(file, vertex_normal=False)
    elif kind in EVERYWHERE:
        damaged.at = ""
        for each in sorted((folder / "meshes").glob("*.ply")):
            mesh = trimesh.load_mesh(each, process=False)
            mesh.vertices = mesh.vertices @ EVERYWHERE[kind].T
            mesh.export(each, vertex_normal=False)
    if kind == "device-inside":
        receiver = Receiver("station", BOX_AT_M, np.array([0.0, 0.0, 0.0, 1.0]))
        tx_pos_m, powers = np.array([[1.0, 1, 1], [1, 1, 1.2]]), np.full((1, 2, 1), -50, np.float32)
        damaged.record = Record("walk", "rssi", tx_pos_m, (receiver,), powers)
    damaged.text = damaged.text.replace(block, changed)
    xml.write_text(damaged.text, encoding="utf-8", newline="\n")
    return damaged


def whole_scenes(folder: Path) -> Iterator[Path]:
    """Scenes without a fault: random rooms, the small scenes of Sionna RT, and solids."""
    from sionna.rt import scene as shipped

    for seed in range(WHOLE_ROOMS):
        yield write_scene(folder / f"room_{seed}", random_room(seed).parts, "whole room")
    files = sorted(Path(file) for file in vars(shipped).values() if isinstance(file, str) and file.endswith(".xml"))
    yield from (file for file in files if file.stat().st_size < 10_000)  # cities take a minute
    rng = np.random.default_rng(3)
    new = trimesh.creation
    for number in range(SOLIDS):
        solid = (new.box(), new.icosphere(), new.cylinder(radius=1, height=2), new.capsule())[number % 4]
        solid.apply_scale(float(rng.uniform(0.6, 4)))
        solid.apply_translation(rng.uniform(-5, 5, 3))
        yield write_scene(folder / f"solid_{number}", {"solid": ("itu_metal", solid)}, "whole solid")
