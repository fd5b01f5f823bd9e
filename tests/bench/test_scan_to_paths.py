"""Paths of scenes made from simulated scans."""

import os
from pathlib import Path

import numpy as np
import pytest
from made_rooms import scene_file, two_rooms
from wrf_mi_bench.scene import match, scan_to_paths, spread

from wrf_mi.core import Receiver
from wrf_mi.scene.make import make_scene
from wrf_mi.scene.scan import simulate_scan
from wrf_mi.tracing import TraceOptions, open_scene, trace_paths

FREQUENCY_HZ = 2.4e9


def test_paths_of_the_made_scene_equal_those_of_the_room(tmp_path):
    """Two rooms with a doorway, scanned from both: LoS and two reflections."""
    xml = scene_file(tmp_path / "room", two_rooms())
    np.savez(tmp_path / "scan.npz", points=simulate_scan(xml, [[2, 2, 1.4], [5.5, 2, 1.4]], rays_per_pose=40_000))
    made = make_scene(tmp_path / "scan.npz", tmp_path / "made")
    rng = np.random.default_rng(1)
    positions = rng.uniform([0.3, 0.3, 0.3], [6.8, 3.7, 2.3], (20, 3))
    positions = positions[np.abs(positions[:, 0] - 4.06) > 0.2]
    end = Receiver("end", np.array([1.1, 1.3, 2.0]), np.array([0.0, 0.0, 0.0, 1.0]))
    options = TraceOptions(depth=2, rays=1 << 15)
    truth, ours = (trace_paths(open_scene(xml, FREQUENCY_HZ), positions, end, options).paths for xml in (xml, made.xml))
    found, matched = match(truth, ours)
    power, power_ours = truth.length_m**-2, ours.length_m**-2
    assert len(truth) > 100
    assert power[found].sum() > 0.95 * power.sum()
    assert power_ours[matched].sum() > 0.95 * power_ours.sum()


def test_scanner_poses_are_far_from_each_other():
    places = np.array([[0.0, 0, 0], [0.1, 0, 0], [5, 0, 0], [2.4, 0, 0]])
    np.testing.assert_array_equal(spread(places, 3), places[[0, 2, 3]])
    assert len(spread(places, 9)) == 4


@pytest.mark.slow
@pytest.mark.parametrize("room", ["conference", "office"])
def test_a_noisy_scan_of_a_cad_room_gives_most_of_its_paths(room):
    file = Path(os.environ.get("WRF_MI_DATA", "/nowhere")) / "newrf" / f"{room}.npz"
    if not file.is_file():
        pytest.skip("WRF_MI_DATA names no folder with newrf/")
    result = scan_to_paths(file)
    assert result["recall"]["power"] > 0.9
    assert result["precision"]["power"] > 0.9
