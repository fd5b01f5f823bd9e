"""The page of a view: one HTML document with plotly.js, its data and its script."""

from __future__ import annotations

import html
import json
from functools import cache
from importlib import import_module
from importlib.resources import files
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import to_hex

from ..core import InputError
from ..scene.preview import ENDS, SPAN_DB
from .content import MapContent, MaterialMesh, RowsContent, ViewContent
from .pack import packed

SCALES = {"strength": "viridis", "gain": "plasma", "error": "YlOrRd", "map": "turbo"}
"""Colour map of each quantity."""
STOPS = 12
"""Colours of a scale, between which the page interpolates."""
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


@cache
def plotly_js() -> str:
    """The source of plotly.js.

    Raises:
        InputError: plotly is not installed.
    """
    try:
        return str(import_module("plotly.offline").get_plotlyjs())
    except ModuleNotFoundError:
        raise InputError("views need plotly; install it: pip install 'wrf-mi[view]'") from None


def page(content: ViewContent) -> str:
    """The document.

    Raises:
        InputError: plotly is not installed.
    """
    names = ("page.html", "page.css", "tools.js", "page.js")
    template, style, tools, script = (files(__package__).joinpath(name).read_text("utf-8") for name in names)
    # No text of the data can end the element that holds it.
    data = json.dumps(page_data(content), allow_nan=False).replace("<", "\\u003c")
    fields = {
        "title": html.escape(content.title),
        "style": style,
        "plotly": plotly_js(),
        "data": data,
        "tools": tools,
        "script": script,
    }
    pieces = template.split("%%")  # texts at even places, names of fields at odd ones
    return "".join(fields[piece] if index % 2 else piece for index, piece in enumerate(pieces))


def page_data(content: ViewContent) -> dict[str, Any]:
    """Plain data of the page; arrays as of `packed`."""
    rows, gaussians, paths, scene = content.rows, content.gaussians, content.paths, content.scene
    colours = _material_colours(content)
    return {
        "title": content.title,
        "notes": content.notes,
        "scales": {name: [to_hex(c) for c in colormaps[m](np.linspace(0, 1, STOPS))] for name, m in SCALES.items()},
        "span_db": SPAN_DB,
        "ends": {name: colour for name, _, colour in ENDS},
        "receivers": {"names": list(content.receivers), "position": packed(content.receivers_m)},
        "meshes": [] if scene is None else [_mesh(mesh, colours[mesh.material]) for mesh in scene.meshes],
        "edges": None if scene is None else packed(scene.edges_m),
        "rows": None if rows is None else _rows(rows),
        "gaussians": None
        if gaussians is None
        else {
            "position": packed(gaussians.position_m),
            "scale": packed(np.log(np.maximum(gaussians.scale_m, 1e-9))),
            "rotation": packed(gaussians.rotation_xyzw),
            "strength": packed(gaussians.strength_db),
            "total": gaussians.total,
        },
        "paths": None
        if paths is None
        else {
            **{name: packed(getattr(paths, name)) for name in ("tx", "rx", "order", "kind")},
            "kinds": list(paths.kinds),
            "gain": packed(paths.gain_db),
            "length": packed(paths.length_m),
            "corners": packed(paths.corners_m),
        },
        "maps": [_map(one) for one in content.maps],
        "quantities": _quantities(content.maps),
    }


def _mesh(mesh: MaterialMesh, colour: str) -> dict[str, Any]:
    return {
        "material": mesh.material,
        "ceiling": mesh.ceiling,
        "colour": colour,
        "corners": packed(mesh.corners_m),
        "surface": packed(mesh.surface),
        "names": list(mesh.names),
    }


def _material_colours(content: ViewContent) -> dict[str, str]:
    names = [] if content.scene is None else sorted({mesh.material for mesh in content.scene.meshes})
    others = [name for name in names if name not in MATERIALS]
    colours = {name: OTHER_MATERIALS[index % len(OTHER_MATERIALS)] for index, name in enumerate(others)}
    return MATERIALS | colours


def _rows(rows: RowsContent) -> dict[str, Any]:
    received = rows.score[np.isfinite(rows.score)]
    low, high = np.percentile(received, [2, 98]) if received.size else (0.0, 1.0)
    return {
        "row": packed(rows.row),
        "position": packed(rows.tx_pos_m),
        "score": packed(rows.score),
        "range": [float(low), float(high)],
        "label": rows.label,
        "digits": rows.digits,
        "higher_is_better": rows.higher_is_better,
        "stored": packed(rows.stored),
        "observed": rows.observed,
        "quantity": rows.quantity,
    }


def _map(one: MapContent) -> dict[str, Any]:
    return {
        "name": one.name,
        "height": one.height_m,
        "x": packed(one.x_m),
        "y": packed(one.y_m),
        "z": None if one.z_m is None else packed(one.z_m),
        "receivers": list(one.receivers),
        "values": {name: packed(values) for name, values in one.values.items()},
    }


def _quantities(maps: list[MapContent]) -> dict[str, Any]:
    """Label and common range of the colours of each quantity of all maps."""
    found: dict[str, Any] = {}
    for name in dict.fromkeys(name for one in maps for name in one.values):
        every = np.concatenate([one.values[name].ravel() for one in maps if name in one.values])
        known = every[np.isfinite(every)]
        low, high = np.percentile(known, [1, 99]) if known.size else (0.0, 1.0)
        label = next(one.labels[name] for one in maps if name in one.labels)
        found[name] = {"label": label, "range": [float(low), float(high)]}
    return found
