"""Scene folders: a room as meshes, materials and a file that Mitsuba and Sionna RT both open.

``scene.xml`` and ``meshes/*.ply`` are the scene, ``materials.yml`` is the file to edit, ``scene.yml`` holds source,
frame and counts, and ``preview.png`` is a picture.
"""

from __future__ import annotations

import logging
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from io import StringIO
from itertools import chain, count
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from defusedxml.common import DefusedXmlException
from numpy.typing import ArrayLike
from wrf_mi_scenes.mitsuba_xml import scene_xml

from ..core import InputError
from ..core.files import atomic_folder, inside, listed, one_line, write_atomically, write_figure
from ..core.yaml_files import read_yaml
from .coordinates import require_near
from .materials import FILE as MATERIALS_FILE
from .materials import Materials, materials_text, read_materials
from .mesh.surfaces import Surface, box_of
from .plan.pictures import PlanDrawing
from .xml_file import parsed_xml

logger = logging.getLogger(__name__)

XML_FILE = "scene.xml"
FACTS_FILE = "scene.yml"
PREVIEW_FILE = "preview.png"


@dataclass(frozen=True)
class SceneFolder:
    """Content of a scene folder.

    Attributes:
        folder: path of the folder.
        xml: scene file for Mitsuba and Sionna RT.
        materials: complete materials.
        counts: numbers of its parts.
        origin_m: point [3] of its source, metres, that became the origin, or None.
    """

    folder: Path
    xml: Path
    materials: Materials
    counts: Mapping[str, int]
    origin_m: tuple[float, ...] | None = None


def write_scene(
    folder: str | Path,
    surfaces: Sequence[Surface],
    *,
    frame: str,
    source: str,
    materials: Materials | None = None,
    registration: ArrayLike | None = None,
    origin_m: Sequence[float] | None = None,
    description: str = "",
    points_m: ArrayLike | None = None,
    drawing_below: PlanDrawing | None = None,
    positions_m: ArrayLike | None = None,
    counts: Mapping[str, int] | None = None,
    replace: bool = False,
) -> Path:
    """Write a scene folder atomically and return its path.

    Args:
        folder: path of the folder.
        surfaces: surfaces in the scene's frame, metres.
        frame: axes and origin of the coordinates, one line.
        source: file that the surfaces were made from.
        materials: rules and exceptions; None takes the default rules.
        registration: 4 x 4 matrix from the source's frame to the scene's that has been applied already, or None.
        origin_m: point [3] of the source that has become the origin already, before the registration, or None.
        description: one line.
        points_m: a sample of the scan [n, 3] or [n, 2] in the scene's frame for the preview.
        drawing_below: the plan that the surfaces were made of, for the preview.
        positions_m: measured positions [n, 2] or [n, 3] in the scene's frame, for the preview.
        counts: further numbers for ``scene.yml``.
        replace: replace an existing folder.

    Raises:
        InputError: the folder exists or cannot be written, there is no surface, one is too far from the origin, or
            ``materials`` names an unknown surface.
    """
    from .preview import draw_scene  # matplotlib takes a second, and reading a scene does without

    folder = Path(folder)
    if not surfaces:
        raise InputError(f"{source}: no surface was found in it; a scene needs at least one")
    full = _complete(materials or Materials(), surfaces)
    require_near(box_of(surfaces), source)
    sizes = {"surfaces": len(surfaces), "faces": sum(len(surface.faces) for surface in surfaces)}
    facts = {
        "description": description or f"{len(surfaces)} surfaces made from {Path(source).name}",
        "frame": frame,
        "units": "m",
        "xml": XML_FILE,
        "source": source,
        "origin_m": None if origin_m is None else np.asarray(origin_m, float).tolist(),
        "registration": None if registration is None else np.asarray(registration, float).reshape(4, 4).tolist(),
        "counts": {**sizes, **(counts or {})},
    }
    with atomic_folder(folder, replace=replace) as part:
        (part / "meshes").mkdir()
        for surface in surfaces:
            surface.mesh.export(part / "meshes" / f"{surface.name}.ply", vertex_normal=False)
        write_atomically(part / XML_FILE, scene_xml(full.by_surface(), full.constants))
        write_atomically(part / MATERIALS_FILE, materials_text(full))
        write_atomically(part / FACTS_FILE, yaml.safe_dump(facts, sort_keys=False, width=110))
        drawn: dict[str, Any] = {"points_m": points_m, "drawing_below": drawing_below, "positions_m": positions_m}
        write_figure(part / PREVIEW_FILE, draw_scene(surfaces, materials=full.by_surface(), **drawn))
    return folder


def _complete(materials: Materials, surfaces: Sequence[Surface]) -> Materials:
    """Materials of all surfaces; `InputError` for those of a surface that is not among them."""
    kinds = {surface.name: surface.material or surface.kind for surface in surfaces}
    if len(kinds) < len(surfaces):
        raise ValueError("write_scene: two surfaces have the same name")
    if unknown := [name for name in materials.surfaces if name not in kinds]:
        raise InputError(f"materials: no surface {unknown[0]!r} in this scene; it has {listed(kinds)}")
    return materials.complete(kinds)


def plain_name(name: str, odd: str, names_in_use: Collection[str]) -> str:
    """A name without the characters of a pattern, which become ``_``, and numbered where it is in use."""
    plain = re.sub(odd, "_", name)
    candidates = chain([plain], (f"{plain}_{number}" for number in count(2)))
    return next(free for free in candidates if free not in names_in_use)


def read_scene_folder(folder: str | Path) -> SceneFolder:
    """Read a scene folder.

    If ``scene.xml`` and ``materials.yml`` name different materials, ``scene.xml`` is written anew; additions by hand
    are lost.

    `InputError`: a file is missing or damaged, a surface has no mesh, or the scene file cannot be written.
    """
    folder = Path(folder)
    facts = read_yaml(folder / FACTS_FILE)
    xml = scene_file(folder, facts)
    materials = read_materials(folder / MATERIALS_FILE)
    meshes = {path.stem for path in (folder / "meshes").glob("*.ply")}
    if odd := sorted(meshes ^ set(materials.surfaces)):
        which = "no mesh in meshes/" if odd[0] in materials.surfaces else f"not among surfaces in {MATERIALS_FILE}"
        raise InputError(f"{folder}: surface {odd[0]!r} has {which}; write the scene anew")
    full = materials.complete(materials.surfaces)
    text = scene_xml(full.by_surface(), full.constants)
    if _materials_in(xml) != _materials_in(StringIO(text)):
        logger.info("%s: materials changed in %s, written anew", xml, MATERIALS_FILE)
        try:
            write_atomically(xml, text)
        except OSError as error:
            reason = f"{xml}: must follow {MATERIALS_FILE} and cannot be written ({one_line(error.strerror or error)})"
            raise InputError(f"{reason}; copy the folder and open the copy") from None
    counts = facts.get("counts")
    return SceneFolder(folder, xml, full, counts if isinstance(counts, dict) else {}, _origin(folder, facts))


def _origin(folder: Path, facts: Mapping[Any, Any]) -> tuple[float, ...] | None:
    value = facts.get("origin_m")
    if not value:
        return None
    try:
        origin_m = tuple(map(float, value))
    except (TypeError, ValueError):
        origin_m = ()
    if len(origin_m) != 3 or not np.isfinite(origin_m).all():
        raise InputError(f"{folder / FACTS_FILE}: origin_m is not a point; give x, y and z in metres")
    return origin_m


def scene_file(folder: Path, facts: Mapping[Any, Any]) -> Path:
    """The scene file of a folder by the content of its ``scene.yml``; `InputError` for none, or one elsewhere."""
    if "xml" not in facts:
        raise InputError(f"{folder / FACTS_FILE}: no xml in it; write the scene anew")
    return inside(folder, facts["xml"], folder / FACTS_FILE)


def _materials_in(xml: Path | StringIO) -> tuple[dict[str, str], dict[str, dict[str, float]]]:
    """Material of each shape of a scene file by the shape's name, and constants of materials of its own."""
    try:
        root = parsed_xml(xml)
        constants = {
            bsdf.get("id", "").removeprefix("mat-"): {
                value.get("name", ""): float(value.get("value", "nan")) for value in bsdf.findall("float")
            }
            for bsdf in root.findall("bsdf[@type='radio-material']")
        }
    except (OSError, ElementTree.ParseError, ValueError, DefusedXmlException):
        return {}, {}
    references = {shape.get("id", "").removeprefix("mesh-"): shape.find("ref") for shape in root.findall("shape")}
    return {n: r.get("id", "").removeprefix("mat-") for n, r in references.items() if r is not None}, constants
