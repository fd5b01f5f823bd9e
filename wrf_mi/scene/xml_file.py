"""Scene files of others for Mitsuba: read without entities, with known plugins, and with files of their own folder."""

from __future__ import annotations

import re
from collections.abc import Mapping
from io import StringIO
from pathlib import Path
from typing import cast
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from defusedxml.common import DefusedXmlException
from defusedxml.ElementTree import parse

from ..core import InputError
from ..core.files import inside, one_line

PLUGINS = {
    "shape": "ply obj serialized rectangle cube sphere disk cylinder shapegroup instance merge",
    "bsdf": "radio-material itu-radio-material absorber-radio-material twosided diffuse roughplastic plastic "
    "principled conductor roughconductor dielectric roughdielectric thindielectric mask bumpmap normalmap blendbsdf "
    "null",
    "texture": "bitmap checkerboard uniform mesh_attribute volume",
    "emitter": "area point constant envmap directional spot",
    "sensor": "perspective thinlens orthographic",
    "film": "hdrfilm",
    "sampler": "independent stratified multijitter orthogonal ldsampler",
    "rfilter": "box tent gaussian mitchell catmullrom lanczos",
    "integrator": "path direct depth aov volpath",
    "spectrum": "uniform regular irregular srgb d65 blackbody",
}
"""Plugins that a scene file may name, by the element that names them: geometry, materials and what pictures need."""
VALUES = (
    *("scene", "default", "string", "float", "integer", "boolean", "vector", "point", "rgb", "spectrum", "ref"),
    *("transform", "translate", "rotate", "scale", "matrix", "lookat"),
)
"""Elements without a plugin. ``include``, ``path`` and ``alias`` are not among them: they reach other files."""
PARAMETER = re.compile(r"\$(\w+)")  # a place that a caller's value or a default takes
FILES = ("filename",)  # names of texts that are files
DEEPEST = 64  # most levels of elements: Mitsuba's reader calls itself for each


OVERRULED = "has constants and an id of ITU-R P.2040, by which Sionna RT leaves them out; rename it, without itu"


def overruled(bsdf: Element) -> bool:
    """Whether a BSDF states constants, in place of which Sionna RT takes those of ITU-R P.2040 for its id."""
    is_itu = bsdf.get("id", "").removeprefix("mat-").startswith(("itu_", "itu-"))
    parameters = {child.get("name") for child in bsdf}
    return is_itu and bool(parameters & {"relative_permittivity", "conductivity"})


def make_files_absolute(root: Element, path: Path) -> None:
    """Name the files of a scene file, in place, so that it may be written elsewhere."""
    for text in root.iter("string"):
        if text.get("name") in FILES:
            text.set("value", str((path.parent / text.get("value", "")).absolute()))


def parsed_xml(source: Path | StringIO) -> Element:
    """The root of an XML file, the values of its ``<default>`` elements in the places of ``$name``, as in Mitsuba.

    `DefusedXmlException`: a document type or entities.
    """
    root = cast(Element, parse(source, forbid_dtd=True).getroot())
    defaults: dict[str, str] = {}
    for element in root.iter():
        for key, value in element.items():
            if "$" in value:
                element.set(key, PARAMETER.sub(lambda match: defaults.get(match[1], match[0]), value))
        if element.tag == "default":  # counts from here on; the first of a name holds
            defaults.setdefault(element.get("name", ""), element.get("value", ""))
    return root


def read_scene_xml(path: Path, check_shapes: bool = True) -> Element:
    """The root of a scene file.

    `InputError`: missing, not XML in UTF-8, or with an element, plugin or entity that a scene file may not name; with
    ``check_shapes`` also with a type of shape or a file that it may not name, or a value that is left to the caller.
    """
    try:
        path.read_text("utf-8")
        root = parsed_xml(path)
    except DefusedXmlException:
        raise InputError(f"{path}: has a document type or entities; remove them") from None
    except (ElementTree.ParseError, OSError, ValueError, LookupError) as error:
        raise InputError(f"{path}: cannot be opened ({one_line(error)}); correct the scene") from None
    named = {id(shape): f"{path}: {name}" for name, shape in named_shapes(root)}
    _check(root, str(path), named, path.parent if check_shapes else None, 0)
    if root.tag != "scene" or not root.get("version"):
        raise InputError(
            f'{path}: begins with <{root.tag}>, not with a scene and its version; write <scene version="3.0.0">'
        )
    return root


def named_shapes(root: Element) -> list[tuple[str, Element]]:
    """Shapes of a scene, those within shapes included, each after its name in messages: its id, or else its number."""

    def name(number: int, shape: Element) -> str:
        return f"shape {shape.get('id', '')!r}" if shape.get("id") else f"shape {number} ({shape.get('type')}, no id)"

    return [(name(number, shape), shape) for number, shape in enumerate(root.iter("shape"), start=1)]


def _check(element: Element, where: str, named: Mapping[int, str], folder: Path | None, depth: int) -> None:
    where = named.get(id(element), where)
    if depth > DEEPEST:
        raise InputError(f"{where}: elements within elements to more than {DEEPEST} levels; correct the scene")
    tag = element.tag
    if tag != "shape" or folder is not None:
        _check_plugin(element, where)
    if tag == "string" and "$" in element.get("value", "") and folder is not None:
        raise InputError(f"{where}: a value with a parameter ($) that has no <default>; write the value in its place")
    if tag == "string" and element.get("name") in FILES and folder is not None:
        inside(folder, element.get("value", ""), where)
    for child in element:
        _check(child, where, named, folder, depth + 1)


def _check_plugin(element: Element, where: str) -> None:
    tag, plugin = element.tag, element.get("type", "")
    plugins = PLUGINS.get(tag, "").split()
    if plugin not in plugins if plugin else tag not in VALUES:
        what = f"plugin {plugin[:40]!r} of <{tag}>" if plugins else f"element <{tag[:40]}>"
        remedy = f"known are {', '.join(plugins or [*VALUES, *PLUGINS])}"
        raise InputError(f"{where}: {one_line(what)} does not belong into a scene; {remedy}")
