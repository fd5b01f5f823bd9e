"""The page of a view: one HTML document with plotly.js, its figures as data, and its script."""

from __future__ import annotations

import html
import json
from functools import cache
from importlib import import_module
from importlib.resources import files
from typing import Any

import numpy as np

from ...core import InputError
from .content import ViewContent
from .figures import SceneFigure, observed_figure


@cache
def plotly_js() -> str:
    """The source of plotly.js; `InputError` where plotly is not installed."""
    try:
        return str(import_module("plotly.offline").get_plotlyjs())
    except ModuleNotFoundError:
        raise InputError("views need plotly; install it: pip install '.[view]'") from None


def page(content: ViewContent) -> str:
    """The document; `InputError` where plotly is not installed."""
    names = ("page.html", "page.css", "page.js")
    template, style, script = (files(__package__).joinpath(name).read_text("utf-8") for name in names)
    # No text of the data can end the element that holds it.
    data = json.dumps(page_data(content), allow_nan=False).replace("<", "\\u003c")
    texts = {"title": html.escape(content.title), "style": style, "plotly": plotly_js(), "data": data, "script": script}
    pieces = template.split("%%")  # texts at even places, names of fields at odd ones
    return "".join(texts[piece] if index % 2 else piece for index, piece in enumerate(pieces))


def page_data(content: ViewContent) -> dict[str, Any]:
    """Plain data of the page: both figures, what choices change in them, and texts."""
    scene = SceneFigure(content)
    traces, layout, observed = observed_figure(content)
    data: dict[str, Any] = {"traces": scene.traces, "layout": scene.layout(), "ellipsoids": scene.ellipsoids}
    data |= {"receivers": scene.receivers, "transmitters": scene.transmitters, "pairs": scene.pairs}
    data |= {"observedTraces": traces, "observedLayout": layout, "observed": observed, "choosable": scene.choosable}
    rows, texts = [], []
    if (shown := content.rows) is not None:
        rows = [f"row {row}" for row in shown.row[shown.stored]]
        scores = np.char.mod(f"%.{shown.digits}f", shown.score[:, shown.stored].T)
        texts = [
            [f"{row}, {shown.label} {score}, {name}" for score, name in zip(of_row, content.receivers, strict=True)]
            for row, of_row in zip(rows, scores, strict=True)
        ]
    return data | {"names": list(content.receivers), "notes": content.notes, "rows": rows, "texts": texts}
