"""Walls of a flat from a robot's map."""

from pathlib import Path

import numpy as np
import pytest
from changed_folders import DATA, needs

from wrf_mi.scene.plan.sources import PlanGrid, read_layout
from wrf_mi.scene.plan.storey import layout_walls
from wrf_mi.scene.plan.walls import find_walls


@needs("flat-ble/lidar")
def test_walls_from_a_robots_map_agree_with_the_layout():
    from wrf_mi_bench.scene import GRID_RESOLUTION_M, GRID_ROW_0, wall_agreement

    from wrf_mi.scene.plan.sources import read_plan
    from wrf_mi.scene.register import best_scale, register_walls, sample_walls

    home = Path(DATA, "flat-ble")
    grid = read_plan(home / "lidar" / "gridmap.npz", GRID_RESOLUTION_M, GRID_ROW_0)
    assert isinstance(grid, PlanGrid)
    walls, true = find_walls(grid), layout_walls(read_layout(home / "layout.csv"))
    motion = register_walls(sample_walls(walls), true)
    walls = walls @ motion[:2, :2].T + motion[:2, 3]
    # Measured 0.74 and 0.66; furniture hides 23 % of the layout from the robot, and its fronts look like walls.
    found, right = wall_agreement(walls, true)
    assert found > 0.70
    assert right > 0.60
    assert best_scale(sample_walls(walls), np.zeros(3), true)[0] == pytest.approx(1, abs=0.03)
