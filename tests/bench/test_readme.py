"""README and documents: scripts run, commands parse, links exist, numbers and measured tables equal the stored ones."""

import argparse
import importlib
import json
import re
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from documents import CHECKOUT, DOCS, PAGE_NAMES, PAGES, README, blocks, marked
from PIL import Image
from wrf_mi_bench.bench import CASES, CHECKS
from wrf_mi_bench.command import TABLES
from wrf_mi_bench.entries import stored_entries
from wrf_mi_bench.front_page import question_table
from wrf_mi_bench.journey import COMMANDS

from wrf_mi.apps.commands.main import build_parser
from wrf_mi.apps.table.entries import read_entries
from wrf_mi.core import Receiver, Record
from wrf_mi.core.settings import describe, with_settings
from wrf_mi.datasets import write_spectrum_folder
from wrf_mi.gaussians import FIELDS
from wrf_mi.models import MODELS
from wrf_mi.training.config import TrainConfig

HEIGHT, WIDTH, ROWS = 10, 16, 14


def prose(path: Path) -> str:
    """A document without its fenced blocks."""
    return re.sub(r"^```.*?^```$", "", path.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)


def commands(path: Path) -> list[str]:
    """Every line of a shell block, and every `wrf-mi ...` in the prose."""
    lines = [line for block in blocks(path, "sh") for line in block.splitlines()]
    return [*lines, *re.findall(r"`(wrf-mi [^`]+)`", prose(path))]


def cell_rows(text: str) -> list[list[str]]:
    """Cells of the table rows that begin with a name in backticks, the backticks taken off."""
    rows = re.findall(r"^\| `([^`]+)` \|(.+)\|$", text, re.MULTILINE)
    return [[name, *(cell.strip().strip("`") for cell in cells.split(" | "))] for name, cells in rows]


def test_scripts_of_the_readme_run(tmp_path, monkeypatch, capsys):
    """Scripts run unchanged except data set, of rfid-lab's form, and number of steps."""
    rng = np.random.default_rng(3)
    receiver = Receiver("gateway1", np.array([5.0, 0.3, 0.0]), np.array([0.0, 0.6, 0.0, 0.8]))
    spectra = rng.random((1, ROWS, HEIGHT, WIDTH)).astype(np.float32)
    official = np.arange(ROWS - 3), np.arange(ROWS - 3, ROWS)
    record = Record("tiny", "spectrum", rng.uniform(-0.5, 1.0, (ROWS, 3)), (receiver,), spectra, official)
    folder = write_spectrum_folder(tmp_path / "tiny", record)
    script = "\n".join(blocks(README, "python"))
    for shown, tiny in (('"rfid-lab"', repr(str(folder))), ('"steps": 6000', '"steps": 2')):
        assert script.count(shown) == 1
        script = script.replace(shown, tiny)
    script += "\n".join(blocks(DOCS / "gaussians.md", "python"))
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    exec(compile(script, str(README), "exec"), names)
    metrics = json.loads((tmp_path / "runs" / "script" / "metrics.json").read_text())
    assert metrics["steps"] == 2
    printed = capsys.readouterr().out
    for block in (metrics["ssim"], metrics["reference"]["idw"]):
        assert str(block["median"]) in printed
    assert names["spectrum"].shape == (HEIGHT, WIDTH)
    assert names["spectra"].shape == (3, HEIGHT, WIDTH)
    # The parts that were put in are the ones that trained.
    assert names["trainer"].field is names["field"]
    assert names["trainer"].state.gaussians == 200
    with Image.open(tmp_path / "spectrum.png") as picture:
        assert np.ptp(np.asarray(picture.convert("L"))) > 100


@pytest.mark.parametrize("path", PAGES, ids=PAGE_NAMES)
def test_commands_parse(path):
    targets = set(re.findall(r"^([a-z-]+):", (CHECKOUT / "Makefile").read_text(), re.MULTILINE))
    for line in commands(path):
        program, *arguments = shlex.split(line, comments=True)
        if program == "make":
            assert set(arguments) <= targets, line
            continue
        assert program == "wrf-mi", line
        try:
            parsed: argparse.Namespace = build_parser().parse_args(arguments)
        except SystemExit:
            pytest.fail(f"{path.name}: {line}")
        if changes := getattr(parsed, "set", []):
            entry = MODELS[parsed.model or "wrf-gs+"]
            with_settings(TrainConfig() if entry.name in FIELDS else entry.settings(), changes)
        for name in getattr(parsed, "names", []):
            assert name in {*CASES, *CHECKS, TABLES}, line


def test_readme_is_short_and_leads_from_a_scan_to_a_map():
    shown = [shlex.split(line, comments=True)[1] for block in blocks(README, "sh") for line in block.splitlines()]
    journey = ["mesh", "data", "train", "map", "locate"]
    assert shown == [*journey, "demo", "test", "mesh", "check", "data", "train", "predict"]
    lines = [shlex.split(line, comments=True) for line in blocks(README, "sh")[0].splitlines()]
    assert [" ".join(words[1:]) for words in lines] == list(COMMANDS)
    assert len(README.read_text(encoding="utf-8").splitlines()) <= 120


def test_the_first_table_of_the_results_is_of_stored_entries():
    assert marked("docs/results.md", "questions") == question_table(CHECKOUT / "benchmarks" / "table")


def test_entries_of_other_benchmarks_are_those_of_their_stored_results():
    table = read_entries(CHECKOUT / "benchmarks" / "table")
    derived = {entry.name: entry for entry in stored_entries(CHECKOUT / "benchmarks" / "results")}
    assert len(derived) > 100
    assert [name for name, entry in derived.items() if table.get(name) != entry] == []


@pytest.mark.parametrize("path", PAGES, ids=PAGE_NAMES)
def test_links_and_paths_exist(path):
    text = path.read_text(encoding="utf-8")
    for link in re.findall(r"\]\(([^)#]+)\)", text):
        assert "://" in link or (path.parent / link).exists(), link
    for name in re.findall(r"`((?:wrf_mi|scenes|plugins|tests|docs|notebooks|benchmarks)/[\w./-]*)[`:]", text):
        assert (CHECKOUT / name).exists(), name


def test_gaussians_page_states_the_defaults_and_constants():
    rows = cell_rows((DOCS / "gaussians.md").read_text(encoding="utf-8"))
    constants, settings = ([row for row in rows if row[0].isupper() == upper] for upper in (True, False))
    assert constants
    assert settings
    for name, value, where, *_ in constants:
        module = importlib.import_module(where.removesuffix(".py").replace("/", "."))
        assert float(value) == getattr(module, name), name
    defaults = dict(line.split("=", 1) for line in describe(TrainConfig()).splitlines())
    for name, value, *_ in settings:
        assert value == defaults.get(name), name


def test_results_page_names_every_case():
    (table,) = re.findall(
        r"^\| cases and checks .*?(?=\n\n)", (DOCS / "results.md").read_text("utf-8"), re.M | re.DOTALL
    )
    assert sorted(re.findall(r"`([^`]+)`", table)) == sorted([*CASES, *CHECKS])


def test_notebooks_are_stored_without_output_unless_they_require_a_package():
    notebooks = {path.name: json.loads(path.read_text(encoding="utf-8")) for path in CHECKOUT.glob("notebooks/*.ipynb")}
    assert notebooks
    for name, notebook in notebooks.items():
        executed = any(cell.get("outputs") or cell.get("execution_count") for cell in notebook["cells"])
        assert executed == bool(notebook["metadata"].get("requires")), name


EARLIER = sorted((CHECKOUT / "benchmarks" / "results" / "earlier").glob("*.json"))
"""What was measured at a commit, and is kept as it was found then."""
DECIMAL = re.compile(r"\d\.\d")
BLOCK = re.compile(r"<!-- ([\w/-]+) -->\n.*?<!-- /\1 -->", re.DOTALL)
STATED = {
    *(("data.md", "name"), ("data.md", "task"), ("export.md", "format"), ("gaussians.md", "constant")),
    *(("gaussians.md", "setting"), ("joint.md", "setting"), ("plugins.md", "parameter")),
}
"""Page and first cell of tables of definitions, settings and bounds, which nobody measures."""


def unsourced(text: str, page: str) -> list[str]:
    """First lines of the tables with decimal figures outside blocks that are made from results."""
    tables = re.findall(r"(?:^ *\|.*\n?)+", BLOCK.sub("", text), re.MULTILINE)
    first = {table: table.strip().split("\n")[0] for table in tables if DECIMAL.search(table)}
    return [line for line in first.values() if (page, line.split("|")[1].strip()) not in STATED]


def earlier_block(name: str, result: Mapping[str, Any]) -> str:
    """The block of a document that shows an earlier measurement."""
    cells = [result["columns"], ["---"] * len(result["columns"]), *result["rows"]]
    table = "\n".join("|" + "".join(f" {cell} |" if cell else " |" for cell in row) for row in cells)
    source = f"Measured {result['date']} (commit {result['commit']})"
    source += f" by `{result['command']}`." if result["command"] else "."
    return f"<!-- earlier/{name} -->\n{table}\n\n{source}\n<!-- /earlier/{name} -->"


@pytest.mark.parametrize("path", PAGES, ids=PAGE_NAMES)
def test_measured_tables_are_made_from_results(path):
    text = prose(path)
    assert unsourced(text, path.name) == []
    assert BLOCK.findall(text) == re.findall(r"<!-- ([\w-][\w/-]*) -->", text)


@pytest.mark.parametrize("path", EARLIER, ids=lambda path: path.stem)
def test_earlier_measurements_are_stated_and_shown(path):
    result = json.loads(path.read_text(encoding="utf-8"))
    for measurement in result.get("measurements", [result]):
        assert re.fullmatch(r"\d{4}-\d{2}-\d{2} [0-9a-f]{7,40}", f"{measurement['date']} {measurement['commit']}")
        assert measurement.get("rows") or (measurement["what"] and measurement["figures"] not in ([], {})), measurement
    if "measurements" not in result:
        assert earlier_block(path.stem, result) in (CHECKOUT / result["page"]).read_text(encoding="utf-8")


def test_table_without_a_result_is_found():
    table = "| what | error |\n| --- | --- |\n| a | 0.1 |"
    assert unsourced(f"By `wrf-mi bench stress`:\n\n{table}\n\nSmall.", "page.md") == ["| what | error |"]
    for text in (f"<!-- made -->\n{table}\n<!-- /made -->", table.replace("0.1", "one")):
        assert unsourced(text, "page.md") == []
