"""Tables of the benchmarks, and their agreement with the documents."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import pytest
from wrf_mi_bench import scene as bench_scene
from wrf_mi_bench.bench import (
    CASES,
    CHECKS,
    BenchFailed,
    bench,
    case_folder,
    check_table,
    own_table,
    read_results,
    table,
)
from wrf_mi_bench.check import main
from wrf_mi_bench.stress_rows import FITS, STAGES, stages
from wrf_mi_bench.table_pages import fronts, read_points

from wrf_mi.core import InputError
from wrf_mi.core.registry import resolve
from wrf_mi.parallel import Scheduler

CHECKOUT = Path(__file__).resolve().parents[2]
RESULTS = CHECKOUT / "benchmarks" / "results"
NEEDS_NO_DATA = (
    "damaged-scenes",
    "traced-and-splatted",
    "scaling",
    "operator",
    "stress",
    "pareto",
    "rooms",
    "phase-error",
    "elsewhere",
    "gpu",
    "robustness",
    "sentinels",
    "new-carriers",
)
"""Checks on what is made here, and on stored figures."""
ON_PAGE = {
    "pareto": "speed.md",
    "scaling": "speed.md",
    "operator": "speed.md",
    "training": "speed.md",
    "elsewhere": "numerics.md",
    "rooms": "correction.md",
    "stages": "hybrid.md",
    "intervals": "hybrid.md",
    "locate": "locate.md",
    "phase-error": "scenes.md",
}
"""Pages that show a check's table; all others but `NOT_LISTED` are in `docs/results.md`."""
NOT_LISTED = ("stress", "robustness", "sentinels", "new-carriers", "new-receivers")
"""Checks of many rows or of a former hybrid; `docs/numerics.md` summarises the first two."""
OTHER_BLOCKS = ("checks", "figures", "pareto", "ratios")
"""Blocks of pages that are made from several results."""


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
    text = table([result("wrf-gs+-paper", 0.91), result("demo", 0.97)])
    assert len(text.splitlines()) == 4
    assert (
        "| WRF-GS+, L = 9 as the paper | **0.910** | 0.800 | 0.700 | 0.950 | 0.978 | 1,234 | 1.5 min | 8.5 | 346 MB |"
        in text
    )


def test_results_come_in_the_order_of_the_cases(tmp_path: Path) -> None:
    for case in ("demo", "wrf-gs+-paper"):
        (tmp_path / f"{case}.json").write_text(json.dumps(result(case, 0.9)))
    assert [r["case"] for r in read_results(tmp_path)[0]] == ["wrf-gs+-paper", "demo"]


def test_unknown_case_is_refused_before_anything_runs(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="unknown; choose from"):
        bench(["no-such-case"], tmp_path / "out", tmp_path / "runs")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", CHECKS)
def test_checks_name_missing_data(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The function is there; without data it is one line, exit status 2 and no file."""
    assert callable(resolve(CHECKS[name].function))
    if name in NEEDS_NO_DATA:
        return
    monkeypatch.setenv("WRF_MI_DATA", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert main(CHECKS[name].function, str(tmp_path / "out.json")) == 2
    assert "not on this machine" in capsys.readouterr().err
    assert not (tmp_path / "out.json").exists()


def test_result_of_a_check_is_stored_and_tabulated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    figures = {"rows": [{"what": "walls", "value": "0.9", "asked": "0.8"}]}
    monkeypatch.setattr(bench_scene, "flat_plan", lambda: figures)
    assert main("wrf_mi_bench.scene:flat_plan", str(tmp_path / "out.json")) == 0
    assert json.loads((tmp_path / "out.json").read_text()) == figures
    line = check_table([{"title": "mesh", "figures": figures}]).splitlines()[-1]
    assert line == "| mesh: walls | **0.9** | 0.8 |"


def test_bench_on_workers_writes_figures_and_reports_failures(
    two: Scheduler, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A check that was measured before, and a run that cannot go on."""
    runs, out = tmp_path / "runs", tmp_path / "out"
    folder = case_folder(runs, "flat-plan")
    folder.mkdir(parents=True)
    figures = {"rows": [{"what": "walls", "value": "0.9", "asked": "0.8"}]}
    (folder / "check.json").write_text(json.dumps({"figures": figures}))
    rows = bench(["flat-plan"], out, runs, two)
    assert json.loads((out / "flat-plan.json").read_text()) == rows[0]
    assert rows[0]["figures"] == figures
    assert "| walls | **0.9** | 0.8 |" in (out / "README.md").read_text().replace("mesh of a flat: ", "")
    assert "cases that share a machine" in capsys.readouterr().err
    case_folder(runs, "demo").mkdir()
    (case_folder(runs, "demo") / "config.yaml").write_text("nonsense")
    with pytest.raises(BenchFailed, match=r"^bench demo: .* ended with status 2 wrf-mi: .*config.yaml: not readable"):
        bench(["flat-plan", "demo"], out, runs, two)


def test_documents_show_the_stored_results() -> None:
    results = (CHECKOUT / "docs" / "results.md").read_text()
    trained, checked = read_results(RESULTS)
    others = [one for one in checked if one["case"] not in {*ON_PAGE, *NOT_LISTED}]
    for one in checked:
        name = one["case"]
        if name in ON_PAGE:
            page = (CHECKOUT / "docs" / ON_PAGE[name]).read_text()
            assert f"<!-- {name} -->\n{own_table(one)}\n<!-- /{name} -->" in page
    for name, text in (("figures", table(trained)), ("checks", check_table(others))):
        assert text in results.split(f"<!-- {name} -->")[1].split(f"<!-- /{name} -->")[0]


def test_documents_show_no_check_without_a_stored_result() -> None:
    measured = {one["case"] for one in read_results(RESULTS)[1]}
    for page in (CHECKOUT / "docs").glob("*.md"):
        blocks = set(re.findall(r"^<!-- ([\w-]+) -->$", page.read_text(), re.MULTILINE))
        assert blocks <= {*measured, *OTHER_BLOCKS}, page.name


def test_documents_show_the_fronts_of_the_stored_tables() -> None:
    rows = fronts(read_points(RESULTS / "tables"))
    shown = check_table([{"title": CHECKS["pareto"].title, "figures": {"rows": rows}}])
    assert f"<!-- pareto -->\n{shown}\n<!-- /pareto -->" in (CHECKOUT / "docs" / "speed.md").read_text()


def summary_table(rows: Sequence[Mapping[str, str]]) -> str:
    """Markdown table of the worst error of each stage and its bound, and of the outcome of the fits."""
    lines = ["| what | cases | worst | bound |", "| --- | --- | --- | --- |"]
    lines += [
        f"| {title} | {cases or ''} | **{worst:.1e}** | {bound:g} |" for title, cases, worst, bound in stages(rows)
    ]
    for row in rows:
        if row["what"].startswith(FITS):
            what, _, count = row["what"].rpartition(", ")
            lines.append(f"| {what} | {count.removesuffix(' cases')} | **{row['value']}** | {row['asked']} |")
    return "\n".join(lines)


def test_documents_show_the_worst_of_each_stage() -> None:
    rows = json.loads((RESULTS / "stress.json").read_text())["figures"]["rows"]
    shown = (CHECKOUT / "docs" / "numerics.md").read_text().split("<!-- stress -->")[1].split("<!-- /stress -->")[0]
    assert shown.strip() == summary_table(rows)
    shown_stages = [next((words for words, begins in STAGES if re.match(begins, row["what"])), None) for row in rows]
    assert set(shown_stages) >= {words for words, _ in STAGES}
    worse = [{**row, "value": "worst 9.0e-01"} if row["what"].startswith("phase") else row for row in rows]
    assert "| **9.0e-01** | 0.001 |" in summary_table(worse)


def test_documents_show_the_robustness_without_single_files() -> None:
    result = json.loads((RESULTS / "robustness.json").read_text())
    rows = [row for row in result["figures"]["rows"] if " inputs, " not in row["value"]]
    shown = check_table([{"title": CHECKS["robustness"].title, "figures": {"rows": rows}}])
    assert f"<!-- robustness -->\n{shown}\n<!-- /robustness -->" in (CHECKOUT / "docs" / "numerics.md").read_text()


def test_stored_results_are_complete() -> None:
    trained, checked = read_results(RESULTS)
    assert [r["case"] for r in trained] == list(CASES)
    # What compares this code with stored figures holds for this code alone, so it may not be measured yet, nor may
    # what needs a GPU.
    measured = {r["case"] for r in checked}
    needed = [name for name, check in CHECKS.items() if name in measured or not (check.resumes or check.gpu)]
    assert [r["case"] for r in checked] == needed
    for r in [*trained, *checked]:
        assert r["command"].startswith("wrf-mi ")
        assert {"machine", "versions", "date"} <= set(r)
        assert "metrics" in r or r["figures"]["rows"]
