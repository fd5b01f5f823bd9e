"""Any model with prediction intervals from held-out training rows, as ``wrf-mi train --intervals`` fits it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..core import InputError, Prediction, Record, Split
from ..core.angles import FloatArray
from ..core.array_files import keyed, under
from ..core.types import IntArray
from ..tasks import task_of
from ..training.by_distance import GAPS, Intervals, expected_size, fit_intervals
from ..training.selection import HeldOut, RowDistance, hold_out
from .error_prior import ErrorPrior
from .held_out import held_out_predictions
from .model import (
    Arrays,
    Decomposition,
    Fitted,
    Inputs,
    Model,
    Problem,
    Session,
    field_arrays,
    from_field_arrays,
    known_positions,
)
from .reception import Reception

INTERVALS, ROWS = "intervals/", "intervals_rows"  # prefix of the arrays of intervals, and key of the training rows


class FittedWithIntervals(Fitted):
    """A fitted model whose standard deviations are those of held-out errors, by the distance to training rows [n].

    Of signal strengths with rows that were not received it states the probability of reception, too.
    """

    def __init__(
        self, fitted: Fitted, record: Record, rows: IntArray, intervals: Intervals, reception: Reception | None
    ) -> None:
        self.fitted, self._record, self._rows, self._intervals = fitted, record, rows, intervals
        self._reception = reception
        self._distance = RowDistance.of_rows(record, rows)
        self.receivers, self.uses_heading, self.carriers_hz = fitted.receivers, fitted.uses_heading, fitted.carriers_hz

    def _stated(self, prediction: Prediction, tx_pos_m: FloatArray, receiver: int) -> Prediction:
        distance_m = self._distance(tx_pos_m, receiver)
        stated = self._intervals(prediction.mean, expected_size(task_of(self._record), prediction), distance_m)
        if prediction.std_mean is not None:  # deviations of the mean are as wrong as those of readings
            factor = stated.stated_std / prediction.stated_std
            stated = replace(stated, std_mean=prediction.std_mean * factor)
        return stated if self._reception is None else self._reception(stated, tx_pos_m, receiver)

    def predict(self, inputs: Inputs, receiver: int) -> Prediction:
        """Prediction of the model with calibrated standard deviations, [m, ...]."""
        return self._stated(self.fitted.predict(inputs, receiver), inputs.tx_pos_m, receiver)

    def predict_rows(self, rows: IntArray, receiver: int) -> Prediction | None:
        """Stored predictions of the model with calibrated standard deviations."""
        stored = self.fitted.predict_rows(rows, receiver)
        return None if stored is None else self._stated(stored, self._record.tx_pos_m[rows], receiver)

    def decompose(self, inputs: Inputs, receiver: int, std: bool = True) -> Decomposition:
        """Decomposition of the model's prediction, with calibrated standard deviations."""
        decomposed = self.fitted.decompose(inputs, receiver, std)
        return replace(decomposed, prediction=self._stated(decomposed.prediction, inputs.tx_pos_m, receiver))

    def _about(self, fitted: Fitted, rows: IntArray) -> FittedWithIntervals:
        return FittedWithIntervals(fitted, self._record, rows, self._intervals, self._reception)

    def tracing_once(self) -> FittedWithIntervals:
        """The model that traces once, with the intervals."""
        return self._about(self.fitted.tracing_once(), self._rows)

    def refit(self, record: Record, rows: IntArray) -> FittedWithIntervals | None:
        """The model given some rows, see `Fitted`, with the intervals at the distances to these."""
        refit = self.fitted.refit(record, rows)
        return None if refit is None else self._about(refit, rows)

    def error_prior(self, receiver: int) -> ErrorPrior | None:
        """As of the model: intervals change the size of errors, not where they are large."""
        return self.fitted.error_prior(receiver)

    def in_scene(self, scene: str) -> FittedWithIntervals:
        """The model in an edited scene, with the intervals of the scene that it was fitted in."""
        return self._about(self.fitted.in_scene(scene), self._rows)

    @property
    def depends_on_heading(self) -> bool:
        """As the model."""
        return self.fitted.depends_on_heading

    def arrays(self) -> Arrays:
        """Arrays of the model, of the intervals and of the reception."""
        reception = {} if self._reception is None else keyed(INTERVALS, self._reception.arrays())
        return self.fitted.arrays() | field_arrays(self._intervals, INTERVALS) | reception | {ROWS: self._rows}

    def facts(self) -> dict[str, object]:
        """Facts of the model and of the reception."""
        return self.fitted.facts() | ({} if self._reception is None else self._reception.facts(self._record))


class WithIntervals(Model):
    """A model with calibrated intervals, which states all else as the model does; its fit takes twice as long."""

    def __init__(self, model: Model) -> None:
        vars(self).update({name: getattr(model, name) for name in Model.__annotations__})
        self.model, self.gaps = model, (*model.gaps, *GAPS)

    def fit(self, problem: Problem, split: Split, session: Session) -> FittedWithIntervals:
        """Fit the model, and once more without held-out rows, whose errors calibrate the intervals."""
        record = problem.record
        fitted = self.model.fit(problem, split, session)
        fold = _fold(self.model, problem, split)
        held_out = HeldOut.of(record, fold, problem.seed)
        predicted = fitted.unseen
        if predicted is None:
            place = replace(session, folder=session.folder / "held_out")
            predicted = held_out_predictions(self.model, problem, fold, held_out, place, self.name)
            session.discarded.append(place.folder)
        size = expected_size(task_of(record), predicted)
        of_rows = held_out.distance_m, held_out.row, held_out.group
        intervals = fit_intervals(predicted.mean, held_out.observed(record), size, *of_rows)
        reception, every, rows = None, predicted.every, problem.rows(split)
        if every is not None:
            distance_m = RowDistance.of_rows(record, fold.all_train).of_pairs(record, *held_out.every.T)
            stated = intervals(every.mean, expected_size(task_of(record), every), distance_m)
            reception = Reception.fit(record, rows, fold.all_train, held_out, stated)
        return FittedWithIntervals(fitted, record, rows, intervals, reception)

    def load(self, arrays: Arrays, problem: Problem, folder: Path) -> FittedWithIntervals:
        """The model and its intervals."""
        intervals = from_field_arrays(Intervals, under(INTERVALS, arrays))
        of_model = {key: values for key, values in arrays.items() if not key.startswith("intervals")}
        fitted = self.model.load(of_model, problem, folder)
        reception = Reception.from_arrays(under(INTERVALS, arrays), problem.record)
        return FittedWithIntervals(fitted, problem.record, arrays[ROWS], intervals, reception)

    def uses_places(self, problem: Problem, splits: Sequence[Split]) -> bool:
        """As the model."""
        return self.model.uses_places(problem, splits)

    def check(self, problem: Problem, splits: Sequence[Split]) -> None:
        """Refuse rows that are too few to hold some out, and what the model refuses."""
        for split in splits:
            _fold(self.model, problem, split)
        self.model.check(problem, splits)

    def unused_settings(self, problem: Problem, splits: Sequence[Split]) -> Mapping[str, str]:
        """As of the model."""
        return self.model.unused_settings(problem, splits)

    def prepare(self, problem: Problem, splits: Sequence[Split], session: Session) -> Any:
        """Settings of the model without open choices."""
        return self.model.prepare(problem, splits, session)


def _fold(entry: Model, problem: Problem, split: Split) -> Split:
    record, rows = problem.record, problem.rows(split)
    known_positions(record, rows, f"{entry.name} with intervals")
    fold = hold_out(record, split) if len(rows) else None
    if split.held_receivers and fold is None:
        raise InputError(f"{record.name}: one receiver trains; intervals at others need two at least")
    if fold is None or not np.isfinite(record.observation[:, rows]).any():
        raise InputError(f"{record.name}: {len(rows)} training rows; intervals need three at least, at two positions")
    return fold
