"""Short tables of results for the documents; `benchmarks/results/README.md` has all their rows."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from wrf_mi.runs.sweep import markdown_table

from .comparison import Row

FIT, STEP = ", fit to its final accuracy", ", a step of "
SPECTRUM = "ms of one spectrum, "
SAME = 1e-6  # difference of mean scores below which two models predict the same


def operator(rows: Sequence[Row]) -> str:
    """Milliseconds of a spectrum by splatting and by operator."""
    lines = []
    for row in rows:
        if row["what"].startswith(SPECTRUM):
            parts = dict(part.split(" ", 1) for part in row["value"].replace("operator, 64", "batch").split("; "))
            cells = (parts.get(name, "").partition(" (")[0] for name in ("both", "operator", "batch"))
            lines.append([row["what"].removeprefix(SPECTRUM), *cells])
    return markdown_table(["ms of a spectrum", "splatted", "operator", "operator, 64 at once"], lines)


def training(rows: Sequence[Row]) -> str:
    """Time and peak memory of a fit, its score, and the time of a step of one and of four transmitters."""
    values = {row["what"]: row["value"] for row in rows}
    lines = []
    for what, value in values.items():
        if what.endswith(FIT):
            model, (times, memory, score) = what.removesuffix(FIT), value.split("; ")
            steps = (values.get(f"{model}{STEP}{count}", "") for count in ("1 transmitter", "4 transmitters"))
            ms = (step.partition(" (")[0] for step in steps)
            lines.append([model, times.partition(",")[0], memory, score.rpartition(" ")[2], *ms])
    return markdown_table(["model", "fit", "memory", "median SSIM", "ms of a step of 1", "of 4"], lines)


def waits(rows: Sequence[Row]) -> str:
    """Measured durations and their bounds."""
    return markdown_table(["what", "measured", "bound"], [[row["what"], row["value"], row["asked"]] for row in rows])


def rooms(rows: Sequence[Mapping[str, Any]]) -> str:
    """Smallest, median and largest accuracy over the rooms, and duration of the correction."""
    measured = [row for row in rows if "correction" in row]
    columns = {name: [row["cea_db"][name] for row in measured] for name in measured[0]["cea_db"] if name != "true"}
    seconds = [row["correction"]["seconds"] for row in measured]
    lines = []
    for name, statistic in (("smallest", np.min), ("median", np.median), ("largest", np.max)):
        cells = (f"{statistic(values):.1f}" for values in columns.values())
        lines.append([f"{name} of {len(measured)} rooms", *cells, f"{statistic(seconds):.0f} s"])
    return markdown_table(["mean CEA, dB", *columns, "duration of the correction"], lines)


def reception(rows: Sequence[Mapping[str, Any]]) -> str:
    """Log loss of the models, of the rate and of the nearest rows, by data set; the smallest is bold."""
    models = list(dict.fromkeys(row["model"] for row in rows))
    lines = []
    for cell in dict.fromkeys(row["cell"] for row in rows):
        by_model = {row["model"]: row for row in rows if row["cell"] == cell}
        _, *references = by_model[models[0]]["log_loss"]
        losses = [by_model[model]["log_loss"][0] if model in by_model else None for model in models] + references
        shown = ["" if loss is None else f"{loss:.3f}" for loss in losses]
        cells = [f"**{text}**" if text == min(filter(None, shown)) else text for text in shown]
        lines.append([f"{cell} ({by_model[models[0]]['received']:.0%} received)", *cells])
    return markdown_table(["data, split, rows", *models, "rate", "nearest"], lines)


def stages(rows: Sequence[Mapping[str, Any]]) -> str:
    """The hybrid, its kept stages and its best part by mean score; without rows on which both predict the same."""
    lines = []
    for cell in dict.fromkeys(row["cell"] for row in rows):
        hybrid, *parts = (row for row in rows if row["cell"] == cell)
        best = min(parts, key=lambda row: row["gain"])
        if abs(best["gain"]) < SAME:
            continue
        inside = hybrid["inside_90"]
        cells = [
            hybrid["what"].rpartition(":")[0],
            f"**{hybrid['score']['median']:.3g}**",
            "" if inside is None else f"{inside:.0%}",
            ", ".join(stage["stage"] for stage in hybrid["stages"] if stage["kept"]),
            f"{best['model']} {best['score']['median']:.3g}",
            f"{best['gain']:.2g} ({best['gain_low']:.2g} to {best['gain_high']:.2g})",
        ]
        lines.append(cells)
    return markdown_table(["data", "hybrid", "inside", "kept stages", "best part alone", "gain over it"], lines)
