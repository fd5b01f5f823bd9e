"""Receivers on an office floor: where they are, what they receive, and that both data sets have the same paths."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from spectrum_records import assert_same
from wrf_mi_scenes import floor_plans
from wrf_mi_scenes.mitsuba_xml import write_scene

from wrf_mi.core import Record
from wrf_mi.datasets import load
from wrf_mi.receivers.channel import csi, rssi_dbm
from wrf_mi.synthetic import traced_floor_channels, traced_floor_strengths
from wrf_mi.synthetic.floor_receivers import (
    CARRIER_HZ,
    DEFAULT,
    FloorReceivers,
    floor_devices,
    strengths_of,
    trace_floor,
)
from wrf_mi.synthetic.stored import SCAN
from wrf_mi.tracing import TraceOptions, TraceResult, open_scene, trace_paths

SMALL = FloorReceivers(columns=3, rows=2, train=8, test=4, rays=1 << 11, scattered_rays=1 << 6, depth=3, reflections=1)
QUIET = replace(SMALL, noise_db=0.0, offset_db=0.0, sensitivity_dbm=-500.0)
FLOAT32_DB = 1e-3
"""Signal strengths of some tens of dB are stored in float32."""
SINGLE = 1e-5
"""Relative to the largest coefficient: powers and phases of paths are stored in float32."""


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> Record:
    return traced_floor_strengths(tmp_path_factory.mktemp("floor") / "rssi", SMALL)


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    work = tmp_path_factory.mktemp("scene")
    write_scene(work, floor_plans.office().parts, "test")
    return work


@pytest.fixture(scope="module")
def traced(scene_folder: Path) -> TraceResult:
    return trace_floor(scene_folder, floor_plans.office(), SMALL)


def test_record_has_the_stated_rows_and_receivers(record: Record) -> None:
    assert (record.name, record.task.name) == ("traced-floor-receivers", "rssi")
    assert record.observation.shape == (6, 12)
    assert [receiver.name for receiver in record.receivers] == [f"anchor{k}" for k in range(1, 7)]
    np.testing.assert_array_equal(record.frequencies_hz, [CARRIER_HZ])
    assert [part.tolist() for part in record.official] == [list(range(8)), list(range(8, 12))]
    assert np.nanmin(record.observation) >= SMALL.sensitivity_dbm
    assert Path(record.source, SCAN).is_file()
    assert len(open_scene(Path(record.source, "floor"), CARRIER_HZ).objects) == len(floor_plans.office().bare)


def test_data_are_stored_and_reproducible(record: Record, traced: TraceResult) -> None:
    file = Path(record.source, "train.csv")
    before = file.stat().st_mtime_ns
    assert_same(traced_floor_strengths(record.source, SMALL), record)
    assert file.stat().st_mtime_ns == before
    np.testing.assert_array_equal(traced.tx_pos_m, record.tx_pos_m)
    np.testing.assert_array_equal(strengths_of(traced, SMALL).observation, record.observation)


def test_devices_are_spread_outside_of_bodies(scene_folder: Path) -> None:
    scene, plan = open_scene(scene_folder, CARRIER_HZ), floor_plans.office()
    receivers, transmitters = floor_devices(scene, plan, DEFAULT)
    assert not np.array_equal(floor_devices(scene, plan, replace(DEFAULT, seed=2))[1], transmitters)
    places = np.stack([receiver.position_m for receiver in receivers])
    assert (places.shape, transmitters.shape) == ((16, 3), (400, 3))
    np.testing.assert_array_equal(places[:, 2], DEFAULT.mount_m)
    cells = np.floor(places[:, :2] / [18 / 4, 10 / 4]).astype(int)
    assert len(np.unique(cells, axis=0)) == 16
    apart = np.linalg.norm(transmitters[:, None] - places, axis=-1)
    assert apart.min() > DEFAULT.from_receiver_m
    assert ((transmitters[:, 2] >= DEFAULT.low_m) & (transmitters[:, 2] <= DEFAULT.high_m)).all()
    for position in (*transmitters, *places):  # the metal core
        assert not ((position[:2] > [8.6, 2.2]) & (position[:2] < [10.4, 4.0])).all()


def test_strengths_are_the_power_of_all_paths(traced: TraceResult) -> None:
    expected = rssi_dbm(traced.paths) + SMALL.power_dbm  # NaN without a path, as in the record
    np.testing.assert_allclose(strengths_of(traced, QUIET).observation, expected, atol=FLOAT32_DB)
    kinds = set(np.unique(traced.paths.interactions))
    assert {1, 2, 4} < kinds  # reflection, scattering, transmission
    assert 8 not in kinds


def test_offsets_noise_and_sensitivity_are_the_stated_ones(traced: TraceResult) -> None:
    quiet = strengths_of(traced, QUIET).observation
    offset = strengths_of(traced, replace(QUIET, offset_db=3.0)).observation - quiet
    assert (np.nanmax(offset, axis=1) - np.nanmin(offset, axis=1)).max() < FLOAT32_DB
    assert 1 < np.nanmedian(offset, axis=1).std() < 6
    noise = strengths_of(traced, replace(QUIET, noise_db=2.0)).observation - quiet
    assert np.nanstd(noise) == pytest.approx(2, rel=0.3)  # three standard deviations of the estimate from 70 values
    # Strengths below the sensitivity are not received.
    all_received = strengths_of(traced, replace(SMALL, sensitivity_dbm=-500.0)).observation
    ordered = np.sort(all_received[np.isfinite(all_received)])
    limit = float(ordered[len(ordered) // 2 :][:2].mean())
    some = strengths_of(traced, replace(SMALL, sensitivity_dbm=limit)).observation
    np.testing.assert_array_equal(some, np.where(all_received < limit, np.nan, all_received))


def test_specular_paths_are_those_of_a_search_without_scattering(traced: TraceResult, scene_folder: Path) -> None:
    options = TraceOptions(transmission=True, depth=3, reflections=1, rays=SMALL.rays, seed=SMALL.seed)
    alone = trace_paths(open_scene(scene_folder, CARRIER_HZ), traced.tx_pos_m, traced.receivers, options).paths
    specular = traced.paths.select(~(traced.paths.interactions == 2).any(axis=1))
    np.testing.assert_array_equal(specular.length_m, alone.length_m)
    # A reflection loses the scattered share of its power.
    reflected = (specular.interactions == 1).sum(axis=1)
    kept = np.sqrt(1 - SMALL.scattering**2) ** reflected
    np.testing.assert_allclose(np.abs(specular.gain), np.abs(alone.gain) * kept, rtol=1e-4, atol=1e-12)


def test_channels_have_the_same_paths(traced: TraceResult, tmp_path: Path) -> None:
    record = traced_floor_channels(tmp_path, SMALL)
    assert (record.name, record.task.name) == ("traced-floor-receivers-csi", "csi")
    assert record.observation.shape == (6, 12, 16)
    np.testing.assert_allclose(record.frequencies_hz, CARRIER_HZ + np.arange(16) * 1.25e6)
    np.testing.assert_allclose(record.tx_pos_m, traced.tx_pos_m, rtol=1e-6)
    expected = csi(traced.paths, record.frequencies_hz)
    assert np.nanmax(np.abs(record.observation - expected)) < SINGLE * np.abs(expected).max()
    np.testing.assert_array_equal(np.isnan(record.observation), expected == 0)
    assert [len(part) for part in record.official] == [8, 4]
    before = (tmp_path / "params.json").stat().st_mtime_ns
    assert_same(traced_floor_channels(tmp_path, SMALL), record)
    assert (tmp_path / "params.json").stat().st_mtime_ns == before
    assert load(tmp_path).observation.shape == (6, 12, 16)
