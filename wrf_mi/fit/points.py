"""Point clouds as starting positions of Gaussians."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from ..core import InputError


def read_points(path: str | Path) -> NDArray[np.float64]:
    """Points [m, 3] in metres of a point cloud or mesh file.

    Args:
        path: ``.npz`` with an array ``points`` [m, 3], or any format that trimesh reads (PLY, XYZ, OBJ, STL).

    Raises:
        InputError: a file that is missing or has no points.
    """
    file = Path(path)
    if not file.is_file():
        raise InputError(f"{file}: no such file; give a point cloud (.ply, .xyz, .npz)")
    try:
        if file.suffix == ".npz":
            with np.load(file, allow_pickle=False) as arrays:
                points = arrays["points"]
        else:
            points = getattr(trimesh.load(file), "vertices", np.empty((0, 3)))
    except (ValueError, KeyError, AttributeError, OSError, NotImplementedError) as error:
        raise InputError(f"{file}: no points to be read ({error}); give .ply, .xyz, or .npz with points") from None
    points = np.asarray(points, float)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"{file}: expected points of shape [m, 3], got {list(points.shape)}")
    return points
