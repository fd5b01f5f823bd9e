"""Picture of positions: probability, region and estimate of some rows over the plan of the scene."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch

from ..core.angles import FloatArray
from ..runs.run import Run
from .locate import Positions
from .locate_file import posterior_arrays
from .picture import scene_cuts

SHOWN, COLUMNS = 6, 3  # number of rows that are drawn, and panels side by side
MARGIN_M = 0.5  # margin of a panel around the candidates
REGION, ESTIMATE, NEIGHBOURS, TRUTH = "tab:orange", "tab:red", "tab:purple", "black"


def draw_positions(run: Run, found: Positions, true_m: FloatArray | None = None) -> Figure:
    """Rows at equal spacing: the region of the stated probability, the estimate, and nearest neighbours.

    Args:
        run: run whose scene and receivers are drawn.
        found: positions.
        true_m: true positions [m, 2], metres, or None.
    """
    rows = np.unique(np.linspace(0, len(found) - 1, min(SHOWN, len(found))).round().astype(int))
    columns = min(COLUMNS, len(rows))
    lines = -(-len(rows) // columns)
    arrays, walls = posterior_arrays(found), scene_cuts(run, found.candidates.grid.height_m)
    size = np.array([np.ptp(arrays["x_m"]), np.ptp(arrays["y_m"])]) + 1.0
    height = 3.6 * float(np.clip(size[1] / size[0], 0.4, 2.0)) + 0.6
    figure = Figure(figsize=(3.6 * columns + 0.3, height * lines + 0.5), layout="constrained", facecolor="white")
    panels = figure.subplots(lines, columns, squeeze=False).ravel()
    for axes, row in zip(panels, rows, strict=False):
        _draw_row(axes, arrays, found, int(row), true_m)
        for lines_m in walls:
            axes.add_collection(LineCollection(list(lines_m), colors="0.35", linewidths=1.2))
        place = np.stack([receiver.position_m[:2] for receiver in run.receivers])
        axes.plot(*place.T, "^", color="tab:blue", markersize=6, markeredgecolor="white")
        for grid_m, set_limits in ((arrays["x_m"], axes.set_xlim), (arrays["y_m"], axes.set_ylim)):
            set_limits(grid_m[0] - MARGIN_M, grid_m[-1] + MARGIN_M)
        axes.set_aspect("equal")
        axes.tick_params(labelsize=7)
    for axes in panels[len(rows) :]:
        axes.set_visible(False)
    figure.supxlabel("x (m)", fontsize=8)
    figure.supylabel("y (m)", fontsize=8)
    figure.legend(handles=_legend(found, true_m is not None), loc="outside upper center", ncols=4, fontsize=8)
    return figure


def _draw_row(axes: Axes, arrays: dict[str, Any], found: Positions, row: int, true_m: FloatArray | None) -> None:
    grid = found.candidates.grid
    drawn = arrays["probability"][row]
    axes.pcolormesh(grid.x_m, grid.y_m, np.where(drawn > 0, drawn, np.nan), shading="nearest", cmap="Greens")
    inside = np.zeros(drawn.size)
    inside[found.candidates.inside] = found.region[row]
    if min(drawn.shape) > 1:
        # A border of zeros closes outlines at the edge of the grid.
        x, y = (np.concatenate([[2 * a[0] - a[1]], a, [2 * a[-1] - a[-2]]]) for a in (grid.x_m, grid.y_m))
        bordered = np.pad(inside.reshape(drawn.shape), 1)
        axes.contour(x, y, bordered, levels=[0.5], colors=REGION, linewidths=1.4)
    x_m, y_m = found.tx_pos_m[row, :2]
    axes.add_patch(Circle((x_m, y_m), found.radius_m[row], fill=False, color=ESTIMATE, linewidth=0.8, linestyle=":"))
    axes.plot(x_m, y_m, "o", color=ESTIMATE, markersize=6)
    if found.neighbours_m is not None:
        axes.plot(*found.neighbours_m[row, :2], "s", color=NEIGHBOURS, markersize=5)
    title = f"row {row + 1}: {found.area_m2[row]:.1f} m²"
    if true_m is not None:
        axes.plot(*true_m[row], "+", color=TRUTH, markersize=11, markeredgewidth=2)
        title += f", error {found.error_m(true_m)[row]:.2f} m"
    axes.set_title(title, fontsize=9)


def _legend(found: Positions, with_truth: bool) -> list[Any]:
    dot: dict[str, Any] = {"linestyle": "none"}
    handles: list[Any] = [
        Patch(color="tab:green", alpha=0.6, label="probability"),
        Line2D([], [], color=REGION, label=f"{found.level:.0%} region"),
        Line2D([], [], marker="o", color=ESTIMATE, label="estimate", **dot),
        Line2D([], [], color=ESTIMATE, linestyle=":", label=f"circle of {found.level:.0%}"),
    ]
    if found.neighbours_m is not None:
        k = found.calibration.neighbours
        name = "nearest neighbours" if k is None else f"{k.count} nearest neighbours"
        handles.append(Line2D([], [], marker="s", color=NEIGHBOURS, label=name, **dot))
    if with_truth:
        handles.append(Line2D([], [], marker="+", color=TRUTH, markeredgewidth=2, label="true position", **dot))
    handles.append(Line2D([], [], marker="^", color="tab:blue", label="receiver", **dot))
    return handles
