"""Repair of triangles: near the origin, one sheet in place of two, no degenerate faces, no copies, one winding."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import trimesh
from numpy.typing import NDArray

from ...core.angles import FloatArray
from ...scene.coordinates import local_origin
from ...scene.mesh.surfaces import bodies, copies, without_area
from .scene_geometry import ShapePart, materials_of
from .triangle_faults import double_sheets, sheet_numbers, wound_both_ways, wound_one_way


def repaired_triangles(parts: Sequence[ShapePart]) -> tuple[list[ShapePart], FloatArray, list[str]]:
    """Repaired parts, the origin [3] that was subtracted in metres, and what was done to which part."""
    if not parts:
        return [], np.zeros(3), []
    origin_m = np.array(local_origin(np.concatenate([part.corners_m for part in parts]).reshape(-1, 3)) or np.zeros(3))
    done = list[str]()
    stage = [replace(part, corners_m=part.corners_m - origin_m) for part in parts]
    for repair, text in STAGES:
        before, stage = stage, repair(stage)
        changed = [after for after, part in zip(stage, before, strict=True) if after is not part]
        done += [f"{label(part)}: {text}" for part in changed]
    return [part for part in stage if len(part.corners_m)], origin_m, done


def label(part: ShapePart) -> str:
    """Name of a part, or of its file."""
    return part.name or part.file.name


def _one_plane(parts: list[ShapePart]) -> list[ShapePart]:
    """Parts whose flat bodies are put into the planes of faces of the same material within millimetres."""
    corners = [part.corners_m.copy() for part in parts]
    owner = np.repeat(np.arange(len(parts)), [len(each) for each in corners])
    row = np.concatenate([np.arange(len(each)) for each in corners])
    pairs = double_sheets(np.concatenate(corners), materials_of(parts)[owner])
    sheet = [sheet_numbers(each) for each in corners]
    moved = set[tuple[int, int]]()
    # The later of two sheets moves; where it is a wall of a solid, the other one.
    for fixed, other in [*pairs.tolist(), *pairs[:, ::-1].tolist()]:
        still, mover = ((int(owner[face]), int(sheet[owner[face]][row[face]])) for face in (fixed, other))
        # A sheet moves once, and none onto one that has moved, or chains of sheets would drift.
        if mover[1] < 0 or {mover, still} & moved:
            continue
        faces = sheet[mover[0]] == mover[1]
        corners[mover[0]][faces] = _in_plane(corners[mover[0]][faces], corners[still[0]][row[fixed]])
        moved.add(mover)
    changed = list(parts)
    for k, _ in moved:
        changed[k] = replace(parts[k], corners_m=corners[k])
    return changed


def _in_plane(corners_m: FloatArray, triangle_m: FloatArray) -> FloatArray:
    (normal,) = trimesh.triangles.normals(triangle_m[None])[0]
    return np.asarray(corners_m - ((corners_m - triangle_m[0]) @ normal)[..., None] * normal)


def _with_area(parts: list[ShapePart]) -> list[ShapePart]:
    return [_only(part, ~without_area(part.corners_m)) for part in parts]


def _without_copies(parts: list[ShapePart]) -> list[ShapePart]:
    """Parts without triangles that an earlier part, or the part itself, has."""
    doubled = copies(np.concatenate([part.corners_m for part in parts]))
    ends = np.cumsum([len(part.corners_m) for part in parts])[:-1]
    return [_only(part, row) for part, row in zip(parts, np.split(~doubled, ends), strict=True)]


def _only(part: ShapePart, rows: NDArray[np.bool_]) -> ShapePart:
    return part if rows.all() else replace(part, corners_m=part.corners_m[rows])


def _wound(parts: list[ShapePart]) -> list[ShapePart]:
    return [
        replace(part, corners_m=wound_one_way(part.corners_m))
        if any(map(wound_both_ways, bodies(part.corners_m)))
        else part
        for part in parts
    ]


STAGES: tuple[tuple[Callable[[list[ShapePart]], list[ShapePart]], str], ...] = (
    (_one_plane, "sheet moved by millimetres into the plane of another one"),
    (_with_area, "faces without an area left out"),
    (_without_copies, "copies of faces left out"),
    (_wound, "faces wound one way"),
)
"""Repairs in their order, and what is said of the parts that they change."""
