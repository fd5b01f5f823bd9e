"""Probability of reception of four models beside the constant rate of each receiver and the nearest training rows.

Every cell is a run of ``wrf-mi train`` on a data set as it was measured, or with a sensitivity at which a third of its
values is missing: weaker ones are removed before anything is fitted. The hybrid is measured where it is fitted once, as
its fits in a scene take minutes. Each run is stored when it is measured
(`wrf_mi_bench.comparison.stored_part`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from wrf_mi.core import Record
from wrf_mi.core.array_files import stored_arrays
from wrf_mi.runs.folder import PREDICTIONS
from wrf_mi.runs.reception import REFERENCES
from wrf_mi.runs.results import RECEPTION
from wrf_mi.synthetic import load_record
from wrf_mi.synthetic.floor_receivers import NAME as FLOOR
from wrf_mi.tasks.scores import bootstrap

from .bench import FLAT
from .comparison import data_folder, line, measured_on, say, stored_part
from .declared import pivoted
from .sources import fit_key, source_files
from .stages import ALONE, HYBRID, Alone, run_of_cell
from .stages import Cell as Rows
from .tables import scene_of_data

RUNS = Path("runs/bench/reception")
MISSING = 1 / 3  # share of missing values
MODELS = ("idw", "kriging", "ray-tracing")  # of all cells
WORSE = 0.02  # largest loss against a reference that is allowed, nats
SCORES = ("log_loss", "brier", "calibration_error")


@dataclass(frozen=True)
class Cell(Rows):
    """Rows of a data set, as measured or with `MISSING` values."""

    weak_are_missing: bool = False

    @property
    def name(self) -> str:
        return f"{super().name}{'-missing' if self.weak_are_missing else ''}"

    @property
    def title(self) -> str:
        return f"{super().title}, {'a third missing' if self.weak_are_missing else 'as measured'}"

    @property
    def models(self) -> tuple[str, ...]:
        """Models of the cell."""
        return MODELS if self.split == "blocked" else (*MODELS, HYBRID)

    def record(self) -> Record:
        """Data of the cell."""
        record = load_record(self.dataset)
        if not self.weak_are_missing:
            return record
        observed = record.observation
        # Missing values are the weakest.
        sensitivity_dbm = np.quantile(np.where(np.isnan(observed), -np.inf, observed), MISSING, method="higher")
        return replace(record, observation=np.where(observed < sensitivity_dbm, np.nan, observed))


CELLS = (
    Cell(FLAT, "blocked", 400),
    Cell(FLAT, "blocked", 400, weak_are_missing=True),
    Cell(FLAT, "official", 400, weak_are_missing=True),
    Cell(FLOOR, "blocked", None, weak_are_missing=True),
)


def measure(cell: Cell, model: str, place: Path) -> dict[str, Any]:
    """Block ``reception`` of a run, gains in log loss on both references by row, and the error of received rows."""
    scene = scene_of_data(cell.dataset, place)
    alone = Alone(HYBRID, True) if model == HYBRID else ALONE[model]
    more: dict[str, Any] = {"scene": scene if alone.scene else None, "settings": alone.settings}
    more |= {"intervals": model != HYBRID}  # which has its own
    folder = place / cell.name / model
    run = run_of_cell(cell, cell.record(), folder, model, **more)
    arrays = stored_arrays(folder / PREDICTIONS)
    received = np.isfinite(arrays["truth"])
    loss = [
        -np.log(np.where(received, arrays[key].astype(float), 1 - arrays[key])).mean(axis=0)
        for key in (RECEPTION, *REFERENCES)
    ]
    gains = [bootstrap(other - loss[0], statistic=np.mean) for other in loss[1:]]
    figures = {"gain": [[gain.value, gain.low, gain.high] for gain in gains], "score": run.metrics["abs_error_db"]}
    facts = {key: run.metrics[key] for key in ("reception", "train_seconds", "inside_90")}
    return {**facts, **figures, "sensitivity": run.metrics.get("sensitivity")}


def row_of(cell: Cell, model: str, part: Mapping[str, Any]) -> dict[str, Any]:
    """Row of the table."""
    block = part["reception"]
    scores = {key: [block[key], *(block["reference"][name][key] for name in REFERENCES)] for key in SCORES}
    values = "log loss {:.3f}, rate {:.3f}, nearest rows {:.3f}".format(*scores["log_loss"])
    row = line(f"{cell.title}: {model}", values, f"at most {WORSE} above either")
    header = {"cell": cell.title, "model": model, "received": block["received"], "gain": part["gain"]}
    return {**row, **header, **scores, "error_db": part["score"]["median"]}


def main() -> dict[str, Any]:
    """Measure all runs that are not stored; `InputError` where data are not on this machine.

    ``failed`` is there where a log loss exceeds that of a reference clearly and by more than `WORSE`.
    """
    data_folder(FLAT)
    place, rows, parts = RUNS / fit_key(source_files()), list[dict[str, Any]](), list[dict[str, Any]]()
    for cell in CELLS:
        for model in cell.models:
            say("reception", f"{cell.title}: {model}")
            parts.append(stored_part("reception", f"{cell.name}-{model}", partial(measure, cell, model, place)))
            rows.append(row_of(cell, model, parts[-1]))
            say("reception", rows[-1]["value"])
    result: dict[str, Any] = {"rows": rows, "measured": measured_on(parts)}
    worse = [row["what"] for row in rows if any(gain < -WORSE and high < 0 for gain, _, high in row["gain"])]
    return result | ({"failed": f"clearly worse than a reference: {', '.join(worse)}"} if worse else {})


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Log loss of the models, of the rate and of the nearest rows, by data set; the smallest is bold."""
    names = "model", "rate", "nearest"
    losses = [
        {**row, "by": row.get(name, name), "loss": loss}
        for row in rows
        for name, loss in zip(names, row["log_loss"], strict=True)
    ]
    titles = {name: name for name in [*dict.fromkeys(row["model"] for row in rows), *names[1:]]}
    line = "| {cell} ({received:.0%} received) | ... |"
    return pivoted("| data, split, rows | ... |", line, "cell", "by", "{loss:.3f}", titles, best=min)(losses)
