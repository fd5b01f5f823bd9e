"""Reading what a run left behind."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import InputError
from ..core.angles import FloatArray
from ..core.types import IntArray
from ..tasks import TASKS, Task
from ..training.checkpoint import LOG
from .folder import METRICS, PREDICTIONS, check_format

Observations = NDArray[np.float32] | NDArray[np.complex64]
"""Greys, powers in dBm or channel coefficients, see `wrf_mi.core.Record`."""


def reference_key(name: str) -> str:
    """Key in ``predictions.npz`` of what the reference of that name predicts."""
    return f"reference_{name}"


@dataclass(frozen=True)
class Results:
    """Scores and predictions of a finished run, with one first axis per receiver.

    Attributes:
        path: the run folder.
        name: for tables and legends.
        task: ``"spectrum"``, ``"rssi"`` or ``"csi"``; `wrf_mi.tasks.TASKS` says how it is scored.
        dataset: name or folder of the data set, "" where the run does not tell.
        metrics: content of ``metrics.json``.
        seed: of split and fit, or None where the run does not tell.
        receivers: their names.
        row: test rows, shape [m].
        tx_pos_m: transmitter positions [m, 3], metres.
        prediction: shape [n_rx, m, H, W] grey values, [n_rx, m] dBm or [n_rx, m, subcarriers] coefficients, or
            [n_rx, m, antennas, subcarriers].
        truth: the same shape; NaN where nothing was received.
        references: by name (`wrf_mi.tasks.Task.references`) what needs no model, the same shape.
        validation: by fold name ("" without folds), pairs (seconds, SSIM on validation rows while they were held out).
    """

    path: Path
    name: str
    task: str
    dataset: str
    metrics: dict[str, Any]
    seed: int | None
    receivers: tuple[str, ...]
    row: IntArray
    tx_pos_m: FloatArray
    prediction: Observations
    truth: Observations
    references: dict[str, Observations]
    validation: dict[str, list[tuple[float, float]]]

    @cached_property
    def score(self) -> FloatArray:
        """The task's metric of each prediction, shape [n_rx, m]; NaN where nothing was received."""
        return TASKS[self.task].of_rows(self.prediction, self.truth)

    @cached_property
    def reference_scores(self) -> dict[str, FloatArray]:
        """The same of each reference."""
        return {key: TASKS[self.task].of_rows(values, self.truth) for key, values in self.references.items()}

    @property
    def reference(self) -> Observations:
        """The reference that stands for all, the first one."""
        return next(iter(self.references.values()))

    @property
    def reference_name(self) -> str:
        """That one in words."""
        return TASKS[self.task].references[next(iter(self.references))]

    @property
    def reference_score(self) -> FloatArray:
        """Score of that one."""
        return next(iter(self.reference_scores.values()))


def read_run(path: str | Path, name: str | None = None) -> Results:
    """Read a run folder.

    Args:
        path: the folder; a run over all blocks has subfolders ``fold0``, ... and pooled files at its top.
        name: for tables and legends; the folder's own name without one.

    Raises:
        InputError: not a run folder, or a file in it that is missing or damaged.
    """
    folder = Path(path)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give a run folder made by train or trace")
    check_format(folder)
    metrics = _read_metrics(folder / METRICS)
    task = TASKS[metrics["task"]]
    references = [key for key in task.references if key in metrics["reference"]]
    arrays = _read_predictions(folder / PREDICTIONS, task, references)
    parts = [folder, *sorted(p for p in folder.glob("fold*") if p.is_dir())]
    curves = {p.name if p != folder else "": _read_log(p / LOG) for p in parts}
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
        validation={fold: points for fold, points in curves.items() if points},
    )


def read_runs(paths: Sequence[str | Path]) -> list[Results]:
    """Read several run folders under names that differ: folders of the same name get as many parents as needed.

    Raises:
        InputError: no folder, one of them twice, or one that is no run.
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
    try:
        metrics = json.loads(path.read_text())
    except FileNotFoundError:
        raise InputError(f"{path.parent}: no {METRICS}, so no finished run; finish it with train --resume") from None
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: not readable as JSON ({error}); run evaluate to write it anew") from None
    needed = ("task", "model", "split", "n_train", "n_test", "ms_per_sample", "train_seconds", "peak_memory_mb")
    missing = [key for key in needed if key not in metrics]
    if missing:
        raise InputError(f"{path}: no {', '.join(missing)}; run evaluate to write it anew")
    if metrics["task"] not in TASKS:
        raise InputError(f"{path}: task {metrics['task']!r}; known are {', '.join(TASKS)}")
    task = TASKS[metrics["task"]]
    references = metrics.get("reference")
    held = references if isinstance(references, dict) else {}
    blocks = [metrics.get(task.block), *(held[key] for key in task.references if key in held)]
    if len(blocks) == 1 or any(not isinstance(block, dict) or "median" not in block for block in blocks):
        what = f"no {task.block} or no reference {' or '.join(sorted(task.references))} with a median"
        raise InputError(f"{path}: {what}; run evaluate to write it anew")
    return metrics


def _read_predictions(path: Path, task: Task, references: Sequence[str]) -> dict[str, Any]:
    observed = ("prediction", "truth", *map(reference_key, references))
    try:
        with np.load(path, allow_pickle=False) as stored:
            arrays = {key: stored[key] for key in ("row", "tx_pos", *observed)}
            names = stored.get("receiver_name")
    except FileNotFoundError:
        raise InputError(f"{path}: missing; run evaluate to write it") from None
    except KeyError as error:
        raise InputError(f"{path}: {error.args[0]}; run evaluate to write it anew") from None
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: not readable ({error}); run evaluate to write it anew") from None
    shapes = ", ".join(f"{key} {value.shape}" for key, value in arrays.items())
    single = arrays["truth"].ndim == 1 + task.axes if names is None else len(names) == 1
    if single:
        arrays |= {key: arrays[key][None] for key in observed}
    shape, rows = arrays["truth"].shape, len(arrays["row"])
    names = np.arange(shape[0] if shape else 0) if names is None else names
    fits = 0 <= len(shape) - 2 - task.axes <= task.more_axes
    fits = fits and shape[:2] == (len(names), rows) and arrays["tx_pos"].shape == (rows, 3)
    if not fits or any(arrays[key].shape != shape for key in observed):
        raise InputError(f"{path}: shapes do not fit together ({shapes}); run evaluate to write it anew")
    return arrays | {"receiver_name": names}


def _read_log(path: Path) -> list[tuple[float, float]]:
    """Pairs (seconds, score on held-out validation rows); methods without training leave no log."""
    if not path.is_file():
        return []
    points = []
    for number, line in enumerate(path.read_text().splitlines(), start=1):
        try:
            entry = json.loads(line)
            # Once the fit trains on the validation rows, their score says nothing about rows it has not seen.
            if entry["validation_score"] is not None and entry["held_out"]:
                points.append((float(entry["seconds"]), float(entry["validation_score"])))
        except (ValueError, KeyError, AttributeError, TypeError):
            raise InputError(f"{path}: line {number} is no log entry; remove the line") from None
    return points
