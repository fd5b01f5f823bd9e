"""Faults and hostile files in small numbers: no case goes wrong."""

from __future__ import annotations

from pathlib import Path

from wrf_mi_bench import faults
from wrf_mi_bench.hostile_files import run_readers
from wrf_mi_bench.hostile_samples import READERS
from wrf_mi_bench.robustness import SLOW

INPUTS = 10


def test_changed_files_are_refused_in_one_line_or_read(tmp_path: Path) -> None:
    rows = run_readers(tmp_path, [name for name in READERS if name not in SLOW], INPUTS)
    assert {row["reader"]: row["failed"] for row in rows if row["failed"]} == {}
    assert all(row["refused"] + row["loaded"] == INPUTS for row in rows)


def test_killed_and_refused_trainings_go_on_as_if_left_alone(tmp_path: Path) -> None:
    found = faults.run(tmp_path, ["kriging"], kills=2)
    assert {kind: one["failed"] for kind, one in found.items() if one["failed"]} == {}
