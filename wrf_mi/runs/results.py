"""Scores and predictions of a finished run, read from its folder."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import InputError, Split
from ..core.angles import FloatArray
from ..core.array_files import stored_arrays
from ..core.files import readable
from ..core.task import IDW, NEIGHBOURS
from ..core.types import IntArray
from ..core.types import Observations as Observations
from ..datasets import load_split
from ..tasks import TASKS, Task
from ..training.checkpoint import LOG
from .folder import METRICS, PREDICTIONS, SPLIT, check_format, run_parts

REMEDY = "run evaluate to write it anew"
PREDICTED = "predictions"  # key in ``metrics.json`` of the file of another program
STD_MEAN = "std_mean"  # key in ``predictions.npz``: standard deviation of the mean
RECEPTION = "probability_of_reception"  # key in ``predictions.npz`` and variable of a map


def reference_key(name: str) -> str:
    """Key in ``predictions.npz`` of a reference."""
    return f"reference_{name}"


def reference_words(task: Task, references: dict[str, Any], key: str) -> str:
    """Description of a reference, with the numbers of neighbours that folds chose, of the ``reference`` of metrics.

    >>> reference_words(TASKS["rssi"], {"idw": {"neighbours": [8, 32]}}, "idw")
    'IDW of 8 to 32 nearest'
    """
    counts = references.get(key, {}).get(NEIGHBOURS)
    numbers = f" of {' to '.join(map(str, np.unique([min(counts), max(counts)])))} nearest" if counts else ""
    return task.references[key] + numbers


@dataclass(frozen=True)
class Results:
    """Scores and predictions of a finished run, with a first axis of the receivers."""

    path: Path  # run folder
    name: str  # name for tables and legends
    task: str  # ``"spectrum"``, ``"rssi"`` or ``"csi"`` (`wrf_mi.tasks.TASKS`)
    dataset: str  # name or folder of the data set; "": unknown
    metrics: dict[str, Any]  # content of ``metrics.json``
    seed: int | None  # seed of split and fit; None: unknown
    receivers: tuple[str, ...]  # names of the receivers
    row: IntArray  # test rows, shape [m]
    tx_pos_m: FloatArray  # transmitter positions [m, 3], metres
    # grey values [n_rx, m, H, W], dBm [n_rx, m], or coefficients [n_rx, m, subcarriers] or [n_rx, m, antennas,
    # subcarriers]
    prediction: Observations
    truth: Observations  # observations of the same shape; NaN where nothing was received
    # reference predictions of the same shape by name (`wrf_mi.tasks.Task.references`)
    references: dict[str, Observations]
    # stated standard deviations of readings, of the same shape and real; None: none are stated
    std: NDArray[np.float32] | None
    # stated probabilities of reception [n_rx, m]; None: none are stated
    reception: NDArray[np.float32] | None
    # pairs (seconds, score on validation rows while they were held out) by name of the fold, "" without folds
    validation: dict[str, list[tuple[float, float]]]
    std_mean: NDArray[np.float32] | None = None  # standard deviations of the mean; None: not stated
    splits: Sequence[Split] = ()  # splits with test rows, one or those of the folds; empty: not stored

    @cached_property
    def score(self) -> FloatArray:
        """Score of each prediction, shape [n_rx, m]; NaN where nothing was received."""
        return TASKS[self.task].of_rows(self.prediction, self.truth)

    @cached_property
    def scored(self) -> dict[tuple[str, int], tuple[int, int]]:
        """Receiver and column in `score` of each observation that is scored, by the receiver's name and the row."""
        pairs = np.argwhere(np.isfinite(self.score))
        return {(self.receivers[r], int(self.row[m])): (int(r), int(m)) for r, m in pairs}

    @cached_property
    def truth_digests(self) -> dict[tuple[str, int], int]:
        """Digest of the truth of each observation that is scored, by the receiver's name and the row."""
        return {key: hash(self.truth[place].tobytes()) for key, place in self.scored.items()}

    @cached_property
    def training_digests(self) -> dict[tuple[str, int], int]:
        """Digest of the training rows behind each test observation's prediction, by the receiver's name and the row."""
        digests: dict[tuple[str, int], int] = {}
        for split in self.splits:
            digest = hash((split.all_train.tobytes(), split.held_receivers, split.left.tobytes()))
            names = [self.receivers[r] for r in split.held_receivers or range(len(self.receivers))]
            digests |= {(name, row): digest for name in names for row in split.test.tolist()}
        return digests

    @property
    def training_rows(self) -> str:
        """Number of training rows in words, of each fold where there are several."""
        text = rows_of_folds([len(split.all_train) for split in self.splits])
        return text or f"{self.metrics['n_train']} training rows"

    @cached_property
    def reference_scores(self) -> dict[str, FloatArray]:
        """Scores of each reference by name."""
        return {key: TASKS[self.task].of_rows(values, self.truth) for key, values in self.references.items()}

    @cached_property
    def best_reference(self) -> str:
        """Key of the reference with the best mean score on the test rows, the simple model to compare with."""
        task = TASKS[self.task]
        means = {key: np.nanmean(np.clip(scores, *task.limits)) for key, scores in self.reference_scores.items()}
        return (max if task.higher_is_better else min)(means, key=lambda key: float(means[key]))

    @property
    def reference(self) -> Observations:
        """Predictions of the best reference."""
        return self.references[self.best_reference]

    @property
    def reference_name(self) -> str:
        """Description of the best reference."""
        return self.words_of(self.best_reference)

    def words_of(self, key: str) -> str:
        """Description of a reference."""
        return reference_words(TASKS[self.task], self.metrics.get("reference", {}), key)

    @property
    def reference_score(self) -> FloatArray:
        """Score of the best reference."""
        return self.reference_scores[self.best_reference]


def read_run(path: str | Path, name: str | None = None) -> Results:
    """Read a run folder (with folds, the pooled scores); ``name`` is for tables, by default that of the folder.

    `InputError`: not a run folder, or a file in it that is missing or damaged.
    """
    folder = Path(path)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give a run folder made by train or trace")
    check_format(folder)
    metrics = _read_metrics(folder / METRICS)
    task = TASKS[metrics["task"]]
    references = [key for key in task.references if key in metrics["reference"]]
    arrays = _read_predictions(folder / PREDICTIONS, task, references)
    return Results(
        path=folder,
        name=name or folder.resolve().name,
        task=metrics["task"],
        dataset=str(metrics.get("dataset", "")),
        metrics=metrics,
        seed=metrics.get("seed"),
        receivers=tuple(str(name) for name in arrays["receiver_name"]),
        row=arrays["row"],
        tx_pos_m=arrays["tx_pos"],
        prediction=arrays["prediction"],
        truth=arrays["truth"],
        references={key: arrays[reference_key(key)] for key in references},
        std=arrays.get("std"),
        std_mean=arrays.get(STD_MEAN),
        reception=arrays.get(RECEPTION),
        validation=_read_logs(folder),
        splits=[split for part in run_parts(folder) if len((split := load_split(part / SPLIT)).test)],
    )


def rows_of_folds(counts: Sequence[int]) -> str:
    """Numbers of training rows of folds in words; empty of fewer than two folds.

    >>> rows_of_folds([110, 184, 160])
    '3 folds of 110 to 184 training rows'
    """
    if len(counts) < 2:
        return ""
    least, most = min(counts), max(counts)
    return f"{len(counts)} folds of {least}{f' to {most}' if most > least else ''} training rows"


def read_runs(paths: Sequence[str | Path]) -> list[Results]:
    """Read several run folders; where names coincide, parent folders are added to tell them apart.

    `InputError`: no folder, a folder given twice, or a folder that is not a run.
    """
    resolved = [Path(p).resolve() for p in paths]
    if not resolved:
        raise InputError("nothing to compare: give at least one run folder")
    for folder in resolved:
        if resolved.count(folder) > 1:
            raise InputError(f"{folder}: given twice; give each run once")
    depth = 1
    while len({p.parts[-depth:] for p in resolved}) < len(resolved):
        depth += 1
    return [read_run(path, "/".join(p.parts[-depth:])) for path, p in zip(paths, resolved, strict=True)]


def _read_metrics(path: Path) -> dict[str, Any]:
    missing = f"{path.parent}: no {METRICS}, so no finished run; finish it with train --resume"
    with readable(path, missing, REMEDY):
        metrics = json.loads(path.read_text())
    if metrics.get("n_test") == 0:
        raise InputError(f"{path.parent}: no test rows, so no scores; train it with a split that has some (--split)")
    needed = ("task", "model", "split", "n_train", "n_test", "ms_per_sample", "train_seconds", "peak_memory_mb")
    _require(path, metrics, needed)
    if metrics["task"] not in TASKS:
        raise InputError(f"{path}: task {metrics['task']!r}; known are {', '.join(TASKS)}")
    task, stored = TASKS[metrics["task"]], metrics.get("reference")
    references = stored if isinstance(stored, dict) else {}
    blocks = [metrics.get(task.block), *(references[key] for key in task.references if key in references)]
    if len(blocks) == 1 or any(not isinstance(block, dict) or "median" not in block for block in blocks):
        names = [IDW, *sorted(set(task.references) - {IDW})]
        text = f"no {task.block} or no reference {' or '.join(names)} with a median"
        raise InputError(f"{path}: {text}; {REMEDY}")
    return dict(metrics)


def _require(path: Path, stored: Collection[str], keys: Iterable[str]) -> None:
    if absent := [key for key in keys if key not in stored]:
        raise InputError(f"{path}: no {', '.join(absent)}; {REMEDY}")


def _read_predictions(path: Path, task: Task, references: Sequence[str]) -> dict[str, Any]:
    observed = ["prediction", "truth", *map(reference_key, references)]
    with readable(path, f"{path}: missing; run evaluate to write it", REMEDY):
        stored = stored_arrays(path)
    _require(path, stored, ("row", "tx_pos", "receiver_name", *observed))
    observed += {"std", STD_MEAN, RECEPTION} & stored.keys()
    arrays: dict[str, Any] = {key: stored[key] for key in ("row", "tx_pos", *observed)}
    names = stored["receiver_name"]
    shapes = ", ".join(f"{key} {value.shape}" for key, value in arrays.items())
    if len(names) == 1:
        arrays |= {key: arrays[key][None] for key in observed}
    shape, rows = arrays["truth"].shape, len(arrays["row"])
    fits = (
        {arrays[key].shape for key in observed} == {shape},
        shape[:2] == (len(names), rows),
        0 <= len(shape) - 2 - task.axes <= task.more_axes,
        arrays["tx_pos"].shape == (rows, 3),
    )
    if not all(fits):
        raise InputError(f"{path}: shapes do not fit together ({shapes}); {REMEDY}")
    return arrays | {"receiver_name": names}


def _read_logs(run: Path) -> dict[str, list[tuple[float, float]]]:
    """Content of the logs of a run and of its folds that are not empty, by the fold's name."""
    folds = {fold.name: fold for fold in sorted(run.glob("fold*"))}
    curves = {name: _read_log(folder / LOG) for name, folder in {"": run, **folds}.items()}
    return {name: points for name, points in curves.items() if points}


def _read_log(path: Path) -> list[tuple[float, float]]:
    """Pairs (seconds, score on held-out validation rows); empty without a log."""
    if not path.is_file():
        return []
    points = []
    for number, line in enumerate(path.read_text().splitlines(), start=1):
        try:
            entry = json.loads(line)
            # Once the fit trains on the validation rows, their score is no longer that of unseen rows.
            if entry["validation_score"] is not None and entry["held_out"]:
                points.append((float(entry["seconds"]), float(entry["validation_score"])))
        except (ValueError, KeyError, AttributeError, TypeError):
            raise InputError(f"{path}: line {number} is no log entry; remove the line") from None
    return points
