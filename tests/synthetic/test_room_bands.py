"""The furnished room at several carriers: rows, splits, and that each carrier is as if traced alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.constants import speed_of_light
from wrf_mi_scenes.build_laboratory import sheet
from wrf_mi_scenes.furnished import furnished_parts
from wrf_mi_scenes.mitsuba_xml import write_scene

from wrf_mi.core import Record
from wrf_mi.core.arrays import planar_array
from wrf_mi.datasets import make_splits
from wrf_mi.receivers.channel import received_power
from wrf_mi.synthetic import load_record, traced_room_bands
from wrf_mi.synthetic.furnished_room import DEFAULT_BANDS, RECEIVERS, RoomBands, channels_at_carriers, opaque_parts
from wrf_mi.synthetic.searches import searched_paths, set_scattering, trace_channels
from wrf_mi.synthetic.stored import SCAN
from wrf_mi.tracing import TraceOptions, open_scene
from wrf_mi.tracing.paths.result import recompute

SMALL = RoomBands(
    train=4,
    test=2,
    carriers_hz=(0.9e9, 5.8e9),
    rows=2,
    columns=3,
    height=9,
    width=36,
    rays=1 << 10,
    scattered_rays=1 << 8,
    depth=2,
    reflections=1,
)
POSITIONS = np.array([[2.0, 3.0, 1.2], [4.5, 1.0, 1.7], [3.0, 5.2, 1.0], [7.6, 6.0, 1.3]])
FLOAT32 = 1e-4
"""Gains are computed in single precision, once in the search and again at each carrier."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("bands") / "data"


@pytest.fixture(scope="module")
def record(folder: Path) -> Record:
    return traced_room_bands(folder, SMALL)


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    work = tmp_path_factory.mktemp("room")
    write_scene(work, furnished_parts(), "test")
    return work


def test_rows_are_positions_times_carriers(record: Record, folder: Path) -> None:
    assert (record.name, record.task) == ("traced-room-bands", "spectrum")
    assert record.observation.shape == (2, 12, 9, 36)
    assert record.observation.min(axis=(2, 3)).max() == 0
    assert record.observation.max(axis=(2, 3)).min() == 1
    np.testing.assert_array_equal(record.carriers_hz, [0.9e9, 5.8e9] * 6)
    assert record.frequencies_hz is None
    np.testing.assert_array_equal(record.tx_pos_m[::2], record.tx_pos_m[1::2])
    assert len(np.unique(record.tx_pos_m, axis=0)) == 6
    assert [len(receiver.array_m) for receiver in record.receivers] == [6, 6]
    assert (folder / SCAN).is_file()
    assert len(open_scene(folder / "room", 2.4e9).objects) == 8


def test_arrays_face_the_room_and_have_no_grating_lobes() -> None:
    ceiling, wall = (receiver.to_world for receiver in RECEIVERS)
    np.testing.assert_allclose(ceiling[:, 2], [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose(wall[:, 1:], np.array([[0, 0, 1], [-1, 0, 0]]).T, atol=1e-12)
    assert DEFAULT_BANDS.spacing_m < speed_of_light / max(DEFAULT_BANDS.carriers_hz) / 2


def test_data_are_stored(record: Record, folder: Path) -> None:
    before = (folder / "tx_pos.csv").stat().st_mtime_ns
    again = traced_room_bands(folder, SMALL)
    assert (folder / "tx_pos.csv").stat().st_mtime_ns == before
    np.testing.assert_array_equal(again.observation, record.observation)


def test_splits_keep_positions_and_carriers_apart(record: Record) -> None:
    assert record.carriers_hz is not None
    (official,) = make_splits(record, "official", validation_fraction=0)
    places = [set(map(tuple, record.tx_pos_m[rows])) for rows in (official.all_train, official.test)]
    assert [len(part) for part in places] == [4, 2]
    assert not places[0] & places[1]
    for split, carrier_hz in zip(make_splits(record, "frequency"), SMALL.carriers_hz, strict=True):
        assert (record.carriers_hz[split.test] == carrier_hz).all()
        assert carrier_hz not in record.carriers_hz[split.all_train]
        assert set(map(tuple, record.tx_pos_m[split.test])) == places[1]
    assert [split.held_receivers for split in make_splits(record, "receiver")] == [(0,), (1,)]


def test_spectra_of_a_carrier_are_those_made_at_it_alone(record: Record, tmp_path: Path) -> None:
    for number, carrier_hz in enumerate(SMALL.carriers_hz):
        alone = traced_room_bands(tmp_path / str(number), replace(SMALL, carriers_hz=(carrier_hz,)))
        np.testing.assert_array_equal(alone.frequencies_hz, [carrier_hz])
        np.testing.assert_array_equal(alone.tx_pos_m, record.tx_pos_m[number::2])
        np.testing.assert_array_equal(alone.observation, record.observation[:, number::2])
    assert not np.array_equal(record.observation[:, ::2], record.observation[:, 1::2])


def channels(room: Path, searched_hz: float, carriers_hz: tuple[float, ...], options: tuple[Any, ...]) -> np.ndarray:
    receiver = replace(RECEIVERS[1], array_m=planar_array(2, 2, 0.025))
    scenes = [open_scene(room, hz) for hz in (searched_hz, *carriers_hz)]
    return channels_at_carriers(scenes[1:], receiver, POSITIONS, scenes[0], options, opaque_parts())


def test_channels_are_those_of_a_search_at_the_carrier(room: Path) -> None:
    """All kinds of path at the carrier of the search; at another one those that are not drawn at random."""
    exact, rough = replace(SMALL, depth=3, reflections=2).options(diffraction=True)
    receiver, opaque = replace(RECEIVERS[1], array_m=planar_array(2, 2, 0.025)), opaque_parts()

    def alone(carrier_hz: float, options: tuple[Any, ...]) -> np.ndarray:
        scene = open_scene(room, carrier_hz)
        return trace_channels(scene, receiver, POSITIONS, np.array([carrier_hz]), options, opaque)[..., 0]

    for options, carrier_hz in (((exact, rough), 2.4e9), ((replace(exact, diffraction=False),), 5.8e9)):
        found = channels(room, 2.4e9, (carrier_hz,), options)[..., 0]
        expected = alone(carrier_hz, options)
        assert np.abs(found - expected).max() < FLOAT32 * np.abs(expected).max()


def test_scattered_power_does_not_depend_on_the_carrier_of_the_search(tmp_path: Path) -> None:
    """A pane is nearly transparent at 5.8 GHz, so that a search there draws few of its scattered paths."""
    write_scene(tmp_path, {"pane": ("itu_glass", sheet(0, 0.0, (0.0, 6.0), (0.0, 3.0)))}, "test")
    carriers, options = (2.4e9, 5.8e9), TraceOptions(scattering=True, transmission=True, max_depth=1, rays=1 << 17)
    receiver = replace(RECEIVERS[1], position_m=np.array([2.0, 3.0, 1.5]))
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


def test_name_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    monkeypatch.setattr("wrf_mi.synthetic.traced_room_bands", lambda progress: asked.append(progress))
    load_record("traced-room-bands", progress=True)
    assert asked == [True]
