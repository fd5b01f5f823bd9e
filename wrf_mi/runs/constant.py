"""Scores of a model against those of one constant prediction for each receiver, which knows nothing of the place."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import Record, Split
from ..core.angles import FloatArray
from ..tasks import TASKS, Task
from ..tasks.scores import summary

CONSTANT = "constant"  # key of the block in ``metrics.json``
SCORES = "constant_score"
"""Key of the constant prediction's scores [n_rx, m] among the arrays of an evaluation; they are not stored."""


def constant_scores(record: Record, split: Split, truth: NDArray[Any]) -> FloatArray:
    """Scores [n_rx, m] of a constant prediction (`wrf_mi.tasks.Task.constant`) of the test rows' truth [n_rx, m, ...].

    The constant is that of the training rows, validation rows included, that a receiver received; a receiver without
    any, which the split holds out, takes that of all receivers. Truth is NaN where it is not scored.
    """
    task, rows = TASKS[record.task], split.all_train
    observed = record.seen(split).observation[:, rows]
    received = np.asarray(np.isfinite(observed).reshape(*observed.shape[:2], -1).all(axis=2))
    scores = []
    for values, known, expected in zip(observed, received, truth, strict=True):
        constant = task.constant(values[known] if known.any() else observed[received])
        scores.append(task.of_rows(np.broadcast_to(constant, expected.shape)[None], expected[None])[0])
    return np.stack(scores)


def against_constant(task: Task, scores: FloatArray, constant: FloatArray) -> dict[str, Any]:
    """Block of ``metrics.json``: whether a model's scores [n_rx, m] are clearly better than the constant prediction's.

    Returns:
        `wrf_mi.tasks.scores.summary` of the constant prediction, ``gain``, by which the model's mean score is better,
        its standard error ``gain_error``, and ``beaten``.
    """
    sign = 1 if task.higher_is_better else -1
    # Limited, as a few exact or absurd predictions would decide a mean of decibels.
    gains = sign * (np.clip(scores, *task.limits) - np.clip(constant, *task.limits))
    gains = gains[np.isfinite(gains)]
    gain, error = float(gains.mean()), float(gains.std() / np.sqrt(len(gains)))
    # More than the standard error, so that chance seldom passes for a gain, and more than the last digit that is shown,
    # so that predicting all but zero does not either.
    clear = gain > max(error, 10.0**-task.digits)
    # The median is the score that tables show first.
    beaten = clear and sign * float(np.nanmedian(scores) - np.nanmedian(constant)) > 0
    return {**summary(constant + 0.0), "gain": gain, "gain_error": error, "beaten": beaten}


def unbeaten(metrics: dict[str, Any]) -> str | None:
    """Line about a model whose scores are not better than those of the constant prediction; None where they are."""
    block = metrics.get(CONSTANT)
    if block is None or block["beaten"]:
        return None
    task = TASKS[metrics["task"]]
    both = [f"{key} {metrics[task.block][key] + 0.0:.3f} against {block[key]:.3f}" for key in ("median", "mean")]
    gain = f"gain {block['gain']:.2g}, standard error {block['gain_error']:.2g}"
    what = f"{metrics['model']} is no better than predicting {task.constant_words}"
    return f"{what}: {task.label}, {', '.join(both)} ({gain}); see docs/data.md, Scores"
