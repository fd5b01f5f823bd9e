"""The stage *scene*: materials, gains and geometry of a scene by the measurements (`wrf_mi.correction`).

scene/    in a fit's folder: the corrected scene, of a fit to all rows with its page
edit.npz  beside it, of a fit to a part of the rows: the state of the correction, from which one to all rows goes on
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..backend.device import release_memory
from ..core import Record, Split
from ..core.array_files import stored_arrays, write_arrays
from ..core.stored import from_arrays, to_arrays
from ..core.types import FloatArray, IntArray
from ..correction import CorrectionOptions, default_options, write_page, write_scene
from ..correction.edits import TracedScene, fit_edit, refit_edit
from ..correction.options import FRAME, HIDDEN, MATERIALS, PHASES, PLANES
from ..correction.state import SceneEdit
from ..estimators.model import Problem, Session
from ..scene.correction_data import FILE as CORRECTION
from ..training.selection import hold_out_groups
from .engine import CONFIDENCE, OptionReport
from .stage import Option, Stage, State

SCENE, EDIT = "scene", "edit.npz"
STAGES = ("mean", "calibration", "correction", "surfaces", "field", "residual")  # stages in their order
MEAN, CALIBRATION, CORRECTED, SURFACES, FIELD, RESIDUAL = STAGES
OF_GEOMETRY = frozenset((PLANES, FRAME, HIDDEN))  # parameter groups beyond materials and gains
FAST = tuple(stage for stage in STAGES if stage != FIELD)  # without the stage whose training takes most of the time
AS_STATED, CALIBRATED, MOVED, ANEW = "as stated", "calibrated", "corrected", "corrected, paths found anew"
"""Options of the scene: nothing, materials and gains (and faces that a scan lacks), planes, too, and further along the
paths of the scene whose planes have moved."""


@dataclass(frozen=True)
class StageReport:
    """What one stage contributes."""

    stage: str  # its name, of `STAGES`
    kept: bool  # whether it is part of the prediction
    # Mean score of held-out training rows by the stages up to it; None: it was not judged
    held_out: float | None = None
    seconds: float | None = None  # duration of its fit; None: it is part of the next one's


def stated_reports(reports: Collection[StageReport]) -> list[dict[str, Any]]:
    """Reports as ``metrics.json`` has them."""
    return [asdict(report) for report in reports]


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


def in_regions(split: Split, row: IntArray) -> NDArray[np.bool_]:
    """Which held-out rows [q] lie in regions that are held out: validation rows lie among those that a scene is fitted
    to, and add to few.
    """
    return np.asarray(~np.isin(row, split.validation) | bool(split.held_receivers))


def of_rows(record: Record, fold: Split) -> bool:
    """Whether a fold holds out rows of receivers and carriers that train, by which a training can choose its state."""
    carriers = record.carriers_hz
    is_trained = carriers is None or bool(np.isin(carriers[fold.test], carriers[fold.all_train]).all())
    return is_trained and not fold.held_receivers


@dataclass(frozen=True)
class Edited:
    """A scene and what was found of it, kept for a fit to all rows."""

    stated: Problem  # with the scene before the edit
    options: CorrectionOptions
    edit: SceneEdit


class Change(NamedTuple):
    """What an option of the stage changes."""

    groups: Collection[str]  # parameter groups that are fitted; none leave the scene as stated
    options: CorrectionOptions
    near: IntArray  # validation rows, which are fitted to, too: they do not judge (`in_regions`)


class SceneStage(Stage):
    """Correction of the scene.

    ``options`` are those of the correction; None: by the task and the stages that the problem's settings want.
    """

    name = "scene"

    def __init__(self, options: CorrectionOptions | None = None) -> None:
        self._options = options

    def options(self, problem: Problem, split: Split) -> Sequence[Option]:
        """The scene as it is stated, and where rows suffice and settings allow it, calibrated and corrected."""
        how = self._options or _wanted_options(problem)
        if how is None or not (split.held_receivers or not too_few(problem.record, split)):
            return [Option(AS_STATED, lambda state, split, session: state)]
        groups = [group for group in how.groups if group != PHASES]
        still = [group for group in groups if group not in (PLANES, FRAME)]
        changes = (Change(names, how, split.validation) for names in ((), still, groups))
        stated, calibrated, moved = (partial(self._fit, change) for change in changes)
        options = [Option(AS_STATED, stated)]
        if still == groups or MATERIALS in still:
            options.append(Option(CALIBRATED, calibrated, 1))
        if still != groups:
            # Other paths make good planes better. They do not mend those that fit training rows alone, and finding
            # them takes as long as all that was done before.
            options += [Option(MOVED, moved, 2), Option(ANEW, moved, 2, MOVED)]
        return options

    def confidence(self, rows: int) -> float:
        """Fits with more freedom also fit what no surface explains."""
        return CONFIDENCE

    def judging(self, split: Split, row: IntArray) -> NDArray[np.bool_]:
        """The regions alone (`in_regions`)."""
        return in_regions(split, row)

    def _fit(self, change: Change, state: State, split: Split, session: Session) -> State:
        """Some parameter groups fitted, from an edit that the state may have."""
        if not change.groups:
            return state
        before: Edited | None = state.kept.get(self.name)
        stated_problem, place = before.stated if before else state.problem, session.folder / SCENE
        path = session.folder / EDIT
        if not path.exists():
            assert stated_problem.scene is not None
            how = with_near(state, split, change.near), change.options, stated_problem.material, session.progress
            traced, edit = (
                TracedScene(stated_problem.scene, stated_problem.record, *how),
                before.edit if before else None,
            )
            posterior = traced.fitted_posterior(traced.record, traced.split.all_train, edit)
            fitted = fit_edit(posterior, change.groups, edit)
            session.folder.mkdir(parents=True, exist_ok=True)
            write_scene(fitted, traced.kinds, place)
            write_arrays(path, to_arrays(fitted.edit))
            del posterior, fitted, traced
            release_memory()
        edited = Edited(stated_problem, change.options, from_arrays(SceneEdit, stored_arrays(path)))
        problem = replace(stated_problem, scene=str(place), material=None)
        return replace(state, problem=problem, kept={**state.kept, self.name: edited})

    def continued(self, option: Option, chosen: State, scores: Mapping[str, FloatArray]) -> Option:
        """Least squares with all rows, from what was found by the rows of the fold."""
        edited: Edited | None = chosen.kept.get(self.name)
        if edited is None:
            return option
        of_fold = chosen.problem.record.receivers
        out = [of_fold[number].name for number in chosen.fold.held_receivers] if chosen.fold is not None else []

        def fit(state: State, split: Split, session: Session) -> State:
            problem, place = state.problem, session.folder / SCENE
            if not (place / CORRECTION).exists():  # a resumed fit finds it
                assert problem.scene is not None
                how = split, edited.options, problem.material, session.progress
                traced = TracedScene(problem.scene, problem.record, *how)
                held = {problem.record.receivers[number].name for number in split.held_receivers}
                names = [name for name in out if name not in held]
                facts = {"held_out": len(next(iter(scores.values()))), "held_out_receivers": names}
                named = {"" if name == AS_STATED else name: score for name, score in scores.items()}
                write_page(refit_edit(traced, edited.edit, named, facts), place, replace=True)
                release_memory()
            return replace(state, problem=in_scene(problem, session.folder))

        return option._replace(fit=fit)


def _wanted_options(problem: Problem) -> CorrectionOptions | None:
    """Options of a correction by the stages that a problem's settings want; None: neither of its stages."""
    wanted, how = {*problem.settings.wanted}, default_options(problem.record)
    if CORRECTED in wanted:
        return how
    groups = tuple(group for group in how.groups if group not in OF_GEOMETRY)
    return replace(how, groups=groups) if CALIBRATION in wanted else None


def with_near(state: State, split: Split, near: IntArray) -> Split:
    """The split of a fold with rows ``near`` to those that train among these, where a training can choose by them."""
    if state.fold is None or not of_rows(state.problem.record, state.fold):
        return split
    return replace(split, train=np.union1d(split.train, near), test=np.setdiff1d(split.test, near))


def scene_reports(options: Sequence[OptionReport], higher_is_better: bool) -> list[StageReport]:
    """Reports of the stages mean, calibration and correction by those of the scene's options, none if none was tried.

    Materials and gains are the calibration, all further parameters the correction.
    """
    tried = {report.option: report for report in options if report.stage == SceneStage.name and report.seconds}
    if not tried:
        return []
    taken = next((name for name, report in tried.items() if report.taken), AS_STATED)
    reports = [StageReport(MEAN, True, tried[AS_STATED].held_out)]
    for stage, names in ((CALIBRATION, (CALIBRATED,)), (CORRECTED, (MOVED, ANEW))):
        of_stage = [tried[name] for name in names if name in tried]
        if of_stage:
            # What was not taken is reported by the best that it reached.
            order = sorted(of_stage, key=lambda report: report.held_out or 0.0, reverse=higher_is_better)
            best = next((report for report in of_stage if report.taken), order[0])
            kept = taken in names or (stage == CALIBRATION and taken in (MOVED, ANEW))
            reports.append(StageReport(stage, kept, best.held_out, sum(report.seconds or 0.0 for report in of_stage)))
    return reports
