"""The model ``hybrid``: one fit in stages, from a scene's paths to interpolation of what they leave.

Stages 1 to 5 (`wrf_mi.models.hybrid.paths`) predict from the scene, the last one interpolates: their residuals and the
observations themselves, weighted by the distance to the nearest training row. One hold-out
(`wrf_mi.training.selection`) chooses stages, weights and standard deviations (`wrf_mi.training.by_distance`).

parts/  in the run folder: files of the parts
"""

from __future__ import annotations

import json
import logging
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core import InputError, Prediction, Record, Split
from ...core.angles import FloatArray
from ...core.types import IntArray
from ...tasks import task_of
from ...training.by_distance import (
    GAPS,
    LEAST,
    HeldOutScores,
    Intervals,
    Mixture,
    choose_weights,
    constant,
    expected_size,
    fit_intervals,
)
from ...training.selection import HeldOut, RowDistance, hold_out
from .. import MODELS
from ..held_out import fit_model, held_out_predictions, labelled, predicted_rows
from ..model import (
    Arrays,
    Decomposition,
    Fitted,
    Inputs,
    Model,
    PredictAll,
    Problem,
    Session,
    field_arrays,
    from_field_arrays,
    keyed,
    known_positions,
    under,
)
from .contributions import by_stage
from .parts import KRIGING, PATHS, TRACED, UPLINK_PARTS, HybridSettings, parts_of, scene_side, stored_parts
from .residuals import Residuals
from .scene_side import RESIDUAL, SceneSide, StageReport, inside, stated_reports

logger = logging.getLogger(__name__)
FOLDER = "parts"
NEGLIGIBLE = 1e-3
"""Weight below which a part is not evaluated: its share of the prediction."""
STATED, PREDICTED = "stated", "predicted"
"""Sizes of expected errors: standard deviations that all parts state, or magnitudes (`expected_size`)."""


class FittedHybrid(Fitted):
    """A fitted hybrid.

    Args:
        problem: problem of the hybrid.
        known: training rows that determine distances [n].
        parts: fitted parts with a weight, by name.
        mixture: weights of these parts, and, if there are ``residuals``, of the scene's side with them as the last.
        residuals: what the scene's side leaves; None: it has no weight.
        intervals: standard deviations; None: none are stated.
        facts: further entries of ``metrics.json``.
    """

    def __init__(
        self,
        problem: Problem,
        known: IntArray,
        parts: Mapping[str, Fitted],
        mixture: Mixture,
        residuals: Residuals | None,
        intervals: Intervals | None,
        facts: dict[str, Any],
    ) -> None:
        self._problem, self._known, self._facts = problem, known, facts
        self._distance = RowDistance.of_rows(problem.record, known)
        self.parts, self.mixture, self.residuals, self.intervals = dict(parts), mixture, residuals, intervals

    def predict(self, inputs: Inputs, receiver: int) -> Prediction:
        """Weighted mean of the parts' predictions, [m, ...], with its standard deviation."""
        self._check(inputs)

        def predicted(one: Fitted, some: IntArray) -> Decomposition:
            if self._facts["sizes"] == STATED:
                return Decomposition(one.predict(inputs.rows(some), receiver))
            return Decomposition(Prediction(one.predict_mean(inputs.rows(some), receiver)))

        return self._mixed(inputs.tx_pos_m, receiver, predicted).whole

    def predict_mean(self, inputs: Inputs, receiver: int) -> NDArray[Any]:
        """The mean of `predict`, by parts that save time without standard deviations."""
        self._check(inputs)

        def predicted(one: Fitted, some: IntArray) -> Decomposition:
            return Decomposition(Prediction(one.predict_mean(inputs.rows(some), receiver)))

        return self._mixed(inputs.tx_pos_m, receiver, predicted, std=False).whole.mean

    def predict_rows(self, rows: IntArray, receiver: int) -> Prediction:
        """Predictions of rows of the record; parts use what they have stored."""
        record = self._problem.record

        def stored(one: Fitted, some: IntArray) -> Decomposition:
            return Decomposition(predicted_rows(one, record, rows[some], receiver))

        return self._mixed(record.tx_pos_m[rows], receiver, stored).whole

    def decompose(self, inputs: Inputs, receiver: int, std: bool = True) -> Decomposition:
        """The prediction; what the scene's side and the others predict alone, NaN where they have no weight; and the
        traced paths.
        """
        self._check(inputs)

        def decomposed(one: Fitted, some: IntArray) -> Decomposition:
            return one.decompose(inputs.rows(some), receiver, std and self._facts["sizes"] == STATED)

        return self._mixed(inputs.tx_pos_m, receiver, decomposed, std)

    @property
    def depends_on_heading(self) -> bool:
        """Whether a part's predictions do."""
        return any(fitted.depends_on_heading for fitted in self.parts.values())

    def _check(self, inputs: Inputs) -> None:
        needed = [name for name in self.parts if name.partition("-")[0] in UPLINK_PARTS]
        if needed and inputs.uplink is None:
            raise InputError(f"hybrid: {needed[0]} has a weight and predicts from the uplink; give the uplink, too")

    def _mixed(
        self,
        tx_pos_m: FloatArray,
        receiver: int,
        predict: Callable[[Fitted, IntArray], Decomposition],
        std: bool = True,
    ) -> Decomposition:
        if not np.isfinite(tx_pos_m).all():
            raise InputError("hybrid: predicts from positions; give finite x, y, z in metres for every row")
        distance_m = self._distance(tx_pos_m, receiver)
        weights = self.mixture(distance_m)
        weights = np.where(weights < NEGLIGIBLE, 0, weights)
        weights /= weights.sum(axis=1, keepdims=True)
        observed = self._problem.record.observation
        shape, kind = observed.shape[2:], np.result_type(observed, np.float64)
        names = list(self.parts)
        with_residual = weights[:, len(names)] if self.residuals is not None else np.zeros(len(tx_pos_m))
        sides, totals = np.zeros((2, len(tx_pos_m), *shape), kind), np.zeros((2, len(tx_pos_m)))
        mean, paths, size = np.zeros((len(tx_pos_m), *shape), kind), None, np.zeros((len(tx_pos_m), *shape))

        def spread(values: FloatArray) -> FloatArray:
            return values.reshape(-1, *[1] * len(shape))

        for name, fitted, weight in zip(names, self.parts.values(), weights.T, strict=False):
            share = weight + with_residual if name == PATHS else weight
            rows = np.flatnonzero(share)
            if not len(rows):
                continue
            found = predict(fitted, rows)
            traced = int(name in TRACED)
            sides[traced, rows] += spread(share[rows]) * found.whole.mean
            totals[traced, rows] += share[rows]
            if found.whole.std is not None:
                size[rows] += spread(share[rows]) * found.whole.std
            if paths is None and found.paths is not None:
                paths = found.paths.placed(rows, len(tx_pos_m))
        mean += sides.sum(axis=0)
        rows = np.flatnonzero(with_residual)
        if len(rows) and self.residuals is not None:
            mean[rows] += spread(with_residual[rows]) * self.residuals(tx_pos_m[rows], receiver, shape)
        if task_of(self._problem.record).image:
            mean = np.clip(mean, 0, 1)  # residuals leave the range of greys
        whole = Prediction(mean)
        if self.intervals is not None and std:
            if self._facts["sizes"] == STATED:
                factor = self.intervals(mean, np.ones(mean.shape), distance_m).stated_std
                whole = Prediction(mean, np.maximum(size * factor, LEAST))
            else:
                whole = self.intervals(mean, expected_size(task_of(self._problem.record), whole), distance_m)
        if not (totals[0].any() and totals[1].any()):
            return Decomposition(whole, paths=paths)
        with np.errstate(divide="ignore", invalid="ignore"):
            learned, scene = (sides[k] / spread(totals[k]) for k in (0, 1))
        return Decomposition(whole, scene, learned, paths)

    def arrays(self) -> Arrays:
        """Weights, residuals, intervals, training rows, and the arrays of the parts."""
        arrays: Arrays = {"known": self._known, "names": np.asarray(list(self.parts))}
        arrays["facts"] = np.asarray(json.dumps(self._facts))
        arrays |= field_arrays(self.mixture, "mixture/")
        if self.intervals is not None:
            arrays |= field_arrays(self.intervals, "intervals/")
        if self.residuals is not None:
            arrays |= keyed("residuals/", self.residuals.arrays())
        for name, fitted in self.parts.items():
            arrays |= keyed(f"{name}/", fitted.arrays())
        return arrays

    def by_stage(self, split: Split) -> dict[str, PredictAll]:
        """Predictions of the stages up to each but the last, see `wrf_mi.models.hybrid.contributions`."""
        side, kept = self.parts.get(PATHS), [one["stage"] for one in self._facts["stages"] if one["kept"]]
        return by_stage(self._problem, split, side, kept) if isinstance(side, SceneSide) and kept else {}

    def facts(self) -> dict[str, Any]:
        """Stages with their held-out scores, form and weights of the mixture, and held-out scores of its parts."""
        return self._facts


def fit(problem: Problem, split: Split, session: Session) -> FittedHybrid:
    """Fit all parts, and choose weights and standard deviations by held-out rows.

    Raises:
        InputError: unknown positions, or no part that can be fitted.
        Interrupted: stopped; finished parts are kept.
    """
    record, rows = problem.record, problem.rows(split)
    known_positions(record, rows, "hybrid")
    fold = hold_out(record, split)
    held = None if fold is None else HeldOut.of(record, fold, problem.seed)
    parts = parts_of(problem, split)
    fitted: dict[str, Fitted] = {}
    predictions: dict[str, Prediction] = {}
    reports: list[StageReport] = []
    residuals, begun = None, time.perf_counter()
    of_scene = 0.0
    # Strengths are kriged about the scene's, and reports of other carriers have residuals of their own.
    interpolates = RESIDUAL in problem.settings.wanted and not task_of(record).in_decibel and record.carriers_hz is None

    def fit_part(name: str) -> Fitted:
        place = inside(session, FOLDER, name)
        place.folder.mkdir(parents=True, exist_ok=True)
        return fit_model(*parts[name], split, labelled(place, name))[0]

    for name, (entry, inner) in parts.items():
        unseen = None
        if name == PATHS:
            # Its stages are chosen by the held-out rows, which it predicts on the way.
            fitted[name] = one = fit_part(name)
            of_scene = time.perf_counter() - begun
            assert isinstance(one, SceneSide)
            reports += one.stages
            entry, inner = scene_side(record)[1], one.problem  # the scene is corrected once
            unseen = None if held is None else one.held_out_at(held)
        if fold is None or held is None:
            continue
        if unseen is not None:
            predictions[name] = unseen
        else:
            place = inside(session, FOLDER, name, "held")
            predictions[name] = held_out_predictions(entry, inner, fold, held, place, name)
        if name == PATHS and interpolates:
            residuals, predictions[RESIDUAL] = _residuals(one, record, split, fold, held, predictions[name], problem)
    names = [*predictions] if predictions else [*parts]
    form, sizes, mixture, intervals, scores = _weights(record, predictions, held, bool(split.held_receivers), session)
    if not predictions:
        mixture = constant(np.eye(len(parts))[0])
    used = [name for name, most in zip(names, mixture.weights.max(axis=0), strict=True) if most >= NEGLIGIBLE]
    if RESIDUAL in used and PATHS not in used:
        used.insert(0, PATHS)
    used = [*(name for name in used if name != RESIDUAL), *([RESIDUAL] if RESIDUAL in used else [])]
    kept = Mixture(mixture.distance_m, mixture.weights[:, [names.index(name) for name in used]])
    for name in set(parts) - set(used):
        shutil.rmtree(session.folder / FOLDER / name, ignore_errors=True)
    if KRIGING in names and len(names) > 1:
        gained = task_of(record).in_decibel or KRIGING in used or RESIDUAL in used
        seconds = time.perf_counter() - begun - of_scene
        reports.append(StageReport(RESIDUAL, gained, scores.get("hybrid"), seconds))
    facts = {
        "stages": stated_reports(reports),
        "form": form,
        "sizes": sizes,
        "held_out": scores,
        "weights": _stated(kept, used),
    }
    whole = {name: fitted.get(name) or fit_part(name) for name in used if name != RESIDUAL}
    return FittedHybrid(problem, rows, whole, kept, residuals if RESIDUAL in used else None, intervals, facts)


def _residuals(
    fitted: Fitted, record: Record, split: Split, fold: Split, held: HeldOut, before: Prediction, problem: Problem
) -> tuple[Residuals, Prediction]:
    """Residuals of the training rows, and predictions of held-out rows with those of the others.

    Both are residuals of the final parameters, which have seen the held-out rows, too: an approximation. To keep
    those of the chosen state would take the reports of all rows.
    """
    among_known, mean = Residuals.of(fitted, record, fold, problem.seed), np.array(before.mean)
    for receiver in np.unique(held.receiver):
        places = held.receiver == receiver
        mean[places] += among_known(record.tx_pos_m[held.row[places]], int(receiver), mean.shape[1:])
    if task_of(record).image:
        mean = np.clip(mean, 0, 1)
    return Residuals.of(fitted, record, split, problem.seed), Prediction(mean)


def _weights(
    record: Record, predictions: Mapping[str, Prediction], held: HeldOut | None, by_receiver: bool, session: Session
) -> tuple[str, str, Mixture, Intervals | None, dict[str, float]]:
    """Form of the weights, sizes of expected errors, weights, intervals, and mean held-out scores of the parts.

    Errors are independent between rows; ``by_receiver``: between receivers, which are held out.
    """
    if held is None or not len(held) or not predictions:
        return "alone", PREDICTED, constant(np.ones(1)), None, {}
    task, observed = task_of(record), held.observed(record)
    means = np.stack([one.mean for one in predictions.values()])
    score, every = task.mixtures(means, observed), np.arange(len(held))
    unit = held.receiver if by_receiver else held.row

    def on_group(share: float) -> None:
        session.report("choosing weights", share)

    form, mixture = choose_weights(
        HeldOutScores(score, held.distance_m, unit, len(means)), held.group, on_group, trusted=0
    )
    mean = np.einsum("qk,kq...->q...", mixture(held.distance_m), means)
    stds = [one.std for one in predictions.values()]
    known = [std for std in stds if std is not None]
    sizes = PREDICTED
    std = np.einsum("qk,kq...->q...", mixture(held.distance_m), np.stack(known)) if len(known) == len(stds) else None
    if std is not None and (std > 0).all():  # kriging of two or three rows may pass through all of them
        # Few rows tell a factor of stated deviations, not how errors depend on them.
        sizes = STATED
        intervals = fit_intervals(mean / std, observed / std, np.ones(mean.shape), held.distance_m, held.row)
    else:
        size = expected_size(task, Prediction(mean))
        intervals = fit_intervals(mean, observed, size, held.distance_m, held.row)
    sign = 1 if task.higher_is_better else -1
    scores = {
        name: sign * float(score(np.broadcast_to(one, (len(held), len(means))), every).mean())
        for name, one in zip(predictions, np.eye(len(means)), strict=True)
    }
    scores["hybrid"] = sign * float(score(mixture(held.distance_m), every).mean())
    return form, sizes, mixture, intervals, scores


def _stated(mixture: Mixture, names: Sequence[str]) -> list[dict[str, float]]:
    rows = zip(mixture.distance_m, mixture.weights, strict=True)
    return [
        {"distance_m": float(distance), **dict(zip(names, map(float, weights), strict=True))}
        for distance, weights in rows
    ]


def load(arrays: Arrays, problem: Problem, folder: Path) -> FittedHybrid:
    """The hybrid that `FittedHybrid.arrays` described."""
    facts = json.loads(str(arrays["facts"]))
    if "sizes" not in facts:
        raise InputError(f"{folder}: a hybrid of an earlier version, which mixed other models; train the run anew")
    parts: dict[str, Fitted] = {}
    for name, (entry, inner) in stored_parts(problem, [str(name) for name in arrays["names"]]).items():
        parts[name] = entry.load(under(f"{name}/", arrays), inner, folder / FOLDER / name)
    mixture = from_field_arrays(Mixture, under("mixture/", arrays))
    stored, left = under("intervals/", arrays), under("residuals/", arrays)
    residuals = Residuals.from_arrays(left, problem.record) if left else None
    intervals = from_field_arrays(Intervals, stored) if stored else None
    return FittedHybrid(problem, arrays["known"], parts, mixture, residuals, intervals, facts)


def check(problem: Problem, splits: Sequence[Split]) -> None:
    """Refuse unknown positions, and data that no part can be fitted to."""
    for split in splits:
        known_positions(problem.record, split.all_train, "hybrid")
        parts_of(problem, split)


def _by_data(task: str, with_scene: bool) -> Model:
    """The entry, whose arrays have the gaps of the parts' arrays."""
    entries = [MODELS[name] for name in (KRIGING, "wrf-gs+", *UPLINK_PARTS) if MODELS[name].serves(task)]
    gaps = {name for entry in entries for name in entry.serving(task, with_scene).gaps}
    return replace(MODEL, by_data=None, gaps=(*GAPS, *sorted(gaps)))


MODEL = Model(
    "hybrid",
    None,
    HybridSettings,
    fit,
    load,
    "docs/hybrid.md",
    scene="optional",
    uplink="optional",
    headings=True,
    several_carriers=True,
    new_receivers=True,
    given=("deterministic",),
    check=check,
    by_data=_by_data,
)
