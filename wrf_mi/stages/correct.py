"""Correction of a scene by measurements (``docs/correction.md`` has the steps).

The engine chooses of the options of the stage *scene*, which are judged by the observations of traced paths with the
parameters of each; all training rows are then fitted to.
"""

from __future__ import annotations

import time
from collections.abc import Collection, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy.stats import rankdata
from threadpoolctl import threadpool_limits

from ..core import InputError, Prediction, Record, Split
from ..core.types import FloatArray, Inputs, IntArray
from ..correction.edits import Correction, TracedScene, error_ratio, fit_edit, moves_planes, refit_edit
from ..correction.misfit import Misfit
from ..correction.options import FRAME, PHASES, PLANES, CorrectionOptions, OnStage
from ..correction.state import SceneEdit, ScenePosterior
from ..correction.uncertain_phases import UncertainPhases
from ..estimators.model import Arrays, Fitted, Problem, Session
from ..tracing.paths.instrument_parameters import gain_name
from ..training.gains import last_gain
from .engine import CONFIDENCE, Engine
from .scene import Change, Edited, SceneStage, in_regions, too_few, with_near
from .stage import Option, Stage, State

LEAST_RECEIVERS = 4  # fewest trained receivers of which half decide what is kept, where a split holds receivers out


# Products are of a few rows: threads that share them wait for each other, on a busy machine ten times as long.
@threadpool_limits.wrap(1, "blas")  # type: ignore[untyped-decorator]
def correct_scene(
    scene: str | Path,
    record: Record,
    split: Split,
    options: CorrectionOptions | None = None,
    material: str | None = None,
    on_stage: OnStage = lambda what, share: None,
) -> Correction:
    """Correct a scene by the training rows of a split.

    Args:
        scene: see `wrf_mi.tracing.open_scene`.
        record: measurements of any task, positions known.
        split: its training and validation rows are used, its test rows and receivers that it holds out are not.
        options: parameter groups that may change, and their prior; None: `wrf_mi.correction.default_options`.
        material: radio material of a bare mesh.
        on_stage: called as the correction goes on.

    Returns:
        The correction, with scores [n_rx * rows] of the held-out rows by what was changed, NaN for no observation.

    Raises:
        InputError: data or a scene that cannot be used, or no path to any receiver.
    """
    # Paths of the training rows, and which of these rows judge.
    begun = time.perf_counter()
    traced = TracedScene(scene, record, split, options, material, on_stage)
    judging, of_scene, observations = _judging(traced), _SharedScene(traced), _TracedObservations(traced)
    enough = judging.held_receivers or not too_few(traced.record, judging)
    problem = Problem(traced.record, None, split.seed, str(scene), material)

    # Engine: options are fitted without the judging rows, which choose one.
    with TemporaryDirectory() as place:
        session = Session(Path(place), Path(place), lambda stage, share, _=None, /: on_stage(stage, share))
        chosen = Engine(None, (of_scene, observations), problem, judging, session).choose() if enough else None
    if chosen is None:
        text = f"{len(traced.split.train)} training rows are too few to hold some out; give more"
        raise InputError(f"{traced.record.name}: {text}")

    # Phases: known, or uncertain where that is likelier.
    best = chosen.fitted
    assert isinstance(best, _EditObservations)
    if not moves_planes(best.edit.stage):
        best = _by_uncertain_phases(of_scene.trial, observations, best)

    # Least squares with all rows, from the chosen edit.
    scores = {each.edit.stage: each.scores for each in observations.tried} | {best.edit.stage: best.scores}
    facts = {"held_out": len(best.misfit.rows), "held_out_receivers": observations.out}
    correction: Correction = refit_edit(traced, best.edit, scores, facts)

    # How much smaller errors of known rows are than those of others.
    if correction.data is not None:
        # Rows held out of every choice are few; residuals of rows left out of least squares alone are of all rows.
        after = _with_mean_gain(correction.vector, correction.misfit, observations.heard)
        ratio = _held_out_ratio(best.misfit, best.vector, correction.misfit, after)
        correction.data = replace(correction.data, error_ratio=max(correction.data.error_ratio, ratio))
    correction.seconds = time.perf_counter() - begun
    return correction


def _judging(traced: TracedScene) -> Split:
    """The split of which the engine holds training rows out.

    Rows that judge have to be like what the scene shall serve, anywhere: new receivers, or else regions as large as
    possible, wherever the test rows are.
    """
    split = replace(traced.split, test=traced.split.test[:0], wanted_m=traced.split.wanted_m[:0])
    if len(traced.record.receivers) - len(split.held_receivers) >= LEAST_RECEIVERS:
        return split
    return replace(split, held_receivers=(), left=split.left[:0])


class _SharedScene(SceneStage):
    """The stage with options that share the opened scene and its paths to the rows that all are fitted to."""

    trial: ScenePosterior  # of these rows, along the paths of the stated scene

    def __init__(self, traced: TracedScene) -> None:
        super().__init__(traced.options)
        self._traced = traced

    def _fit(self, change: Change, state: State, split: Split, session: Session) -> State:
        """As of `SceneStage`; the scene as stated has the gains of the observations. Nothing is written."""
        record, rows = state.problem.record, with_near(state, split, change.near).all_train
        before: Edited | None = state.kept.get(self.name)
        if not change.groups:
            self.trial = self._traced.fitted_posterior(record, rows)
            fitted = self.trial.start("")
        elif before:
            fitted = fit_edit(self._traced.posterior(record, rows, before.edit), change.groups, before.edit)
        else:
            fitted = fit_edit(self.trial, change.groups)
        return replace(state, kept={**state.kept, self.name: Edited(state.problem, change.options, fitted.edit)})


class _EditObservations(Fitted):
    """Predicted observations of held-out rows along the paths of a scene with the parameters of an edit.

    ``heard`` are names of the receivers whose gains are known; others have the mean of these.
    """

    def __init__(self, edit: SceneEdit, misfit: Misfit, heard: Collection[str]) -> None:
        self.edit, self.misfit = edit, misfit
        self.vector = _with_mean_gain(misfit.vector_of(edit.parameters), misfit, heard)
        self.scores = misfit.scores(self.vector)
        self._predicted = misfit.predicted(self.vector)

    def predict(self, inputs: Inputs, receiver: int) -> Prediction:
        """Refused: paths to the held-out rows alone are known."""
        raise InputError("the predictions of a correction are those of held-out rows")

    def predict_rows(self, rows: IntArray, receiver: int) -> Prediction:
        """Predictions [q, ...]; NaN of rows that do not judge."""
        is_judging = np.isin(rows, self.misfit.rows)
        predicted = np.full((len(rows), *self._predicted.shape[2:]), np.nan, self._predicted.dtype)
        predicted[is_judging] = self._predicted[receiver, np.searchsorted(self.misfit.rows, rows[is_judging])]
        return Prediction(predicted)

    def arrays(self) -> Arrays:
        """None: no run stores these predictions."""
        return {}


class _TracedObservations(Stage):
    """Observations of traced paths."""

    name = "observations"
    stated: ScenePosterior  # of the held-out rows that judge, along the paths of the stated scene
    heard: Collection[str]  # names of the receivers that observed rows which are fitted to
    out: Collection[str] = ()  # names of the receivers that judge where some were held out

    def __init__(self, traced: TracedScene) -> None:
        self._traced, self.tried = traced, list[_EditObservations]()

    def options(self, problem: Problem, split: Split) -> Sequence[Option]:
        """One."""
        return [Option("traced", partial(self._fit, problem.record, split))]

    def _fit(self, record: Record, judging: Split, state: State, split: Split, session: Session) -> State:
        assert state.fold is not None
        if not self.tried:
            self._hold(record, judging, state.problem.record, state.fold)
        edited: Edited = state.kept[SceneStage.name]
        self.tried.append(self.of(edited.edit))
        return replace(state, fitted=self.tried[-1])

    def _hold(self, record: Record, judging: Split, fitted: Record, fold: Split) -> None:
        """Note the rows of a record that judge, given what a fit sees of it."""
        rows, names = fold.test[in_regions(judging, fold.test)], [each.name for each in record.receivers]
        unseen = record.at_receivers([names.index(each.name) for each in fitted.receivers])
        received = np.isfinite(fitted.observation)
        of_receiver = received[:, fold.all_train].reshape(len(received), -1).any(axis=1)
        self.heard = {fitted.receivers[number].name for number in np.flatnonzero(of_receiver)}
        if fold.held_receivers:
            unseen = replace(unseen, observation=np.where(received, np.nan, unseen.observation))
            judge = np.isfinite(unseen.observation[:, rows]).reshape(len(received), -1).any(axis=1)
            self.out = [unseen.receivers[number].name for number in np.flatnonzero(judge)]
        self.stated = self._traced.posterior(unseen, rows)

    def of(self, edit: SceneEdit) -> _EditObservations:
        """Predictions of the rows that judge with the parameters of an edit, along the paths of its scene."""
        misfit = self.stated.misfit
        if not moves_planes(edit.stage):
            return _EditObservations(edit, misfit, self.heard)
        return _EditObservations(edit, self._traced.posterior(misfit.record, misfit.rows, edit).misfit, self.heard)


def _by_uncertain_phases(
    trial: ScenePosterior, observations: _TracedObservations, best: _EditObservations
) -> _EditObservations:
    """What is kept where planes are not resolved: ``best``, or materials by uncertain phases."""
    if PHASES not in trial.options.groups or not UncertainPhases.serves(trial.misfit):
        return best
    fit = UncertainPhases(trial)
    groups = [group for group in trial.options.groups if group not in (PLANES, FRAME)]
    other = observations.of(fit.best("+".join(groups)).edit)
    observations.tried.append(other)
    # The engine judges by predictions. Predicted channels of wrong phases say nothing of materials: their likelihood
    # with uncertain phases decides.
    unseen = UncertainPhases(observations.stated, fit.noise)
    gain = unseen.scores(other.vector) - unseen.scores(best.vector)
    if observations.out:  # errors are independent between receivers
        of_receivers = gain.reshape(len(unseen.misfit.record.receivers), -1)
        gain = np.array([np.nanmean(rows) for rows in of_receivers if np.isfinite(rows).any()])
    gain = gain[np.isfinite(gain)]
    # Signed ranks (Wilcoxon, 1945): rows of which a path is missing in the scene have gains and losses of any size.
    ranks = np.sign(gain) * rankdata(np.abs(gain))
    return last_gain([(best, 0 * ranks), (other, ranks)], higher_is_better=True, confidence=CONFIDENCE)


def _with_mean_gain(vector: FloatArray, misfit: Misfit, heard: Collection[str]) -> FloatArray:
    """A vector with the mean gain of the receivers that were fitted at those that were not."""
    gains = {receiver.name: misfit.slices.get(gain_name(receiver)) for receiver in misfit.record.receivers}
    if None in gains.values():
        return vector
    mean, result = np.mean([vector[gains[name]] for name in heard], axis=0), vector.copy()
    for name in gains.keys() - heard:
        result[gains[name]] = mean
    return result


def _held_out_ratio(unseen: Misfit, before: FloatArray, final: Misfit, after: FloatArray) -> float:
    """`error_ratio` of the rows held out of every choice, by vectors of misfits without and with them."""
    names, rows = [each.name for each in final.record.receivers], np.isin(final.rows, unseen.rows)
    numbers = [names.index(each.name) for each in unseen.record.receivers]
    with_rows = final.residual(after).reshape(len(names), len(rows), -1)[numbers][:, rows]
    return error_ratio(unseen.residual(before).reshape(with_rows.shape), with_rows)
