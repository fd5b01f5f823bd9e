"""A point cloud thinned to the means of small cells, strays removed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..core import InputError
from ..core.angles import FloatArray
from .packages import lidar_package

VOXEL_M = 0.03
"""Edge of the cells: a desk's side still has several."""
MOST_VOXELS = 600_000
"""More and the cells grow: bounds time and memory of a large building."""
NORMAL_RADIUS_M = 0.15
NORMAL_NEIGHBOURS = 50
STRAY_NEIGHBOURS = 20
STRAY_RATIO = 2.0
"""A mean farther from its neighbours than usual by this many standard deviations is a stray."""


@dataclass(frozen=True)
class Thinned:
    """A thinned point cloud.

    Attributes:
        points_m: mean of the points in each cell, shape [m, 3], metres.
        count: number of points behind each mean, shape [m].
        normals: unit vectors of either sign, shape [m, 3].
        voxel_m: edge of the cells, metres.
    """

    points_m: FloatArray
    count: FloatArray
    normals: FloatArray
    voxel_m: float


def thin(points_m: FloatArray) -> Thinned:
    """Thin a cloud [n, 3] in metres to at most `MOST_VOXELS` means, drop strays and estimate normals.

    Raises:
        InputError: Open3D is missing, or hardly a point has neighbours.
    """
    o3d = lidar_package("open3d")
    voxel = VOXEL_M
    mean, count = _cells(points_m, voxel)
    while len(mean) > MOST_VOXELS:
        voxel *= 1.25
        mean, count = _cells(points_m, voxel)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(mean))
    cloud, kept = cloud.remove_statistical_outlier(STRAY_NEIGHBOURS, STRAY_RATIO)
    if len(kept) < STRAY_NEIGHBOURS:
        raise InputError(f"only {len(kept)} points have neighbours; give a denser point cloud")
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(NORMAL_RADIUS_M * voxel / VOXEL_M, NORMAL_NEIGHBOURS))
    return Thinned(np.asarray(cloud.points), count[kept], np.asarray(cloud.normals), voxel)


def _cells(points_m: FloatArray, voxel_m: float) -> tuple[FloatArray, FloatArray]:
    """Mean [m, 3] and number [m] of the points in each cell."""
    low = points_m.min(axis=0)
    size = np.ceil((points_m.max(axis=0) - low) / voxel_m).astype(np.int64) + 1
    cell = ((points_m - low) / voxel_m).astype(np.int64)
    key = np.ravel_multi_index(tuple(cell.T), tuple(size))
    _, inverse = np.unique(key, return_inverse=True)
    count = np.bincount(inverse).astype(float)
    mean = np.stack([np.bincount(inverse, points_m[:, axis]) / count for axis in range(3)], axis=1)
    return mean, count
