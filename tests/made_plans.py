"""A storey with known walls, and what a robot with a LiDAR would see of it."""

from pathlib import Path
from typing import Any

import numpy as np
import shapely

from wrf_mi.scene.plan.grid import PlanGrid
from wrf_mi.scene.plan.sources import grid_from_points, read_plan

WIDTH_M, DEPTH_M, INNER_M = 6.0, 4.0, 3.5
DOOR_M = (1.0, 1.9)
"""Along y, in the wall between the two rooms."""

L_ROOM_M = np.array([[0, 0], [5, 0], [5, 2], [2.5, 2], [2.5, 4.5], [0, 4.5], [0, 0]], float)
"""Vertices of a room without any symmetry."""
POSES_M = np.array([[1.0, 1.0], [2.5, 3.0], [4.5, 1.4], [5.0, 3.0]])


def read_grid(path: Path, resolution_m: float | None = None, row_0: Any = None) -> PlanGrid:
    """A plan from a file of cells."""
    grid = read_plan(path, resolution_m, row_0)
    assert isinstance(grid, PlanGrid)
    return grid


def box(x, y, width, depth):
    """The four sides of a box [4, 2, 2], a piece of furniture or a storey."""
    corners = np.array([[x, y], [x + width, y], [x + width, y + depth], [x, y + depth], [x, y]], float)
    return np.stack([corners[:-1], corners[1:]], axis=1)


INNER_WALL_M = [[[INNER_M, 0], [INNER_M, DOOR_M[0]]], [[INNER_M, DOOR_M[1]], [INNER_M, DEPTH_M]]]
TWO_ROOMS_M = np.concatenate([box(0, 0, WIDTH_M, DEPTH_M), INNER_WALL_M])


def turn(points_m, degrees, shift_m=(0.0, 0.0)):
    """Points [..., 2] turned about the origin, then shifted."""
    a = np.radians(degrees)
    return points_m @ np.array([[np.cos(a), np.sin(a)], [-np.sin(a), np.cos(a)]]) + shift_m


def scan(walls_m, pose_m, beams=720, noise_m=0.01, seed=0):
    """Where beams from a place meet the first wall, [n, 2]; a beam that meets none is left out."""
    angle = np.linspace(0, 2 * np.pi, beams, endpoint=False)
    ray = np.stack([np.cos(angle), np.sin(angle)], axis=-1)[:, None]
    begin, along = walls_m[None, :, 0] - pose_m, walls_m[None, :, 1] - walls_m[None, :, 0]
    cross = ray[..., 0] * along[..., 1] - ray[..., 1] * along[..., 0]
    safe = np.where(np.abs(cross) < 1e-9, np.inf, cross)
    distance = (begin[..., 0] * along[..., 1] - begin[..., 1] * along[..., 0]) / safe
    part = (begin[..., 0] * ray[..., 1] - begin[..., 1] * ray[..., 0]) / safe
    met = np.where((distance > 1e-6) & (part >= 0) & (part <= 1) & np.isfinite(safe), distance, np.inf).min(axis=1)
    hit = np.isfinite(met)
    met = met[hit] + np.random.default_rng(seed).normal(0, noise_m, np.count_nonzero(hit))
    return pose_m + met[:, None] * ray[hit, 0]


def scans(walls_m, poses_m=POSES_M, **more):
    """Returns of a scan from each place, a list of [n, 2]."""
    return [scan(walls_m, pose, seed=i, **more) for i, pose in enumerate(np.asarray(poses_m, float))]


def grid_of(walls_m, poses_m=POSES_M, resolution_m=0.05, **more):
    """The map that scans from known poses make: occupied where a beam ended, free where more went through."""
    poses_m = np.asarray(poses_m, float)
    clouds = scans(walls_m, poses_m, **more)
    grid = grid_from_points(np.concatenate(clouds), resolution_m)
    passes = np.zeros(grid.occupied.shape, bool)
    for pose, cloud in zip(poses_m, clouds, strict=True):
        part = np.linspace(0, 1, 400)[:, None, None]
        cells = ((pose + part * (cloud - pose) - grid.origin_m) / resolution_m).astype(int).reshape(-1, 2)
        passes[cells[:, 1], cells[:, 0]] = True
    return PlanGrid(grid.occupied, passes & ~grid.occupied, resolution_m, grid.origin_m)


def agreement(made_m, true_m, tolerance_m):
    """Share of the true walls near made ones, and of the made walls near true ones."""
    made_lines, true = (shapely.unary_union(shapely.linestrings(w)) for w in (made_m, true_m))
    recall = true.intersection(made_lines.buffer(tolerance_m)).length / true.length
    right = made_lines.intersection(true.buffer(tolerance_m)).length / made_lines.length
    return recall, right


def distance(point_m, walls_m):
    """From a point to the nearest wall, metres."""
    return shapely.unary_union(shapely.linestrings(walls_m)).distance(shapely.Point(point_m))
