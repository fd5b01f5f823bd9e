"""Figures: spectra on the polar sky, score distributions, training curves (Matplotlib without pyplot)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter
from numpy.typing import ArrayLike

from ..core.angles import FloatArray, azimuth_elevation, azimuth_rad, elevation_rad
from ..core.types import IntArray
from ..scene import drawing
from ..stages.scene import STAGES

if TYPE_CHECKING:
    from ..gaussians.footprint import Footprints

PANEL_IN = 2.3  # side of a polar plot in inches
TABLE_IN = 5.5  # least width of a table of maps in inches
OUTLINE_POINTS = 64  # corners of the polygon of a footprint's outline
COLOURS = 10  # number of colours in Matplotlib's cycle
POINTS_AREA = 4000.0  # area of all points of a map together, points squared: few positions are drawn larger
MARKERS = "os^D"  # markers of points, where colours repeat
NOT_KEPT = "hollow: not kept, without a clear gain on held-out rows by itself or with the stages after it"
TAIL = 0.01
"""Fraction of each curve that may lie beyond either end of the axis, so that outliers do not compress the rest."""

Rows = Sequence[tuple[str, Sequence[ArrayLike | None]]]
"""Rows of a table of plots: a name and an array per column; None leaves the plot out."""


def polar_spectrum(axes: Axes, spectrum: ArrayLike, title: str = "") -> None:
    """Draw grey values [H, W] in 0..1 on polar axes: azimuth as angle, 90 degrees - elevation as radius."""
    values = np.asarray(spectrum)
    height, width = values.shape
    # The zenith is no sample: it gets the mean of the ring around it.
    values = np.vstack([values, np.full(width, values[-1].mean())])
    radius_deg = np.append(90 - np.degrees(elevation_rad(height)), 0.0)
    axes.pcolormesh(azimuth_rad(width), radius_deg, values, shading="nearest", cmap=drawing.COLOUR_MAP, vmin=0, vmax=1)
    _sky(axes, title, ring_labels="white")


def _sky(axes: Axes, title: str, ring_labels: str) -> None:
    axes.set_rlim(0, 90)  # type: ignore[attr-defined]
    axes.set_yticks([30, 60, 90], ["60°", "30°", ""], fontsize=6, color=ring_labels)
    axes.set_xticks(np.radians([0, 90, 180, 270]), ["0°", "90°", "180°", "270°"], fontsize=6)
    axes.tick_params(pad=-2)
    axes.grid(alpha=0.3, linewidth=0.5)
    axes.set_title(title, fontsize=8)


def spectrum_table(rows: Rows, columns: Sequence[str]) -> Figure:
    """Table of polar plots, for example truth beside prediction.

    Args:
        rows: a name and a spectrum [H, W] per column; None leaves the plot out.
        columns: title of each column.

    >>> truth = np.random.default_rng(0).uniform(size=(9, 36))
    >>> figure = spectrum_table([("row 0", [truth, truth**2])], ["measured", "predicted"])
    >>> [axes.get_title() for axes in figure.axes]
    ['measured', 'predicted']
    """
    figure = Figure(figsize=(PANEL_IN * len(columns), PANEL_IN * len(rows) + 0.2), layout="constrained")
    grid = figure.subplots(len(rows), len(columns), squeeze=False, subplot_kw={"projection": "polar"})
    for r, (name, spectra) in enumerate(rows):
        for c, (title, spectrum) in enumerate(zip(columns, spectra, strict=True)):
            axes = grid[r, c]
            if spectrum is None:
                axes.set_axis_off()
            else:
                polar_spectrum(axes, spectrum, title if r == 0 else "")
            if c == 0:
                axes.text(-0.25, 0.5, name, transform=axes.transAxes, rotation=90, va="center", fontsize=7)
    return figure


def position_table(rows: Rows, columns: Sequence[str], tx_pos_m: ArrayLike, label: str) -> Figure:
    """Table of maps of values [m], NaN left out, at positions [m, 3] in metres; those of a row share their colours."""
    positions_m = np.asarray(tx_pos_m, float)
    x, y, _ = np.ptp(positions_m, axis=0) + 0.1
    aspect = float(np.clip(y / x, 0.3, 1.5))
    panel_in = max(PANEL_IN, TABLE_IN / len(columns))
    figure = Figure(figsize=(panel_in * len(columns) + 0.8, panel_in * aspect * len(rows) + 0.6), layout="constrained")
    grid = figure.subplots(len(rows), len(columns), squeeze=False, sharex=True, sharey=True)
    for r, (name, maps) in enumerate(rows):
        row_values = np.concatenate([np.ravel(values) for values in maps if values is not None])
        low, high = np.nanpercentile(row_values, [1, 99]) if np.isfinite(row_values).any() else (0.0, 1.0)
        colours = drawing.shades(low, high)
        for c, (title, values) in enumerate(zip(columns, maps, strict=True)):
            axes = grid[r, c]
            drawing.set_plan(axes)
            axes.set_title(title if r == 0 else "", fontsize=drawing.LABEL_SIZE)
            axes.set_ylabel(f"{name}\ny (m)")
            axes.label_outer()
            if values is None:
                axes.set_axis_off()
            else:
                size = float(np.clip(POINTS_AREA / len(positions_m), 6, 40))
                drawing.draw_values(axes, positions_m, np.asarray(values), colours, s=size, linewidths=0)
        drawing.colour_bar(figure, colours, list(grid[r]), label, shrink=0.9)
    return figure


def row_table(rows: Rows, columns: Sequence[str], row: ArrayLike, label: str) -> Figure:
    """Values [m] over row numbers [m], for data without positions: a plot for each name, a line for each column."""
    order = np.argsort(np.asarray(row))
    figure = Figure(figsize=(8, 2.2 * len(rows) + 0.6), layout="constrained")
    grid = figure.subplots(len(rows), 1, squeeze=False, sharex=True)[:, 0]
    for axes, (name, lines) in zip(grid, rows, strict=True):
        for title, values in zip(columns, lines, strict=True):
            if values is not None:
                axes.plot(np.asarray(row)[order], np.asarray(values)[order], linewidth=0.8, label=title)
        axes.set_ylabel(f"{name}\n{label}", fontsize=7)
        axes.tick_params(labelsize=6)
    grid[0].legend(fontsize=7)
    grid[-1].set_xlabel("row", fontsize=7)
    return figure


def footprint_sky(spectrum: ArrayLike, gaussians: Footprints, weight: ArrayLike, label: str = "weight") -> Figure:
    """Spectrum [H, W] beside the outlines of the visible Gaussians' footprints, at exp(-1/2) of their maximum.

    Outlines are coloured by ``weight`` [n], for example |opacity x signal|, the largest on top. Footprints are those of
    `wrf_mi.gaussians.footprint.project`.
    """
    colour = np.asarray(weight, float)
    order = np.argsort(colour, kind="stable")
    drawn = order[gaussians.visible.numpy()[order]]
    figure = Figure(figsize=(2 * 1.6 * PANEL_IN, 1.5 * PANEL_IN), layout="constrained")
    left, right = figure.subplots(1, 2, subplot_kw={"projection": "polar"})
    polar_spectrum(left, spectrum, "spectrum")
    lines = LineCollection(list(_outlines(gaussians, drawn)), cmap=drawing.COLOUR_MAP, linewidths=0.8)
    lines.set_array(colour[drawn])
    lines.set_clim(0, None)
    right.add_collection(lines)
    _sky(right, f"footprints of {len(drawn)} Gaussians", ring_labels="black")
    drawing.colour_bar(figure, lines, right, label, shrink=0.8)
    return figure


def _outlines(gaussians: Footprints, chosen: IntArray) -> FloatArray:
    """Azimuth in radians and 90 degrees - elevation in degrees along each footprint's outline, [n, points, 2]."""
    turn = np.linspace(0, 2 * np.pi, OUTLINE_POINTS)
    circle = np.stack([np.cos(turn), np.sin(turn)])
    vectors = (gaussians.direction, *gaussians.whitened)
    direction, *whitened = (np.stack([c.numpy()[chosen] for c in vector], axis=-1) for vector in vectors)
    # The vectors x of the tangent plane with (a . x, b . x) on the unit circle; the direction is n + x.
    in_plane = np.swapaxes(np.linalg.pinv(np.stack(whitened, axis=1)) @ circle, -1, -2)
    azimuth, elevation = azimuth_elevation(direction[:, None] + in_plane)
    return np.stack([azimuth, 90 - np.degrees(elevation)], axis=-1)


def score_cdf(scores: Mapping[str, ArrayLike], references: Mapping[str, ArrayLike], label: str = "SSIM") -> Figure:
    """Cumulative distributions of a score over test rows, NaN left out, by name; references are dashed."""
    figure = Figure(figsize=(7.5, 4), layout="constrained")
    axes = figure.subplots()
    curves = {name: np.ravel(values) for group in (scores, references) for name, values in group.items()}
    shown = [values[~np.isnan(values)] for values in curves.values()]
    for number, (name, values) in enumerate(zip(curves, shown, strict=True)):
        # Colours repeat in another line style.
        style = "--" if number >= len(scores) else ("-", "-.", ":")[number // COLOURS % 3]
        axes.ecdf(values, label=name, linestyle=style, color=f"C{number % COLOURS}")
    axes.set_xlim(min(np.quantile(v, TAIL) for v in shown), max(np.quantile(v, 1 - TAIL) for v in shown))
    axes.set(xlabel=label, ylabel="share of test rows below")
    axes.grid(alpha=0.3)
    figure.legend(fontsize=8, loc="outside right upper")
    return figure


def training_curves(curves: Mapping[str, Sequence[tuple[float, float]]], label: str = "SSIM") -> Figure:
    """Score on held-out validation rows over training time, from pairs (seconds, score) of each run by its name."""
    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.subplots()
    for name, points in curves.items():
        axes.plot(*zip(*points, strict=True), marker=".", label=name)
    axes.set(xlabel="training time (s)", ylabel=f"{label} on held-out validation rows")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    return figure


def stage_steps(stages: Mapping[str, Sequence[Mapping[str, Any]]], label: str = "SSIM") -> Figure:
    """Mean scores by the stages up to each, of held-out training rows (line; hollow where a stage was not kept) and of
    test rows (dashed); seconds of a stage's fit and milliseconds of a prediction beside. ``stages`` are those of
    ``metrics.json`` of each run by its name.
    """
    names = list(dict.fromkeys(report["stage"] for reports in stages.values() for report in reports))
    order = sorted(names, key=[*STAGES, *names].index)
    figure = Figure(figsize=(1.2 * len(order) + 3.5, 4), layout="constrained")
    axes = figure.subplots()
    for number, (name, reports) in enumerate(stages.items()):
        color, used = f"C{number}", [report for report in reports if report["kept"]]
        for key, style, what in (("held_out", "-", "held-out rows"), ("test", "--", "test rows")):
            if (scored := _scored(used, key, order))[0]:
                axes.plot(*scored, style, marker="o", color=color, label=f"{name}, {what}")
        rejected = _scored([report for report in reports if not report["kept"]], "held_out", order)
        axes.scatter(*rejected, facecolors="none", edgecolors=color, zorder=3)
        if rejected[0]:
            axes.set_title(NOT_KEPT, fontsize=8)
        _annotate_costs(axes, reports, order, color)
    axes.set_xticks(range(len(order)), order)
    axes.set(xlim=(-0.2, len(order) - 0.5), ylabel=f"mean {label}")  # the last label lies beside its point
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    return figure


def _annotate_costs(axes: Axes, reports: Sequence[Mapping[str, Any]], order: Sequence[str], color: str) -> None:
    """Write seconds and milliseconds of stages beside their scores."""
    for report in reports:
        costs = [f"{report[key]:.3g} {unit}" for key, unit in (("seconds", "s"), ("ms", "ms")) if report.get(key)]
        score = report["held_out"] if report["held_out"] is not None else report.get("test")
        if costs and score is not None:
            at, text = (order.index(report["stage"]), score), ", ".join(costs)
            axes.annotate(text, at, (4, -10), textcoords="offset points", fontsize=7, color=color)


def _scored(reports: Sequence[Mapping[str, Any]], key: str, order: Sequence[str]) -> tuple[list[int], list[float]]:
    """Places of the stages that state a score, and the scores."""
    scored = [report for report in reports if report.get(key) is not None]
    return [order.index(report["stage"]) for report in scored], [report[key] for report in scored]


def _style(number: int) -> dict[str, Any]:
    return {"marker": MARKERS[number // COLOURS % len(MARKERS)], "color": f"C{number % COLOURS}", "linestyle": "none"}


def time_scatter(times: Mapping[str, Mapping[str, float]], scores: Mapping[str, float], label: str) -> Figure:
    """Scores over times by run, a panel for each kind of time; runs without a time are left out of a panel."""
    figure = Figure(figsize=(3.4 * len(times) + 1.6, 3.6), layout="constrained")
    panels = figure.subplots(1, len(times), squeeze=False, sharey=True)[0]
    for axes, (words, of_runs) in zip(panels, times.items(), strict=True):
        for number, (name, score) in enumerate(scores.items()):
            if of_runs[name] > 0:
                axes.plot(of_runs[name], score, label=name, **_style(number))
        if any(seconds > 0 for seconds in of_runs.values()):
            axes.set_xscale("log")
            axes.xaxis.set_major_formatter("{x:g}")  # the default is a formula, see `drawing.without_formulas`
            axes.xaxis.set_minor_formatter(NullFormatter())
        else:
            axes.set_xticks([])
            axes.text(0.5, 0.5, "none", transform=axes.transAxes, ha="center")
        axes.set_xlabel(words)
        axes.margins(0.15)
        axes.grid(alpha=0.3)
    panels[0].set_ylabel(label)
    drawing.add_legend(figure, columns=min(3, len(scores)))
    return figure


def choice_map(chosen: ArrayLike, names: Sequence[str], tx_pos_m: ArrayLike) -> Figure:
    """Map of the number [m] of a name at each position [m, 3] in metres, seen from above; -1 leaves one out."""
    which = np.asarray(chosen)
    x, y, _ = np.asarray(tx_pos_m, float).T
    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.subplots()
    for number, name in enumerate(names):
        at = which == number
        label = f"{name}: {at.sum() / max((which >= 0).sum(), 1):.0%}"
        axes.plot(x[at], y[at], markersize=4, label=label, **_style(number))
    drawing.set_plan(axes)
    axes.grid(alpha=0.3)
    drawing.add_legend(figure, columns=min(3, len(names)))
    return figure
