"""Measured tables of the documents are made from stored results, or state how and when they were measured."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from test_readme import CHECKOUT, DOCUMENTS, prose

DECIMAL = re.compile(r"\d\.\d")
SOURCE = re.compile(r"`(?:wrf-mi|make) [^`]+`|\(commit [0-9a-f]{7}\)|[Tt]he commands:|Measured at two commits")
"""A command, or the commit of a measurement."""
STATED = {
    *(("conventions.md", "score"), ("correction.md", "part"), ("data.md", "name"), ("data.md", "task")),
    *(("export.md", "format"), ("joint.md", "setting"), ("locate.md", "column"), ("maps.md", "variable")),
    *(
        ("numerics.md", ""),
        ("model.md", "constant"),
        ("plugins.md", "parameter"),
        ("speed.md", "omitted"),
        ("tables.md", "question"),
    ),
}
"""Page and first cell of tables of definitions, settings and bounds, which nobody measures."""


def unsourced(text: str, page: str) -> list[str]:
    """First lines of the tables with decimal figures outside markers, and without a source in a paragraph beside."""
    text = re.sub(r"<!-- ([\w-]+) -->\n.*?<!-- /\1 -->", "", text, flags=re.DOTALL)
    parts = [part for part in re.split(r"\n\s*\n", text) if part.strip() and not part.startswith("![")]
    found = []
    for number, part in enumerate(parts):
        lines = part.strip("\n").split("\n")
        first = next((at for at, line in enumerate(lines) if line.lstrip().startswith("|")), None)
        if first is None or not DECIMAL.search("\n".join(lines[first:])):
            continue
        beside = " ".join([*parts[max(number - 1, 0) : number], *lines[:first], *parts[number + 1 : number + 2]])
        beside = " ".join(line for line in beside.split("\n") if not line.lstrip().startswith("|"))
        if not SOURCE.search(beside) and (page, lines[first].split("|")[1].strip()) not in STATED:
            found.append(lines[first])
    return found


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: str(path.relative_to(CHECKOUT)))
def test_measured_tables_have_a_source(path: Path) -> None:
    assert unsourced(prose(path), path.name) == []


def test_table_without_source_is_found() -> None:
    table = "| what | error |\n| --- | --- |\n| a | 0.1 |"
    assert unsourced(f"Errors:\n\n{table}\n\nSmall.", "page.md") == ["| what | error |"]
    for text in (
        f"By `wrf-mi bench stress`:\n\n{table}",
        f"{table}\n\nMeasured 2026-01-01 (commit 0123abc).",
        f"<!-- made -->\n{table}\n<!-- /made -->",
        table.replace("0.1", "one"),
    ):
        assert unsourced(text, "page.md") == []
