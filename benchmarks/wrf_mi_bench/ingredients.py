"""The hybrid beside each of its ingredients, over data sets, splits and numbers of rows.

Each cell is a run of the hybrid and one of each ingredient on the same rows. Scores are compared row by row; an
ingredient is *clearly better* where the 95 % bootstrap interval of the mean difference lies above zero. Each cell is
stored when it is measured (`wrf_mi_bench.comparison.stored_part`).
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from wrf_mi.models.hybrid.ingredients import INGREDIENTS

from wrf_mi.core.angles import FloatArray
from wrf_mi.runs.api import resume, train
from wrf_mi.runs.fit_key import fit_key, source_files
from wrf_mi.runs.folder import CONFIG, is_finished
from wrf_mi.runs.results import Results, read_run
from wrf_mi.runs.timing import bootstrap
from wrf_mi.synthetic.furnished_room import NAME as ROOM
from wrf_mi.tasks import TASKS

from .bench import CONFERENCE, FLAT, RFID
from .comparison import data_folder, measured_on, stored_part
from .table_plan import PARTS
from .tables import meshed_scan, scene_of

RUNS = Path("runs/bench/ingredients")
LAB = "laboratory"
ROWS: Mapping[tuple[str, str], Sequence[int | None]] = {
    (RFID, "official"): (5, 15, 48, None),
    (RFID, "blocked"): (None,),
    (LAB, "official"): (5, 15, 48, None),
    (LAB, "blocked"): (None,),
    (FLAT, "official"): (5, 15, 64, 400),
    (FLAT, "blocked"): (400,),
    (CONFERENCE, "official"): (15, 100, None),
}
"""Numbers of training rows by data set and split; None: all."""
LIMITS = {"ssim": 0.01, "abs_error_db": 0.1, "cea_db": 0.5}
"""Largest loss against an ingredient that is allowed, in the unit of the score."""
WORSE_SHARE = 0.02
"""Largest share of comparisons in which the hybrid may be clearly worse."""
INSIDE = (0.85, 0.95)
"""Limits of the share of test values inside the 90 % intervals."""
HYBRID = "hybrid"


@dataclass(frozen=True)
class Cell:
    """Data set, split and number of training rows; None: all."""

    dataset: str
    split: str
    n_train: int | None

    @property
    def name(self) -> str:
        """Name for files and progress."""
        return f"{self.dataset}-{self.split}-{'all' if self.n_train is None else self.n_train}"

    @property
    def title(self) -> str:
        """Label in the table."""
        return f"{self.dataset}, {self.split}, {'all' if self.n_train is None else self.n_train} rows"


CELLS = tuple(Cell(*key, count) for key, counts in ROWS.items() for count in counts)


def scene_of_cell(cell: Cell, folder: Path) -> str | None:
    """Scene of a cell's data set, made where needed; None: none is known."""
    if cell.dataset in (LAB, ROOM):
        return str(meshed_scan(cell.dataset, folder))
    part = next(part for part in PARTS if part.dataset == cell.dataset)
    return None if part.scene == "open" else scene_of(part, folder)[1]


def differences(hybrid: Results, ingredient: Results) -> FloatArray:
    """Scores of the hybrid minus those of an ingredient at the same receivers and rows, the higher the better."""
    task = TASKS[hybrid.task]
    pair = [np.clip(run.score[:, np.argsort(run.row)], *task.limits) for run in (hybrid, ingredient)]
    found = (1 if task.higher_is_better else -1) * (pair[0] - pair[1])
    return np.asarray(found[np.isfinite(found)], float)


def compared(hybrid: Results, others: Mapping[str, Results]) -> list[dict[str, Any]]:
    """Scores, intervals and mean differences of the hybrid and its ingredients."""
    block = TASKS[hybrid.task].block
    found = []
    for name, run in {HYBRID: hybrid, **others}.items():
        one = {
            "model": name,
            "score": run.metrics[block],
            "block": block,
            "train_seconds": run.metrics["train_seconds"],
        }
        one |= {key: run.metrics.get(key) for key in ("inside_90", "crps", "ms_per_sample")}
        if name != HYBRID:
            gain = bootstrap(differences(hybrid, run), np.mean)
            one |= {"gain": gain.value, "gain_low": gain.low, "gain_high": gain.high}
        found.append(one)
    return found


def run_of_cell(cell: Cell, folder: Path, name: str, model: str, **more: Any) -> Results:
    """Run of a model in ``folder / name`` on the rows of a cell, seed 0: finished, continued or new."""
    place = folder / name
    if not (place / CONFIG).exists():
        shutil.rmtree(place, ignore_errors=True)  # stopped before its configuration was written
        train(cell.dataset, place, model, split=cell.split, n_train=cell.n_train, seed=0, **more)
    elif not is_finished(place):
        resume(place)
    return read_run(place)


def run_of_ingredient(cell: Cell, folder: Path, name: str, scene: str | None, intervals: bool = False) -> Results:
    """Run of an ingredient by itself, as `run_of_cell`, with intervals of its own or without."""
    known = INGREDIENTS[name]
    more: dict[str, Any] = {"scene": scene if known.scene else None, "settings": known.settings}
    return run_of_cell(
        cell, folder, f"{name}-intervals" if intervals else name, known.model, intervals=intervals, **more
    )


def measure(cell: Cell, folder: Path) -> list[dict[str, Any]]:
    """Runs of a cell in ``folder``, those that are finished excepted, compared."""
    scene = scene_of_cell(cell, folder.parent)
    hybrid = run_of_cell(cell, folder, HYBRID, HYBRID, scene=scene)
    names = [name for name in hybrid.metrics["held_out"] if name != HYBRID]
    return compared(hybrid, {name: run_of_ingredient(cell, folder, name, scene) for name in names})


def measured(cell: Cell, folder: Path) -> dict[str, Any]:
    """``models``: a cell as it is stored."""
    return {"models": measure(cell, folder)}


def rows_of(cell: Cell, found: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Rows of the table: the hybrid, then each ingredient with the hybrid's gain over it."""
    rows = []
    for one in found:
        score, inside = one["score"], one["inside_90"]
        value = f"median {score['median']:.4g}, mean {score['mean']:.4g}"
        value += "" if inside is None else f", {inside:.0%} inside, CRPS {one['crps']:.3g}"
        asked = "85 to 95 % inside"
        if "gain" in one:
            limit = LIMITS[one["block"]]
            interval = f"{one['gain_low']:.3g} to {one['gain_high']:.3g}"
            asked = f"hybrid better by {one['gain']:.3g} ({interval}), at most {limit} worse"
        rows.append({"what": f"{cell.title}: {one['model']}", "value": value, "asked": asked, **one, "cell": cell.name})
    return rows


def main() -> dict[str, Any]:
    """Measure all cells that are not stored; `InputError` where data are not on this machine.

    Returns:
        ``rows``; ``worse``: number of comparisons in which the hybrid is clearly worse, of ``comparisons``; ``inside``:
        number of runs of the hybrid whose intervals cover 85 to 95 %, of ``cells``; and ``failed``, where a limit is
        exceeded.
    """
    for name in {part.dataset for part in PARTS} & {cell.dataset for cell in CELLS}:
        data_folder(name)
    place = RUNS / fit_key(source_files())
    place.mkdir(parents=True, exist_ok=True)
    rows, parts = list[dict[str, Any]](), list[dict[str, Any]]()
    for count, cell in enumerate(CELLS, 1):
        print(f"ingredients: {count} of {len(CELLS)}: {cell.title}", file=sys.stderr, flush=True)
        parts.append(stored_part("ingredients", cell.name, partial(measured, cell, place / cell.name)))
        found = rows_of(cell, parts[-1]["models"])
        rows += found
        for row in found:
            print(f"ingredients: {row['what']}: {row['value']}; {row['asked']}", file=sys.stderr, flush=True)
    return {"rows": rows, "measured": measured_on(parts), **_verdict(rows)}


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Markdown table, a line for each cell: the hybrid, its best ingredient by mean score, kriging and IDW."""
    head = (
        "data",
        "hybrid",
        "inside",
        "CRPS",
        "best ingredient",
        "gain over it",
        "kriging",
        "IDW",
        "clearly worse than",
    )
    lines = [f"| {' | '.join(head)} |", f"| {' | '.join(['---'] * len(head))} |"]
    for cell in dict.fromkeys(row["cell"] for row in rows):
        hybrid, *others = (row for row in rows if row["cell"] == cell)
        known = {row["model"]: f"{row['score']['median']:.3g}" for row in others}
        best = min(others, key=lambda row: row["gain"])
        worse = [row["model"] for row in others if row["gain_high"] < 0]
        inside, crps = hybrid["inside_90"], hybrid["crps"]
        cells = (
            hybrid["what"].rpartition(":")[0],
            f"**{hybrid['score']['median']:.3g}** ({hybrid['score']['mean']:.3g})",
            "" if inside is None else f"{inside:.0%}",
            "" if crps is None else f"{crps:.3g}",
            f"{best['model']} {known[best['model']]} ({best['score']['mean']:.3g})",
            f"{best['gain']:.2g} ({best['gain_low']:.2g} to {best['gain_high']:.2g})",
            *(known.get(name, "") for name in ("kriging", "idw")),
            ", ".join(worse),
        )
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _verdict(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    pairs = [row for row in rows if "gain" in row]
    worse = [row for row in pairs if row["gain_high"] < 0]
    beyond = [row for row in pairs if row["gain"] < -LIMITS[row["block"]]]
    hybrids = [row for row in rows if "gain" not in row and row["inside_90"] is not None]
    inside = [row for row in hybrids if INSIDE[0] <= row["inside_90"] <= INSIDE[1]]
    found: dict[str, Any] = {
        "comparisons": len(pairs),
        "worse": len(worse),
        "cells": len(hybrids),
        "inside": len(inside),
    }
    if len(worse) > WORSE_SHARE * len(pairs) or beyond:
        text = f"clearly worse than an ingredient in {len(worse)} of {len(pairs)} comparisons"
        found["failed"] = f"{text}, by more than the limit in {len(beyond)}"
    return found
