"""Point clouds as starting positions of Gaussians."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from ..core import InputError
from ..core.files import one_line


def read_points(path: str | Path) -> NDArray[np.float64]:
    """Points [m, 3] in metres of a point cloud or mesh file.

    Args:
        path: ``.npz`` with an array ``points`` [m, 3], or any format that trimesh reads (PLY, XYZ, OBJ, STL).

    Raises:
        InputError: a file that is missing, has no points, or one that is not finite.
    """
    file = Path(path)
    if not file.is_file():
        raise InputError(f"{file}: no such file; give a point cloud (.ply, .xyz, .npz)")
    try:
        if file.suffix == ".npz":
            with file.open("rb") as stream, np.load(stream, allow_pickle=False) as arrays:
                points = np.asarray(arrays["points"], float)
        else:
            points = np.asarray(getattr(trimesh.load(file), "vertices", np.empty((0, 3))), float)
    except Exception as error:  # NumPy and trimesh raise a dozen kinds on damaged files
        raise InputError(
            f"{file}: no points to be read ({one_line(error)}); give .ply, .xyz, or .npz with points"
        ) from None
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"{file}: expected points of shape [m, 3], got {list(points.shape)}")
    if len(points) == 0:
        raise InputError(f"{file}: no points in it; give .ply, .xyz, or .npz with points")
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if len(bad):
        raise InputError(f"{file}, point {bad[0] + 1}: not finite; remove that point")
    return points
