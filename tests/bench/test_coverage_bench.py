"""Benchmark of intervals: its runs, with the fits replaced, and its table."""

from pathlib import Path
from typing import Any

from wrf_mi_bench import comparison, stages
from wrf_mi_bench.stages import JOINT, Cell


def test_runs_are_stored_and_those_outside_are_counted(tmp_path, monkeypatch):
    asked = list[tuple[str, str]]()

    def measured(cell: Cell, name: str, _: Path) -> dict[str, Any]:
        asked.append((cell.name, name))
        return {"block": "ssim", "score": {}, "inside_90": 0.97 if name == JOINT else 0.9, "crps": 0.02}

    monkeypatch.setattr(comparison, "STORED", tmp_path)
    monkeypatch.setattr(stages, "RUNS", tmp_path / "runs")
    monkeypatch.setattr(stages, "INTERVAL_CELLS", (Cell("open", "official", None), Cell("meshed", "blocked", 400)))
    monkeypatch.setattr(stages, "data_folder", lambda name: tmp_path)
    monkeypatch.setattr(stages, "measured_intervals", measured)
    found = stages.intervals()
    assert asked == [
        (cell, name) for cell in ("open-official-all", "meshed-blocked-400") for name in stages.INTERVAL_MODELS
    ]
    assert (found["inside"], found["runs"]) == (4, 6)
    assert found["failed"] == "intervals cover 85 to 95 % in 4 of 6 runs"
    assert stages.intervals()["rows"] == found["rows"]
    assert len(asked) == found["runs"]  # the second time from the files
    assert stages.interval_table(found["rows"]).splitlines()[2:] == [
        "| open, official, all rows | 90%, 0.02 | 97%, 0.02 | 90%, 0.02 |",
        "| meshed, blocked, 400 rows | 90%, 0.02 | 97%, 0.02 | 90%, 0.02 |",
    ]
