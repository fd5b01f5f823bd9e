"""Meshes that others made (CAD, photogrammetry), checked before a ray tracer sees them."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from ..core import InputError
from ..core.files import one_line
from .points import UNITS_M, check_extent
from .surfaces import Surface

logger = logging.getLogger(__name__)

SUFFIXES = (".ply", ".stl", ".obj", ".glb")
SMALLEST_FACE_M2 = 1e-10
"""A face below that is a line or a point: nothing reflects from it, and its normal is noise."""


def read_mesh(path: str | Path, units: str = "m") -> list[Surface]:
    """The surfaces of a mesh file, one of kind "other" per body that the file tells apart.

    What does no harm to a ray tracer is mended or left: degenerate faces and second copies of a face are dropped (a
    copy would count each path twice), and the log says how many. Inverted normals stay, because radio materials act on
    both sides; so do edges with one, three or more faces, because rays meet triangles and no use is made of
    inside and outside.

    Args:
        path: ``.ply``, ``.stl``, ``.obj`` or ``.glb`` with triangles.
        units: of its coordinates, a key of `wrf_mi.scene.points.UNITS_M`.

    Raises:
        InputError: missing or damaged, points without a surface, only degenerate faces, coordinates that are not
            finite, or units that look like others.
    """
    file = Path(path)
    if units not in UNITS_M:
        raise InputError(f"units {units!r}: not known; give one of {', '.join(UNITS_M)}")
    if not file.is_file():
        raise InputError(f"{file}: no such file; give a mesh ({', '.join(SUFFIXES)})")
    try:
        parts: list[Any] = trimesh.load_scene(str(file), process=False).dump()
    except Exception as error:  # trimesh's readers raise a dozen kinds on damaged files
        raise InputError(f"{file}: cannot be read as a mesh ({one_line(error)}); convert or restore it") from None
    parts = [part for part in parts if len(getattr(part, "faces", ()))]
    if not parts:
        raise InputError(f"{file}: has no faces, so no surface; make a scene of points with wrf-mi mesh")
    surfaces = []
    for index, part in enumerate(parts):
        name = "mesh" if len(parts) == 1 else f"mesh_{index + 1:02d}"
        vertices = np.asarray(part.vertices, float) * UNITS_M[units]
        bad = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
        if len(bad):
            raise InputError(f"{file}: vertex {bad[0] + 1} of {name} is not finite; correct the mesh")
        surface = _mended(Surface(name, "other", vertices, np.asarray(part.faces, np.int64)), file)
        if len(surface.faces):
            surfaces.append(surface)
    if not surfaces:
        raise InputError(f"{file}: every face is degenerate (no area); export it anew, or give its --units")
    check_extent(np.concatenate([surface.vertices_m for surface in surfaces]), file)
    return surfaces


def _mended(surface: Surface, file: Path) -> Surface:
    """The surface without degenerate and doubled faces."""
    a, b, c = np.moveaxis(surface.vertices_m[surface.faces], 1, 0)
    solid = np.linalg.norm(np.cross(b - a, c - a), axis=-1) / 2 >= SMALLEST_FACE_M2
    faces = surface.faces[solid]
    # Copies may have vertices of their own: STL has no shared ones.
    _, same = np.unique(surface.vertices_m, axis=0, return_inverse=True)
    _, first = np.unique(np.sort(same.reshape(-1)[faces], axis=1), axis=0, return_index=True)
    kept = faces[np.sort(first)]
    for count, what in ((np.count_nonzero(~solid), "degenerate"), (len(faces) - len(kept), "doubled")):
        if count:
            logger.warning("%s: %d %s faces of %s left out", file, count, what, surface.name)
    return Surface(surface.name, surface.kind, surface.vertices_m, kept)
