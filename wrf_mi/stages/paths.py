"""The stage *paths*: paths of the scene, Gaussians on its surfaces and those of a field, for spectra and channels."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from ..backend.device import release_memory
from ..core import InputError, Prediction, Split
from ..core.settings import with_settings
from ..core.stored import from_arrays
from ..core.types import FloatArray, IntArray
from ..estimators.gaussian.model import WRF_GS_PLUS, FittedField
from ..estimators.held_out import hold_out_once
from ..estimators.model import Arrays, Model, Problem, Session
from ..training.config import TrainConfig, calibration_config
from ..training.trainer import Trainer
from ..training.validation import HeldOutObservations
from .engine import LEAST_ROWS, Engine, Fold
from .fitted import Residuals, training_residuals
from .scene import (
    CALIBRATION,
    CORRECTED,
    FIELD,
    MEAN,
    RESIDUAL,
    SCENE,
    STAGES,
    SURFACES,
    SceneStage,
    StageReport,
    in_regions,
    in_scene,
    of_rows,
    scene_reports,
    too_few,
)
from .scene_model import FittedInScene
from .stage import Option, Stage, State

AS_TRACED, CALIBRATED, TRAINED = "as traced", "calibrated", "trained"
IN_STATED = " in the scene as stated"


def config_of(problem: Problem, split: Split, few: bool) -> TrainConfig:
    """Settings of the graph: Gaussians beside paths, or paths alone.

    Where rows are too ``few`` to choose stages, materials of each surface and Gaussians on surfaces are trained
    together from the first step: of six ways the best in the mean of three draws of 5 of the laboratory's training
    rows, judged by 60 others.
    """
    task, wanted = problem.record.task, problem.settings.wanted
    if FIELD in wanted and not few:
        config = with_settings(TrainConfig(), task.settings_with_scene)
        if SURFACES not in wanted:
            config = with_settings(config, ["traced.surface=0"])
    else:
        groups = ["gain", *(["materials"] if {CALIBRATION, CORRECTED} & {*wanted} else [])]
        config = calibration_config([*groups, *(["surface"] if SURFACES in wanted else [])], task.settings_of_paths)
        config = with_settings(config, ["traced.materials=surface", *(["traced.alone=0"] if few else [])])
    settings = problem.settings
    of_hybrid = [f"seed={problem.seed}", f"deterministic={str(settings.deterministic).lower()}"]
    of_hybrid += [] if settings.steps is None else [f"steps={settings.steps}"]
    return with_settings(config, of_hybrid).resolved(problem.record.tx_pos_m[split.all_train])


class FittedPaths(FittedInScene):
    """Scene model: a graph of paths, Gaussians on surfaces and those of a field.

    ``held_out`` are predictions of the held-out rows by a fit to the others, None of a fit to all rows.
    """

    fitted: FittedField
    held_out: HeldOutObservations | None = None

    def predict_rows(self, rows: IntArray, receiver: int) -> Prediction | None:
        """Predictions of held-out rows by which the training chose its state; None: other rows are among them."""
        held_out = self.held_out
        if held_out is None:
            return None
        mine = np.flatnonzero(held_out.receiver == receiver)
        order = mine[np.argsort(held_out.row[mine], kind="stable")]
        place = np.searchsorted(held_out.row[order], rows)
        is_judged = place < len(order)
        if not is_judged.all() or (held_out.row[order[place]] != rows).any():
            return None
        return Prediction(held_out.predicted[order[place]])


class _Training(NamedTuple):
    """A training whose state held-out rows choose."""

    trainer: Trainer
    problem: Problem  # with the scene of its paths


class PathsStage(Stage):
    """Traced paths as they are, or trained: parameters of paths, then Gaussians on surfaces, then those of a field."""

    name = "paths"

    def options(self, problem: Problem, split: Split) -> Sequence[Option]:
        """All; trained ones alone where rows are too few to choose by.

        A training finds materials itself, from those of the scene as it is stated or as it is calibrated: both are
        tried, and all further parameters in the better one.
        """
        wanted = {*problem.settings.wanted}
        rows = hold_out_once(problem, split)
        judging = 0 if rows is None else np.count_nonzero(in_regions(split, rows.fold.test))
        if judging < LEAST_ROWS or too_few(problem.record, split):
            return [Option(TRAINED, self._unjudged)]
        options = [Option(AS_TRACED, self._as_traced)]
        if not problem.record.task.has_gain and not wanted & {CALIBRATION, CORRECTED, SURFACES, FIELD}:
            return options
        stated = [False, True] if {CALIBRATION, CORRECTED} & wanted else [False]
        before = ""
        for freedom, name in enumerate((CALIBRATED, SURFACES, FIELD)):
            if name == CALIBRATED or name in wanted:
                fits = [partial(self._trained, of and not before) for of in stated]
                options += [
                    Option(_named(name, of), fit, 1 + freedom, before and _named(before, of))
                    for of, fit in zip(stated, fits, strict=True)
                ]
                before = name
        return options

    def judging(self, split: Split, row: IntArray) -> NDArray[np.bool_]:
        """The regions alone, as those that judge the scene, which is fitted to the other rows."""
        return in_regions(split, row)

    def _as_traced(self, state: State, split: Split, session: Session) -> State:
        config = calibration_config(["gain"], state.problem.record.task.settings_of_paths)
        of_gain = replace(state.problem, settings=config, checked=[])
        session.progress("tracing", 0.0)
        return replace(state, fitted=FittedPaths(WRF_GS_PLUS.as_traced(of_gain, split, session), state.problem))

    def _unjudged(self, state: State, split: Split, session: Session) -> State:
        """A training whose state is chosen, if at all, by rows that it holds out itself."""
        few = too_few(state.problem.record, split)
        if few:  # all of them train, as none can choose
            split = replace(split, train=split.all_train, validation=split.validation[:0])
        inner = replace(state.problem, settings=config_of(state.problem, split, few), checked=[])
        return replace(state, fitted=FittedPaths(WRF_GS_PLUS.fit(inner, split, session), state.problem))

    def _trained(self, in_stated: bool, state: State, split: Split, session: Session) -> State:
        """The next training of the curriculum, or all where no rows are held out by which it could choose."""
        problem, fold, before = state.problem, state.fold, cast(_Training | None, state.kept.get(self.name))
        if in_stated:
            if SceneStage.name not in state.kept:
                raise InputError("the scene is as stated")
            problem = state.kept[SceneStage.name].stated
        if fold is None or not of_rows(problem.record, fold):
            return self._unjudged(replace(state, problem=problem), split, session) if before is None else state
        rows = replace(split, train=split.all_train, validation=fold.test, test=fold.test[:0])
        inner = replace(problem, settings=config_of(problem, rows, False), checked=[])
        graph, trainer = WRF_GS_PLUS.train_part(before and before.trainer, inner, rows, session)
        carried, scene_model = {**state.kept, self.name: _Training(trainer, problem)}, FittedPaths(graph, problem)
        scene_model.held_out = graph.held_out
        return replace(state, problem=problem, fitted=scene_model, kept=carried)

    def continued(self, option: Option, chosen: State, scores: Mapping[str, FloatArray]) -> Option:
        """The training goes on from the chosen state with all rows."""
        training: _Training | None = chosen.kept.get(self.name)
        if option.name == AS_TRACED:
            return option

        def fit(state: State, split: Split, session: Session) -> State:
            problem = state.problem
            if option.name.endswith(IN_STATED):  # what the stage of the scene has found is not used
                shutil.rmtree(session.folder / SCENE, ignore_errors=True)
                problem = replace(problem, scene=chosen.problem.scene, material=chosen.problem.material)
            if training is None:
                return self._unjudged(replace(state, problem=problem), split, session)
            inner = replace(problem, settings=config_of(problem, split, False), checked=[])
            graph = WRF_GS_PLUS.continued(training.trainer, training.problem.scene, inner, split, session)
            return replace(state, problem=problem, fitted=FittedPaths(graph, problem))

        return option._replace(fit=fit)


def _named(name: str, in_stated: bool) -> str:
    return name + IN_STATED * in_stated


class TracedPaths(Model):
    """Scene model of spectra and channels: no name of the registry."""

    name, source, settings = "paths", WRF_GS_PLUS.source, object
    tasks, gaps = WRF_GS_PLUS.tasks, WRF_GS_PLUS.gaps
    scene, uplink = "required", "optional"
    several_carriers, new_receivers = True, True

    def fit(self, problem: Problem, split: Split, session: Session) -> FittedPaths:
        """Correct the scene, then train paths, Gaussians on surfaces and those of the field in it.

        Raises:
            Interrupted: stopped; the correction is kept, training goes on from its checkpoint.
        """
        engine = Engine(self, (SceneStage(), PathsStage()), problem, split, session)
        state = engine.fit()
        scene_model = state.fitted
        assert isinstance(scene_model, FittedPaths)
        scene_model.problem, scene_model.unseen, scene_model.options = (
            state.problem,
            engine.unseen,
            engine.stated_reports(),
        )
        scene_model.stages = tuple(_reports(engine, scene_model.fitted, problem.record.task.higher_is_better))
        # Observations at other carriers have residuals of their own.
        if RESIDUAL in problem.settings.wanted and problem.record.carriers_hz is None:
            scene_model.with_residuals = engine.of_fold("with-residuals", partial(_with_residuals, problem))
        del engine, state  # with the trainings of the options
        release_memory()
        return scene_model

    def selects(self, problem: Problem, splits: Sequence[Split]) -> bool:
        """By held-out rows."""
        return True

    def load(self, arrays: Arrays, problem: Problem, folder: Path) -> FittedPaths:
        """The scene model that was fitted in a folder."""
        inner = in_scene(problem, folder)
        return FittedPaths(from_arrays(FittedField, arrays, problem=inner, folder=folder), inner)

    def check(self, problem: Problem, splits: Sequence[Split]) -> None:
        """Refuse what the training of the graph refuses."""
        for split in splits:
            config = config_of(problem, split, too_few(problem.record, split))
            WRF_GS_PLUS.check(replace(problem, settings=config), [split])


def _with_residuals(problem: Problem, state: State, fold: Fold, mean: FloatArray) -> FloatArray:
    """Predictions of held-out observations, ``mean`` [q, ...] by a state, with what that leaves of the other rows."""
    record, held_out, result = fold.problem.record, fold.held_out, np.array(mean)
    assert state.fitted is not None
    residuals = Residuals.of(training_residuals(state.fitted, record, fold.split), record, fold.split, problem.seed)
    for place, number in enumerate(fold.numbers):
        of_receiver = held_out.receiver == number
        if of_receiver.any():
            at_m = problem.record.tx_pos_m[held_out.row[of_receiver]]
            result[of_receiver] += residuals(at_m, place, mean.shape[1:])
    return problem.record.task.limited(result)


def _reports(engine: Engine, graph: FittedField, higher_is_better: bool) -> list[StageReport]:
    """Reports of the scene's stages and of those of the training; materials that the graph trained are a calibration
    where the scene's were not taken.
    """
    reports = {report.stage: report for report in scene_reports(engine.reports, higher_is_better)}
    of_paths = {report.option: report for report in engine.reports if report.stage == PathsStage.name}
    taken = next(name for name, report in of_paths.items() if report.taken)
    if taken.endswith(IN_STATED):
        unused = [replace(report, kept=False) for report in reports.values() if report.stage != MEAN]
        reports |= {report.stage: report for report in unused}
    used = {SURFACES: any(name.startswith("surface.") for name in graph.params), FIELD: graph.field is not None}
    if taken == TRAINED:  # nothing could be judged
        last = [name for name in used if used[name]]
        return [*reports.values(), *(StageReport(name, True, None, graph.train_seconds) for name in last)]
    for stage, name in ((CALIBRATION, CALIBRATED), (SURFACES, SURFACES), (FIELD, FIELD)):
        tried = [of_paths[each] for each in (name, _named(name, True)) if each in of_paths and of_paths[each].seconds]
        if not tried:
            continue
        best = (max if higher_is_better else min)(tried, key=lambda report: report.held_out or 0.0)
        seconds, kept = sum(report.seconds or 0.0 for report in tried), used.get(stage, taken != AS_TRACED)
        if stage not in reports or (kept and not reports[stage].kept):
            reports[stage] = StageReport(stage, kept, best.held_out, seconds)
    return sorted(reports.values(), key=lambda report: STAGES.index(report.stage))
