"""Results that are older than their source."""

import json
import os
import shutil
import subprocess
from pathlib import Path

from wrf_mi_bench.bench import modules_of, provenance
from wrf_mi_bench.sources import PACKAGES, SOURCE, code_digest, modules_of_command, needed_files
from wrf_mi_bench.stale import UNKNOWN, stale

from wrf_mi.cli.main import main

CHECKOUT = Path(__file__).resolve().parents[2]
DATE = "2020-05-01"
TEXT = 'def f(x):\n    """Old."""\n    return x + 1\n'


def test_digest_ignores_comments_and_docstrings():
    assert code_digest(
        '"""New."""\n' + TEXT.replace("Old", "New").replace("return", "# why\n    return")
    ) == code_digest(TEXT)
    assert code_digest(TEXT.replace("1", "2")) != code_digest(TEXT)


def test_source_of_a_result_has_what_its_module_imports_and_the_models_that_it_names():
    files = needed_files(*modules_of("stages"))
    assert {"wrf_mi_bench/stages.py", "wrf_mi/core/files.py", "wrf_mi/models/hybrid/model.py"} <= files.keys()
    assert "wrf_mi/gaussians/blend.py" in needed_files(*modules_of("elsewhere"))  # of its child process
    assert "wrf_mi_bench/bench.py" not in files  # a new benchmark makes no other one stale
    rows = [
        needed_files(*modules_of_command(f"wrf-mi train rfid-lab --model {name}".split())) for name in ("idw", "fire")
    ]
    assert ["wrf_mi/models/uplink/fire.py" in one for one in rows] == [False, True]


def test_results_of_changed_source_are_listed(tmp_path, capsys):
    scan, plan = (provenance(*modules_of(name)) for name in ("large-scan", "flat-plan"))
    scan[SOURCE] |= {"wrf_mi/scene": "changed"}
    results = {"flat-plan": plan, "large-scan": scan, "rooms": {"date": DATE}, "stages/part": {"measured": scan}}
    (tmp_path / "stages").mkdir()
    for name, content in results.items():
        (tmp_path / f"{name}.json").write_text(json.dumps(content))
    assert main(["bench", "--stale", "--out", str(tmp_path)]) == 0
    *lines, summary = capsys.readouterr().out.splitlines()
    part, date = tmp_path / "stages" / "part.json", scan["date"]
    assert lines[:2] == [
        f"large-scan: {date}; wrf-mi bench large-scan; changed: wrf_mi/scene",
        f"rooms: {DATE}; wrf-mi bench rooms; changed: {UNKNOWN}",
    ]
    assert lines[2].startswith(f"stages/part: {date}; rm {part}; wrf-mi bench stages; changed: wrf_mi")
    assert len(lines) == 3
    assert summary == "2 of 4 results are older than their source, 1 unknown"
    assert main(["bench", "demo", "--stale", "--out", str(tmp_path)]) == 2


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
    found = {one["name"]: one["changed"] for one in stale(out)[0]}
    assert found == {"flat-plan": ["wrf_mi/scene/plan"], "rooms": UNKNOWN}
