"""Geometry of antenna arrays: elements in the array's x-y plane, boresight +z (`wrf_mi.core.angles`)."""

from __future__ import annotations

import numpy as np

from .angles import FloatArray


def planar_array(rows: int, columns: int, spacing_m: float) -> FloatArray:
    """Element positions [rows * columns, 3] of a uniform planar array, metres, centred on its origin in z = 0.

    Rows follow each other along y and columns along x, which runs fastest, ``spacing_m`` apart. `ValueError` for fewer
    than one row or column, or a spacing that is not positive.
    """
    if rows < 1 or columns < 1 or not spacing_m > 0:
        raise ValueError(f"planar_array: {rows} x {columns} elements {spacing_m} m apart; all three must be positive")
    x = (np.arange(columns) - (columns - 1) / 2) * spacing_m
    y = (np.arange(rows) - (rows - 1) / 2) * spacing_m
    grid_y, grid_x = np.meshgrid(y, x, indexing="ij")
    return np.stack([grid_x.ravel(), grid_y.ravel(), np.zeros(rows * columns)], axis=-1)
