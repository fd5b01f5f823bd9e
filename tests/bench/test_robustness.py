"""Faults, long use and hostile files in small numbers: no case goes wrong."""

import pytest
from wrf_mi_bench import endurance, faults
from wrf_mi_bench.hostile_files import run_readers
from wrf_mi_bench.hostile_samples import READERS

INPUTS = 10


def test_changed_files_are_refused_in_one_line_or_read(tmp_path):
    rows = run_readers(tmp_path, list(READERS), INPUTS)
    assert {row["reader"]: row["failed"] for row in rows if row["failed"]} == {}
    assert all(row["refused"] + row["loaded"] == INPUTS for row in rows)


@pytest.mark.parametrize(
    ("name", "kills"),
    [("kriging", 2), *(pytest.param(name, 1, marks=pytest.mark.slow) for name in ("correct", "tables"))],
)
def test_commands_under_faults_give_the_results_of_undisturbed_ones(name, kills, tmp_path):
    found = faults.run(tmp_path, [name], kills)
    assert {kind: one["failed"] for kind, one in found.items() if one["failed"]} == {}


@pytest.mark.slow
def test_a_lost_worker_loses_and_repeats_no_row(tmp_path):
    assert endurance.lost_worker(tmp_path)["wrong"] == []


def test_predictions_and_opened_runs_keep_no_memory(tmp_path):
    assert endurance.memory(tmp_path, predictions=300, opened=30)["wrong"] == []
