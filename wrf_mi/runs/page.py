"""Parts of HTML pages that need no network: tables that sort, definitions, pictures; for laptops and telephones."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Mapping, Sequence
from importlib.resources import files
from typing import Any

from PIL import Image


def document(title: str, body: str) -> str:
    """HTML of a page with its style and script."""
    style, script = (files(__package__).joinpath(f"page.{kind}").read_text("utf-8") for kind in ("css", "js"))
    return f"""<!DOCTYPE html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{escaped(title)}</title>
<style>
{style}</style>
{body}
<script>
{script}</script>
</html>
"""


def definitions(facts: Mapping[str, str]) -> str:
    """Facts as a list of definitions; empty ones are left out."""
    terms = (f"<dt>{escaped(key)}</dt><dd>{escaped(words)}</dd>" for key, words in facts.items() if words)
    return f"<dl>{''.join(terms)}</dl>"


def sorted_table(columns: Mapping[str, str], rows: Sequence[Mapping[str, Any]], numeric: frozenset[str]) -> str:
    """Table that sorts by a click on a heading; columns without a value are left out."""
    filled = {key: title for key, title in columns.items() if any(row.get(key) is not None for row in rows)}
    buttons = {key: f'<button type="button">{escaped(title)}</button>' for key, title in filled.items()}
    head = "".join(f'<th scope="col"{_class(key, numeric)}>{button}</th>' for key, button in buttons.items())
    body = "\n".join("<tr>" + "".join(_cell(key, row.get(key), numeric) for key in filled) + "</tr>" for row in rows)
    shown = f'<table class="sorts"><thead><tr>{head}</tr></thead>\n<tbody>{body}</tbody></table>'
    return f'<div class="scroll">{shown}</div>'


def _class(key: str, numeric: frozenset[str]) -> str:
    return ' class="n"' if key in numeric else ""


def _cell(key: str, value: Any, numeric: frozenset[str]) -> str:
    """A value with four significant digits, empty where unknown; verdicts are coloured."""
    if value is None or value != value:  # NaN: not stated by another program
        return f"<td{_class(key, numeric)}></td>"
    if key == "verdict":
        return f'<td class="{escaped(str(value).partition(" ")[0])}">{escaped(value)}</td>'
    exact = f' data-value="{escaped(value)}"' if key in numeric else ""
    shown = f"{value:.4g}" if isinstance(value, float) else str(value)
    return f"<td{_class(key, numeric)}{exact}>{escaped(shown)}</td>"


def picture(png: bytes, title: str, alternative: str = "") -> str:
    """A picture with its heading, and what is seen in words for readers who do not see it; "": the heading."""
    with Image.open(io.BytesIO(png)) as opened:
        width, height = opened.size
    # On a telephone a wide picture keeps half its size, at which its texts are legible, and scrolls.
    size = f'width="{width}" height="{height}" style="--least: {width // 2}px"'
    data, words = base64.b64encode(png).decode(), escaped(alternative or title)
    shown = f'<img src="data:image/png;base64,{data}" {size} alt="{words}">'
    return f'<h3>{escaped(title)}</h3>\n<div class="scroll">{shown}</div>'


def escaped(value: Any) -> str:
    """Text of HTML."""
    return html.escape(str(value))
