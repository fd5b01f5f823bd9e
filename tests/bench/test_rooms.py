"""Random rooms: what a seed fixes, what rooms, scans and channels promise; gain of the correction, table."""

from pathlib import Path

import numpy as np
import pytest
from wrf_mi_bench import moved
from wrf_mi_bench.random_room import OPTIONS, SNR_DB, Survey, random_room_record
from wrf_mi_bench.rooms import COLUMNS, clipped_cea_db, disagreement
from wrf_mi_bench.rooms import table as rooms
from wrf_mi_scenes.mitsuba_xml import PERFECT
from wrf_mi_scenes.random_rooms import CLEAR_M, FEWEST, HEIGHTS_M, LEAST_M, MOST, MOST_M, MOUNTED_M, MOUNTS, random_room

from wrf_mi.core import Record
from wrf_mi.correction import CorrectionOptions, write_page
from wrf_mi.datasets import make_splits
from wrf_mi.scene.folder import read_scene_folder
from wrf_mi.stages.correct import correct_scene
from wrf_mi.tasks import instrument_of
from wrf_mi.tracing.tracer import RayTracer

ROOMS = [random_room(seed) for seed in range(200, 240)]
SMALL = Survey(train=30, test=4, rays=10_000)
Surveyed = tuple[Record, Path, Path]


def test_rooms_keep_their_bounds():
    for room in ROOMS:
        bounds = np.array([mesh.bounds for _, mesh in room.parts.values()])
        np.testing.assert_allclose(bounds[:, 0].min(axis=0), 0, atol=1e-12)
        np.testing.assert_allclose(bounds[:, 1].max(axis=0), room.size_m)
        assert ((np.array(room.size_m[:2]) >= LEAST_M) & (np.array(room.size_m[:2]) <= MOST_M)).all()
        assert HEIGHTS_M[0] <= room.size_m[2] <= HEIGHTS_M[1]
        assert FEWEST <= len(room.parts) - 6 <= MOST


def test_furniture_and_access_point_stand_apart():
    for room in ROOMS:
        boxes = [mesh.bounds for name, (_, mesh) in room.parts.items() if name.startswith("piece")]
        for index, (low, high) in enumerate(boxes):
            assert np.maximum(low - room.station_m, room.station_m - high).max() >= CLEAR_M - 1e-4
            for other_low, other_high in boxes[:index]:
                assert np.maximum(low - other_high, other_low - high)[:2].max() > 0
        walls = np.concatenate([room.station_m, np.subtract(room.size_m, room.station_m)])
        assert walls.min() == pytest.approx(MOUNTED_M, abs=1e-4) if room.mount != "free" else walls.min() > MOUNTED_M


def test_furniture_moves_to_free_places():
    for seed, room in enumerate(ROOMS[:8], 200):
        shifts, pieces = moved.displacements(room, seed), len(room.parts) - 6
        assert 0 < len(shifts) <= pieces // 2
        boxes = {name: mesh.bounds + shifts.get(name, 0) for name, (_, mesh) in room.parts.items() if "piece" in name}
        for name, shift in shifts.items():
            low, high = boxes.pop(name)
            assert np.linalg.norm(shift) > moved.AT_LEAST_M
            assert (low[:2] > 0).all() and (high[:2] < room.size_m[:2]).all()  # noqa: PT018
            assert np.maximum(low - room.station_m, room.station_m - high).max() >= CLEAR_M - 1e-4
            for other_low, other_high in boxes.values():
                assert np.maximum(low - other_high, other_low - high)[:2].max() > 0


def test_rows_are_saved_up_to_the_first_number_that_is_as_good():
    counts = {moved.anew(name, n): n / 1000 for name, each in moved.ANEW.items() for n in each}
    scores = counts | {moved.OURS: 0.05}
    rows = [{"what": name, "mean": (m, m, m), "gain": (0.1, -0.1, 0.3)} for name, m in scores.items()]
    assert moved.saved(rows) == {moved.KRIGING: 100, moved.HYBRID: None}
    assert moved.table(rows).splitlines()[2] == "| kriging anew, 10 rows | 0.010 | 0.100 (-0.100 to 0.300) |"
    assert moved.table(rows).splitlines()[-1].endswith("|  |")


def test_rooms_differ_in_mount_and_materials():
    assert {room.mount for room in ROOMS} == set(MOUNTS)
    perfect = [{material for material, _ in room.parts.values()} == {PERFECT} for room in ROOMS]
    assert perfect == [room.perfect for room in ROOMS]
    assert 0 < sum(perfect) < len(ROOMS) / 2


@pytest.fixture(scope="module")
def surveyed(tmp_path_factory: pytest.TempPathFactory) -> Surveyed:
    """Channels, the true scene and the scan of a room."""
    return random_room_record(103, tmp_path_factory.mktemp("room"), SMALL)


def test_a_seed_fixes_channels_and_scan(surveyed, tmp_path):
    again = random_room_record(103, tmp_path, SMALL)
    for name in ("observation", "tx_pos_m"):
        np.testing.assert_array_equal(getattr(surveyed[0], name), getattr(again[0], name))
    first, second = (sorted((scan / "meshes").iterdir()) for _, _, scan in (surveyed, again))
    assert [file.read_bytes() for file in first] == [file.read_bytes() for file in second]


def test_noise_has_the_stated_power(surveyed):
    record, *_ = surveyed
    noise, signal = (np.square(np.abs(x)).mean(axis=2) for x in (record.observation - record.truth, record.truth))
    assert 10 * np.log10((signal / noise).mean()) == pytest.approx(SNR_DB, abs=1.5)


def test_a_third_of_the_scans_paths_and_a_radian_of_phase_are_wrong(surveyed):
    """And the scan states no material of the room: those of the rules."""
    record, true, scan = surveyed
    traced = [RayTracer(scene, instrument_of(record), OPTIONS).trace(record.tx_pos_m) for scene in (true, scan)]
    different = disagreement(*traced)
    assert different["wrong"] >= 1 / 3
    assert different["phase_error_rad"] >= 1
    assert not read_scene_folder(scan).materials.constants
    assert disagreement(traced[0], traced[0]) == {"missing": 0, "wrong": 0, "phase_error_rad": 0}


# Eight seconds. tests/correction/test_correct.py requires 20 dB of a correction by channels, in a smaller room.
@pytest.mark.slow
def test_correction_brings_channels_closer_than_the_scan(tmp_path):
    """By 3 dB at the test rows, 60 training rows; 7 dB with seed 103 and 90 rows."""
    record, _, scan = random_room_record(103, tmp_path / "room", Survey(train=60, test=24, rays=40_000))
    (split,) = make_splits(record, "official")
    write_page(correct_scene(scan, record, split, CorrectionOptions(rays=1 << 14, steps=3)), tmp_path / "corrected")
    tx_pos_m, scored = record.tx_pos_m[split.test], record.scored[0, split.test]
    before, after = (
        clipped_cea_db(RayTracer(scene, instrument_of(record), OPTIONS)(tx_pos_m)[0], scored, record)
        for scene in (scan, tmp_path / "corrected")
    )
    assert after > before + 3


def test_table_has_the_range_and_the_median_over_rooms():
    measured = [
        {
            "cea_db": {column: more + number for number, column in enumerate(COLUMNS)},
            "correction": {"seconds": 31.4 + more},
        }
        for more in (0.0, 9.0, 3.0)
    ]
    lines = rooms([*measured, {"what": "median gain", "cea_db": {column: 100.0 for column in COLUMNS}}]).splitlines()
    assert lines[2] == "| smallest of 3 rooms | 0.0 | 1.0 | 2.0 | 3.0 | 31 s |"
    assert lines[3] == "| median of 3 rooms | 3.0 | 4.0 | 5.0 | 6.0 | 34 s |"
    assert lines[4].startswith("| largest of 3 rooms | 9.0 | 10.0 |")
