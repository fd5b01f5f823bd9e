"""What depends on the distance to the nearest training row: weights of Gaussians and of predictions, and intervals.

- `Reach`: weight of the Gaussians' signal beside the paths of a scene, and of channels, which are zero without them.
- `Mixture`: weights of several predictions.
- `Intervals`: standard deviations of prediction errors.

All are chosen on rows that are held out (`wrf_mi.training.selection`), some near the training rows and some far.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import Prediction
from ..core.angles import FloatArray
from ..core.types import IntArray
from ..tasks import Task
from ..tasks.scores import COMPLEX_90, LEVEL, REAL_90
from .gains import improves, last_gain
from .selection import RowDistance

LENGTHS = 7
"""Number of reaches tried beside 0: each twice the one before, the last four times the largest distance held out."""
NEGLIGIBLE = 1e-4  # weight below which Gaussians are not evaluated: the largest relative change of their signal

KNOTS, KNOT_ROWS = 4, 20
"""Largest number of distances at which weights are chosen, and least number of held-out observations for each."""
FIRST, STEPS = 3, 12
"""Share of the best single prediction at the start of the forward selection, in steps, and largest number of steps."""
CLEAR_GAIN_STANDARD_ERRORS = 2.0
"""Standard errors required of a gain: by chance five rows exceed one standard error one time in five."""

SIZES, DISTANCES = 8, 4  # largest numbers of groups by size and by distance
GROUP_ROWS = 12
"""Least average number of rows in a group: intervals of smaller ones follow their rows and are too narrow elsewhere."""
LEAST_GROUPS = 3  # fewest groups that tell how much they differ: of two, each would be judged by the other alone
MOST_ERRORS = 400_000  # largest number of errors that are sorted; more are thinned evenly
GAPS = ("distance_m",)
"""Arrays that may hold infinity (`wrf_mi.estimators.model.Model.gaps`): distances to receivers without rows."""
SMALLEST = 1e-6  # smallest standard deviation, relative to the median held-out error, and smallest factor
LEAST = float(np.finfo(np.float32).tiny) / SMALLEST**2
"""Smallest standard deviation: factors do not make it zero in single precision, as intervals of zero width would be."""


@dataclass(frozen=True)
class Reach:
    """Region in which a field's Gaussians are used.

        w(x) = exp(-(d(x) / reach)^2)

    d is the distance to the nearest training transmitter, and w scales the Gaussians' signal. They interpolate between
    neighbours; farther away than a fraction of a wavelength they add noise. A reach of 0 switches them off, an infinite
    one uses them everywhere.

    Attributes:
        known_m: training transmitters that each receiver observed, [k, 3] in metres.
        length_m: the reach, metres.
    """

    known_m: tuple[FloatArray, ...]
    length_m: float

    @cached_property
    def distance(self) -> RowDistance:
        """Distance of transmitters to the nearest training transmitter of a receiver."""
        return RowDistance(lambda receiver: self.known_m[receiver])

    def weight(self, tx_pos_m: FloatArray, receiver: int) -> NDArray[np.float32]:
        """Weight w of the Gaussians' signal for transmitters [m, 3], 0 to 1; 0 where it is below `NEGLIGIBLE`."""
        if self.length_m == 0 or np.isinf(self.length_m):
            return np.full(len(tx_pos_m), float(self.length_m > 0), np.float32)
        weight = np.exp(-np.square(self.distance(tx_pos_m, receiver) / self.length_m))
        return np.where(weight < NEGLIGIBLE, 0, weight).astype(np.float32)

    def lengths(self, tx_pos_m: Sequence[FloatArray]) -> list[float]:
        """Candidate reaches from held-out transmitters [m, 3] of each receiver, from 0 upwards."""
        # With the longest reach w is 0.94 at the farthest held-out row: nothing tells longer ones apart.
        away_m = [self.distance(tx_pos_m[r], r) for r, known_m in enumerate(self.known_m) if len(known_m)]
        largest = float(np.max(np.concatenate(away_m), initial=0.0)) if away_m else 0.0
        return [0.0, *(4 * largest * 0.5 ** np.arange(LENGTHS))[::-1]] if largest else [0.0, np.inf]


def choose_reach(
    reach: Reach, lengths: Sequence[float], score: Callable[[Reach], FloatArray], higher_is_better: bool
) -> tuple[float, FloatArray]:
    """The reach by scores of held-out transmitters.

    Args:
        reach: reach with the training transmitters.
        lengths: candidates in ascending order, metres.
        score: scores of the held-out transmitters of all receivers with a reach.
        higher_is_better: direction of the score.

    Returns:
        The last reach that improves on the one kept before it (`improves`), metres, and its scores.
    """
    scores = {length_m: score(replace(reach, length_m=length_m)) for length_m in lengths}
    best = last_gain(scores.items(), higher_is_better)
    return best, scores[best]


RowScores = Callable[[FloatArray, IntArray], FloatArray]
"""From weights [n, k] of some held-out observations and their numbers [n] to scores [n], the higher the better."""


@dataclass(frozen=True)
class Mixture:
    """Weights of predictions, piecewise linear in the distance.

    Attributes:
        distance_m: distances [b], metres, ascending.
        weights: weights [b, k] at these distances, of sum 1.
    """

    distance_m: FloatArray
    weights: FloatArray

    def __call__(self, distance_m: FloatArray) -> FloatArray:
        """Weights [m, k] at distances [m]; those at the last knot beyond it."""
        return np.stack([np.interp(distance_m, self.distance_m, column) for column in self.weights.T], axis=1)


def constant(weights: FloatArray) -> Mixture:
    """The same weights [k] at all distances."""
    return Mixture(np.zeros(1), weights[None])


@dataclass(frozen=True)
class HeldOutScores:
    """Scores of held-out observations by the weights of several predictions, and forms of weights fitted to some.

    Attributes:
        score: scores of observations by their weights.
        distance_m: distance of each to the nearest training row [q], metres.
        unit: number of the unit that each belongs to [q]; errors are independent between units.
        count: number k of predictions.
    """

    score: RowScores
    distance_m: FloatArray
    unit: IntArray
    count: int

    def averaged(self, rows: IntArray) -> Mixture:
        """One mixture for all distances, by forward selection that starts from equal weights.

        Few held-out observations tell predictions of similar scores apart by chance; equal weights hedge against that.
        Predictions that are worse than the best one by more than `CLEAR_GAIN_STANDARD_ERRORS` start without
        weight.
        """
        scores = [self.score(np.broadcast_to(weights, (len(rows), self.count)), rows) for weights in np.eye(self.count)]
        means = [unit_means(values, self.unit[rows]) for values in scores]
        best = max(means, key=np.mean)
        alike = np.array([not improves(best, mean, True, CLEAR_GAIN_STANDARD_ERRORS) for mean in means])
        return constant(self._selected(rows, np.ones(len(rows)), alike / alike.sum(), int(alike.sum())))

    def mixed(self, rows: IntArray) -> Mixture:
        """One mixture for all distances, by forward selection that starts from the best single prediction."""
        return constant(self._best_selected(rows, np.ones(len(rows))))

    def by_distance(self, rows: IntArray) -> Mixture:
        """A mixture as `mixed` at each of some distances.

        An observation counts at the two knots next to its distance, the more the nearer.
        """
        distance_m = self.distance_m[rows]
        knots = _knots(distance_m)
        shares = np.stack([np.interp(distance_m, knots, column) for column in np.eye(len(knots))])
        return Mixture(knots, np.stack([self._best_selected(rows[share > 0], share[share > 0]) for share in shares]))

    def _best_selected(self, rows: IntArray, share: FloatArray) -> FloatArray:
        """`_selected` from the best single prediction."""
        every = np.eye(self.count)
        first = every[int(np.argmax([self._mean(weights, rows, share) for weights in every]))]
        return self._selected(rows, share, first, FIRST)

    def _selected(self, rows: IntArray, share: FloatArray, weights: FloatArray, begun: int) -> FloatArray:
        """Weights [k] of a forward selection from ``weights``, which count as ``begun`` steps."""
        # Caruana, Niculescu-Mizil, Crew and Ksikes, "Ensemble selection from libraries of models", ICML 2004: each step
        # adds one prediction, with replacement, to those that are averaged so far, while the mean score increases.
        best = self._mean(weights, rows, share)
        for step in range(begun, begun + STEPS):
            candidates = (weights * step + np.eye(self.count)) / (step + 1)
            values = [self._mean(candidate, rows, share) for candidate in candidates]
            if max(values) <= best:
                break
            best, weights = max(values), candidates[int(np.argmax(values))]
        return weights

    def _mean(self, weights: FloatArray, rows: IntArray, share: FloatArray) -> float:
        """Mean score of observations that count by their shares."""
        return float(np.average(self.score(np.broadcast_to(weights, (len(rows), self.count)), rows), weights=share))


def _knots(distance_m: FloatArray) -> FloatArray:
    finite = distance_m[np.isfinite(distance_m)]
    count = int(np.clip(len(finite) // KNOT_ROWS, 1, KNOTS))
    # Middles of groups of equal numbers: each knot's weights have as many observations.
    return np.unique(np.quantile(finite, (np.arange(count) + 0.5) / count)) if len(finite) else np.zeros(1)


SINGLE = "single"  # form of the weights before all others: one prediction alone, which is named beforehand
FORMS: Mapping[str, Callable[[HeldOutScores, IntArray], Mixture]] = {
    "averaged": HeldOutScores.averaged,
    "mixed": HeldOutScores.mixed,
    "by distance": HeldOutScores.by_distance,
}
"""Forms of the weights, in the order of their freedom."""


def choose_weights(
    scores: HeldOutScores, fold: IntArray, on_fold: Callable[[float], None], trusted: int | None = None
) -> tuple[str, Mixture, FloatArray]:
    """The form of the weights that predicts held-out scores best, fitted to all held-out observations.

    The weights [q, k] of each observation by the fits of this form without its fold are returned, too: errors of other
    rows are those of weights that these rows have not chosen.

    Each form is fitted without the observations of a fold and scored on them; a form with more freedom is taken where
    its mean score is better by more than the standard error of the difference over independent units: the receivers of
    one transmitter have errors in common. A trusted prediction is left for a gain of
    `CLEAR_GAIN_STANDARD_ERRORS`.

    Args:
        scores: scores of all held-out observations.
        fold: their folds [q].
        on_fold: called with the share of the folds that is done.
        trusted: number of the prediction that is used alone unless a mixture gains; None: mixtures only.
    """
    forms = dict(FORMS)
    if trusted is not None:
        forms = {SINGLE: lambda scores, rows: constant(np.eye(scores.count)[trusted])} | forms
    folds, every = np.unique(fold), np.arange(len(fold))
    of_forms = {name: np.full(len(fold), np.nan) for name in forms}
    without = {name: np.empty((len(fold), scores.count)) for name in forms}
    for done, number in enumerate(folds):
        out = fold == number
        for name, form in forms.items():
            # A single fold cannot be left out: forms are then scored on the rows that they are fitted to.
            mixture = form(scores, every[~out] if len(folds) > 1 else every)
            without[name][out] = mixture(scores.distance_m[out])
            of_forms[name][out] = scores.score(without[name][out], every[out])
        on_fold((done + 1) / len(folds))
    means = ((name, unit_means(values, scores.unit)) for name, values in of_forms.items())
    best = last_gain(means, True, {SINGLE: CLEAR_GAIN_STANDARD_ERRORS})
    return best, forms[best](scores, every), without[best]


def unit_means(values: FloatArray, unit: IntArray) -> FloatArray:
    """Mean value of each unit."""
    _, number = np.unique(unit, return_inverse=True)
    return np.asarray(np.bincount(number, values) / np.bincount(number))


@dataclass(frozen=True)
class Intervals:
    """Standard deviations of prediction errors.

    That of a value is a function of the size of the error that is to be expected (`expected_size`) times a function of
    the distance to the nearest training row, both piecewise linear.

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
        return Prediction(mean, self.widths(size, _columns(distance_m, size.ndim)))

    def widths(self, size: FloatArray, distance_m: FloatArray) -> FloatArray:
        """Standard deviations of errors of some sizes at distances, of shapes that broadcast."""
        return np.interp(size, self.size, self.std) * np.interp(distance_m, self.distance_m, self.factor)


def expected_size(task: Task, prediction: Prediction) -> FloatArray:
    """Size of the expected error of each value, from which intervals are calibrated.

    The standard deviation that a model states; else what the task expects (`wrf_mi.core.Task.error_size`).
    """
    return task.error_size(prediction.mean) if prediction.std is None else prediction.std


def fit_intervals(
    mean: NDArray[Any],
    observed: NDArray[Any],
    size: FloatArray,
    distance_m: FloatArray,
    row: IntArray,
    group: IntArray | None = None,
) -> Intervals:
    """Intervals of which 90 % hold the held-out observations, as in split conformal prediction.

    Args:
        mean: held-out predictions [q, ...].
        observed: observations [q, ...].
        size: size of the expected error of each value [q, ...], see `expected_size`.
        distance_m: distance of each to the nearest row of its fit [q], metres.
        row: row that each belongs to [q]: those of one row, held out twice or received by several, have errors alike.
        group: group of each [q]; intervals of the others have to hold 90 % of a group's values, too. None: one.

    Source: Lei et al., "Distribution-free predictive inference for regression", 2018.
    """
    # Half the width of a 90 % interval in standard deviations, of a real or a complex normal error.
    inside = COMPLEX_90 if np.iscomplexobj(observed) else REAL_90
    step = max(1, mean.size // MOST_ERRORS)
    groups = np.zeros(len(row), np.int64) if group is None else group
    sizes, error, distance, rows, number = (
        np.broadcast_to(_columns(np.asarray(values, float), mean.ndim), mean.shape).ravel()[::step]
        for values in (size, np.abs(mean - observed), distance_m, row, groups)
    )
    floor = max(
        SMALLEST * float(np.median(error)), float(np.finfo(np.float32).eps * np.median(np.abs(observed))), LEAST
    )
    one_each = mean.ndim == 1
    of_all = _fitted_intervals(sizes, error / inside, distance, rows, floor, one_each)
    names = np.unique(number)
    if len(names) < LEAST_GROUPS:
        return of_all
    # Few rows differ in how large their errors are: those of a group that intervals do not know exceed them more often.
    # Never narrower: the groups are a handful, and a factor below 1 is chance.
    ratio = np.empty(len(error))
    for name in names:
        out = number == name
        remaining = [values[~out] for values in (sizes, error / inside, distance, rows)]
        others = _fitted_intervals(remaining[0], remaining[1], remaining[2], remaining[3], floor, one_each)
        ratio[out] = error[out] / (inside * others.widths(sizes[out], distance[out]))
    return replace(of_all, std=of_all.std * max(float(np.quantile(ratio, LEVEL)), 1.0))


def _fitted_intervals(
    sizes: FloatArray, error: FloatArray, distance: FloatArray, row: FloatArray, floor: float, one_each: bool
) -> Intervals:
    """Intervals of the values [n] of some rows; ``error`` [n] in half widths, ``one_each``: a value of each row."""
    rows = len(np.unique(row))
    # Receivers of one row have errors alike; values of an image or channel differ as much within as between rows.
    count = rows if one_each else error.size
    # A new error exceeds the largest of n with probability 1 / (n + 1): the quantile is raised by as much.
    level = min(LEVEL * (1 + 1 / count), 1.0)
    # Groups by rows, not by values: the pixels of one image are no independent evidence.
    groups = max(1, rows // GROUP_ROWS)
    knots, std = _by_group(sizes, error, min(groups, SIZES), level)
    std = np.maximum(std, floor)
    # What the size leaves is a function of the distance: errors relative to the intervals so far.
    ratio = error / np.interp(sizes, knots, std)
    distances, factor = _by_group(distance, ratio, min(groups, DISTANCES), level)
    # Beyond the largest distance errors are those at it, never smaller than nearer ones.
    factor = np.maximum.accumulate(np.maximum(factor, SMALLEST))
    # Interpolation between knots and the accumulated maximum change the coverage: one factor restores it.
    common = np.quantile(ratio / np.interp(distance, distances, factor), level)
    return Intervals(knots, std, distances, factor * max(float(common), SMALLEST))


def _by_group(by: FloatArray, values: FloatArray, count: int, level: float) -> tuple[FloatArray, FloatArray]:
    """Medians of ``by`` and quantiles of ``values`` in groups of equal numbers, ascending and distinct."""
    parts = np.array_split(np.argsort(by, kind="stable"), count)
    knots = np.array([np.median(by[part]) for part in parts])
    quantiles = np.array([np.quantile(values[part], level) for part in parts])
    # Equal medians, as of strengths in whole decibels, are one knot: interpolation needs distinct ones.
    distinct, place = np.unique(knots, return_inverse=True)
    return distinct, np.array([quantiles[place == group].mean() for group in range(len(distinct))])


def _columns(values: FloatArray, axes: int) -> FloatArray:
    """Values [m] with further axes of length one; others as they are."""
    return values.reshape(-1, *[1] * (axes - 1)) if values.ndim == 1 else values
