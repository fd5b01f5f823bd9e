"""Mesh files of others (CAD, photogrammetry), checked and cut into triangles: their parts, or a surface for each."""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
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
from .ifc import read_ifc
from .polygon_files import Polygons, read_obj, read_ply
from .scene_files import USD_SUFFIXES, Beside, bare_gltf, gltf_facts, read_collada, read_usd
from .sheets import as_sheets
from .surfaces import Surface, copies, number_names, without_area

logger = logging.getLogger(__name__)

STATING_READERS = {".dae": read_collada, **dict.fromkeys(USD_SUFFIXES, read_usd)}
"""Readers of files that state their unit and the axis that is up."""
SUFFIXES = (".ply", ".stl", ".obj", ".glb", ".gltf", *STATING_READERS, ".ifc")
POINTS_ELSEWHERE = f"complete it, or give its points as {FORMATS}"
"""Remedy for a mesh of a format that is not read as points."""
POLYGON_READERS = {".obj": read_obj, ".ply": read_ply}
LEVEL, END_SHARE, ROOM_SHARE = 0.99, 0.05, 0.8
"""Cosine of level faces, share of the height that is floor and ceiling, and least share of both in all level faces."""
HIGHEST_ROOM_M = 12.0  # highest single room whose unit is not asked for: a sports hall has 7 to 12 m
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
        parts, unit_m, up_in_file = _stored_parts(file)
        for name, part in zip(number_names(["mesh"] * len(parts)), parts, strict=True):
            _check_part(part)
            if len(bad := np.flatnonzero(~np.isfinite(part.vertices).all(axis=1))):
                raise InputError(f"{file}: vertex {bad[0] + 1} of {name} is not finite; correct the mesh")
            part.vertices = turned(np.asarray(part.vertices, float), up or up_in_file)
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
    if suffix == ".ifc":
        return [surface.mesh for surface in read_ifc(file)], 1.0, "z"
    if suffix not in STATING_READERS:
        return _trimesh_parts(file), None, up
    contents, unit_m, up = STATING_READERS[suffix](file)
    if not 0 < unit_m < np.inf:
        raise ValueError(f"a unit of {unit_m} m")
    return [part for content in contents for part in _polygon_parts(content)], unit_m, up


def _trimesh_parts(file: Path) -> list[trimesh.Trimesh]:
    options: dict[str, Any] = {"file_type": file.suffix.lower()[1:], "process": False}
    # Without a name no other file is looked for: materials and textures are not used.
    content = file.read_bytes()
    source: Any = BytesIO(content)
    if file.suffix.lower() in (".gltf", ".glb"):
        facts = gltf_facts(file)
        if file.suffix.lower() == ".gltf":
            source, options["resolver"] = BytesIO(bare_gltf(facts)), Beside(file)
    dump: list[Any] = trimesh.load_scene(source, **options).dump()
    parts = [part for part in dump if len(getattr(part, "faces", ()))]
    if file.suffix.lower() == ".stl":
        _check_stl(content, parts)
    return parts


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


def _check_stl(content: bytes, parts: Sequence[trimesh.Trimesh]) -> None:
    """Refuse an STL that is cut off (`ValueError`), of which trimesh reads the solids that are whole, or nothing."""
    # Binary files may begin like those of text, but their numbers have zero bytes.
    is_text = b"\0" not in content
    begins, ends = (len(re.findall(rb"(?im)^\s*" + word + rb"\b", content)) for word in (b"solid", b"endsolid"))
    if not parts or (is_text and begins > ends):
        raise ValueError("fewer triangles than it states; it is cut off or damaged")


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
    length, width, _ = np.linalg.svd(corners - corners.mean(axis=0), compute_uv=False)
    grid, normal = GRID * length, _normal(corners[None])[0]
    if width <= grid:
        return _fan(len(corners))  # it has no area
    area = float(np.linalg.norm(normal)) / 2
    if area <= grid * width:
        return None  # a bow tie, whose halves go round both ways
    # The plane of a polygon that is not quite flat is square to its mean normal.
    to_plane = trimesh.geometry.plane_transform(corners.mean(axis=0), normal)
    flat = trimesh.transform_points(corners, to_plane)[:, :2]
    # On a grid, corners that lie on another side but for rounding are corners of both.
    sides = shapely.union_all([shapely.linearrings(flat)], grid_size=grid)
    faces = shapely.get_parts(shapely.polygonize([sides]))
    # Inside are faces from which a ray leaves through an odd number of sides, but for a hole that edges join to the
    # outline. Newell's area counts a face as often as the outline goes round it, and so is another where sides cross.
    inside = faces[
        shapely.contains_xy(shapely.polygons(flat), shapely.get_coordinates(shapely.point_on_surface(faces)))
    ]
    if abs(shapely.area(inside).sum() - area) > grid * sides.length:
        return None
    parts = shapely.get_parts(shapely.constrained_delaunay_triangles(inside))
    _, cut = cKDTree(flat).query(shapely.get_coordinates(parts).reshape(-1, 4, 2)[:, :3])
    return np.asarray(cut, np.int64).reshape(-1, 3)
