"""Repair of scenes (``wrf-mi check --repair``): a new scene folder that plain Sionna RT opens."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np
import trimesh
import yaml
from wrf_mi_scenes.mitsuba_xml import THICKNESS_M

from ..core import InputError
from ..core.files import atomic_folder, write_atomically
from ..scene.coordinates import FARTHEST_M, UNITS_M, Up, turned
from ..scene.folder import FACTS_FILE, XML_FILE, plain_name
from ..scene.mesh.surfaces import bodies
from ..tracing.sionna.materials import BELOW_1_GHZ, in_itu_range
from ..tracing.sionna.scene_shapes import REFUSALS, plain_ply, reason
from .scene_check import Checked, checked, itu_type
from .scene_findings import Finding, SceneReport, some_names
from .scene_geometry import Part, read_triangles, to_world
from .scene_xml_faults import (
    BOUNDS,
    ITU,
    MERGED,
    RADIO,
    SceneXml,
    bsdf_findings,
    is_itu,
    short_name,
    similar_file,
)
from .triangle_faults import copies, double_sheets, is_flat, without_area, wound_both_ways, wound_one_way

ODD = r"[^A-Za-z0-9_.-]"  # characters that ids and file names of a repaired scene do not have
WORDS: Mapping[str, str] = {
    **{material.replace("_", ""): material for material in ITU},
    **{"ceilingtile": "ceiling_board", "drywall": "plasterboard", "gypsum": "plasterboard", "window": "glass"},
    **{"steel": "metal", "alumin": "metal", "iron": "metal", "timber": "wood", "asphalt": "asphalt_concrete"},
}
"""Words in names of materials and shapes, without separators, and the material of ITU-R P.2040 that they mean."""
SIONNA_THICKNESS_M = 0.1  # that of Sionna RT where a scene file states none: repair does not change it
DONE: Mapping[str, str] = {
    "element": "left out",
    "unknown-parameter": "parameter left out; a transform is taken for to_world",
    "pictures": "emitters, sensors and integrators left out",
    "empty-mesh": "shape without faces left out",
    "polygons": "polygons cut into triangles",
    "shape-type": "replaced by a mesh",
    "moved": "to_world applied to the mesh",
    "bsdf-id": "material given an id",
    "two-materials": "the first radio material taken",
    "root": "written as a scene of version 3.0.0",
}
"""What repair does about kinds of findings that need no choice."""
UNREPAIRED = (
    *("xml", "folder", "mesh", "not-finite", "transform", "unsupported-shape", "parameter", "no-shapes"),
    "material-range",
)
"""Kinds of faults that need the user."""


@dataclass(frozen=True)
class Repair:
    """A repaired scene.

    Attributes:
        folder: the new scene folder, None where a fault could not be repaired and nothing was written.
        done: what was changed, a line each.
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
        changed = [f"repaired: {some_names(names)}: {text}" for text, names in shapes.items()] or ["nothing to repair"]
        left = [f"unrepaired {f.kind}: {f.shape or f.file}: {f.text}; {f.remedy}" for f in self.unrepaired]
        if self.after is None:
            return [*changed, *left, "nothing was written; correct the source, then repair it"]
        return [*changed, *left, *self.after.lines(), f"scene: {self.folder}"]

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            "folder": None if self.folder is None else str(self.folder),
            "done": list(self.done),
            "unrepaired": [{**vars(f), "file": str(f.file), "level": f.level} for f in self.unrepaired],
            "after": None if self.after is None else self.after.as_dict(),
        }


@dataclass(frozen=True)
class _Surface:
    """A part with its new name, and the BSDF that it is to have."""

    part: Part
    name: str
    bsdf: Element


def repair_scene(
    source: str | Path,
    out: str | Path,
    *,
    material: str | None = None,
    frequency_hz: float | None = None,
    units: str = "m",
    up: Up | None = None,
    replace_existing: bool = False,
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
        frequency_hz: carrier, for which materials below their range get constants.
        units: unit of the source's coordinates.
        up: axis that is up in the source.
        replace_existing: replace an existing folder.

    Raises:
        InputError: no such source, an unknown material, a scan, or a folder that exists.
    """
    before = checked(source, frequency_hz=frequency_hz, units=units, up=up)
    if before.report.points:
        raise InputError(f"{source}: a scan; make a scene of it by wrf-mi mesh")
    name = None if material is None else material.removeprefix("itu_")
    if name is not None and name not in ITU:
        raise InputError(f"material {material!r}: unknown; give one of ITU-R P.2040: {', '.join(ITU)}")
    if before.scene is not None and (units != "m" or up is not None):
        moved = [replace(p, corners_m=turned(p.corners_m, up or "z") * UNITS_M[units]) for p in before.parts]
        before = replace(before, parts=tuple(moved))
    work = _Work(before, name, frequency_hz, units != "m")
    if work.unrepaired:
        return Repair(None, tuple(work.done), tuple(work.unrepaired), None)
    out = Path(out)
    with atomic_folder(out, replace_existing) as folder:
        work.write(folder, str(source))
        _require_opens(folder / XML_FILE)
    after = checked(out, frequency_hz=frequency_hz).report
    return Repair(out, tuple(work.done), tuple(after.of_level("fault")), after)


def _require_opens(xml: Path) -> None:
    """Refuse (`InputError`) a repaired scene that plain Sionna RT does not open."""
    from sionna import rt

    for merged in (True, False):
        try:
            rt.load_scene(str(xml), merge_shapes=merged)
        except REFUSALS as error:
            raise InputError(f"the repaired scene is refused by Sionna RT ({reason(error)}); report this") from None


class _Work:
    """Repair in progress: ``done`` and ``unrepaired`` are lists for `Repair`."""

    def __init__(self, before: Checked, material: str | None, frequency_hz: float | None, scaled: bool) -> None:
        self.done = list[str]()
        self.unrepaired = list[Finding]()
        self._before, self._material, self._hz = before, material, frequency_hz
        self._materials: dict[str, Element] = {}
        self._origin_m = np.zeros(3)
        parts = [*before.parts, *self._found_elsewhere()]
        names = {part.name for part in parts}
        for finding in before.report.of_level("fault"):
            lost = finding.kind in ("missing-file", "outside-folder") and finding.shape in set(self._shapes()) - names
            if lost or (finding.kind == "units" and not scaled) or finding.kind in UNREPAIRED:
                self.unrepaired.append(finding)
        self.done += [
            f"{each.shape or each.file.name}: {DONE[each.kind]}" for each in before.report.findings if each.kind in DONE
        ]
        self._surfaces = self._named(self._cleaned(parts))
        if not self._surfaces and not self.unrepaired:
            text = "nothing with an area is left of it"
            self.unrepaired.append(Finding("no-shapes", before.source.path, "", text, "give a scene with surfaces"))

    def _shapes(self) -> dict[str, Element]:
        return {} if self._before.scene is None else dict(self._before.scene.shapes)

    def _found_elsewhere(self) -> list[Part]:
        """Parts whose files are not where the scene names them, but elsewhere in its folder."""
        scene, parts = self._before.scene, list[Part]()
        if scene is None:
            return parts
        for name, shape in scene.shapes:
            plugin, stated = shape.get("type", ""), scene.file_of(shape)
            matrix = to_world(scene, shape)
            if plugin not in ("ply", "obj") or not stated or (scene.path.parent / stated).is_file():
                continue
            other = similar_file(scene.path.parent, stated)
            if other is None or isinstance(matrix, str) or other.suffix.lower() != f".{plugin}":
                continue
            materials = [identifier for identifier, _ in scene.materials(shape)]
            for part in read_triangles(Part(name, (materials or [""])[0], other, np.empty((0, 3, 3))), plugin):
                if isinstance(part, Part):
                    points = trimesh.transform_points(part.corners_m.reshape(-1, 3), matrix)
                    parts.append(replace(part, corners_m=points.reshape(-1, 3, 3)))
                    self.done.append(f"{name}: file {other.name} taken from {other.parent.name or '.'}/")
        return parts

    def _cleaned(self, parts: Sequence[Part]) -> list[Part]:
        """Parts near the origin, without degenerate and doubled faces and double sheets, wound one way."""
        parts = self._without_double_sheets(self._near_origin(parts))
        parts = [self._without_degenerate(part) for part in parts]
        return [self._wound_one_way(part) for part in self._without_copies(parts) if len(part.corners_m)]

    def _near_origin(self, parts: Sequence[Part]) -> list[Part]:
        """Parts moved together by whole hundreds of metres where they are far from the origin."""
        far = [part for part in parts if np.abs(part.corners_m).max(initial=0) >= FARTHEST_M]
        if not far:
            return list(parts)
        low = np.concatenate([part.corners_m.reshape(-1, 3) for part in parts]).min(axis=0)
        self._origin_m = np.where(np.abs(low) < 1000, 0, np.floor(low / 100) * 100)
        parts = [replace(part, corners_m=part.corners_m - self._origin_m) for part in parts]
        for part in parts:
            if np.abs(part.corners_m).max(initial=0) >= FARTHEST_M:
                text = "lies kilometres from other shapes"
                self.unrepaired.append(Finding("far", part.file, part.name, text, "correct its coordinates"))
        text = ", ".join(f"{value:.12g}" for value in self._origin_m)
        self.done.append(f"origin: {text} m subtracted; subtract it from the positions of the measurements, too")
        return parts

    def _without_degenerate(self, part: Part) -> Part:
        empty = without_area(part.corners_m)
        if empty.any():
            self._did(part, f"{empty.sum()} faces without an area left out")
        return replace(part, corners_m=part.corners_m[~empty])

    def _without_copies(self, parts: Sequence[Part]) -> list[Part]:
        if not parts:
            return []
        doubled = copies(np.concatenate([part.corners_m for part in parts]))
        ends = np.cumsum([len(part.corners_m) for part in parts])[:-1]
        cleaned = []
        for part, rows in zip(parts, np.split(doubled, ends), strict=True):
            if rows.any():
                self._did(part, f"{rows.sum()} copies of faces left out")
            cleaned.append(replace(part, corners_m=part.corners_m[~rows]))
        return cleaned

    def _without_double_sheets(self, parts: Sequence[Part]) -> list[Part]:
        """Parts whose flat bodies are moved into the planes of faces of the same material within millimetres."""
        corners = [part.corners_m.copy() for part in parts]
        if not parts:
            return []
        materials = {part.material: number for number, part in enumerate(parts)}
        owner = np.repeat(np.arange(len(parts)), [len(each) for each in corners])
        row = np.concatenate([np.arange(len(each)) for each in corners])
        pairs = double_sheets(np.concatenate(corners), np.array([materials[p.material] for p in parts])[owner])
        sheets = {k: [b for b in bodies(corners[k]) if is_flat(b)] for k in set(owner[pairs].ravel().tolist())}
        moved = set[str]()
        for fixed, other in [*pairs.tolist(), *pairs[:, ::-1].tolist()]:
            k = int(owner[other])
            body = next((each for each in sheets[k] if row[other] in each.faces), None)
            if body is None or (parts[k].name in moved and parts[int(owner[fixed])].name in moved):
                continue
            plane = corners[owner[fixed]][row[fixed]]
            normal = np.cross(plane[1] - plane[0], plane[2] - plane[0])
            normal /= np.linalg.norm(normal)
            away = (corners[k][body.faces] - plane[0]) @ normal
            corners[k][body.faces] -= away[..., None] * normal
            moved.add(parts[k].name)
        self.done += [f"{name or 'mesh'}: sheet moved by millimetres into the plane of another one" for name in moved]
        return [replace(part, corners_m=each) for part, each in zip(parts, corners, strict=True)]

    def _wound_one_way(self, part: Part) -> Part:
        if not any(map(wound_both_ways, bodies(part.corners_m))):
            return part
        corners_m = wound_one_way(part.corners_m)
        count = int((corners_m != part.corners_m).any(axis=(1, 2)).sum())
        self._did(part, f"{count} faces wound the other way")
        return replace(part, corners_m=corners_m)

    def _did(self, part: Part, text: str) -> None:
        self.done.append(f"{part.name or part.file.name}: {text}")

    def _named(self, parts: Sequence[Part]) -> list[_Surface]:
        """Surfaces with safe unique names, and their materials."""
        names, surfaces = set[str](), list[_Surface]()
        shapes = self._shapes()
        for number, part in enumerate(parts, start=1):
            identifier = shapes[part.name].get("id", "") if part.name in shapes else part.name
            wanted = short_name(ascii_name(identifier)) or (part.file.stem if part.file.suffix != ".xml" else "")
            name = plain_name(ascii_name(wanted) or f"shape_{number}", ODD, names | {MERGED})
            names.add(name)
            if identifier and short_name(identifier) != name:
                self.done.append(f"{identifier}: named {name}")
            bsdf = self._material_of(part, shapes.get(part.name))
            if bsdf is not None:
                surfaces.append(_Surface(part, name, bsdf))
        taken = {short_name(bsdf.get("id", "")) for bsdf in self._materials.values()}
        return [s if s.name not in taken else replace(s, name=plain_name(f"{s.name}_1", ODD, names)) for s in surfaces]

    def _material_of(self, part: Part, shape: Element | None) -> Element | None:
        """The BSDF that a part is to have: its radio material, that which names mean, or the one that was asked for."""
        scene = self._before.scene
        stated = [] if scene is None or shape is None else scene.materials(shape)
        for identifier, bsdf in stated:
            usable = None if scene is None or bsdf is None else self._radio(scene, bsdf)
            if usable is not None:
                return self._kept(identifier or part.name, usable)
        names = [*(identifier for identifier, _ in stated), part.name or part.file.stem]
        guessed = next((each for each in map(meant, names) if each), None)
        known = guessed or self._material
        if known is None:
            text = "has no radio material, and its names mean none"
            remedy = f"give one by --material, such as {ITU[1]}"
            self.unrepaired.append(Finding("no-material", self._before.source.path, part.name, text, remedy))
            return None
        self._did(part, f"material {known}{' by its name' if guessed else ''}")
        return self._kept(f"itu_{known}", _itu_bsdf(known, THICKNESS_M[f"itu_{known}"]))

    def _radio(self, scene: SceneXml, bsdf: Element) -> Element | None:
        """A radio material without faults from a BSDF, or from within it; None for another BSDF."""
        for inner in bsdf.iter("bsdf"):
            candidate = Element("bsdf", {**inner.attrib, "id": inner.get("id") or bsdf.get("id") or "mat-material"})
            candidate.extend(inner)
            plain = not is_itu(candidate.get("id", "")) and inner.get("type") not in RADIO
            faults = [f for f in bsdf_findings(scene, "", candidate) if f.level == "fault"]
            if plain or any(fault.kind == "material-values" for fault in faults):
                continue
            material = itu_type(candidate)
            if material is None and (is_itu(candidate.get("id", "")) or inner.get("type") == "itu-radio-material"):
                continue
            return self._in_range(candidate, material)
        return None

    def _in_range(self, bsdf: Element, material: str | None) -> Element:
        """A radio material with its thickness, and with constants below its range."""
        if material is None:
            return bsdf
        stated = bsdf.find("float[@name='thickness']")
        names = (short_name(bsdf.get("id", "")), f"itu_{material}")
        known = next((self._before.source.thickness_m[n] for n in names if n in self._before.source.thickness_m), None)
        thickness_m = known or (SIONNA_THICKNESS_M if stated is None else float(stated.get("value", "nan")))
        new = _itu_bsdf(material, thickness_m, self._hz)
        colour = next((c for c in bsdf.iter("rgb") if c.get("name") in ("color", "reflectance", "base_color")), None)
        if colour is not None:
            SubElement(new, "rgb", name="color", value=colour.get("value", ""))
        for name in ("scattering_coefficient", "xpd_coefficient"):
            if (value := bsdf.find(f"float[@name='{name}']")) is not None and bsdf.get("type") in RADIO:
                new.append(value)
        return new

    def _kept(self, identifier: str, bsdf: Element) -> Element:
        """A BSDF with a safe id that no other one has; the same one for the same id."""
        if identifier in self._materials:
            return self._materials[identifier]
        names = {short_name(each.get("id", "")) for each in self._materials.values()}
        wanted = re.sub(ODD, "_", ascii_name(short_name(identifier))) or "material"
        constants = bsdf.get("type") != "itu-radio-material" and (wanted in ITU or is_itu(wanted))
        name = plain_name(f"my_{wanted}" if constants else f"itu_{wanted}" if wanted in ITU else wanted, ODD, names)
        if name != short_name(identifier):
            self.done.append(f"material {identifier}: named {name}")
        bsdf.set("id", f"mat-{name}")
        self._materials[identifier] = bsdf
        return bsdf

    def write(self, folder: Path, source: str) -> None:
        """Write the scene folder."""
        (folder / "meshes").mkdir()
        root = Element("scene", version="3.0.0")
        root.extend(self._materials.values())
        for surface in self._surfaces:
            mesh = trimesh.Trimesh(**trimesh.triangles.to_kwargs(surface.part.corners_m), process=False)
            mesh.merge_vertices()
            (folder / "meshes" / f"{surface.name}.ply").write_bytes(plain_ply(mesh))
            shape = SubElement(root, "shape", type="ply", id=f"mesh-{surface.name}")
            SubElement(shape, "string", name="filename", value=f"meshes/{surface.name}.ply")
            SubElement(shape, "boolean", name="face_normals", value="true")
            SubElement(shape, "ref", id=surface.bsdf.get("id", ""), name="bsdf")
        ElementTree.indent(root, "    ")
        write_atomically(folder / XML_FILE, ElementTree.tostring(root, encoding="unicode") + "\n")
        facts = {
            "description": f"{len(self._surfaces)} surfaces repaired by wrf-mi check",
            "frame": "that of the source, less origin_m",
            "units": "m",
            "xml": XML_FILE,
            "source": source,
            "origin_m": self._origin_m.tolist(),
            "repairs": self.done,
        }
        write_atomically(folder / FACTS_FILE, yaml.safe_dump(facts, sort_keys=False, width=110))


def ascii_name(name: str) -> str:
    """A name with the letters of ASCII that its letters are written with."""
    return unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()


def meant(name: str) -> str | None:
    """Material of ITU-R P.2040 that a name of a material or shape means; the longest word counts."""
    plain = re.sub(r"[^a-z]", "", ascii_name(name).lower())
    words = sorted((word for word in WORDS if word in plain), key=len)
    return WORDS[words[-1]] if words else None


def _itu_bsdf(material: str, thickness_m: float, frequency_hz: float | None = None) -> Element:
    """Radio material of ITU-R P.2040; with its constants where a carrier is below its range."""
    constants = BELOW_1_GHZ.get(material)
    if frequency_hz is None or in_itu_range(material, frequency_hz) or constants is None:
        bsdf = Element("bsdf", type="itu-radio-material")
        SubElement(bsdf, "string", name="type", value=material)
        numbers: Mapping[str, float] = {"thickness": thickness_m}
    else:
        bsdf = Element("bsdf", type="radio-material")
        numbers = dict(zip(BOUNDS, (*constants, thickness_m), strict=False))
    for name, value in numbers.items():
        SubElement(bsdf, "float", name=name, value=f"{value:.9g}")
    return bsdf
