"""The local mean of traced power on a grid, and powers kept on the disk for the same scene, positions and antennas."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from traced_rooms import FREQUENCY_HZ, SHOEBOX, inside, receiver, room
from wrf_mi_scenes.build_laboratory import box, sheet

from wrf_mi.core import Antenna, Record
from wrf_mi.receivers import rssi_dbm
from wrf_mi.tracing import TraceOptions, open_scene, power_map, trace_paths
from wrf_mi.tracing.paths.solve import Prepared
from wrf_mi.tracing.power_map import PowerMap, TracedPower, trace_map


def test_map_is_linear_between_its_points():
    x, y, z = np.array([0.0, 1.0, 2.0]), np.array([0.0, 2.0]), np.array([1.0])
    power = PowerMap(x, y, z, (x[:, None, None] * 10 + y[None, :, None])[None], 0)
    where = np.array([[0.5, 1.0, 1.0], [1.5, 0.0, 9.0], [9.0, 9.0, 1.0]])
    np.testing.assert_allclose(power(where, 0), [6.0, 15.0, 22.0])


def test_traced_power_asks_for_each_position_once_and_falls_back_to_the_local_mean():
    axis = np.array([0.0, 2.0])
    local = PowerMap(axis, axis, np.array([1.0]), np.stack([np.full((2, 2, 1), -50.0), np.full((2, 2, 1), -70.0)]), 0)
    asked = []

    def trace(position_m, places):
        power = np.stack([-position_m[:, 0], -2 * position_m[:, 0]])
        power[1, position_m[:, 1] > 1] = np.nan  # without a path
        power = power if places is None else power[places]
        asked.append(power.shape)
        return power

    power, where = TracedPower(local, trace, np.arange(2), {}), np.array([[0.5, 0.0, 1.0], [1.5, 2.0, 1.0]])
    np.testing.assert_allclose(power(where, 0), [-0.5, -1.5])
    np.testing.assert_allclose(power(where[::-1], 1), [-70.0, -1.0])
    np.testing.assert_allclose(power.at(np.array([1]))(where, 0), [-1.0, -70.0])
    assert asked == [(2, 2)]
    predicted = power.at(np.array([1, 0])).of_predictions(where[:1])
    for number in (0, 1):
        np.testing.assert_allclose(predicted(where[:1], number), [(-1.0, -0.5)[number]])
    assert asked == [(2, 2)]
    for number in (0, 1, 1):  # each time anew, and for this receiver alone
        np.testing.assert_allclose(predicted(where, number), [(-1.0, -70.0), (-0.5, -1.5)][number])
    assert asked == [(2, 2), (1, 1), (1, 1), (1, 1)]


def test_map_excludes_points_inside_closed_solids(tmp_path, caplog):
    """A column of 0.9 m holds points of the map's grid, whose antennas nobody has stated: no error and no warning."""
    parts = sheet(2, 0.0, (0.0, 6.0), (0.0, 6.0)), box((2.6, 2.4, 0), (3.5, 3.3, 3.0))
    trimesh.util.concatenate(parts).export(tmp_path / "room.ply")
    scene = open_scene(tmp_path / "room.ply", FREQUENCY_HZ, material="concrete")
    receivers = tuple(receiver(at, f"r{k}") for k, at in enumerate([(0, 0, 2), (6, 1, 2), (2, 5, 2)]))
    position = np.array([[0.5, 0.5, 1.3], [5.5, 5.5, 1.3], [0.5, 5.5, 1.3]])
    record = Record("made", "rssi", position, receivers, np.zeros((3, 3), np.float32))
    for smooth_m in (0.0, 0.3):
        traced = trace_map(scene, record, 0.25, smooth_m, TraceOptions(transmission=True, depth=1))
        x, y = np.meshgrid(traced.x_m, traced.y_m, indexing="ij")
        within = (np.abs(x - 3.05) < 0.45) & (np.abs(y - 2.85) < 0.45)
        around = (np.abs(x - 3.05) < 0.9) & (np.abs(y - 2.85) < 0.9) & ~within
        assert within.sum() >= 9
        for power in traced.power_dbm[..., 0]:
            # What is inside continues what is outside; it is no hole of the map, whose least value is its floor.
            assert power[around].min() <= power[within].min() <= power[within].max() <= power[around].max()
    assert not caplog.records


OPTIONS = TraceOptions(transmission=True, depth=1)
POSITIONS, CENTRE = inside(5), (3.0, 2.0, 1.5)


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setattr(power_map, "user_cache", lambda: tmp_path / "cache")
    return tmp_path / "cache"


def powers(scene, positions=POSITIONS, **changed):
    arguments = {"receivers": [receiver(CENTRE)], "options": OPTIONS, "tx_antenna": Antenna(), **changed}
    return power_map.traced_powers(Prepared(scene), positions, **arguments)


def test_kept_powers_are_those_traced(shoebox, cache, monkeypatch):
    expected = rssi_dbm(trace_paths(shoebox, POSITIONS, [receiver(CENTRE)], OPTIONS).paths)
    np.testing.assert_allclose(powers(shoebox), expected, rtol=1e-6)
    assert len(list(cache.rglob("*.npz"))) == 1
    monkeypatch.setattr(power_map, "trace_paths", None)
    np.testing.assert_allclose(powers(shoebox), expected, rtol=1e-6)


def test_another_scene_position_antenna_or_depth_is_traced(shoebox, tmp_path, cache):
    shorter = {"options": replace(OPTIONS, reflections=0)}
    for changed in ({}, {"tx_antenna": Antenna("dipole")}, shorter, {"receivers": [receiver(CENTRE, "other")]}):
        powers(shoebox, **changed)
    powers(shoebox, POSITIONS[:4])
    higher = {name: (kind, mesh.copy().apply_translation([0, 0, 1e-3])) for name, (kind, mesh) in SHOEBOX.items()}
    softer = {name: ("itu_wood", mesh) for name, (_, mesh) in SHOEBOX.items()}
    for name, parts in {"higher": higher, "softer": softer}.items():
        powers(room(tmp_path / name, parts))
    assert len(list(cache.rglob("*.npz"))) == 7
