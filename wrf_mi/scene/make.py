"""From a scan, a plan or a mesh to a scene folder: what the command ``wrf-mi mesh`` does."""

from __future__ import annotations

from dataclasses import replace as changed
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from ..core import InputError
from ..core.angles import FloatArray
from .folder import SceneFolder, read_scene_folder, write_scene
from .materials import Materials, read_materials
from .mesh import SUFFIXES, read_mesh
from .packages import lidar_package
from .points import check_extent, read_points
from .surfaces import Surface

PLAN_SUFFIXES = (".png", ".pgm", ".yaml", ".yml", ".csv")
PREVIEW_POINTS = 20_000
RIGID = 1e-6
"""Largest departure of a registration's rotation from orthonormal."""


def make_scene(
    points_file: str | Path,
    out: str | Path,
    *,
    units: str = "m",
    materials: str | Path | Materials | None = None,
    height_m: float | None = None,
    floor_m: float = 0.0,
    resolution_m: float | None = None,
    registration: ArrayLike | None = None,
    register_walls_of: str | Path | None = None,
    replace: bool = False,
) -> SceneFolder:
    """Make a scene folder that Mitsuba and Sionna RT both open.

    Args:
        points_file: a 3D scan, z upwards (`wrf_mi.scene.points.read_points`); a plan in two dimensions
            (`wrf_mi.scene.plan_sources.read_plan`), which becomes walls, floor and ceiling; a mesh with faces, whose
            triangles are taken as they are.
        out: folder to make.
        units: of a scan's or mesh's coordinates: m, cm, mm or ft.
        materials: rules and exceptions, or a ``materials.yml`` (or scene folder) to read them from.
        height_m: from floor to ceiling; needed for a plan and for nothing else.
        floor_m: z of a plan's floor.
        resolution_m: side of a plan's cell, where the file does not tell or tells wrongly.
        registration: 4 x 4 rigid motion from the source's frame to the scene's, metres; None leaves the frame.
        register_walls_of: a layout file whose walls the scene's walls are to lie on (`wrf_mi.scene.plan.read_walls`,
            `wrf_mi.scene.register.register_walls`), in place of ``registration``.
        replace: let the folder take the place of an existing one.

    Returns:
        The folder, read back.

    Raises:
        InputError: a file that cannot be read or used, a package that is missing, options that do not fit the
            source, or a folder that exists.
    """
    file, out = Path(points_file), Path(out)
    if out.exists() and not replace:
        # Before a minute's work, not after.
        raise InputError(f"{out}: exists; remove it or choose another folder")
    if isinstance(materials, str | Path):
        materials = read_materials(materials)
    if registration is not None and register_walls_of is not None:
        raise InputError(f"{file}: registration by pairs and to walls: give one of them")
    matrix = None if registration is None else _rigid(registration)
    for name in ("shapely", "mapbox_earcut"):
        lidar_package(name)
    from .plan import read_walls
    from .register import register_walls, wall_points

    surfaces, points = _surfaces(file, units, height_m, floor_m, resolution_m)
    if register_walls_of is not None:
        matrix = register_walls(wall_points(surfaces), read_walls(register_walls_of), str(file)).matrix
    counts = {} if points is None else {"points": len(points)}
    sample = None if points is None else _some(points)
    if matrix is not None:
        surfaces = [changed(surface, vertices_m=_moved(surface.vertices_m, matrix)) for surface in surfaces]
        sample = None if sample is None else _moved(sample, matrix)
    write_scene(
        out,
        surfaces,
        frame=f"that of {file.name}, z upwards" + ("" if matrix is None else ", moved by the registration"),
        source=str(file),
        materials=materials,
        registration=matrix,
        points_m=sample,
        counts=counts,
        replace=replace,
    )
    return read_scene_folder(out)


def _surfaces(
    file: Path, units: str, height_m: float | None, floor_m: float, resolution_m: float | None
) -> tuple[list[Surface], FloatArray | None]:
    """The surfaces of a source, and its points if it is a scan."""
    from .cloud import surfaces_from_points
    from .plan import plan_surfaces

    if is_plan(file):
        if height_m is None:
            raise InputError(f"{file}: a plan has no heights; give that of the ceiling in metres (--height)")
        if units != "m":
            raise InputError(f"{file}: a plan is in metres; give its cell with --resolution and leave out --units")
        return plan_surfaces(file, height_m=height_m, floor_m=floor_m, resolution_m=resolution_m), None
    if height_m is not None or resolution_m is not None or floor_m:
        raise InputError(f"{file}: has heights of its own; leave out --height, --floor and --resolution")
    if _has_faces(file):
        return read_mesh(file, units), None
    points = read_points(file, units)
    check_extent(points, file)
    return surfaces_from_points(points), points


def is_plan(path: str | Path) -> bool:
    """Whether a file shows a building from above, in two dimensions: by its ending, its arrays or its columns."""
    file = Path(path)
    suffix = file.suffix.lower()
    if suffix in PLAN_SUFFIXES:
        return True
    try:
        if suffix == ".npz":
            with np.load(file, allow_pickle=False) as arrays:
                return "log_odds" in arrays or "xy_m" in arrays
        if suffix in (".xyz", ".txt"):
            with file.open(encoding="utf-8-sig") as stream:
                rows = (line.split("#")[0].replace(",", " ").split() for line in stream)
                return len(next((row for row in rows if row), [])) == 2
    except (OSError, ValueError):
        return False  # the reader of points says what is wrong with it
    return False


def _has_faces(file: Path) -> bool:
    """Whether a file is a mesh and not a cloud; PLY may be either."""
    if file.suffix.lower() not in SUFFIXES or not file.is_file():
        return False
    if file.suffix.lower() != ".ply":
        return True
    with file.open("rb") as stream:
        head = stream.read(1 << 16).split(b"end_header")[0].split()
    return b"face" in head and head[head.index(b"face") + 1] != b"0"


def _some(points_m: FloatArray) -> FloatArray:
    """A sample for the preview; every k-th point would show the scanner's pattern."""
    rng = np.random.default_rng(1)
    return points_m[rng.integers(len(points_m), size=min(PREVIEW_POINTS, len(points_m)))]


def _rigid(registration: ArrayLike) -> FloatArray:
    matrix = np.asarray(registration, float)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all() or not np.allclose(matrix[3], [0, 0, 0, 1]):
        raise InputError(f"registration: give a 4 x 4 matrix with the last row 0 0 0 1, not shape {matrix.shape}")
    rotation = matrix[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > RIGID or np.linalg.det(rotation) < 0:
        raise InputError("registration: not rigid (its rotation scales, shears or mirrors); give a rigid motion")
    return matrix


def _moved(points_m: FloatArray, matrix: FloatArray) -> FloatArray:
    return points_m @ matrix[:3, :3].T + matrix[:3, 3]
