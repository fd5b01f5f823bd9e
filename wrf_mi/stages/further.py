"""Stages of other packages, which go on from the prediction of the hybrid.

A stage is an instance of `FurtherStage`, which an entry point of the group ``wrf_mi.stages`` names by the stage's name.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, ClassVar, Self

import numpy as np

from ..core import Split
from ..core.registry import Registry
from ..core.stored import NOT_STORED, from_arrays, to_arrays
from ..estimators.model import Arrays, Fitted, Model, PredictAll, Problem, Session
from .engine import Engine
from .fitted import FittedMixture
from .scene import StageReport, stated_reports
from .scene_model import at_all_receivers
from .stage import Option, Stage, State

FURTHER = "further"  # array of the names of such stages in their order, and beginning of the names of their arrays


@dataclass(eq=False)
class Further(Fitted):
    """A prediction that a stage made of that of the stages ``before``; all but `predict` is theirs.

    A subclass is a dataclass, whose further fields are stored (`wrf_mi.core.stored`).
    """

    stage: ClassVar[str]  # name of the stage

    before: Fitted = field(metadata=NOT_STORED)

    def __post_init__(self) -> None:
        before = self.before
        self.receivers, self.uses_heading, self.carriers_hz = before.receivers, before.uses_heading, before.carriers_hz
        self.run_sd_db, self.traces = before.run_sd_db, before.traces

    @property
    def depends_on_heading(self) -> bool:
        """As before."""
        return self.before.depends_on_heading

    def tracing_once(self) -> Self:
        """The stage after the model that traces once."""
        return replace(self, before=self.before.tracing_once())

    def in_scene(self, scene: str) -> Self:
        """The stage after the prediction in an edited scene."""
        return replace(self, before=self.before.in_scene(scene))

    def by_stage(self, split: Split) -> dict[str, PredictAll]:
        """Predictions by the stages before, up to each and to the last of them."""
        kept_stages = [report["stage"] for report in self.facts()["stages"] if report["kept"]]
        last = kept_stages[kept_stages.index(self.stage) - 1] if self.stage in kept_stages[1:] else ""
        if not last:
            return self.before.by_stage(split)
        count = len(first_of(self).problem.record.receivers)
        return self.before.by_stage(split) | {last: partial(at_all_receivers, self.before, count)}

    def arrays(self) -> Arrays:
        """Arrays of the stages before and of this one."""
        arrays = self.before.arrays()
        names = [*np.atleast_1d(arrays.get(FURTHER, np.zeros(0, str))), self.stage]
        return arrays | {FURTHER: np.asarray(names, str)} | to_arrays(self, f"{FURTHER}/{self.stage}/")

    def facts(self) -> dict[str, Any]:
        """As before."""
        return self.before.facts()


def first_of(fitted: Fitted) -> FittedMixture:
    """The prediction that all further stages go on from."""
    while isinstance(fitted, Further):
        fitted = fitted.before
    assert isinstance(fitted, FittedMixture)
    return fitted


class FurtherStage(Stage):
    """A stage after all of this package, for data of any task that it serves.

    The first of its options leaves the prediction as it is; the others set ``State.fitted`` to a `Further`.
    """

    fitted: type[Further]  #: class of its predictions


FURTHER_STAGES: Registry[FurtherStage] = Registry("stage", "wrf_mi.stages", {})


class _Before(Stage):
    """All stages of this package."""

    name = "hybrid"

    def __init__(self, fit: Callable[[Problem, Split, Session], Fitted]) -> None:
        self._fit = fit

    def options(self, problem: Problem, split: Split) -> Sequence[Option]:
        """The one fit."""

        def fitted(state: State, split: Split, session: Session) -> State:
            session.folder.mkdir(parents=True, exist_ok=True)
            return State(state.problem, fitted=self._fit(state.problem, split, session))

        return [Option("fitted", fitted)]


def fit_further(
    entry: Model,
    fit: Callable[[Problem, Split, Session], Fitted],
    names: Sequence[str],
    problem: Problem,
    split: Split,
    session: Session,
) -> tuple[Fitted, list[dict[str, Any]], list[dict[str, Any]]]:
    """A ``fit`` of all stages of this package and further ones of some names, and reports of stages and options.

    The fit is made twice, once without the rows by which the further stages are chosen.
    """
    stages = [FURTHER_STAGES[name] for name in names]
    engine = Engine(entry, [_Before(fit), *stages], problem, split, session)
    fitted, reports = engine.fit().fitted, list[StageReport]()
    assert fitted is not None
    for stage in stages:
        of_stage = [report for report in engine.reports if report.stage == stage.name]
        taken_report = next((report for report in of_stage if report.taken), None)
        if taken_report is not None:
            seconds = sum(report.seconds or 0.0 for report in of_stage)
            reports.append(StageReport(stage.name, taken_report is not of_stage[0], taken_report.held_out, seconds))
    options = [report for report in engine.stated_reports() if report["stage"] in names]
    return fitted, stated_reports(reports), options


def load_further(arrays: Arrays, fitted: Fitted) -> Fitted:
    """The stages of other packages after a fitted model, from the arrays of a run."""
    for name in map(str, np.atleast_1d(arrays.get(FURTHER, np.zeros(0, str)))):
        fitted = from_arrays(FURTHER_STAGES[name].fitted, arrays, f"{FURTHER}/{name}/", before=fitted)
    return fitted
