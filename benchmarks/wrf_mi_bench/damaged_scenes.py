"""Scenes with one fault each, and whole ones: does ``wrf-mi check`` name the fault at its shape, and nothing else.

Each damaged scene is a random room (`wrf_mi_scenes.random_rooms`) as a scene file with meshes, in which a fault of a
kind of `wrf_mi.apps.checking.scene_findings.KINDS` was made. Whole scenes are such rooms, those of Sionna RT, solids.
"""

from __future__ import annotations

import re
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from wrf_mi_scenes.mitsuba_xml import Parts, write_scene
from wrf_mi_scenes.random_rooms import random_room

from wrf_mi.apps.checking import SceneReport, check_scene
from wrf_mi.core import Receiver, Record

COUNT = 510  # 15 of each kind
ROOMS, BOXES = 20, 2  # rooms that are damaged, and pieces of furniture of each
WHOLE_ROOMS, SOLIDS = 15, 10  # beside the scenes of Sionna RT
BOX_AT_M = np.array([2.0, 2.0, 1.0])
SHAPE = re.compile(r'    <shape type="ply" id="mesh-(\w+)">\n.*?</shape>\n', re.DOTALL)
BSDF = re.compile(r'    <bsdf [^>]*id="(mat-\w+)">\n.*?\n    </bsdf>\n', re.DOTALL)
REF = re.compile(r'<ref id="mat-\w+" name="bsdf"/>')
HEADER = (
    "ply\nformat {}\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n"
    "element face {}\nproperty list uchar int vertex_indices\nend_header\n"
)
"""Header of a PLY file with a format and numbers of vertices and faces."""


@dataclass
class Damaged:
    """A scene to damage, and what was done.

    Attributes:
        folder: its folder, with ``scene.xml`` and ``meshes/``.
        text: content of the scene file.
        shape: name of the part that is damaged.
        rng: source of the choices.
        at: id of the shape that has to be named; empty for the scene as a whole.
        record: measurements that are checked with it.
        new: id of the BSDF that was added.
    """

    folder: Path
    text: str
    shape: str
    rng: np.random.Generator
    at: str = ""
    record: Record | None = None
    new: str = ""

    @property
    def mesh_file(self) -> Path:
        """Mesh of the damaged part."""
        return self.folder / "meshes" / f"{self.shape}.ply"

    @property
    def mesh(self) -> trimesh.Trimesh:
        """Content of `mesh_file`."""
        return trimesh.load_mesh(self.mesh_file, process=False)

    def choose(self, *choices: str) -> str:
        """One of some texts."""
        return str(self.rng.choice(choices))

    def in_shape(self, old: str, new: str) -> None:
        """Replace a text in the element of the part."""
        block = next(match[0] for match in SHAPE.finditer(self.text) if match[1] == self.shape)
        if old not in block:
            raise ValueError(f"{self.shape}: no {old} in it")
        self.text = self.text.replace(block, block.replace(old, new, 1))

    def add_to_shape(self, element: str) -> None:
        """Add an element to that of the part."""
        self.in_shape("    </shape>", f"        {element}\n    </shape>")

    def add(self, element: str) -> None:
        """Add an element to the scene."""
        self.text = self.text.replace("</scene>", f"    {element}\n</scene>")

    def use(self, bsdf: str) -> None:
        """Add a BSDF with the id mat-new, and refer to it from the part."""
        identifier = re.search(r'id="([^"]*)"', bsdf)
        self.new = identifier[1] if identifier else ""
        self.add(bsdf)
        block = next(match[0] for match in SHAPE.finditer(self.text) if match[1] == self.shape)
        reference = f'<ref id="{self.new}" name="bsdf"/>'
        self.text = self.text.replace(block, REF.sub(reference, block))

    def store(self, vertices: Any, faces: Any) -> None:
        """Store triangles as the mesh of the part."""
        trimesh.Trimesh(vertices, faces, process=False).export(self.mesh_file, vertex_normal=False)


def _xml(d: Damaged) -> None:
    d.at = ""
    bomb = "".join(f'<!ENTITY {b} "{f"&{a};" * 10}">' for a, b in zip("abcdefghi", "bcdefghij", strict=True))
    d.text = {
        "cut": d.text[: len(d.text) // 2],
        "tag": d.text.replace("</shape>", "</shap>", 1),
        "bomb": f'<!DOCTYPE scene [<!ENTITY a "x">{bomb}]>\n' + d.text.replace("3.0.0", "&j;"),
        "deep": d.text.replace("</scene>", "<transform>" * 500 + "</transform>" * 500 + "</scene>"),
        "ampersand": d.text.replace("mesh-", "mesh-&", 1),
    }[d.choose("cut", "tag", "bomb", "deep", "ampersand")]


def _root(d: Damaged) -> None:
    d.at = ""
    new = d.choose("<scene>", '<scene version="three">', '<scene version="3">')
    d.text = d.text.replace('<scene version="3.0.0">', new)


def _parameter(d: Damaged) -> None:
    moved = '<transform name="to_world"><translate x="1"/></transform>'
    if d.rng.random() < 0.5:
        d.add_to_shape(moved + moved)
    else:
        d.in_shape(f"meshes/{d.shape}.ply", "$mesh")


def _missing(d: Damaged) -> None:
    stated = f"meshes/{d.shape}.ply"
    d.in_shape(stated, d.choose(f"meshes\\{d.shape}.ply", f"{d.shape}.ply", f"meshes/{d.shape}.PLY", "meshes/gone.ply"))


def _not_radio(d: Damaged) -> None:
    radio = '<bsdf type="itu-radio-material" id="mat-inner"><string name="type" value="brick"/></bsdf>'
    white = '<rgb name="reflectance" value="0.5 0.5 0.5"/>'
    d.use(
        d.choose(
            f'<bsdf type="diffuse" id="mat-new">{white}</bsdf>',
            '<bsdf type="twosided" id="mat-new"><bsdf type="principled"/></bsdf>',
            f'<bsdf type="twosided" id="mat-new">{radio}</bsdf>',
            '<bsdf type="mask" id="mat-new"><bsdf type="diffuse"/></bsdf>',
        )
    )


def _unknown_material(d: Damaged) -> None:
    d.use(f'<bsdf type="diffuse" id="{d.choose("mat-itu_concret", "mat-itu_stone", "mat-concrete", "mat-brick")}"/>')
    d.at = f"<bsdf> {d.new}"


def _values(d: Damaged) -> None:
    name, value = d.choose("conductivity -1", "thickness -0.1", "alpha 1", "scattering_coefficient 2").split()
    permittivity = '<float name="relative_permittivity" value="5"/>'
    d.use(f'<bsdf type="radio-material" id="mat-new">{permittivity}<float name="{name}" value="{value}"/></bsdf>')
    d.at = f"<bsdf> {d.new}"


def _smooth(d: Damaged) -> None:
    block = next(match[0] for match in SHAPE.finditer(d.text) if match[1] == d.shape)
    reference = REF.search(block)
    plugin = d.choose("sphere", "cylinder", "disk")
    shape = f'    <shape type="{plugin}" id="mesh-{d.shape}">{reference and reference[0]}</shape>\n'
    d.text = d.text.replace(block, shape)


def _unsupported(d: Damaged) -> None:
    d.in_shape('type="ply"', f'type="{d.choose("stl", "instance", "bsplinecurve", "heightfield", "Ply")}"')


def _transform(d: Damaged) -> None:
    step = d.choose('<scale x="0"/>', '<translate x="nan"/>', '<rotate angle="ninety" z="1"/>', '<matrix value="1 0"/>')
    d.add_to_shape(f'<transform name="to_world">{step}</transform>')


def _mesh(d: Damaged) -> None:
    content = d.mesh_file.read_bytes()
    corners, faces = len(d.mesh.vertices), len(d.mesh.faces)
    d.mesh_file.write_bytes(
        {
            "cut": content[:-7],
            "huge": re.sub(rb"element face \d+", b"element face 1000000000000", content),
            "garbage": bytes(d.rng.integers(0, 256, 500, dtype=np.uint8)),
            "index": HEADER.format("ascii 1.0", 3, 1).encode() + b"0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n",
            "header": content.replace(b"property float x", b"property blob x", 1),
            "vertices": content.replace(f"element vertex {corners}".encode(), f"element vertex {faces * 99}".encode()),
        }[d.choose("cut", "huge", "garbage", "index", "header", "vertices")]
    )


def _not_finite(d: Damaged) -> None:
    vertices = np.array(d.mesh.vertices)
    vertices[d.rng.integers(len(vertices)), d.rng.integers(3)] = d.rng.choice([np.nan, np.inf])
    d.store(vertices, d.mesh.faces)


def _polygons(d: Damaged) -> None:
    corners = ["0 0 1", "2 0 1", "2 2 1", "1 0.5 1", "0 2 1"]
    if d.rng.random() < 0.5:
        d.mesh_file.write_text(HEADER.format("ascii 1.0", 5, 1) + "\n".join([*corners, "5 0 1 2 3 4", ""]))
        return
    lines = [*(f"v {corner}" for corner in corners), d.choose("f 1 2 3 4 5", "f -5 -4 -3 -2 -1"), ""]
    d.mesh_file.with_suffix(".obj").write_text("\n".join(lines))
    d.in_shape(".ply", ".obj")
    d.in_shape('type="ply"', 'type="obj"')


def _zero_area(d: Damaged) -> None:
    a, b, _ = d.mesh.faces[0]
    d.store(d.mesh.vertices, [*d.mesh.faces, [a, b, b]])


def _duplicates(d: Damaged) -> None:
    faces = d.mesh.faces
    extra = faces[d.rng.permutation(len(faces))[: d.rng.integers(1, len(faces) + 1)]]
    d.store(d.mesh.vertices, np.concatenate([faces, np.roll(extra, 1, axis=1)]))


def _winding(d: Damaged) -> None:
    faces = np.array(d.mesh.faces)
    faces[0] = faces[0, ::-1]
    d.store(d.mesh.vertices, faces)


def _double_sheet(d: Damaged) -> None:
    vertices, faces = np.array(d.mesh.vertices), np.array(d.mesh.faces)
    away = d.mesh.face_normals[0] * d.rng.uniform(1e-4, 2e-3)
    d.store(np.concatenate([vertices, vertices + away]), np.concatenate([faces, faces + len(vertices)]))


def _far(d: Damaged) -> None:
    origin_m = np.array([d.rng.uniform(3e5, 9e5), d.rng.uniform(4e6, 6e6), 0])
    d.store(d.mesh.vertices + origin_m, d.mesh.faces)


def _everywhere(d: Damaged, matrix: Any) -> None:
    for file in sorted((d.folder / "meshes").glob("*.ply")):
        mesh = trimesh.load_mesh(file, process=False)
        trimesh.Trimesh(mesh.vertices @ np.asarray(matrix).T, mesh.faces, process=False).export(
            file, vertex_normal=False
        )
    d.at = ""


def _up(d: Damaged) -> None:
    # A hall whose longest side becomes its height, as in a model with y up.
    stretch = np.diag([1.0, 2.0, 1.0])
    _everywhere(d, np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]) @ stretch)


def _device(d: Damaged) -> None:
    box = trimesh.creation.box((1.0, 0.6, 1.5))
    d.store(box.vertices + BOX_AT_M, box.faces)
    receiver = Receiver("station", BOX_AT_M, np.array([0.0, 0.0, 0.0, 1.0]))
    d.record = Record(
        "walk", "rssi", np.array([[1.0, 1, 1], [1, 1, 1.2]]), (receiver,), np.full((1, 2, 1), -50, np.float32)
    )


def _range(d: Damaged) -> None:
    name = d.choose("clear_acrylic", "floorboard")
    d.use(f'<bsdf type="itu-radio-material" id="mat-new"><string name="type" value="{name}"/></bsdf>')


def _odd_name(d: Damaged) -> None:
    d.at = f"mesh-{d.choose('sp ace', 'wänd', '壁', 'a b.c')}"
    d.in_shape(f'id="mesh-{d.shape}"', f'id="{d.at}"')


def _reserved(d: Damaged) -> None:
    d.at = "merged-shapes"
    d.in_shape(f'id="mesh-{d.shape}"', f'id="{d.at}"')


def _duplicate_id(d: Damaged) -> None:
    block = next(match[0] for match in SHAPE.finditer(d.text) if match[1] == d.shape)
    copy = block if d.rng.random() < 0.5 else block.replace(f"mesh-{d.shape}", d.shape, 1)
    d.at = f"mesh-{d.shape}" if copy == block else d.shape
    d.text = d.text.replace(block, block + copy.replace(f"meshes/{d.shape}", "meshes/floor"))


def _bsdf_id(d: Damaged) -> None:
    inline = '<bsdf type="itu-radio-material"><string name="type" value="brick"/></bsdf>'
    block = next(match[0] for match in SHAPE.finditer(d.text) if match[1] == d.shape)
    d.text = d.text.replace(block, REF.sub(inline, block))


def _two_materials(d: Damaged) -> None:
    d.add_to_shape('<bsdf type="itu-radio-material" id="mat-second"><string name="type" value="brick"/></bsdf>')


def _no_material(d: Damaged) -> None:
    block = next(match[0] for match in SHAPE.finditer(d.text) if match[1] == d.shape)
    d.text = d.text.replace(block, REF.sub("", block))


def _unknown_reference(d: Damaged) -> None:
    block = next(match[0] for match in SHAPE.finditer(d.text) if match[1] == d.shape)
    d.text = d.text.replace(block, REF.sub('<ref id="mat-gone" name="bsdf"/>', block))


def _element(d: Damaged) -> None:
    d.at = ""
    d.add(d.choose("<mesh/>", '<emitter type="lamp"/>', '<sensor type="camera"/>', '<include filename="other.xml"/>'))


def _no_constants(d: Damaged) -> None:
    d.use('<bsdf type="radio-material" id="mat-new"><float name="conductivity" value="0.1"/></bsdf>')
    d.at = f"<bsdf> {d.new}"


def _empty(d: Damaged) -> None:
    d.mesh_file.write_text(HEADER.format("ascii 1.0", 3, 0) + "0 0 0\n1 0 0\n0 1 0\n")


def _unknown_parameter(d: Damaged) -> None:
    d.add_to_shape(
        d.choose(
            '<transform name="toWorld"><translate x="1"/></transform>',
            '<boolean name="faceNormals" value="true"/>',
            '<float name="size" value="1"/>',
        )
    )


DAMAGES: Mapping[str, Callable[[Damaged], None]] = {
    **{"xml": _xml, "root": _root, "element": _element, "parameter": _parameter, "transform": _transform},
    **{"unknown-parameter": _unknown_parameter, "missing-file": _missing, "odd-name": _odd_name},
    **{"outside-folder": lambda d: d.in_shape("meshes/", "../meshes/"), "reserved-id": _reserved},
    **{"duplicate-id": _duplicate_id, "no-material": _no_material, "two-materials": _two_materials},
    **{"unknown-reference": _unknown_reference, "not-radio": _not_radio, "unknown-material": _unknown_material},
    **{"material-values": _values, "bsdf-id": _bsdf_id, "no-constants": _no_constants, "shape-type": _smooth},
    **{"unsupported-shape": _unsupported, "mesh": _mesh, "empty-mesh": _empty, "not-finite": _not_finite},
    **{"polygons": _polygons, "zero-area": _zero_area, "duplicate-faces": _duplicates, "mixed-winding": _winding},
    **{"double-sheet": _double_sheet, "far": _far, "units": lambda d: _everywhere(d, 1000 * np.eye(3))},
    **{"up-axis": _up, "device-inside": _device, "material-range": _range},
}
"""What makes a fault of each kind."""


@lru_cache
def _small_room(seed: int) -> Parts:
    """Walls, floor and ceiling of a random room, which are flat, and its first boxes; tables are sheets that cross."""
    parts = random_room(seed).parts
    boxes = [name for name, (_, mesh) in parts.items() if len(mesh.faces) == 12]
    return {
        name: part
        for name, part in parts.items()
        if (len(part[1].faces) == 2 and "piece" not in name) or name in boxes[:BOXES]
    }


def damaged_scene(seed: int, folder: Path) -> tuple[str, Damaged]:
    """Write the damaged scene of a seed; the kind of its fault, and the scene."""
    rng = np.random.default_rng([seed, 7])
    kind = list(DAMAGES)[seed % len(DAMAGES)]
    parts = _small_room(int(rng.integers(ROOMS)))
    sheets = [name for name in parts if name in ("wall_west", "wall_east", "wall_south", "wall_north", "ceiling")]
    xml = write_scene(folder, parts, "damaged room")
    (folder / "scene.yml").unlink()
    shape = str(rng.choice(sheets))
    damaged = Damaged(folder, xml.read_text("utf-8"), shape, rng, f"mesh-{shape}")
    DAMAGES[kind](damaged)
    xml.write_text(damaged.text, encoding="utf-8", newline="\n")
    return kind, damaged


def is_named(kind: str, damaged: Damaged, report: SceneReport) -> bool:
    """Whether a report names a fault of a kind, at the shape that has it."""
    places = [finding.shape for finding in report.findings if finding.kind == kind]
    return damaged.at in places if damaged.at else bool(places)


def whole_scenes(folder: Path, cities: bool = False) -> Iterator[Path]:
    """Scenes without a fault: random rooms, scenes of Sionna RT (with cities, which take a minute), and solids."""
    from sionna.rt import scene as shipped

    for seed in range(WHOLE_ROOMS):
        yield write_scene(folder / f"room_{seed}", random_room(seed).parts, "whole room")
    files = sorted(Path(file) for file in vars(shipped).values() if isinstance(file, str) and file.endswith(".xml"))
    yield from (file for file in files if cities or file.stat().st_size < 10_000)
    rng = np.random.default_rng(3)
    makers: tuple[Callable[[], trimesh.Trimesh], ...] = (
        trimesh.creation.box,
        trimesh.creation.icosphere,
        lambda: trimesh.creation.cylinder(radius=1, height=2),
        trimesh.creation.capsule,
    )
    for number in range(SOLIDS + (0 if cities else 4)):
        solid = makers[number % len(makers)]()
        solid.apply_scale(float(rng.uniform(0.6, 4)))
        solid.apply_translation(rng.uniform(-5, 5, 3))
        yield write_scene(folder / f"solid_{number}", {"solid": ("itu_metal", solid)}, "whole solid")


def main(count: int = COUNT) -> dict[str, Any]:
    """Shares of damaged scenes whose fault is named, and of whole ones with an alarm."""
    named, total, missed = Counter[str](), Counter[str](), list[str]()
    begun = time.perf_counter()
    with tempfile.TemporaryDirectory() as temporary:
        for seed in range(count):
            kind, damaged = damaged_scene(seed, Path(temporary) / str(seed))
            report = check_scene(damaged.folder / "scene.xml", data=damaged.record)
            total[kind] += 1
            named[kind] += is_named(kind, damaged, report)
            missed += [] if is_named(kind, damaged, report) else [f"{seed} {kind}"]
        seconds = time.perf_counter() - begun
        alarms, whole = list[str](), 0
        for xml in whole_scenes(Path(temporary) / "whole", cities=True):
            report, whole = check_scene(xml), whole + 1
            alarms += [f"{xml.name} {f.kind}" for f in report.findings if f.level != "note"]
    rows = [
        {"what": "damaged scenes named", "value": f"{named.total()} of {total.total()}", "asked": "all"},
        {"what": "false alarms", "value": f"{len(alarms)} on {whole} whole scenes", "asked": "0"},
        {"what": "fewest scenes of a kind", "value": f"{min(total.values())}", "asked": "15"},
    ]
    failed = "; ".join([*missed[:5], *alarms[:5]])
    return {"rows": rows, "seconds": round(seconds, 1), "kinds": dict(total), "missed": missed, "alarms": alarms} | (
        {"failed": failed} if failed else {}
    )
