"""Mesh files of others (CAD, photogrammetry), checked and cut into triangles: their parts, or a surface for each."""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import shapely
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ...core import InputError
from ...core.angles import FloatArray
from ...core.files import one_line
from ...core.types import IntArray
from ..coordinates import FORMATS, UNITS_M, Up, check_extent, require_precise, source_file, turned, up_of
from .polygon_files import Polygons, read_obj, read_ply
from .scene_files import USD_SUFFIXES, Beside, bare_gltf, gltf_facts, read_collada, read_usd
from .sheets import as_sheets
from .surfaces import Surface, copies, number_names, without_area

logger = logging.getLogger(__name__)

STATING_READERS = {".dae": read_collada, **dict.fromkeys(USD_SUFFIXES, read_usd)}
"""Readers of files that state their unit and the axis that is up."""
SUFFIXES = (".ply", ".stl", ".obj", ".glb", ".gltf", *STATING_READERS)
POINTS_ELSEWHERE = f"complete it, or give its points as {FORMATS}"
"""Remedy for a mesh of a format that is not read as points."""
POLYGON_READERS = {".obj": read_obj, ".ply": read_ply}
STL_HEADER, STL_FACE = 84, 50
"""Bytes of the header of a binary STL file, whose last four are the number of triangles, and of a triangle."""
LEVEL, END_SHARE, ROOM_SHARE = 0.99, 0.05, 0.8
"""Cosine of level faces, share of the height that is floor and ceiling, and least share of both in all level faces."""
HIGHEST_ROOM_M = 12.0  # highest single room whose unit is not asked for: a sports hall has 7 to 12 m
FLAT_POLYGON = 1e-9  # least ratio of a polygon's second extent to its first; below it has no area
COLLINEAR = 1e-6  # sine of the angle below which a corner lies in a straight side: rounding of float32
GRID = 1e-5
"""Distance relative to a polygon's extent at which its corners and sides touch: that rounding some metres away."""


def mesh_parts(path: str | Path, up: Up | None = None) -> list[trimesh.Trimesh]:
    """The parts of a mesh file that have faces, with z up, in metres where the file states its unit, else in its unit.

    Polygons of OBJ, PLY, COLLADA and USD are cut into triangles, concave ones too. Faces of one material of an OBJ are
    one part, in other files those of a node or solid.

    Args:
        path: a file of `SUFFIXES`, or another format that trimesh reads.
        up: axis that is up in the file; None: that which COLLADA and USD state, y in GLB and glTF, as they specify,
            else z.

    Raises:
        InputError: a file that cannot be read as a mesh, is cut off, or has a face that crosses itself or names a
            vertex that it has not, or a missing package.
    """
    parts, unit_m = _parts(Path(path), up)
    for part in parts if unit_m not in (None, 1.0) else ():
        part.vertices = part.vertices * unit_m
    return parts


def _parts(file: Path, up: Up | None) -> tuple[list[trimesh.Trimesh], float | None]:
    """The parts of a mesh file, with z up, and the unit of their coordinates in metres if the file states it."""
    try:
        parts, unit_m, stated = _stored_parts(file)
        for name, part in zip(number_names(["mesh"] * len(parts)), parts, strict=True):
            _check_part(part)
            if len(bad := np.flatnonzero(~np.isfinite(part.vertices).all(axis=1))):
                raise InputError(f"{file}: vertex {bad[0] + 1} of {name} is not finite; correct the mesh")
            part.vertices = turned(np.asarray(part.vertices, float), up or stated)
    except InputError:
        raise
    except Exception as error:  # trimesh's readers raise a dozen kinds on damaged files
        raise InputError(f"{file}: cannot be read as a mesh ({one_line(error)}); convert or restore it") from None
    return parts, unit_m


def _stored_parts(file: Path) -> tuple[list[trimesh.Trimesh], float | None, Up]:
    """Parts and unit of `_parts` as they are stored, and the axis that is up by the file or its format."""
    suffix, up = file.suffix.lower(), up_of(file, None)
    if suffix in POLYGON_READERS:
        return _polygon_parts(POLYGON_READERS[suffix](file)), None, up
    if suffix not in STATING_READERS:
        return _trimesh_parts(file), None, up
    contents, unit_m, up = STATING_READERS[suffix](file)
    if not 0 < unit_m < np.inf:
        raise ValueError(f"a unit of {unit_m} m")
    return [part for content in contents for part in _polygon_parts(content)], unit_m, up


def _trimesh_parts(file: Path) -> list[trimesh.Trimesh]:
    _check_size(file)
    options: dict[str, Any] = {"file_type": file.suffix.lower()[1:], "process": False}
    # Without a name no other file is looked for: materials and textures are not used.
    source: Any = BytesIO(file.read_bytes())
    if file.suffix.lower() in (".gltf", ".glb"):
        facts = gltf_facts(file)
        if file.suffix.lower() == ".gltf":
            source, options["resolver"] = BytesIO(bare_gltf(facts)), Beside(file)
    dump: list[Any] = trimesh.load_scene(source, **options).dump()
    return [part for part in dump if len(getattr(part, "faces", ()))]


def _check_part(part: trimesh.Trimesh) -> None:
    faces, count = np.asarray(part.faces), len(part.vertices)
    if np.ndim(part.vertices) != 2 or np.shape(part.vertices)[1] != 3:
        raise ValueError(f"vertices of shape {list(np.shape(part.vertices))}; expected [v, 3]")
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.min() < 0 or faces.max() >= count:
        raise ValueError(f"a face names a vertex that is not among its {count}")


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
        _check_stl(content)


def _check_stl(content: bytes) -> None:
    count = int.from_bytes(content[80:84], "little")
    if len(content) == STL_HEADER + STL_FACE * count:
        return
    begins, ends = (len(re.findall(rb"(?im)^\s*" + word + rb"\b", content)) for word in (b"solid", b"endsolid"))
    # Binary files may begin like those of text, but their numbers have zero bytes.
    if not begins or b"\0" in content:
        if len(content) < STL_HEADER:
            raise ValueError(f"{len(content)} bytes, fewer than its header has; it is cut off")
        faces = (len(content) - STL_HEADER) / STL_FACE
        raise ValueError(f"states {count} triangles and has bytes for {faces:.6g}; it is cut off or damaged")
    if begins > ends:
        raise ValueError("a solid without its endsolid; it is cut off")


def read_mesh(path: str | Path, units: str | None = None, up: Up | None = None) -> list[Surface]:
    """The surfaces of a mesh file, each of kind "other": a surface per body that the file names.

    Degenerate faces and second copies of a face, which would count each path twice, are dropped (logged). Inverted
    normals stay, because radio materials act on both sides; so do edges with one, three or more faces.

    Args:
        path: a file of `SUFFIXES` with faces.
        units: unit of its coordinates, a key of `wrf_mi.scene.coordinates.UNITS_M`; None: that which COLLADA and USD
            state, else metres.
        up: axis that is up in it, see `mesh_parts`.

    Raises:
        InputError: missing or damaged, points without a surface, only degenerate faces, coordinates that are not
            finite or were rounded far from the origin, or units that look like others.
    """
    file = source_file(path, units, f"a mesh ({', '.join(SUFFIXES)})")
    parts, stated_m = _parts(file, up)
    if not parts:
        remedy = "make a scene of points with wrf-mi mesh" if file.suffix.lower() == ".ply" else POINTS_ELSEWHERE
        raise InputError(f"{file}: has no faces, so no surface; {remedy}")
    surfaces = sound_surfaces(parts, UNITS_M[units] if units else stated_m or 1.0, file)
    check_extent(np.concatenate([surface.vertices_m for surface in surfaces]), file)
    surfaces = as_sheets(surfaces, file)
    if units is None and stated_m is None:
        _check_height(surfaces, file)
    return surfaces


def _check_height(surfaces: Sequence[Surface], file: Path) -> None:
    """Refuse a room of a file without a unit that is higher than rooms are: it is in inches or decimetres."""
    corners = np.concatenate([surface.vertices_m[surface.faces] for surface in surfaces])
    heights = corners[..., 2]
    low, high = float(heights.min()), float(heights.max())
    cross = trimesh.triangles.cross(corners)
    level_m2 = np.abs(cross[:, 2]) / 2 * (np.abs(cross[:, 2]) > LEVEL * np.linalg.norm(cross, axis=-1))
    ends = [level_m2[(np.abs(heights - end) < END_SHARE * (high - low)).all(axis=1)].sum() for end in (low, high)]
    # A town has no ceiling, and a house has floors between its lowest and its highest.
    is_room = min(ends) > ROOM_SHARE * level_m2.sum() / 2
    if is_room and high - low > HIGHEST_ROOM_M:
        choices = ", ".join(f"{unit} ({(high - low) * UNITS_M[unit]:.3g} m)" for unit in ("in", "ft", "dm", "m"))
        raise InputError(f"{file}: a room {high - low:.4g} units high; give --units: {choices}, or another")


def sound_surfaces(parts: Sequence[trimesh.Trimesh], unit_m: float, name: str | Path) -> list[Surface]:
    """Surfaces of parts of a mesh, in a unit of some metres, without degenerate and doubled faces, see `read_mesh`."""
    require_precise(np.concatenate([part.vertices for part in parts]), unit_m, name)
    surfaces = []
    for part_name, part in zip(number_names(["mesh"] * len(parts)), parts, strict=True):
        vertices = np.asarray(part.vertices, float) * unit_m
        faces = np.asarray(part.faces, np.int64)
        for find, what in ((without_area, "degenerate"), (copies, "doubled")):
            left_out = find(vertices[faces])
            if count := np.count_nonzero(left_out):
                logger.warning("%s: %d %s faces of %s left out", name, count, what, part_name)
            faces = faces[~left_out]
        if len(faces):
            surfaces.append(Surface(part_name, "other", vertices, faces))
    if not surfaces:
        raise InputError(f"{name}: every face is degenerate (no area); export it anew, or give its --units")
    return surfaces


def triangles_of(polygons: Polygons) -> tuple[IntArray, IntArray]:
    """Triangles [t, 3] that fill polygons, and the number of each triangle's polygon [t].

    Convex polygons, and those without an area, are fans about their first corner, as other programs have them. Others
    become Delaunay triangles in their plane, with all corners; a hole that is joined to the outline by an edge there
    and back stays open. `ValueError`, by its place in the file, for one whose edges cross or that covers a place twice.
    """
    polygons = _without_repeats(polygons)
    first = np.cumsum(polygons.sizes) - polygons.sizes
    faces: list[IntArray] = [np.empty((0, 3), np.int64)]
    owners: list[IntArray] = [np.empty(0, np.int64)]
    for size in np.unique(polygons.sizes):
        chosen = np.flatnonzero(polygons.sizes == size)
        corners = polygons.corners[first[chosen, None] + np.arange(size)]
        convex = np.ones(len(chosen), bool) if size == 3 else _convex(polygons.vertices[corners])
        faces.append(corners[convex][:, _fan(size)].reshape(-1, 3))
        owners.append(np.repeat(chosen[convex], size - 2))
        for polygon, indices in zip(chosen[~convex], corners[~convex], strict=True):
            cut = _cut(polygons.vertices[indices])
            if cut is None:
                text = f"{polygons.place(polygon)}: the edges of the face cross, or it covers a place twice"
                raise ValueError(f"{text}; split it into faces that do not")
            faces.append(indices[cut])
            owners.append(np.full(len(cut), polygon))
    every, owner = np.concatenate(faces), np.concatenate(owners)
    order = np.argsort(owner, kind="stable")  # that of the file
    return every[order], owner[order]


def _without_repeats(polygons: Polygons) -> Polygons:
    """Polygons without corners that lie where the corner before does, unless fewer than three are left."""
    owner = np.repeat(np.arange(len(polygons.sizes)), polygons.sizes)
    first = np.cumsum(polygons.sizes) - polygons.sizes
    before = np.arange(len(owner)) - 1
    before[first] = first + polygons.sizes - 1
    places = polygons.vertices[polygons.corners]
    repeated = (places == places[before]).all(axis=1)
    sizes = np.bincount(owner[~repeated], minlength=len(first))
    repeated &= (sizes >= 3)[owner]
    sizes = np.bincount(owner[~repeated], minlength=len(first))
    return replace(polygons, corners=polygons.corners[~repeated], sizes=sizes)


def _fan(size: int) -> IntArray:
    """Triangles [size - 2, 3] of a polygon's corners about the first."""
    middle = np.arange(1, size - 1)
    return np.stack([np.zeros_like(middle), middle, middle + 1], axis=-1)


def _convex(corners: FloatArray) -> NDArray[np.bool_]:
    """Whether each polygon [n, s, 3] turns one way at all corners, and round once."""
    edges = np.roll(corners, -1, axis=1) - corners
    following = np.roll(edges, -1, axis=1)
    normal = _normal(corners)
    normal = normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), np.finfo(float).tiny)
    size = np.linalg.norm(edges, axis=-1) * np.linalg.norm(following, axis=-1)
    sine = (np.cross(edges, following) * normal[:, None]).sum(axis=-1)
    cosine = (edges * following).sum(axis=-1)
    # A star turns one way at all corners, too, but twice round.
    rounds = np.arctan2(sine, cosine).sum(axis=-1) / (2 * np.pi)
    # One with a corner in a straight side does not: a fan about its neighbour would have a triangle without an area.
    convex: NDArray[np.bool_] = (sine > COLLINEAR * size).all(axis=-1) & (rounds < 1.5)
    return convex


def _normal(corners: FloatArray) -> FloatArray:
    """Newell's normals [n, 3] of polygons [n, s, 3], twice as long as their areas."""
    about = corners - corners[:, :1]
    return np.cross(about, np.roll(about, -1, axis=1)).sum(axis=1)


def _cut(corners: FloatArray) -> IntArray | None:
    """Corner numbers of triangles [t, 3] that fill a polygon [s, 3]; None if its edges cross."""
    if not np.isfinite(corners).all():
        return _fan(len(corners))  # `mesh_parts` refuses it, with the number of the vertex
    centred = corners - corners.mean(axis=0)
    _, extent, axes = np.linalg.svd(centred, full_matrices=False)
    if extent[1] <= FLAT_POLYGON * extent[0]:
        return _fan(len(corners))
    normal, grid = _normal(corners[None])[0], GRID * extent[0]
    if np.linalg.norm(normal) > grid * extent[0]:
        # The plane of a polygon that is not quite flat is square to its mean normal.
        normal = normal / np.linalg.norm(normal)
        along = axes[0] - normal * (axes[0] @ normal)
        along = along / np.linalg.norm(along)
        axes = np.stack([along, np.cross(normal, along)])
    flat = centred @ axes[:2].T
    # On a grid, corners that lie on another side but for rounding are corners of both.
    sides = shapely.union_all([shapely.linearrings(flat)], grid_size=grid)
    faces = shapely.polygonize([sides])
    parts, face = shapely.get_parts(shapely.constrained_delaunay_triangles(shapely.get_parts(faces)), return_index=True)
    # How often the polygon goes round each face, seen from the middle of a triangle clear of all edges.
    middle = shapely.centroid(parts)
    order = np.lexsort((shapely.distance(middle, sides), face))
    clear = order[np.flatnonzero(np.diff(face[order], append=-1))]
    spokes = flat - shapely.get_coordinates(middle[clear])[:, None]
    angle = np.arctan2(spokes[..., 1], spokes[..., 0])
    step = (np.roll(angle, -1, axis=1) - angle + np.pi) % (2 * np.pi) - np.pi
    rounds = np.round(step.sum(axis=1) / (2 * np.pi)).astype(int)
    # Never in a hole; beside a crossing twice, or both ways.
    if np.ptp([0, *rounds]) > 1:
        return None
    inside = parts[(rounds != 0)[face]]
    _, cut = cKDTree(flat).query(shapely.get_coordinates(inside).reshape(-1, 4, 2)[:, :3])
    return np.asarray(cut, np.int64).reshape(-1, 3)
