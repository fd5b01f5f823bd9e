"""The scene's side for spectra and channels: stages 4 and 5, a graph of paths and Gaussians in the corrected scene."""

from __future__ import annotations

import shutil
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...core import Prediction, Split
from ...core.settings import with_settings
from ...correction import default_options
from ...tasks import instrument_of, task_of
from ...tracing import TraceOptions
from ...tracing.tracer import RayTracer, fit_offsets
from ...training.config import TrainConfig, calibration_config, task_settings
from ...training.selection import HeldOut
from ..gaussian.model import WRF_GS_PLUS, FittedField
from ..held_out import as_unseen, labelled
from ..model import Arrays, Fitted, Inputs, Model, PredictAll, Problem, Session, settings_array, stored_settings
from . import scene_side
from .scene_side import CALIBRATION, CORRECTED, FIELD, MEAN, STAGES, SURFACES, SceneSide, StageReport, too_few

STATED = "stated"  # folder of the fit in the scene as it is stated, inside the session's
FEW_ROWS = 40
"""Training rows up to which the scene as it is stated is tried beside the corrected one. Few rows are fitted by planes
that moved wrongly, too, and what Gaussians on the stated planes gain is then more; either fit takes half a minute."""
OFFSET_ROWS = 400  # most training rows whose traces tell the offset of a receiver


def config_of(problem: Problem, split: Split, wanted: Collection[str]) -> TrainConfig:
    """Settings of the graph: Gaussians beside paths, or paths alone.

    Where rows are too few to choose stages, materials of each surface and Gaussians on surfaces are trained together
    from the first step: of six ways the best in the mean of three draws of 5 of the laboratory's training rows, judged
    by 60 others.
    """
    task, few = task_of(problem.record), too_few(problem.record, split)
    if FIELD in wanted and not few:
        config = with_settings(TrainConfig(), task_settings(task.name, task.image, True))
        if SURFACES not in wanted:
            config = with_settings(config, ["traced.surface=0"])
    else:
        parts = ["gain", *(["materials"] if {CALIBRATION, CORRECTED} & {*wanted} else [])]
        config = calibration_config([*parts, *(["surface"] if SURFACES in wanted else [])], task.image)
        config = with_settings(config, ["traced.materials=surface", *(["traced.alone=0"] if few else [])])
    settings = problem.settings
    of_hybrid = [f"seed={problem.seed}", f"deterministic={str(settings.deterministic).lower()}"]
    of_hybrid += [] if settings.steps is None else [f"steps={settings.steps}"]
    return with_settings(config, of_hybrid).resolved(problem.record.tx_pos_m[split.all_train])


class FittedPaths(SceneSide):
    """The scene's side: a trained graph of paths, Gaussians on surfaces and those of a field."""

    fitted: FittedField

    def arrays(self) -> Arrays:
        """Arrays of the graph, and its settings."""
        return super().arrays() | {"settings": settings_array(self.fitted.config)}

    def held_out_at(self, held_out: HeldOut) -> Prediction | None:
        """Reports of the rows that the stages were chosen by; None: not all held-out rows are among these."""
        reports = self.fitted.held_out
        if reports is None:
            return None
        place = {pair: number for number, pair in enumerate(zip(reports.receiver, reports.row, strict=True))}
        numbers = [place.get(pair, -1) for pair in zip(held_out.receiver, held_out.row, strict=True)]
        return None if -1 in numbers else Prediction(as_unseen(reports.report[numbers], self.problem, held_out))


class InScene(Model):
    """Stages 4 and 5 in a scene that is corrected already: no name of the registry."""

    name, source, settings = "paths", WRF_GS_PLUS.source, object
    tasks, gaps = WRF_GS_PLUS.tasks, WRF_GS_PLUS.gaps
    scene, uplink = "required", "optional"
    several_carriers, new_receivers = True, True

    def fit(self, problem: Problem, split: Split, session: Session) -> FittedPaths:
        """Train paths, Gaussians on surfaces and those of the field."""
        settings = config_of(problem, split, problem.settings.wanted)
        if too_few(problem.record, split):  # all of them train, as none can choose
            split = replace(split, train=split.all_train, validation=split.validation[:0])
        graph = WRF_GS_PLUS.fit(replace(problem, settings=settings), split, session)
        scores: Mapping[str, float] = {} if graph.held_out is None else graph.held_out.score
        used = {SURFACES: any(name.startswith("surface.") for name in graph.params), FIELD: graph.field is not None}
        reports = [StageReport(CALIBRATION, True, scores[CALIBRATION])] if CALIBRATION in scores else []
        reports += [StageReport(name, used[name], scores.get(name)) for name in used if name in scores or used[name]]
        if reports:
            reports[-1] = replace(reports[-1], seconds=graph.train_seconds)
        return FittedPaths(graph, problem, reports)

    def load(self, arrays: Arrays, problem: Problem, folder: Path) -> FittedPaths:
        """The scene's side that was fitted in a folder."""
        config, inner = stored_settings(TrainConfig, arrays, str(folder)), scene_side.in_scene(problem, folder)
        return FittedPaths(FittedField(arrays, config, replace(inner, settings=config), folder), inner)

    def check(self, problem: Problem, splits: Sequence[Split]) -> None:
        """Refuse what the training of the graph refuses."""
        for split in splits:
            config = config_of(problem, split, problem.settings.wanted)
            WRF_GS_PLUS.check(replace(problem, settings=config), [split])


class Paths(InScene):
    """Stages 1 to 5: the scene's side for spectra and channels."""

    def fit(self, problem: Problem, split: Split, session: Session) -> FittedPaths:
        """Correct the scene, then train paths, Gaussians on surfaces and those of the field in it.

        Up to `FEW_ROWS` training rows they are trained in the scene as it is stated, too, and the better one of both
        scenes by the rows that chose their stages is kept.

        Raises:
            Interrupted: stopped; the correction is kept, training goes on from its checkpoint.
        """
        inner, reports = scene_side.corrected(problem, split, session)
        place = scene_side.inside(session, STATED)
        if inner.scene == problem.scene:
            # A stopped fit that had preferred the scene as it is stated finds it trained.
            paths = super().fit(inner, split, place if place.folder.exists() else session)
        else:
            paths = super().fit(inner, split, session)
            if paths.fitted.held_out is not None and len(split.all_train) <= FEW_ROWS:
                place.folder.mkdir(parents=True, exist_ok=True)
                stated = super().fit(problem, split, labelled(place, "scene as stated"))
                if _held_out_score(stated) > _held_out_score(paths):
                    paths = stated
                    reports = [replace(report, kept=report.kept and report.stage == MEAN) for report in reports]
                    scene_side.write_reports(session.folder, reports)
                    shutil.rmtree(session.folder / scene_side.SCENE)
        # A correction contains the calibration; parameters of paths are the graph's where it is not kept.
        is_corrected = any(report.kept and report.stage != MEAN for report in reports)
        reports = [report for report in reports if is_corrected or report.stage != CALIBRATION]
        trained = [report for report in paths.stages if not (is_corrected and report.stage == CALIBRATION)]
        paths.stages = tuple(sorted([*reports, *trained], key=lambda report: STAGES.index(report.stage)))
        return paths


def _held_out_score(paths: FittedPaths) -> float:
    # Of the rows that chose the stages, as if the scene had not seen them; the higher the better.
    reports, problem = paths.fitted.held_out, paths.problem
    assert reports is not None
    task, no_distance = task_of(problem.record), np.zeros(len(reports.row))
    held_out = HeldOut(reports.receiver, reports.row, no_distance, no_distance.astype(np.int64))
    scores = task.training_score(as_unseen(reports.report, problem, held_out), held_out.observed(problem.record))
    return float(np.nanmean(scores)) * (1 if task.higher_is_better else -1)


def by_stage(problem: Problem, split: Split, side: SceneSide, used: Collection[str]) -> dict[str, PredictAll]:
    """Predictions of the stages up to each but the last, of the ``used`` ones of a fitted scene's side.

    The problem has the scene as it is stated; training rows of the split fit offsets of traced signal strengths.
    """
    predictions: dict[str, PredictAll] = {}
    earlier = [stage for stage in STAGES if stage in used][:-1]
    if MEAN in earlier:
        predictions[MEAN] = _traced(problem, split)
    if side.problem.scene != problem.scene:
        predictions |= {stage: _traced(side.problem, split) for stage in (CALIBRATION, CORRECTED) if stage in earlier}
    if isinstance(side, FittedPaths):
        if SURFACES in earlier:
            fitted = side.fitted.without_gaussians() if FIELD in used else side
            predictions[SURFACES] = partial(_at_all_receivers, fitted)
        if FIELD in earlier:
            predictions[FIELD] = partial(_at_all_receivers, side)
    return predictions


def _at_all_receivers(fitted: Fitted, inputs: Inputs) -> NDArray[np.generic]:
    assert fitted.receivers is not None
    return np.stack([fitted.predict_mean(inputs, receiver) for receiver in range(len(fitted.receivers))])


def _traced(problem: Problem, split: Split) -> PredictAll:
    """Traced reports; strengths with the offset of each receiver that fits its training rows."""
    record, how = problem.record, default_options(problem.record)
    stated = record if record.carriers_hz is None else record.at_carrier(record.carriers_hz[0])
    options = TraceOptions(transmission=True, depth=how.depth, reflections=how.reflections)
    assert problem.scene is not None
    tracer = RayTracer(problem.scene, instrument_of(stated), options, problem.material)
    offsets = None
    if task_of(record).in_decibel:
        every = split.all_train
        rows = every[:: -(-len(every) // OFFSET_ROWS)]
        offsets = fit_offsets(tracer(record.tx_pos_m[rows]), record.seen(split).observation[:, rows])

    def predict(inputs: Inputs) -> NDArray[np.generic]:
        traced = tracer.trace(inputs.tx_pos_m, first_row=inputs.first_row, carriers_hz=inputs.carriers_hz)
        observed = tracer.observe(traced)
        return observed if offsets is None else offsets(observed)

    return predict
