"""Code of README and documents: names are defined, and no folder is written by two of their commands or scripts."""

from __future__ import annotations

import ast
import itertools
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from documents import blocks

CHECKOUT = Path(__file__).resolve().parents[2]
README = CHECKOUT / "README.md"
SITE = {"_build", "api", "notebooks"}
PAGES = [README, *(page for page in sorted((CHECKOUT / "docs").rglob("*.md")) if not SITE & set(page.parts))]
PARALLEL = 0.02
"""Relative difference of figures after a fit whose parallel sums differ in the last digits: 1.4 % was seen."""
CONTINUED = {"gaussians.md": README}
"""Pages whose code goes on from that of another one."""
WRITES = {"train": 1, "plan_sweep": 0, "make_scene": 1, "edit_scene": 1, "compare": 1}
"""Functions that write a folder, and the place of its name among their arguments."""


def script(page: Path) -> str:
    """All Python code of a page, as a reader runs it from the top."""
    pages = [page] if page.name not in CONTINUED else [CONTINUED[page.name], page]
    return "\n".join(code for one in pages for code in blocks(one, "python"))


def undefined(code: str) -> list[str]:
    """Names that code does not define, and errors of syntax."""
    command = ["ruff", "check", "--isolated", "--select", "F821,F823", "--output-format", "concise", "-"]
    done = subprocess.run([sys.executable, "-m", *command], input=code, capture_output=True, text=True, check=False)
    assert done.returncode in (0, 1), done.stderr
    return [line for line in done.stdout.splitlines() if line.startswith("-:")]


@pytest.mark.parametrize("page", [page for page in PAGES if script(page)], ids=lambda page: page.name)
def test_code_of_documents_defines_its_names(page: Path) -> None:
    assert undefined(script(page)) == []


def test_code_with_undefined_names_is_found() -> None:
    assert len(undefined("import os\nprint(os.name, positions)\n")) == 1
    assert len(undefined("print(\n")) == 1


@pytest.mark.slow
def test_training_from_python_prints_what_the_page_states(capsys: pytest.CaptureFixture[str]) -> None:
    code = script(CHECKOUT / "docs" / "joint.md")
    stated = [float(number) for number in re.findall(r"^print\(.*\)  # ([\d.]+)", code, re.MULTILINE)]
    assert len(stated) == 2
    exec(compile(code, "docs/joint.md", "exec"), {})
    printed = [float(line) for line in capsys.readouterr().out.splitlines()]
    assert printed == pytest.approx(stated, rel=PARALLEL)


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


def test_no_folder_is_written_twice() -> None:
    """A run, a scene or a sweep that exists is refused: a reader of one page could not follow the next."""
    places: dict[str, list[str]] = {}
    for page in PAGES:
        for folder in written(page):
            if not re.search(r"\.\w+$", folder):
                places.setdefault(folder, []).append(page.name)
    assert {"runs/script", "runs/first"} <= set(places)
    assert {folder: pages for folder, pages in places.items() if len(pages) > 1} == {}
