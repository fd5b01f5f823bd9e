"""Geometry of antenna arrays: elements in the array's x-y plane, boresight +z (`wrf_mi.core.angles`)."""

from __future__ import annotations

import numpy as np

from .angles import FloatArray


def planar_array(rows: int, columns: int, spacing_m: float) -> FloatArray:
    """Element positions of a uniform planar array, centred on its origin.

    Args:
        rows: elements along y.
        columns: elements along x.
        spacing_m: distance between neighbours along both axes, metres.

    Returns:
        Shape [rows * columns, 3] in metres, x fastest, z = 0.

    Raises:
        ValueError: fewer than one row or column, or a spacing that is not positive.
    """
    if rows < 1 or columns < 1 or not spacing_m > 0:
        raise ValueError(f"planar_array: {rows} x {columns} elements {spacing_m} m apart; all three must be positive")
    x = (np.arange(columns) - (columns - 1) / 2) * spacing_m
    y = (np.arange(rows) - (rows - 1) / 2) * spacing_m
    grid_y, grid_x = np.meshgrid(y, x, indexing="ij")
    return np.stack([grid_x.ravel(), grid_y.ravel(), np.zeros(rows * columns)], axis=-1)
