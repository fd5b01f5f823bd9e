"""Sentinels: stored figures, and when they count as kept; results that are older than their source."""

import json
import os
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from calling import call
from documents import CHECKOUT
from wrf_mi_bench import bench, check
from wrf_mi_bench import sentinels as bench_sentinels
from wrf_mi_bench.bench import CHECKS, modules_of, provenance
from wrf_mi_bench.sentinels import STORED, TABLE_ROWS, Figure, Group, groups, main, median_interval
from wrf_mi_bench.sources import PACKAGES, SOURCE, code_digest, modules_of_command, needed_files, source_files
from wrf_mi_bench.stale import UNKNOWN, stale
from wrf_mi_bench.tables import FOLDER

from wrf_mi.apps.commands.main import main as cli
from wrf_mi.core import InputError
from wrf_mi.tasks import TASKS

SSIM = Figure("room: field, median SSIM", 0.90, 0.88, 0.92, True)
ERROR = Figure("flat: field, median absolute error (dB)", 3.0, 2.8, 3.2, False)
OTHERS_S = 300
"""Image method, integrator and stress: 30 s, 30 s and 75 s were seen while another process had half of the cores."""


def test_sentinels_are_stored_figures_of_every_task_within_forty_minutes(monkeypatch):
    monkeypatch.chdir(CHECKOUT)
    sentinel_groups = groups()
    figures = [figure for group in sentinel_groups for figure in group.figures]
    assert 25 <= len(figures) == len({figure.name for figure in figures})
    assert len(sentinel_groups) == len({group.name for group in sentinel_groups})
    assert all(figure.low <= figure.stored <= figure.high for figure in figures)
    assert {name.partition("-")[0] for name in TABLE_ROWS} == set(TASKS)
    rows = [json.loads((STORED.parent / FOLDER / f"{name}-100-seed0.json").read_text()) for name in TABLE_ROWS]
    assert OTHERS_S + sum(row["wall_seconds"] for row in rows) < 40 * 60


@pytest.mark.parametrize("count", [40, 400])
def test_interval_of_a_median_has_its_nominal_coverage(count):
    rng, inside = np.random.default_rng(1), 0
    for _ in range(400):
        low, high = median_interval(list(np.quantile(rng.normal(size=count), np.linspace(0, 1, 101))), count)
        inside += low <= 0 <= high
    # 400 draws of 95 % have a standard deviation of 1.1 %; the exact interval of 40 rows covers 96 %.
    assert 0.92 < inside / 400 < 0.99


@pytest.mark.parametrize(
    ("figure", "verdicts"),
    [
        (SSIM, {0.88: "equal", 0.93: "better", 0.87: "worse", float("nan"): "worse"}),
        (ERROR, {3.2: "equal", 2.7: "better", 3.3: "worse", float("inf"): "worse"}),
    ],
)
def test_a_figure_is_worse_outside_its_interval_on_the_bad_side(figure, verdicts):
    assert [figure.verdict(measured) for measured in verdicts] == list(verdicts.values())


class MadeGroups:
    """Three groups that take no time: a good figure, one as it is asked for, and one without data."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, runs: Path) -> None:
        self.asked: list[str] = []
        self.error: float | Exception | type[BaseException] = 3.0
        test_groups = [
            Group("good", (SSIM,), lambda _: self.measured("good", 0.9)),
            Group("other", (ERROR,), lambda _: self.measured("other", self.error)),
            Group("far", (ERROR,), lambda _: self.measured("far", 3.0), present=False),
        ]
        monkeypatch.setattr(bench_sentinels, "groups", lambda: test_groups)
        monkeypatch.setattr(bench_sentinels, "RUNS", runs)

    def measured(self, name: str, value: float | Exception | type[BaseException]) -> list[float]:
        self.asked.append(name)
        if isinstance(value, float):
            return [value]
        raise value


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> MadeGroups:
    return MadeGroups(monkeypatch, tmp_path / "sentinels")


def test_equal_figures_pass_and_missing_data_are_reported(made):
    result = main()
    assert "failed" not in result
    assert [row["verdict"] for row in result["rows"]] == ["equal", "equal", "not on this machine"]
    lines = bench_sentinels.table(result["rows"]).splitlines()
    assert lines[2] == "| room: field, median SSIM | 0.9 | 0.88 to 0.92 | 0.9 | equal |"
    assert lines[4] == "| flat: field, median absolute error (dB) | 3 | 2.8 to 3.2 |  | not on this machine |"


def test_stopped_call_resumes_from_measured_groups(made, tmp_path):
    made.error = KeyboardInterrupt
    assert check.main(CHECKS["sentinels"].function, str(tmp_path / "out.json")) == 130
    assert not (tmp_path / "out.json").exists()
    made.error = 3.0
    assert "failed" not in main()
    assert made.asked == ["good", "other", "other"]


def test_changed_code_is_measured_again(made, monkeypatch, tmp_path):
    first = main()
    assert main() == first  # nothing was measured, dates and seconds are those of the measurement
    changed = tmp_path / "changed.py"
    changed.write_text("x = 1\n")
    monkeypatch.setattr(bench_sentinels, "source_files", lambda: source_files() | {"wrf_mi/changed.py": changed})
    main()
    assert made.asked == ["good", "other"] * 2


def test_source_files_are_the_packages_without_compiled_files():
    names = source_files()
    assert {"wrf_mi/runs/folder.py", "wrf_mi_plugins/shape.py", "wrf_mi_scenes/registry.py"} <= set(names)
    assert not [name for name in names if name.endswith(".pyc")]


@pytest.mark.parametrize(
    ("error", "value"), [(3.3, "3.3, worse"), (InputError("no\nscene"), "failed: no scene"), (OSError(), "failed")]
)
def test_worse_or_failed_figure_is_named_after_all_were_measured(made, error, value):
    made.error = error
    failed = main()["failed"]
    assert made.asked == ["good", "other"]
    assert failed.startswith(f"1 of 3 figures got worse or were not measured, first {ERROR.name}: {value}")


def test_the_command_prints_and_stores_the_table_and_fails_where_a_figure_got_worse(monkeypatch, tmp_path, capsys):
    """The check runs in a process of its own, which is left out here."""
    figures = {"rows": [ERROR.row(3.3, "worse"), SSIM.row(0.9, "equal")], "failed": "1 of 2 figures got worse"}
    calls = []

    def run_module(module: str, arguments: Sequence[str]) -> tuple[int, str]:
        calls.append(arguments[0])
        Path(arguments[1]).write_text(json.dumps(figures))
        return 0, ""

    monkeypatch.setattr(bench, "run_module", run_module)
    monkeypatch.setattr(bench, "source_digests", lambda *modules: {})
    asked = ["bench", "sentinels", "--out", tmp_path / "out", "--runs", tmp_path / "runs"]
    status, out, err = call(asked, capsys)
    assert status == 1
    assert "| flat: field, median absolute error (dB) | 3 | 2.8 to 3.2 | 3.3 | worse |" in out.splitlines()
    assert err.splitlines()[-1] == "wrf-mi: bench sentinels: 1 of 2 figures got worse"
    result = json.loads((tmp_path / "out" / "sentinels.json").read_text())
    assert {"machine", "versions", "date"} <= set(result)
    assert result["figures"] == figures
    assert "3.3, worse" in (tmp_path / "out" / "README.md").read_text()
    # Every call compares with what is stored then.
    del figures["failed"]
    status, _, err = call(asked, capsys)
    assert status == 0
    assert "finished before" not in err
    assert calls == [CHECKS["sentinels"].function] * 2


def test_missing_stored_figures_are_reported_in_one_line(monkeypatch, tmp_path, capfd):
    """The command, with the process that it starts."""
    monkeypatch.chdir(tmp_path)
    status, out, err = call(["bench", "sentinels", "--out", "out", "--runs", "runs"], capfd)
    assert (status, out, err.count("\n")) == (2, "", 1), err
    assert "stored figures are not on this machine; call it in a checkout" in err
    assert not (tmp_path / "out" / "sentinels.json").exists()


DATE = "2020-05-01"
TEXT = 'def f(x):\n    """Old."""\n    return x + 1\n'


def test_digest_ignores_comments_and_docstrings():
    assert code_digest(
        '"""New."""\n' + TEXT.replace("Old", "New").replace("return", "# why\n    return")
    ) == code_digest(TEXT)
    assert code_digest(TEXT.replace("1", "2")) != code_digest(TEXT)


def test_source_of_a_result_has_what_its_module_imports_and_the_models_that_it_names():
    files = needed_files(*modules_of("stages"))
    assert {"wrf_mi_bench/stages.py", "wrf_mi/core/files.py", "wrf_mi/stages/hybrid.py"} <= files.keys()
    assert "wrf_mi/gaussians/blend.py" in needed_files(*modules_of("elsewhere"))  # of its child process
    assert "wrf_mi_bench/bench.py" not in files  # a new benchmark makes no other one stale
    rows = [
        needed_files(*modules_of_command(f"wrf-mi train rfid-lab --model {name}".split())) for name in ("idw", "fire")
    ]
    assert ["wrf_mi/estimators/uplink/fire.py" in files for files in rows] == [False, True]


def test_results_of_changed_source_are_listed(tmp_path, capsys):
    scan, plan = (provenance(*modules_of(name)) for name in ("large-scan", "flat-plan"))
    scan[SOURCE] |= {"wrf_mi/scene": "changed"}
    results = {"flat-plan": plan, "large-scan": scan, "rooms": {"date": DATE}, "stages/part": {"measured": scan}}
    (tmp_path / "stages").mkdir()
    for name, content in results.items():
        (tmp_path / f"{name}.json").write_text(json.dumps(content))
    assert cli(["bench", "--stale", "--out", str(tmp_path)]) == 0
    *lines, summary = capsys.readouterr().out.splitlines()
    part, date = tmp_path / "stages" / "part.json", scan["date"]
    assert lines[:2] == [
        f"large-scan: {date}; wrf-mi bench large-scan; changed: wrf_mi/scene",
        f"rooms: {DATE}; wrf-mi bench rooms; changed: {UNKNOWN}",
    ]
    assert lines[2].startswith(f"stages/part: {date}; rm {part}; wrf-mi bench stages; changed: wrf_mi")
    assert len(lines) == 3
    assert summary == "2 of 4 results are older than their source, 1 unknown"
    assert cli(["bench", "flat-plan", "--stale", "--out", str(tmp_path)]) == 2


def test_results_without_digest_are_compared_with_the_source_of_their_date(tmp_path):
    """A repository with this source, but a comment in one folder and a statement in another."""
    for name, folder in PACKAGES.items():
        ignored = shutil.ignore_patterns("__pycache__", "results", "[!_]*.[!p]*")
        shutil.copytree(CHECKOUT / folder / name, tmp_path / folder / name, ignore=ignored)
    for name, line in (("wrf_mi/core/files.py", "# why"), ("wrf_mi/scene/plan/storey.py", "MADE = 1")):
        with (tmp_path / name).open("a") as file:
            file.write(f"{line}\n")
    out = tmp_path / "benchmarks" / "results"
    out.mkdir()
    (out / "flat-plan.json").write_text(json.dumps({"date": DATE}))
    (out / "rooms.json").write_text(json.dumps({"date": "2019-01-01"}))
    git = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@example.org"]
    dates = {"GIT_COMMITTER_DATE": f"{DATE}T12:00:00", "GIT_AUTHOR_DATE": f"{DATE}T12:00:00"}
    for words in (["init", "-q"], ["add", "-A"], ["commit", "-qm", "one"]):
        subprocess.run([*git, *words], check=True, env={**os.environ, **dates})
    changed = {result["name"]: result["changed"] for result in stale(out)[0]}
    assert changed == {"flat-plan": ["wrf_mi/scene/plan"], "rooms": UNKNOWN}
