"""Sentinels: which rows they are, and when a figure counts as kept."""

from __future__ import annotations

import json

import numpy as np
import pytest

from wrf_mi.report import bench_sentinels
from wrf_mi.report.bench import CHECKS
from wrf_mi.report.bench_sentinels import SENTINELS, STORED, compare_row, median_interval
from wrf_mi.report.table_plan import plan


def test_sentinels_are_stored_rows_of_the_tables_within_their_time() -> None:
    planned = {row.name for row in plan()}
    names = [f"{name}-100-seed0" for name in SENTINELS]
    assert 28 <= len(names) == len(set(names))
    assert set(names) <= planned
    stored = [json.loads((STORED / f"{name}.json").read_text()) for name in names]
    assert sum(row["wall_seconds"] or row["train_seconds"] for row in stored) < 45 * 60
    assert "sentinels" in CHECKS


@pytest.mark.parametrize("count", [40, 400])
def test_interval_of_a_median_covers_it_as_often_as_it_says(count: int) -> None:
    rng = np.random.default_rng(1)
    inside = 0
    for _ in range(400):
        low, high = median_interval(np.quantile(rng.normal(size=count), np.linspace(0, 1, 101)), count)
        inside += low <= 0 <= high
    assert 0.90 < inside / 400 < 0.99  # 95 %, of 400 draws


def row(median: float, task: str = "rssi") -> dict[str, object]:
    quantiles = list(median + np.linspace(-2, 2, 101))
    return {"row": task, "score": {"median": median}, "quantiles": quantiles, "n_test": 100}


@pytest.mark.parametrize(
    ("task", "now", "held"),
    [("rssi", 3.0, True), ("rssi", 3.3, True), ("rssi", 3.6, False), ("rssi", 1.0, True), ("csi", 1.0, False)],
)
def test_figures_inside_the_interval_or_better_are_kept(task: str, now: float, held: bool) -> None:
    assert compare_row(row(3.0, task), row(now, task), task)["held"] is held


def test_a_figure_that_moved_fails_after_all_were_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    measured = []

    def moved(runs: object, planned: object) -> dict[str, object]:
        measured.append(planned)
        return row(99.0) | {"row": "moved"}

    monkeypatch.setattr(bench_sentinels, "measure", moved)
    monkeypatch.setattr(bench_sentinels, "available", lambda part: True)
    monkeypatch.setattr(bench_sentinels, "SENTINELS", (SENTINELS[0], "rssi-flat-ble-official-idw"))
    with pytest.raises(bench_sentinels.BenchFailed, match="1 of 2 figures moved, first rssi-flat-ble"):
        bench_sentinels.main()
    assert len(measured) == 2
