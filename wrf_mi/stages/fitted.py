"""A fitted mixture of models: weighted predictions of its parts and kriging of what the scene model leaves."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from ..core import InputError, Prediction, Record, Split
from ..core.angles import FloatArray
from ..core.array_files import keyed, under
from ..core.counts import count
from ..core.stored import NOT_STORED, from_arrays, to_arrays
from ..core.types import IntArray
from ..estimators.held_out import HoldOut, predicted_rows
from ..estimators.interpolation.kriging import Kriged, Kriging
from ..estimators.model import (
    Arrays,
    Decomposition,
    Fitted,
    Inputs,
    PredictAll,
    Problem,
)
from ..estimators.reception import Reception
from ..training.by_distance import LEAST, Intervals, Mixture, expected_size
from ..training.selection import RowDistance, rows_at_receiver
from .scene_model import FittedInScene, by_stage

LEAST_RESIDUALS = 3  # fewest rows of a receiver whose residuals are interpolated
TrainingResiduals = Mapping[int, tuple[IntArray, NDArray[Any]]]
"""Rows [n] by receiver, and what a model's mean leaves of their observations, [n, ...]."""


def training_residuals(fitted: Fitted, record: Record, split: Split) -> TrainingResiduals:
    """What a fitted model leaves of the observations of its training rows."""
    left: dict[int, tuple[IntArray, NDArray[Any]]] = {}
    for receiver in range(len(record.receivers)):
        rows = _training_rows(record, split, receiver)
        if len(rows):
            observed = record.observation[receiver, rows]
            left[receiver] = rows, observed - predicted_rows(fitted, record, rows, receiver).mean
    return left


def _training_rows(record: Record, split: Split, receiver: int) -> IntArray:
    rows = rows_at_receiver(record, split.all_train, receiver)
    if receiver in split.held_receivers:
        rows = np.intersect1d(rows, split.left[split.left[:, 0] == receiver, 1])
    return rows


@dataclass(frozen=True)
class Residuals:
    """Kriging of what the scene model leaves at the training rows."""

    by_receiver: Mapping[int, Kriged]  # interpolation of each receiver that has enough rows, by its number

    @classmethod
    def of(cls, left: TrainingResiduals, record: Record, split: Split, seed: int) -> Residuals:
        """Residuals that a model left, at the training rows of a split that is the model's or holds out more."""
        by_receiver: dict[int, Kriged] = {}
        for receiver, (rows, residual) in left.items():
            in_training = np.isin(rows, _training_rows(record, split, receiver))
            if in_training.sum() >= LEAST_RESIDUALS:
                residual = residual if in_training.all() else residual[in_training]
                by_receiver[receiver] = Kriging(seed=seed).fit(record.tx_pos_m[rows[in_training]], residual)
        return cls(by_receiver)

    def __call__(self, tx_pos_m: FloatArray, receiver: int, shape: tuple[int, ...]) -> NDArray[Any] | float:
        """Expected residuals of a receiver at positions [m, 3], [m, *shape]; 0 without any rows."""
        kriged = self.by_receiver.get(receiver)
        return 0.0 if kriged is None else kriged.predict(tx_pos_m).reshape(len(tx_pos_m), *shape)


PATHS = "paths"
UPLINK_PARTS = ("r2f2", "optml", "fire", "linear")
"""Models of a downlink, the first of which is the mean that others have to improve on."""
FIELD_IN_SCENE = "field-scene"  # field beside the paths of a scene, of signal strengths
TRACED = (PATHS, FIELD_IN_SCENE, "r2f2-scene")  # parts that are given the scene
NEGLIGIBLE = 1e-3  # weight below which a part is not evaluated: its share of the prediction
PARTS = "parts"  # array of the names of the parts, and beginning of the names of their arrays
STATED, PREDICTED = "stated", "predicted"
"""Sizes of expected errors: standard deviations that parts state, or magnitudes (`expected_size`)."""


def mixed(weights: FloatArray, predictions: Sequence[Prediction], states: NDArray[np.bool_]) -> Prediction:
    """Weighted mean of predictions [q, ...], and `deviation_weights` of the deviations that some of them state.

    Args:
        weights: weights [q, k] of sum 1.
        predictions: the k predictions.
        states: which of them have standard deviations that count [k].
    """
    mean = np.einsum("qk,kq...->q...", weights, np.stack([each.mean for each in predictions]))
    if not states.any():
        return Prediction(mean)
    stds = [each.stated_std for each, counts in zip(predictions, states, strict=True) if counts]
    return Prediction(mean, np.einsum("qk,kq...->q...", deviation_weights(weights, states)[:, states], np.stack(stds)))


def deviation_weights(weights: FloatArray, states: NDArray[np.bool_]) -> FloatArray:
    """Weights [q, k] of standard deviations that some predictions state [k]: those of the predictions, of sum 1 again.

    Where none of these has a weight, all that state deviations count alike.
    """
    of_stated = np.where(states, weights, 0.0)
    total = of_stated.sum(axis=1, keepdims=True)
    return np.where(total > 0, of_stated / np.where(total > 0, total, 1.0), states / max(states.sum(), 1))


@dataclass(eq=False)
class FittedMixture(Fitted):
    """A weighted mean of fitted models with prediction intervals, or a single one with these."""

    name: str = field(
        metadata=NOT_STORED
    )  # name of the model; a part of that name is the model itself, to which intervals alone are added
    problem: Problem = field(metadata=NOT_STORED)  # problem of the fit
    known: IntArray  # training rows that determine distances [n]
    parts: dict[str, Fitted] = field(metadata=NOT_STORED)  # fitted parts with a weight, by name
    mixture: Mixture  # weights of these parts, and, if there are residuals, of the scene model with them as the last
    residuals: Residuals | None  # what the scene model leaves; None: it has no weight
    intervals: Intervals | None  # standard deviations; None: none are stated
    deviations: tuple[str, ...]  # parts whose deviations are the sizes of expected errors; none: `expected_size`
    stated: dict[str, Any]  # further entries of ``metrics.json``
    reception: Reception | None = None  # probability of reception; None: not fitted

    def __post_init__(self) -> None:
        self._distance = RowDistance.of_rows(self.problem.record, self.known)
        told = [part.run_sd_db for part in self.parts.values() if part.run_sd_db is not None]
        self.run_sd_db = max(told, default=None)
        self.traces = any(part.traces for part in self.parts.values())
        model = self.parts.get(self.name)
        if model is not None:
            self.receivers, self.uses_heading, self.carriers_hz = model.receivers, model.uses_heading, model.carriers_hz

    def predict(self, inputs: Inputs, receiver: int) -> Prediction:
        """Weighted mean of the parts' predictions, [m, ...], with its standard deviation."""
        return self._of_inputs(inputs, receiver, Fitted.decompose).prediction

    def with_reception(self, prediction: Prediction, inputs: Inputs, receiver: int) -> Prediction:
        """Strengths [m] with their probability of reception, if it was fitted."""
        return prediction if self.reception is None else self.reception(prediction, inputs.tx_pos_m, receiver)

    def predict_mean(self, inputs: Inputs, receiver: int) -> NDArray[Any]:
        """The mean of `predict`, by parts that save time without standard deviations."""
        return self._of_inputs(inputs, receiver, Fitted.decompose, std=False).prediction.mean

    def predict_rows(self, rows: IntArray, receiver: int) -> Prediction:
        """Predictions of rows of the record; parts use what they have stored."""
        record = self.problem.record
        return self._mixed(
            record.tx_pos_m[rows],
            receiver,
            lambda part, places, _: Decomposition(predicted_rows(part, record, rows[places], receiver)),
        ).prediction

    def decompose(self, inputs: Inputs, receiver: int, std: bool = True) -> Decomposition:
        """The prediction, its traced and learned components, NaN where they have no weight, and the traced paths.

        Those of a single part are its own.
        """
        return self._of_inputs(inputs, receiver, lambda part, *of_part: part.decompose(*of_part), std)

    def in_scene(self, scene: str) -> Fitted:
        """The part that predicts from the scene in an edited one; residuals and weights stay."""
        name = PATHS if PATHS in self.parts else next(iter(self.parts))
        return replace(self, parts=self.parts | {name: self.parts[name].in_scene(scene)})

    def tracing_once(self) -> FittedMixture:
        """The mixture of parts that trace once."""
        return replace(self, parts={name: part.tracing_once() for name, part in self.parts.items()})

    def refit(self, record: Record, rows: IntArray) -> FittedMixture | None:
        """The parts given some rows, see `Fitted`, mixed at the distances to these; None if a part has to be fitted."""
        refits = {name: part.refit(record, rows) for name, part in self.parts.items()}
        parts = {name: part for name, part in refits.items() if part is not None}
        if len(parts) < len(self.parts) or self.residuals is not None:
            return None
        return replace(self, known=rows, parts=parts)

    @property
    def depends_on_heading(self) -> bool:
        """Whether the predictions of a part depend on the heading of the transmitter."""
        return any(part.depends_on_heading for part in self.parts.values())

    def _of_inputs(
        self, inputs: Inputs, receiver: int, decompose: Callable[..., Decomposition], std: bool = True
    ) -> Decomposition:
        """Mixed results of ``decompose(part, inputs, receiver, std)``; that of `Fitted` computes no components."""
        needed = [name for name in self.parts if name.partition("-")[0] in UPLINK_PARTS]
        if needed and inputs.uplink is None:
            raise InputError(
                f"{self.name}: {needed[0]} has a weight and predicts from the uplink; give the uplink, too"
            )
        return self._mixed(
            inputs.tx_pos_m,
            receiver,
            lambda part, rows, of_part: decompose(part, inputs.rows(rows), receiver, of_part),
            std,
        )

    def _mixed(
        self,
        tx_pos_m: FloatArray,
        receiver: int,
        predict: Callable[[Fitted, IntArray, bool], Decomposition],
        std: bool = True,
    ) -> Decomposition:
        """Weighted mean of the parts' ``predict(part, rows, std)``, with intervals and reception."""
        if not np.isfinite(tx_pos_m).all():
            raise InputError(f"{self.name}: predicts from positions; give finite x, y, z in metres for every row")
        distance_m = self._distance(tx_pos_m, receiver)
        if len(self.parts) == 1 and self.residuals is None:
            ((name, part),) = self.parts.items()
            result = predict(part, np.arange(len(tx_pos_m)), std and name in self.deviations)
        else:
            result = self._weighted(tx_pos_m, distance_m, receiver, predict, std)
        prediction = Prediction(result.prediction.mean)
        if std:
            prediction = self.with_intervals(result.prediction, distance_m)
            if self.reception is not None:
                prediction = self.reception(prediction, tx_pos_m, receiver)
        return replace(result, prediction=prediction)

    def _weighted(
        self,
        tx_pos_m: FloatArray,
        distance_m: FloatArray,
        receiver: int,
        predict: Callable[[Fitted, IntArray, bool], Decomposition],
        std: bool,
    ) -> Decomposition:
        """Weighted mean of the parts and the residuals, of the deviations that parts state, and its components."""
        observed, m = self.problem.record.observation, len(tx_pos_m)
        shape, kind = observed.shape[2:], np.result_type(observed, np.float64)
        weights = self.weights(distance_m)
        residual_weight = weights[:, len(self.parts)] if self.residuals is not None else np.zeros(m)
        of_parts = weights[:, : len(self.parts)]
        # A part may state the deviations of a mixture in which it has no weight.
        of_std = deviation_weights(of_parts, self._states) * std
        components, totals = np.zeros((2, m, *shape), kind), np.zeros((2, m))
        paths, (size, size_of_mean) = None, np.zeros((2, m, *shape))
        for (name, part), weight, std_weight in zip(self.parts.items(), of_parts.T, of_std.T, strict=True):
            # Residuals are about the scene model, which is therefore a part of what they predict.
            share = weight + residual_weight if name == PATHS else weight
            rows = np.flatnonzero(share + std_weight)
            count("rows of parts", len(rows), len(share) - len(rows))
            if not len(rows):
                continue
            by_part = predict(part, rows, bool(std_weight.any()))
            component = int(name in TRACED)
            components[component, rows] += _spread(share[rows], shape) * by_part.prediction.mean
            totals[component, rows] += share[rows]
            if std_weight.any():
                size[rows] += _spread(std_weight[rows], shape) * by_part.prediction.stated_std
                # NaN of a part that does not state it.
                of_mean = by_part.prediction.std_mean
                size_of_mean[rows] += _spread(std_weight[rows], shape) * (np.nan if of_mean is None else of_mean)
            paths = paths or (by_part.paths and by_part.paths.placed(rows, m))
        mean = components.sum(axis=0)
        rows = np.flatnonzero(residual_weight)
        if len(rows) and self.residuals is not None:
            residual = self.residuals(tx_pos_m[rows], receiver, shape)
            mean[rows] += _spread(residual_weight[rows], shape) * residual
        mean = self.problem.record.task.limited(mean)  # residuals leave the range of observations
        prediction = Prediction(mean)
        if std and self.deviations:
            prediction = Prediction(mean, size, std_mean=size_of_mean if np.isfinite(size_of_mean).all() else None)
        if not totals.any(axis=1).all():
            return Decomposition(prediction, paths=paths)
        with np.errstate(divide="ignore", invalid="ignore"):
            learned, traced = (values / _spread(total, shape) for values, total in zip(components, totals, strict=True))
        return Decomposition(prediction, traced, learned, paths)

    @property
    def _states(self) -> NDArray[np.bool_]:
        return np.array([name in self.deviations for name in self.parts])

    def weights(self, distance_m: FloatArray) -> FloatArray:
        """Weights of the parts and, as the last, of the residuals, [m, k]; 0 where a part is not worth its time."""
        weights = self.mixture(distance_m)
        weights = np.where(weights < NEGLIGIBLE, 0, weights)
        return np.asarray(weights / weights.sum(axis=1, keepdims=True))

    def with_intervals(self, prediction: Prediction, distance_m: FloatArray) -> Prediction:
        """Mixed predictions [m, ...] with calibrated standard deviations, from those that their parts state, if any."""
        mean = prediction.mean
        if self.intervals is None:
            return Prediction(mean)
        if self.deviations:
            factor = self.intervals(mean, np.ones(mean.shape), distance_m).stated_std
            of_mean = None if prediction.std_mean is None else prediction.std_mean * factor
            return Prediction(mean, np.maximum(prediction.stated_std * factor, LEAST), std_mean=of_mean)
        return self.intervals(mean, expected_size(self.problem.record.task, Prediction(mean)), distance_m)

    def fit_reception(self, rows: HoldOut, every: Sequence[Prediction]) -> None:
        """Fit the probability of reception by the parts' predictions of `HeldOut.every`, fitted without these rows."""
        record, pairs = self.problem.record, rows.held_out.every.T
        distance_m = RowDistance.of_rows(record, rows.fold.all_train).of_pairs(record, *pairs)
        predictions = self.with_intervals(mixed(self.weights(distance_m), every, self._states), distance_m)
        self.reception = Reception.fit(record, self.known, rows.fold.all_train, rows.held_out, predictions)

    def arrays(self) -> Arrays:
        """Fields, and the arrays of the parts."""
        arrays = to_arrays(self) | {PARTS: np.asarray(list(self.parts))}
        for name, fitted in self.parts.items():
            arrays |= keyed(f"{PARTS}/{name}/", fitted.arrays())
        return arrays

    @classmethod
    def from_arrays(cls, name: str, arrays: Arrays, problem: Problem, load: Callable[[str, Arrays], Fitted]) -> Self:
        """The mixture that `arrays` described; ``load(part, arrays)`` loads a part."""
        parts = {part: load(part, under(f"{PARTS}/{part}/", arrays)) for part in map(str, arrays[PARTS])}
        return from_arrays(cls, arrays, name=name, problem=problem, record=problem.record, parts=parts)

    def by_stage(self, split: Split) -> dict[str, PredictAll]:
        """Predictions of the stages up to each but the last."""
        scene_model, used = (
            self.parts.get(PATHS),
            [report["stage"] for report in self.stated.get("stages", []) if report["kept"]],
        )
        return (
            by_stage(self.problem, split, scene_model, used) if isinstance(scene_model, FittedInScene) and used else {}
        )

    def facts(self) -> dict[str, Any]:
        """Entries of ``metrics.json``, and those of the reception."""
        return self.stated | ({} if self.reception is None else self.reception.facts())


def _spread(values: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    return values.reshape(-1, *[1] * len(shape))
