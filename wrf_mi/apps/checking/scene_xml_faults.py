"""Faults of a Mitsuba scene file: elements, names, materials and files, without its geometry."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from wrf_mi_scenes.mitsuba_xml import THICKNESS_M

from ...core import InputError
from ...core.files import MOST_NAME, inside, listed
from ...scene.scattering import SCATTERING, check_scattering, stated_scattering
from ...scene.xml_file import FILES, OVERRULED, VALUES, named_shapes, overruled, read_scene_xml
from .scene_findings import Finding, refused

ITU = tuple(name.removeprefix("itu_") for name in THICKNESS_M)  # materials of ITU-R P.2040 that Sionna RT knows
RADIO = ("radio-material", "itu-radio-material", "absorber-radio-material")
LEAST: Mapping[str, float] = {"relative_permittivity": 1, "conductivity": 0, "thickness": 0}
"""Least values of the numbers of a radio material in Sionna RT."""
PARAMETERS: Mapping[str, tuple[str, ...]] = {
    "ply": ("filename", "flip_tex_coords"),
    "obj": ("filename", "flip_tex_coords"),
    "serialized": ("filename", "shape_index"),
    "sphere": ("center", "radius"),
    "cylinder": ("p0", "p1", "radius"),
    **dict.fromkeys(("disk", "rectangle", "cube"), ()),
}
"""Parameters of the shapes that are opened or repaired, beside `ALL_SHAPES`."""
ALL_SHAPES = ("to_world", "flip_normals", "face_normals")
SMOOTH = ("sphere", "cylinder", "disk")  # shapes that Mitsuba does not hold as triangles
MERGED = "merged-shapes"
VERSION = re.compile(r"(\d+)\.\d+\.\d+")
DASH = "mat-"  # begin of ids of Blender's exporter, which Sionna RT leaves out
OWN_ID = "give each element an id of its own"
GIVE = 'give the shape a material: <ref id="mat-itu_concrete" name="bsdf"/>, or --repair with --material NAME'


def short_name(identifier: str) -> str:
    """Name of a radio material or object in Sionna RT by its id in a scene file."""
    return identifier.removeprefix(DASH).removeprefix("mesh-")


@dataclass(frozen=True)
class SceneXml:
    """A parsed scene file.

    Attributes:
        path: the file.
        root: its first element.
    """

    path: Path
    root: Element

    @cached_property
    def shapes(self) -> list[tuple[str, Element]]:
        """Shapes, each with its id, or else its number and type."""
        return [(shape.get("id") or name.removeprefix("shape "), shape) for name, shape in named_shapes(self.root)]

    @cached_property
    def bsdfs(self) -> dict[str, Element]:
        """BSDFs that shapes may refer to, by their id."""
        return {bsdf.get("id", ""): bsdf for bsdf in self.root.findall("bsdf")}

    @property
    def has_old_names(self) -> bool:
        """Whether Mitsuba reads parameters as in its versions 0.x, toWorld for to_world."""
        version = VERSION.fullmatch(self.root.get("version", ""))
        return version is not None and int(version[1]) < 2

    def parameter(self, element: Element) -> str:
        """Name of a parameter in Mitsuba 3."""
        name = element.get("name", "")
        return re.sub(r"(?<!^)(?=[A-Z])", "_", name).lower() if self.has_old_names else name

    def materials(self, shape: Element) -> list[tuple[str, Element | None]]:
        """BSDFs of a shape by their ids, as elements or references to them; None: no element has the id."""
        return [
            (child.get("id", ""), self.bsdfs.get(child.get("id", "")) if child.tag == "ref" else child)
            for child in shape
            if child.tag == "bsdf" or (child.tag == "ref" and child.get("id", "") not in self._others)
        ]

    @cached_property
    def _others(self) -> set[str]:
        return {element.get("id", "") for element in self.root if element.tag not in ("bsdf", "shape")}

    def file_of(self, shape: Element) -> str | None:
        """Name of a shape's file as the scene file states it."""
        return next((each.get("value", "") for each in shape.findall("string") if each.get("name") in FILES), None)


def read_xml(path: Path) -> SceneXml | Finding:
    """Parse a scene file, or say why that fails."""
    try:
        return SceneXml(path, read_scene_xml(path, check_shapes=False))
    except InputError as error:
        return refused("xml", path, error)


def xml_findings(scene: SceneXml) -> Iterator[Finding]:
    """Findings about a scene file, but for its geometry."""
    root, path = scene.root, scene.path
    if not scene.shapes:
        yield Finding("no-shapes", path, "", "holds no <shape>", "give a scene with surfaces")
    yield from _elements(scene)
    yield from _ids(scene)
    for number, bsdf in enumerate(root.findall("bsdf"), start=1):
        yield from bsdf_findings(scene, f"<bsdf> {bsdf.get('id') or number}", bsdf)
    for name, shape in scene.shapes:
        yield from _shape(scene, name, shape)
        yield from _material(scene, name, shape)


def _elements(scene: SceneXml) -> Iterator[Finding]:
    """Parameters that are left open, and files."""
    for element, name, is_converted in _walk(scene):
        value = element.get("value", "")
        if "$" in value:
            text = f"the value {value[:40]} is left to the caller and has no <default>"
            yield Finding("parameter", scene.path, name, text, "write the value in its place")
        elif element.tag == "string" and element.get("name") in FILES and not is_converted:
            yield from _file(scene, name, value)


def _walk(scene: SceneXml) -> Iterator[tuple[Element, str, bool]]:
    """Elements below the first, the name of their shape, and whether they are in a BSDF that Sionna RT replaces."""
    shapes = {id(shape): name for name, shape in scene.shapes}
    stack = [(child, "", False) for child in reversed(list(scene.root))]
    while stack:
        element, name, is_converted = stack.pop()
        name = shapes.get(id(element), name)
        is_converted |= element.tag == "bsdf" and is_itu(element.get("id", ""))
        stack.extend((child, name, is_converted) for child in reversed(list(element)))
        yield element, name, is_converted


def is_itu(identifier: str) -> bool:
    """Whether Sionna RT makes a material of ITU-R P.2040 of a BSDF with an id."""
    return identifier.removeprefix(DASH)[:4] in ("itu_", "itu-")


def _file(scene: SceneXml, name: str, file_name: str) -> Iterator[Finding]:
    try:
        file = inside(scene.path.parent, file_name, scene.path)
    except InputError:
        text = f"{file_name[:MOST_NAME]!r} is not in the folder of the scene"
        yield Finding("outside-folder", scene.path, name, text, "copy the file there and name it so")
        return
    if not file.is_file():
        other = similar_file(scene.path.parent, file_name)
        also = "" if other is None else f", but {other.relative_to(scene.path.parent).as_posix()} is"
        text = f"{file_name[:MOST_NAME]!r} is not in its place{also}"
        yield Finding("missing-file", scene.path, name, text, "correct the name (with / between folders)")


def similar_file(folder: Path, stated: str) -> Path | None:
    """The only file in a scene's folder, or one below it, with the name that a path ends with, in any case."""
    name = re.split(r"[\\/]", stated)[-1].casefold()
    candidates = [file for file in [*folder.glob("*"), *folder.glob("*/*")] if file.name.casefold() == name]
    return candidates[0] if len(candidates) == 1 and candidates[0].is_file() else None


def _ids(scene: SceneXml) -> Iterator[Finding]:
    used = {identifier for _, shape in scene.shapes for identifier, _ in scene.materials(shape)}
    first: dict[str, Element] = {}
    short: dict[str, str] = {}
    for element, name in _with_ids(scene):
        identifier, tag = element.get("id", ""), element.tag
        same = short.get(short_name(identifier))
        if identifier in first:
            text = f"<{tag}> has the id {identifier!r}, as <{first[identifier].tag}> before it"
            yield Finding("duplicate-id", scene.path, name, text, OWN_ID)
        elif tag == "shape" or (tag == "bsdf" and identifier in used):  # unused BSDFs are not opened
            if same is not None:
                text = f"{identifier!r} has the name {short_name(identifier)!r} in Sionna RT, as {same!r} has"
                yield Finding("duplicate-id", scene.path, name, text, OWN_ID)
            short.setdefault(short_name(identifier), identifier)
        first.setdefault(identifier, element)


def _with_ids(scene: SceneXml) -> list[tuple[Element, str]]:
    """Elements with ids, and the name of the shape that they are or are in."""
    elements = [(element, "") for element in scene.root if element.tag != "shape"]
    for name, shape in scene.shapes:
        elements += [(shape, name), *((bsdf, name) for bsdf in shape.findall("bsdf"))]
    return [(element, name) for element, name in elements if element.get("id")]


def bsdf_findings(scene: SceneXml, where: str, bsdf: Element) -> Iterator[Finding]:
    """Findings about a BSDF, which stands where it is named, that do not depend on its use."""
    identifier, plugin = bsdf.get("id", ""), bsdf.get("type", "")
    name = identifier.removeprefix(DASH)
    if not identifier:
        text = f"<bsdf> ({plugin}) has no id"
        yield Finding("bsdf-id", scene.path, where, text, 'give it one of its own, such as id="mat-my_material"')
    if is_itu(identifier) or plugin == "itu-radio-material":
        yield from _itu(scene, where, bsdf)
    elif name in ITU:
        remedy = "ids of materials of ITU-R P.2040 begin with mat-itu_"
        yield Finding("unknown-material", scene.path, where, f"the id {identifier!r} lacks itu_", remedy)
    if plugin == "absorber-radio-material":
        yield Finding("absorber", scene.path, where, "an absorber", "nothing to do in wrf-mi")
    elif plugin in RADIO and not is_itu(identifier):
        yield from _values(scene, where, bsdf)
    try:
        check_scattering("", stated_scattering(bsdf, scene.root))
    except InputError as error:
        yield refused("material-values", scene.path, error, where)


def stated_itu(bsdf: Element) -> str:
    """Material of ITU-R P.2040 that a BSDF states by its type or id, without ``itu_``."""
    type_element = bsdf.find("string[@name='type']")
    identifier = bsdf.get("id", "")
    named = identifier.removeprefix(DASH)[4:] if is_itu(identifier) else ""
    return named if type_element is None else type_element.get("value", "")


def itu_type(bsdf: Element) -> str | None:
    """Material of ITU-R P.2040 that Sionna RT makes of a BSDF, without ``itu_``; None for another one."""
    is_one = is_itu(bsdf.get("id", "")) or bsdf.get("type") == "itu-radio-material"
    return material if is_one and (material := stated_itu(bsdf)) in ITU else None


def _itu(scene: SceneXml, where: str, bsdf: Element) -> Iterator[Finding]:
    """Findings about a BSDF that Sionna RT makes a material of ITU-R P.2040 of."""
    if overruled(bsdf):
        text, _, remedy = OVERRULED.partition("; ")
        yield Finding("material-values", scene.path, where, text, remedy)
    if (material := stated_itu(bsdf)) not in ITU:
        remedy = f"known are {', '.join(ITU)}, and constants of your own"
        yield Finding("unknown-material", scene.path, where, f"ITU-R P.2040 has no {material!r}", remedy)
    elif bsdf.find("float[@name='thickness']") is None:
        remedy = "nothing to do if that is right; thickness_m of a scene folder overrides it"
        yield Finding("default-thickness", scene.path, where, "no thickness: Sionna RT takes 0.1 m", remedy)


def _values(scene: SceneXml, where: str, bsdf: Element) -> Iterator[Finding]:
    """Numbers of a radio material that are out of bounds, and parameters that it does not have."""
    values = {child.get("name", ""): child.get("value", "") for child in bsdf if child.tag in ("float", "string")}
    values = {name: text for name, text in values.items() if name not in SCATTERING}
    if bsdf.get("type") == "itu-radio-material":
        values.pop("type", None)
    elif "relative_permittivity" not in values:
        remedy = "state relative_permittivity and conductivity (S/m)"
        yield Finding("no-constants", scene.path, where, "no relative permittivity: that of air is taken", remedy)
    for name, text in values.items():
        value = number(text)
        if value is None or value < LEAST.get(name, np.inf):
            remedy = f"Sionna RT takes {', '.join(f'{parameter} {least:g}..' for parameter, least in LEAST.items())}"
            yield Finding("material-values", scene.path, where, f"{name} is {text[:40]!r}", remedy)


def number(text: str) -> float | None:
    """A finite number; None for another text."""
    try:
        value = float(text)
    except ValueError:
        return None
    return value if abs(value) <= 3.4e38 else None


def _shape(scene: SceneXml, name: str, shape: Element) -> Iterator[Finding]:
    path, plugin = scene.path, shape.get("type", "")
    if plugin not in PARAMETERS:
        remedy = f"write it as a PLY mesh; opened are {', '.join(PARAMETERS)}"
        yield Finding("unsupported-shape", path, name, f"a shape of type {plugin[:40]!r}", remedy)
        return
    if plugin in SMOOTH:
        text = f"a {plugin}, and Sionna RT traces triangles alone"
        yield Finding("shape-type", path, name, text, "--repair makes a mesh of it")
    yield from _parameters(scene, name, shape)
    file_name = scene.file_of(shape)
    if plugin in ("ply", "obj") and file_name and "$" not in file_name and not file_name.lower().endswith(f".{plugin}"):
        text = f"of type {plugin!r}, with the file {file_name[-60:]!r}"
        yield Finding("mesh", path, name, text, "give a file of that type, converted if need be")


def _parameters(scene: SceneXml, name: str, shape: Element) -> Iterator[Finding]:
    """Parameters of a shape that it does not have, or that are missing or stated twice."""
    path, plugin = scene.path, shape.get("type", "")
    names = [scene.parameter(child) for child in shape if child.tag in VALUES and child.tag != "ref"]
    parameters = (*PARAMETERS[plugin], *ALL_SHAPES)
    for parameter, count in Counter(names).items():
        if parameter not in parameters:
            remedy = f"remove it, or write it as {', '.join(parameters)}"
            yield Finding("unknown-parameter", path, name, f"no {plugin} has the parameter {parameter[:40]!r}", remedy)
        elif count > 1:
            yield Finding("parameter", path, name, f"the parameter {parameter!r} is stated twice", "remove one of both")
    if "filename" in parameters and "filename" not in names:
        yield Finding("parameter", path, name, "has no file", 'give one: <string name="filename" value="..."/>')


def _material(scene: SceneXml, name: str, shape: Element) -> Iterator[Finding]:
    path, materials = scene.path, scene.materials(shape)
    for inline in shape.findall("bsdf"):
        yield from bsdf_findings(scene, name, inline)
    if not materials:
        yield Finding("no-material", path, name, "has no material", GIVE)
    if len(materials) > 1:
        text = f"has {len(materials)} materials: {listed(identifier for identifier, _ in materials)}"
        yield Finding("two-materials", path, name, text, "leave one of them")
    for identifier, bsdf in materials:
        if bsdf is None:
            yield Finding("unknown-reference", path, name, f"no <bsdf> has the id {identifier[:60]!r}", GIVE)
        elif not _is_radio(identifier, bsdf):
            within = any(inner.get("type") in RADIO for inner in bsdf.iter("bsdf"))
            text = f"its material {identifier!r} is {bsdf.get('type')!r}{', around a radio material' if within else ''}"
            remedy = "name it mat-itu_concrete or the like, or give constants; --repair does with --material NAME"
            yield Finding("not-radio", path, name, text, remedy)


def _is_radio(identifier: str, bsdf: Element) -> bool:
    """Whether a BSDF is a radio material in Sionna RT, or is meant to be one and named wrongly."""
    return bsdf.get("type") in RADIO or is_itu(identifier) or identifier.removeprefix(DASH) in ITU
