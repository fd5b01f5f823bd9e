"""Sphinx extension: docstrings are text with code in backticks, without reStructuredText's special characters.

Formulas such as |R|^2 and names such as x_ are written as they read in the source.
"""

from __future__ import annotations

import re
from typing import Any

from sphinx.application import Sphinx

KEPT = re.compile(r"(``.*?``|`[^`]*`|(?<![\w*])\*\*?\w[^*]*\w\*\*?(?!\w))")
"""Code and emphasis."""


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the extension; napoleon, which finds the sections, comes first."""
    app.connect("autodoc-process-docstring", _escape, priority=900)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def _escape(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Escape bars, asterisks and trailing underscores outside of code and emphasis."""
    for number, line in enumerate(lines):
        if line.lstrip().startswith((">>>", "...", "..")):
            continue
        pieces = KEPT.split(line)
        pieces[::2] = [re.sub(r"(?<!\\)([|*])", r"\\\1", piece) for piece in pieces[::2]]
        pieces[::2] = [re.sub(r"(?<=\w)_(?=[\s,.;:)]|$)", r"\\_", piece) for piece in pieces[::2]]
        lines[number] = "".join(pieces)
