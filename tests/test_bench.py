"""The benchmark's table, and that README and stored results say the same."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from wrf_mi.core import InputError
from wrf_mi.report.bench import CASES, bench, read_results, table

CHECKOUT = Path(__file__).resolve().parents[1]
RESULTS = CHECKOUT / "benchmarks" / "results"


def result(case: str, median: float) -> dict[str, object]:
    metrics = {
        "ssim": {"median": median, "mean": 0.8, "p10": 0.7, "p90": 0.95},
        "reference": {"idw4": {"median": 0.978}},
        "steps": 1234,
        "train_seconds": 90.0,
        "ms_per_sample": 8.5,
        "peak_memory_mb": 345.6,
    }
    return {"case": case, "title": CASES[case].title, "metrics": metrics}


def test_table_has_a_line_for_each_result() -> None:
    text = table([result("wrf-gs-official", 0.91), result("demo", 0.97)])
    assert len(text.splitlines()) == 4
    assert (
        "| WRF-GS, authors' split | **0.910** | 0.800 | 0.700 | 0.950 | 0.978 | 1,234 | 1.5 min | 8.5 | 346 MB |"
        in text
    )


def test_results_come_in_the_order_of_the_cases(tmp_path: Path) -> None:
    for case in ("demo", "wrf-gs-official"):
        (tmp_path / f"{case}.json").write_text(json.dumps(result(case, 0.9)))
    assert [r["case"] for r in read_results(tmp_path)] == ["wrf-gs-official", "demo"]


def test_unknown_case_is_refused_before_anything_runs(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="unknown; choose from"):
        bench(["no-such-case"], tmp_path / "out", tmp_path / "runs")
    assert not (tmp_path / "out").exists()


def test_readme_shows_the_stored_results() -> None:
    readme = (CHECKOUT / "README.md").read_text()
    shown = readme.split("<!-- figures -->")[1].split("<!-- /figures -->")[0]
    assert table(read_results(RESULTS)) in shown


def test_stored_results_are_complete() -> None:
    stored = read_results(RESULTS)
    assert [r["case"] for r in stored] == list(CASES)
    for r in stored:
        assert r["command"].startswith("wrf-mi ")
        assert {"machine", "versions", "date", "metrics"} <= set(r)
