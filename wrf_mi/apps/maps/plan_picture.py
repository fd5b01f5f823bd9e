"""Picture of planned measurements over the distance from measured positions."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from scipy.spatial import KDTree

from ...runs.run import Run
from ...runs.scene_view import scene_cuts
from ...scene import drawing
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
    colour = drawing.ENDS["transmitter"][1]
    colours = drawing.shades(0, float(nearest_m.max()))
    drawing.draw_values(axes, plan.candidates_m, nearest_m, colours, s=14, linewidths=0)
    drawing.draw_outlines(axes, walls)
    axes.plot(*plan.measured_m[:, :2].T, ".", color="white", markersize=6, markeredgecolor="0.3", markeredgewidth=0.6)
    drawing.draw_devices(axes, "receiver", [receiver.position_m for receiver in run.receivers])
    for number, (x, y, _) in enumerate(plan.tx_pos_m.tolist(), start=1):
        box = {"boxstyle": "circle,pad=0.15", "facecolor": colour, "edgecolor": "white", "linewidth": 0.6}
        axes.text(x, y, str(number), color="white", fontsize=8, ha="center", va="center", bbox=box)
    drawing.set_plan(axes, low, high)
    drawing.colour_bar(figure, colours, axes, "distance from the nearest measured position (m)", shrink=0.85)
    text = "white: measured; numbers: measure next, in this order; triangles: receivers"
    figure.suptitle(f"{text}\n{summary(plan)}", fontsize=8)
    return drawing.without_formulas(figure)


def summary(plan: Plan) -> str:
    """The distance that a plan lowers, before and after, in one line."""
    before, after = plan.distance_m[[0, -1]]
    text = f"{before:.2f} m now, {after:.2f} m after {len(plan.tx_pos_m)} more measurements"
    return f"distance of the farthest candidate from the nearest measured position: {text}"
