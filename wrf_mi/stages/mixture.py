"""Fit of a mixture: parts, each judged by held-out rows, whose errors choose weights by distance and intervals.

The hybrid has several parts; ``wrf-mi train --intervals`` fits any other model as the only one (`WithIntervals`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..core import InputError, Prediction, Split
from ..core.types import FloatArray
from ..estimators.held_out import fit_model, held_out_predictions, hold_out_once, labelled
from ..estimators.model import Arrays, Fitted, HeldOutPrediction, Model, Problem, Session, known_positions
from ..training import by_distance
from ..training.by_distance import SINGLE, Intervals, Mixture
from ..training.selection import HeldOut
from .fitted import NEGLIGIBLE, PATHS, PREDICTED, STATED, FittedMixture, Residuals, mixed
from .scene import RESIDUAL

HELD_OUT = "held_out"  # folder of the fits without held-out rows
STATED_ROWS = 35
"""Held-out rows that count as much as the deviations that parts state of strengths. The logarithm of the 90 % quantile
of n errors in standard deviations has a standard error of 0.88 / sqrt(n); for stated deviations 0.15 is taken:
(0.88 / 0.15)^2."""


class Part(NamedTuple):
    """A model of a mixture, its problem, and the session of its fit."""

    model: Model
    problem: Problem
    session: Session


@dataclass(frozen=True)
class ChosenWeights:
    """Weights of predictions that held-out rows choose."""

    form: str  # one of `wrf_mi.training.by_distance.FORMS`, or a single prediction
    mixture: Mixture
    cross_fitted: FloatArray  # weights of each held-out row by fits of the form without its group [q, k]


class MixtureFit:
    """Fit of a mixture to the rows of a split.

    Args:
        name: name of the model.
        parts: parts by name, the first of which is used alone unless a mixture is clearly better.
        problem: problem of the fit.
        split: split whose training rows are held out and fitted.
        session: session of the fit.

    Attributes:
        rows: rows that are held out; None: none can be.
        fitted: parts that are fitted to all rows, by name; those of the caller are not fitted anew.
        predictions: predictions of the held-out rows by fits to the others, by name, of which weights are chosen.
    """

    def __init__(self, name: str, parts: Mapping[str, Part], problem: Problem, split: Split, session: Session) -> None:
        self.name, self.parts, self._problem, self._split, self._session = name, parts, problem, split, session
        self.rows = hold_out_once(problem, split)
        self.fitted = dict[str, Fitted]()
        self.predictions = dict[str, HeldOutPrediction]()

    def part(self, name: str) -> Fitted:
        """A part fitted to all rows."""
        if name not in self.fitted:
            model, problem, session = self.parts[name]
            session.folder.mkdir(parents=True, exist_ok=True)
            self.fitted[name] = fit_model(model, problem, self._split, labelled(session, name))[0]
        return self.fitted[name]

    def predict_held_out(self, name: str) -> None:
        """Predict the held-out rows by a part, fitted to all rows first if it chooses by held-out rows itself."""
        (model, problem, session), unseen = self.parts[name], None
        if name in self.fitted or model.selects(problem, [self._split]):
            unseen = self.part(name).unseen
        if self.rows is None:
            return
        if unseen is None:
            place = replace(session, folder=session.folder / HELD_OUT)
            unseen = held_out_predictions(model, problem, self.rows.fold, self.rows.held_out, place, name)
            session.discarded.append(place.folder)
        self.predictions[name] = unseen

    @property
    def names(self) -> list[str]:
        """Names of the predictions that have weights."""
        return [*self.predictions] or [*self.parts]

    def weights(self) -> ChosenWeights:
        """Weights of the predictions by the held-out rows; without any, or with one prediction, that of the first."""
        first = np.eye(len(self.names))[0]
        if self.rows is None:
            return ChosenWeights("alone", by_distance.constant(first), np.zeros((0, len(first))))
        held_out = self.rows.held_out
        if len(first) == 1:
            return ChosenWeights(SINGLE, by_distance.constant(first), np.ones((len(held_out), 1)))
        # Errors are independent between rows, or where receivers are held out, between these.
        unit = held_out.receiver if self._split.held_receivers else held_out.row
        scores_of = by_distance.HeldOutScores(self._score, held_out.distance_m, unit, len(first))
        progress = partial(self._session.progress, "choosing weights")
        return ChosenWeights(*by_distance.choose_weights(scores_of, held_out.group, progress, trusted=0))

    @cached_property
    def _score(self) -> by_distance.RowScores:
        """Scores of held-out observations by weights of the predictions, the higher the better."""
        assert self.rows is not None
        means = np.stack([prediction.mean for prediction in self.predictions.values()])
        record = self._problem.record
        return record.task.mixtures(means, self.rows.held_out.observed(record))

    def scores(self, chosen: ChosenWeights) -> dict[str, float]:
        """Mean held-out scores of the predictions and of the mixture, by name; none without held-out rows."""
        if self.rows is None:
            return {}
        distance_m, higher = self.rows.held_out.distance_m, self._problem.record.task.higher_is_better
        every, alone = np.arange(len(distance_m)), np.eye(len(self.names))
        weights = {
            name: np.broadcast_to(weight, (len(every), len(weight)))
            for name, weight in zip(self.names, alone, strict=True)
        }
        weights[self.name] = chosen.mixture(distance_m)
        return {name: (1 if higher else -1) * float(self._score(each, every).mean()) for name, each in weights.items()}

    def used(self, chosen: ChosenWeights) -> list[str]:
        """Names of predictions with a weight, the residuals as the last and with the scene model they are about."""
        largest = chosen.mixture.weights.max(axis=0)
        used = [name for name, most in zip(self.names, largest, strict=True) if most >= NEGLIGIBLE]
        if RESIDUAL in used:
            used.remove(RESIDUAL)
            used = [*(() if PATHS in used else (PATHS,)), *used, RESIDUAL]
        return used

    def mixture(self, chosen: ChosenWeights, residuals: Residuals | None, stated: dict[str, Any]) -> FittedMixture:
        """The parts with a weight, fitted to all rows, with intervals and reception.

        Args:
            chosen: weights.
            residuals: what the scene model leaves, if that has a weight.
            stated: entries of ``metrics.json``, to which the sizes of expected errors are added.
        """
        used, trained_rows = self.used(chosen), self._problem.rows(self._split)
        parts = {name: self.part(name) for name in used if name != RESIDUAL}
        columns = [self.names.index(name) for name in used]
        weights = Mixture(chosen.mixture.distance_m, chosen.mixture.weights[:, columns])
        deviations, intervals = tuple[str, ...](), None
        if self.rows is not None:
            deviations, intervals = self._intervals(self.rows.held_out, chosen.cross_fitted, parts)
        of_errors = residuals if RESIDUAL in used else None, intervals, deviations
        stated = stated | {"sizes": STATED if deviations else PREDICTED}
        fitted = FittedMixture(self.name, self._problem, trained_rows, parts, weights, *of_errors, stated)
        if self.rows is not None:
            every = [self.predictions[name].every for name in parts]
            pairs = [predicted for predicted in every if predicted is not None]
            if len(pairs) == len(parts):
                fitted.fit_reception(self.rows, pairs)
        return fitted

    def _intervals(
        self, held_out: HeldOut, weights: FloatArray, used: Mapping[str, Fitted]
    ) -> tuple[tuple[str, ...], Intervals]:
        """Names of the parts whose standard deviations are the sizes of expected errors, and calibrated intervals.

        ``weights`` [q, k] are those that each held-out row has not chosen: intervals are cross-fitted over the groups.
        """
        task, observed = self._problem.record.task, held_out.observed(self._problem.record)
        states = np.array([name in used and each.std is not None for name, each in self.predictions.items()])
        # Mixed spectra and channels have errors like their magnitudes: what kriging of few rows states is next to
        # nothing at some values, and a factor that suits these is much too wide elsewhere.
        states &= task.trusts_stated_std or states.all()
        predicted = mixed(weights, [*self.predictions.values()], states)
        mean, of_rows = predicted.mean, (held_out.distance_m, held_out.row, held_out.group)
        # Kriging of two or three rows may pass through all of them.
        if predicted.std is None or not (predicted.std > 0).all():
            size = by_distance.expected_size(task, Prediction(mean))
            return (), by_distance.fit_intervals(mean, observed, size, *of_rows)
        # Few rows tell a factor of stated deviations, not how errors depend on them.
        std, ones = predicted.std, np.ones(mean.shape)
        intervals = by_distance.fit_intervals(mean / std, observed / std, ones, *of_rows)
        if task.trusts_stated_std:
            # Strengths calibrate what they state by rows that they hold out: few more rows change little of it.
            rows = len(np.unique(held_out.row))
            trust = rows / (rows + STATED_ROWS)
            intervals = replace(intervals, std=intervals.std**trust, factor=intervals.factor**trust)
        return tuple(name for name, counts in zip(self.predictions, states, strict=True) if counts), intervals


class WithIntervals(Model):
    """A model with calibrated intervals, which states all else as the model does; its fit takes twice as long."""

    def __init__(self, model: Model) -> None:
        vars(self).update({name: getattr(model, name) for name in Model.__annotations__})
        self.model, self.gaps = model, (*model.gaps, *by_distance.GAPS)

    def fit(self, problem: Problem, split: Split, session: Session) -> FittedMixture:
        """Fit the model, and once more without held-out rows, whose errors calibrate the intervals."""
        fit = MixtureFit(self.name, {self.name: Part(self.model, problem, session)}, problem, split, session)
        fitted = fit.fitted[self.name] = self.model.fit(problem, split, session)
        fit.predict_held_out(self.name)
        return fit.mixture(fit.weights(), None, fitted.facts())

    def load(self, arrays: Arrays, problem: Problem, folder: Path) -> FittedMixture:
        """The model and its intervals."""
        return FittedMixture.from_arrays(
            self.name, arrays, problem, lambda _, of_model: self.model.load(of_model, problem, folder)
        )

    def uses_places(self, problem: Problem, splits: Sequence[Split]) -> bool:
        """As the model."""
        return self.model.uses_places(problem, splits)

    def check(self, problem: Problem, splits: Sequence[Split]) -> None:
        """Refuse rows that are too few to hold some out, and what the model refuses."""
        record = problem.record
        for split in splits:
            rows = problem.rows(split)
            known_positions(record, rows, f"{self.name} with intervals")
            held_out = hold_out_once(problem, split) if len(rows) else None
            if split.held_receivers and held_out is None:
                raise InputError(f"{record.name}: one receiver trains; intervals at others need two at least")
            if held_out is None or not np.isfinite(record.observation[:, rows]).any():
                text = "intervals need three at least, at two positions"
                raise InputError(f"{record.name}: {len(rows)} training rows; {text}")
        self.model.check(problem, splits)

    def unused_settings(self, problem: Problem, splits: Sequence[Split]) -> Mapping[str, str]:
        """As of the model."""
        return self.model.unused_settings(problem, splits)

    def prepare(self, problem: Problem, splits: Sequence[Split], session: Session) -> Any:
        """Settings of the model without open choices."""
        return self.model.prepare(problem, splits, session)
