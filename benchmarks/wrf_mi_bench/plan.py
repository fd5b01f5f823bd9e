"""Walls found in a robot's map and LiDAR returns of a furnished flat, compared with walls measured by hand."""

import time
from typing import Any

import numpy as np
import shapely

from wrf_mi.core import InputError
from wrf_mi.core.angles import FloatArray
from wrf_mi.scene.plan.alignment import grid_from_scans
from wrf_mi.scene.plan.sources import PlanGrid, PlanPoints, Row0, grid_from_points, read_layout, read_plan
from wrf_mi.scene.plan.storey import layout_walls
from wrf_mi.scene.plan.walls import find_walls
from wrf_mi.scene.register import best_scale, register_walls, sample_walls

from .comparison import data_folder, line

NEAR_M = 0.2  # distance within which walls agree: the blur of the robot's poses
GRID_RESOLUTION_M = 0.04
"""Resolution of the SLAM map: ``size = 20, res = 0.04``, so 500 cells, in the notebook of its author
(github.com/marckolak/graphSLAM, examples/Mapping.ipynb); registration to the layout finds the same."""
GRID_ROW_0: Row0 = "top"  # side of the map's first row; registration to the layout refuses the mirror image
ASKED = "0.85 and 0.85"


def wall_agreement(made_m: FloatArray, true_m: FloatArray, near_m: float = NEAR_M) -> tuple[float, float]:
    """Shares of true walls [m, 2, 2] near walls made [n, 2, 2], by length, and the reverse; end points in m."""
    made_walls, true = (shapely.unary_union(shapely.linestrings(walls)) for walls in (made_m, true_m))
    share_found = shapely.intersection(true, shapely.buffer(made_walls, near_m)).length / true.length
    right = shapely.intersection(made_walls, shapely.buffer(true, near_m)).length / made_walls.length
    return float(share_found), float(right)


def flat_plan() -> dict[str, Any]:
    """Walls from ``lidar/gridmap.npz`` and ``lidar/points.npz`` of flat-ble, registered to ``layout.csv``.

    An upper bound for any method is the share of the layout near an occupied cell. Each source has shares, what can be
    seen, walls, scale of the registration, seconds.
    """
    home = data_folder("flat-ble")
    true = layout_walls(read_layout(home / "layout.csv"))
    lidar = home / "lidar"
    grid, returns = read_plan(lidar / "gridmap.npz", GRID_RESOLUTION_M, GRID_ROW_0), read_plan(lidar / "points.npz")
    if not isinstance(grid, PlanGrid) or not isinstance(returns, PlanPoints) or returns.time_s is None:
        raise InputError(f"{lidar}: expected log_odds in gridmap.npz, xy_m and time_s in points.npz")
    begin = time.perf_counter()
    scans = grid_from_scans(returns.xy_m, returns.time_s)
    aligning_s = time.perf_counter() - begin
    figures: dict[str, Any] = {
        "gridmap": _measured(grid, true),
        "points": _measured(scans, true) | {"aligning_seconds": aligning_s},
        # In the layout's frame by the robot's poses; too blurred for a fit to be accepted.
        "points without alignment": _measured(grid_from_points(returns.xy_m), true, register=False),
    }
    rows = [
        line(
            f"{name}: layout within {NEAR_M} m of a wall made, and the reverse",
            f"{f['layout_found']:.2f} and {f['walls_right']:.2f} (seen at all: {f['layout_seen']:.2f})",
            ASKED if name == "gridmap" else "-",
        )
        for name, f in figures.items()
    ]
    return {"rows": rows, **figures}


def _measured(grid: PlanGrid, true: FloatArray, register: bool = True) -> dict[str, Any]:
    begin = time.perf_counter()
    walls, cells = find_walls(grid), grid.centres_m(grid.occupied)
    seconds = time.perf_counter() - begin
    scale = None
    if register:
        motion = register_walls(sample_walls(walls), true)
        walls, cells = (points @ motion[:2, :2].T + motion[:2, 3] for points in (walls, cells))
        scale, _ = best_scale(sample_walls(walls), np.zeros(3), true)
    share_found, right = wall_agreement(walls, true)
    line = shapely.unary_union(shapely.linestrings(true))
    near_cells = shapely.intersection(line, shapely.buffer(shapely.multipoints(cells), NEAR_M)).length / line.length
    return {
        "layout_found": share_found,
        "walls_right": right,
        "layout_seen": float(near_cells),
        "walls": len(walls),
        "length_m": float(np.linalg.norm(walls[:, 1] - walls[:, 0], axis=-1).sum()),
        "scale": scale,
        "seconds": seconds,
    }
