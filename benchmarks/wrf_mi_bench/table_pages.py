"""Pages and pictures of the tables of all methods, from stored rows, and their run time against error."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from wrf_mi.apps.table.entries import Entry, read_entries
from wrf_mi.apps.table.page import PUBLISHED
from wrf_mi.core import InputError
from wrf_mi.core.files import write_atomically, write_figure
from wrf_mi.core.yaml_files import read_yaml
from wrf_mi.runs.figures import score_cdf
from wrf_mi.runs.results import reference_words
from wrf_mi.tasks import TASKS

from .comparison import Row, line
from .declared import lined, pivoted
from .table_plan import MADE_HERE, PARTS, SHARES, TablePart, plan


def write_tables(place: Path, quick: bool = False) -> None:
    """Write tables in Markdown to ``README.md`` and a picture of the score distributions of each part."""
    stored, published_figures = read_entries(place), published(place)
    text = ["# Every method, task by task", NOTE]
    for name, heading in OVERVIEWS.items():
        if shown := overview(name, stored, published_figures, quick):
            text += [f"## {heading.capitalize()}: medians", shown]
    for part in PARTS:
        groups = grouped(part, stored, quick)
        if not groups:
            continue
        title = f"{TASKS[part.task].heading.capitalize()}: {part.dataset}, split {part.split}"
        text += [f"## {title}", part_table(part, groups, published_figures)]
        most = max(share for share, _ in groups)
        first = {method: rows[0] for (share, method), rows in groups.items() if share == most}
        picture = f"{part.task}-{part.dataset}-{part.split}.png"
        figure = score_cdf(
            {part.entries[method].label: row.quantiles for method, row in first.items()}, {}, TASKS[part.task].label
        )
        write_figure(place / picture, figure)
        text.append(f"![Distribution of the scores of each method]({picture})")
    write_atomically(place / "README.md", "\n\n".join(text) + "\n")


OVERVIEWS = {
    "spectrum": TASKS["spectrum"].heading,
    "rssi": TASKS["rssi"].heading,
    "carriers": "spectra at carriers that are held out",
    "receivers": "signal strengths at receivers that are held out",
    "uplink": "downlink channels from the uplink",
}
"""Headings of the overviews, by `wrf_mi_bench.table_plan.Part.table`."""
IN_RESULTS = ("spectrum", "rssi", "uplink")  # overviews that docs/results.md shows
NOTE = (
    "Written by `wrf-mi bench tables`; each row's JSON file has its command (a scene in braces is made by it), "
    "machine, versions and date. Scores are over test rows: SSIM and channel estimation accuracy (CEA, dB) are "
    "better when larger, errors in dB when smaller. With several seeds median, mean, p10 and p90 are means over "
    "them and the medians' range stands in brackets; with fewer rows the seed draws the rows too. Errors of signal "
    "strength are pooled over receivers and rows; fields have one offset a receiver. *Paper* is what the WRF-GS+ "
    "paper states **on other data**, NeRF2's and Argos's, for signal strength as means over twelve receivers: "
    "compare orders, not figures. Networks of blocked splits are fitted in five folds, all but the VAE with a fifth "
    "to a half of their steps; in the traced room NeRF2, VAE and DCGAN take the steps of the ten times smaller "
    "laboratory, WRF-GS and WRF-GS+ 18,000. Times are of the machine in each file, which others may have used too, "
    "with as many threads as `worker_threads` says there, or else all: read ratios. Rows with † are of a data set of "
    "this package as an earlier recipe made it; `wrf-mi bench tables` measures them anew."
)
FORMER = "†"  # mark of rows that were measured on other data than the newest rows of their part


Groups = Mapping[tuple[float, str], Sequence[Entry]]
"""Entries by share of the training rows and method, in the order of their seeds."""


Published = Mapping[tuple[str, str], str]
"""Figures that the paper states for other data, by overview and method."""


def published(place: Path) -> Published:
    """Figures of papers for the methods of the overviews, from the file beside the entries; empty without it."""
    path = place / PUBLISHED
    figures = read_yaml(path)["figures"] if path.exists() else []
    return {(published_row["table"], published_row["key"]): published_row["figure"] for published_row in figures}


def grouped(part: TablePart, stored: Mapping[str, Entry], quick: bool = False) -> Groups:
    groups: dict[tuple[float, str], list[Entry]] = {}
    for row in plan(quick):
        if row.part == part and row.name in stored:
            groups.setdefault((row.share, row.method), []).append(stored[row.name])
    return groups


def is_former(part: TablePart, rows: Sequence[Entry], newest: str | None) -> bool:
    """Whether one of some rows was measured on other data than those of a digest; measured data do not change."""
    return part.dataset.startswith(MADE_HERE) and any(row.data != newest for row in rows)


def newest_data(groups: Groups) -> str | None:
    """Digest of the data of most of the newest rows."""
    rows = [row for of_method in groups.values() for row in of_method]
    last = max(row.date for row in rows)
    return Counter(row.data for row in rows if row.date == last).most_common(1)[0][0]


def overview(name: str, stored: Mapping[str, Entry], stated: Published, quick: bool = False) -> str:
    """Markdown table of medians, most rows of each data set; a line is a method, a column a data set.

    With several seeds a median is their mean. Best mean rank first. "" where nothing is stored.
    """
    rows, ranks, labels = list[dict[str, Any]](), dict[str, list[float]](), dict[str, list[str]]()
    for part in PARTS:
        groups = grouped(part, stored, quick) if part.table == name else {}
        task, newest = TASKS[part.task], newest_data(groups) if groups else None
        of_part: list[dict[str, Any]] = [
            {"median": _mean(of_method, "median"), "method": method, "former": is_former(part, of_method, newest)}
            for (share, method), of_method in groups.items()
            if quick or share == SHARES[0]
        ]
        of_part.sort(key=lambda row: row["median"], reverse=task.higher_is_better)
        for rank, row in enumerate(of_part):
            ranks.setdefault(row["method"], []).append(rank / max(len(of_part) - 1, 1))
            text = f"{row['median']:.{task.digits}f}"
            text = f"**{text}**" if row["median"] == of_part[0]["median"] else text
            entry = part.entries[row["method"]]
            labels.setdefault(row["method"], []).append(entry.label)
            row |= {"title": title_of(part), "text": f"{text} {FORMER}" if row["former"] else text}
            rows.append({**row, "task": task, "published": stated.get((name, row["method"]), "")})
    if not rows:
        return ""
    titles = {row["title"]: row["title"] for row in rows}
    rows.sort(key=lambda row: float(np.mean(ranks[row["method"]])))
    for row in rows:
        # Where labels differ between columns, as the inputs do, the plain name is shown.
        first, *others = labels[row["method"]]
        row["label"] = first if {first} >= {*others} else first.split(",")[0]
    head, line = "| {task.label} | ... | paper, other data |", "| {label} | ... | {published} |"
    return pivoted(head, line, "method", "title", "{text}", titles)(rows)


def _mean(rows: Sequence[Entry], key: str) -> float:
    """Mean of a score over rows."""
    return float(np.mean([row.score[key] for row in rows]))


def title_of(part: TablePart) -> str:
    """Data set, and split where it is not the official one."""
    return part.dataset if part.split == "official" else f"{part.dataset}, {part.split}"


def part_table(part: TablePart, groups: Groups, stated: Published) -> str:
    """Markdown table of a data set and split: best median first, fewer rows below, references last."""
    task = TASKS[part.task]
    sign, rows = -1 if task.higher_is_better else 1, list[dict[str, Any]]()
    digits, newest, most = task.digits, newest_data(groups), max(share for share, _ in groups)
    for share, method in sorted(groups, key=lambda key: (-key[0], sign * _mean(groups[key], "median"))):
        of_method, entry = groups[share, method], part.entries[method]
        medians = [row.score["median"] for row in of_method]
        spread = f" [{min(medians):.{digits}f}, {max(medians):.{digits}f}]" if len(medians) > 1 else ""
        figures: dict[str, Any] = {key: _mean(of_method, key) for key in ("median", "mean", "p10", "p90")}
        figures |= {"label": entry.label + (f" {FORMER}" if is_former(part, of_method, newest) else "")}
        figures |= {"training": f"{np.median([row.train_seconds for row in of_method]):.0f} s"}
        figures |= {"sample": f"{np.median([row.ms_per_sample for row in of_method]):.2g} ms"}
        figures |= {"memory": f"{max(row.peak_memory_mb or 0 for row in of_method):.0f} MB"}
        figures |= {
            "spread": spread,
            "published": stated.get((part.table, method), "") if share == most else "",
            "digits": digits,
        }
        rows.append({"n_train": of_method[0].n_train, **figures})
    if "idw" not in part.entries:  # references that every run states, where interpolation has no row
        first = next(of_method[0] for (share, _), of_method in groups.items() if share == most)
        empty = dict.fromkeys(("spread", "training", "sample", "memory", "published"), "")
        for key, block in (first.reference or {}).items():
            label = {"n_train": first.n_train, "label": _reference_words(part, first, key), "digits": 2}
            rows.append({**block, **label, **empty})
    head = (
        f"| rows | method | median {task.label} | mean | p10 | p90 | training | a sample | memory | paper, other data |"
    )
    line = (
        "| {n_train} | {label} | **{median:.{digits}f}**{spread} | {mean:.{digits}f} | {p10:.{digits}f} "
        "| {p90:.{digits}f} | {training} | {sample} | {memory} | {published} |"
    )
    return lined(head, line)(rows)


def _reference_words(part: TablePart, entry: Entry, key: str) -> str:
    """Description of a reference; keys of IDW end with its number of neighbours where rows did not choose it."""
    name = key.rstrip("0123456789")
    if name != key:
        return f"{TASKS[part.task].references[name]} of {key.removeprefix(name)} nearest"
    return reference_words(TASKS[part.task], dict(entry.reference or {}), key)


STORED, PICTURE = Path("benchmarks/table"), Path("docs/images/pareto.png")
"""Entries, and the picture, which is written only in a checkout of the project."""
COSTS = {"ms_per_sample": ("prediction of a sample", "ms"), "train_seconds": ("training", "s")}
"""Key, title and unit of each cost."""
LEAST = 1e-3  # smallest cost on the logarithmic axes
SPEEDS = {"nerf2": (200, 0.78), "wrf-gs": (5, 0.82), "wrf-gs+": (8, 0.90)}
"""Milliseconds of a prediction on an RTX 3090 and median SSIM of the authors' programs for the spectra of NeRF2's data
(WRF-GS+, section V), as hollow markers beside spectra of these data.
"""

Points = Mapping[str, Mapping[str, float]]  # score and costs of each method by name


def points_of(part: TablePart, stored: Mapping[str, Entry]) -> Points:
    """Mean over seeds of the median score, and median costs, of each method of a part with all training rows."""
    groups = grouped(part, stored)
    return {
        method: {"score": _mean(rows, "median")}
        | {cost: float(np.median([getattr(row, cost) for row in rows])) for cost in COSTS}
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


def fronts(by_part: Mapping[TablePart, Points]) -> list[Row]:
    """Rows for the benchmark's table: the methods on each front with their scores and costs."""
    rows = []
    for part, points in by_part.items():
        task = TASKS[part.task]
        for cost, (title, unit) in COSTS.items():
            shown = [
                f"{name} {points[name]['score']:.{task.digits}f} ({points[name][cost]:.3g} {unit})"
                for name in front(points, cost, task.higher_is_better)
            ]
            rows.append(line(f"{title_of(part)}, {task.label}, {title}", ", ".join(shown)))
    return rows


front_table = lined(
    f"| data, score | Pareto-optimal methods: score ({COSTS['ms_per_sample'][0]}) |",
    "| {part} | {value} |",
    lambda row: {**row, "part": row["what"].rpartition(", ")[0]} if row["what"].endswith("sample") else None,
)
"""Fronts of `fronts` in the time of a prediction."""


def pareto_figure(by_part: Mapping[TablePart, Points]) -> Figure:
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
            if part.task == "spectrum" and cost == "ms_per_sample":
                for name, place in SPEEDS.items():
                    if name in at:
                        number = names.index(name)
                        axes.scatter(*place, facecolor="none", edgecolor=f"C{number}", marker="os^"[number // 10])
            steps = np.transpose([at[name] for name in front(points, cost, task.higher_is_better)])
            axes.step(*steps, where="post", color="0.7", zorder=0)
            axes.set(xscale="log", xlabel=f"{title} ({unit})")
            axes.grid(alpha=0.3)
        row[0].set(ylabel=task.label, title=title_of(part))
    figure.legend(shown.values(), shown, loc="outside lower center", ncols=6, fontsize=8)
    return figure


def read_points(place: Path = STORED) -> dict[TablePart, Points]:
    """Points of each part with stored rows; `InputError` where there are none."""
    stored = read_entries(place)
    if not stored:
        raise InputError(f"{place}: no entries; call it in a checkout that has them, or run wrf-mi bench tables")
    return {part: points for part in PARTS if (points := points_of(part, stored))}


def pareto() -> dict[str, Sequence[Any]]:
    """Fronts of all parts in both costs, and their picture."""
    by_part = read_points()
    if PICTURE.parent.is_dir():
        write_figure(PICTURE, pareto_figure(by_part))
    return {"rows": fronts(by_part)}
