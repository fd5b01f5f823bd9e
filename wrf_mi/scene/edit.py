"""Scenes with parts moved or removed: what would be measured after a cabinet is moved, without measuring anew."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, cast

import numpy as np
import trimesh
from numpy.typing import ArrayLike

from ..core import InputError
from ..core.angles import FloatArray
from ..core.files import listed
from .folder import read_scene_folder, write_scene
from .materials import Materials
from .mesh.files import mesh_parts
from .mesh.surfaces import Surface, bounds, box_of, moved, named_kind

logger = logging.getLogger(__name__)

TOUCH_M = 0.01  # depth up to which parts touch: surfaces of scans stand up to a centimetre in each other
PAIRS_PER_CHUNK = 1 << 18  # pairs of edge and triangle that are tried together: some 50 MB


@dataclass(frozen=True)
class Move:
    """A rigid motion of some parts of a scene together.

    Attributes:
        parts: names of surfaces; ``*`` and ``?`` are wildcards.
        shift_m: displacement [3], metres.
        turn_deg: rotation about the vertical axis through the middle of the parts' common box, degrees, from +x
            towards +y; before the displacement.

    >>> Move(("table*", "box"), (0.5, 0, 0), 90).parts
    ('table*', 'box')
    """

    parts: tuple[str, ...]
    shift_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn_deg: float = 0.0

    def __post_init__(self) -> None:
        """Refuse (`InputError`) numbers that are not finite."""
        if len(self.shift_m) != 3 or not np.isfinite([*self.shift_m, self.turn_deg]).all():
            raise InputError(f"move {','.join(self.parts)}: give three finite numbers of metres, and of degrees")

    def matrix(self, box_m: FloatArray) -> FloatArray:
        """Matrix [4, 4] of the motion of parts whose common box has the corners [2, 3], metres."""
        middle = box_m.mean(axis=0)
        turn = trimesh.transformations.rotation_matrix(np.radians(self.turn_deg), [0, 0, 1], middle)
        return np.asarray(trimesh.transformations.translation_matrix(self.shift_m) @ turn)


def read_surfaces(folder: str | Path) -> tuple[list[Surface], Materials]:
    """Surfaces of a scene folder in the order of ``materials.yml``, and its materials; `InputError`: a damaged one."""
    scene = read_scene_folder(folder)
    surfaces = []
    for name, entry in scene.materials.surfaces.items():
        parts = mesh_parts(scene.folder / "meshes" / f"{name}.ply")
        mesh = cast(Any, trimesh.util.concatenate(parts))
        surfaces.append(Surface(name, named_kind(name, entry), np.asarray(mesh.vertices), np.asarray(mesh.faces)))
    return surfaces, scene.materials


def parts_within(folder: str | Path, low_m: ArrayLike, high_m: ArrayLike) -> tuple[str, ...]:
    """Names of the surfaces of a scene folder that lie in a box of two corners [3], metres, such as the sides of a
    cabinet.
    """
    low, high = np.asarray(low_m, float), np.asarray(high_m, float)
    surfaces, _ = read_surfaces(folder)
    inside = [((surface.vertices_m >= low) & (surface.vertices_m <= high)).all() for surface in surfaces]
    return tuple(surface.name for surface, within in zip(surfaces, inside, strict=True) if within)


def edit_scene(
    folder: str | Path,
    out: str | Path,
    moves: Sequence[Move] = (),
    remove: Sequence[str] = (),
    replace_folder: bool = False,
) -> Path:
    """Write a folder of a scene with parts moved or removed, and return its path; materials stay.

    Parts that are moved partly out of the scene, or into other surfaces, are named in the log with the distance.

    Args:
        folder: scene folder.
        out: scene folder to make.
        moves: motions, in their order; a part may move more than once.
        remove: names of surfaces to leave out; ``*`` and ``?`` are wildcards.
        replace_folder: replace an existing folder.

    Raises:
        InputError: not a scene folder, a name that no surface has, nothing to change, a part that is moved and removed
            or moved out of the scene, no surface left, or an existing folder.
    """
    surfaces, materials = read_surfaces(folder)
    if not moves and not remove:
        raise InputError(f"{folder}: nothing to change; name parts to move or to remove")
    unmoved, moved_names, removed_names = surfaces, set[str](), _chosen(folder, surfaces, remove)
    for move in moves:
        names = _chosen(folder, surfaces, move.parts)
        surfaces = _after(move, surfaces, names, removed_names)
        moved_names |= names
    remaining = [surface for surface in surfaces if surface.name not in removed_names]
    _check_moves(unmoved, remaining, moved_names)
    entries = {surface.name: materials.surfaces[surface.name] for surface in remaining}
    changes = [f"{','.join(move.parts)} moved by {move.shift_m} m and {move.turn_deg:g} degrees" for move in moves]
    changes += [f"{name} removed" for name in remove]
    return write_scene(
        out,
        remaining,
        frame=f"that of {folder}",
        source=str(folder),
        materials=replace(materials, surfaces=entries),
        description=f"An edited scene: {'; '.join(changes)}",
        replace=replace_folder,
    )


def _after(move: Move, surfaces: Sequence[Surface], names: set[str], removed: set[str]) -> list[Surface]:
    """Surfaces after a motion of some of them; `InputError` for none, or for one of removed surfaces."""
    text = f"move {','.join(move.parts)}"
    if not any(move.shift_m) and not move.turn_deg % 360:
        raise InputError(f"{text}: by 0 m and {move.turn_deg:g} degrees changes nothing; omit it")
    if both := sorted(names & removed):
        raise InputError(f"{text}: {both[0]} is also removed; omit one of the two")
    matrix = move.matrix(box_of([surface for surface in surfaces if surface.name in names]))
    return [moved([part], matrix)[0] if part.name in names else part for part in surfaces]


def _chosen(folder: str | Path, surfaces: Sequence[Surface], patterns: Sequence[str]) -> set[str]:
    """Names of the surfaces that match some patterns; every pattern has to match one."""
    chosen: set[str] = set()
    for pattern in patterns:
        names = {surface.name for surface in surfaces if fnmatchcase(surface.name, pattern)}
        if not names:
            present = listed(surface.name for surface in surfaces)
            raise InputError(f"{folder}: no surface {pattern!r}; it has {present}")
        chosen |= names
    return chosen


def _check_moves(before: Sequence[Surface], after: Sequence[Surface], names: set[str]) -> None:
    """Refuse a moved part that is wholly outside of the scene, and warn of one partly out of it, or in others."""
    parts, others = ([part for part in after if (part.name in names) == chosen] for chosen in (True, False))
    if not parts or not others:
        return  # a scene that is moved as a whole has no inside
    earlier = {part.name: part for part in before}
    low, high = box_of(before)
    for part in parts:
        _check_inside(part, low, high)
        _warn_of_crossings(part, earlier[part.name], others)


def _warn_of_crossings(part: Surface, earlier: Surface, others: Sequence[Surface]) -> None:
    for other in others:
        depth_m = _crossing_depth(part, other)
        if depth_m > TOUCH_M and depth_m > _crossing_depth(earlier, other) + TOUCH_M:
            logger.warning("move %s: reaches %.2f m through %s", part.name, depth_m, other.name)


def _check_inside(part: Surface, low: FloatArray, high: FloatArray) -> None:
    """Refuse a surface outside of the box of a scene, and warn of one that is partly outside."""
    first, last = box_of([part])
    outside_m = float(np.maximum(low - first, last - high).max())
    gap_m = float(np.maximum(low - last, first - high).max())
    # An outer wall may be moved outwards, which enlarges the room, but not farther than the room is large.
    if gap_m > (0 if part.kind == "other" else (high - low).max()):
        text = f"moved out of the scene, {gap_m:.2f} m beyond it; give a smaller displacement, or --remove"
        raise InputError(f"move {part.name}: {text}")
    if outside_m > TOUCH_M:
        logger.warning("move %s: reaches %.2f m out of the scene", part.name, outside_m)


def _crossing_depth(part: Surface, other: Surface) -> float:
    """How far a surface reaches through another one, metres; 0: it does not, or the two touch."""
    # Of an edge that is cut, the shorter piece counts; of all such edges of a surface, the longest.
    triangles, cut = part.vertices_m[part.faces], other.vertices_m[other.faces]
    low, high = bounds(triangles)
    # Where surfaces touch, edges lie in faces and rounding decides what is cut: a smaller part touches nothing.
    smaller = np.clip(triangles, np.minimum(low + TOUCH_M, high), np.maximum(high - TOUCH_M, low))
    cut = cut[((cut.max(axis=1) >= low) & (cut.min(axis=1) <= high)).all(axis=1)]  # others are out of reach
    if not any((_depth(smaller, cut), _depth(cut, smaller))):
        return 0.0
    # Of edges of the part and of the other, the shorter way back counts.
    return min((depth for depth in (_depth(triangles, cut), _depth(cut, triangles)) if depth), default=0.0)


def _depth(triangles: FloatArray, cut: FloatArray) -> float:
    """The depth of `_crossing_depth` by the edges of triangles [n, 3, 3] that other triangles [m, 3, 3] are cut by."""
    starts, ends = triangles.reshape(-1, 3), np.roll(triangles, -1, axis=1).reshape(-1, 3)
    normal, proper = trimesh.triangles.normals(cut)  # of triangles with an area alone
    cut = cut[proper]
    depth, step = 0.0, max(1, PAIRS_PER_CHUNK // max(len(cut), 1))
    for first in range(0, len(starts), step):
        start, end = starts[first : first + step, None], ends[first : first + step, None]
        # Signed distances [edges, triangles] of both ends from the planes.
        before, after = (((point - cut[:, 0]) * normal).sum(axis=-1) for point in (start, end))
        edge, triangle = np.nonzero(before * after < 0)  # both ends are on different sides of the plane
        d = before[edge, triangle], after[edge, triangle]
        met = start[edge, 0] + (d[0] / (d[0] - d[1]))[:, None] * (end - start)[edge, 0]
        within = (trimesh.triangles.points_to_barycentric(cut[triangle], met) >= 0).all(axis=1)
        depth = max(depth, float(np.minimum(np.abs(d[0]), np.abs(d[1]))[within].max(initial=0.0)))
    return depth
