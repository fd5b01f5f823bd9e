"""Weights of several predictions by the distance to the nearest training row."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ...core.angles import FloatArray
from ...core.types import IntArray
from ...training.reach import improves

KNOTS, KNOT_ROWS = 4, 20
"""Largest number of distances at which weights are chosen, and least number of held-out observations for each."""
FIRST, STEPS = 3, 12
"""Share of the best single prediction at the start of the forward selection, in steps, and largest number of steps."""

DOUBT = 2.0
"""Standard errors of a difference that is clear: by chance five rows exceed one of them one time in five."""

RowScores = Callable[[FloatArray, IntArray], FloatArray]
"""From weights [n, k] of some held-out observations and their numbers [n] to scores [n], the higher the better."""


@dataclass(frozen=True)
class Mixture:
    """Weights that are piecewise linear in the distance.

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


def averaged(score: RowScores, distance_m: FloatArray, unit: IntArray, rows: IntArray, count: int) -> Mixture:
    """One mixture for all distances, by forward selection that starts from equal weights.

    Few held-out observations tell predictions of similar scores apart by chance; equal weights hedge against that.
    Predictions that are worse than the best one by more than `DOUBT` standard errors start without weight.
    """
    scores = [score(np.broadcast_to(one, (len(rows), count)), rows) for one in np.eye(count)]
    means = [unit_means(values, unit[rows]) for values in scores]
    best = max(means, key=np.mean)
    alike = np.array([not improves(best, one, True, DOUBT) for one in means])
    return constant(_selected(score, rows, np.ones(len(rows)), alike / alike.sum(), int(alike.sum())))


def mixed(score: RowScores, distance_m: FloatArray, unit: IntArray, rows: IntArray, count: int) -> Mixture:
    """One mixture for all distances, by forward selection that starts from the best single prediction."""
    return constant(_best_selected(score, rows, np.ones(len(rows)), count))


def by_distance(score: RowScores, distance_m: FloatArray, unit: IntArray, rows: IntArray, count: int) -> Mixture:
    """A mixture as `mixed` at each of some distances.

    An observation counts at the two knots next to its distance, the more the nearer.
    """
    distance_m = distance_m[rows]
    knots = _knots(distance_m)
    shares = np.stack([np.interp(distance_m, knots, column) for column in np.eye(len(knots))])
    weights = [_best_selected(score, rows[share > 0], share[share > 0], count) for share in shares]
    return Mixture(knots, np.stack(weights))


FORMS = {"averaged": averaged, "mixed": mixed, "by distance": by_distance}
"""Forms of the weights, in the order of their freedom."""
SINGLE = "single"
"""Form before these: one prediction alone, which is named beforehand."""


def choose(
    score: RowScores,
    distance_m: FloatArray,
    fold: IntArray,
    unit: IntArray,
    count: int,
    on_fold: Callable[[float], None],
    trusted: int | None = None,
) -> tuple[str, Mixture]:
    """The form of the weights that predicts held-out scores best, fitted to all held-out observations.

    Each form is fitted without the observations of a fold and scored on them; a form with more freedom is taken where
    its mean score is better by more than the standard error of the difference over independent units: the receivers of
    one transmitter have errors in common. A trusted prediction is left for a gain of `DOUBT` errors.

    Args:
        score: scores of all held-out observations by their weights.
        distance_m: their distances [q], metres.
        fold: their folds [q].
        unit: number of the unit that each belongs to [q].
        count: number k of predictions.
        on_fold: called with the share of the folds that is done.
        trusted: number of the prediction that is used alone unless a mixture gains; None: mixtures only.
    """

    def single(score: RowScores, distance_m: FloatArray, unit: IntArray, rows: IntArray, count: int) -> Mixture:
        return constant(np.eye(count)[trusted])

    forms = FORMS if trusted is None else {SINGLE: single, **FORMS}
    folds, every = np.unique(fold), np.arange(len(fold))
    found = {name: np.full(len(fold), np.nan) for name in forms}
    for done, number in enumerate(folds):
        out = fold == number
        for name, form in forms.items():
            chosen = form(score, distance_m, unit, every[~out] if len(folds) > 1 else every, count)
            found[name][out] = score(chosen(distance_m[out]), every[out])
        on_fold((done + 1) / len(folds))
    best = next(iter(forms))
    for name in forms:
        errors = DOUBT if best == SINGLE else 1.0
        if improves(unit_means(found[name], unit), unit_means(found[best], unit), True, errors):
            best = name
    return best, forms[best](score, distance_m, unit, every, count)


def unit_means(values: FloatArray, unit: IntArray) -> FloatArray:
    """Mean value of each unit."""
    _, number = np.unique(unit, return_inverse=True)
    return np.asarray(np.bincount(number, values) / np.bincount(number))


def _selected(score: RowScores, rows: IntArray, share: FloatArray, weights: FloatArray, begun: int) -> FloatArray:
    """Weights [k] of a forward selection with replacement on some observations, which count by their shares.

    The selection goes on while the mean score increases.

    Args:
        score: scores by weights.
        rows: observations.
        share: their shares.
        weights: weights at the start [k].
        begun: number of steps that the start counts as.

    Source: Caruana, Niculescu-Mizil, Crew and Ksikes, "Ensemble selection from libraries of models", ICML 2004.
    """
    every = np.eye(len(weights))
    best = _mean(score, weights, rows, share)
    for step in range(begun, begun + STEPS):
        changed = (weights * step + every) / (step + 1)
        values = [_mean(score, one, rows, share) for one in changed]
        if max(values) <= best:
            break
        best, weights = max(values), changed[int(np.argmax(values))]
    return weights


def _best_selected(score: RowScores, rows: IntArray, share: FloatArray, count: int) -> FloatArray:
    """`_selected` from the best single prediction."""
    every = np.eye(count)
    first = every[int(np.argmax([_mean(score, one, rows, share) for one in every]))]
    return _selected(score, rows, share, first, FIRST)


def _knots(distance_m: FloatArray) -> FloatArray:
    finite = distance_m[np.isfinite(distance_m)]
    count = int(np.clip(len(finite) // KNOT_ROWS, 1, KNOTS))
    knots: FloatArray = np.unique(np.quantile(finite, (np.arange(count) + 0.5) / count)) if len(finite) else np.zeros(1)
    return knots


def _mean(score: RowScores, weights: FloatArray, rows: IntArray, share: FloatArray) -> float:
    scores = score(np.broadcast_to(weights, (len(rows), len(weights))), rows)
    return float(np.average(scores, weights=share))
