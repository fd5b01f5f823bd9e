"""The furnished room at one carrier and at several: what is in it, rows and splits, and what a model is given."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.constants import speed_of_light
from spectrum_records import assert_same
from wrf_mi_scenes.build_laboratory import sheet
from wrf_mi_scenes.furnished import furnished_parts, measured_parts
from wrf_mi_scenes.mitsuba_xml import write_scene

from wrf_mi.core import Receiver, Record
from wrf_mi.core.arrays import planar_array
from wrf_mi.datasets import make_splits
from wrf_mi.receivers.channel import array_channels, received_power
from wrf_mi.synthetic import furnished_room as furnished
from wrf_mi.synthetic.laboratory import FREQUENCY_HZ, RECEIVER
from wrf_mi.synthetic.searches import searched_paths, set_scattering, trace_channels
from wrf_mi.synthetic.stored import SCAN
from wrf_mi.tracing import TraceOptions, open_scene, trace_paths
from wrf_mi.tracing.paths.result import recompute
from wrf_mi.tracing.search.devices import solid_around
from wrf_mi.tracing.search.surfaces import scene_surfaces

SMALL = furnished.TracedRoom(train=6, test=2, rays=1 << 10, scattered_rays=1 << 8, depth=2, reflections=1)


def test_data_are_stored_and_reproducible(tmp_path: Path) -> None:
    record = furnished.traced_room(tmp_path, SMALL)
    before = (tmp_path / "tx_pos.csv").stat().st_mtime_ns
    assert_same(furnished.traced_room(tmp_path, SMALL), record)
    assert (tmp_path / "tx_pos.csv").stat().st_mtime_ns == before
    assert [len(part) for part in record.official] == [6, 2]
    assert record.observation.shape == (1, 8, 90, 360)
    assert (record.observation.min(), record.observation.max()) == (0, 1)
    measured = open_scene(tmp_path / furnished.MEASURED, FREQUENCY_HZ)
    assert measured.objects.keys() == measured_parts(0.02, 1).keys()
    assert not np.array_equal(record.tx_pos_m, furnished.traced_room(tmp_path, replace(SMALL, seed=2)).tx_pos_m)
    assert_same(furnished.traced_room(tmp_path, SMALL), record)


def test_measured_room_lacks_furniture_and_has_errors() -> None:
    full, bare = furnished_parts(), measured_parts(0.02, 1)
    assert {material for material, _ in bare.values()} == {"itu_concrete"}
    assert len({material for material, _ in full.values()}) > 5
    for name, axis in (("floor", 2), ("ceiling", 2), ("wall_west", 0), ("wall_north", 1)):
        error_m = bare[name][1].bounds[0, axis] - full[name][1].bounds[0, axis]
        assert 0 < abs(error_m) < 0.08  # four deviations


def test_transmitters_are_clear_of_surfaces(room: Path) -> None:
    scene = open_scene(room, FREQUENCY_HZ)
    positions = furnished.transmitters(scene, furnished.TracedRoom(train=300, test=100))
    assert positions.shape == (400, 3)
    assert 0.5 <= positions[:, 2].min() < positions[:, 2].max() <= 2.0
    assert np.linalg.norm(positions - RECEIVER.position_m, axis=1).min() > 0.5
    assert (solid_around(scene_surfaces(scene), positions) < 0).all()


@pytest.fixture(scope="module")
def bare(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The room's walls without errors."""
    work = tmp_path_factory.mktemp("bare")
    write_scene(work, measured_parts(0.0, 0), "test")
    return open_scene(work, FREQUENCY_HZ)


ARRAY_M = planar_array(4, 4, 0.16)


def test_scattered_waves_come_from_their_last_point(bare: Any) -> None:
    ends = [Receiver("0", np.array([2.0, 3.0, 1.2]), np.array([0.0, 0.0, 0.0, 1.0]))]
    options = TraceOptions(scattering=True, scattering_coefficient=0.3, depth=1, rays=1 << 8)
    paths = trace_paths(bare, RECEIVER.position_m, ends, options).paths
    path = paths.select(np.flatnonzero((paths.interactions == 2).any(axis=1))[:1])
    computed = array_channels(path, RECEIVER, ARRAY_M, FREQUENCY_HZ)[0, :, 0]
    point = path.vertices_m[0, 0]
    elements = RECEIVER.position_m + ARRAY_M @ RECEIVER.to_world.T
    wavenumber = 2 * np.pi * FREQUENCY_HZ / 299792458.0
    near, far = np.linalg.norm(point - elements, axis=1), np.linalg.norm(point - ends[0].position_m)
    origin = np.linalg.norm(point - RECEIVER.position_m)
    expected = path.gain[0] * origin / near * np.exp(-1j * wavenumber * (near + far))
    assert np.abs(computed - expected).max() < 1e-4 * np.abs(expected).max()  # vertices are float32


SIZE: dict[str, Any] = {"carriers_hz": (0.9e9, 5.8e9), "rows": 2, "columns": 3, "height": 9, "width": 36}
SMALL_BANDS = furnished.RoomBands(**SIZE, train=4, test=2, rays=1 << 10, scattered_rays=1 << 8, depth=2, reflections=1)
POSITIONS = np.array([[2.0, 3.0, 1.2], [4.5, 1.0, 1.7], [3.0, 5.2, 1.0], [7.6, 6.0, 1.3]])
SINGLE = 1e-4
"""Gains are computed in single precision, once in the search and again at each carrier."""


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> Record:
    return furnished.traced_room_bands(tmp_path_factory.mktemp("bands") / "data", SMALL_BANDS)


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    work = tmp_path_factory.mktemp("room")
    write_scene(work, furnished_parts(), "test")
    return work


def test_rows_are_positions_times_carriers(record: Record) -> None:
    assert (record.name, record.task.name) == ("traced-room-bands", "spectrum")
    assert record.observation.shape == (2, 12, 9, 36)
    assert record.observation.min(axis=(2, 3)).max() == 0
    assert record.observation.max(axis=(2, 3)).min() == 1
    np.testing.assert_array_equal(record.carriers_hz, [0.9e9, 5.8e9] * 6)
    assert record.frequencies_hz is None
    np.testing.assert_array_equal(record.tx_pos_m[::2], record.tx_pos_m[1::2])
    assert len(np.unique(record.tx_pos_m, axis=0)) == 6
    assert [len(receiver.array_m) for receiver in record.receivers] == [6, 6]
    assert Path(record.source, SCAN).is_file()
    assert len(open_scene(Path(record.source, "room"), 2.4e9).objects) == 8
    # No position is in both parts of the official split.
    (official,) = make_splits(record, "official", validation_fraction=0)
    places = [set(map(tuple, record.tx_pos_m[rows])) for rows in (official.all_train, official.test)]
    assert [len(part) for part in places] == [4, 2]
    assert not places[0] & places[1]


def test_arrays_face_the_room_and_have_no_grating_lobes() -> None:
    ceiling, wall = (receiver.to_world for receiver in furnished.RECEIVERS)
    np.testing.assert_allclose(ceiling[:, 2], [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose(wall[:, 1:], np.array([[0, 0, 1], [-1, 0, 0]]).T, atol=1e-12)
    assert furnished.DEFAULT_BANDS.spacing_m < speed_of_light / max(furnished.DEFAULT_BANDS.carriers_hz) / 2


def test_bands_are_stored(record: Record) -> None:
    file = Path(record.source, "tx_pos.csv")
    before = file.stat().st_mtime_ns
    assert_same(furnished.traced_room_bands(record.source, SMALL_BANDS), record)
    assert file.stat().st_mtime_ns == before


def test_spectra_of_a_carrier_are_those_made_at_it_alone(record: Record, tmp_path: Path) -> None:
    alone = furnished.traced_room_bands(tmp_path / "alone", replace(SMALL_BANDS, carriers_hz=(5.8e9,)))
    np.testing.assert_array_equal(alone.frequencies_hz, [5.8e9])
    np.testing.assert_array_equal(alone.tx_pos_m, record.tx_pos_m[1::2])
    np.testing.assert_array_equal(alone.observation, record.observation[:, 1::2])
    assert not np.array_equal(record.observation[:, ::2], record.observation[:, 1::2])


def test_channels_are_those_of_a_search_at_the_carrier(room: Path) -> None:
    """All kinds of path at the carrier of the search; at another one those that are not drawn at random."""
    exact, rough = SMALL_BANDS.options(diffraction=True)
    receiver, opaque = replace(furnished.RECEIVERS[1], array_m=planar_array(2, 2, 0.025)), furnished.opaque_parts()
    searched_at = open_scene(room, 2.4e9)
    for options, hz in (((exact, rough), 2.4e9), ((replace(exact, diffraction=False),), 5.8e9)):
        at_carrier = open_scene(room, hz)
        reported = furnished.channels_at_carriers([at_carrier], receiver, POSITIONS, searched_at, options, opaque)
        expected = trace_channels(at_carrier, receiver, POSITIONS, np.array([hz]), options, opaque)
        assert np.abs(reported - expected).max() < SINGLE * np.abs(expected).max()


def test_scattered_power_does_not_depend_on_the_carrier_of_the_search(tmp_path: Path) -> None:
    """A pane is nearly transparent at 5.8 GHz, so that a search there draws few of its scattered paths."""
    write_scene(tmp_path, {"pane": ("itu_glass", sheet(0, 0.0, (0.0, 6.0), (0.0, 3.0)))}, "test")
    carriers, options = (2.4e9, 5.8e9), TraceOptions(scattering=True, scattering_coefficient=0.3, depth=1, rays=1 << 17)
    receiver = replace(furnished.RECEIVERS[1], position_m=np.array([2.0, 3.0, 1.5]))
    scenes = [open_scene(tmp_path, carrier_hz) for carrier_hz in carriers]
    power_db, counts = np.empty((2, 2)), []  # [search, carrier]
    for search, searched_at in enumerate(scenes):
        ((_, traced),) = searched_paths(searched_at, receiver, np.array([[1.5, 2.0, 1.0]] * 2), (options,))
        counts.append(len(traced.paths))
        for carrier, scene in enumerate(scenes):
            set_scattering(scene, options.scattering_coefficient)
            power_db[search, carrier] = 10 * np.log10(received_power(recompute(traced, scene).paths)[0, 0])
    assert counts[0] > 2 * counts[1]
    # Sums of several hundred random paths of unequal power; without the probabilities of the draw 5.2 dB.
    assert np.abs(power_db[0] - power_db[1]).max() < 1
