"""Sphinx extension: links from documents to files of the checkout that are no pages of the site.

Documents are read on GitHub, too, where they link to notebooks, tables and source files by relative paths. On the site
a notebook is its executed page, the tables are the page of tables, the README is the front page, and a source file is
a download. A link to a folder becomes plain text.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

LINK = re.compile(r"(?<!!)\[([^\]]+)\]\(([^)#\s]+)(#[\w-]+)?\)")


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the extension."""
    app.connect("source-read", _rewrite)
    app.connect("include-read", _rewrite_included)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def _rewrite(app: Sphinx, name: str, source: list[str]) -> None:
    if not name.startswith("notebooks/"):
        source[0] = on_site(source[0], Path(app.srcdir), (Path(app.srcdir) / name).parent)


def _rewrite_included(app: Sphinx, path: Path, parent: str, content: list[str]) -> None:
    content[0] = on_site(content[0], Path(app.srcdir), (Path(app.srcdir) / path).resolve().parent)


def on_site(text: str, docs: Path, folder: Path) -> str:
    """Text of a document in ``folder`` with its links to files outside ``docs`` as links of the site."""

    def replaced(found: re.Match[str]) -> str:
        label, link, anchor = found.group(1), found.group(2), found.group(3) or ""
        # A page that is called by its file name is called by its title on the site.
        shown = "" if label in {Path(link).name, f"docs/{Path(link).name}"} and link.endswith(".md") else label
        path = (folder / link).resolve()
        if "://" in link or not path.exists():
            return found.group(0)
        if path.is_relative_to(docs):
            # From the top, as those of an included file are relative to the page that includes it.
            return f"[{shown}](/{path.relative_to(docs)}{anchor})"
        checkout = docs.parent
        tables = checkout / "benchmarks/table"
        pages = {checkout / "README.md": "/index.md", tables: "/results.md", tables / "README.md": "/results.md"}
        if path in pages:
            return f"[{label}]({pages[path]})"
        if path.parent == checkout / "notebooks":
            return f"[{label}](/notebooks/{path.name})"
        if path.is_dir():
            return f"[{label}](/notebooks/index.md)" if path == checkout / "notebooks" else label
        return found.group(0)

    return LINK.sub(replaced, text)
