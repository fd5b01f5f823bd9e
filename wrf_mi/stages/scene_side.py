"""The hybrid's scene: its correction (stages 1 to 3), and for spectra and channels paths and Gaussians in it (4 and 5).

scene/  in a part's folder: the corrected scene with its page, where the correction gained (`wrf_mi.correction`)
"""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Collection, Mapping, Sequence
from copy import copy
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..backend.device import release_memory
from ..core import InputError, Prediction, Record, Split
from ..core.files import write_atomically
from ..core.settings import with_settings
from ..correction import Correction, correct_scene, default_options, write_page
from ..correction.options import FRAME, HIDDEN, PLANES
from ..models import model
from ..models.error_prior import ErrorPrior
from ..models.gaussian.model import WRF_GS_PLUS, FittedField
from ..models.held_out import as_unseen, labelled
from ..models.model import Arrays, Decomposition, Fitted, HeldOutPrediction, Inputs, Model, PredictAll, Problem, Session
from ..scene.correction_data import FILE as CORRECTION
from ..tasks import instrument_of, task_of
from ..tracing import TraceOptions
from ..tracing.tracer import RayTracer, fit_offsets
from ..training.config import TrainConfig, calibration_config, task_settings
from ..training.selection import HeldOut, hold_out_groups

logger = logging.getLogger(__name__)

SCENE, STAGES_FILE = "scene", "stages.json"
STAGES = ("mean", "calibration", "correction", "surfaces", "field", "residual")  # stages in their order
MEAN, CALIBRATION, CORRECTED, SURFACES, FIELD, RESIDUAL = STAGES
OF_GEOMETRY = frozenset((PLANES, FRAME, HIDDEN))  # parts of a correction beyond materials and gains
FAST = tuple(stage for stage in STAGES if stage != FIELD)  # without the stage whose training takes most of the time


@dataclass(frozen=True)
class StageReport:
    """What one stage contributes."""

    stage: str  # its name, of `STAGES`
    kept: bool  # whether it is part of the prediction
    # Mean score of held-out training rows by the stages up to it; None: it was not judged
    held_out: float | None = None
    seconds: float | None = None  # duration of its fit; None: it is part of the next one's


class SceneSide(Fitted):
    """A part of the hybrid that predicts from the scene, by a model fitted in it.

    ``problem`` is the hybrid's with that scene, ``stages`` are reports of those that were tried, none after loading.
    """

    def __init__(self, fitted: Fitted, problem: Problem, stages: Collection[StageReport] = ()) -> None:
        self.fitted, self.problem, self.stages = fitted, problem, tuple(stages)
        self.receivers, self.uses_heading, self.carriers_hz = fitted.receivers, fitted.uses_heading, fitted.carriers_hz

    def predict(self, inputs: Inputs, receiver: int) -> Prediction:
        """Observations of the receiver of that index, [m, ...]."""
        return self.fitted.predict(inputs, receiver)

    def predict_mean(self, inputs: Inputs, receiver: int) -> NDArray[Any]:
        """The mean of `predict`, of strengths in a fraction of its time."""
        return self.fitted.predict_mean(inputs, receiver)

    def decompose(self, inputs: Inputs, receiver: int, std: bool = True) -> Decomposition:
        """Observations, and the paths' and the Gaussians' share of them where there are both."""
        return self.fitted.decompose(inputs, receiver, std)

    def error_prior(self, receiver: int) -> ErrorPrior | None:
        """As of the fitted model."""
        return self.fitted.error_prior(receiver)

    def tracing_once(self) -> SceneSide:
        """As of the fitted model."""
        shared = copy(self)
        shared.fitted = self.fitted.tracing_once()
        return shared

    def in_scene(self, scene: str) -> SceneSide:
        """The fitted model in an edited copy of the scene that it was fitted in."""
        return type(self)(self.fitted.in_scene(scene), replace(self.problem, scene=scene, material=None))

    def arrays(self) -> Arrays:
        """Arrays of the fitted model."""
        return self.fitted.arrays()

    def held_out_at(self, held_out: HeldOut) -> HeldOutPrediction | None:
        """Predictions of held-out rows, with errors as of rows that the scene has not seen; None: not available."""
        return self.unseen


def inside(session: Session, *names: str) -> Session:
    """The session with a folder inside its own."""
    place = session.folder.joinpath(*names)
    return replace(session, folder=place, run=place)


def too_few(record: Record, split: Split) -> bool:
    """Whether the training rows are too few to hold groups of them out for a choice of stages."""
    return hold_out_groups(split, record.tx_pos_m) is split


def in_scene(problem: Problem, folder: Path) -> Problem:
    """The problem with the scene of a fit in a folder: the corrected one, where there is one."""
    corrected = folder / SCENE
    return replace(problem, scene=str(corrected), material=None) if (corrected / CORRECTION).exists() else problem


def corrected(problem: Problem, split: Split, session: Session) -> tuple[Problem, list[StageReport]]:
    """The problem in the scene that training rows correct, and reports of stages 1 to 3.

    The corrected scene lies in the session's folder where it gains; a resumed fit finds it there.
    """
    record, path = problem.record, session.folder / STAGES_FILE
    if path.exists():
        return in_scene(problem, session.folder), [StageReport(**report) for report in json.loads(path.read_text())]
    reports: list[StageReport] = []
    # A correction changes materials, too: it contains the calibration.
    wanted = not {CALIBRATION, CORRECTED}.isdisjoint(problem.settings.wanted)
    if wanted and (split.held_receivers or not too_few(record, split)):
        reports = _correct(problem, split, session)
        release_memory()
    write_reports(session.folder, reports)
    return in_scene(problem, session.folder), reports


def _correct(problem: Problem, split: Split, session: Session) -> list[StageReport]:
    """Write the corrected scene where it gains; reports of its stages, none where it cannot be corrected."""
    record, options = problem.record, default_options(problem.record)
    if CORRECTED not in problem.settings.wanted:
        options = replace(options, parts=tuple(part for part in options.parts if part not in OF_GEOMETRY))
    assert problem.scene is not None
    try:
        correction = correct_scene(problem.scene, record, split, options, problem.material, session.report)
    except InputError as error:
        logger.warning("%s; the scene is used as it is stated", error)
        return []
    if correction.kept:
        write_page(correction, session.folder / SCENE, replace=True)
    return _reports(correction, task_of(record).higher_is_better)


def _reports(correction: Correction, higher_is_better: bool) -> list[StageReport]:
    """Materials and gains are the calibration, all further parts the correction."""
    scores = {name: float(np.nanmean(score)) for name, score in correction.scores.items()}
    of_geometry = {name: bool(OF_GEOMETRY.intersection(name.split("+"))) for name in scores}
    reports = [StageReport(MEAN, True, scores.pop(""))]
    for stage, geometry in ((CALIBRATION, False), (CORRECTED, True)):
        judged = {name: score for name, score in scores.items() if of_geometry[name] == geometry}
        if judged:
            best = (max if higher_is_better else min)(judged.values())
            # What was not kept is reported by the best that it reached.
            gains = bool(correction.kept) and of_geometry[correction.kept] >= geometry
            reports.append(StageReport(stage, gains, judged.get(correction.kept, best)))
    return [*reports[:-1], replace(reports[-1], seconds=correction.seconds)]


def write_reports(folder: Path, reports: Collection[StageReport]) -> None:
    """Keep the reports of stages 1 to 3 for a resumed fit."""
    write_atomically(folder / STAGES_FILE, json.dumps(stated_reports(reports)) + "\n")


def stated_reports(reports: Collection[StageReport]) -> list[dict[str, Any]]:
    """Reports as ``metrics.json`` has them."""
    return [asdict(report) for report in reports]


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
        return super().arrays() | {"settings": model.settings_array(self.fitted.config)}

    def held_out_at(self, held_out: HeldOut) -> HeldOutPrediction | None:
        """Reports of the rows that the stages were chosen by; None: not all held-out rows are among these."""
        reports = self.fitted.held_out
        if reports is None:
            return None
        place = {pair: number for number, pair in enumerate(zip(reports.receiver, reports.row, strict=True))}
        numbers = [place.get(pair, -1) for pair in zip(held_out.receiver, held_out.row, strict=True)]
        return None if -1 in numbers else HeldOutPrediction(as_unseen(reports.report[numbers], self.problem, held_out))


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
        config, inner = model.stored_settings(TrainConfig, arrays, str(folder)), in_scene(problem, folder)
        return FittedPaths(FittedField(arrays, config, replace(inner, settings=config), folder), inner)

    def check(self, problem: Problem, splits: Sequence[Split]) -> None:
        """Refuse what the training of the graph refuses."""
        for split in splits:
            config = config_of(problem, split, problem.settings.wanted)
            WRF_GS_PLUS.check(replace(problem, settings=config), [split])


class TracedStages(InScene):
    """Stages 1 to 5: the scene's side for spectra and channels."""

    def fit(self, problem: Problem, split: Split, session: Session) -> FittedPaths:
        """Correct the scene, then train paths, Gaussians on surfaces and those of the field in it.

        Up to `FEW_ROWS` training rows they are trained in the scene as it is stated, too, and the better one of both
        scenes by the rows that chose their stages is kept.

        Raises:
            Interrupted: stopped; the correction is kept, training goes on from its checkpoint.
        """
        inner, reports = corrected(problem, split, session)
        place = inside(session, STATED)
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
                    write_reports(session.folder, reports)
                    shutil.rmtree(session.folder / SCENE)
        paths.stages = _joint_reports(reports, paths.stages)
        return paths


def _joint_reports(of_scene: Sequence[StageReport], trained: Sequence[StageReport]) -> tuple[StageReport, ...]:
    # A correction contains the calibration; parameters of paths are the graph's where it is not kept.
    is_corrected = any(report.kept and report.stage != MEAN for report in of_scene)
    first, calibrated = (of_scene, trained) if is_corrected else (trained, of_scene)
    reports = [*first, *(report for report in calibrated if report.stage != CALIBRATION)]
    return tuple(sorted(reports, key=lambda report: STAGES.index(report.stage)))


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
