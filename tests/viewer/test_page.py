"""The page of a view: self-contained, escaped, complete, and small."""

import base64
import io
import json
import re
import sys
from html.parser import HTMLParser
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from made_views import MARKUP, made_view
from PIL import Image

from wrf_mi.apps.viewer import page as page_module
from wrf_mi.apps.viewer import view as view_module
from wrf_mi.apps.viewer.layers import png
from wrf_mi.apps.viewer.page import LARGEST, MISSING, SMALLEST_RANGE, packed, page, plotly_js
from wrf_mi.apps.viewer.view import View
from wrf_mi.core import InputError

ROUNDED = 0.51 / LARGEST
"""Largest error of a packed number as a share of the range: half a step, and rounding."""
DATA = r'<script id="content" type="application/json">(.*?)</script>'


def unpacked(stored: dict[str, Any]) -> np.ndarray:
    """What ``unpack`` of tools.js gives."""
    codes = np.frombuffer(base64.b64decode(stored["codes"]), "<u2").reshape(stored["shape"])
    return np.where(codes == MISSING, np.nan, stored["low"] + codes * stored["step"])


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


@example(np.full((3, 4), 5e-324) * np.eye(3, 4))
@given(arrays(float, (3, 4), elements=st.floats(-1e6, 1e6) | st.just(np.nan)))
def test_packed_numbers_keep_half_a_step(values):
    stored, finite = unpacked(packed(values)), np.isfinite(values)
    np.testing.assert_array_equal(np.isnan(stored), np.isnan(values))
    if finite.any():
        atol = ROUNDED * np.ptp(values[finite]) + SMALLEST_RANGE
        np.testing.assert_allclose(stored[finite], values[finite], rtol=1e-12, atol=atol)


def test_packed_integers_are_exact():
    values = np.array([[-3, 0], [7, LARGEST - 3]])
    np.testing.assert_array_equal(unpacked(packed(values)), values)
    assert unpacked(packed(np.zeros((0, 3)))).shape == (0, 3)


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
    assert data["receivers"][0] == MARKUP
    assert data["notes"] == [f"A note {MARKUP}."]


def test_page_holds_the_numbers_of_the_content(text):
    content, data = made_view(), data_of(text)
    counts = {"triangles": 5, "held_out_rows": 6, "transmitters": 3, "gaussians": 5, "paths": 12, "maps": 2}
    assert content.counts == counts
    for stored, mesh in zip(data["scene"]["meshes"], content.scene.meshes, strict=True):
        np.testing.assert_allclose(unpacked(stored["corners_m"]), mesh.corners_m, atol=4 * ROUNDED)
        assert (stored["material"], stored["ceiling"]) == (mesh.material, mesh.ceiling)
    np.testing.assert_array_equal(unpacked(data["rows"]["row"]), content.rows.row)
    np.testing.assert_allclose(unpacked(data["rows"]["score"]), content.rows.score, atol=ROUNDED)
    np.testing.assert_allclose(unpacked(data["gaussians"]["log_scale"]), content.gaussians.log_scale)
    assert data["gaussians"]["total"] == 9
    for name in ("tx", "rx", "order", "kind"):
        np.testing.assert_array_equal(unpacked(data["paths"][name]), getattr(content.paths, name))
    corners = unpacked(data["paths"]["corners_m"])
    assert len(corners) == (content.paths.order + 2).sum()
    np.testing.assert_allclose(corners, content.paths.corners_m, atol=4 * ROUNDED)
    for stored, layer in zip(data["maps"], content.maps, strict=True):
        assert stored["height_m"] == layer.height_m
        values = unpacked(stored["values"]["power_dbm"])
        np.testing.assert_allclose(values, layer.values["power_dbm"], atol=50 * ROUNDED)
    low, high = data["quantities"]["power_dbm"]["range"]
    assert low < high


def test_images_of_spectra_have_the_highest_elevation_at_the_top():
    grey = np.zeros((4, 6))
    grey[3, 2] = 1.0
    pixels = np.asarray(Image.open(io.BytesIO(base64.b64decode(png(grey).partition(",")[2]))))
    assert pixels[0, 2] == pixels.sum() == 255
    assert png(np.full((4, 6), np.nan)) is None


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
