"""Picture of planned measurements over the expected error before and after them."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from scipy.spatial import KDTree

from ...core.angles import FloatArray
from ...runs.figures import without_formulas
from ...runs.folder import load_rows
from ...runs.run import Run
from ...tasks import task_of
from .picture import scene_cuts
from .plan import Plan

MARGIN_M = 0.3
PANEL_IN = 4.2
PIXELS = 300  # along the longer side


def plan_figure(plan: Plan, run: Run) -> Figure:
    """Standard deviations over the map before and after, planned positions in their order, rows measured so far."""
    record = run.problem.record
    rows = load_rows(run.folder, record).all_train
    measured_m, walls = record.tx_pos_m[rows], scene_cuts(run, float(np.median(plan.targets_m[:, 2])))
    low, high = plan.targets_m.min(axis=0) - MARGIN_M, plan.targets_m.max(axis=0) + MARGIN_M
    aspect = float(np.clip((high - low)[1] / max((high - low)[0], 1e-6), 0.3, 1.8))
    figure = Figure(figsize=(2 * PANEL_IN + 1, PANEL_IN * aspect + 1.2), layout="constrained", facecolor="white")
    shade: dict[str, Any] = {"cmap": "viridis", "vmin": float(plan.std.min()), "vmax": float(plan.std.max())}
    panels = figure.subplots(1, 2, squeeze=False).ravel()
    extent = (low[0], high[0], low[1], high[1])
    titles = "standard deviation now", f"after {len(plan.tx_pos_m)} more measurements"
    for axes, title, std in zip(panels, titles, plan.std, strict=True):
        drawn = axes.imshow(_nearest(plan.targets_m[:, :2], std, low, high), extent=extent, origin="lower", **shade)
        for lines in walls:
            axes.add_collection(LineCollection(list(lines), colors="black", linewidths=1.2))
        axes.plot(*measured_m[:, :2].T, ".", color="white", markersize=5, markeredgecolor="0.3", markeredgewidth=0.5)
        place = np.stack([receiver.position_m[:2] for receiver in run.receivers])
        axes.plot(*place.T, "^", color="#c1121f", markersize=6, markeredgecolor="white")
        axes.set(title=title, xlabel="x (m)", xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
        axes.title.set_fontsize(9)
    panels[0].set_ylabel("y (m)")
    for number, position_m in enumerate(plan.tx_pos_m, start=1):
        box = {"boxstyle": "circle,pad=0.15", "facecolor": "#c1121f", "edgecolor": "white", "linewidth": 0.6}
        panels[0].text(*position_m[:2], str(number), color="white", fontsize=7, ha="center", va="center", bbox=box)
    label = f"standard deviation of the prediction error ({_unit(run)})"
    figure.colorbar(drawn, ax=list(panels), shrink=0.85).set_label(label, fontsize=8)
    text = "dots: measured; numbers: measure next, in this order; triangles: receivers"
    figure.suptitle(f"{text}\n{summary(plan, run)}", fontsize=8)
    return without_formulas(figure)


def summary(plan: Plan, run: Run) -> str:
    """The quantity that a plan lowers, before and after, in one line."""
    (first, last), unit = plan.expected_error[[0, -1]], _unit(run)
    what, other = "standard deviation of the prediction error, root mean square over the map and receivers", ""
    if plan.surfaces:
        before, after = (max(plan.surfaces, key=lambda name: plan.surfaces[name][time]) for time in (0, 1))
        what = f"standard deviation of the least certain loss at a surface, {before}"
        other = "" if after == before else f" ({after})"
    return f"{what}: {first:#.3g} {unit} now, {last:#.3g} {unit}{other} after {len(plan.tx_pos_m)} more measurements"


def _unit(run: Run) -> str:
    return "dB" if task_of(run.problem.record).in_decibel else "units of an observation"


def _nearest(targets_m: FloatArray, values: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Image [h, w] of the value at the nearest of the targets [m, 2], NaN away from all of them."""
    # Targets are a random draw of cells: twice the 90th percentile of distances to the next bridges the gaps between.
    tree = KDTree(targets_m)
    gap_m = 2 * np.percentile(tree.query(targets_m, k=[2])[0], 90) if len(targets_m) > 1 else MARGIN_M
    pixel_m = (high - low)[:2].max() / PIXELS
    x, y = (np.arange(start + pixel_m / 2, end, pixel_m) for start, end in zip(low[:2], high[:2], strict=True))
    distance_m, nearest = tree.query(np.stack(np.meshgrid(x, y), axis=-1))
    return np.where(distance_m <= max(gap_m, MARGIN_M), values[nearest], np.nan)
