"""Repair of scenes (``wrf-mi check --repair``): a new scene folder that plain Sionna RT opens."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np
import trimesh
import yaml

from ...core import InputError
from ...core.angles import FloatArray
from ...core.files import atomic_folder, listed, write_atomically
from ...scene.coordinates import FARTHEST_M, Up
from ...scene.folder import FACTS_FILE, XML_FILE, plain_name
from ...scene.make import is_plan
from ...scene.material_names import ascii_name
from ...tracing.sionna.scenes import plain_ply
from .material_repair import ODD, MaterialRepair
from .scene_check import Checked, Frame, check_scene, checked, opened
from .scene_findings import NAMED, Finding, SceneReport
from .scene_geometry import ShapePart
from .scene_xml_faults import ITU, MERGED, short_name
from .triangle_repair import label, repaired_triangles

DONE: Mapping[str, str] = {
    "unknown-parameter": "parameter left out; a transform is taken for to_world",
    "missing-file": "file of the same name elsewhere in the folder taken",
    "outside-folder": "file of the same name in the folder taken",
    "empty-mesh": "shape without faces left out",
    "polygons": "polygons cut into triangles",
    "shape-type": "replaced by a mesh",
    "moved": "to_world applied to the mesh",
    "bsdf-id": "material given an id",
    "two-materials": "the first radio material taken",
}
"""What repair does about kinds of findings that need no choice."""
UNREPAIRED = (
    *("xml", "folder", "mesh", "not-finite", "transform", "unsupported-shape", "parameter", "no-shapes", "units"),
    "material-range",
)
"""Kinds of faults that need the user."""
LOST = ("missing-file", "outside-folder")  # kinds that do, too, where no file of the name is in the folder


@dataclass(frozen=True)
class Repair:
    """A repaired scene.

    Attributes:
        folder: the new scene folder, None where a fault could not be repaired and nothing was written.
        done: what was changed, a line each: shape, colon, change.
        unrepaired: findings that need the user.
        after: findings about the new folder, None without one.
    """

    folder: Path | None
    done: tuple[str, ...]
    unrepaired: tuple[Finding, ...]
    after: SceneReport | None

    def lines(self) -> list[str]:
        """What was changed, what was not, and the new folder with its findings."""
        shapes: dict[str, list[str]] = {}
        for line in self.done:
            shape, _, text = line.partition(": ")
            shapes.setdefault(text, []).append(shape)
        changed = [f"repaired: {listed(names, NAMED)}: {text}" for text, names in shapes.items()] or [
            "nothing to repair"
        ]
        unrepaired = [f"unrepaired {f.kind}: {f.shape or f.file}: {f.text}; {f.remedy}" for f in self.unrepaired]
        if self.after is None:
            return [*changed, *unrepaired, "nothing was written; correct the source, then repair it"]
        return [*changed, *unrepaired, *self.after.lines(), f"scene: {self.folder}"]

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            "folder": None if self.folder is None else str(self.folder),
            "done": list(self.done),
            "unrepaired": [finding.as_dict() for finding in self.unrepaired],
            "after": None if self.after is None else self.after.as_dict(),
        }


def repair_scene(
    source: str | Path,
    out: str | Path,
    *,
    material: str | None = None,
    shape_materials: Mapping[str, str] | None = None,
    frequency_hz: float | None = None,
    units: str = "m",
    up: Up | None = None,
    overwrite: bool = False,
) -> Repair:
    """Repair a scene or mesh into a new folder that ``sionna.rt.load_scene`` opens; the source stays as it is.

    Polygons become triangles, shapes without triangles meshes, and transforms are applied. Faces without an area and
    copies are left out, winding is made consistent, and sheets within millimetres of each other are put into one
    plane. Ids and file names become ASCII. Materials are taken out of other BSDFs, or guessed by names. Coordinates
    far from the origin are shifted by whole hundreds of metres.

    Args:
        source: name, folder, XML or mesh, as of `check_scene`.
        out: folder to make: ``scene.xml``, ``meshes/*.ply``, and ``scene.yml`` with what was done.
        material: material of ITU-R P.2040 of shapes without one whose names say none, ``concrete`` or ``itu_concrete``.
        shape_materials: materials by the names of shapes, in place of their own; None: none.
        frequency_hz: carrier, for which materials below their range get constants.
        units: unit of the source's coordinates.
        up: axis that is up in the source.
        overwrite: replace an existing folder.

    Returns:
        What was done. Where a fault needs the user, nothing is written.

    Raises:
        InputError: no such source or shape, an unknown material, a scan, or a folder that exists.
    """
    default = None if material is None else _known_material(material)
    of_shapes = {shape: _known_material(name) for shape, name in (shape_materials or {}).items()}
    before = checked(source, Frame(units, up), frequency_hz)
    if before.report.points or is_plan(before.source.path):
        raise InputError(f"{source}: a scan or plan; make a scene of it by wrf-mi mesh")
    parts, origin_m, done = repaired_triangles(before.parts)
    if unknown := sorted(set(of_shapes) - {part.name for part in parts}):
        raise InputError(f"{source}: no shape {unknown[0]!r}; there are {listed(part.name for part in parts)}")
    materials = MaterialRepair(before.scene, before.source.thickness_m, default, frequency_hz, of_shapes)
    bsdfs = [materials.of(part) for part in parts]
    names = _names(parts, bsdfs)
    done = [*_shift(origin_m), *_routine(before), *done, *materials.done, *_renamed(names)]
    unrepaired = [*_unrepaired(before), *_left(parts, bsdfs, before.source.path)]
    if unrepaired:
        return Repair(None, tuple(done), tuple(unrepaired), None)
    with atomic_folder(Path(out), overwrite) as folder:
        _write(folder, names, bsdfs, {"source": str(source), "origin_m": origin_m.tolist(), "repairs": done})
        for finding in opened(folder / XML_FILE):
            raise InputError(f"{source}: not repaired, as {finding.text}; report this with the scene")
    after = check_scene(out, frequency_hz=frequency_hz)
    return Repair(Path(out), tuple(done), tuple(after.of_level("fault")), after)


def _write(
    folder: Path, names: Mapping[ShapePart, str], bsdfs: Sequence[Element | None], facts: Mapping[str, Any]
) -> None:
    """Write meshes, scene file and ``scene.yml`` into an empty folder."""
    (folder / "meshes").mkdir()
    for part, name in names.items():
        mesh = trimesh.Trimesh(**trimesh.triangles.to_kwargs(part.corners_m), process=False)
        mesh.merge_vertices()
        (folder / "meshes" / f"{name}.ply").write_bytes(plain_ply(mesh))
    root = _scene([bsdf for bsdf in bsdfs if bsdf is not None], list(names.values()))
    write_atomically(folder / XML_FILE, ElementTree.tostring(root, encoding="unicode") + "\n")
    frame = {"frame": "that of the source, less origin_m", "units": "m", "xml": XML_FILE}
    facts = {"description": f"{len(names)} surfaces repaired by wrf-mi check", **frame, **facts}
    write_atomically(folder / FACTS_FILE, yaml.safe_dump(facts, sort_keys=False, width=110))


def _shift(origin_m: FloatArray) -> list[str]:
    text = ", ".join(f"{value:.12g}" for value in origin_m)
    remedy = "subtract it from the positions of the measurements, too"
    return [f"origin: {text} m subtracted; {remedy}"] if origin_m.any() else []


def _renamed(names: Mapping[ShapePart, str]) -> list[str]:
    return [f"{label(part)}: named {name}" for part, name in names.items() if short_name(label(part)) != name]


def _routine(before: Checked) -> list[str]:
    findings = [finding for finding in before.report.findings if finding.kind in DONE]
    return [f"{finding.shape or finding.file.name}: {DONE[finding.kind]}" for finding in findings]


def _unrepaired(before: Checked) -> list[Finding]:
    """Faults that need the user, and shapes whose triangles are not known for another reason."""
    read, faults = {id(part.shape) for part in before.parts}, before.report.of_level("fault")
    lost = [name for name, shape in (before.scene.shapes if before.scene else ()) if id(shape) not in read]
    unrepaired = [each for each in faults if each.kind in UNREPAIRED or (each.kind in LOST and each.shape in lost)]
    named = {each.shape for each in faults if each.kind in (*UNREPAIRED, *LOST, "empty-mesh")}
    text, remedy = "its triangles are not read", "write it as a PLY mesh"
    form = "unsupported-shape", before.source.path
    return unrepaired + [Finding(*form, name, text, remedy) for name in lost if name not in named]


def _known_material(name: str) -> str:
    """Name of a material of ITU-R P.2040 without ``itu_``."""
    if (material := name.removeprefix("itu_")) not in ITU:
        raise InputError(f"material {name!r}: unknown; give one of ITU-R P.2040: {', '.join(ITU)}")
    return material


def _left(parts: Sequence[ShapePart], bsdfs: Sequence[Element | None], path: Path) -> list[Finding]:
    """Repaired parts that still cannot be written."""
    findings = list[Finding]()
    for part, bsdf in zip(parts, bsdfs, strict=True):
        if bsdf is None:
            text = "has no radio material, and its names mean none"
            findings.append(Finding("no-material", path, part.name, text, f"give one by --material, such as {ITU[1]}"))
        if np.abs(part.corners_m).max() >= FARTHEST_M:
            text = "lies kilometres from other shapes"
            findings.append(Finding("far", part.file, part.name, text, "correct its coordinates"))
    return findings if parts else [Finding("no-shapes", path, "", "nothing has an area", "give a scene with surfaces")]


def _names(parts: Sequence[ShapePart], bsdfs: Sequence[Element | None]) -> dict[ShapePart, str]:
    """Safe names of parts that neither another one, nor a material, has: both are items of a scene of Sionna RT."""
    names = dict[ShapePart, str]()
    materials = [short_name(bsdf.get("id", "")) for bsdf in bsdfs if bsdf is not None]
    for number, part in enumerate(parts, start=1):
        identifier = part.name if part.shape is None else part.shape.get("id", "")
        wanted = short_name(ascii_name(identifier)) or ("" if part.file.suffix == ".xml" else part.file.stem)
        used = {*names.values(), *materials, MERGED}
        names[part] = plain_name(ascii_name(wanted) or f"shape_{number}", ODD, used)
    return names


def _scene(bsdfs: Sequence[Element], names: Sequence[str]) -> Element:
    """A scene file of ``meshes/NAME.ply`` with a BSDF each."""
    root = Element("scene", version="3.0.0")
    root.extend({bsdf.get("id"): bsdf for bsdf in bsdfs}.values())
    for bsdf, name in zip(bsdfs, names, strict=True):
        shape = SubElement(root, "shape", type="ply", id=f"mesh-{name}")
        SubElement(shape, "string", name="filename", value=f"meshes/{name}.ply")
        SubElement(shape, "boolean", name="face_normals", value="true")
        SubElement(shape, "ref", id=bsdf.get("id", ""), name="bsdf")
    ElementTree.indent(root, "    ")
    return root
