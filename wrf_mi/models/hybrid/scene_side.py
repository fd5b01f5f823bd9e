"""The hybrid's scene: stages 1 to 3, by the correction of the scene, and what every part in it reports.

scene/  in a part's folder: the corrected scene with its page, where the correction gained (`wrf_mi.correction`)
"""

from __future__ import annotations

import json
import logging
from collections.abc import Collection
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...backend.device import release_memory
from ...core import InputError, Prediction, Record, Split
from ...core.files import write_atomically
from ...correction import Correction, correct_scene, default_options, write_page
from ...correction.options import FRAME, HIDDEN, PLANES
from ...scene.correction_data import FILE as CORRECTION
from ...tasks import task_of
from ...training.selection import HeldOut, hold_out_groups
from ..model import Arrays, Decomposition, Fitted, Inputs, Problem, Session

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

    def arrays(self) -> Arrays:
        """Arrays of the fitted model."""
        return self.fitted.arrays()

    def held_out_at(self, held_out: HeldOut) -> Prediction | None:
        """Predictions of held-out rows, with errors as of rows that the scene has not seen; None: not available."""
        return None


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
    wanted = problem.settings.wanted
    # A correction changes materials, too: it contains the calibration.
    if not {CALIBRATION, CORRECTED}.isdisjoint(wanted) and (split.held_receivers or not too_few(record, split)):
        options = default_options(record)
        if CORRECTED not in wanted:
            options = replace(options, parts=tuple(part for part in options.parts if part not in OF_GEOMETRY))
        assert problem.scene is not None
        try:
            correction = correct_scene(problem.scene, record, split, options, problem.material, session.report)
        except InputError as error:
            logger.warning("%s; the scene is used as it is stated", error)
        else:
            if correction.kept:
                write_page(correction, session.folder / SCENE, replace=True)
            reports = _reports(correction, task_of(record).higher_is_better)
            del correction
            release_memory()
    write_reports(session.folder, reports)
    return in_scene(problem, session.folder), reports


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
            gains = bool(correction.kept) and (not geometry or of_geometry[correction.kept])
            reports.append(StageReport(stage, gains, judged.get(correction.kept, best)))
    return [*reports[:-1], replace(reports[-1], seconds=correction.seconds)]


def write_reports(folder: Path, reports: Collection[StageReport]) -> None:
    """Keep the reports of stages 1 to 3 for a resumed fit."""
    write_atomically(folder / STAGES_FILE, json.dumps(stated_reports(reports)) + "\n")


def stated_reports(reports: Collection[StageReport]) -> list[dict[str, Any]]:
    """Reports as ``metrics.json`` has them."""
    return [asdict(report) for report in reports]
