"""The model ``hybrid``: a mixture of other models, weighted by the distance to the nearest training row.

Interpolation is best next to training rows, ray tracing far from them. Ingredients are fitted to parts of the training
rows and predict the others, some near and some far (`wrf_mi.models.held_out`); weights that are best there, as a
function of the distance, mix ingredients that are fitted to all training rows. The same held-out predictions give
the standard deviations (`wrf_mi.models.intervals`).

ingredients/  in the run folder: files of the ingredients
"""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ...core import InputError, Prediction, Record, Split
from ...core.angles import FloatArray
from ...core.settings import CheckedSettings
from ...core.types import IntArray
from ...tasks import task_of
from .. import MODELS
from ..held_out import (
    HeldOut,
    RowDistance,
    fit_model,
    held_out_predictions,
    hold_out_folds,
    labelled,
    predicted_rows,
)
from ..intervals import GAPS, Intervals, expected_size, fit_intervals
from ..model import (
    Arrays,
    Decomposition,
    Fitted,
    Inputs,
    Model,
    Problem,
    Session,
    field_arrays,
    from_field_arrays,
    keyed,
    known_positions,
    under,
)
from .ingredients import INGREDIENTS, from_uplink, most_trusted, problems, serving, uses_scene
from .mixture import Mixture, choose, constant

logger = logging.getLogger(__name__)
FOLDER = "ingredients"
NEGLIGIBLE = 1e-3
"""Weight below which an ingredient is not evaluated: its share of the prediction."""


@dataclass(frozen=True)
class HybridSettings(CheckedSettings):
    """Settings of the hybrid.

    Attributes:
        ingredients: names of the mixed models, separated by commas: idw, kriging, trees, mri, learned
            (wrf-gs+), or a model's name; with an uplink r2f2, optml, fire and linear; with a scene ray-tracing, surface
            (its gain, materials and Gaussians on its surfaces trained), physics, joint (wrf-gs+ with the scene) and,
            with an uplink, r2f2-scene. null: all of them that serve the data, but learned and joint, each fit of which
            takes minutes.
    """

    ingredients: str | None = None


class FittedHybrid(Fitted):
    """A fitted mixture.

    Args:
        problem: problem of the hybrid.
        known: training rows that determine distances [n].
        fitted: fitted ingredients with a weight, by name.
        mixture: weights of these ingredients.
        intervals: standard deviations; None: none are stated.
        facts: further entries of ``metrics.json``.
    """

    def __init__(
        self,
        problem: Problem,
        known: IntArray,
        fitted: Mapping[str, Fitted],
        mixture: Mixture,
        intervals: Intervals | None,
        facts: dict[str, Any],
    ) -> None:
        self._problem, self._known, self._facts = problem, known, facts
        self._distance = RowDistance(problem.record, known)
        self.ingredients, self.mixture, self.intervals = dict(fitted), mixture, intervals

    def predict(self, inputs: Inputs, receiver: int) -> Prediction:
        """Weighted mean of the ingredients' predictions, [m, ...], with its standard deviation."""
        self._check(inputs)

        def predicted(one: Fitted, some: IntArray) -> Decomposition:
            return Decomposition(Prediction(one.predict_mean(inputs.rows(some), receiver)))

        return self._mixed(inputs.tx_pos_m, receiver, predicted).whole

    def predict_rows(self, rows: IntArray, receiver: int) -> Prediction:
        """Predictions of rows of the record; ingredients use what they have stored."""
        record = self._problem.record

        def stored(one: Fitted, some: IntArray) -> Decomposition:
            return Decomposition(predicted_rows(one, record, rows[some], receiver))

        return self._mixed(record.tx_pos_m[rows], receiver, stored).whole

    def decompose(self, inputs: Inputs, receiver: int, std: bool = True) -> Decomposition:
        """The prediction; the weighted means of the ingredients with the scene and of those without, each of weights
        of sum one; and the traced paths of the first ingredient that knows them, where it has a weight.
        """
        self._check(inputs)

        def decomposed(one: Fitted, some: IntArray) -> Decomposition:
            return one.decompose(inputs.rows(some), receiver, std=False)

        return self._mixed(inputs.tx_pos_m, receiver, decomposed, sides=True)

    @property
    def depends_on_heading(self) -> bool:
        """Whether an ingredient's predictions do."""
        return any(fitted.depends_on_heading for fitted in self.ingredients.values())

    def _check(self, inputs: Inputs) -> None:
        needed = [name for name in self.ingredients if inputs.uplink is None and from_uplink(name)]
        if needed:
            raise InputError(f"hybrid: {needed[0]} has a weight and predicts from the uplink; give the uplink, too")

    def _mixed(
        self,
        tx_pos_m: FloatArray,
        receiver: int,
        predict: Callable[[Fitted, IntArray], Decomposition],
        sides: bool = False,
    ) -> Decomposition:
        if not np.isfinite(tx_pos_m).all():
            raise InputError("hybrid: predicts from positions; give finite x, y, z in metres for every row")
        distance_m = self._distance(tx_pos_m, receiver)
        weights = self.mixture(distance_m)
        weights = np.where(weights < NEGLIGIBLE, 0, weights)
        weights /= weights.sum(axis=1, keepdims=True)
        observed = self._problem.record.observation
        traced = np.array([uses_scene(name) for name in self.ingredients])
        both = sides and traced.any() and not traced.all()
        # The mean, or the share of each side, whose sum it is.
        sums = np.zeros((1 + both, len(tx_pos_m), *observed.shape[2:]), np.result_type(observed, np.float64))
        paths = None

        def spread(weight: FloatArray) -> FloatArray:
            return weight.reshape(-1, *[1] * (sums.ndim - 2))

        for fitted, weight, with_scene in zip(self.ingredients.values(), weights.T, traced, strict=True):
            rows = np.flatnonzero(weight)
            if len(rows):
                found = predict(fitted, rows)
                sums[int(both and with_scene), rows] += spread(weight[rows]) * found.whole.mean
                if paths is None and found.paths is not None:
                    paths = found.paths.placed(rows, len(tx_pos_m))
        mean = sums.sum(axis=0) if both else sums[0]
        whole = Prediction(mean)
        if self.intervals is not None:
            whole = self.intervals(mean, expected_size(task_of(self._problem.record), whole), distance_m)
        if not both:
            return Decomposition(whole, paths=paths)
        with np.errstate(divide="ignore", invalid="ignore"):
            learned, scene = (sums[k] / spread(weights[:, traced == k].sum(axis=1)) for k in (0, 1))
        return Decomposition(whole, scene, learned, paths)

    def arrays(self) -> Arrays:
        """Weights, intervals, training rows, and the arrays of the ingredients."""
        arrays: Arrays = {"known": self._known, "names": np.asarray(list(self.ingredients))}
        arrays["facts"] = np.asarray(json.dumps(self._facts))
        arrays |= field_arrays(self.mixture, "mixture/")
        if self.intervals is not None:
            arrays |= field_arrays(self.intervals, "intervals/")
        for name, fitted in self.ingredients.items():
            arrays |= keyed(f"{name}/", fitted.arrays())
        return arrays

    def facts(self) -> dict[str, Any]:
        """Form and weights of the mixture, and held-out scores of the ingredients."""
        return self._facts


def fit(problem: Problem, split: Split, session: Session) -> FittedHybrid:
    """Predict held-out training rows by every ingredient, choose weights, and fit ingredients with weight to all rows.

    Raises:
        InputError: unknown positions, or an ingredient that cannot be fitted.
        Interrupted: stopped; finished folds are kept.
    """
    record, rows = problem.record, problem.rows(split)
    known_positions(record, rows, "hybrid")
    asked = _names(problem.settings)
    found = serving(problems(problem, asked), split, required=asked is not None)
    folder = session.folder / FOLDER
    folds = hold_out_folds(record, split)
    held = HeldOut.of(record, folds, problem.seed) if folds else None
    predictions: dict[str, Prediction] = {}
    if held is not None:
        for name, (entry, inner) in list(found.items()):
            place = replace(session, folder=folder / name, run=folder / name)
            try:
                predictions[name] = held_out_predictions(entry, inner, folds, held, place, name)
            except InputError as error:
                if asked is not None:
                    raise
                logger.info("hybrid without %s: %s", name, error)
                del found[name]
    form, mixture, intervals, scores = _weights(record, predictions, held, bool(split.held_receivers), session)
    if held is None:
        mixture = constant(np.eye(len(found))[0])
    names = [name for name, most in zip(found, mixture.weights.max(axis=0), strict=True) if most >= NEGLIGIBLE]
    places = [list(found).index(name) for name in names]
    fitted = {}
    for name in names:
        entry, inner = found[name]
        (folder / name).mkdir(parents=True, exist_ok=True)
        place = labelled(replace(session, folder=folder / name, run=folder / name), name)
        fitted[name], _ = fit_model(entry, inner, split, place)
    for name in set(found) - set(names):
        shutil.rmtree(folder / name, ignore_errors=True)
    kept = Mixture(mixture.distance_m, mixture.weights[:, places])
    facts = {"form": form, "held_out": scores, "weights": _stated(kept, names)}
    return FittedHybrid(problem, rows, fitted, kept, intervals, facts)


def _names(settings: HybridSettings) -> list[str] | None:
    return None if settings.ingredients is None else [name.strip() for name in settings.ingredients.split(",")]


def _weights(
    record: Record, predictions: Mapping[str, Prediction], held: HeldOut | None, by_receiver: bool, session: Session
) -> tuple[str, Mixture, Intervals | None, dict[str, float]]:
    """Form of the weights, weights, intervals, and mean held-out scores of the ingredients.

    Errors are independent between rows; ``by_receiver``: between receivers, which are held out.
    """
    if held is None or not len(held):
        return "alone", constant(np.ones(1)), None, {}
    task, observed = task_of(record), held.observed(record)
    means = np.stack([one.mean for one in predictions.values()])
    score = task.mixtures(means, observed)
    every = np.arange(len(held))
    form, mixture = choose(
        score,
        held.distance_m,
        held.fold,
        held.receiver if by_receiver else held.row,
        len(means),
        lambda share: session.report("choosing weights", share),
        None if task.image else most_trusted(list(predictions)),
    )
    mean = np.einsum("qk,kq...->q...", mixture(held.distance_m), means)
    size = expected_size(task, Prediction(mean))
    sign = 1 if task.higher_is_better else -1
    scores = {
        name: sign * float(score(np.broadcast_to(one, (len(held), len(means))), every).mean())
        for name, one in zip(predictions, np.eye(len(means)), strict=True)
    }
    scores["hybrid"] = sign * float(score(mixture(held.distance_m), every).mean())
    return form, mixture, fit_intervals(mean, observed, size, held.distance_m, held.row), scores


def _stated(mixture: Mixture, names: Sequence[str]) -> list[dict[str, float]]:
    rows = zip(mixture.distance_m, mixture.weights, strict=True)
    return [
        {"distance_m": float(distance), **dict(zip(names, map(float, weights), strict=True))}
        for distance, weights in rows
    ]


def load(arrays: Arrays, problem: Problem, folder: Path) -> FittedHybrid:
    """The mixture that `FittedHybrid.arrays` described."""
    names = [str(name) for name in arrays["names"]]
    found = problems(problem, names)
    fitted = {}
    for name, (entry, inner) in found.items():
        fitted[name] = entry.load(under(f"{name}/", arrays), inner, folder / FOLDER / name)
    mixture = from_field_arrays(Mixture, under("mixture/", arrays))
    stored = under("intervals/", arrays)
    intervals = from_field_arrays(Intervals, stored) if stored else None
    facts = json.loads(str(arrays["facts"]))
    return FittedHybrid(problem, arrays["known"], fitted, mixture, intervals, facts)


def check(problem: Problem, splits: Sequence[Split]) -> None:
    """Refuse unknown positions, and ingredients that none of the splits can be fitted with."""
    asked = _names(problem.settings)
    for split in splits:
        known_positions(problem.record, split.all_train, "hybrid")
        serving(problems(problem, asked), split, required=asked is not None)


def _by_data(task: str, with_scene: bool) -> Model:
    """The entry, whose arrays have the gaps of the ingredients' arrays."""
    served = ((MODELS[one.model], one.scene) for one in INGREDIENTS.values() if MODELS[one.model].serves(task))
    gaps = (name for entry, scene in served for name in entry.serving(task, scene).gaps)
    return replace(MODEL, by_data=None, gaps=(*GAPS, *gaps))


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
    check=check,
    by_data=_by_data,
)
