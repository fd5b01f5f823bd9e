"""Run time against error: the tables' rows of all training rows, and their Pareto fronts."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from wrf_mi.core import InputError
from wrf_mi.core.files import write_figure
from wrf_mi.tasks import TASKS

from .comparison import Row, line
from .table_pages import grouped, read_rows, title_of
from .table_plan import PARTS, SHARES, Part

STORED, PICTURE = Path("benchmarks/results/tables"), Path("docs/images/pareto.png")
"""Stored rows, and the picture, which is written only in a checkout of the project."""
COSTS = {"ms_per_sample": ("prediction of a sample", "ms"), "train_seconds": ("training", "s")}
"""Key, title and unit of each cost."""
LEAST = 1e-3  # smallest cost on the logarithmic axes

Points = Mapping[str, Mapping[str, float]]  # score and costs of each method by name


def points_of(part: Part, stored: Mapping[str, Mapping[str, Any]]) -> Points:
    """Mean over seeds of the median score, and median costs, of each method of a part with all training rows."""
    groups = grouped(part, stored)
    return {
        method: {"score": float(np.mean([row["score"]["median"] for row in rows]))}
        | {cost: float(np.median([row[cost] for row in rows])) for cost in COSTS}
        for (share, method), rows in groups.items()
        if share == SHARES[0]
    }


def front(points: Points, cost: str, higher_is_better: bool) -> list[str]:
    """Names of the Pareto-optimal methods in a cost and the score, from cheap to costly."""
    sign = 1 if higher_is_better else -1
    optimal, best = [], -np.inf
    for name in sorted(points, key=lambda name: (points[name][cost], -sign * points[name]["score"])):
        if sign * points[name]["score"] > best:
            best = sign * points[name]["score"]
            optimal.append(name)
    return optimal


def fronts(by_part: Mapping[Part, Points]) -> list[Row]:
    """Rows for the benchmark's table: the methods on each front with their scores and costs."""
    rows = []
    for part, points in by_part.items():
        task = TASKS[part.task]
        for cost, (title, unit) in COSTS.items():
            shown = [
                f"{name} {points[name]['score']:.{task.digits}f} in {points[name][cost]:.3g} {unit}"
                for name in front(points, cost, task.higher_is_better)
            ]
            rows.append(line(f"{title_of(part)}, {task.label}, {title}", ", ".join(shown)))
    return rows


def pareto_figure(by_part: Mapping[Part, Points]) -> Figure:
    """Picture of costs against scores: a row for each part, a colour for each method, the fronts as grey steps."""
    figure = Figure(figsize=(9, 2.3 * len(by_part) + 1), layout="constrained", facecolor="white")
    names = list(dict.fromkeys(name for points in by_part.values() for name in points))
    shown: dict[str, Any] = {}
    panels = figure.subplots(len(by_part), 2, sharey="row", squeeze=False)
    for row, (part, points) in zip(panels, by_part.items(), strict=True):
        task = TASKS[part.task]
        for axes, (cost, (title, unit)) in zip(row, COSTS.items(), strict=True):
            at = {name: (max(points[name][cost], LEAST), points[name]["score"]) for name in points}
            for name, place in at.items():
                number = names.index(name)
                shown[name] = axes.scatter(*place, color=f"C{number}", marker="os^"[number // 10])
            steps = np.transpose([at[name] for name in front(points, cost, task.higher_is_better)])
            axes.step(*steps, where="post", color="0.7", zorder=0)
            axes.set(xscale="log", xlabel=f"{title} ({unit})")
            axes.grid(alpha=0.3)
        row[0].set(ylabel=task.label, title=title_of(part))
    figure.legend(shown.values(), shown, loc="outside lower center", ncols=6, fontsize=8)
    return figure


def read_points(place: Path = STORED) -> dict[Part, Points]:
    """Points of each part with stored rows; `InputError` where there are none."""
    stored = {row["row"]: row for row in read_rows(place)}
    if not stored:
        raise InputError(f"{place}: no stored rows; call it in a checkout that has them, or run wrf-mi bench tables")
    return {part: points for part in PARTS if (points := points_of(part, stored))}


def main() -> dict[str, Sequence[Any]]:
    """Fronts of all parts in both costs, and their picture."""
    by_part = read_points()
    if PICTURE.parent.is_dir():
        write_figure(PICTURE, pareto_figure(by_part))
    return {"rows": fronts(by_part)}
