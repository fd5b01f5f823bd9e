"""Prediction intervals from errors on held-out training rows.

The standard deviation of a prediction error is a function of the size of the error that is to be expected (the standard
deviation that a model states, or the magnitude of the prediction) times a function of the distance to the nearest
training row. Both are piecewise linear and chosen so that 90 % of the held-out errors lie inside the 90 % intervals,
as in split conformal prediction (Lei et al., "Distribution-free predictive inference for regression", 2018).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import Prediction
from ..core.angles import FloatArray
from ..core.types import IntArray
from ..tasks import Task
from ..tasks.scores import COMPLEX_90, REAL_90

LEVEL = 0.9
SIZES, DISTANCES = 8, 4
"""Largest numbers of groups by size and by distance."""
GROUP_ROWS = 12
"""Least average number of rows in a group: intervals of smaller ones follow their rows and are too narrow elsewhere."""
MOST_VALUES = 400_000
"""Largest number of errors that are sorted; more are thinned evenly."""
GAPS = ("distance_m",)
"""Arrays that may hold infinity (`wrf_mi.models.model.Model.gaps`): distances to receivers without training rows."""
SMALLEST = 1e-6
"""Smallest standard deviation, relative to the median held-out error, and smallest factor."""
LEAST = float(np.finfo(np.float32).tiny) / SMALLEST**2
"""Smallest standard deviation: factors do not make it zero in single precision, as intervals of zero width would be."""


@dataclass(frozen=True)
class Intervals:
    """Standard deviations of prediction errors.

    Attributes:
        size: sizes at the knots [a].
        std: standard deviation at these sizes [a], in the observations' unit.
        distance_m: distances at the knots [b], metres.
        factor: factor at these distances [b].
    """

    size: FloatArray
    std: FloatArray
    distance_m: FloatArray
    factor: FloatArray

    def __call__(self, mean: NDArray[Any], size: FloatArray, distance_m: FloatArray) -> Prediction:
        """Prediction with standard deviations.

        Args:
            mean: predictions [m, ...].
            size: sizes of their expected errors [m, ...], see `expected_size`.
            distance_m: distances to the nearest training row [m], metres; infinite: that of the last knot.
        """
        std = np.interp(size, self.size, self.std)
        std *= _columns(np.interp(distance_m, self.distance_m, self.factor), std.ndim)
        return Prediction(mean, std)


def expected_size(task: Task, found: Prediction) -> FloatArray:
    """Size of the expected error of each value, from which intervals are calibrated.

    The standard deviation that a model states; else the magnitude of the prediction, but for powers in decibels, whose
    magnitude says nothing about the error.
    """
    if found.std is not None:
        return found.std
    return np.ones(found.mean.shape) if task.in_decibel else np.abs(found.mean).astype(float)


def fit_intervals(
    mean: NDArray[Any], observed: NDArray[Any], size: FloatArray, distance_m: FloatArray, row: IntArray
) -> Intervals:
    """Intervals from held-out predictions.

    Args:
        mean: held-out predictions [q, ...].
        observed: observations [q, ...].
        size: size of the expected error of each value [q, ...], see `expected_size`.
        distance_m: distance of each to the nearest row of its fit [q], metres.
        row: row that each belongs to [q]: those of one row, held out twice or received by several, have errors alike.
    """
    inside = COMPLEX_90 if np.iscomplexobj(observed) else REAL_90
    step = max(1, mean.size // MOST_VALUES)
    sizes, error = (np.ravel(values)[::step] for values in (size, np.abs(mean - observed)))
    distance = np.broadcast_to(_columns(distance_m, mean.ndim), mean.shape).ravel()[::step]
    # Receivers of one row have errors alike; values of an image or channel differ as much within as between rows.
    count = len(np.unique(row)) if mean.ndim == 1 else error.size
    level = min(LEVEL * (1 + 1 / count), 1.0)
    floor = max(
        SMALLEST * float(np.median(error)), float(np.finfo(np.float32).eps * np.median(np.abs(observed))), LEAST
    )
    groups = max(1, len(np.unique(row)) // GROUP_ROWS)
    knots, std = _by_group(sizes, error, min(groups, SIZES), level)
    std = np.maximum(std / inside, floor)
    ratio = error / (inside * np.interp(sizes, knots, std))
    places, factor = _by_group(distance, ratio, min(groups, DISTANCES), level)
    # Beyond the largest distance errors are those at it, never smaller than nearer ones.
    factor = np.maximum.accumulate(np.maximum(factor, SMALLEST))
    whole = np.quantile(ratio / np.interp(distance, places, factor), level)
    return Intervals(knots, std, places, factor * max(float(whole), SMALLEST))


def _by_group(by: FloatArray, values: FloatArray, count: int, level: float) -> tuple[FloatArray, FloatArray]:
    """Medians of ``by`` and quantiles of ``values`` in groups of equal numbers, ascending and distinct."""
    parts = np.array_split(np.argsort(by, kind="stable"), count)
    knots = np.array([np.median(by[part]) for part in parts])
    found = np.array([np.quantile(values[part], level) for part in parts])
    distinct, place = np.unique(knots, return_inverse=True)
    return distinct, np.array([found[place == group].mean() for group in range(len(distinct))])


def _columns(values: FloatArray, axes: int) -> FloatArray:
    """Values [m] with further axes of length one."""
    return np.asarray(values, float).reshape(-1, *[1] * (axes - 1))
