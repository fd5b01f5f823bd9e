"""Entries of the table: one JSON file states who predicted what from which training rows, its cost and its scores."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from ...core import InputError
from ...core.digest import content_digest
from ...core.files import one_line, write_atomically
from ...runs.baselines import CONSTANT, CONSTANT_RMSE
from ...runs.compare_tables import row_blocks
from ...runs.results import Results
from ...tasks import TASKS, Task
from ...tasks.scores import block_bootstrap

QUANTILES = 101  # number of equally spaced quantiles of an entry's scores
ALL_ROWS, ALL = 1.0, "all rows"  # share of the training rows of a split, all of them, and its words
COPIED = ("n_train", "n_test", "reference", "train_seconds", "ms_per_sample", "peak_memory_mb")
STATED = (CONSTANT, CONSTANT_RMSE, "inside_90", "crps")
"""Keys of ``metrics.json`` that an entry copies: always, and where they are there."""


def rows_in_words(share: float) -> str:
    """Number or share of training rows in words.

    >>> rows_in_words(1.0), rows_in_words(1), rows_in_words(0.3)
    ('all rows', '1 rows', '30 % of the rows')
    """
    if isinstance(share, int):
        return f"{share} rows"
    return ALL if share == ALL_ROWS else f"{100 * share:.0f} % of the rows"


@dataclass(frozen=True, kw_only=True)
class Entry:
    """A method's scores on the test rows of a data set and split; a JSON file holds its fields by name.

    ``score`` is of `wrf_mi.tasks.Task.label`: SSIM, absolute error in dB or channel estimation accuracy in dB.
    """

    method: str  # name that the entries of one method share
    label: str  # method in words, with what it knows
    task: str  # ``spectrum``, ``rssi`` or ``csi``
    dataset: str  # name of the data set, of the file that describes it (`wrf_mi.apps.table.sources`)
    split: str  # split (`wrf_mi.datasets.make_splits`)
    share: int | float = ALL_ROWS  # number of training rows, or their share of all where it is a float
    seed: int | None = 0  # seed of split and fit; None: pooled over seeds
    date: str  # ISO 8601
    n_train: int | None = None  # number of training rows, mean of the folds
    n_test: int | None = None  # number of test rows
    score: Mapping[str, float]  # median, mean, p10, p90; of signal strengths bias, std and rmse in dB
    mean_interval: Sequence[float] | None = None  # 95 % interval of the mean score, over blocks of test rows
    quantiles: Sequence[float] = ()  # `QUANTILES` quantiles of the score over the test rows
    inside_90: float | None = None  # share of the truth inside the stated 90 % intervals
    crps: float | None = None  # continuous ranked probability score, in the unit of the observation
    reference: Mapping[str, Any] | None = None  # scores of interpolation from the same training rows, by name
    constant: Mapping[str, Any] | None = None  # scores of the constant with the best mean score
    constant_rmse: Mapping[str, Any] | None = None  # of powers: scores of the constant with the smallest RMSE
    train_seconds: float | None = None  # time of the fit, s
    ms_per_sample: float | None = None  # time of a prediction of one row, ms
    peak_memory_mb: float | None = None  # peak memory of the fit, MB
    wall_seconds: float | None = None  # time of the whole command, s
    machine: Mapping[str, Any] | str | None = None  # machine of the times
    worker_threads: int | None = None  # threads, where not all of the machine
    versions: Mapping[str, str] | None = None  # versions of packages
    source: Mapping[str, str] | None = None  # digests of the source, of entries that this project measures
    command: str | None = None  # command that measures it again
    origin: str | None = None  # address of the code, or its commit, where it is not this project's
    paper: str | None = None  # address of the paper
    licence: str | None = None  # licence of the code
    data: str | None = None  # SHA-256 of the data's files
    predictions: str | None = None  # SHA-256 of the predictions (`predictions_digest`)

    @property
    def name(self) -> str:
        """Name of the file without its suffix."""
        # As shares of all rows are floats, 1 is one row and 1.0 is all of them.
        count = f"{self.share}rows" if isinstance(self.share, int) else str(round(100 * self.share))
        seed = "seeds" if self.seed is None else f"seed{self.seed}"
        name = "-".join((self.task, self.dataset, self.split, self.method, count, seed))
        return re.sub(r"[^\w.+-]+", "-", name)

    @property
    def rows(self) -> str:
        """Training rows in words."""
        return rows_in_words(self.share)

    @property
    def of(self) -> Task:
        """Task, whose score the entry has."""
        return TASKS[self.task]


def entry_of(run: Results, predictions: str | None = None, **facts: Any) -> Entry:
    """Entry of a finished run; ``facts`` are fields that its folder does not hold."""
    task, metrics = TASKS[run.task], run.metrics
    entry_fields = {key: metrics[key] for key in COPIED} | {key: metrics[key] for key in STATED if key in metrics}
    score = {key: value for key, value in metrics[task.block].items() if isinstance(value, (int, float))}
    scores, scored = np.clip(run.score, *task.limits), np.isfinite(run.score)
    scored_rows = scored.any(axis=0)
    means = np.where(scored, scores, 0).sum(axis=0)[scored_rows] / scored.sum(axis=0)[scored_rows]
    # Receivers of a row have errors in common, and so have near rows.
    interval = block_bootstrap(means, row_blocks(run.tx_pos_m[scored_rows]))
    every = np.sort(run.score[np.isfinite(run.score)])
    entry_fields |= {"score": score, "mean_interval": [interval.low, interval.high], "predictions": predictions}
    entry_fields |= {"quantiles": [round(float(q), 5) for q in np.quantile(every, np.linspace(0, 1, QUANTILES))]}
    unknown = {key for key, value in entry_fields.items() if isinstance(value, float) and np.isnan(value)}
    entry_fields = {key: value for key, value in entry_fields.items() if key not in unknown}
    return Entry(**{"task": run.task, **entry_fields, **facts})


def predictions_digest(run: Results) -> str:
    """SHA-256 of the predictions of a run, single precision, in the order of the rows."""
    order = np.argsort(run.row)
    kind = np.complex64 if np.iscomplexobj(run.prediction) else np.float32
    return content_digest(run.row[order].astype(np.int64), np.asarray(run.prediction[:, order], kind))


def write_entry(folder: Path, entry: Entry) -> Path:
    """Write an entry into a folder of entries; fields that are not known are left out."""
    content = {key: value for key, value in asdict(entry).items() if value is not None and value != ()}
    # A seed that is not there is 0.
    content |= {"seed": None} if entry.seed is None else {}
    return write_atomically(folder / f"{entry.name}.json", json.dumps(content, indent=1) + "\n")


def read_entry(path: Path) -> Entry:
    """An entry from its file; `InputError` for a file that cannot be read, or lacks a field or has an unknown one."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: not readable ({one_line(error)}); restore it, or delete it") from None
    if not isinstance(content, dict):
        raise InputError(f"{path}: no entry of a table; delete it")
    needed = {field.name for field in fields(Entry) if field.default is MISSING}
    field_names = {field.name for field in fields(Entry)}
    for names, what in ((needed - content.keys(), "lacks"), (content.keys() - field_names, "has the unknown field")):
        if names:
            raise InputError(f"{path}: {what} {sorted(names)[0]}; write it by wrf-mi table add")
    entry = Entry(**content)
    if entry.task not in TASKS:
        raise InputError(f"{path}: task {entry.task!r}; give one of {', '.join(TASKS)}")
    return entry


def read_entries(folder: Path) -> dict[str, Entry]:
    """Entries of a folder by their names, sorted.

    `InputError`: no such folder, or a file whose name is not that of its content.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give that of the entries (--table)")
    entries = {path.stem: read_entry(path) for path in sorted(folder.glob("*.json"))}
    for name, entry in entries.items():
        if name != entry.name:
            raise InputError(f"{folder / name}.json: its fields are of {entry.name}; rename or correct it")
    return entries
