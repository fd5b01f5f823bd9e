"""Benchmark of random rooms: errors of scans, gain of the correction, table."""

from pathlib import Path

import pytest
from wrf_mi_bench.random_room import OPTIONS, Survey, random_room_record
from wrf_mi_bench.rooms import COLUMNS, clipped_cea_db, disagreement, table

from wrf_mi.core import Record
from wrf_mi.correction import CorrectionOptions, correct_scene, write_page
from wrf_mi.datasets import make_splits
from wrf_mi.scene.folder import read_scene_folder
from wrf_mi.tasks import instrument_of
from wrf_mi.tracing.tracer import RayTracer


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Record, Path, Path]:
    return random_room_record(103, tmp_path_factory.mktemp("room"), Survey(train=60, test=24, rays=40_000))


def test_a_third_of_the_scans_paths_and_a_radian_of_phase_are_wrong(made):
    """And the scan states no material of the room: those of the rules."""
    record, true, scan = made
    traced = [RayTracer(scene, instrument_of(record), OPTIONS).trace(record.tx_pos_m) for scene in (true, scan)]
    found = disagreement(*traced)
    assert found["wrong"] >= 1 / 3
    assert found["phase_error_rad"] >= 1
    assert not read_scene_folder(scan).materials.constants
    same = disagreement(traced[0], traced[0])
    assert same == {"missing": 0, "wrong": 0, "phase_error_rad": 0}


# Eight seconds. tests/correction/test_correct.py requires 20 dB of a correction by channels, in a smaller room.
@pytest.mark.slow
def test_correction_brings_channels_closer_than_the_scan(made, tmp_path):
    """By 3 dB at the test rows, 60 training rows; 7 dB with seed 103 and 90 rows."""
    record, _, scan = made
    options = CorrectionOptions(rays=1 << 14, steps=3)
    write_page(correct_scene(scan, record, make_splits(record, "official")[0], options), tmp_path / "corrected")
    rows = make_splits(record, "official")[0].test
    accuracy = [
        clipped_cea_db(
            RayTracer(scene, instrument_of(record), OPTIONS)(record.tx_pos_m[rows])[0], record.scored[0, rows], record
        )
        for scene in (scan, tmp_path / "corrected")
    ]
    assert accuracy[1] > accuracy[0] + 3


def test_table_has_a_line_for_each_room_and_the_median():
    row = {
        "what": "0: 3 x 4 x 3 m",
        "value": "1.0 to 9.0 dB",
        "cea_db": {column: float(number) for number, column in enumerate(COLUMNS)},
        "scan": {"missing": 0.4, "wrong": 0.5, "phase_error_rad": 1.2},
        "correction": {"seconds": 31.4},
    }
    lines = table([row, {"what": "median gain", "value": "8.0 dB", "cea_db": row["cea_db"]}]).splitlines()
    assert lines[2] == "| 0: 3 x 4 x 3 m | 0.0 | 1.0 | 2.0 | 3.0 | 40 % | 50 % | 1.2 rad | 31 s |"
    assert lines[3].startswith("| **median**; median gain: 8.0 dB | 0.0 | 1.0 |")
    assert len({line.count("|") for line in lines}) == 1
