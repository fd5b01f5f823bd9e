"""Measured tables of the documents are made from stored results."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from test_readme import CHECKOUT, DOCUMENTS, prose

EARLIER = sorted((CHECKOUT / "benchmarks" / "results" / "earlier").glob("*.json"))
"""What was measured at a commit, and is kept as it was found then."""
DECIMAL = re.compile(r"\d\.\d")
BLOCK = re.compile(r"<!-- ([\w/-]+) -->\n.*?<!-- /\1 -->", re.DOTALL)
STATED = {
    *(("conventions.md", "score"), ("correction.md", "part"), ("data.md", "name"), ("data.md", "task")),
    *(("export.md", "format"), ("joint.md", "setting"), ("locate.md", "column"), ("maps.md", "variable")),
    *(("changelog.md", "0.1.0"), ("gaussians.md", "constant"), ("gaussians.md", "setting"), ("numerics.md", "")),
    *(("plugins.md", "parameter"), ("speed.md", "omitted")),
    *(("mesh.md", "you have"), ("receiver.md", "what"), ("check.md", "kind"), ("own-data.md", "your table")),
    *(("data.md", "columns of receivers"), ("data.md", "columns of rows")),
}
"""Page and first cell of tables of definitions, settings and bounds, which nobody measures."""


def unsourced(text: str, page: str) -> list[str]:
    """First lines of the tables with decimal figures outside blocks that are made from results."""
    tables = re.findall(r"(?:^ *\|.*\n?)+", BLOCK.sub("", text), re.MULTILINE)
    first = {table: table.strip().split("\n")[0] for table in tables if DECIMAL.search(table)}
    return [line for line in first.values() if (page, line.split("|")[1].strip()) not in STATED]


def made(name: str, result: Mapping[str, Any]) -> str:
    """The block of a document that shows an earlier measurement."""
    cells = [result["columns"], ["---"] * len(result["columns"]), *result["rows"]]
    table = "\n".join("|" + "".join(f" {cell} |" if cell else " |" for cell in row) for row in cells)
    source = f"Measured {result['date']} (commit {result['commit']})"
    source += f" by `{result['command']}`." if result["command"] else "."
    return f"<!-- earlier/{name} -->\n{table}\n\n{source}\n<!-- /earlier/{name} -->"


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: str(path.relative_to(CHECKOUT)))
def test_measured_tables_are_made_from_results(path: Path) -> None:
    text = prose(path)
    assert unsourced(text, path.name) == []
    assert BLOCK.findall(text) == re.findall(r"<!-- ([\w-][\w/-]*) -->", text)


@pytest.mark.parametrize("path", EARLIER, ids=lambda path: path.stem)
def test_earlier_measurements_are_stated_and_shown(path: Path) -> None:
    result = json.loads(path.read_text(encoding="utf-8"))
    for one in result.get("measurements", [result]):
        assert re.fullmatch(r"\d{4}-\d{2}-\d{2} [0-9a-f]{7}", f"{one['date']} {one['commit']}"), one
        assert one.get("rows") or (one["what"] and one["figures"] not in ([], {})), one
    if "measurements" not in result:
        assert made(path.stem, result) in (CHECKOUT / result["page"]).read_text(encoding="utf-8")


def test_table_without_a_result_is_found() -> None:
    table = "| what | error |\n| --- | --- |\n| a | 0.1 |"
    assert unsourced(f"By `wrf-mi bench stress`:\n\n{table}\n\nSmall.", "page.md") == ["| what | error |"]
    for text in (f"<!-- made -->\n{table}\n<!-- /made -->", table.replace("0.1", "one")):
        assert unsourced(text, "page.md") == []
