"""The traced room: what is in it, what a model is given, and that both are made the same way each time."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from wrf_mi_scenes.furnished import furnished_parts, measured_parts
from wrf_mi_scenes.mitsuba_xml import write_scene

from wrf_mi.core import Receiver
from wrf_mi.core.arrays import planar_array
from wrf_mi.receivers import antenna_csi
from wrf_mi.receivers.channel import array_channels
from wrf_mi.synthetic.furnished_room import MEASURED, TracedRoom, traced_room, transmitters
from wrf_mi.synthetic.laboratory import FREQUENCY_HZ, RECEIVER
from wrf_mi.tracing import TraceOptions, open_scene, trace_paths
from wrf_mi.tracing.search.devices import solid_around
from wrf_mi.tracing.search.surfaces import scene_surfaces

SMALL = TracedRoom(train=6, test=2, rays=1 << 10, scattered_rays=1 << 8, depth=2, reflections=1)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("room") / "data"
    traced_room(folder, SMALL)
    return folder


def test_data_are_stored_and_reproducible(made: Path) -> None:
    before = (made / "tx_pos.csv").stat().st_mtime_ns
    record = traced_room(made, SMALL)
    assert (made / "tx_pos.csv").stat().st_mtime_ns == before
    assert record.official is not None
    assert [len(part) for part in record.official] == [6, 2]
    assert record.observation.shape == (1, 8, 90, 360)
    assert record.observation.min() == 0
    assert record.observation.max() == 1
    assert open_scene(made / MEASURED, FREQUENCY_HZ).objects.keys() == measured_parts(0.02, 1).keys()
    moved = traced_room(made, replace(SMALL, seed=2))
    assert not np.array_equal(record.tx_pos_m, moved.tx_pos_m)
    back = traced_room(made, SMALL)
    assert np.array_equal(record.observation, back.observation)


def test_measured_room_lacks_furniture_and_has_errors() -> None:
    full, bare = furnished_parts(), measured_parts(0.02, 1)
    assert {material for material, _ in bare.values()} == {"itu_concrete"}
    assert len({material for material, _ in full.values()}) > 5
    off = [
        bare[name][1].bounds[0, axis] - full[name][1].bounds[0, axis]
        for name, axis in (("floor", 2), ("ceiling", 2), ("wall_west", 0), ("wall_north", 1))
    ]
    assert all(0 < abs(one) < 0.08 for one in off)  # four deviations


def test_transmitters_are_clear_of_surfaces(tmp_path: Path) -> None:
    write_scene(tmp_path, furnished_parts(), "test")
    scene = open_scene(tmp_path, FREQUENCY_HZ)
    positions, surfaces = transmitters(scene, TracedRoom(train=300, test=100)), scene_surfaces(scene)
    assert positions.shape == (400, 3)
    assert (positions[:, 2] >= 0.5).all()
    assert (positions[:, 2] <= 2.0).all()
    assert np.linalg.norm(positions - RECEIVER.position_m, axis=1).min() > 0.5
    assert (solid_around(surfaces, positions) < 0).all()


def test_specular_signals_are_reciprocal(tmp_path: Path) -> None:
    write_scene(tmp_path, measured_parts(0.0, 0), "test")
    scene, array_m = open_scene(tmp_path, FREQUENCY_HZ), planar_array(4, 4, 0.16)
    tx = np.array([[2.0, 3.0, 1.2], [4.5, 1.0, 1.7]])
    ends = [Receiver(str(i), place, np.array([0.0, 0.0, 0.0, 1.0])) for i, place in enumerate(tx)]
    options = TraceOptions(depth=2, rays=1 << 14)
    # The array's antennas are polarised along its y axis, which is up to a thousandth.
    there = trace_paths(scene, tx, RECEIVER, options).paths
    back = trace_paths(scene, RECEIVER.position_m, ends, TraceOptions(depth=2, rays=1 << 14)).paths
    expected = antenna_csi(there, RECEIVER, array_m, FREQUENCY_HZ)[0, ..., 0]
    found = array_channels(back, RECEIVER, array_m, FREQUENCY_HZ)[..., 0]
    assert np.abs(found - expected).max() < 2e-3 * np.abs(expected).max()


def test_scattered_waves_come_from_their_last_point(tmp_path: Path) -> None:
    write_scene(tmp_path, measured_parts(0.0, 0), "test")
    scene, array_m = open_scene(tmp_path, FREQUENCY_HZ), planar_array(4, 4, 0.16)
    ends = [Receiver("0", np.array([2.0, 3.0, 1.2]), np.array([0.0, 0.0, 0.0, 1.0]))]
    options = TraceOptions(scattering=True, depth=1, rays=1 << 8)
    paths = trace_paths(scene, RECEIVER.position_m, ends, options).paths
    one = paths.select(np.flatnonzero((paths.interactions == 2).any(axis=1))[:1])
    found = array_channels(one, RECEIVER, array_m, FREQUENCY_HZ)[0, :, 0]
    point = one.vertices_m[0, 0]
    elements = RECEIVER.position_m + array_m @ RECEIVER.to_world.T
    wavenumber = 2 * np.pi * FREQUENCY_HZ / 299792458.0
    near, far = np.linalg.norm(point - elements, axis=1), np.linalg.norm(point - ends[0].position_m)
    origin = np.linalg.norm(point - RECEIVER.position_m)
    expected = one.gain[0] * origin / near * np.exp(-1j * wavenumber * (near + far))
    assert np.abs(found - expected).max() < 1e-4 * np.abs(expected).max()  # vertices are float32
