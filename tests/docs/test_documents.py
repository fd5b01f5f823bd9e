"""README and documents: code defines its names, no folder is written twice, figures in the prose have a source."""

import ast
import itertools
import json
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
import yaml
from documents import CHECKOUT, DOCS, PAGE_NAMES, PAGES, README, blocks

PARALLEL = 0.02
"""Relative difference of figures after a fit whose parallel sums differ in the last digits: 1.4 % was seen."""
CONTINUED = {"gaussians.md": README}
"""Pages whose code goes on from that of another one."""
WRITES = {"plan_sweep": 0, "make_scene": 1, "edit_scene": 1, "compare": 1}
"""Functions that write a folder, and the place of its name among their arguments."""


def script(page: Path) -> str:
    """All Python code of a page, as a reader runs it from the top."""
    pages = [page] if page.name not in CONTINUED else [CONTINUED[page.name], page]
    return "\n".join(code for part in pages for code in blocks(part, "python"))


def undefined(scripts: Mapping[str, str], folder: Path) -> list[str]:
    """Names that scripts do not define, and errors of syntax, each behind the name of its script."""
    for name, code in scripts.items():
        (folder / f"{name}.py").write_text(code)
    command = ["ruff", "check", "--isolated", "--no-cache", "--select", "F821,F823", "--output-format", "concise", "."]
    done = subprocess.run([sys.executable, "-m", *command], cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode in (0, 1), done.stderr
    return [line for line in done.stdout.splitlines() if re.match(r"[\w.-]+\.py:", line)]


def test_code_of_documents_defines_its_names(tmp_path):
    scripts = {name.replace("/", "-"): script(page) for name, page in zip(PAGE_NAMES, PAGES, strict=True)}
    assert undefined(scripts, tmp_path) == []


def test_code_with_undefined_names_is_found(tmp_path):
    missed = undefined({"a": "import os\nprint(os.name, positions)\n", "b": "print(\n"}, tmp_path)
    assert [line[:2] for line in missed] == ["a.", "b."]


@pytest.mark.slow
def test_training_from_python_prints_what_the_page_states(capsys):
    code = script(DOCS / "joint.md")
    documented = [float(number) for number in re.findall(r"^print\(.*\)  # ([\d.]+)", code, re.MULTILINE)]
    assert len(documented) == 2
    exec(compile(code, "docs/joint.md", "exec"), {})
    printed = [float(line) for line in capsys.readouterr().out.splitlines()]
    assert printed == pytest.approx(documented, rel=PARALLEL)


def written(page: Path) -> Iterator[str]:
    """Folders that the commands and the code of a page write; a name with a suffix is a file, which is replaced."""
    for block in blocks(page, "sh"):
        for line in block.splitlines():
            words = shlex.split(line, comments=True)
            yield from (value for option, value in itertools.pairwise(words) if option == "--out")
    code = "\n".join(blocks(page, "python"))
    for call in ast.walk(ast.parse(code)):
        if isinstance(call, ast.Call):
            place = WRITES.get(ast.unparse(call.func).rpartition(".")[2], len(call.args))
            if place < len(call.args) and isinstance(call.args[place], ast.Constant):
                yield str(ast.literal_eval(call.args[place]))
            named = (word.value for word in call.keywords if word.arg == "out")
            yield from (str(value.value) for value in named if isinstance(value, ast.Constant))


def test_no_folder_is_written_twice():
    """A run, a scene or a sweep that exists is refused: a reader of one page could not follow the next."""
    places: dict[str, list[str]] = {}
    for page in PAGES:
        for folder in written(page):
            if not re.search(r"\.\w+$", folder):
                places.setdefault(folder, []).append(page.name)
    assert {"runs/script", "runs/first"} <= set(places)
    assert {folder: pages for folder, pages in places.items() if len(pages) > 1} == {}


RESULTS = CHECKOUT / "benchmarks" / "results"
UNIT = r"(?:ms|s|min|minutes?|seconds?|hours?|dB|%|kB|MB|GB|GiB|MiB|times|mm|cm|m)(?!\w)"
FIGURE = re.compile(
    rf"(?<![\w.^/-])-?\d[\d,]*(?:\.\d+(?:e-?\d+)?(?![\w.]*\.\d)| (?=(?:to|and) \d[\d,.]* {UNIT})| {UNIT})"
)
"""A number with decimals, or before a unit; not part of a name, a version or a power."""
LEVEL = re.compile(r"\b9[05] %(?= (?:bootstrap |Wilson |distribution-free )*(?:interval|region))")
"""Levels of intervals and regions, which are definitions."""
KINDS = ("definition", "data", "published", "standard", "version")
"""What a figure is that nobody measures here: a setting, limit or worked example; a property of a data set; a figure of
a paper; of physics or a standard; a version."""
ABOUT = ("page", "command", "commit", "date", "machine", "versions")
"""Entries of a result that are none of its figures."""


def prose(text: str) -> str:
    """The text without tables, code, made blocks, links' targets and headings, in single spaces."""
    text = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    text = re.sub(r"<!-- ([\w/+-]+) -->.*?<!-- /\1 -->", "", text, flags=re.DOTALL)
    text = re.sub(r"^(?: {4}|\||#).*$", "", text, flags=re.MULTILINE)
    text = re.sub(r"`[^`]*`", "", re.sub(r"\]\([^)]*\)", "]", text))
    return " ".join(re.sub(r"^ *(?:[-*]|\d+\.) ", "", text, flags=re.MULTILINE).split())


def stated(page: Path) -> list[dict[str, Any]]:
    """Entries of the page's file: a ``text`` of the prose, and its ``result`` or the kind it ``is``."""
    name = page.relative_to(CHECKOUT if page.parent == CHECKOUT else CHECKOUT / "docs").with_suffix(".yml")
    path = Path(__file__).parent / "figures" / name
    return list(yaml.safe_load(path.read_text(encoding="utf-8"))) if path.exists() else []


def numbers(value: Any) -> Iterator[float]:
    """All numbers in a result, those in its texts included."""
    if isinstance(value, dict | list):
        inner = [entry for key, entry in value.items() if key not in ABOUT] if isinstance(value, dict) else value
        for entry in inner:
            yield from numbers(entry)
    elif isinstance(value, str):
        yield from (float(number) for number in re.findall(r"-?\d+(?:\.\d+)?(?:e[+-]?\d+)?", value.replace(",", "")))
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield float(value)


def unfounded(text: str, figures: list[float]) -> list[str]:
    """Numbers of a text that no number of a result gives, rounded to their digits; a share may stand for per cent."""
    missing = []
    for shown in re.findall(r"(?<![\w.])\d[\d,]*(?:\.\d+)?(?:e-?\d+)?", text):
        number, decimals = float(shown.replace(",", "")), len(shown.partition("e")[0].partition(".")[2])
        half = 0.5 * 10.0**-decimals * (10 ** float(shown.partition("e")[2]) if "e" in shown else 1) * (1 + 1e-6)
        if not any(abs(abs(figure) * factor - number) <= half for figure in figures for factor in (1, 100)):
            missing.append(shown)
    return missing


@pytest.mark.parametrize("page", PAGES, ids=PAGE_NAMES)
def test_figures_have_a_source(page):
    left = prose(page.read_text(encoding="utf-8"))
    for entry in stated(page):
        text = prose(entry["text"])
        assert text in left, f"no longer in {page.name}: {text}"
        left = left.replace(text, "…", 1)
        if "result" in entry:
            names = [entry["result"]] if isinstance(entry["result"], str) else entry["result"]
            results = [json.loads((RESULTS / name).read_text(encoding="utf-8")) for name in names]
            figures = [number for result in results for number in numbers(result)]
            assert unfounded(text, figures) == [], f"not in {entry['result']}: {text}"
        else:
            assert entry["is"] in KINDS, entry
    left = LEVEL.sub("", left)
    assert [left[max(at.start() - 60, 0) : at.end() + 20] for at in FIGURE.finditer(left)] == []


def test_figures_without_a_source_are_found():
    assert FIGURE.search(prose("The error is 3.2 dB."))
    assert FIGURE.search(prose("It takes 3 to 4 minutes."))
    assert not FIGURE.search(prose("See `0.3 s`, eq. 4 and\n\n| a | 0.1 |\n"))
    assert unfounded("a median of 0.91 and 3 %", [0.914, 0.031]) == []
    assert unfounded("a median of 0.92 and 3 %", [0.914, 0.031]) == ["0.92"]
