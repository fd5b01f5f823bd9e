"""Views in a browser: Chromium without a window, where it is installed."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import BROWSER, BROWSERS, Browser
from made_views import made_view

from wrf_mi.viewer.content import ViewContent
from wrf_mi.viewer.page import page

pytestmark = pytest.mark.skipif(BROWSER is None, reason=f"no browser: none of {', '.join(BROWSERS)} is installed")

LAPTOP, PHONE = (1366, 768), (390, 844)
ELLIPSOID = 42
"""Corners of a Gaussian's mesh."""
READY = """
new Promise((done) => {
  const look = () => (document.body?.dataset.ready ? done(true) : setTimeout(look, 50));
  look();
})
"""
TOOLS = """
const scene = document.getElementById("scene");
const drawn = () => new Promise((done) => requestAnimationFrame(() => setTimeout(done, 0)));
const lengths = (shown) => scene.data.filter(shown).map((trace) => trace.x.length);
const meshes = () => lengths((trace) => trace.type === "mesh3d").sort((a, b) => a - b);
const paths = () => lengths((trace) => trace.mode === "lines" && trace.hovertemplate);
const heights = () => scene.data.filter((trace) => trace.type === "surface").map((trace) => trace.z[1][1]);
const upper = (id) => document.getElementById(id).getBoundingClientRect().top;
async function set(name, value) {
  const label = [...document.querySelectorAll("label")].find((one) => name.test(one.textContent));
  const input = label.querySelector("input, select");
  if (input.type === "checkbox") input.click();
  else {
    input.value = value;
    input.dispatchEvent(new Event(input.tagName === "SELECT" ? "change" : "input"));
  }
  await drawn();
}
"""
FIRST = """
({
  width: document.documentElement.scrollWidth,
  below: upper("choices") > upper("scene") + scene.clientHeight - 1,
  title: document.querySelector("h1").textContent,
  note: document.getElementById("notes").textContent,
  layers: document.querySelectorAll("#layers label.layer input").length,
  images: document.getElementById("observation").layout.images?.length ?? 0,
  lines: document.getElementById("observation").data.map((trace) => trace.y.length),
  meshes: meshes(), paths: paths(), heights: heights(),
})
"""
CONTROLS = """
(async () => {
  const seen = {};
  await set(/^Transmitter:/, 2);
  await set(/^Receiver/, 1);
  seen.chosen = document.getElementById("observation-title").textContent;
  await set(/^Height:/, 1);
  seen.heights = heights();
  await set(/^ 1$/);
  seen.direct = paths();
  await set(/^Strongest:/, 2);
  seen.fewer = meshes();
  await set(/^Gaussians/);
  await set(/, ceiling$/);
  seen.ceiling = meshes();
  return seen;
})()
"""

EYE = """Math.hypot(...Object.values(document.getElementById("scene")._fullLayout.scene.camera.eye))"""


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    running = Browser(tmp_path_factory.mktemp("browser"))
    yield running
    running.close()


def opened(browser: Browser, folder: Path, content: ViewContent, size: tuple[int, int]) -> tuple[Any, dict[str, Any]]:
    """An open view and what it shows at first."""
    (folder / "view.html").write_text(page(content))
    tab = browser.open(folder / "view.html", *size)
    assert tab.run(READY)
    tab.run(f"{TOOLS}; 0")
    return tab, tab.run(FIRST)


@pytest.mark.parametrize(("size", "observed"), [(LAPTOP, "image"), (PHONE, "level")])
def test_views_need_no_network_and_answer_their_controls(browser, tmp_path, size, observed):
    content = made_view(observed)
    tab, first = opened(browser, tmp_path, content, size)
    assert first == {
        "width": size[0],
        "below": size == PHONE,
        "title": content.title,
        "note": content.notes[0],
        "layers": 10,
        "images": 2 if observed == "image" else 0,
        "lines": [1, 1] if observed == "image" else [2, 2],
        "meshes": [3, 6, 5 * ELLIPSOID],  # glass, concrete, Gaussians
        "paths": [3 + 4],  # a direct path and a reflection, each with a gap behind it
        "heights": [0.5],
    }
    # The scene is drawn: neither text nor background has colours.
    part = tab.picture()[60 : size[1] // 2 + 100, : size[0] * 2 // 3].reshape(-1, 3).astype(int)
    assert (np.ptp(part, axis=1) > 40).mean() > 0.02
    shown = tab.run(CONTROLS)
    assert shown.pop("chosen").startswith("row 15, SSIM 0.")
    assert shown == {"heights": [1.5], "direct": [3], "fewer": [3, 6, 2 * ELLIPSOID], "ceiling": [3, 6, 6]}
    assert tab.complaints() == []
    requests = [url for url in tab.requests() if not url.startswith(("data:", "blob:"))]
    assert requests == [(tmp_path / "view.html").as_uri()]
    tab.close()


def test_channels_are_drawn_over_subcarriers(browser, tmp_path):
    content = replace(made_view("curve"), scene=None, gaussians=None, paths=None, maps=[])
    tab, first = opened(browser, tmp_path, content, PHONE)
    assert (first["images"], first["lines"], first["layers"]) == (0, [8, 8], 3)
    assert tab.complaints() == []
    tab.close()


def test_a_map_alone_is_seen_from_further_back(browser, tmp_path):
    """Plotly draws flat scenes wider than rooms: their corners would lie outside the picture."""
    view, away = made_view(), []
    low = view.receivers_m * [1, 1, 0] + [0, 0, 0.5]
    flat = replace(view, receivers_m=low, scene=None, gaussians=None, paths=None, rows=None, maps=view.maps[:1])
    for content in (view, flat):
        tab, _ = opened(browser, tmp_path, content, LAPTOP)
        away.append(tab.run(EYE))
        assert tab.complaints() == []
        tab.close()
    assert away[0] == pytest.approx(np.linalg.norm([1.05, 1.55, 1.35]))
    assert away[1] > 1.2 * away[0]
