"""The scene's side of the hybrid: stages 1 to 5, by the correction of a scene and one graph of paths and Gaussians.

scene/  in its folder: the corrected scene with its page, where the correction gained (`wrf_mi.correction`)
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core import InputError, Prediction, Record, Split
from ...core.files import write_atomically
from ...core.settings import with_settings
from ...core.types import IntArray
from ...correction import correct_scene, default_options, write_page
from ...correction.options import FRAME, HIDDEN, PLANES
from ...scene.correction_data import FILE as CORRECTION
from ...tasks import task_of
from ...training.config import TrainConfig, calibration_config, task_settings
from ...training.reach import hold_out_groups
from ..gaussian.model import WRF_GS_PLUS, FittedField
from ..gaussian.model import check as check_graph
from ..gaussian.model import fit as fit_graph
from ..model import Arrays, Decomposition, Fitted, Inputs, Problem, Session, settings_array, stored_settings

SCENE, STAGES_FILE = "scene", "stages.json"
MEAN, CALIBRATION, CORRECTION_STAGE, SURFACES, FIELD, RESIDUAL = (
    "mean",
    "calibration",
    "correction",
    "surfaces",
    "field",
    "residual",
)
STAGES = (MEAN, CALIBRATION, CORRECTION_STAGE, SURFACES, FIELD, RESIDUAL)
"""Stages in their order."""


@dataclass(frozen=True)
class StageReport:
    """What one stage contributes.

    Attributes:
        stage: its name, of `STAGES`.
        kept: whether it is part of the prediction.
        held_out: mean score of held-out training rows by the stages up to it; None: it was not judged.
        seconds: duration of its fit; None: it is part of the next one's.
    """

    stage: str
    kept: bool
    held_out: float | None = None
    seconds: float | None = None


def too_few(record: Record, split: Split) -> bool:
    """Whether the training rows are too few to hold groups of them out for a choice of stages."""
    return hold_out_groups(split, record.tx_pos_m) is split


def config_of(problem: Problem, split: Split, wanted: Collection[str]) -> TrainConfig:
    """Settings of the graph: Gaussians beside paths, or paths alone.

    Where rows are too few to choose stages, materials of each surface and Gaussians on surfaces are trained together
    from the first step: of six ways this was the best on 5 rows of the laboratory (docs/hybrid.md).
    """
    task, few = task_of(problem.record), too_few(problem.record, split)
    if FIELD in wanted and not few:
        config = with_settings(TrainConfig(), task_settings(task.name, task.image, True))
        if SURFACES not in wanted:
            config = with_settings(config, ["traced.surface=0"])
    else:
        parts = ["gain", *(["materials"] if CALIBRATION in wanted else [])]
        config = calibration_config([*parts, *(["surface"] if SURFACES in wanted else [])], task.image)
        config = with_settings(config, ["traced.materials=surface", *(["traced.alone=0"] if few else [])])
    own = [f"seed={problem.seed}", f"deterministic={str(problem.settings.deterministic).lower()}"]
    return with_settings(config, own).resolved(problem.record.tx_pos_m[split.all_train])


class FittedPaths(Fitted):
    """The scene's side: paths, Gaussians on surfaces and those of a field.

    Args:
        graph: the trained graph in the scene that it was trained in.
        problem: problem with that scene.
        stages: reports of the stages that were tried; none after loading.
    """

    def __init__(self, graph: FittedField, problem: Problem, stages: Sequence[StageReport] = ()) -> None:
        self.graph, self.problem, self.stages = graph, problem, tuple(stages)
        self.receivers, self.uses_heading, self.carriers_hz = graph.receivers, graph.uses_heading, graph.carriers_hz
        self.train_seconds = graph.train_seconds

    def predict(self, inputs: Inputs, receiver: int) -> Prediction:
        """Observations of the receiver of that index, [m, ...]."""
        return self.graph.predict(inputs, receiver)

    def decompose(self, inputs: Inputs, receiver: int, std: bool = True) -> Decomposition:
        """Observations, and the paths' and the Gaussians' share of them."""
        return self.graph.decompose(inputs, receiver, std)

    def arrays(self) -> Arrays:
        """Arrays of the graph, and its settings."""
        return self.graph.arrays() | {"settings": settings_array(self.graph.config)}

    def held_out_at(self, receiver: IntArray, row: IntArray) -> NDArray[Any] | None:
        """Reports [q, ...] of training rows that the stages were chosen by; None: not all of these rows are."""
        reports = self.graph.held_out
        if reports is None:
            return None
        place = {pair: number for number, pair in enumerate(zip(reports.receiver, reports.row, strict=True))}
        wanted = list(zip(receiver, row, strict=True))
        return reports.report[[place[pair] for pair in wanted]] if all(pair in place for pair in wanted) else None


def needs_graph(wanted: Collection[str]) -> bool:
    """Whether one of the stages needs the scene."""
    return not {MEAN, CALIBRATION, CORRECTION_STAGE, SURFACES, FIELD}.isdisjoint(wanted)


def fit(problem: Problem, split: Split, session: Session) -> FittedPaths:
    """Correct the scene, then train paths, Gaussians on surfaces and those of the field in it.

    Raises:
        Interrupted: stopped; the correction is kept, training goes on from its checkpoint.
    """
    wanted = problem.settings.wanted
    reports = _corrected(problem, split, wanted, session)
    inner = _in_scene(problem, session.folder, config_of(problem, split, wanted))
    if too_few(problem.record, split):  # all of them train, as none can choose
        split = replace(split, train=split.all_train, validation=split.validation[:0])
    graph = fit_graph(inner, split, session)
    scores: Mapping[str, float] = {} if graph.held_out is None else graph.held_out.score
    used = {SURFACES: any(name.startswith("surface.") for name in graph.params), FIELD: graph.field is not None}
    trained = [stage for stage in (SURFACES, FIELD) if stage in scores or used[stage]]
    if CALIBRATION in scores and not reports:
        reports = [StageReport(CALIBRATION, True, scores[CALIBRATION])]
    for stage in trained:
        last = stage == trained[-1]
        reports.append(StageReport(stage, used[stage], scores.get(stage), graph.train_seconds if last else None))
    return FittedPaths(graph, inner, reports)


def _in_scene(problem: Problem, folder: Path, settings: TrainConfig) -> Problem:
    """The problem with the scene of a fit in a folder: the corrected one, where there is one."""
    corrected = folder / SCENE
    if not (corrected / CORRECTION).exists():
        return replace(problem, settings=settings)
    return replace(problem, settings=settings, scene=str(corrected), material=None)


def _corrected(problem: Problem, split: Split, wanted: Collection[str], session: Session) -> list[StageReport]:
    """Reports of stages 1 to 3; the corrected scene lies in the session's folder where it is kept."""
    record, path = problem.record, session.folder / STAGES_FILE
    if path.exists():
        return [StageReport(**one) for one in json.loads(path.read_text())]
    reports: list[StageReport] = []
    if CALIBRATION in wanted and (split.held_receivers or not too_few(record, split)):
        options = default_options(record)
        if CORRECTION_STAGE not in wanted:
            parts = tuple(part for part in options.parts if part not in (PLANES, FRAME, HIDDEN))
            options = replace(options, parts=parts)
        assert problem.scene is not None
        try:
            found = correct_scene(problem.scene, record, split, options, problem.material, session.report)
        except InputError as error:
            session.report(f"no correction: {error}", 1.0)
        else:
            if found.kept:
                write_page(found, session.folder / SCENE, replace=True)
            scores = {name: float(np.nanmean(score)) for name, score in found.scores.items()}
            kept = set(found.kept.split("+")) - {""}
            moved = bool(kept & {PLANES, FRAME, HIDDEN})
            corrected = [score for name, score in scores.items() if {PLANES, FRAME, HIDDEN} & set(name.split("+"))]
            alone = [scores[name] for name in scores if name and not {PLANES, FRAME, HIDDEN} & set(name.split("+"))]
            reports.append(StageReport(MEAN, True, scores[""]))
            if alone:
                reports.append(StageReport(CALIBRATION, bool(kept), alone[0], None if corrected else found.seconds))
            if corrected:
                best = scores[found.kept] if moved else (max if task_of(record).higher_is_better else min)(corrected)
                reports.append(StageReport(CORRECTION_STAGE, moved, best, found.seconds))
    write_atomically(path, json.dumps([asdict(one) for one in reports]) + "\n")
    return reports


def load(arrays: Arrays, problem: Problem, folder: Path) -> FittedPaths:
    """The scene's side that `fit` made in a folder."""
    config = stored_settings(TrainConfig, arrays, str(folder))
    inner = _in_scene(problem, folder, config)
    return FittedPaths(FittedField(arrays, config, inner, folder), inner)


def check(problem: Problem, splits: Sequence[Split]) -> None:
    """Refuse what the training of the graph refuses."""
    for split in splits:
        config = config_of(problem, split, problem.settings.wanted)
        check_graph(replace(problem, settings=config), [split])


def stated_reports(reports: Collection[StageReport]) -> list[dict[str, Any]]:
    """Reports as ``metrics.json`` has them."""
    return [asdict(one) for one in reports]


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
