"""Run time against error of `wrf_mi_bench.methods` on a data set: measurement, Pareto front, table and picture."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.transforms import Bbox

from wrf_mi.core.angles import FloatArray
from wrf_mi.runs.figures import save
from wrf_mi.runs.timing import Interval, bootstrap, interleaved, memory_mb, one_blas_thread, ratio, split, typical_split
from wrf_mi.synthetic.furnished_room import traced_room
from wrf_mi.tasks.scores import ssim

from .comparison import line
from .methods import METHODS, FittedMethod, Method, MethodInput

logger = logging.getLogger(__name__)

ROWS = 400
"""Training rows."""
REFERENCE = "volprim_rf_basic, WRF-GS+, 270"
PICTURE = Path("docs/images/pareto.png")
"""Picture, written only in a checkout of the project."""
FITS = Path("runs/bench/pareto/fits")
"""Fitted models below the working directory; a finished one with the same key is used again (logged)."""
BATCH = 64
REPEATS = 9
MOST_S = 120.0
"""Seconds after which no further interleaved round begins."""
SHOWN = ("ms", "error")
"""Axes of the picture."""
DOT_PX = 4
"""Half the size of a dot."""

Point = Mapping[str, Any]


def measure_methods(
    given: MethodInput, methods: Sequence[Method], reference: str, repeats: int = REPEATS, most_s: float = MOST_S
) -> list[dict[str, Any]]:
    """Time, memory and error of each method on the test rows.

    Single predictions of all methods are interleaved in one process, and batches in a second series.

    Returns:
        For each method ``name``, ``family``, ``ms`` and ``batch_ms`` (of one spectrum; median and interval),
        ``over_reference`` (ratio of single times), ``error`` (1 - median SSIM over rows, and interval), ``l2`` (median
        relative L2 error), ``split`` (`wrf_mi.runs.timing.Split` of the first single prediction and of a warm one),
        ``memory_mb`` (of one prediction, and of a batch), ``stored_mb``, ``train_seconds``.
    """
    rows, record = given.split.test, given.record
    tx, truth = record.tx_pos_m[rows], record.observation[0][rows]
    one, many = tx[:1], tx[:BATCH]
    points: list[dict[str, Any]] = []
    ready: dict[str, FittedMethod] = {}
    for method in methods:
        logger.info("%s", method.name)
        made = ready[method.name] = method.make(given)
        parts = {"first": vars(split(made.call(one))), "warm": vars(typical_split(made.call(one)))}
        predicted = made.predict(tx)
        scores = ssim(np.asarray(predicted, np.float32), truth)
        points.append(
            {
                "name": method.name,
                "family": method.family,
                "error": vars(bootstrap(1 - scores)),
                "l2": float(np.median(_relative_l2(predicted, truth))),
                "split": parts,
                "memory_mb": {name: memory_mb(made.call(at)) for name, at in (("one", one), ("batch", many))},
                "stored_mb": made.stored_mb,
                "train_seconds": made.train_seconds,
            }
        )
    single = interleaved({name: made.call(one) for name, made in ready.items()}, repeats, most_s=most_s)
    together = {method.name: ready[method.name].call(many) for method in methods if method.batches}
    batched = interleaved(together, repeats, 1, most_s)
    for point in points:
        name = point["name"]
        point["ms"] = vars(bootstrap(single[name]))
        point["over_reference"] = vars(ratio(single[name], single[reference]))
        if name in batched:
            point["batch_ms"] = vars(bootstrap(batched[name] / len(many)))
    return points


def _relative_l2(predicted: Any, truth: Any) -> FloatArray:
    error = np.linalg.norm((predicted - truth).reshape(len(truth), -1), axis=1)
    return np.asarray(error / np.linalg.norm(truth.reshape(len(truth), -1), axis=1))


def front(points: Sequence[Point]) -> list[str]:
    """Names of the Pareto-optimal points in time and error, from fast to slow."""
    kept, best = [], np.inf
    for point in sorted(points, key=lambda p: (p["ms"]["value"], p["error"]["value"])):
        if point["error"]["value"] < best:
            best = point["error"]["value"]
            kept.append(point["name"])
    return kept


def pareto_figure(points: Sequence[Point], title: str = "") -> Figure:
    """Picture of time against error: a colour for each family, the front as a grey step, rings for times in a batch."""
    figure = Figure(figsize=(9, 5.4), layout="constrained", facecolor="white")
    axes = figure.subplots()
    families = list(dict.fromkeys(point["family"] for point in points))
    for k, family in enumerate(families):
        members = [point for point in points if point["family"] == family]
        x, y = ([p[key]["value"] for p in members] for key in SHOWN)
        errors = {
            key: [[abs(p[key][side] - p[key]["value"]) for p in members] for side in ("low", "high")] for key in SHOWN
        }
        look: dict[str, Any] = {"fmt": "o", "color": f"C{k}", "markersize": 6, "elinewidth": 0.7}
        axes.errorbar(x, y, xerr=errors["ms"], yerr=errors["error"], label=family, **look)
        for p in members:
            if "batch_ms" in p:
                axes.scatter(p["batch_ms"]["value"], p["error"]["value"], 30, "none", edgecolors=f"C{k}", alpha=0.55)
    at = {p["name"]: [p[key]["value"] for key in SHOWN] for p in points}
    axes.step(*np.transpose([at[name] for name in front(points)]), where="post", color="0.7", zorder=0)
    axes.set(xscale="log", yscale="log", ylabel="error, 1 - median SSIM over held-out rows")
    axes.set_xlabel("time of one spectrum (ms): dots alone, rings in a batch of 64")
    axes.set_title(title, fontsize=9)
    axes.yaxis.set_minor_formatter("{x:.2g}")
    axes.yaxis.set_major_formatter("{x:.2g}")
    axes.grid(alpha=0.3, which="both", linewidth=0.4)
    axes.legend(fontsize=8)
    _label(axes, points)
    return figure


def _label(axes: Axes, points: Sequence[Point]) -> None:
    """Write names beside their points without overlap."""
    figure: Any = axes.figure
    figure.draw_without_rendering()
    legend: Any = axes.get_legend()
    taken, frame = [legend.get_window_extent()], axes.bbox
    for point in points:
        x, y = axes.transData.transform([point[key]["value"] for key in SHOWN])
        taken.append(Bbox.from_bounds(x - DOT_PX, y - DOT_PX, 2 * DOT_PX, 2 * DOT_PX))
    # In order of distance from the point.
    places = [(side, 4 + 11 * up * sign) for up in range(12) for sign in (1, -1) for side in ("left", "right")]
    leader = {"arrowprops": {"arrowstyle": "-", "linewidth": 0.4, "color": "0.6"}}
    for point in sorted(points, key=lambda p: -p["ms"]["value"]):
        for side, up in places:
            at, off = (point["ms"]["value"], point["error"]["value"]), (6 if side == "left" else -6, up)
            more: dict[str, Any] = leader if abs(up) > 10 else {}
            text = axes.annotate(point["name"], at, off, textcoords="offset points", fontsize=7, ha=side, **more)
            text.get_window_extent()  # positions the text
            box = Text.get_window_extent(text)  # the text without its line
            inside = frame.x0 < box.x0 and box.x1 < frame.x1 and frame.y0 < box.y0 and box.y1 < frame.y1
            if (inside and not any(box.overlaps(other) for other in taken)) or (side, up) == places[-1]:
                taken.append(box)
                break
            text.remove()


def table(points: Sequence[Point]) -> list[dict[str, str]]:
    """Rows for the benchmark's table, from fast to slow."""
    best = front(points)
    return [
        line(
            f"{point['name']}{' (on the front)' if point['name'] in best else ''}",
            f"SSIM {1 - point['error']['value']:.3f}, {point['ms']['value']:.3g} ms"
            + (f", {point['batch_ms']['value']:.2g} ms in a batch" if "batch_ms" in point else ""),
        )
        for point in sorted(points, key=lambda p: p["ms"]["value"])
    ]


def full_table(points: Sequence[Point]) -> str:
    """Markdown table of all figures, from fast to slow, with methods on the front in bold."""
    lines = [
        "| method | SSIM | ms alone | in a batch | of the stock integrator's time | tracing + code + execution, ms "
        "| memory | stored | training |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    best = front(points)
    for p in sorted(points, key=lambda p: p["ms"]["value"]):
        name = f"**{p['name']}**" if p["name"] in best else p["name"]
        warm, memory, trained = p["split"]["warm"], max(p["memory_mb"].values()), p["train_seconds"]
        cells = [
            name,
            f"{1 - p['error']['value']:.3f}",
            str(Interval(**p["ms"])),
            f"{p['batch_ms']['value']:.2g}" if "batch_ms" in p else "",
            f"{p['over_reference']['value']:.2g}",
            " + ".join(f"{warm[part]:.1f}" for part in ("tracing", "code_generation", "execution")),
            f"{memory:.0f} MB" if memory >= 1 else "< 1 MB",
            f"{p['stored_mb']:.2g} MB",
            f"{trained:.0f} s" if trained else "",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> dict[str, Any]:
    """Measure `METHODS` in the traced room, about twenty minutes on two cores, and draw them."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    record, scene = traced_room()
    with one_blas_thread():
        points = measure_methods(MethodInput(record, scene, FITS, ROWS), METHODS, REFERENCE)
    if PICTURE.parent.is_dir():
        save(pareto_figure(points, f"traced room, {ROWS} training rows, 90 x 360 directions"), PICTURE, dpi=130)
    return {"rows": table(points), "reference": REFERENCE, "front": front(points), "points": points}
