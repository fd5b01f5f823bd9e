"""Benchmarks of models: the hybrid and its parts, positions, new receivers, reception, stored parts."""

from typing import Any

import numpy as np
import pytest
from wrf_mi_bench import bench, reception, stages
from wrf_mi_bench.comparison import MEASURED, STORED, measured_on, stored_part
from wrf_mi_bench.locate import CELLS as LOCATE_CELLS
from wrf_mi_bench.locate import STRETCH, stretches, summary
from wrf_mi_bench.stages import CALIBRATED, CELLS, JOINT, MATERIALS, parts_of, rows_of
from wrf_mi_bench.unmeasured import HYBRID, LAW, gains, only

from wrf_mi.core import Receiver, Record
from wrf_mi.datasets import make_splits


def test_part_is_measured_once_and_stored_with_machine_and_date(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(bench, "source_digests", lambda *modules: {})
    calls: list[int] = []

    def score() -> dict[str, Any]:
        calls.append(1)
        return {"score": len(calls)}

    first = stored_part("rooms", "part", score)
    assert stored_part("rooms", "part", score) == first
    assert first["score"] == 1
    assert {"date", "machine", "versions", "source"} <= set(first[MEASURED])
    (STORED / "rooms" / "part.json").unlink()
    assert stored_part("rooms", "part", score)["score"] == 2


@pytest.mark.parametrize(
    ("days", "stated"), [(["2026-01-02"], "2026-01-02"), (["2026-01-02", "2025-12-31"], "2025-12-31 to 2026-01-02")]
)
def test_dates_of_parts(days, stated):
    assert measured_on([{MEASURED: {"date": day}} for day in days]) == stated


def test_table_names_the_kept_stages_and_the_best_part():
    def measured(model: str, median: float, gains: tuple[float, ...] = (), **more: Any) -> dict[str, Any]:
        score = {"median": median, "mean": median - 0.01}
        gain = dict(zip(("gain", "gain_low", "gain_high"), gains, strict=False))
        return {"model": model, "score": score, "block": "ssim", "inside_90": None, "crps": None} | gain | more

    stage_values = [("mean", True, 0.7, None), ("correction", False, 0.695, 3.0), ("field", True, None, 1.0)]
    in_turn = [dict(zip(("stage", "kept", "held_out", "seconds"), values, strict=True)) for values in stage_values]
    results = [
        measured("hybrid", 0.9, inside_90=0.88, crps=0.02, stages=in_turn),
        measured("kriging", 0.92, (-0.02, -0.03, -0.01)),
        measured("idw", 0.7, (0.2, 0.1, 0.3)),
        measured(JOINT, 0.91, (-0.01, -0.03, 0.01)),
    ]
    rows = rows_of(CELLS[0], results)
    assert stages.table(rows).splitlines()[2:] == [
        "| rfid-lab, official, 5 rows | **0.9** | 88% | mean, field | kriging 0.92 | -0.02 (-0.03 to -0.01) |"
    ]
    assert len(stages.table([{**row, "gain": 0.0} if "gain" in row else row for row in rows]).splitlines()) == 2


def test_few_rows_are_judged_by_the_means_of_their_draws():
    def draw(gain: float, *names: str) -> list[dict[str, Any]]:
        stage_rows = [
            {"stage": name, "kept": name in names, "held_out": None, "seconds": 1.0} for name in ("mean", "field")
        ]
        hybrid = {"model": "hybrid", "score": {"median": 0.5 + gain}, "inside_90": 0.8 + gain, "stages": stage_rows}
        part = {"model": "kriging", "score": {"median": 0.5}, "inside_90": None}
        return [hybrid, part | {"gain": gain, "gain_low": gain - 0.1, "gain_high": gain + 0.1}]

    assert [cell.seed for cell in CELLS if cell.title == "laboratory, official, 15 rows"] == [0, 1, 2]
    assert [cell.seed for cell in CELLS if cell.title == "laboratory, official, all rows"] == [0]
    hybrid, part = stages.over_draws([draw(0.0, "mean"), draw(0.3, "mean", "field"), draw(0.0, "mean")])
    assert (hybrid["score"]["median"], hybrid["inside_90"]) == pytest.approx((0.6, 0.9))
    assert [(stage["stage"], stage["draws"]) for stage in hybrid["stages"]] == [("mean", 3), ("field", 1)]
    # As wide as those of one draw: all are scored on the same test rows.
    assert [part[key] for key in ("gain", "gain_low", "gain_high")] == pytest.approx([0.1, 0.0, 0.2])
    assert part["inside_90"] is None


@pytest.mark.parametrize(
    ("task", "scene", "parts"),
    [
        ("spectrum", None, ["kriging", "idw"]),
        ("spectrum", "room", ["kriging", "idw", "ray-tracing", JOINT, MATERIALS]),
        ("rssi", "flat", ["kriging", "idw", "ray-tracing", CALIBRATED]),
    ],
)
def test_parts_are_those_of_the_task_and_the_scene(task, scene, parts):
    assert parts_of(task, scene) == parts


def positions(error_m: float, inside: float, count: int = 10 * STRETCH) -> dict[str, Any]:
    """A cell whose errors are those of nearest neighbours less half a metre, in the share ``inside`` of its regions."""
    hits = np.random.default_rng(0).permutation(np.arange(count) < inside * count)
    values = {"error_m": error_m, "neighbours_error_m": error_m + 0.5, "best_neighbours_error_m": error_m}
    values |= {"area_m2": 1.0, "radius_m": 1.0}
    return {name: [value] * count for name, value in values.items()} | {"inside": hits.tolist()}


def test_draws_are_pooled_and_judged_together():
    shares = {0: 0.8, 1: 1.0, 2: 0.9}
    result = summary({cell: positions(1.0 + cell.seed, shares[cell.seed]) for cell in LOCATE_CELLS})
    rows = {row["what"]: row for row in result["rows"]}
    pooled = rows["64 rows, hybrid, knows walls, 3 draws"]
    assert pooled["mean_m"] == pytest.approx(2.0)
    assert pooled["gain_m"] == pytest.approx([0.5] * 3)
    assert pooled["inside"][0] == pytest.approx(0.9)
    assert "all rows, hybrid, knows walls, seed 0" in rows
    # Those of a single draw, 80 %; of three draws it is 90 % in the mean.
    titles = ["hybrid, knows walls", "kriging", "kriging"]
    names = ["all rows", "wifi-office, all rows", "mall-f3, all rows"]
    of_one = [f"{name}, {title}, seed 0" for name, title in zip(names, titles, strict=True)]
    assert result["coverage_outside"] == of_one
    assert result["not_clearly_better"] == []
    assert "failed" in result


def test_stretches_are_means_of_consecutive_rows_over_draws():
    values = np.stack([np.arange(50.0), np.arange(50.0) + 2])
    np.testing.assert_allclose(stretches(values), [np.arange(20).mean() + 1, np.arange(20, 50).mean() + 1])
    np.testing.assert_allclose(stretches(values[:, :27]), np.arange(27) + 1)  # places one by one


def test_new_receivers_alone_see_the_rows_left_to_them():
    receivers = tuple(Receiver(f"rx{k}", np.array([k, 0.0, 1.0]), np.array([0.0, 0, 0, 1])) for k in range(3))
    observed = -np.arange(180, dtype=np.float32).reshape(3, 60)
    official, tx_pos_m = (np.arange(40), np.arange(40, 60)), np.random.default_rng(0).uniform(1, 5, (60, 3))
    record = Record("made-up", "rssi", tx_pos_m, receivers, observed, official)
    (split,) = make_splits(record, "receiver+5:1")
    alone, rows = only(record, split)
    assert [receiver.name for receiver in alone.receivers] == ["rx1"]
    np.testing.assert_array_equal(rows.train, split.left[:, 1])
    np.testing.assert_array_equal(rows.test, split.test)
    received = np.flatnonzero(np.isfinite(alone.observation[0]))
    np.testing.assert_array_equal(received, np.union1d(split.left[:, 1], split.test))
    np.testing.assert_array_equal(alone.observation[0, received], observed[1, received])


def test_seeds_that_score_the_same_rows_do_not_narrow_an_interval():
    errors = np.random.default_rng(1).uniform(1, 3, (2, 50))
    scores = {HYBRID: errors[0].tolist(), LAW: errors[1].tolist(), "inside_90": 0.9, "crps": 1.0, "task": "rssi"}
    scores["pairs"] = [["rx", row] for row in range(50)]
    once, thrice = (gains([scores] * count)[LAW] for count in (1, 3))
    assert once[2].value == pytest.approx((errors[1] - errors[0]).mean())
    assert (thrice[2].low, thrice[2].high) == pytest.approx((once[2].low, once[2].high))
    assert thrice[:2] == pytest.approx(once[:2])


def test_weakest_values_are_missing_and_reception_is_tabulated(monkeypatch):
    observed = np.arange(12, dtype=np.float32).reshape(2, 6)
    observed[0, 0] = np.nan  # counts among the missing third
    monkeypatch.setattr(reception, "load_record", lambda _: strengths(observed))
    cell = reception.Cell("flat-ble", "blocked", 400, weak_are_missing=True)
    np.testing.assert_array_equal(np.isnan(cell.record().observation), [[True] * 4 + [False] * 2, [False] * 6])
    scores = {"log_loss": 0.25, "brier": 0.1, "calibration_error": 0.01}
    block = {"received": 2 / 3, **scores, "reference": {name: scores for name in reception.REFERENCES}}
    row = reception.row_of(cell, "idw", {"reception": block, "gain": [], "score": {"median": 3.0}})
    rows = [row, {**row, "model": "kriging", "log_loss": [0.2, 0.25, 0.25]}]
    cells = "flat-ble, blocked, 400 rows, a third missing (67% received) | 0.250 | **0.200** | 0.250 | 0.250"
    assert reception.table(rows).splitlines()[2] == f"| {cells} |"


def strengths(observed: np.ndarray) -> Record:
    """Strengths of receivers at one place."""
    places = [Receiver(str(k), np.zeros(3), np.array([0.0, 0, 0, 1])) for k in range(len(observed))]
    return Record("made-up", "rssi", np.zeros((observed.shape[1], 3)), tuple(places), observed)
