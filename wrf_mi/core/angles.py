"""Directions, pixels and orientations.

Azimuth runs from +x towards +y, elevation from the array's x-y plane towards its normal +z, both in the receiver's
frame and in radians. Sample (row r, column c) of an H x W spectrum is the *point* at elevation ``r * 90 / H`` degrees
and azimuth ``c * 360 / W`` degrees; the azimuth wraps.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

UNIT_QUATERNION_TOLERANCE = 1e-3
"""Largest accepted deviation of a quaternion's norm from one: files carry five or more digits."""


def elevation_rad(height: int) -> FloatArray:
    """Elevation of each of ``height`` rows over the upper hemisphere, in radians, shape [height]."""
    return np.arange(height, dtype=float) * (np.pi / 2 / height)


def azimuth_rad(width: int) -> FloatArray:
    """Azimuth of each of ``width`` columns over the full circle, in radians, shape [width]."""
    return np.arange(width, dtype=float) * (2 * np.pi / width)


def unit_vectors(azimuth: ArrayLike, elevation: ArrayLike) -> FloatArray:
    """Unit vectors [..., 3] of directions in the receiver's frame, of angles in radians whose shapes broadcast."""
    az, el = np.broadcast_arrays(np.asarray(azimuth, float), np.asarray(elevation, float))
    return np.stack([np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), np.sin(el)], axis=-1)


def pixel_directions(height: int, width: int) -> FloatArray:
    """Unit vector of every pixel of a ``height`` x ``width`` spectrum, shape [height, width, 3]."""
    return unit_vectors(azimuth_rad(width)[None, :], elevation_rad(height)[:, None])


def solid_angles(height: int, width: int) -> FloatArray:
    """Weight of each pixel in an integral over the upper hemisphere, [height * width], steradian.

    cos(elevation) times the pixel's angles, by the trapezoidal rule: the horizon counts half in each hemisphere.
    """
    rows = np.cos(elevation_rad(height)) * (np.pi / 2 / height) * (2 * np.pi / width)
    rows[0] /= 2
    return np.repeat(rows, width)


def azimuth_elevation(vectors: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Azimuth in [0, 2 pi) and elevation in [-pi/2, pi/2], in radians, of vectors [..., 3]."""
    v = np.asarray(vectors, float)
    return np.arctan2(v[..., 1], v[..., 0]) % (2 * np.pi), np.arctan2(v[..., 2], np.hypot(v[..., 0], v[..., 1]))


def rotation_matrix(quaternion_xyzw: ArrayLike) -> FloatArray:
    """Rotation matrices [..., 3, 3] of quaternions [..., 4] in the order x, y, z, w.

    The quaternions are normalised first; unknown ones (NaN), which SciPy refuses, give NaN. Source: Shuster, "A survey
    of attitude representations" (1993).
    """
    q = np.asarray(quaternion_xyzw, float)
    x, y, z, w = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def fibonacci_sphere(count: int) -> FloatArray:
    """Unit vectors [count, 3] spread evenly over the sphere (Gonzalez, 2010)."""
    number = np.arange(count) + 0.5
    z = 1 - 2 * number / count
    # Heights are uniform, hence areas equal; successive azimuths differ by the golden ratio of a turn, modulo 2 pi.
    turn, radius = np.pi * (1 + np.sqrt(5)) * number, np.sqrt(1 - z**2)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), z], axis=1)
