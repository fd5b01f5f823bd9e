"""Surfaces of building models in IFC: walls, slabs, doors, windows, columns and furniture, with their materials.

Source: ISO 16739-1:2018, Industry Foundation Classes.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...core import InputError
from ...core.files import listed, one_line
from ..coordinates import extra_package
from ..material_names import meant
from .sheets import as_sheets
from .surfaces import Kind, Surface, number_names

logger = logging.getLogger(__name__)

CLASSES: dict[str, tuple[Kind, str, str]] = {
    "IfcWall": ("wall", "wall", ""),
    "IfcCurtainWall": ("wall", "wall", "itu_glass"),
    "IfcSlab": ("floor", "floor", "itu_concrete"),
    "IfcRoof": ("ceiling", "ceiling", "itu_concrete"),
    "IfcCovering": ("ceiling", "ceiling", ""),
    "IfcDoor": ("other", "door", "itu_wood"),
    "IfcWindow": ("other", "window", "itu_glass"),
    "IfcPlate": ("wall", "wall", "itu_glass"),
    "IfcColumn": ("other", "column", "itu_concrete"),
    "IfcBeam": ("other", "beam", "itu_concrete"),
    "IfcMember": ("other", "member", "itu_metal"),
    "IfcStair": ("other", "stair", "itu_concrete"),
    "IfcStairFlight": ("other", "stair", "itu_concrete"),
    "IfcRamp": ("other", "ramp", "itu_concrete"),
    "IfcRampFlight": ("other", "ramp", "itu_concrete"),
    "IfcRailing": ("other", "railing", "itu_metal"),
    "IfcFurnishingElement": ("other", "furniture", ""),
    "IfcBuildingElementProxy": ("other", "proxy", ""),
}
"""Classes that are read: kind of their surfaces, beginning of their names, and material where none is known."""
COVERINGS: dict[str, Kind] = {"FLOORING": "floor", "CLADDING": "wall"}  # kinds of coverings that are no ceilings
TOP_M = 0.5  # a slab whose lower side is at most this far below the tops of all walls is no floor


def read_ifc(path: Path) -> list[Surface]:
    """Surfaces of the elements of a model in its coordinates, metres, z up, openings cut out of walls.

    The material of an element is that which the names of its materials (of the thickest layer first), its type and the
    element mean (`wrf_mi.scene.material_names.meant`); panes of windows are of glass.

    Raises:
        InputError: damaged, or without an element that is read.
    """
    ifcopenshell = extra_package("ifcopenshell")
    from ifcopenshell import geom

    try:
        model = ifcopenshell.open(str(path))
        elements = [element for name in _classes(model) for element in model.by_type(name)]
        settings = geom.settings()
        settings.set("use-world-coords", True)
        shapes: list[Any] = list(geom.iterator(settings, model, 1, include=elements)) if elements else []
    except (ifcopenshell.Error, RuntimeError, OSError) as error:
        raise InputError(f"{path}: not an IFC that can be read ({one_line(error)}); export it anew") from None
    parts: list[tuple[Kind, str, str, Any, Any]] = []
    unknown: list[str] = []
    for shape in shapes:
        element = model.by_id(shape.id)
        vertices, faces = (np.array(getattr(shape.geometry, part)).reshape(-1, 3) for part in ("verts", "faces"))
        if len(faces):
            kind, name, usual = _role(element)
            names = _material_names(element)
            material = next(filter(None, map(meant, names)), None) if name != "window" else "glass"
            unknown += [names[0]] if names and not material else []
            parts.append((kind, name, f"itu_{material}" if material else usual, vertices, faces))
    if not parts:
        raise InputError(f"{path}: no wall, slab or other element with a shape; export the model of the architecture")
    if unknown:
        text = "%s: %d of %d materials are not known by their names (%s), and are the usual ones of their elements"
        logger.warning(f"{text}; correct materials.yml", path, len(unknown), len(parts), listed(dict.fromkeys(unknown)))
    top_m = max((part[3][:, 2].max() for part in parts if part[0] == "wall"), default=np.inf)
    # The uppermost slab of a storey without a roof is its ceiling, whatever its class.
    roofs = [part[0] == "floor" and part[3][:, 2].min() >= top_m - TOP_M for part in parts]
    beginnings = ["ceiling" if is_roof else part[1] for is_roof, part in zip(roofs, parts, strict=True)]
    surfaces = [
        Surface(name, "ceiling" if is_roof else kind, vertices, faces, material)
        for name, is_roof, (kind, _, material, vertices, faces) in zip(
            number_names(beginnings), roofs, parts, strict=True
        )
    ]
    return as_sheets(surfaces, path)


def _classes(model: Any) -> list[str]:
    """Classes of `CLASSES` that the schema of a model has."""
    from ifcopenshell import ifcopenshell_wrapper

    schema_classes = {each.name() for each in ifcopenshell_wrapper.schema_by_name(model.schema_identifier).entities()}
    return [name for name in CLASSES if name in schema_classes]


def _role(element: Any) -> tuple[Kind, str, str]:
    kind, name, usual = next(role for of, role in CLASSES.items() if element.is_a(of))
    predefined_type = str(getattr(element, "PredefinedType", None) or "")
    if element.is_a("IfcSlab") and predefined_type == "ROOF":
        kind = "ceiling"
    elif element.is_a("IfcCovering"):
        kind = COVERINGS.get(predefined_type, kind)
    return kind, kind if name in ("floor", "ceiling") else name, usual


def _material_names(element: Any) -> Sequence[str]:
    """Names that state the material of an element, the most telling first."""
    from ifcopenshell.util.element import get_material, get_materials, get_type

    material = get_material(element, should_skip_usage=True)
    layers = sorted(getattr(material, "MaterialLayers", None) or (), key=lambda layer: -layer.LayerThickness)
    of_layers = [layer.Material for layer in layers if layer.Material]
    parts = [*(of_layers or get_materials(element)), get_type(element), element]
    return [name for part in parts if part is not None and (name := part.Name)]
