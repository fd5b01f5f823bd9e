"""Point clouds and meshes from files, in metres."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh

from ..core import InputError
from ..core.angles import FloatArray
from ..core.files import one_line
from .packages import lidar_package

UNITS_M = {"m": 1.0, "cm": 0.01, "mm": 0.001, "ft": 0.3048}
"""Length of each unit that a scan may be in."""
FORMATS = ".ply, .las, .laz, .xyz, .txt, or .npz with points"
LARGEST_M = 1000.0
HIGHEST_M = 100.0
SMALLEST_M = 0.5
"""Scans of rooms and buildings are smaller and larger than that, or their units are others."""
CORE = (0.005, 0.995)
"""Share of the coordinates between which the extent is taken: strays do not make a room larger."""


def read_points(path: str | Path, units: str = "m") -> FloatArray:
    """Points [m, 3] in metres of a point cloud, or the vertices of a mesh.

    Args:
        path: ``.npz`` with an array ``points`` or ``xyz_m`` [m, 3]; ``.las`` or ``.laz``; ``.xyz`` or ``.txt`` with
            three or more columns, separated by spaces or commas; or any format that trimesh reads (PLY, OBJ, STL).
        units: of the file's coordinates, a key of `UNITS_M`.

    Raises:
        InputError: a file that is missing, has no points, or one that is not finite; units that are not known.
    """
    file = Path(path)
    if units not in UNITS_M:
        raise InputError(f"units {units!r}: not known; give one of {', '.join(UNITS_M)}")
    if not file.is_file():
        raise InputError(f"{file}: no such file; give a point cloud ({FORMATS})")
    suffix = file.suffix.lower()
    if suffix in (".las", ".laz"):
        # Outside the net below: a missing package is no fault of the file.
        lidar_package("laspy")
    read: Callable[[Path], FloatArray] = _READERS.get(suffix, _read_trimesh)
    try:
        points = np.asarray(read(file), float)
    except Exception as error:  # NumPy, laspy and trimesh raise a dozen kinds on damaged files
        raise InputError(f"{file}: no points to be read ({one_line(error)}); give {FORMATS}") from None
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"{file}: expected points of shape [m, 3], got {list(points.shape)}")
    if len(points) == 0:
        raise InputError(f"{file}: no points in it; give {FORMATS}")
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if len(bad):
        raise InputError(f"{file}, point {bad[0] + 1}: not finite; remove that point")
    return points if UNITS_M[units] == 1 else points * UNITS_M[units]


def check_extent(points_m: FloatArray, name: str | Path) -> None:
    """Refuse coordinates that are not metres of a room or a building.

    Args:
        points_m: shape [n, 3].
        name: of the source, for the error.

    Raises:
        InputError: they look like millimetres or centimetres, or are too small for a room.
    """
    low, high = np.quantile(points_m, CORE, axis=0)
    size = high - low
    text = " x ".join(f"{side:.4g}" for side in size)
    if size.max() > LARGEST_M:
        raise InputError(f"{name}: extent {text} m looks like millimetres; give --units mm (or cut out one building)")
    if size[2] > HIGHEST_M:
        raise InputError(f"{name}: extent {text} m looks like centimetres; give --units cm (or cut out one building)")
    if size.max() < SMALLEST_M:
        raise InputError(f"{name}: extent {text} m is too small for a room; give its --units ({', '.join(UNITS_M)})")


def _read_arrays(file: Path) -> FloatArray:
    with file.open("rb") as stream, np.load(stream, allow_pickle=False) as arrays:
        return np.asarray(arrays["xyz_m" if "xyz_m" in arrays else "points"], float)


def _read_las(file: Path) -> FloatArray:
    with lidar_package("laspy").open(file) as source:
        return np.asarray(source.read().xyz, float)


def _read_text(file: Path) -> FloatArray:
    with file.open(encoding="utf-8-sig") as stream:
        commas = "," in next((line for line in stream if line.strip() and not line.startswith("#")), "")
    return np.loadtxt(file, usecols=(0, 1, 2), delimiter="," if commas else None, ndmin=2, encoding="utf-8-sig")


def _read_trimesh(file: Path) -> FloatArray:
    return np.asarray(getattr(trimesh.load(file), "vertices", np.empty((0, 3))), float)


_READERS = {
    ".npz": _read_arrays,
    ".las": _read_las,
    ".laz": _read_las,
    ".xyz": _read_text,
    ".txt": _read_text,
}
