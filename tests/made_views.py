"""A view of everything, made by hand: every layer, with names that contain markup."""

from typing import Any

import numpy as np

from wrf_mi.apps.viewer.content import (
    GaussiansContent,
    MapContent,
    MaterialMesh,
    PathsContent,
    RowsContent,
    SceneContent,
    ViewContent,
)

MARKUP = "<b>&amp;</script><img src=x onerror=alert(1)>"
STORED, GAUSSIANS, HEIGHTS_M = 3, 5, (0.5, 1.5)


def made_view(observed: str = "image") -> ViewContent:
    """Two receivers, six held-out rows, three of them stored, and two maps; ``observed`` is the kind of observation."""
    rng = np.random.default_rng(4)
    floor = np.array([[[0.0, 0, 0], [4, 0, 0], [4, 3, 0]], [[0, 0, 0], [4, 3, 0], [0, 3, 0]]])
    meshes = (
        MaterialMesh("concrete", "#9aa0a6", False, floor, np.array([MARKUP, MARKUP])),
        MaterialMesh("glass", "#7fc4dd", False, floor[:1][..., [0, 2, 1]], np.array(["window"])),
        MaterialMesh("plasterboard", "#d9d2c0", True, floor + np.array([0, 0, 2.5]), np.array(["ceiling"] * 2)),
    )
    score = rng.uniform(0.6, 0.9, (2, 6))
    score[1, 4] = np.nan
    positions = rng.uniform([0.5, 0.5, 0.8], [3.5, 2.5, 1.6], (6, 3))
    stored = np.array([0, 2, 5])
    rows = RowsContent(10 + np.arange(6), positions, score, "SSIM", 3, stored, _observed(observed, rng), "grey")
    receivers_m = np.array([[0.2, 0.2, 2.0], [3.8, 2.8, 2.0]])
    turns = rng.normal(size=(STORED, GAUSSIANS, 4))
    fall = np.sort(rng.uniform(-60, -20, (STORED, GAUSSIANS)))[:, ::-1]
    places = rng.uniform([0, 0, 0], [4, 3, 2], (GAUSSIANS, 3))
    gaussians = GaussiansContent(places, np.full((STORED, GAUSSIANS, 3), np.log(0.2)), turns, fall, 9)
    corners, tx, rx, order = list[Any](), list[int](), list[int](), list[int]()
    for t in range(STORED):
        for r in range(2):
            for bounces in (0, 1):
                corners += [positions[stored[t]], *([[2.0, 3.0, 1.0]] * bounces), receivers_m[r]]
                tx, rx, order = [*tx, t], [*rx, r], [*order, bounces]
    numbers = np.array(tx), np.array(rx), np.array(order)
    gain_db, length_m = -50 - 8.0 * numbers[2], 3 + 1.5 * numbers[2]
    words = ("line of sight", "reflection")
    paths = PathsContent(*numbers, numbers[2], words, gain_db, length_m, np.array(corners))
    names = (MARKUP, "hall")
    return ViewContent(
        f"made {MARKUP}",
        [f"A note {MARKUP}."],
        names,
        receivers_m,
        SceneContent(meshes, np.array([[[0.0, 0, 0], [4, 0, 0]]])),
        rows,
        gaussians,
        paths,
        [_map(height_m, names) for height_m in HEIGHTS_M],
    )


def _observed(kind: str, rng: np.random.Generator) -> dict:
    both = ("measured", "predicted")
    if kind == "image":
        return {"kind": kind, **{key: rng.integers(0, 256, (2, STORED, 9, 36), np.uint8) for key in both}}
    shape = (2, STORED) if kind == "level" else (2, STORED, 8)
    return {"kind": kind, **{key: rng.uniform(-80, -40, shape) for key in both}}


def _map(height_m: float, receivers: tuple[str, ...]) -> MapContent:
    x_m, y_m = np.linspace(0.25, 3.75, 8), np.linspace(0.25, 2.75, 6)
    level = -40 - 10 * np.hypot(*np.meshgrid(x_m, y_m)) - height_m
    values = np.stack([level, level[::-1]]).astype(np.float32)
    values[:, 0, 0] = np.nan
    quantity = {"power_dbm": values, "best": np.ones((1, 6, 8), np.float32)}
    return MapContent("map.nc", height_m, x_m, y_m, None, receivers, quantity, {"power_dbm": MARKUP, "best": "best"})
