"""A simulated LiDAR scan of a scene."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ... import backend
from ...core import InputError
from ...core.angles import FloatArray

RAYS_PER_POSE = 300_000
RANGE_NOISE_M = 0.02
"""Standard deviation of a range, metres: a phone or a mobile scanner; one on a tripod has a tenth of it."""
OUTLIERS = 0.01  # share of stray returns: edges, glass, people walking by


def simulate_scan(scene: Any, poses_m: ArrayLike, *, rays_per_pose: int = RAYS_PER_POSE, seed: int = 1) -> FloatArray:
    """Points of a simulated LiDAR at some positions.

    The rays of a position are spread evenly over the sphere (a Fibonacci lattice, turned at random); each return is
    moved along its ray by Gaussian noise (`RANGE_NOISE_M`), and a share of them (`OUTLIERS`) to a uniform random part
    of its range.

    Args:
        scene: a Mitsuba scene file, or a ``mi.Scene`` (for a ``sionna.rt.Scene``: its ``mi_scene``).
        poses_m: scanner positions [k, 3], metres.
        rays_per_pose: number of rays from each position.
        seed: seed of the noise.

    Returns:
        Points [n, 3] in metres; rays that meet nothing leave none.

    Raises:
        InputError: no ray met anything.
    """
    backend.init()
    import mitsuba as mi

    from ...backend.device import to_vectors

    if isinstance(scene, str | Path):
        scene = mi.load_file(str(scene))
    rng = np.random.default_rng(seed)
    parts = []
    for pose in np.asarray(poses_m, float).reshape(-1, 3):
        index = np.arange(rays_per_pose) + rng.random()  # Gonzalez 2010, Math. Geosci. 42
        z, azimuth = 1 - 2 * index / (rays_per_pose + 1), index * (np.pi * (3 - np.sqrt(5))) + rng.random() * 2 * np.pi
        across = np.sqrt(1 - z * z)
        directions = np.stack([across * np.cos(azimuth), across * np.sin(azimuth), z], axis=-1)
        ray = mi.Ray3f(mi.Point3f(*pose.tolist()), to_vectors(directions, mi.Vector3f))
        distance = np.array(scene.ray_intersect_preliminary(ray).t, float)
        hit = np.isfinite(distance)
        distance = distance[hit] + rng.normal(0, RANGE_NOISE_M, np.count_nonzero(hit))
        stray = rng.random(len(distance)) < OUTLIERS
        distance[stray] *= rng.random(np.count_nonzero(stray))
        parts.append(pose + directions[hit] * distance[:, None])
    points = np.concatenate(parts)
    if not len(points):
        raise InputError("simulated scan: no ray met the scene; put the scanner inside it")
    return points
