"""Sphinx extension: tables of the kinds of faults and warnings of ``wrf-mi check``, made from the code.

A line ``<!-- kinds of findings: fault -->`` of a page becomes the table of that level; elsewhere it is a comment, and
``wrf-mi check --help`` prints the same text.
"""

from __future__ import annotations

import re
from typing import Any

from sphinx.application import Sphinx

from wrf_mi.apps.checking.scene_findings import KINDS
from wrf_mi.runs.sweep import markdown_table

MARK = re.compile(r"^<!-- kinds of findings: (\w+) -->$", re.MULTILINE)


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the extension."""
    app.connect("source-read", _insert)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def _insert(app: Sphinx, name: str, source: list[str]) -> None:
    source[0] = MARK.sub(lambda found: table(found[1]), source[0])


def table(level: str) -> str:
    """Markdown table of the kinds of a level."""
    rows = [[f"`{kind}`", description] for kind, (of, description) in KINDS.items() if of == level]
    return markdown_table(["kind", "what"], rows)
