"""A picture of a scene: seen from above at a slant with the ceiling taken off, and its plan.

Surfaces, the scan they were made from, traced paths and the Gaussians of a field go into the same two views. Made
without pyplot, as all figures here: no global state, no window system.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection
from numpy.typing import ArrayLike

from ..core.angles import FloatArray, rotation_matrix
from ..core.files import write_atomically
from ..core.paths import Paths
from .preview_surfaces import TOP, draw_plan, draw_slant, extent, toward_viewer
from .surfaces import Surface

KIND_COLOURS = {"floor": "#cfc6b8", "ceiling": "#e8e8e4", "wall": "#7d9cb5", "other": "#c58f5c"}
MATERIAL_COLOURS = {
    "itu_concrete": "#a3a3a3",
    "itu_brick": "#b5654a",
    "itu_plasterboard": "#d8cfb8",
    "itu_ceiling_board": "#e8e8e4",
    "itu_wood": "#b07b46",
    "itu_chipboard": "#c79a63",
    "itu_plywood": "#d0a873",
    "itu_floorboard": "#9c6b3f",
    "itu_glass": "#8ec7d9",
    "itu_metal": "#5b6770",
    "itu_marble": "#dcd6d0",
}
OTHER_MATERIAL = "#b9a9c9"
MOST_POINTS = 20_000
MOST_GAUSSIANS = 3_000
MOST_PATHS = 300
"""The strongest are drawn; more only fill the picture."""
OUTLINE_POINTS = 20
SPAN_DB = 40.0
"""Colours span so much below the strongest."""


@dataclass(frozen=True)
class GaussianCloud:
    """Gaussians as a picture needs them.

    Attributes:
        position_m: centres [n, 3].
        scale_m: standard deviations along own axes [n, 3].
        rotation_xyzw: quaternions, own axes to world [n, 4].
        strength_db: what colours them, [n]; for example 20 log10 of the signal's magnitude.
        label: of the strength.
    """

    position_m: FloatArray
    scale_m: FloatArray
    rotation_xyzw: FloatArray
    strength_db: FloatArray
    label: str = "signal of a Gaussian (dB)"

    def covariance(self) -> FloatArray:
        """Shape [n, 3, 3], square metres."""
        axes = rotation_matrix(self.rotation_xyzw) * np.asarray(self.scale_m, float)[:, None, :]
        return np.asarray(axes @ np.swapaxes(axes, -1, -2))

    def strongest(self, count: int) -> GaussianCloud:
        """The ``count`` strongest, weakest first, so that the strong are drawn last."""
        order = np.argsort(self.strength_db, kind="stable")[-count:]
        return GaussianCloud(
            np.asarray(self.position_m, float)[order],
            np.asarray(self.scale_m, float)[order],
            np.asarray(self.rotation_xyzw, float)[order],
            np.asarray(self.strength_db, float)[order],
            self.label,
        )


def draw_preview(
    surfaces: Sequence[Surface],
    path: str | Path,
    points: ArrayLike | None = None,
    materials: Mapping[str, str] | None = None,
    title: str = "",
) -> Path:
    """Write a picture of a scene as PNG, whole or not at all.

    Args:
        surfaces: of the scene, at least one.
        path: of the file.
        points: the scan [n, 3] or [n, 2], metres.
        materials: radio material of surfaces by name; None colours them by kind.
        title: above the picture.
    """
    figure = draw_scene(surfaces, points_m=points, materials=materials, title=title)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110, metadata={"Software": None})
    return write_atomically(Path(path), buffer.getvalue())


def draw_scene(
    surfaces: Sequence[Surface],
    *,
    points_m: ArrayLike | None = None,
    paths: Paths | None = None,
    transmitters_m: ArrayLike | None = None,
    receivers_m: ArrayLike | None = None,
    gaussians: GaussianCloud | None = None,
    materials: Mapping[str, str] | None = None,
    title: str = "",
) -> Figure:
    """A scene with what is known in it, at a slant and in plan.

    Args:
        surfaces: of the scene, at least one.
        points_m: a scan [n, 3] or [n, 2].
        paths: traced paths; the strongest `MOST_PATHS` are drawn, with ``transmitters_m`` and ``receivers_m``.
        transmitters_m: shape [n_tx, 3].
        receivers_m: shape [n_rx, 3].
        gaussians: of a field.
        materials: radio material of surfaces by name; None colours them by kind.
        title: above the picture.

    Raises:
        ValueError: no surface, or paths without both ends.
    """
    if not surfaces:
        raise ValueError("draw_scene: no surface")
    if paths is not None and (transmitters_m is None or receivers_m is None):
        raise ValueError("draw_scene: paths need transmitters_m and receivers_m")
    ends = [None if p is None else np.asarray(p, float).reshape(-1, 3) for p in (transmitters_m, receivers_m)]
    scan = None if points_m is None else _thinned(np.asarray(points_m, float))
    cloud = None if gaussians is None else gaussians.strongest(MOST_GAUSSIANS)
    lines = None if paths is None or not len(paths) else _lines(paths, ends[0], ends[1])

    figure = Figure(figsize=(12.5, 5.8), layout="constrained")
    grid = figure.add_gridspec(1, 2, width_ratios=[1.2, 1])
    slant: Any = figure.add_subplot(grid[0], projection="3d", computed_zorder=False)
    plan = figure.add_subplot(grid[1])
    colours = _colours(surfaces, materials)
    low, high = extent(surfaces)
    draw_slant(slant, surfaces, colours, low, high)
    draw_plan(plan, surfaces, colours, low, high)
    if scan is not None:
        plan.plot(*scan.T[:2], ",", color="0.35", alpha=0.25, zorder=2)
        if scan.shape[1] == 3:
            below = scan[scan[:, 2] < low[2] + TOP * (high[2] - low[2])]
            slant.plot(*below.T, ",", color="0.3", alpha=0.15, zorder=4)
    if cloud is not None:
        _draw_gaussians(figure, slant, plan, cloud)
    if lines is not None:
        _draw_paths(figure, slant, plan, *lines)
    for points, marker, colour in zip(ends, "^o", ("#c1121f", "#0353a4"), strict=True):
        if points is not None:
            slant.plot(*points.T, marker, color=colour, markersize=5, markeredgecolor="white", zorder=8)
            plan.plot(*points.T[:2], marker, color=colour, markersize=6, markeredgecolor="white", zorder=8)
    _legend(figure, surfaces, colours, materials, ends)
    figure.suptitle(title, fontsize=10)
    return figure


def _colours(surfaces: Sequence[Surface], materials: Mapping[str, str] | None) -> list[str]:
    if materials is None:
        return [KIND_COLOURS[surface.kind] for surface in surfaces]
    return [MATERIAL_COLOURS.get(materials[surface.name], OTHER_MATERIAL) for surface in surfaces]


def _thinned(points: FloatArray) -> FloatArray:
    return points[:: -(-len(points) // MOST_POINTS)] if len(points) else points


def _silhouettes(cloud: GaussianCloud, across: FloatArray) -> FloatArray:
    """Outlines at one standard deviation as seen across two unit vectors [2, 3], [n, points, 2] in their plane."""
    covariance = across @ cloud.covariance() @ across.T
    half = np.linalg.cholesky(covariance + 1e-12 * np.eye(2))
    turn = np.linspace(0, 2 * np.pi, OUTLINE_POINTS)
    return np.swapaxes(half @ np.stack([np.cos(turn), np.sin(turn)]), -1, -2)


def _draw_gaussians(figure: Figure, slant: Any, plan: Axes, cloud: GaussianCloud) -> None:
    """Each Gaussian as the outline that it has from there (an orthographic view keeps Gaussians Gaussian)."""
    shades = _shades(cloud.strength_db, "viridis")
    rgba = shades.to_rgba(cloud.strength_db, alpha=0.4)
    eye = toward_viewer()
    right = np.cross([0, 0, 1], eye) / np.linalg.norm(np.cross([0, 0, 1], eye))
    screen = np.stack([right, np.cross(eye, right)])
    outlines = cloud.position_m[:, None] + _silhouettes(cloud, screen) @ screen
    slant.add_collection3d(Poly3DCollection(outlines, facecolors=rgba, edgecolors="none", zorder=5))
    flat = cloud.position_m[:, None, :2] + _silhouettes(cloud, np.eye(3)[:2])
    plan.add_collection(PolyCollection(list(flat), facecolors=rgba, edgecolors="none", zorder=4))
    _colour_bar(figure, shades, cloud.label)


def _lines(paths: Paths, transmitters: Any, receivers: Any) -> tuple[list[FloatArray], FloatArray]:
    """Corners of the strongest paths, the weakest first, and 20 log10 of their gains."""
    strength = 20 * np.log10(np.maximum(np.abs(paths.gain), 1e-20))
    order = np.argsort(strength, kind="stable")[-MOST_PATHS:]
    corners = []
    for i in order:
        met = paths.vertices_m[i][: int(paths.bounces[i])]
        corners.append(np.vstack([transmitters[paths.tx[i]], met, receivers[paths.rx[i]]]))
    return corners, strength[order]


def _draw_paths(figure: Figure, slant: Any, plan: Axes, corners: list[FloatArray], strength: FloatArray) -> None:
    shades = _shades(strength, "plasma")
    rgba = shades.to_rgba(strength, alpha=0.85)
    slant.add_collection3d(Line3DCollection(corners, colors=rgba, linewidths=0.9, zorder=6))
    plan.add_collection(LineCollection([c[:, :2] for c in corners], colors=rgba, linewidths=0.9, zorder=6))
    _colour_bar(figure, shades, "gain of a path (dB)")


def _shades(strength: FloatArray, colours: str) -> ScalarMappable:
    top = float(np.max(strength))
    return ScalarMappable(Normalize(max(float(np.min(strength)), top - SPAN_DB), top + 1e-9), colours)


def _colour_bar(figure: Figure, shades: ScalarMappable, label: str) -> None:
    bar = figure.colorbar(shades, ax=figure.axes[:2], shrink=0.6, pad=0.01, aspect=30)
    bar.set_label(label, fontsize=8)
    bar.ax.tick_params(labelsize=7)


def _legend(
    figure: Figure,
    surfaces: Sequence[Surface],
    colours: Sequence[str],
    materials: Mapping[str, str] | None,
    ends: Sequence[FloatArray | None],
) -> None:
    shown = [(s, c) for s, c in zip(surfaces, colours, strict=True) if s.kind != "ceiling"]
    names = {materials[s.name] if materials else s.kind: c for s, c in shown}
    handles: list[Any] = [Patch(facecolor=c, edgecolor="0.3", linewidth=0.5, label=name) for name, c in names.items()]
    for points, marker, colour, name in zip(
        ends, "^o", ("#c1121f", "#0353a4"), ("transmitter", "receiver"), strict=True
    ):
        if points is not None:
            handles.append(Line2D([], [], marker=marker, color=colour, linestyle="none", label=name))
    figure.legend(handles=handles, fontsize=8, loc="outside lower center", ncols=8, frameon=False)
