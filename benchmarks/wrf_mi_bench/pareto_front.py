"""Run time against error: measuring `wrf_mi_bench.methods` on one data set, the front, and its picture."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.transforms import Bbox

from wrf_mi.core.angles import FloatArray
from wrf_mi.runs.timing import Interval, bootstrap, interleaved, memory_mb, ratio, split, typical_split
from wrf_mi.tasks.scores import ssim

from .methods import FittedMethod, Method, Place

logger = logging.getLogger(__name__)

BATCH = 64
REPEATS = 9
MOST_S = 120.0
"""Bound of all interleaved rounds together."""
SHOWN = ("ms", "error")
"""Axes of the picture."""
DOT_PX = 4
"""Half the size of a dot."""

Point = Mapping[str, Any]


def measure_methods(
    place: Place, methods: Sequence[Method], reference: str, repeats: int = REPEATS, most_s: float = MOST_S
) -> list[dict[str, Any]]:
    """Time, memory and error of each method, on the test rows of a place.

    Single predictions of all methods take turns in one process; batches do so in a second series.

    Returns:
        For each method ``name``, ``family``, ``ms`` and ``batch_ms`` (of one spectrum; median and interval),
        ``over_reference`` (ratio of single times), ``error`` (1 - median SSIM over rows, and interval), ``l2`` (median
        relative L2 error), ``split`` (`wrf_mi.runs.timing.Split` of the first single prediction and of a warm one),
        ``memory_mb`` (of one prediction, and of a batch), ``stored_mb``, ``train_seconds``.
    """
    rows, record = place.split.test, place.record
    tx, truth = record.tx_pos_m[rows], record.observation[0][rows]
    one, many = tx[:1], tx[:BATCH]
    points: list[dict[str, Any]] = []
    ready: dict[str, FittedMethod] = {}
    for method in methods:
        logger.info("%s", method.name)
        made = ready[method.name] = method.make(place)
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
    """Names of the points that no other beats in both time and error, from fast to slow."""
    kept, best = [], np.inf
    for point in sorted(points, key=lambda p: (p["ms"]["value"], p["error"]["value"])):
        if point["error"]["value"] < best:
            best = point["error"]["value"]
            kept.append(point["name"])
    return kept


def pareto_figure(points: Sequence[Point], title: str = "") -> Figure:
    """Time of one prediction against error, a colour for each family, the front as a grey step."""
    figure = Figure(figsize=(9, 5.4), layout="constrained", facecolor="white")
    axes = figure.subplots()
    families = list(dict.fromkeys(point["family"] for point in points))
    for k, family in enumerate(families):
        own = [point for point in points if point["family"] == family]
        x, y = ([p[key]["value"] for p in own] for key in SHOWN)
        spread = {
            key: [[abs(p[key][side] - p[key]["value"]) for p in own] for side in ("low", "high")] for key in SHOWN
        }
        look: dict[str, Any] = {"fmt": "o", "color": f"C{k}", "markersize": 6, "elinewidth": 0.7}
        axes.errorbar(x, y, xerr=spread["ms"], yerr=spread["error"], label=family, **look)
        batched = [p for p in own if "batch_ms" in p]
        axes.scatter(
            [p["batch_ms"]["value"] for p in batched],
            [p["error"]["value"] for p in batched],
            s=30,
            facecolors="none",
            edgecolors=f"C{k}",
            alpha=0.55,
        )
    best = [next(p for p in points if p["name"] == name) for name in front(points)]
    axes.step(
        [p["ms"]["value"] for p in best], [p["error"]["value"] for p in best], where="post", color="0.7", zorder=0
    )
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel("time of one spectrum (ms): dots alone, rings in a batch of 64")
    axes.set_ylabel("error, 1 - median SSIM over held-out rows")
    axes.set_title(title, fontsize=9)
    axes.yaxis.set_minor_formatter("{x:.2g}")
    axes.yaxis.set_major_formatter("{x:.2g}")
    axes.grid(alpha=0.3, which="both", linewidth=0.4)
    axes.legend(fontsize=8)
    _label(axes, points)
    return figure


def _spread(intervals: Sequence[Mapping[str, float]]) -> list[list[float]]:
    """Distances of both limits from the value, as error bars want them."""
    return [[abs(one[side] - one["value"]) for one in intervals] for side in ("low", "high")]


def _label(axes: Axes, points: Sequence[Point]) -> None:
    """Names beside their points, where no other name is: points of one family often lie on each other."""
    figure: Any = axes.figure
    figure.draw_without_rendering()
    legend: Any = axes.get_legend()
    taken, frame = [legend.get_window_extent()], axes.bbox
    for point in points:
        x, y = axes.transData.transform([point[key]["value"] for key in SHOWN])
        taken.append(Bbox.from_bounds(x - DOT_PX, y - DOT_PX, 2 * DOT_PX, 2 * DOT_PX))
    # The farther away the later: right of the point or left of it, then up and down.
    places = [(side, 4 + 11 * up * sign) for up in range(12) for sign in (1, -1) for side in ("left", "right")]
    for point in sorted(points, key=lambda p: -p["ms"]["value"]):
        look: dict[str, Any] = {"textcoords": "offset points", "fontsize": 7}
        for side, up in places:
            line: dict[str, Any] = (
                {"arrowprops": {"arrowstyle": "-", "linewidth": 0.4, "color": "0.6"}} if abs(up) > 10 else {}
            )
            at, off = (point["ms"]["value"], point["error"]["value"]), (6 if side == "left" else -6, up)
            text = axes.annotate(point["name"], at, xytext=off, ha=side, **look, **line)
            text.get_window_extent()  # puts it where it belongs
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
        {
            "what": f"{point['name']}{' (on the front)' if point['name'] in best else ''}",
            "value": f"SSIM {1 - point['error']['value']:.3f}, {point['ms']['value']:.3g} ms"
            + (f", {point['batch_ms']['value']:.2g} ms in a batch" if "batch_ms" in point else ""),
            "asked": "",
        }
        for point in sorted(points, key=lambda p: p["ms"]["value"])
    ]


def full_table(points: Sequence[Point]) -> str:
    """Markdown table of all that is measured, from fast to slow; those on the front in bold."""
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
