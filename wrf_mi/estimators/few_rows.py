"""Receivers that received few training rows, or none, predicted by what the other receivers teach.

The law of distance that all receivers share, P = T - 10 gamma log10(d), has a shift for each receiver, normal with the
variance between receivers. The shift of a receiver with n rows is its mean residual times n v / (n v + s^2), with v the
variance between receivers and s^2 that within one, so that it vanishes without rows. A receiver at an unknown place has
the mean level of all receivers in place of the law.

Source: Robinson, "That BLUP is a good thing: the estimation of random effects" (1991), Statistical Science 6(1).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import Prediction, Record, Split
from ..core.angles import FloatArray
from ..core.antenna import AS_STATED
from ..core.array_files import under
from ..core.stored import from_arrays, to_arrays
from ..core.types import IntArray
from ..datasets.observations import FEW_ROWS, rows_received
from ..tasks import TASKS
from .interpolation.path_loss import Trend, fit_path_loss
from .model import Arrays, Decomposition, Fitted, Inputs, Model, Problem, Session

FEW = "few/"  # prefix of the arrays of receivers with few rows
BETWEEN_DB = 4.0  # standard deviation between receivers where fewer than two show it: antennas and their mounting
WITHIN_DB = 6.0  # standard deviation within a receiver where no row shows it: shadowing and fading of buildings


def few_rows(record: Record, splits: Sequence[Split]) -> IntArray:
    """Numbers of the receivers with fewer than `FEW_ROWS` training rows in a split that does not hold them out.

    Where no receiver has as many, those with fewer rows than another.
    """
    few = np.zeros(len(record.receivers), bool)
    for split in splits:
        counts = rows_received(record, split.all_train)
        scarce = counts < min(FEW_ROWS, int(counts.max()))
        scarce[list(split.held_receivers)] = False
        few |= scarce
    return np.flatnonzero(few)


@dataclass(frozen=True)
class SharedLaw:
    """Law of distance of all receivers, shifted for each of some.

    Attributes:
        number: numbers of the receivers in the record [k].
        place_m: their positions [k, 3], metres; NaN where unknown.
        law: power at one metre in dBm, and minus the exponent, [2].
        level_dbm: level [k] of receivers at unknown places.
        shift_db: shifts [k].
        std_db: standard deviations of an observation about the prediction [k].
        carrier_hz: carrier that the law belongs to; others are shifted as free space is. 0: unknown.
    """

    number: IntArray
    place_m: FloatArray
    law: FloatArray
    level_dbm: float
    shift_db: FloatArray
    std_db: FloatArray
    carrier_hz: float

    @classmethod
    def fit(cls, record: Record, rows: IntArray, number: IntArray) -> SharedLaw:
        """The law of all receivers from some rows of a record, and the shifts of the receivers of these numbers."""
        positions_m = np.stack([receiver.position_m for receiver in record.receivers]).astype(float)
        is_placed = np.isfinite(positions_m).all(axis=1)
        observed = np.asarray(record.observation[:, rows], float)
        carrier_hz = 0.0
        if record.carriers_hz is not None:
            carrier_hz = float(np.exp(np.mean(np.log(record.carriers_hz[rows]))))
            observed = observed + _of_carriers(record.carriers_hz[rows], carrier_hz)
        received = np.isfinite(observed)
        columns = np.stack([Trend(position_m)(record.tx_pos_m[rows]) for position_m in positions_m])
        law = fit_path_loss(columns[is_placed], observed[is_placed])
        counts = received.sum(axis=1)
        level = float(np.mean(observed[received]))
        expected = np.where(is_placed[:, None], columns @ law, level)
        residual = np.where(received, observed - expected, 0.0)
        mean = residual.sum(axis=1) / np.maximum(counts, 1)
        within, between = _variances(np.where(received, residual - mean[:, None], 0.0), mean, counts)
        often = counts >= min(FEW_ROWS, int(counts.max()))
        centre = float(mean[often].mean())  # each receiver counts once, however many rows it received
        trust = counts[number] * between / (counts[number] * between + within)
        shift = centre + trust * (mean[number] - centre)
        return cls(number, positions_m[number], law, level, shift, np.sqrt(within + (1 - trust) * between), carrier_hz)

    def __call__(self, inputs: Inputs, receiver: int) -> Prediction:
        """Power in dBm and its standard deviation, [m] each, at a receiver of a number."""
        place = int(np.flatnonzero(self.number == receiver)[0])
        mean = np.full(len(inputs), self.level_dbm)
        if np.isfinite(self.place_m[place]).all():
            mean = Trend(self.place_m[place])(inputs.tx_pos_m) @ self.law
        if inputs.carriers_hz is not None and self.carrier_hz:
            mean = mean - _of_carriers(inputs.carriers_hz, self.carrier_hz)
        mean = mean + self.shift_db[place]
        return Prediction(mean.astype(np.float32), np.full(len(mean), self.std_db[place]))


def _of_carriers(carriers_hz: FloatArray, carrier_hz: float) -> FloatArray:
    """Path loss of free space at carriers above that at another one, dB."""
    return np.asarray(20 * np.log10(carriers_hz / carrier_hz))


def _variances(within_db: FloatArray, mean_db: FloatArray, counts: IntArray) -> tuple[float, float]:
    """Variances of the rows of a receiver about their mean, and of these means, by the method of moments."""
    often = counts >= FEW_ROWS
    free = int((counts[often] - 1).sum())
    within = float(np.square(within_db[often]).sum()) / free if free else WITHIN_DB**2
    within = max(within, 1e-6)  # data without noise
    if often.sum() < 2:
        return within, BETWEEN_DB**2
    return within, max(float(np.var(mean_db[often], ddof=1) - np.mean(within / counts[often])), 0.0)


class FittedWithFew(Fitted):
    """A fitted model of the receivers of some numbers, and a law for the others."""

    def __init__(self, fitted: Fitted, numbers: IntArray, law: SharedLaw) -> None:
        self.fitted, self.law, self._numbers = fitted, law, numbers
        self._place = {int(number): place for place, number in enumerate(numbers)}
        self.train_seconds, self.uses_heading = fitted.train_seconds, fitted.uses_heading
        self.carriers_hz, self.run_sd_db, self.traces = fitted.carriers_hz, fitted.run_sd_db, fitted.traces
        self._states_std: bool | None = None

    def predict(self, inputs: Inputs, receiver: int) -> Prediction:
        """Observations, [m]; those of receivers with few rows have standard deviations if the model states them."""
        if receiver in self._place:
            return self.fitted.predict(inputs, self._place[receiver])
        prediction = self.law(inputs, receiver)
        if self._states_std is None:  # the same for all inputs, and a prediction of some models is slow
            self._states_std = self.fitted.predict(inputs.rows(slice(0, 1)), 0).std is not None
        return prediction if self._states_std else Prediction(prediction.mean)

    def with_reception(self, prediction: Prediction, inputs: Inputs, receiver: int) -> Prediction:
        """As of the model; that of receivers with few rows is not stated."""
        if receiver in self._place:
            return self.fitted.with_reception(prediction, inputs, self._place[receiver])
        return prediction

    def predict_mean(self, inputs: Inputs, receiver: int) -> NDArray[Any]:
        """The mean of `predict`."""
        if receiver in self._place:
            return self.fitted.predict_mean(inputs, self._place[receiver])
        return self.law(inputs, receiver).mean

    def predict_rows(self, rows: IntArray, receiver: int) -> Prediction | None:
        """Stored predictions of the model."""
        return self.fitted.predict_rows(rows, self._place[receiver]) if receiver in self._place else None

    def decompose(self, inputs: Inputs, receiver: int, std: bool = True) -> Decomposition:
        """Decomposition of the model's prediction; that of a law has one part."""
        if receiver in self._place:
            return self.fitted.decompose(inputs, self._place[receiver], std)
        return super().decompose(inputs, receiver, std)

    def tracing_once(self) -> FittedWithFew:
        """The model that traces once, and the law."""
        return FittedWithFew(self.fitted.tracing_once(), self._numbers, self.law)

    def refit(self, record: Record, rows: IntArray) -> FittedWithFew | None:
        """The model given some rows, see `Fitted`, and the law fitted to these."""
        refit = self.fitted.refit(record.at_receivers(self._numbers), rows)
        if refit is None:
            return None
        return FittedWithFew(refit, self._numbers, SharedLaw.fit(record, rows, self.law.number))

    @property
    def depends_on_heading(self) -> bool:
        """As the model."""
        return self.fitted.depends_on_heading

    def arrays(self) -> Arrays:
        """Arrays of the model and of the law."""
        return self.fitted.arrays() | to_arrays(self.law, FEW)

    def facts(self) -> dict[str, Any]:
        """Facts of the model."""
        return self.fitted.facts()


class WithFewRows(Model):
    """A model that is fitted to the receivers with enough rows, beside the law that all receivers share.

    A model that pools receivers itself (`Model.pools_receivers`) is fitted to all that have a row or a known place.
    """

    def __init__(self, model: Model) -> None:
        vars(self).update({name: getattr(model, name) for name in Model.__annotations__})
        self.model = model
        self.gaps = (*model.gaps, "place_m")  # unknown places

    def _numbers(self, problem: Problem, splits: Sequence[Split]) -> tuple[IntArray, IntArray]:
        """Numbers of the receivers that the model is fitted to, and of the others."""
        few = few_rows(problem.record, splits)
        if self.model.pools_receivers(problem):
            few = few[[not np.isfinite(problem.record.receivers[number].position_m).all() for number in few]]
        return np.setdiff1d(np.arange(len(problem.record.receivers)), few), few

    def _part(self, problem: Problem, numbers: IntArray) -> Problem:
        if len(numbers) == len(problem.record.receivers):
            return problem  # a new problem would open its scene anew
        return replace(problem, dataset=problem.record.at_receivers(numbers), antennas=AS_STATED, left_out=())

    def fit(self, problem: Problem, split: Split, session: Session) -> Fitted:
        """Fit the model, and the law where receivers have few rows."""
        numbers, few = self._numbers(problem, [split])
        if not len(few):
            return self.model.fit(problem, split, session)
        fitted = self.model.fit(self._part(problem, numbers), split.at_receivers(numbers), session)
        return FittedWithFew(fitted, numbers, SharedLaw.fit(problem.record, problem.rows(split), few))

    def load(self, arrays: Arrays, problem: Problem, folder: Path) -> Fitted:
        """The model and the law."""
        if not under(FEW, arrays):
            return self.model.load(arrays, problem, folder)
        law = from_arrays(SharedLaw, arrays, FEW)
        numbers = np.setdiff1d(np.arange(len(problem.record.receivers)), law.number)
        of_model = {key: values for key, values in arrays.items() if not key.startswith(FEW)}
        return FittedWithFew(self.model.load(of_model, self._part(problem, numbers), folder), numbers, law)

    def selects(self, problem: Problem, splits: Sequence[Split]) -> bool:
        """As the model, of all receivers: the law of the others chooses nothing."""
        return self.model.selects(problem, splits) and not len(self._numbers(problem, splits)[1])

    def uses_places(self, problem: Problem, splits: Sequence[Split]) -> bool:
        """Whether the model does, or receivers have few rows, of which the law of distance needs the places of all."""
        return self.model.uses_places(problem, splits) or bool(len(few_rows(problem.record, splits)))

    def check(self, problem: Problem, splits: Sequence[Split]) -> None:
        """Refuse what the model refuses of the receivers with enough rows."""
        numbers, _ = self._numbers(problem, splits)
        self.model.check(self._part(problem, numbers), [split.at_receivers(numbers) for split in splits])

    def unused_settings(self, problem: Problem, splits: Sequence[Split]) -> Mapping[str, str]:
        """As of the model with the receivers with enough rows."""
        numbers, _ = self._numbers(problem, splits)
        parts = [split.at_receivers(numbers) for split in splits]
        return self.model.unused_settings(self._part(problem, numbers), parts)

    def prepare(self, problem: Problem, splits: Sequence[Split], session: Session) -> Any:
        """Settings of the model without open choices."""
        numbers, _ = self._numbers(problem, splits)
        return self.model.prepare(
            self._part(problem, numbers), [split.at_receivers(numbers) for split in splits], session
        )


def with_few_rows(model: Model, task: str) -> Model:
    """The model, for signal strengths with `WithFewRows`; other tasks have no law of distance."""
    return WithFewRows(model) if TASKS[task].shares_law else model
