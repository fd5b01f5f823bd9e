"""Floor plans in DXF: lines of the layers of walls, doors and windows, in metres."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from ...core import InputError
from ...core.angles import FloatArray
from ...core.files import listed, one_line
from ..coordinates import LARGEST_M, SMALLEST_M, UNITS_M, extra_package
from ..material_names import ascii_name, meant
from .faces import DOOR, GLASS, SAG_M, WALL, PlanLines, straight_pieces

logger = logging.getLogger(__name__)

INSERT_UNITS = {1: "in", 2: "ft", 4: "mm", 5: "cm", 6: "m", 14: "dm"}  # values of $INSUNITS (Autodesk, "DXF Reference")
BEGINNINGS = {
    WALL: "wall wand waend wande trennw mauer mur pared paret cloison vagg vegg scian sten sein partition",
    DOOR: "door tuer tur porte puert porta deur drzwi dorr",
    GLASS: "glaz glas wind fenst fenetre ventan finest janel vitr raam okn fonster",
}
"""Beginnings of words in names of layers, without accents, and what is drawn on them; the first counts."""
ANNOTATION = "iden anno text dim patt hatch demo note symb bemass beschr legend head centre center axis furn"
SWEEP_RAD, SAG_SHARE = np.radians([25, 100]), 0.01
"""Angles of the arc of a door's leaf, and largest deviation from a circle, a share of its radius."""
DOOR_M = 0.4, 2.0  # usual widths of doors
Leaf = tuple[FloatArray, float, FloatArray]
"""Hinge of a door's leaf [2], its width, and both ends of its arc [2, 2]."""
JAMB_M, LEAF_M = 0.35, 0.15  # largest distance of a closed leaf's end, and least of its middle, from walls


def read_dxf(path: Path, units: str | None = None, layers: Sequence[str] = ()) -> PlanLines:
    """Walls, windows and closed doors of the model space of a DXF, its blocks exploded, metres.

    Walls are the lines of layers whose names say so, or of those that are stated. Windows are of glass, as is a wall on
    a layer named after a material of that material. A door is the chord of an arc that closes a gap.

    Args:
        path: the file.
        units: unit of its coordinates; None: that which it states.
        layers: names of the layers of walls; ``*`` and ``?`` are wildcards.

    Raises:
        InputError: damaged, without a unit, an extent that is no building's, or unclear layers.
    """
    ezdxf = extra_package("ezdxf")
    try:
        document = ezdxf.readfile(path)
    except (OSError, ezdxf.DXFError, ValueError, UnicodeError) as error:
        raise InputError(f"{path}: not a DXF that can be read ({one_line(error)}); export it anew") from None
    document_unit = INSERT_UNITS.get(document.header.get("$INSUNITS", 0))
    if (unit := units or document_unit) not in UNITS_M:
        raise InputError(f"{path}: does not state the unit of its lines; give it by --units ({', '.join(UNITS_M)})")
    drawn: dict[str, list[FloatArray]] = {}
    try:
        for layer, curve in _curves(document.modelspace(), "0", SAG_M / UNITS_M[unit]):
            if layers or layer not in document.layers or not _is_hidden(document.layers.get(layer)):
                drawn.setdefault(layer, []).append(curve * UNITS_M[unit])
    except RecursionError:
        raise InputError(f"{path}: a block contains itself; explode it") from None
    roles = _roles(path, drawn, layers)
    lines = {role: [c for layer in names for c in drawn[layer]] for role, names in roles.items()}
    leaves = [circle for curve in lines.get(DOOR, []) if (circle := _circle(curve))]
    _check_unit(path, np.concatenate([curve for role in lines if role != DOOR for curve in lines[role]]), leaves, unit)
    pieces = {role: straight_pieces(parts) for role, parts in lines.items() if role != DOOR}
    if closed := _closed_leaves(leaves, pieces):
        pieces[DOOR] = np.array(closed)
    text = "%s: %s; %d of %d doors are closed, and windows are of glass from floor to ceiling"
    described = ", ".join(f"{role} of {listed(names)}" for role, names in roles.items())
    logger.warning(text, path, described, len(closed), len(leaves))
    return PlanLines(pieces, by_faces=True)


def _is_hidden(layer: Any) -> bool:
    return bool(layer.is_off() or layer.is_frozen())


def _curves(entities: Any, layer: str, sag: float) -> Iterator[tuple[str, FloatArray]]:
    """Layer and points [n, 2] of each curve; parts of blocks on layer 0 are on that of the block."""
    from ezdxf import path as paths

    for entity in entities:
        entity_layer = layer if entity.dxf.layer == "0" else entity.dxf.layer
        if entity.dxftype() == "INSERT":
            for block in entity.multi_insert() if entity.mcount > 1 else (entity,):
                yield from _curves(block.virtual_entities(), entity_layer, sag)
        elif entity.dxftype() == "POLYLINE" and not (entity.is_2d_polyline or entity.is_3d_polyline):
            continue
        elif entity.dxftype() in ("LINE", "LWPOLYLINE", "POLYLINE", "ARC", "CIRCLE", "ELLIPSE", "SPLINE"):
            points = np.array([(point.x, point.y) for point in paths.make_path(entity).flattening(sag)])
            if len(points) > 1 and np.isfinite(points).all():
                yield entity_layer, points


def _role(layer: str) -> str | None:
    """What is drawn on a layer by its name, None if that does not say it."""
    words = re.findall(r"[a-z]+", ascii_name(layer).lower())
    if any(word.startswith(tuple(ANNOTATION.split())) for word in words):
        return None
    roles = [
        role
        for role, beginnings in BEGINNINGS.items()
        if any(word.startswith(tuple(beginnings.split())) for word in words)
    ]
    if not roles:
        return None
    material = meant(layer)
    return f"itu_{material}" if roles[0] == WALL and material else roles[0]


def _roles(path: Path, drawn: dict[str, list[FloatArray]], patterns: Sequence[str]) -> dict[str, list[str]]:
    """Layers of walls by their materials, of windows and of doors."""
    roles: dict[str, list[str]] = {}
    for layer in drawn:
        role = _role(layer)
        if patterns and any(fnmatchcase(layer, pattern) for pattern in patterns):
            role = role or WALL
        elif patterns and role not in (DOOR, GLASS):
            role = None
        if role is not None:
            roles.setdefault(role, []).append(layer)
    if set(roles) <= {DOOR, GLASS}:
        lengths = {layer: sum(shapely.linestrings(curve).length for curve in drawn[layer]) for layer in drawn}
        names = [f"{name!r} ({lengths[name]:.0f} m)" for name in sorted(lengths, key=lambda name: -lengths[name])]
        text = f"no layer {', '.join(patterns)}" if patterns else "no layer is named as one of walls"
        raise InputError(f"{path}: {text}; state those of walls by --layers NAME,NAME, of {listed(names) or 'none'}")
    return roles


def _check_unit(path: Path, points_m: FloatArray, leaves: Sequence[Leaf], unit: str) -> None:
    size, wide_m = np.ptp(points_m, axis=0), float(np.median([leaf[1] for leaf in leaves] or [1.0]))
    text = f"{path}: its walls in {unit} measure {size[0]:.4g} m x {size[1]:.4g} m"
    if not SMALLEST_M <= size.max() <= LARGEST_M or not DOOR_M[0] <= wide_m <= DOOR_M[1]:
        doors = f", and its doors {wide_m:.3g} m" if leaves else ""
        raise InputError(f"{text}{doors}; give the unit by --units ({', '.join(UNITS_M)}), or cut out one plan")


def _closed_leaves(leaves: Sequence[Leaf], pieces: dict[str, FloatArray]) -> list[FloatArray]:
    """Chords [2, 2] that close the gaps of walls, from the hinges of doors to the ends of the arcs of their leaves."""
    walls = shapely.union_all(shapely.linestrings(np.concatenate(list(pieces.values()))))
    chords = []
    for hinge, _, ends in leaves:
        off_m = shapely.distance(walls, shapely.points(ends))
        middle_m = shapely.distance(walls, shapely.points((hinge + ends) / 2))
        fits = (off_m <= JAMB_M) & (middle_m >= LEAF_M)
        if fits.any():
            chords.append(np.stack([hinge, ends[int(np.argmax(np.where(fits, middle_m - off_m, -np.inf)))]]))
    return chords


def _circle(curve: FloatArray) -> Leaf | None:
    """Arc of a door's leaf through points [n, 2]; None for other curves."""
    if len(curve) < 4:
        return None
    about = curve - curve[0]  # far from the origin squares would lose their digits
    design = np.column_stack([2 * about, np.ones(len(about))])
    solution, _, rank, _ = np.linalg.lstsq(design, (about**2).sum(axis=1), rcond=None)
    radii = np.linalg.norm(about - solution[:2], axis=1)
    chord = np.linalg.norm(about[-1])
    sweep = 2 * np.arcsin(min(1.0, chord / (2 * radii.mean())))
    is_leaf = rank == 3 and np.ptp(radii) < SAG_SHARE * radii.mean() and SWEEP_RAD[0] < sweep <= SWEEP_RAD[1]
    return (solution[:2] + curve[0], float(radii.mean()), curve[[0, -1]]) if is_leaf else None
