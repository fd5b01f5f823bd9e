"""Mesh files of others (CAD, photogrammetry), checked: their parts, or a surface for each part."""

from __future__ import annotations

import logging
import re
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from ...core import InputError
from ...core.files import one_line
from ..coordinates import FORMATS, UNITS_M, Up, check_extent, require_precise, source_file, turned, up_of
from .polygon_files import Polygons, read_obj, read_ply
from .surfaces import Surface
from .triangulation import triangles_of

logger = logging.getLogger(__name__)

SUFFIXES = (".ply", ".stl", ".obj", ".glb")
POINTS_ELSEWHERE = f"complete it, or give its points as {FORMATS}"
"""Remedy for a mesh of a format that is not read as points."""
SMALLEST_FACE_M2 = 1e-10
"""Smaller faces are degenerate: nothing reflects from them, and their normals are noise."""
POLYGON_READERS = {".obj": read_obj, ".ply": read_ply}
STL_HEADER, STL_FACE = 84, 50
"""Bytes of the header of a binary STL file, whose last four are the number of triangles, and of a triangle."""


def mesh_parts(path: str | Path, up: Up | None = None) -> list[trimesh.Trimesh]:
    """The parts of a mesh file that have faces, with z up, in the file's unit.

    Polygons of OBJ and PLY are cut into triangles, concave ones too. Faces of one material of an OBJ are one part, in
    other files those of a node or solid.

    Args:
        path: PLY, OBJ, STL, GLB, or another format that trimesh reads.
        up: axis that is up in the file; None: y in GLB and glTF, as they specify, else z.

    Raises:
        InputError: a file that cannot be read as a mesh, is cut off, or has a face that crosses itself or names a
            vertex that it has not.
    """
    file = Path(path)
    suffix = file.suffix.lower()
    try:
        if suffix in POLYGON_READERS:
            parts = _polygon_parts(POLYGON_READERS[suffix](file))
        else:
            _check_size(file)
            # Without a name no other file is looked for: materials and textures are not used.
            with file.open("rb") as stream:
                dump: list[Any] = trimesh.load_scene(stream, file_type=suffix[1:], process=False).dump()
            parts = [part for part in dump if len(getattr(part, "faces", ()))]
        for name, part in zip(part_names(len(parts)), parts, strict=True):
            faces, count = np.asarray(part.faces), len(part.vertices)
            if np.ndim(part.vertices) != 2 or np.shape(part.vertices)[1] != 3:
                raise ValueError(f"vertices of shape {list(np.shape(part.vertices))}; expected [v, 3]")
            if faces.ndim != 2 or faces.shape[1] != 3 or faces.min() < 0 or faces.max() >= count:
                raise ValueError(f"a face names a vertex that is not among its {count}")
            if len(bad := np.flatnonzero(~np.isfinite(part.vertices).all(axis=1))):
                raise InputError(f"{path}: vertex {bad[0] + 1} of {name} is not finite; correct the mesh")
            part.vertices = turned(np.asarray(part.vertices, float), up_of(file, up))
    except InputError:
        raise
    except Exception as error:  # trimesh's readers raise a dozen kinds on damaged files
        raise InputError(f"{path}: cannot be read as a mesh ({one_line(error)}); convert or restore it") from None
    return parts


def part_names(count: int) -> list[str]:
    """Names of the parts of a mesh file: ``mesh``, or ``mesh_01``, ``mesh_02``, ..."""
    return ["mesh"] if count == 1 else [f"mesh_{index + 1:02d}" for index in range(count)]


def _polygon_parts(polygons: Polygons) -> list[trimesh.Trimesh]:
    """Triangles of each part of a file of polygons, with the vertices that they name."""
    triangles, polygon = triangles_of(polygons)
    part, parts = polygons.parts[polygon], []
    for number in np.unique(part):
        used, faces = np.unique(triangles[part == number], return_inverse=True)
        parts.append(trimesh.Trimesh(polygons.vertices[used], faces.reshape(-1, 3), process=False))
    return parts


def _check_size(file: Path) -> None:
    """Refuse STL and GLB that are longer or shorter than they state: `ValueError`; trimesh drops what is cut off."""
    content, suffix = file.read_bytes(), file.suffix.lower()
    if suffix == ".glb" and len(content) >= 12 and (stated := int.from_bytes(content[8:12], "little")) != len(content):
        raise ValueError(f"states {stated} bytes and has {len(content)}; it is cut off or damaged")
    if suffix == ".stl":
        count = int.from_bytes(content[80:84], "little")
        if len(content) >= STL_HEADER and len(content) == STL_HEADER + STL_FACE * count:
            return
        begins, ends = (len(re.findall(rb"(?im)^\s*" + word + rb"\b", content)) for word in (b"solid", b"endsolid"))
        # Binary files may begin like those of text, but their numbers have zero bytes.
        if not begins or b"\0" in content:
            if len(content) < STL_HEADER:
                raise ValueError(f"{len(content)} bytes, fewer than its header has; it is cut off")
            faces = max(len(content) - STL_HEADER, 0) / STL_FACE
            raise ValueError(f"states {count} triangles and has bytes for {faces:.6g}; it is cut off or damaged")
        if begins > ends:
            raise ValueError("a solid without its endsolid; it is cut off")


def read_mesh(path: str | Path, units: str = "m", up: Up | None = None) -> list[Surface]:
    """The surfaces of a mesh file, each of kind "other": a surface per body that the file names.

    Degenerate faces and second copies of a face, which would count each path twice, are dropped (logged). Inverted
    normals stay, because radio materials act on both sides; so do edges with one, three or more faces.

    Args:
        path: ``.ply``, ``.stl``, ``.obj`` or ``.glb`` with faces.
        units: unit of its coordinates, a key of `wrf_mi.scene.scan.points.UNITS_M`.
        up: axis that is up in it, see `wrf_mi.scene.mesh.surfaces.mesh_parts`.

    Raises:
        InputError: missing or damaged, points without a surface, only degenerate faces, coordinates that are not
            finite or were rounded far from the origin, or units that look like others.
    """
    file = source_file(path, units, f"a mesh ({', '.join(SUFFIXES)})")
    parts = mesh_parts(file, up)
    if not parts:
        remedy = "make a scene of points with wrf-mi mesh" if file.suffix.lower() == ".ply" else POINTS_ELSEWHERE
        raise InputError(f"{file}: has no faces, so no surface; {remedy}")
    require_precise(np.concatenate([part.vertices for part in parts]), UNITS_M[units], file)
    surfaces = []
    for name, part in zip(part_names(len(parts)), parts, strict=True):
        vertices = np.asarray(part.vertices, float) * UNITS_M[units]
        faces = np.asarray(part.faces, np.int64)
        solid = faces[trimesh.triangles.area(vertices[faces]) >= SMALLEST_FACE_M2]
        # Copies may have other vertices: STL has no shared vertices.
        _, same = np.unique(vertices, axis=0, return_inverse=True)
        _, first = np.unique(np.sort(same.reshape(-1)[solid], axis=1), axis=0, return_index=True)
        for count, what in ((len(faces) - len(solid), "degenerate"), (len(solid) - len(first), "doubled")):
            if count:
                logger.warning("%s: %d %s faces of %s left out", file, count, what, name)
        if len(first):
            surfaces.append(Surface(name, "other", vertices, solid[np.sort(first)]))
    if not surfaces:
        raise InputError(f"{file}: every face is degenerate (no area); export it anew, or give its --units")
    check_extent(np.concatenate([surface.vertices_m for surface in surfaces]), file)
    return surfaces
