"""Whether a scan is level, by its walls: they are upright in a level scan, whatever the slope of floor and ceiling."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import trimesh

from ...core import InputError
from ...core.angles import FloatArray
from ..mesh.planes import near
from .planes import BAND, MERGE_ANGLE_RAD, find_planes, thin

MOST_POINTS = 200_000  # points of a scan by whose planes its level is judged
MOST_TILT_DEG = 15.0  # largest tilt that is corrected: more is no scanner held by hand, but another axis or a slope
SEARCHED_DEG = 45.0  # nearer to another axis, that one is up
LEAST_TILT_RAD = MERGE_ANGLE_RAD  # walls and registration lean by less
LEAST_FITTING = (
    0.5  # least share of the planes' area square to the vertical or level: slopes of roofs fit one by chance
)
LEAST_CORNER = np.sin(np.radians(20))  # sine of the least angle of two walls whose line of intersection is told


def level_rotation(points_m: FloatArray) -> tuple[FloatArray, float]:
    """Rotation [4, 4] that makes a scan [n, 3] level, and its angle in degrees; the identity and 0 for a level one.

    The vertical is the direction to which walls of two headings and a floor or ceiling are square and which fits a
    larger area of walls than z does. `InputError`: tilted by more than `MOST_TILT_DEG`.
    """
    chosen = np.random.default_rng(0).permutation(len(points_m))[:MOST_POINTS]
    cloud = thin(points_m[chosen] - np.floor(np.median(points_m, axis=0)))
    planes, noise_m = find_planes(cloud)
    if not planes:
        return np.eye(4), 0.0
    normals = np.stack([plane.normal for plane in planes])
    # Thinned points are as dense everywhere, so that their number is an area.
    size = np.array([np.count_nonzero(near(plane, cloud.points_m, BAND * noise_m)) for plane in planes], float)

    def walls(up: FloatArray) -> float:
        return float(size[np.abs(normals @ up) < np.sin(MERGE_ANGLE_RAD)].sum())

    z = np.array([0.0, 0.0, 1.0])
    best, most = z, walls(z)
    for a, b in combinations(normals, 2):
        across = np.cross(a, b)
        sine = np.linalg.norm(across)
        if sine < LEAST_CORNER:
            continue
        up = across / sine * np.sign(across[2] or 1.0)
        has_floor = (np.abs(normals @ up) > np.cos(MERGE_ANGLE_RAD)).any()
        if up[2] > np.cos(np.radians(SEARCHED_DEG)) and has_floor and walls(up) > most:
            best, most = up, walls(up)
    along = np.abs(normals @ best)
    is_wall, is_level = along < np.sin(MERGE_ANGLE_RAD), along > np.cos(MERGE_ANGLE_RAD)
    if best is z or size[is_wall | is_level].sum() < LEAST_FITTING * size.sum():
        return np.eye(4), 0.0
    # Least squares over all planes that fit: square to walls, along the normals of floors.
    weight = size * (is_wall.astype(float) - is_level)
    up = np.linalg.eigh((normals.T * weight) @ normals)[1][:, 0]
    up = up * np.sign(up[2])
    angle = float(np.arccos(min(up[2], 1.0)))
    if angle < LEAST_TILT_RAD:
        return np.eye(4), 0.0
    if np.degrees(angle) > MOST_TILT_DEG:
        text = f"its walls lean by {np.degrees(angle):.1f} degrees, more than {MOST_TILT_DEG:g}"
        raise InputError(f"{text}; level the scan, or state the axis that is up (--up)")
    return np.asarray(trimesh.geometry.align_vectors(up, z)), float(np.degrees(angle))
