"""Views in a browser."""

import io
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_views import made_view
from pages import LAPTOP, PHONE, OpenPage, open_page
from PIL import Image
from playwright.sync_api import Browser

from wrf_mi.apps.viewer.content import ViewContent
from wrf_mi.apps.viewer.page import page

POSITIONS_ALONE = replace(made_view("curve"), scene=None, gaussians=None, paths=None, maps=[])
ELLIPSOID = 42
"""Corners of a Gaussian's mesh."""
TOOLS = """
const scene = document.getElementById("scene");
const drawn = () => new Promise((done) => requestAnimationFrame(() => setTimeout(done, 0)));
const shown = (traces) => scene._fullData.filter((trace) => trace.visible === true && traces(trace));
const meshes = () => shown((trace) => trace.type === "mesh3d").map((trace) => trace.x.length).sort((a, b) => a - b);
const paths = () => shown((trace) => trace.mode === "lines" && trace.hovertemplate).map((trace) => trace.x.length);
const heights = () => shown((trace) => trace.type === "surface").map((trace) => trace.z[1][1]);
const upper = (id) => document.getElementById(id).getBoundingClientRect().top;
const named = (text) => scene._fullData.findIndex((trace) => trace.name.startsWith(text));
async function set(id, value) {
  const input = document.getElementById(id);
  input.value = value;
  input.dispatchEvent(new Event(input.tagName === "SELECT" ? "change" : "input"));
  await drawn();
}
async function press(menu, button) {
  await Plotly.restyle(scene, ...scene.layout.updatemenus[menu].buttons[button].args);
}
"""
FIRST = """
({
  width: document.documentElement.scrollWidth,
  below: upper("choices") > upper("scene") + scene.clientHeight - 1,
  title: document.querySelector("h1").textContent,
  note: document.getElementById("notes").textContent,
  layers: scene._fullData.length,
  observed: document.getElementById("observation")._fullData.map((trace) => (trace.z ?? trace.y).length),
  meshes: meshes(), paths: paths(), heights: heights(),
})
"""
CONTROLS = """
(async () => {
  const seen = {};
  await set("transmitter", 2);
  await set("receiver", 1);
  seen.chosen = document.getElementById("observation-title").textContent;
  await press(0, 2);
  seen.heights = heights();
  await press(1, 4);
  seen.opacity = scene._fullData[named("concrete")].opacity;
  await Plotly.restyle(scene, { visible: "legendonly" }, [named("paths: reflection"), named("Gaussians")]);
  await Plotly.restyle(scene, { visible: true }, [named("plasterboard, ceiling")]);
  await set("transmitter", 1);
  seen.direct = paths();
  seen.ceiling = meshes();
  return seen;
})()
"""


def opened(browser: Browser, folder: Path, content: ViewContent, size: tuple[int, int]) -> OpenPage:
    """An open view, when its scene is drawn."""
    (folder / "view.html").write_text(page(content))
    view = open_page(browser, folder / "view.html", size)
    view.page.wait_for_selector("body[data-ready]")
    view.page.add_script_tag(content=TOOLS)
    return view


def colourful(screenshot: bytes) -> np.ndarray:
    """Pixels that show data [height, width]: neither text nor background has colours."""
    return np.ptp(np.asarray(Image.open(io.BytesIO(screenshot)).convert("RGB"), int), axis=-1) > 40


@pytest.mark.parametrize(("size", "observed"), [(LAPTOP, "image"), (PHONE, "level")])
def test_views_need_no_network_and_answer_their_controls(browser, tmp_path, size, observed):
    content = made_view(observed)
    view = opened(browser, tmp_path, content, size)
    assert view.page.evaluate(FIRST) == {
        "width": size[0],
        "below": size == PHONE,
        "title": content.title,
        "note": content.notes[0],
        "layers": 15,
        "observed": [9, 9] if observed == "image" else [2, 2],
        "meshes": [3, 4, 5 * ELLIPSOID],  # glass, concrete, Gaussians
        "paths": [3, 4],  # a direct path and a reflection, each with a gap behind it
        "heights": [0.5],
    }
    shown = view.page.evaluate(CONTROLS)
    assert shown.pop("chosen").startswith("row 15, SSIM 0.")
    assert shown == {"heights": [1.5], "opacity": 1, "direct": [3], "ceiling": [3, 4, 4]}
    assert view.complaints == []
    requests = [url for url in view.requests if not url.startswith(("data:", "blob:"))]
    assert requests == [(tmp_path / "view.html").as_uri()]
    view.page.close()


def test_channels_are_drawn_over_subcarriers(browser, tmp_path):
    view = opened(browser, tmp_path, POSITIONS_ALONE, PHONE)
    first = view.page.evaluate(FIRST)
    assert (first["observed"], first["layers"]) == ([8, 8], 4)
    assert view.complaints == []
    view.page.close()


REDRAWN_S = 30.0
"""Time in which a software renderer on a busy machine has drawn a scene anew."""


def map_alone(stretch: float) -> ViewContent:
    """A map and receivers at its height, ``stretch`` times as long as the room."""
    room = made_view()
    low = room.receivers_m * [stretch, 1, 0] + [0, 0, 0.5]
    long = replace(room.maps[0], x_m=stretch * room.maps[0].x_m)
    return replace(room, receivers_m=low, scene=None, gaussians=None, paths=None, rows=None, maps=[long])


@pytest.mark.parametrize("stretch", [1.0, 8.0])
def test_whole_map_is_in_the_picture(browser, tmp_path, stretch):
    view = opened(browser, tmp_path, map_alone(stretch), PHONE)
    assert view.complaints == []
    view.page.add_style_tag(content=".infolayer, .menulayer { display: none; }")  # colour bars, legend, menus
    scene, end = view.page.get_by_role("img", name="3D view"), time.monotonic() + REDRAWN_S
    while (data := colourful(scene.screenshot()))[:, 0].any() and time.monotonic() < end:
        pass  # WebGL shows the camera's new place some frames after Plotly has set it, on a busy machine seconds
    view.page.close()
    across, along = np.flatnonzero(data.any(axis=0)), np.flatnonzero(data.any(axis=1))
    assert 0 < across.min() < across.max() < data.shape[1] - 1
    assert 0 < along.min() < along.max() < data.shape[0] - 1
    assert np.ptp(across) > data.shape[1] / 2 or np.ptp(along) > data.shape[0] / 2  # not seen from far away
