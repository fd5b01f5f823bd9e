"""The scene's side for spectra and channels: stages 4 and 5, a graph of paths and Gaussians in the corrected scene."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from ...core import Prediction, Split
from ...core.settings import with_settings
from ...tasks import task_of
from ...training.config import TrainConfig, calibration_config, task_settings
from ...training.selection import HeldOut
from ..gaussian.model import WRF_GS_PLUS, FittedField
from ..gaussian.model import check as check_graph
from ..gaussian.model import fit as fit_graph
from ..held_out import as_unseen
from ..model import Arrays, Decomposition, Inputs, Problem, Session, settings_array, stored_settings
from .scene_side import CALIBRATION, CORRECTED, FIELD, SURFACES, SceneSide, StageReport, corrected, in_scene, too_few


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

    Raises:
        Interrupted: stopped; the correction is kept, training goes on from its checkpoint.
    """
    inner, reports = corrected(problem, split, session)
    paths = fit_in_scene(inner, split, session)
    paths.stages = (*reports, *(one for one in paths.stages if one.stage != CALIBRATION or not reports))
    return paths


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
