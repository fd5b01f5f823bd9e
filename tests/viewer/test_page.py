"""The page of a view: self-contained, escaped, complete, and small."""

import base64
import json
import re
import sys
from html.parser import HTMLParser
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from made_views import MARKUP, made_view

from wrf_mi.apps.viewer import page as page_module
from wrf_mi.apps.viewer import view as view_module
from wrf_mi.apps.viewer.figures import spec
from wrf_mi.apps.viewer.page import page, plotly_js
from wrf_mi.apps.viewer.view import View
from wrf_mi.core import InputError

FLOAT32 = 1e-6
"""Relative rounding of numbers of a page."""
DATA = r'<script id="content" type="application/json">(.*?)</script>'


def array_of(stored: dict[str, str]) -> np.ndarray:
    """What Plotly reads of an array."""
    shape = [int(size) for size in stored["shape"].split(",")]
    return np.frombuffer(base64.b64decode(stored["bdata"]), f"<{stored['dtype']}").reshape(shape)


def points_of(trace: dict[str, Any]) -> np.ndarray:
    """Points [n, 3] of a trace."""
    return np.stack([array_of(trace[axis]) for axis in "xyz"], axis=-1)


def data_of(text: str) -> dict[str, Any]:
    """Data in a page."""
    (data,) = re.findall(DATA, text, re.DOTALL)
    return dict(json.loads(data))


class Elements(HTMLParser):
    """Names and attributes of a page's elements, and the text of its heading."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.heading = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        self.heading += data if self.found and self.lasttag == "h1" and not self.heading else ""


@pytest.fixture(scope="module")
def text() -> str:
    return page(made_view())


@given(arrays(float, (3, 4), elements=st.floats(-1e6, 1e6) | st.just(np.nan)))
def test_arrays_of_a_page_are_rounded_to_float32(values):
    np.testing.assert_array_equal(array_of(spec(values)), values.astype(np.float32))


@given(arrays(int, (2, 3), elements=st.integers(0, 2**31)))
def test_integers_of_a_page_are_exact(values):
    np.testing.assert_array_equal(array_of(spec(values)), values)


def test_page_holds_plotly_and_refers_to_nothing_else(text):
    assert text.count(plotly_js()) == 1
    assert re.search(r"plotly\.js v\d", text)
    outside = text.replace(plotly_js(), "")
    assert not re.search(r"https?:", outside)
    outside = re.sub(DATA, "", outside, flags=re.DOTALL)  # base64 has slashes
    assert not re.search(r"[\"'(]//|@import|url\(", outside)
    loading = {"link", "iframe", "img", "object", "embed", "base", "video", "audio"}
    elements = Elements(outside).found
    assert not [tag for tag, attributes in elements if tag in loading or {"src", "href"} & attributes.keys()]
    (policy,) = [a["content"] for tag, a in elements if tag == "meta" and a.get("http-equiv")]
    assert policy.startswith("default-src 'none';")
    assert "http" not in policy


def test_markup_in_names_is_text(text):
    parsed = Elements(text.replace(plotly_js(), ""))
    assert parsed.heading == f"made {MARKUP}"
    assert [tag for tag, _ in parsed.found].count("script") == 3
    data = data_of(text)
    assert data["names"][0] == MARKUP
    assert data["notes"] == [f"A note {MARKUP}."]
    escaped = MARKUP.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    (receivers,) = [trace for trace in data["traces"] if trace["name"] == "receivers (2)"]
    assert receivers["text"][0] == escaped
    label = data["layout"]["updatemenus"][0]["buttons"][0]["label"]
    assert label.startswith(escaped[:20])
    assert "<" not in label


def test_page_holds_the_numbers_of_the_content(text):
    content, data = made_view(), data_of(text)
    counts = {"triangles": 5, "held_out_rows": 6, "transmitters": 3, "gaussians": 5, "paths": 12, "maps": 2}
    assert content.counts == counts
    traces = {trace["name"]: trace for trace in data["traces"] if trace["name"] != "map"}
    number = {trace["name"]: str(k) for k, trace in enumerate(data["traces"])}
    for mesh in content.scene.meshes:
        stored = traces[mesh.material + ", ceiling" * mesh.ceiling]
        faces = np.stack([array_of(stored[corner]) for corner in "ijk"], axis=-1)
        np.testing.assert_allclose(points_of(stored)[faces], mesh.corners_m, rtol=FLOAT32)
        assert (stored["color"], stored["visible"]) == (mesh.colour, "legendonly" if mesh.ceiling else True)
    rows, paths = content.rows, content.paths
    np.testing.assert_array_equal(array_of(traces["held-out rows (6)"]["customdata"]), rows.row)
    for receiver, score in enumerate(rows.score):
        shown = data["receivers"][receiver][number["held-out rows (6)"]]["marker.color"]
        np.testing.assert_allclose(array_of(shown), score, rtol=FLOAT32)
    ends = np.cumsum(paths.order + 2)
    for k, (tx, rx) in enumerate(zip(paths.tx, paths.rx, strict=True)):
        stored = data["pairs"][tx][rx][number[f"paths: {paths.kinds[paths.kind[k]]}"]]
        corners = paths.corners_m[ends[k] - paths.order[k] - 2 : ends[k]]
        np.testing.assert_allclose(points_of(stored)[:-1], corners, rtol=FLOAT32)
        assert array_of(stored["line.color"]) == pytest.approx(paths.gain_db[k])
        assert array_of(stored["customdata"]) == pytest.approx(paths.length_m[k])
    maps = [(k, trace) for k, trace in enumerate(data["traces"]) if trace["name"] == "map"]
    assert [trace["visible"] for _, trace in maps] == [True, False, False, False]
    for (k, trace), layer in zip(maps[::2], content.maps, strict=True):
        assert np.nanmax(array_of(trace["z"])) == layer.height_m
        for receiver, values in enumerate(layer.values["power_dbm"]):
            np.testing.assert_array_equal(array_of(data["receivers"][receiver][str(k)]["surfacecolor"]), values)


def test_axes_hold_all_that_is_shown(text):
    scene = data_of(text)["layout"]["scene"]
    content = made_view()
    for axis, values in zip("xyz", content.receivers_m.T, strict=True):
        low, high = scene[f"{axis}axis"]["range"]
        assert low <= values.min() <= values.max() <= high


def test_views_display_themselves_in_notebooks(text):
    shown = View(made_view())._repr_html_()
    (tag, attributes), *more = Elements(shown).found
    assert (tag, more) == ("iframe", [])
    assert attributes["srcdoc"] == text


def test_pages_have_a_largest_size(monkeypatch):
    monkeypatch.setattr(view_module, "LARGEST_BYTES", 1_000_000)
    with pytest.raises(InputError, match=r"view: \d\.\d MB, the limit is 1 MB; lower --max-transmitters"):
        _ = View(made_view()).html


def test_missing_plotly_is_named(monkeypatch):
    page_module.plotly_js.cache_clear()
    monkeypatch.setitem(sys.modules, "plotly.offline", None)
    with pytest.raises(InputError, match=r"views need plotly; install it: pip install '\.\[view\]'"):
        plotly_js()
