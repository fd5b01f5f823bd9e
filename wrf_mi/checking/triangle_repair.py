"""Repair of triangles: near the origin, one sheet in place of two, no degenerate faces, no copies, one winding."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..core.angles import FloatArray
from ..scene.coordinates import FARTHEST_M
from ..scene.mesh.surfaces import bodies
from .scene_geometry import Part, materials_of
from .triangle_faults import copies, double_sheets, is_flat, without_area, wound_both_ways, wound_one_way

ORIGIN_STEP_M = 100.0  # origins are whole multiples, and axes near zero stay
NEAR_ZERO_M = 1000.0


def repaired_triangles(parts: Sequence[Part]) -> tuple[list[Part], FloatArray, list[str]]:
    """Repaired parts, the origin [3] that was subtracted in metres, and what was done to which part."""
    origin_m = _origin(parts)
    near = [replace(part, corners_m=part.corners_m - origin_m) for part in parts]
    in_plane = _one_plane(near)
    done = [
        f"{label(part)}: sheet moved by millimetres into the plane of another one"
        for part, before in zip(in_plane, near, strict=True)
        if part is not before
    ]
    valid = [replace(part, corners_m=part.corners_m[~without_area(part.corners_m)]) for part in in_plane]
    single = _without_copies(valid)
    for before, between, after in zip(in_plane, valid, single, strict=True):
        for count, what in (
            (len(before.corners_m) - len(between.corners_m), "faces without an area"),
            (len(between.corners_m) - len(after.corners_m), "copies of faces"),
        ):
            done += [f"{label(after)}: {count} {what} left out"] if count else []
    wound = [part for part in single if len(part.corners_m)]
    for number, part in enumerate(wound):
        if any(map(wound_both_ways, bodies(part.corners_m))):
            wound[number] = replace(part, corners_m=wound_one_way(part.corners_m))
            done.append(f"{label(part)}: faces wound one way")
    return wound, origin_m, done


def label(part: Part) -> str:
    """Name of a part, or of its file."""
    return part.name or part.file.name


def _origin(parts: Sequence[Part]) -> FloatArray:
    """Origin [3] near which parts are that lie far from zero; else zero."""
    if all(np.abs(part.corners_m).max(initial=0) < FARTHEST_M for part in parts):
        return np.zeros(3)
    low = np.concatenate([part.corners_m.reshape(-1, 3) for part in parts]).min(axis=0)
    return np.where(np.abs(low) < NEAR_ZERO_M, 0, np.floor(low / ORIGIN_STEP_M) * ORIGIN_STEP_M)


def _one_plane(parts: list[Part]) -> list[Part]:
    """Parts whose flat bodies are put into the planes of faces of the same material within millimetres."""
    if not parts:
        return parts
    corners = [part.corners_m.copy() for part in parts]
    owner = np.repeat(np.arange(len(parts)), [len(each) for each in corners])
    row = np.concatenate([np.arange(len(each)) for each in corners])
    pairs = double_sheets(np.concatenate(corners), materials_of(parts)[owner])
    sheets = {k: [b for b in bodies(corners[k]) if is_flat(b)] for k in np.unique(owner[pairs]).tolist()}
    moved = set[tuple[int, int]]()
    # The later of two sheets moves; where it is a wall of a solid, the other one.
    for fixed, other in [*pairs.tolist(), *pairs[:, ::-1].tolist()]:
        k, f = int(owner[other]), int(owner[fixed])
        number = next((n for n, body in enumerate(sheets[k]) if row[other] in body.faces), None)
        still = next((n for n, body in enumerate(sheets[f]) if row[fixed] in body.faces), -1)
        if number is None or {(k, number), (f, still)} & moved:
            continue
        plane, faces = corners[f][row[fixed]], sheets[k][number].faces
        normal = np.cross(plane[1] - plane[0], plane[2] - plane[0])
        normal /= np.linalg.norm(normal)
        corners[k][faces] -= ((corners[k][faces] - plane[0]) @ normal)[..., None] * normal
        moved.add((k, number))
    changed = {k for k, _ in moved}
    return [replace(part, corners_m=corners[k]) if k in changed else part for k, part in enumerate(parts)]


def _without_copies(parts: list[Part]) -> list[Part]:
    """Parts without triangles that an earlier part, or the part itself, has."""
    if not parts:
        return parts
    doubled = copies(np.concatenate([part.corners_m for part in parts]))
    ends = np.cumsum([len(part.corners_m) for part in parts])[:-1]
    rows = np.split(~doubled, ends)
    return [replace(part, corners_m=part.corners_m[row]) for part, row in zip(parts, rows, strict=True)]
