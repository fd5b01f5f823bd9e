"""Paths and walls of scenes from scans, plans and maps, and the comparison with MATLAB's image method."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from changed_folders import DATA, needs
from made_rooms import scene_file, two_rooms
from traced_rooms import FREQUENCY_HZ, SHOEBOX, WAVELENGTH_M, inside, receiver, room
from wrf_mi_bench.scene import GRID_RESOLUTION_M, GRID_ROW_0, match, scan_to_paths, spread, wall_agreement
from wrf_mi_bench.trace import confirm_paths, image_method_agreement, match_paths
from wrf_mi_scenes.build_laboratory import sheet

from wrf_mi.core import Receiver
from wrf_mi.core.array_files import write_arrays
from wrf_mi.scene.make import make_scene
from wrf_mi.scene.plan.sources import PlanGrid, read_layout, read_plan
from wrf_mi.scene.plan.storey import layout_walls
from wrf_mi.scene.plan.walls import find_walls
from wrf_mi.scene.register import best_scale, register_walls, sample_walls
from wrf_mi.scene.scan import simulate_scan
from wrf_mi.tracing import TraceOptions, open_scene, trace_paths
from wrf_mi.tracing.search.surfaces import scene_surfaces

SHARE = 0.99
"""Share of MATLAB's paths; missing ones meet a face of square millimetres."""
CEA_DB = 30.0


@needs("newrf")
@pytest.mark.parametrize("name", ["conference", "office"])
def test_paths_of_matlabs_image_method_are_found(name):
    agreement = image_method_agreement(Path(DATA, "newrf", f"{name}.npz"), rays=1 << 17)
    assert agreement["share_found"] >= SHARE
    assert agreement["length_error_m"] < 1e-3
    assert agreement["cea_db"]["median"] >= CEA_DB
    assert agreement["cea_db_where_matlab_lacks_none"]["p10"] >= CEA_DB
    # What MATLAB lacks is there, by brute force in float64, but for paths that pass within 0.1 mm of an edge.
    assert agreement["of_these_confirmed"] >= 0.99 * agreement["paths_matlab_lacks"]


@pytest.mark.parametrize("line_of_sight", [True, False])
def test_a_reference_that_lacks_a_path_at_every_position_is_compared(tmp_path, line_of_sight):
    """One with the line of sight alone, and one without paths."""
    trimesh.util.concatenate([part for _, part in SHOEBOX.values()]).export(tmp_path / "room.stl")
    moving, fixed = inside(3), np.array([4.4, 3.1, 1.7])
    count = 3 if line_of_sight else 0
    length = np.linalg.norm(moving - fixed, axis=1)[:count]
    gain = WAVELENGTH_M / (4 * np.pi * length) * np.exp(-2j * np.pi / WAVELENGTH_M * length)
    csi = gain if line_of_sight else np.zeros(3, complex)
    offsets = np.arange(4) if line_of_sight else np.zeros(4, np.int64)
    paths: dict[str, Any] = {"path_offsets": offsets, "path_gain": gain, "path_last_point": np.tile(fixed, (count, 1))}
    channels: dict[str, Any] = {"frequency_hz": FREQUENCY_HZ, "csi": csi, "line_of_sight": np.full(3, line_of_sight)}
    write_arrays(tmp_path / "room.npz", {"tx_pos": fixed, "rx_pos": moving} | channels | paths)
    agreement = image_method_agreement(tmp_path / "room.npz", rays=1 << 12)
    assert agreement["receivers_matlab_lacks_paths"] == agreement["receivers"] == 3
    assert agreement["of_these_confirmed"] == agreement["paths_matlab_lacks"] > 50
    assert agreement["cea_db_where_matlab_lacks_none"] is None
    if line_of_sight:
        assert agreement["share_found"] == 1
        assert agreement["cea_db"]["median"] < 10
    else:
        assert agreement["share_found"] is agreement["cea_db"] is None


def test_matching_is_one_to_one():
    ours = np.array([0, 0, 1]), np.array([1.0, 1.0004, 2.0]), np.zeros((3, 3))
    theirs = np.array([0, 0, 1, 1]), np.array([1.0003, 1.0001, 2.0, 2.5]), np.zeros((4, 3))
    pairs = zip(*(rows.tolist() for rows in match_paths(ours, theirs)), strict=True)
    assert sorted(pairs) == [(0, 1), (1, 0), (2, 2)]
    assert not len(match_paths(ours, (*theirs[:2], theirs[2] + 0.1))[0])


def test_confirmation_rejects_moved_and_obstructed_paths(tmp_path):
    partition = {"partition": ("itu_wood", sheet(0, 3.0, (0.0, 4.0), (0.0, 2.0)))}
    scene = room(tmp_path / "open", SHOEBOX)
    tx, rx = np.array([[1.3, 2, 1]]), np.array([4.4, 3.1, 1.7])
    paths = trace_paths(scene, tx, receiver(rx), TraceOptions(depth=2)).paths
    triangles = scene_surfaces(scene).triangles
    assert confirm_paths(paths, tx, rx, triangles).all()
    moved = replace(paths, vertices_m=paths.vertices_m + np.array([0.01, 0.02, 0.01]))
    np.testing.assert_array_equal(confirm_paths(moved, tx, rx, triangles), paths.bounces == 0)
    divided = scene_surfaces(room(tmp_path / "divided", {**SHOEBOX, **partition})).triangles
    confirmed = confirm_paths(paths, tx, rx, divided)
    assert not confirmed[0]
    assert confirmed.any()


def test_paths_of_the_made_scene_equal_those_of_the_room(tmp_path):
    """Two rooms with a doorway, scanned from both: LoS and two reflections."""
    xml = scene_file(tmp_path / "room", two_rooms())
    np.savez(tmp_path / "scan.npz", points=simulate_scan(xml, [[2, 2, 1.4], [5.5, 2, 1.4]], rays_per_pose=40_000))
    scanned = make_scene(tmp_path / "scan.npz", tmp_path / "made")
    rng = np.random.default_rng(1)
    positions = rng.uniform([0.3, 0.3, 0.3], [6.8, 3.7, 2.3], (20, 3))
    positions = positions[np.abs(positions[:, 0] - 4.06) > 0.2]
    end = Receiver("end", np.array([1.1, 1.3, 2.0]), np.array([0.0, 0.0, 0.0, 1.0]))
    options = TraceOptions(depth=2, rays=1 << 15)
    truth, ours = (trace_paths(open_scene(xml, 2.4e9), positions, end, options).paths for xml in (xml, scanned.xml))
    recalled, matched = match(truth, ours)
    power, power_ours = truth.length_m**-2, ours.length_m**-2
    assert len(truth) > 100
    assert power[recalled].sum() > 0.95 * power.sum()
    assert power_ours[matched].sum() > 0.95 * power_ours.sum()


def test_scanner_poses_are_far_from_each_other():
    places = np.array([[0.0, 0, 0], [0.1, 0, 0], [5, 0, 0], [2.4, 0, 0]])
    np.testing.assert_array_equal(spread(places, 3), places[[0, 2, 3]])
    assert len(spread(places, 9)) == 4


@needs("newrf")
@pytest.mark.slow
@pytest.mark.parametrize("name", ["conference", "office"])
def test_a_noisy_scan_of_a_cad_room_gives_most_of_its_paths(name):
    result = scan_to_paths(Path(DATA, "newrf", f"{name}.npz"))
    assert result["recall"]["power"] > 0.9
    assert result["precision"]["power"] > 0.9


@needs("flat-ble/lidar")
def test_walls_from_a_robots_map_agree_with_the_layout():
    grid = read_plan(Path(DATA, "flat-ble", "lidar", "gridmap.npz"), GRID_RESOLUTION_M, GRID_ROW_0)
    assert isinstance(grid, PlanGrid)
    walls, true = find_walls(grid), layout_walls(read_layout(Path(DATA, "flat-ble", "layout.csv")))
    motion = register_walls(sample_walls(walls), true)
    walls = walls @ motion[:2, :2].T + motion[:2, 3]
    # Measured 0.74 and 0.66; furniture hides 23 % of the layout from the robot, and its fronts look like walls.
    share_found, share_right = wall_agreement(walls, true)
    assert share_found > 0.70
    assert share_right > 0.60
    assert best_scale(sample_walls(walls), np.zeros(3), true)[0] == pytest.approx(1, abs=0.03)
