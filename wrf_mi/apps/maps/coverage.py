"""Probability of coverage from predicted powers, and how reliable it is on test rows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr

from ...core import InputError, Prediction
from ...core.angles import FloatArray
from ...runs.results import read_run
from ...tasks import TASKS
from ...tasks.scores import calibration_bins, probability_scores

QUANTILES = np.linspace(0.1, 0.9, 9)  # quantiles of the measured levels that are thresholds where none is stated
FEWEST = 20  # least number of pairs in a bin that is drawn


def coverage_probability(
    level_db: ArrayLike, std_db: ArrayLike, threshold_db: float, reception: ArrayLike | None = None
) -> FloatArray:
    """Probability that a normal level with a mean and a standard deviation exceeds a threshold, in any shape.

    With the probability of ``reception``, of which mean and deviation are conditional: that it is received and exceeds.

    >>> coverage_probability([-90.0, -80.0], [5.0, 5.0], -90.0).round(3).tolist()
    [0.5, 0.977]
    >>> coverage_probability(-80.0, 5.0, -90.0, reception=0.5).round(3).tolist()
    0.489
    """
    above = np.asarray(level_db, float) - threshold_db
    with np.errstate(divide="ignore", invalid="ignore"):
        exceeds = np.asarray(ndtr(above / np.asarray(std_db, float)))
    return exceeds if reception is None else np.asarray(exceeds * reception)


@dataclass(frozen=True)
class Reliability:
    """Predicted probabilities of coverage against observed shares, in bins of the probability; NaN in empty bins."""

    predicted: FloatArray  # mean predicted probability in each bin [b]
    observed: FloatArray  # share of the measured levels above the threshold [b]
    count: NDArray[np.int64]  # number of pairs of an observation and a threshold [b]
    error: float  # mean of abs(observed - predicted) over all pairs (expected calibration error)
    # Mean of (predicted - 0 or 1)^2 over all pairs: Brier, "Verification of forecasts expressed in terms of
    # probability" (1950).
    brier: float
    threshold_db: FloatArray  # thresholds [t]


def reliability(
    level_db: FloatArray,
    std_db: FloatArray,
    measured_db: FloatArray,
    threshold_db: FloatArray | None = None,
    reception: FloatArray | None = None,
) -> Reliability:
    """Reliability of probabilities of coverage from predicted levels, their deviations and measured levels, any shape.

    Measured levels are NaN where nothing was received, which counts as not covered where the probability of
    ``reception`` is stated and else not at all. Thresholds [t] are by default `QUANTILES` of the measured levels.
    `InputError` where nothing was measured.
    """
    finite = np.isfinite(measured_db)
    if not finite.any():
        raise InputError("coverage: no measured level to compare with; give a run whose test rows were received")
    thresholds = np.quantile(measured_db[finite], QUANTILES) if threshold_db is None else np.atleast_1d(threshold_db)
    counted = finite if reception is None else np.isfinite(reception)
    received = None if reception is None else reception[counted]
    level, std, measured = (np.asarray(values, float)[counted] for values in (level_db, std_db, measured_db))
    probability = np.concatenate([coverage_probability(level, std, float(limit), received) for limit in thresholds])
    exceeded = np.concatenate([measured > threshold for threshold in thresholds])
    scores = probability_scores(probability, exceeded)
    bins = calibration_bins(probability, exceeded)
    return Reliability(*bins, scores["calibration_error"], scores["brier"], thresholds)


def run_reliability(folder: str | Path, threshold_db: FloatArray | None = None) -> Reliability:
    """Reliability of probabilities of coverage on the test rows of a run, those of all its folds.

    Thresholds are in the unit of `wrf_mi.tasks.Task.level`; None: quantiles of the measured levels. `InputError`: not a
    finished run, or its model states no standard deviation.
    """
    results = read_run(folder)
    if results.std is None:
        raise InputError(f"{folder}: its model states no standard deviation; train with --intervals")
    task = TASKS[results.task]

    def levels(values: Any, std: Any = None) -> Prediction:
        rows = int(np.prod(values.shape[:2]))
        deviations = None if std is None else np.asarray(std, float).reshape(rows, *std.shape[2:])
        return task.level(Prediction(values.reshape(rows, *values.shape[2:]), deviations))

    predicted = levels(results.prediction, results.std)
    received = None if results.reception is None else results.reception.astype(float).ravel()
    return reliability(predicted.mean, predicted.stated_std, levels(results.truth).mean, threshold_db, received)


def reliability_figure(results: Mapping[str, Reliability]) -> Figure:
    """Observed share against predicted probability of coverage; bins of fewer than `FEWEST` pairs are left out."""
    figure = Figure(figsize=(4.6, 4.4), layout="constrained")
    axes = figure.subplots()
    axes.plot([0, 1], [0, 1], color="0.6", linewidth=1, linestyle="--", label="calibrated")
    for name, result in results.items():
        shown = result.count >= FEWEST
        label = f"{name} (error {result.error:.3f})"
        axes.plot(result.predicted[shown], result.observed[shown], marker="o", markersize=4, linewidth=1.2, label=label)
    axes.set(xlim=(0, 1), ylim=(0, 1), aspect="equal")
    axes.set_xlabel("predicted P(level > threshold)")
    axes.set_ylabel("observed share of test values")
    axes.legend(fontsize=7)
    axes.grid(alpha=0.3)
    return figure
