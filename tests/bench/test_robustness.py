"""Faults, long use, hostile files and numbers of threads, small: no case goes wrong, none differs."""

from dataclasses import replace

import numpy as np
import pytest
from wrf_mi_bench import elsewhere, endurance, faults, hostile_files
from wrf_mi_bench.bench import BenchFailed
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
    outcomes = faults.run(tmp_path, [name], kills)
    assert {kind: outcome["failed"] for kind, outcome in outcomes.items() if outcome["failed"]} == {}


@pytest.mark.slow
def test_a_lost_worker_loses_and_repeats_no_row(tmp_path):
    assert endurance.lost_worker(tmp_path)["wrong"] == []


def test_predictions_and_opened_runs_keep_no_memory(tmp_path):
    assert endurance.memory(tmp_path, predictions=300, opened=30)["wrong"] == []


@pytest.mark.slow
def test_two_threads_give_what_one_gives(monkeypatch):
    """Images, spectra and metrics have equal bits; a change of one of them is reported."""
    both = [variant for variant in elsewhere.variants((1, 2)) if variant.kind == "threads"]
    monkeypatch.setattr(elsewhere, "variants", lambda threads: iter(both))
    computed = elsewhere.computed
    results = [computed(variant, True) for variant in both]
    in_turn = iter(results)
    monkeypatch.setattr(elsewhere, "computed", lambda *_: next(in_turn))
    figures = elsewhere.main(small=True)
    assert "failed" not in figures
    exact = dict.fromkeys(elsewhere.EXACT, 0.0)
    bounds = {row["quantity"]: row["bound"] for row in figures["rows"]}
    assert bounds == {**exact, "gradient": elsewhere.BOUNDS["gradient"]}
    assert elsewhere.table(figures["rows"]).splitlines()[-1].startswith("| 2 threads | **0** (bit-identical) |")
    (first, _), (second, seconds) = results
    changed = {**second, "image": np.nextafter(second["image"], 2)}
    assert elsewhere.differences(first, changed)["image"] > 0
    in_turn = iter([results[0], (changed, seconds)])
    assert elsewhere.main(small=True)["failed"] == "beyond its bound: 2 threads: image of Gaussians"


def test_failed_child_is_reported():
    variant = replace(next(elsewhere.variants((1,))), backend="none")
    with pytest.raises(elsewhere.BenchFailed, match="is none of auto, llvm, cuda"):
        elsewhere.computed(variant, True)


def test_a_child_that_never_reads_an_input_ends_the_benchmark(tmp_path, monkeypatch):
    """It would do so again for each input of each reader."""
    monkeypatch.setattr(hostile_files.sys, "executable", "false")
    with pytest.raises(BenchFailed, match="status 1, before the first input"):
        hostile_files.run_readers(tmp_path, list(READERS)[:1], INPUTS)
