"""Shares of test values inside the 90 % intervals of three models, over data sets and both kinds of split.

Standard deviations are those of errors on training rows that are held out in space: the hybrid has its own, other
models are fitted once more, as ``wrf-mi train --intervals`` does. Each run is stored when it is measured
(`wrf_mi_bench.comparison.stored_part`).
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from wrf_mi.runs.sweep import markdown_table
from wrf_mi.synthetic.furnished_room import NAME as ROOM
from wrf_mi.tasks import TASKS

from .bench import FLAT, RFID
from .comparison import data_folder, measured_on, stored_part
from .fit_key import fit_key, source_files
from .stages import CHANNELS, HYBRID, INSIDE, JOINT, LAB, RUNS, Cell, data_of, run_alone, run_of_cell

CELLS = tuple(
    Cell(dataset, split, n_train)
    for dataset, n_train in {RFID: None, LAB: None, ROOM: 400, FLAT: 400, CHANNELS: None}.items()
    for split in ("official", "blocked")
)
MODELS = ("kriging", JOINT, HYBRID)
"""Models; Gaussians are trained jointly with the paths of the scene where there is one."""


def measured(cell: Cell, name: str, folder: Path) -> dict[str, Any]:
    """Score, share inside the 90 % intervals, CRPS and time of training of a model, as they are stored."""
    data, scene = data_of(cell, folder)
    if name == HYBRID:
        run = run_of_cell(cell, data, folder / HYBRID, HYBRID, scene=scene)
    else:
        run = run_alone(cell, data, folder, name, scene, intervals=True)
    block = TASKS[run.task].block
    return {"block": block, "score": run.metrics[block]} | {
        key: run.metrics[key] for key in ("inside_90", "crps", "train_seconds")
    }


def main() -> dict[str, Any]:
    """Measure all runs that are not stored; `InputError` where data are not on this machine.

    Returns:
        ``rows``; ``inside``: number of runs whose intervals cover 85 to 95 %, of ``runs``; and ``failed``, where some
        do not.
    """
    for name in (RFID, FLAT):
        data_folder(name)
    place = RUNS / fit_key(source_files())
    place.mkdir(parents=True, exist_ok=True)
    rows, parts = list[dict[str, Any]](), list[dict[str, Any]]()
    for cell in CELLS:
        for name in MODELS:
            print(f"intervals: {cell.title}: {name}", file=sys.stderr, flush=True)
            part = stored_part("intervals", f"{cell.name}-{name}", partial(measured, cell, name, place / cell.name))
            parts.append(part)
            value = f"{part['inside_90']:.1%} inside, CRPS {part['crps']:.3g}"
            known = {key: part[key] for key in ("inside_90", "crps", "score")}
            row = {"what": f"{cell.title}: {name}", "value": value, "asked": "85 to 95 % inside"}
            rows.append({**row, **known, "cell": cell.title, "model": name})
            print(f"intervals: {row['what']}: {value}", file=sys.stderr, flush=True)
    inside = sum(INSIDE[0] <= row["inside_90"] <= INSIDE[1] for row in rows)
    found = {"rows": rows, "measured": measured_on(parts), "inside": inside, "runs": len(rows)}
    if inside < len(rows):
        found["failed"] = f"intervals cover 85 to 95 % in {inside} of {len(rows)} runs"
    return found


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Markdown table, a line for each data set and split: share inside and CRPS of each model."""
    lines = []
    for cell in dict.fromkeys(row["cell"] for row in rows):
        known = {row["model"]: f"{row['inside_90']:.0%}, {row['crps']:.3g}" for row in rows if row["cell"] == cell}
        lines.append([cell, *(known.get(name, "") for name in MODELS)])
    return markdown_table(["data", *MODELS], lines)
