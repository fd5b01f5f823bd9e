"""Point clouds from files, in metres, and thinned to the means of small cells."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from ...core import InputError
from ...core.angles import FloatArray
from ...core.array_files import stored_array, stored_arrays
from ...core.files import one_line
from ...core.memory import require_memory
from ...parallel import run_module
from ..coordinates import FORMATS, UNITS_M, Up, require_precise, source_file, turned, up_of
from ..mesh.polygon_files import read_obj, read_ply

SYSTEM = "apt-get install libusb-1.0-0 libgl1 libegl1 libx11-6"
"""Libraries that Open3D is linked against and a small system lacks."""
MOST_LAZ = 1000  # largest ratio of LAZ compression: points of a cloud reach 10, equal points a hundred
LAS_HEADER, LAS_MINOR, LAS_EXTENDED = 375, 25, 4
"""Bytes of the header of LAS 1.4, place of its minor version, and the version from which extended records exist."""
LAS_RECORDS = (("records", 100, 54), ("extended records", 243, 60))
"""Places of the numbers (32 bits) of variable-length records in the header, and the least bytes of a record."""
LAZ_BYTES, LAZ_S, LAZ_BYTES_PER_S = 4 << 30, 30.0, 1 << 20
"""Address space of the process that reads LAZ beside its points, and the time that it has."""
VOXEL_M = 0.03  # edge of the cells: a desk's side still has several
MOST_VOXELS = 600_000  # the cells of a large building grow until there are no more: bounds time and memory
NORMAL_RADIUS_M, NORMAL_NEIGHBOURS = 0.15, 50
STRAY_NEIGHBOURS, STRAY_RATIO = 20, 2.0
"""A mean farther from its neighbours than usual by this many standard deviations is a stray."""


@dataclass(frozen=True)
class Thinned:
    """A thinned point cloud: mean of the points in each cell [m, 3], their number [m], and unit normals [m, 3]."""

    points_m: FloatArray
    count: FloatArray
    normals: FloatArray


def lidar_package(name: str) -> Any:
    """A package of the extra ``lidar``; an `InputError` if it or a system library that it needs is not installed."""
    try:
        return import_module(name)
    except ModuleNotFoundError:
        raise InputError(f"scenes from scans need {name}: pip install 'wrf-mi[lidar]'") from None
    except ImportError as error:
        text = one_line(error)
        raise InputError(f"{name} cannot be loaded ({text}); install that library, on Debian: {SYSTEM}") from None


def read_points(path: str | Path, units: str = "m", up: Up | None = None) -> FloatArray:
    """Points [m, 3] in metres, z up, of a point cloud, or the vertices of a mesh.

    Args:
        path: ``.npz`` with an array ``points`` or ``xyz_m`` [m, 3]; ``.las`` or ``.laz``; ``.xyz`` or ``.txt`` with
            three or more columns, separated by spaces or commas; or any format that trimesh reads (PLY, OBJ, STL).
        units: unit of the file's coordinates, a key of `UNITS_M`.
        up: axis that is up in it, see `wrf_mi.scene.mesh.files.mesh_parts`.

    Raises:
        InputError: missing file, unknown units, no points, a point that is not finite, or coordinates that were
            rounded far from the origin.
    """
    file = source_file(path, units, f"a point cloud ({FORMATS})")
    if file.suffix.lower() in (".las", ".laz"):
        lidar_package("laspy")  # a missing package is no fault of the file
    try:
        points = np.asarray(_read(file), float)
    except InputError:
        raise
    except Exception as error:  # NumPy, laspy and trimesh raise a dozen kinds on damaged files
        raise InputError(f"{file}: no points to be read ({one_line(error)}); give {FORMATS}") from None
    if points.size == 0:
        raise InputError(f"{file}: no points in it; give {FORMATS}")
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"{file}: expected points of shape [m, 3], got {list(points.shape)}")
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if len(bad):
        raise InputError(f"{file}, point {bad[0] + 1}: not finite; remove that point")
    require_precise(points, UNITS_M[units], file)
    return turned(points if UNITS_M[units] == 1 else points * UNITS_M[units], up_of(file, up))


def thin(points_m: FloatArray) -> Thinned:
    """Thin a cloud [n, 3] in metres to at most `MOST_VOXELS` means, drop strays and estimate normals."""
    o3d = lidar_package("open3d")
    voxel = VOXEL_M
    mean, count = _cells(points_m, voxel)
    while len(mean) > MOST_VOXELS:
        voxel *= 1.25
        mean, count = _cells(points_m, voxel)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(mean))
    cloud, rows = cloud.remove_statistical_outlier(STRAY_NEIGHBOURS, STRAY_RATIO)
    if len(rows) < STRAY_NEIGHBOURS:
        raise InputError(f"only {len(rows)} points have neighbours; give a denser point cloud")
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(NORMAL_RADIUS_M * voxel / VOXEL_M, NORMAL_NEIGHBOURS))
    return Thinned(np.asarray(cloud.points), count[rows], np.asarray(cloud.normals))


def _cells(points_m: FloatArray, voxel_m: float) -> tuple[FloatArray, FloatArray]:
    """Mean [m, 3] and number [m] of the points in each cell."""
    cell = ((points_m - points_m.min(axis=0)) / voxel_m).astype(np.int64)
    key = np.ravel_multi_index(tuple(cell.T), tuple(cell.max(axis=0) + 1))
    _, inverse = np.unique(key, return_inverse=True)
    count = np.bincount(inverse).astype(float)
    return np.stack([np.bincount(inverse, points_m[:, axis]) / count for axis in range(3)], axis=1), count


def _read_las(file: Path) -> Any:
    """Points of a LAS or LAZ file, whose header must not state more than the file can hold."""
    size = file.stat().st_size
    laspy = lidar_package("laspy")
    with file.open("rb") as stream:
        head = stream.read(LAS_HEADER).ljust(LAS_HEADER, b"\0")
    for what, at, least in LAS_RECORDS:  # laspy reads as many as are stated, beyond the end of the file, too
        records = int.from_bytes(head[at : at + 4], "little")
        if (what == "records" or head[LAS_MINOR] >= LAS_EXTENDED) and records * least > size:
            raise ValueError(f"states {records} {what}, and has {size} bytes")
    with laspy.open(file) as source:
        header = source.header
        packed, needed = header.are_points_compressed, header.point_count * header.point_format.size
        if needed > size * (MOST_LAZ if packed else 1):
            raise ValueError(f"states {header.point_count} points, and has {size} bytes")
        require_memory(4 * needed, f"{file}: {header.point_count} points", "thin the cloud first")
        if not packed:
            return source.read().xyz
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "points.npy"
        arguments = [str(file), str(out), str(LAZ_BYTES + 4 * needed)]
        seconds = LAZ_S + size / LAZ_BYTES_PER_S
        status, message = run_module("wrf_mi.scene.scan.read_laz", arguments, quiet=True, most_s=seconds)
        if status != 0:
            raise ValueError(message if status == 1 else "its compressed points are damaged")
        return stored_array(out)


def _read(file: Path) -> Any:
    match file.suffix.lower():
        case ".npz":
            arrays = stored_arrays(file, ("xyz_m", "points"))
            if not arrays:
                raise InputError(f"{file}: no array points or xyz_m in it; give one [m, 3]")
            return arrays["xyz_m" if "xyz_m" in arrays else "points"]
        case ".las" | ".laz":
            return _read_las(file)
        case ".xyz" | ".txt":
            with file.open(encoding="utf-8-sig") as text:
                commas = "," in next((line for line in text if line.strip() and not line.startswith("#")), "")
            columns, delimiter = (0, 1, 2), "," if commas else None
            return np.loadtxt(file, usecols=columns, delimiter=delimiter, ndmin=2, encoding="utf-8-sig")
        case ".ply":
            return read_ply(file).vertices
        case ".obj":
            return read_obj(file).vertices
    with file.open("rb") as stream:  # without a name no other file is looked for
        return getattr(trimesh.load(stream, file_type=file.suffix.lower().removeprefix(".")), "vertices", [])
