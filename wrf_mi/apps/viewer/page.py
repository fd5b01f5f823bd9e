"""The page of a view: one HTML document with plotly.js, its data, arrays in 16 bits as text, and its script."""

from __future__ import annotations

import base64
import html
import json
from dataclasses import fields, is_dataclass
from functools import cache
from importlib import import_module
from importlib.resources import files
from itertools import cycle
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import to_hex
from numpy.typing import ArrayLike, NDArray

from ...core import InputError
from ...scene.drawing import ENDS
from ...scene.preview import SPAN_DB
from .content import MapContent, ViewContent

SCALES = {"strength": "viridis", "gain": "plasma", "error": "YlOrRd", "map": "turbo"}  # colour map of each quantity
STOPS = 12  # colours of a scale, between which the page interpolates
MATERIALS = {
    "concrete": "#9aa0a6",
    "brick": "#b5603f",
    "plasterboard": "#d9d2c0",
    "wood": "#b08850",
    "chipboard": "#c49a6c",
    "plywood": "#c8a165",
    "glass": "#7fc4dd",
    "ceiling board": "#e4e2da",
    "floorboard": "#a9825a",
    "metal": "#5f6b7a",
    "marble": "#cfd3d6",
    "perfect": "#4b5563",
}
"""Colours of usual materials."""
OTHER_MATERIALS = ("#8da0cb", "#66c2a5", "#fc8d62", "#e78ac3", "#a6d854", "#e5c494", "#7d9cb5")
LARGEST = 65534  # number of steps of a range
MISSING = 65535  # code of a value that is not finite
SMALLEST_RANGE = 1e-300
"""Range below which numbers are packed as equal: the steps of a smaller one have few digits or underflow."""


@cache
def plotly_js() -> str:
    """The source of plotly.js; `InputError` where plotly is not installed."""
    try:
        return str(import_module("plotly.offline").get_plotlyjs())
    except ModuleNotFoundError:
        raise InputError("views need plotly; install it: pip install '.[view]'") from None


def page(content: ViewContent) -> str:
    """The document; `InputError` where plotly is not installed."""
    names = ("page.html", "page.css", "tools.js", "page.js")
    template, style, tools, script = (files(__package__).joinpath(name).read_text("utf-8") for name in names)
    # No text of the data can end the element that holds it.
    data = json.dumps(page_data(content), allow_nan=False).replace("<", "\\u003c")
    texts = {"title": html.escape(content.title), "style": style, "plotly": plotly_js()}
    texts |= {"data": data, "tools": tools, "script": script}
    pieces = template.split("%%")  # texts at even places, names of fields at odd ones
    return "".join(texts[piece] if index % 2 else piece for index, piece in enumerate(pieces))


def page_data(content: ViewContent) -> dict[str, Any]:
    """Plain data of the page: the content by the names of its fields, arrays as of `packed`, and colours."""
    data: dict[str, Any] = plain(content)
    if content.rows is not None:
        data["rows"]["range"] = _range(content.rows.score, 2)
    materials = set() if content.scene is None else {mesh.material for mesh in content.scene.meshes}
    others = sorted(materials - MATERIALS.keys())
    return data | {
        "scales": {name: [to_hex(c) for c in colormaps[m](np.linspace(0, 1, STOPS))] for name, m in SCALES.items()},
        "span_db": SPAN_DB,
        "ends": {name: colour for name, (_, colour) in ENDS.items()},
        "colours": MATERIALS | dict(zip(others, cycle(OTHER_MATERIALS), strict=False)),
        "quantities": _quantities(content.maps),
    }


def _quantities(maps: list[MapContent]) -> dict[str, Any]:
    """Label and common range of the colours of each quantity of all maps."""
    quantities: dict[str, Any] = {}
    for name in dict.fromkeys(name for content in maps for name in content.values):
        with_it = [content for content in maps if name in content.values]
        values = np.concatenate([content.values[name].ravel() for content in with_it])
        quantities[name] = {"label": with_it[0].labels[name], "range": _range(values, 1)}
    return quantities


def _range(values: NDArray[Any], tail: float) -> list[float]:
    """Ends of a colour scale that leave a percentage of the known values beyond either of them."""
    known = values[np.isfinite(values)]
    return np.percentile(known, [tail, 100 - tail]).tolist() if known.size else [0.0, 1.0]


def plain(value: Any) -> Any:
    """Values for JSON: dataclasses as dictionaries of their fields, arrays as of `packed`."""
    if is_dataclass(value):
        return {field.name: plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return packed(value) if isinstance(value, np.ndarray) else value


def packed(values: ArrayLike) -> dict[str, Any]:
    """Numbers as 16-bit codes of equal steps over their range, for ``unpack`` of ``tools.js``.

    Integers over a range of at most `LARGEST` are exact, other numbers are rounded to a 65534th of their range, and
    values that are not finite become NaN. ``codes`` are base64 of little-endian unsigned 16-bit integers c in the order
    of the last axis, of values ``low`` + c * ``step``, in the ``shape``.
    """
    array = np.asarray(values)
    numbers = array.astype(float)
    finite = np.isfinite(numbers)
    known = numbers[finite]
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 0.0)
    exact = array.dtype.kind in "iub" and high - low <= LARGEST
    step = 1.0 if exact or high - low < SMALLEST_RANGE else (high - low) / LARGEST
    codes = np.full(array.shape, MISSING, "<u2")
    codes[finite] = np.round((known - low) / step)
    text = base64.b64encode(codes.tobytes()).decode("ascii")
    return {"shape": list(array.shape), "low": low, "step": step, "codes": text}
