"""Picture of planned measurements over the distance from measured positions."""

from __future__ import annotations

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from scipy.spatial import KDTree

from ...runs.figures import without_formulas
from ...runs.run import Run
from .picture import scene_cuts
from .plan import Plan

MARGIN_M = 0.3
WIDTH_IN = 7.0


def plan_figure(plan: Plan, run: Run) -> Figure:
    """Candidates by their distance from the nearest measured position, and planned positions in their order."""
    walls = scene_cuts(run, float(np.median(plan.candidates_m[:, 2])))
    drawn_m = np.concatenate([plan.candidates_m, plan.measured_m])
    low, high = drawn_m.min(axis=0) - MARGIN_M, drawn_m.max(axis=0) + MARGIN_M
    aspect = float(np.clip((high - low)[1] / (high - low)[0], 0.3, 1.8))
    figure = Figure(figsize=(WIDTH_IN, WIDTH_IN * aspect * 0.8 + 0.9), layout="constrained", facecolor="white")
    axes = figure.subplots()
    nearest_m = KDTree(plan.measured_m).query(plan.candidates_m)[0]
    x_m, y_m, _ = plan.candidates_m.T
    dots = axes.scatter(x_m, y_m, s=14, c=nearest_m, cmap="viridis", linewidths=0)
    for lines in walls:
        axes.add_collection(LineCollection(list(lines), colors="black", linewidths=1.2))
    axes.plot(*plan.measured_m[:, :2].T, ".", color="white", markersize=6, markeredgecolor="0.3", markeredgewidth=0.6)
    receivers_m = np.stack([receiver.position_m[:2] for receiver in run.receivers])
    axes.plot(*receivers_m.T, "^", color="#c1121f", markersize=7, markeredgecolor="white")
    for number, (x, y, _) in enumerate(plan.tx_pos_m.tolist(), start=1):
        box = {"boxstyle": "circle,pad=0.15", "facecolor": "#c1121f", "edgecolor": "white", "linewidth": 0.6}
        axes.text(x, y, str(number), color="white", fontsize=8, ha="center", va="center", bbox=box)
    axes.set(xlabel="x (m)", ylabel="y (m)", xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    figure.colorbar(dots, ax=axes, shrink=0.85).set_label("distance from the nearest measured position (m)", fontsize=8)
    text = "white: measured; numbers: measure next, in this order; triangles: receivers"
    figure.suptitle(f"{text}\n{summary(plan)}", fontsize=8)
    return without_formulas(figure)


def summary(plan: Plan) -> str:
    """The distance that a plan lowers, before and after, in one line."""
    before, after = plan.distance_m[[0, -1]]
    text = f"{before:.2f} m now, {after:.2f} m after {len(plan.tx_pos_m)} more measurements"
    return f"distance of the farthest candidate from the nearest measured position: {text}"
