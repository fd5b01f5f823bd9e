"""The scene's side for spectra and channels: stages 4 and 5, a graph of paths and Gaussians in the corrected scene."""

from __future__ import annotations

import shutil
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...core import Prediction, Split
from ...core.settings import with_settings
from ...tasks import task_of
from ...training.config import TrainConfig, calibration_config, task_settings
from ..gaussian.model import WRF_GS_PLUS, FittedField
from ..gaussian.model import check as check_graph
from ..gaussian.model import fit as fit_graph
from ..held_out import HeldOut, as_unseen, labelled
from ..model import Arrays, Decomposition, Inputs, Problem, Session, settings_array, stored_settings
from .scene_side import (
    CALIBRATION,
    CORRECTED,
    FIELD,
    MEAN,
    SCENE,
    STAGES,
    SURFACES,
    SceneSide,
    StageReport,
    corrected,
    in_scene,
    inside,
    too_few,
    write_reports,
)

STATED = "stated"
"""Folder of the fit in the scene as it is stated, inside the session's."""
FEW_ROWS = 40
"""Training rows up to which the scene as it is stated is tried beside the corrected one. Few rows are fitted by planes
that moved wrongly, too, and what Gaussians on the stated planes gain is then more; either fit takes half a minute."""


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
    own = [f"seed={problem.seed}", f"deterministic={str(settings.deterministic).lower()}"]
    own += [] if settings.steps is None else [f"steps={settings.steps}"]
    return with_settings(config, own).resolved(problem.record.tx_pos_m[split.all_train])


class FittedPaths(SceneSide):
    """The scene's side: paths, Gaussians on surfaces and those of a field.

    Args:
        graph: the trained graph in the scene that it was trained in.
        problem: problem of the hybrid with that scene.
        stages: reports of the stages that were tried.
    """

    def __init__(self, graph: FittedField, problem: Problem, stages: Sequence[StageReport] = ()) -> None:
        self.graph, self.problem, self.stages = graph, problem, tuple(stages)
        self.receivers, self.uses_heading, self.carriers_hz = graph.receivers, graph.uses_heading, graph.carriers_hz

    def predict(self, inputs: Inputs, receiver: int) -> Prediction:
        """Observations of the receiver of that index, [m, ...]."""
        return self.graph.predict(inputs, receiver)

    def decompose(self, inputs: Inputs, receiver: int, std: bool = True) -> Decomposition:
        """Observations, and the paths' and the Gaussians' share of them."""
        return self.graph.decompose(inputs, receiver, std)

    def arrays(self) -> Arrays:
        """Arrays of the graph, and its settings."""
        return self.graph.arrays() | {"settings": settings_array(self.graph.config)}

    def held_out_at(self, held: HeldOut) -> Prediction | None:
        """Reports of the rows that the stages were chosen by; None: not all held-out rows are among these."""
        reports = self.graph.held_out
        if reports is None:
            return None
        place = {pair: number for number, pair in enumerate(zip(reports.receiver, reports.row, strict=True))}
        numbers = [place.get(pair, -1) for pair in zip(held.receiver, held.row, strict=True)]
        return None if -1 in numbers else Prediction(as_unseen(reports.report[numbers], self.problem, held))


def fit(problem: Problem, split: Split, session: Session) -> FittedPaths:
    """Correct the scene, then train paths, Gaussians on surfaces and those of the field in it.

    Up to `FEW_ROWS` training rows they are trained in the scene as it is stated, too, and the better one of both scenes
    by the rows that chose their stages is kept.

    Raises:
        Interrupted: stopped; the correction is kept, training goes on from its checkpoint.
    """
    inner, reports = corrected(problem, split, session)
    place = inside(session, STATED)
    if inner.scene == problem.scene:
        # A stopped fit that had preferred the scene as it is stated finds it trained.
        paths = fit_in_scene(inner, split, place if place.folder.exists() else session)
    else:
        paths = fit_in_scene(inner, split, session)
        if paths.graph.held_out is not None and len(split.all_train) <= FEW_ROWS:
            place.folder.mkdir(parents=True, exist_ok=True)
            stated = fit_in_scene(problem, split, labelled(place, "scene as stated"))
            if _held_out_score(stated) > _held_out_score(paths):
                paths, reports = stated, [replace(one, kept=one.kept and one.stage == MEAN) for one in reports]
                write_reports(session.folder, reports)
                shutil.rmtree(session.folder / SCENE)
    # A correction contains the calibration; parameters of paths are the graph's where it is not kept.
    is_corrected = any(report.kept and report.stage != MEAN for report in reports)
    reports = [report for report in reports if is_corrected or report.stage != CALIBRATION]
    trained = [report for report in paths.stages if not (is_corrected and report.stage == CALIBRATION)]
    paths.stages = tuple(sorted([*reports, *trained], key=lambda report: STAGES.index(report.stage)))
    return paths


def _held_out_score(paths: FittedPaths) -> float:
    """Mean score of the rows that chose the stages, as if the scene had not seen them; the higher the better."""
    reports, problem = paths.graph.held_out, paths.problem
    assert reports is not None
    task, no_distance = task_of(problem.record), np.zeros(len(reports.row))
    held = HeldOut(reports.receiver, reports.row, no_distance, no_distance.astype(np.int64))
    scores = task.training_score(as_unseen(reports.report, problem, held), held.observed(problem.record))
    return float(np.nanmean(scores)) * (1 if task.higher_is_better else -1)


def fit_in_scene(problem: Problem, split: Split, session: Session) -> FittedPaths:
    """`fit` without the correction."""
    settings = config_of(problem, split, problem.settings.wanted)
    if too_few(problem.record, split):  # all of them train, as none can choose
        split = replace(split, train=split.all_train, validation=split.validation[:0])
    graph = fit_graph(replace(problem, settings=settings), split, session)
    scores: Mapping[str, float] = {} if graph.held_out is None else graph.held_out.score
    used = {SURFACES: any(name.startswith("surface.") for name in graph.params), FIELD: graph.field is not None}
    reports = [StageReport(CALIBRATION, True, scores[CALIBRATION])] if CALIBRATION in scores else []
    reports += [StageReport(one, used[one], scores.get(one)) for one in used if one in scores or used[one]]
    if reports:
        reports[-1] = replace(reports[-1], seconds=graph.train_seconds)
    return FittedPaths(graph, problem, reports)


def load(arrays: Arrays, problem: Problem, folder: Path) -> FittedPaths:
    """The scene's side that `fit` made in a folder."""
    config, inner = stored_settings(TrainConfig, arrays, str(folder)), in_scene(problem, folder)
    return FittedPaths(FittedField(arrays, config, replace(inner, settings=config), folder), inner)


def check(problem: Problem, splits: Sequence[Split]) -> None:
    """Refuse what the training of the graph refuses."""
    for split in splits:
        config = config_of(problem, split, problem.settings.wanted)
        check_graph(replace(problem, settings=config), [split])


PATHS = replace(
    WRF_GS_PLUS,
    name="paths",
    settings=object,
    fit=fit,
    load=load,
    scene="required",
    check=check,
    prepare=None,
    by_data=None,
    given=(),
    presets={},
)
"""The scene's side as an entry, which no name of the registry has."""
IN_SCENE = replace(PATHS, fit=fit_in_scene)
"""The same in a scene that is corrected already."""
