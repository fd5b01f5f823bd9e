"""Tables of the benchmarks, and their agreement with the documents."""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

import pytest
from documents import CHECKOUT, marked
from wrf_mi_bench import bench as bench_module
from wrf_mi_bench import scene as bench_scene
from wrf_mi_bench import sources
from wrf_mi_bench.bench import CASES, CHECKS, BenchFailed, bench, case_folder, check_table, read_results
from wrf_mi_bench.check import main
from wrf_mi_bench.stress_rows import stages
from wrf_mi_bench.table_pages import IN_RESULTS

from wrf_mi.core import InputError
from wrf_mi.core.registry import resolve

RESULTS = CHECKOUT / "benchmarks" / "results"
NEEDS_NO_DATA = {
    *("side-by-side", "skips", "scaling", "stress", "pareto", "rooms", "phase-error"),
    *("closed-forms", "elsewhere", "gpu", "sentinels", "new-carriers", "moved", "far-scans", "phone-scans"),
}
"""Checks on what is made here, and on stored figures."""
ON_PAGE = {
    **dict.fromkeys(("side-by-side", "skips", "waits"), "speed.md"),
    **dict.fromkeys(("stages", "ablation"), "hybrid.md"),
    **{"rooms": "correction.md", "locate": "locate.md", "moved": "scenes.md"},
    **dict.fromkeys(("fdtd", "far-scans"), "correction.md"),
    **{"buildings": "results.md", "journey": "results.md", "devices": "models.md"},
    **{"reception": "maps.md", "plan": "maps.md", "closed-forms": "numerics.md"},
}
"""Pages that show a check's table; all others but `NOT_LISTED` are in `docs/results.md`."""
NOT_LISTED = (
    *("scaling", "stress", "sentinels", "new-carriers", "new-receivers"),
    *("elsewhere", "flat-plan", "phase-error", "phone-scans"),
)
"""Checks of many rows, or that the prose of a page summarises."""
OTHER_BLOCKS = ("checks", "questions", *IN_RESULTS)
"""Blocks of pages that are made from several results."""
FIGURES = {"rows": [{"what": "walls", "value": "0.9", "asked": "0.8"}]}


def result(case: str, median: float) -> dict[str, object]:
    metrics = {
        "ssim": {"median": median, "mean": 0.8, "p10": 0.7, "p90": 0.95},
        "reference": {"idw4": {"median": 0.978}},
    }
    metrics |= {"steps": 1234, "train_seconds": 90.0, "ms_per_sample": 8.5, "peak_memory_mb": 345.6}
    return {"case": case, "title": CASES[case].title, "metrics": metrics}


def test_table_has_a_line_for_each_result_in_the_order_of_the_cases(tmp_path):
    for case, median in (("wrf-gs+-fast", 0.97), ("wrf-gs+-paper", 0.91)):
        (tmp_path / f"{case}.json").write_text(json.dumps(result(case, median)))
    trained = read_results(tmp_path)[0]
    assert [r["case"] for r in trained] == ["wrf-gs+-paper", "wrf-gs+-fast"]
    lines = bench_module.table(trained).splitlines()
    assert len(lines) == 4
    cells = "WRF-GS+, L = 9 as the paper | **0.910** | 0.800 | 0.700 | 0.950 | 0.978 | 1,234 | 1.5 min | 8.5 | 346 MB"
    assert lines[2] == f"| {cells} |"


def test_unknown_case_is_refused_before_anything_runs(tmp_path):
    with pytest.raises(InputError, match="unknown; choose from"):
        bench(["no-such-case"], tmp_path / "out", tmp_path / "runs")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", CHECKS)
def test_checks_name_missing_data(name, tmp_path, monkeypatch, capsys):
    """The function is there; without data it is one line, exit status 2 and no file."""
    assert callable(resolve(CHECKS[name].function))
    if name in NEEDS_NO_DATA:
        return
    monkeypatch.setenv("WRF_MI_DATA", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert main(CHECKS[name].function, str(tmp_path / "out.json")) == 2
    assert "not on this machine" in capsys.readouterr().err
    assert not (tmp_path / "out.json").exists()


def test_result_of_a_check_is_stored_and_tabulated(tmp_path, monkeypatch):
    monkeypatch.setattr(bench_scene, "flat_plan", lambda: FIGURES)
    assert main("wrf_mi_bench.scene:flat_plan", str(tmp_path / "out.json")) == 0
    assert json.loads((tmp_path / "out.json").read_text()) == FIGURES
    assert check_table([{"title": "mesh", "figures": FIGURES}]).splitlines()[-1] == "| mesh: walls | **0.9** | 0.8 |"


def test_bench_on_workers_writes_figures_and_reports_failures(two, tmp_path, capsys):
    """A check that was measured before, and a run that cannot go on."""
    runs, out = tmp_path / "runs", tmp_path / "out"
    folder = case_folder(runs, "flat-plan")
    folder.mkdir(parents=True)
    (folder / "check.json").write_text(json.dumps({"figures": FIGURES}))
    rows = bench(["flat-plan"], out, runs, two)
    assert json.loads((out / "flat-plan.json").read_text()) == rows[0]
    assert rows[0]["figures"] == FIGURES
    assert "| walls | **0.9** | 0.8 |" in (out / "README.md").read_text().replace("mesh of a flat: ", "")
    assert "cases that share a machine" in capsys.readouterr().err
    case_folder(runs, "wrf-gs+-fast").mkdir()
    (case_folder(runs, "wrf-gs+-fast") / "config.yaml").write_text("nonsense")
    with pytest.raises(
        BenchFailed, match=r"^bench wrf-gs\+-fast: .* ended with status 2 wrf-mi: .*config.yaml: not readable"
    ):
        bench(["flat-plan", "wrf-gs+-fast"], out, runs, two)


@pytest.mark.parametrize("name", ["wrf-gs+-paper", "flat-plan"])
def test_case_folder_depends_on_data_versions_and_arguments(name, tmp_path, monkeypatch):
    monkeypatch.setattr(bench_module, "dataset_files", lambda dataset: [tmp_path])
    folders = [case_folder(tmp_path, name)]
    assert case_folder(tmp_path, name) == folders[0]
    (tmp_path / "rows.csv").write_text("1")
    folders.append(case_folder(tmp_path, name))
    versions = sources.versions() | {"drjit": "0.1"}
    monkeypatch.setattr(sources, "versions", lambda: versions)
    folders.append(case_folder(tmp_path, name))
    if name in CASES:
        other = replace(CASES[name], arguments=(*CASES[name].arguments, "--seed", "3"))
        monkeypatch.setattr(bench_module, "CASES", {name: other})
        folders.append(case_folder(tmp_path, name))
    assert len(set(folders)) == len(folders)
    assert all(folder.name.startswith(f"{name}-") for folder in folders)


def test_documents_show_the_stored_results():
    _, checked = read_results(RESULTS)
    for row in checked:
        if page := ON_PAGE.get(row["case"]):
            assert (
                f"<!-- {row['case']} -->\n{bench_module.own_table(row)}\n<!-- /"
                in (CHECKOUT / "docs" / page).read_text()
            )
    others = [row for row in checked if row["case"] not in {*ON_PAGE, *NOT_LISTED}]
    assert marked("docs/results.md", "checks").strip() == check_table(others)


def test_documents_show_no_check_without_a_stored_result():
    measured = {row["case"] for row in read_results(RESULTS)[1]}
    for page in (CHECKOUT / "docs").glob("*.md"):
        names = set(re.findall(r"^<!-- ([\w-]+) -->$", page.read_text(), re.MULTILINE))
        assert names <= {*measured, *OTHER_BLOCKS}, page.name


def summary_table(rows: Sequence[Mapping[str, str]]) -> str:
    """Markdown table of the worst error of each stage and its bound."""
    lines = ["| what | cases | worst | bound |", "| --- | --- | --- | --- |"]
    lines += [f"| {title} | {cases} | **{worst:.1e}** | {bound:g} |" for title, cases, worst, bound in stages(rows)]
    return "\n".join(lines)


def test_documents_show_the_worst_of_each_stage():
    rows = json.loads((RESULTS / "stress.json").read_text())["figures"]["rows"]
    assert marked("docs/numerics.md", "stress").strip() == summary_table(rows)
    worse = [{**row, "value": "worst 9.0e-01"} if row["what"].startswith("plugin: im") else row for row in rows]
    assert "| **9.0e-01** | 0.0001 |" in summary_table(worse)


def test_stored_results_are_complete():
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
