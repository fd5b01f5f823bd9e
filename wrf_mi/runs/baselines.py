"""A model's scores against simple predictions: the constants that are best for a score, and the references of a run."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import Record, Split
from ..core.angles import FloatArray
from ..core.task import MEAN
from ..core.types import IntArray
from ..tasks import TASKS, Task
from ..tasks.scores import signed_errors_db, summary
from .results import reference_words

CONSTANT, CONSTANT_RMSE = "constant", "constant_rmse"
"""Keys of blocks in ``metrics.json``: of the constant prediction with the best mean score, and, of powers in decibels,
with the smallest RMSE."""
SCORES, WORDS = "constant_score", "constant_words"
PREDICTION, PREDICTION_RMSE = "constant_prediction", "constant_rmse_prediction"
COUNT = "reference_neighbours"
NOT_STORED = SCORES, WORDS, PREDICTION, PREDICTION_RMSE, COUNT
"""Keys among the arrays of an evaluation, [n_rx, m]: the constant prediction's scores and words, of powers in decibels
both constant predictions, and the number of neighbours of the reference."""
CHOSEN_BY = 100  # largest number of a receiver's images by which the constant is chosen: SSIM takes milliseconds
VARIATION = "variation"  # key of the block in ``metrics.json``
LEAST_VARIATION = 0.1
"""Ratio of the standard deviations of predictions and truth over the rows, below which predictions hardly vary.

Predictions of ratio r reduce the squared error of their own mean by 1 - (1 - r)^2 at most, here by a fifth.
"""


def constant_scores(record: Record, split: Split, truth: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """Scores [n_rx, m] of a constant prediction of the test rows' truth [n_rx, m, ...], and its words, by `NOT_STORED`.

    It is the one of `wrf_mi.tasks.Task.constants` with the best mean score on the training rows, validation rows
    included, that a receiver received; a receiver without any, which the split holds out, takes those of all receivers.
    Of powers in decibels that prediction is added, and the mean of the training rows, which has their smallest RMSE.
    Truth is NaN where it is not scored.
    """
    task, rows = record.task, split.all_train
    observed = record.seen(split).observation[:, rows]
    received = np.asarray(np.isfinite(observed).reshape(*observed.shape[:2], -1).all(axis=2))
    trained: dict[str, list[FloatArray]] = {}
    tested: dict[str, list[FloatArray]] = {}
    predicted: dict[str, list[NDArray[Any]]] = {}
    centres: list[NDArray[Any]] = []
    for values, is_received, expected in zip(observed, received, truth, strict=True):
        training_values = values[is_received] if is_received.any() else observed[received]
        centres.append(np.broadcast_to(training_values.mean(axis=0), expected.shape))
        sample = training_values[evenly_spaced(len(training_values), CHOSEN_BY)] if task.image else training_values
        for words, constant in task.constants(training_values).items():
            for scores, rows_of in ((trained, sample), (tested, expected)):
                prediction = np.broadcast_to(constant, rows_of.shape)
                scores.setdefault(words, []).append(task.of_rows(prediction[None], rows_of[None])[0])
            predicted.setdefault(words, []).append(prediction)
    # Limited, as in `against`.
    means = {words: np.nanmean(np.clip(np.concatenate(scores), *task.limits)) for words, scores in trained.items()}
    best = (max if task.higher_is_better else min)(means, key=lambda words: means[words])
    arrays = {SCORES: np.stack(tested[best]), WORDS: np.full(truth.shape[:2], best)}
    if task.in_decibel:
        arrays |= {PREDICTION: np.stack(predicted[best]), PREDICTION_RMSE: np.stack(centres)}
    return arrays


def evenly_spaced(count: int, most: int) -> IntArray:
    """Numbers of at most ``most`` of ``count`` rows, evenly spaced."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))


def variation(prediction: NDArray[Any], truth: NDArray[Any]) -> dict[str, float] | None:
    """Block of ``metrics.json``: how much predictions [n_rx, m, ...] vary over the rows, and how much the truth does.

    Returns:
        Standard deviations over the scored rows, root mean square over receivers and an observation's values, of
        ``prediction`` and ``truth``, and their ``ratio``; None: the truth has no two rows that differ.
    """
    squares = np.zeros(2)
    for of_receiver in zip(prediction, truth, strict=True):
        scored = np.isfinite(of_receiver[1]).reshape(len(of_receiver[1]), -1).all(axis=1)
        for number, values in enumerate(of_receiver):
            if scored.any():
                # About the first row: what is the same in all rows is then exactly 0.
                change = np.asarray(values[scored] - values[scored][0], np.result_type(values, np.float64))
                squares[number] += np.sum(np.square(np.abs(change - change.mean(axis=0))))
    if not squares[1]:
        return None
    deviations = np.sqrt(squares / np.count_nonzero(np.isfinite(truth)))
    return {
        "prediction": float(deviations[0]),
        "truth": float(deviations[1]),
        "ratio": float(deviations[0] / deviations[1]),
    }


def against_simple(task: Task, scores: FloatArray, arrays: dict[str, Any]) -> dict[str, Any]:
    """Blocks of ``metrics.json`` from a model's scores [n_rx, m] and the arrays of an evaluation.

    Returns:
        ``constant``, of powers in decibels ``constant_rmse``, and ``variation``.
    """
    # Folds may differ in the constant that scores best on their training rows.
    words = " or ".join(np.unique(arrays[WORDS]).tolist())
    blocks: dict[str, Any] = {CONSTANT: summary(arrays[SCORES] + 0.0) | {"words": words}}
    blocks[CONSTANT] |= against(task, scores, arrays[SCORES])
    if task.in_decibel:
        blocks[CONSTANT_RMSE] = summary(task.of_rows(arrays[PREDICTION_RMSE], arrays["truth"])) | {"words": MEAN}
        for key, prediction in ((CONSTANT, PREDICTION), (CONSTANT_RMSE, PREDICTION_RMSE)):
            blocks[key] |= signed_errors_db(arrays[prediction], arrays["truth"])
            blocks[key] |= against_rmse(arrays["prediction"], arrays[prediction], arrays["truth"])
    changes = variation(arrays["prediction"], arrays["truth"])
    return blocks if changes is None else blocks | {VARIATION: changes}


def against(task: Task, scores: FloatArray, simple: FloatArray) -> dict[str, Any]:
    """Whether a model's scores [n_rx, m] are clearly better than those of a simple prediction.

    Returns:
        ``gain``, by which the model's mean score is better, its standard error ``gain_error``, and ``beaten``.
    """
    sign = 1 if task.higher_is_better else -1
    # Limited, as a few exact or absurd predictions would decide a mean of decibels.
    gains = sign * (np.clip(scores, *task.limits) - np.clip(simple, *task.limits))
    gains = gains[np.isfinite(gains)]
    gain, error = float(gains.mean()), float(gains.std() / np.sqrt(len(gains)))
    # More than the standard error, so that chance seldom passes for a gain, and more than the last digit that is shown,
    # so that predicting all but zero does not either.
    clear = gain > max(error, 10.0**-task.digits)
    # The median is the score that tables show first.
    beaten = clear and sign * float(np.nanmedian(scores) - np.nanmedian(simple)) > 0
    return {"gain": gain, "gain_error": error, "beaten": beaten}


def against_rmse(prediction: NDArray[Any], simple: NDArray[Any], truth: NDArray[Any]) -> dict[str, Any]:
    """Whether the RMSE of predictions in dB is clearly smaller than that of simple ones, NaN where truth is.

    Returns:
        ``rmse_gain``, the difference in dB, its standard error ``rmse_gain_error``, and ``rmse_beaten``.
    """
    ours, theirs = (np.square(np.asarray(values, float) - truth) for values in (prediction, simple))
    ours, theirs = (squares[np.isfinite(squares)] for squares in (ours, theirs))
    # a - b = (a^2 - b^2) / (a + b), of which the numerator is a mean over rows.
    total = float(np.sqrt(ours.mean()) + np.sqrt(theirs.mean())) or 1.0
    gains = (theirs - ours) / total
    gain, error = float(gains.mean()), float(gains.std() / np.sqrt(len(gains)))
    return {"rmse_gain": gain, "rmse_gain_error": error, "rmse_beaten": gain > error}


def verdicts(metrics: dict[str, Any]) -> list[str]:
    """Lines on a run's scores against the constant that is best for each, and against the best simple model.

    These are the median score, and of powers in decibels the RMSE, with bias and standard deviation of the errors.
    """
    task = TASKS[metrics["task"]]
    block = metrics[task.block]
    shown = f"median {task.label} {block['median']:.3f}"
    lines = [f"{shown}: {_against_words(metrics, CONSTANT, 'median', '', task.higher_is_better)}"]
    if task.in_decibel:
        parts = f"bias {block['bias']:+.2f} dB, standard deviation {block['std']:.2f} dB"
        words = _against_words(metrics, CONSTANT_RMSE, "rmse", "rmse_", False)
        lines.append(f"RMSE {block['rmse']:.3f} dB ({parts}): {words}")
    return lines


def best_reference(references: dict[str, Any], key: str, higher_is_better: bool) -> str:
    """Name of the best of the references of a run by a score of their blocks."""
    return (max if higher_is_better else min)(references, key=lambda name: float(references[name][key]))


def _against_words(metrics: dict[str, Any], constant: str, key: str, prefix: str, higher: bool) -> str:
    """Words on a score against a constant and the best of the references, whose blocks have it as ``key``."""
    task, references = TASKS[metrics["task"]], metrics["reference"]
    best = best_reference(references, key, higher)
    rivals = [("best constant", constant_of(metrics, constant), metrics[constant])]
    rivals.append(("best simple model", reference_words(task, references, best), references[best]))
    clauses = []
    for kind, words, block in rivals:
        same = block[f"{prefix}gain"] == block[f"{prefix}gain_error"] == 0
        verdict = "equal to" if same else "better than" if block[f"{prefix}beaten"] else "no better than"
        clauses.append(f"{verdict} the {kind}, {words} ({block[key] + 0.0:.3f})")
    return "; ".join(clauses)


def warnings_of(metrics: dict[str, Any]) -> list[str]:
    """Lines about a model whose scores are not better than the constant prediction's, or that predicts a constant."""
    block, changes, lines = metrics.get(CONSTANT), metrics.get(VARIATION), list[str]()
    if block is not None and not block["beaten"]:
        task = TASKS[metrics["task"]]
        both = [f"{key} {metrics[task.block][key] + 0.0:.3f} against {block[key]:.3f}" for key in ("median", "mean")]
        gain = f"gain {block['gain']:.2g}, standard error {block['gain_error']:.2g}"
        what = f"{metrics['model']} is no better than predicting {constant_of(metrics)}"
        lines.append(f"{what}: {task.label}, {', '.join(both)} ({gain}); see docs/data.md, Scores")
    if changes is not None and changes["ratio"] < LEAST_VARIATION:
        what = f"{metrics['model']} predicts nearly the same at all positions: standard deviation over the test rows"
        deviations = f"{changes['prediction']:.2g}, of the truth {changes['truth']:.2g}"
        lines.append(f"{what} {deviations}; do not use it to tell positions apart")
    return lines


def constant_of(metrics: dict[str, Any], key: str = CONSTANT) -> str:
    """Words for a constant prediction that a run is compared with."""
    return str(metrics[key].get("words", "a constant"))  # earlier versions state none
