"""Scores of what a run has fitted: ``metrics.json`` and ``predictions.npz`` of the run and of its folds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import InputError, Split
from ..core.angles import FloatArray
from ..core.types import IntArray
from ..datasets import make_splits
from ..models import Fitted, Problem
from ..models.method import inputs_of
from ..tasks.scores import inside_interval
from ..training.trainer import peak_memory_mb
from .evaluate import evaluate, pool, stored_metrics, write_results
from .folder import RunConfig

Done = tuple[Fitted, float]
"""A fitted model and the seconds that its fit took."""


def score_part(
    folder: Path, part: Path, config: RunConfig, problem: Problem, rows: Split, done: Done
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Metrics and arrays of a part; those of a fold are written."""
    metrics, arrays = _evaluated(problem, rows, done[0])
    if part != folder:
        own = replace(config, split=rows.name)
        write_results(part, _header(part, own, done[1], done[0]) | metrics, arrays)
    return metrics, arrays


def score_run(
    folder: Path, config: RunConfig, done: Sequence[Done], parts: list[tuple[dict[str, Any], dict[str, Any]]]
) -> dict[str, Any]:
    """Write ``metrics.json`` and ``predictions.npz`` of a run from its parts' metrics and arrays.

    Returns:
        The metrics of the run.
    """
    metrics, arrays = parts[0] if len(parts) == 1 else pool(parts)
    merged = _header(folder, config, sum(seconds for _, seconds in done), done[0][0]) | metrics | _uncertainty(arrays)
    write_results(folder, merged, arrays)
    return merged


def score_other(
    folder: Path, config: RunConfig, problem: Problem, rows: Split, done: Done, split: str
) -> dict[str, Any]:
    """Metrics on those test rows of another split that the run has not seen; nothing is written.

    Raises:
        InputError: no such row is left.
    """
    asked = np.unique(np.concatenate([s.test for s in make_splits(problem.record, split, config.seed)]))
    unseen = np.setdiff1d(asked, problem.rows(rows))
    if not len(unseen):
        raise InputError(f"{folder}: trained on all test rows of split {split}; nothing is left to score")
    metrics, _ = _evaluated(problem, replace(rows, test=unseen), done[0])
    own = replace(config, split=f"{split} (rows unseen by {config.split})")
    return _header(folder, own, done[1], done[0]) | metrics


def _evaluated(problem: Problem, rows: Split, fitted: Fitted) -> tuple[dict[str, Any], dict[str, Any]]:
    record, stds = problem.record, dict[int, FloatArray]()

    def single(chosen: IntArray, receiver: int) -> NDArray[Any]:
        return fitted.predict(inputs_of(record, chosen), receiver).mean

    def predict(chosen: IntArray, receiver: int) -> NDArray[Any]:
        found = fitted.predict_rows(chosen, receiver) or fitted.predict(inputs_of(record, chosen), receiver)
        if found.std is not None:
            stds[receiver] = found.std
        return found.mean

    metrics, arrays = evaluate(record, rows, predict, single)
    if stds:
        arrays["std"] = np.stack([stds[r] for r in range(len(record.receivers))]).astype(np.float32)
    if not problem.use_rows:
        metrics["n_train"] = 0  # the references have theirs
    return metrics | _uncertainty(arrays), arrays


def _header(folder: Path, config: RunConfig, seconds: float, fitted: Fitted) -> dict[str, Any]:
    known = {"model": config.model, "dataset": config.dataset, "split": config.split, "seed": config.seed}
    known |= {} if config.scene is None else {"scene": config.scene}
    # What the fit needed, where it is known already.
    memory_mb = stored_metrics(folder).get("peak_memory_mb", peak_memory_mb())
    return {**known, "train_seconds": seconds, "peak_memory_mb": memory_mb, **fitted.facts()}


def _uncertainty(arrays: dict[str, Any]) -> dict[str, Any]:
    if "std" not in arrays:
        return {}
    return {"inside_90": inside_interval(arrays["prediction"], arrays["std"], arrays["truth"])}
