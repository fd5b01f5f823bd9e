"""Selection of the options of a fit's stages by rows that are held out once, before any stage is fitted.

Stage by stage, each option is judged by the finished chain: later stages have their defaults, as a better mean alone
may make a worse prediction. The chosen options are then fitted to all rows.

options/  in the session's folder: predictions of held-out rows by each chain, which a stopped fit goes on with
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np

from ..core import InputError, Split
from ..core.array_files import stored_arrays, write_arrays
from ..core.types import FloatArray, IntArray
from ..models.held_out import arrays_of_held_out, fold_of, labelled, stored_held_out
from ..models.model import HeldOutPrediction, Model, Problem, Session
from ..tasks import task_of
from ..training.by_distance import unit_means
from ..training.selection import HeldOut, hold_out, last_gain
from .stage import Option, Stage, State

FOLDER, CHOSEN = "options", "chosen"  # folder of the predictions, and name of those of the chosen chain
LEAST_ROWS, FEW_ROWS, CONFIDENCE = 3, 16, 0.95
"""Fewest held-out rows that choose options, and number below which an option has to gain with this confidence, by
Student's t, where the stage trusts its default. Of 15 fits to 32 rows of a flat, an office and a campus, 10 or 11 of
them held out, the best mean score took shadowing with errors 1.8 % above those of the default, and this rule 0.1 %; by
6 or 7 rows 0.7 % above and 0.1 % below; from 13 rows on both are within 1 %.
"""
Plan = tuple[str, ...]  # names of the options of the stages up to one


@dataclass(frozen=True)
class OptionReport:
    """What became of an option."""

    stage: str
    option: str
    taken: bool
    why: str  # reason of that in words
    held_out: float | None = None  # mean score of held-out training rows by the finished chain; None: not judged
    seconds: float | None = None  # duration of its fit and prediction; None: not judged


class _Fold(NamedTuple):
    """Rows that are held out, and what fits to the others may see."""

    held_out: HeldOut
    problem: Problem
    split: Split
    numbers: IntArray  # numbers of the receivers with enough rows


class Engine:
    """Fit of stages to the rows of a split.

    Args:
        entry: model of these stages.
        stages: stages in their order; the last ones predict.
        problem: problem of the fit.
        split: split whose training rows are held out and fitted.
        session: session, whose folder keeps predictions of held-out rows.

    Attributes:
        unseen: predictions of the held-out rows by the chosen options, fitted to the others; None: none were held out.
        reports: what became of each option.
    """

    def __init__(self, entry: Model, stages: Sequence[Stage], problem: Problem, split: Split, session: Session) -> None:
        self._entry, self._problem, self._split, self._session = entry, problem, split, session
        listed = [(stage, stage.options(problem, split)) for stage in stages]
        self._stages = [stage for stage, options in listed if options]
        self._options = [list(options) for _, options in listed if options]
        self._folder, self._states = session.folder / FOLDER, dict[Plan, State]()
        self.reports, self.unseen = list[OptionReport](), cast(HeldOutPrediction | None, None)

    @cached_property
    def _fold(self) -> _Fold | None:
        record, fold = self._problem.record, hold_out(self._problem.record, self._split)
        if fold is None:
            return None
        held_out = HeldOut.of(record, fold, self._problem.seed)
        # Places of receivers that nobody surveyed are estimated once, for all options.
        return _Fold(held_out, *fold_of(self._entry, self._problem, fold, self._session)) if len(held_out) else None

    def fit(self) -> State:
        """The chosen options fitted to all rows."""
        plan, fold = self._chosen(), self._fold
        if fold is not None:
            self.unseen = self._predicted(fold, plan, finish=True)
        state = State(self._problem)
        for number, stage in enumerate(self._stages):
            option = self._option(number, plan[number])
            if fold is not None:
                option = stage.continued(option, self._state(fold, plan[: number + 1]))
            state = option.fit(state, self._split, self._session)
        self._session.discarded.append(self._folder)
        return self._finished(state, self._split)

    def stated_reports(self) -> list[dict[str, Any]]:
        """Reports as ``metrics.json`` has them."""
        return [asdict(report) for report in self.reports]

    def _finished(self, state: State, split: Split) -> State:
        for stage in self._stages:
            state = stage.finish(state, split, self._session)
        return state

    def _option(self, number: int, name: str) -> Option:
        return next(option for option in self._options[number] if option.name == name)

    def _chosen(self) -> Plan:
        """Names of the options that held-out rows choose, stage by stage."""
        fold, plan = self._fold, Plan()
        for number, (stage, options) in enumerate(zip(self._stages, self._options, strict=True)):
            first, later = options[0], Plan(options[0].name for options in self._options[number + 1 :])
            if len(options) == 1:
                plan, why = (*plan, first.name), "the only option"
                self.reports.append(OptionReport(stage.name, first.name, True, why))
                continue
            rows = 0 if fold is None else len(np.unique(fold.held_out.row))
            if fold is None or rows < LEAST_ROWS:
                why = f"default: {rows} rows can be held out, too few to choose by"
                self.reports.append(OptionReport(stage.name, first.name, True, why))
                plan = (*plan, first.name)
                continue
            scores = dict[str, FloatArray]()
            for done, option in enumerate(options):
                self._session.report(f"{stage.name}: {option.name}", done / len(options))
                try:
                    scores[option.name] = self._scores(fold, (*plan, option.name, *later))
                except InputError as error:  # the default has to serve the data, others may not
                    if option is first:
                        raise
                    self.reports.append(OptionReport(stage.name, option.name, False, str(error)))
            self._session.report(f"{stage.name}: chosen", 1.0)
            best = self._best(options, scores, stage.trusts_default and rows < FEW_ROWS)
            self._report(stage, scores, best, plan, later)
            plan = (*plan, best)
        return plan

    def _best(self, options: Sequence[Option], scores: dict[str, FloatArray], doubted: bool) -> str:
        """Name of the best option: the best mean of equal freedom, then the last clear gain of more freedom."""
        if doubted:
            return last_gain(scores.items(), higher_is_better=True, confidence=CONFIDENCE)
        best_of = []
        judged = (option for option in options if option.name in scores)
        for _, equal in groupby(judged, key=lambda option: option.freedom):
            # The first of equal ones: options may be the same for the data.
            name = max((option.name for option in equal), key=lambda name: scores[name].mean())
            best_of.append((name, scores[name]))
        return last_gain(best_of, higher_is_better=True)

    def _report(self, stage: Stage, scores: dict[str, FloatArray], best: str, plan: Plan, later: Plan) -> None:
        sign = 1 if task_of(self._problem.record).higher_is_better else -1
        for name, score in scores.items():
            why = "best" if name == best else "no clear gain" if score.mean() > scores[best].mean() else "worse"
            seconds = float(stored_arrays(self._path((*plan, name, *later)))["seconds"])
            mean = sign * float(score.mean())
            self.reports.append(OptionReport(stage.name, name, name == best, f"{why} on held-out rows", mean, seconds))

    def _unit(self, fold: _Fold) -> IntArray:
        """Unit of each held-out observation: errors are independent between rows, or between receivers."""
        return fold.held_out.receiver if self._split.held_receivers else fold.held_out.row

    def _scores(self, fold: _Fold, plan: Plan) -> FloatArray:
        """Mean scores of the independent units of held-out rows by a chain, the higher the better."""
        record, count = self._problem.record, len(fold.held_out)
        means = self._predicted(fold, plan).mean[None]
        of_each = task_of(record).mixtures(means, fold.held_out.observed(record))
        return unit_means(of_each(np.ones((count, 1)), np.arange(count)), self._unit(fold))

    def _path(self, plan: Plan, finish: bool = False) -> Path:
        return self._folder / f"{CHOSEN if finish else '+'.join(plan)}.npz"

    def _predicted(self, fold: _Fold, plan: Plan, finish: bool = False) -> HeldOutPrediction:
        """Predictions of held-out rows by a chain, of the ``finish``-ed one with deviations; kept in the folder."""
        path, record, begun = self._path(plan, finish), self._problem.record, time.perf_counter()
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            state = self._state(fold, plan)
            fitted = (self._finished(state, fold.split) if finish else state).fitted
            assert fitted is not None, "the last stage predicts"
            # Reception is fitted to the chosen chain alone.
            held_out = fold.held_out if finish else replace(fold.held_out, every=fold.held_out.every[:0])
            arrays = arrays_of_held_out(fitted, record, fold.numbers, held_out)
            write_arrays(path, arrays | {"seconds": np.asarray(time.perf_counter() - begun)})
        return stored_held_out(path, self._problem, fold.held_out)

    def _state(self, fold: _Fold, plan: Plan) -> State:
        """The state of some options, fitted to the rows of the fold; chains share their beginnings."""
        if not plan:
            return State(fold.problem)
        if plan not in self._states:
            number, before = len(plan) - 1, self._state(fold, plan[:-1])
            folder = self._folder.joinpath(*plan)
            session = labelled(replace(self._session, folder=folder), f"{self._stages[number].name}, {plan[-1]}")
            self._states[plan] = self._option(number, plan[-1]).fit(before, fold.split, session)
        return self._states[plan]
