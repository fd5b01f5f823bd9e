"""Picture of a radio map: power at each receiver over the plan or the mesh, with the measured points."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from ..core import Prediction
from ..core.angles import FloatArray
from ..runs.figures import without_formulas
from ..runs.run import Run
from ..runs.scene_view import surfaces_of
from ..scene.preview import AZIMUTH_DEG, ELEVATION_DEG, MOST_FACES, cut_lines
from ..tasks import task_of
from .variables import POWER

if TYPE_CHECKING:
    import xarray

PANEL_IN, COLUMNS = 3.2, 3
"""Width of a panel, and number of panels in a line."""
MOST_PANELS = 12
"""Largest number of receivers that are drawn, the first ones."""
MOST_POINTS = 400
"""Largest number of measured points of a panel."""
TAIL = 1.0
"""Percentage of values beyond either end of the colour scale."""
STRONGEST = "strongest receiver"


def map_figure(dataset: xarray.Dataset, run: Run) -> Figure:
    """Expected power at each receiver, and of several at the strongest one, with one colour scale for all.

    Walls are the cut of the run's scene at the map's height; measured points of the run's data at this receiver have
    their measured level as colour.
    """
    flat = "point" not in dataset.sizes
    power = dataset[POWER].values
    panels: list[tuple[str, int | None]] = [(STRONGEST, None)] if len(power) > 1 else []
    panels += [(str(name), k) for k, name in enumerate(dataset["receiver"].values)][:MOST_PANELS]
    low, high = np.percentile(power[np.isfinite(power)], [TAIL, 100 - TAIL])
    colours = ScalarMappable(Normalize(low, max(high, low + 1e-3)), "viridis")
    lines = -(-len(panels) // COLUMNS)
    columns = min(COLUMNS, len(panels))
    figure = Figure(figsize=(PANEL_IN * columns + 1, PANEL_IN * _aspect(dataset) * lines + 0.6), layout="constrained")
    kind: dict[str, Any] = {} if flat else {"projection": "3d", "computed_zorder": False}
    grid = figure.subplots(lines, columns, squeeze=False, subplot_kw=kind)
    walls = _walls(run, float(dataset["height"])) if flat else []
    strongest = np.fmax.reduce(power, axis=0)
    for place, (axes, (name, number)) in enumerate(zip(grid.flat, panels, strict=False)):
        values = strongest if number is None else power[number]
        draw = _draw_plan if flat else _draw_mesh
        draw(axes, dataset, values, colours, walls)
        _draw_points(axes, dataset, run, number, colours, flat)
        axes.set_title(name, fontsize=8)
        axes.tick_params(labelsize=6)
        if flat:
            axes.set_xlabel("x (m)" if place + columns >= len(panels) else "", fontsize=7)
            axes.set_ylabel("y (m)" if place % columns == 0 else "", fontsize=7)
    for axes in grid.flat[len(panels) :]:
        axes.set_axis_off()
    bar = figure.colorbar(colours, ax=list(grid.flat), shrink=0.8)
    bar.set_label(f"{dataset[POWER].attrs['long_name']} ({dataset[POWER].attrs['units']})", fontsize=8)
    bar.ax.tick_params(labelsize=7)
    figure.suptitle(f"{dataset.attrs['title']}; dots: measured, crosses: receivers", fontsize=9)
    return without_formulas(figure)


def _aspect(dataset: xarray.Dataset) -> float:
    if "point" in dataset.sizes:
        return 0.9
    x, y = (np.ptp(dataset[axis].values) + 0.1 for axis in "xy")
    return float(np.clip(y / x, 0.3, 1.6))


def _walls(run: Run, height_m: float) -> Sequence[FloatArray]:
    """Cuts [n, 2, 2] of the surfaces of a run's scene at a height."""
    scene = run.problem.opened_scene
    return [] if scene is None else [cut_lines(part, height_m) for part in surfaces_of(scene)]


def _draw_plan(
    axes: Axes, dataset: xarray.Dataset, values: FloatArray, colours: ScalarMappable, walls: Sequence[FloatArray]
) -> None:
    x, y = dataset["x"].values, dataset["y"].values
    shades: Any = {"cmap": colours.cmap, "norm": colours.norm}
    axes.pcolormesh(x, y, values, shading="nearest", rasterized=True, **shades)
    for lines in walls:
        if len(lines):
            axes.add_collection(LineCollection(list(lines), colors="black", linewidths=1.2, capstyle="round"))
    axes.set_aspect("equal")


def _draw_mesh(
    axes: Any, dataset: xarray.Dataset, values: FloatArray, colours: ScalarMappable, walls: Sequence[FloatArray]
) -> None:
    triangles = dataset["triangle"].values
    area = np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1)
    largest = np.argsort(-area, kind="stable")[:MOST_FACES]
    rgba = colours.to_rgba(np.ma.masked_invalid(values[largest]))
    faces = Poly3DCollection(triangles[largest], facecolors=rgba, edgecolors="none", antialiaseds=False, zorder=1)
    axes.add_collection3d(faces)
    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    size = np.maximum(high - low, 0.05 * float((high - low).max()))
    for axis, start, extent in zip("xyz", low, size, strict=True):
        axes.set(**{f"{axis}lim": (start, start + extent), f"{axis}label": f"{axis} (m)"})
    axes.set_box_aspect(size)
    axes.set_proj_type("ortho")
    axes.view_init(ELEVATION_DEG, AZIMUTH_DEG)


def _draw_points(
    axes: Any, dataset: xarray.Dataset, run: Run, number: int | None, colours: ScalarMappable, flat: bool
) -> None:
    """Measured levels of a receiver, thinned, and the receivers as crosses."""
    record = run.problem.record
    at = np.stack([dataset[f"receiver_{axis}"].values for axis in "xyz"], axis=-1)
    chosen = at if number is None else at[number : number + 1]
    axes.scatter(*chosen.T[: 2 if flat else 3], marker="x", color="#c1121f", s=22, linewidths=1.4, zorder=5)
    if number is None:
        return
    task, index = task_of(record), int(np.atleast_1d(dataset.attrs["receiver_numbers"])[number])
    added = float(dataset.attrs["transmit_power_dbm"]) if task.level_kind == "gain" else 0.0
    level = task.level(Prediction(record.observation[index])).mean + added
    known = np.flatnonzero(np.isfinite(level) & np.isfinite(record.tx_pos_m).all(axis=1))
    known = known[:: -(-len(known) // MOST_POINTS)] if len(known) else known
    points = record.tx_pos_m[known].T[: 2 if flat else 3]
    shades = {"c": level[known], "cmap": colours.cmap, "norm": colours.norm}
    axes.scatter(*points, **shades, s=9, edgecolors="white", linewidths=0.4, zorder=4)
