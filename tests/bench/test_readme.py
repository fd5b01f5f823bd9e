"""README and documents: scripts run, commands parse, links exist, numbers equal the stored ones."""

from __future__ import annotations

import argparse
import importlib
import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from documents import blocks
from PIL import Image
from wrf_mi_bench.bench import CASES, CHECKS
from wrf_mi_bench.command import TABLES

from wrf_mi.cli.main import build_parser
from wrf_mi.core import Receiver, Record
from wrf_mi.core.settings import describe, with_settings
from wrf_mi.datasets import write_spectrum_folder
from wrf_mi.gaussians import FIELDS
from wrf_mi.models import MODELS
from wrf_mi.training.config import TrainConfig

CHECKOUT = Path(__file__).resolve().parents[2]
README = CHECKOUT / "README.md"
PAGES = sorted(
    page
    for page in (CHECKOUT / "docs").rglob("*.md")
    if page.relative_to(CHECKOUT / "docs").parts[0] not in {"_build", "api", "notebooks"}
)
DOCUMENTS = [README, *PAGES]
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
    return [[name, *(cell.strip().strip("`") for cell in rest.split(" | "))] for name, rest in rows]


@pytest.fixture
def tiny_folder(tmp_path: Path) -> Path:
    """A data set of the same form as rfid-lab, small enough to train on in a moment."""
    rng = np.random.default_rng(3)
    receiver = Receiver("gateway1", np.array([5.0, 0.3, 0.0]), np.array([0.0, 0.6, 0.0, 0.8]))
    record = Record(
        name="tiny",
        task="spectrum",
        tx_pos_m=rng.uniform(-0.5, 1.0, (ROWS, 3)),
        receivers=(receiver,),
        observation=rng.random((1, ROWS, HEIGHT, WIDTH)).astype(np.float32),
        official=(np.arange(ROWS - 3), np.arange(ROWS - 3, ROWS)),
    )
    return write_spectrum_folder(tmp_path / "tiny", record)


def test_scripts_of_the_readme_run(tiny_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    """Scripts run unchanged except data set and number of steps."""
    script = "\n".join(blocks(README, "python"))
    for shown, tiny in (('"rfid-lab"', repr(str(tiny_folder))), ('"steps=6000"', '"steps=2"')):
        assert script.count(shown) == 1
        script = script.replace(shown, tiny)
    script += "\n".join(blocks(CHECKOUT / "docs" / "gaussians.md", "python"))
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    exec(compile(script, str(README), "exec"), names)
    metrics = json.loads((tmp_path / "runs" / "script" / "metrics.json").read_text())
    assert metrics["steps"] == 2
    printed = capsys.readouterr().out
    for block in (metrics["ssim"], metrics["reference"]["idw4"]):
        assert str(block["median"]) in printed
    assert names["spectrum"].shape == (HEIGHT, WIDTH)
    assert names["spectra"].shape == (3, HEIGHT, WIDTH)
    # The parts that were put in are the ones that trained.
    assert names["trainer"].field is names["field"]
    assert names["trainer"].state.gaussians == 200
    with Image.open(tmp_path / "spectrum.png") as picture:
        assert np.ptp(np.asarray(picture.convert("L"))) > 100


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda p: str(p.relative_to(CHECKOUT)))
def test_commands_parse(path: Path) -> None:
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
        if given := getattr(parsed, "set", []):
            entry = MODELS[parsed.model or "wrf-gs+"]
            with_settings(TrainConfig() if entry.name in FIELDS else entry.settings(), given)
        for name in getattr(parsed, "names", []):
            assert name in {*CASES, *CHECKS, TABLES}, line


def test_readme_shows_all_main_commands() -> None:
    shown = {shlex.split(line, comments=True)[1] for line in commands(README) if line.startswith("wrf-mi")}
    assert shown >= {"doctor", "data", "train", "evaluate", "predict", "compare", "demo", "mesh", "trace", "sweep"}
    assert {"make demo", "make test"} <= {line.partition("#")[0].strip() for line in commands(README)}


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda p: str(p.relative_to(CHECKOUT)))
def test_links_and_paths_exist(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    links = [link for link in re.findall(r"\]\(([^)#]+)\)", text) if "://" not in link]
    for link in links:
        assert (path.parent / link).exists(), link
    named = re.findall(r"`((?:wrf_mi|scenes|plugins|tests|docs|notebooks|benchmarks)/[\w./-]*)[`:]", text)
    for name in named:
        assert (CHECKOUT / name).exists(), name


def test_gaussians_page_states_the_defaults_and_constants() -> None:
    rows = cell_rows((CHECKOUT / "docs" / "gaussians.md").read_text(encoding="utf-8"))
    constants = [row for row in rows if row[0].isupper()]
    settings = [row for row in rows if not row[0].isupper()]
    assert constants
    assert settings
    for name, value, where, *_ in constants:
        module = importlib.import_module(where.removesuffix(".py").replace("/", "."))
        assert float(value) == getattr(module, name), name
    defaults = dict(line.split("=", 1) for line in describe(TrainConfig()).splitlines())
    for name, value, *_ in settings:
        assert value == defaults.get(name), name


def test_results_page_names_every_case() -> None:
    rows = cell_rows((CHECKOUT / "docs" / "results.md").read_text(encoding="utf-8"))
    assert [name for name, *_ in rows] == [*CASES, *CHECKS]


def test_notebooks_are_stored_without_output() -> None:
    paths = list((CHECKOUT / "notebooks").glob("*.ipynb"))
    assert paths
    for path in paths:
        for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
            assert not cell.get("outputs"), path.name
            assert cell.get("execution_count") is None, path.name
