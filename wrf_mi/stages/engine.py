"""Selection of the options of a fit's stages by rows that are held out once, before any stage is fitted.

Stage by stage, each option is judged by the finished chain: later stages have their defaults, as a better mean alone
may make a worse prediction. The chosen options are then fitted to all rows.

options/  in the session's folder: predictions of held-out rows by each chain, which a stopped fit goes on with
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np

from ..core import InputError, Split
from ..core.array_files import stored_arrays, write_arrays
from ..core.stored import to_arrays
from ..core.types import FloatArray, IntArray
from ..estimators.held_out import fold_of, hold_out_once, predicted_held_out, stored_held_out
from ..estimators.model import HeldOutPrediction, Model, Problem, Session
from ..training.by_distance import unit_means
from ..training.gains import improves, last_gain
from ..training.selection import HeldOut
from .stage import Option, Stage, State

FOLDER, CHOSEN = "options", "chosen"  # folder of the predictions, and name of those of the chosen chain
LEAST_ROWS = 3  # fewest held-out rows that choose options
CONFIDENCE = 0.95  # one-sided confidence in a gain, by Student's t, where a stage asks for it
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


class Fold(NamedTuple):
    """Rows that are held out, and what fits to the others may see."""

    held_out: HeldOut
    problem: Problem
    split: Split
    numbers: IntArray  # numbers of the receivers with enough rows


class Engine:
    """Fit of stages to the rows of a split.

    Args:
        entry: model of these stages; None: one that uses no position of a receiver that nobody surveyed.
        stages: stages in their order; the last ones predict.
        problem: problem of the fit.
        split: split whose training rows are held out and fitted.
        session: session, whose folder keeps predictions of held-out rows.

    Attributes:
        unseen: predictions of the held-out rows by the chosen options, fitted to the others; None: none were held out.
        reports: what became of each option.
    """

    def __init__(
        self, entry: Model | None, stages: Sequence[Stage], problem: Problem, split: Split, session: Session
    ) -> None:
        self._entry, self._problem, self._split, self._session = entry, problem, split, session
        listed = [(stage, stage.options(problem, split)) for stage in stages]
        self._stages = [stage for stage, options in listed if options]
        self._options = [list(options) for _, options in listed if options]
        self._folder, self._states = session.folder / FOLDER, dict[Plan, State]()
        self._judged = {stage.name: dict[str, FloatArray]() for stage in self._stages}  # scores of what was tried
        self.reports, self.unseen = list[OptionReport](), cast(HeldOutPrediction | None, None)

    @cached_property
    def _fold(self) -> Fold | None:
        rows = hold_out_once(self._problem, self._split)
        if rows is None:
            return None
        # Places of receivers that nobody surveyed are estimated once, for all options.
        return Fold(rows.held_out, *fold_of(self._entry, self._problem, rows.fold, self._session))

    def choose(self) -> State | None:
        """The chosen options fitted to all rows but those held out, which chose them; None: none can be held out."""
        self._plan, fold = self._chosen(), self._fold
        return None if fold is None else self._state(fold, self._plan)

    def fit(self) -> State:
        """The chosen options fitted to all rows."""
        self.choose()
        plan, fold = self._plan, self._fold
        if fold is not None:
            self.unseen = self._predicted(fold, plan, finish=True)
        state = State(self._problem)
        for number, stage in enumerate(self._stages):
            option = self._option(number, plan[number])
            if fold is not None:
                option = stage.continued(option, self._state(fold, plan[: number + 1]), self._judged[stage.name])
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
            rows = (
                0 if fold is None else len(np.unique(fold.held_out.row[stage.judging(self._split, fold.held_out.row)]))
            )
            if fold is None or rows < LEAST_ROWS:
                why = f"default: {rows} rows can be held out, too few to choose by"
                self.reports.append(OptionReport(stage.name, first.name, True, why))
                plan = (*plan, first.name)
                continue
            scores, left = self._judged[stage.name], dict[str, str]()
            for done, option in enumerate(options):
                if option.after and (why := self._why_omitted(self._option(number, option.after), scores)):
                    left[option.name] = f"{option.after}, which it goes on from, {why}"
                    continue
                self._session.progress(f"{stage.name}: {option.name}", done / len(options))
                try:
                    scores[option.name] = self._scores(fold, (*plan, option.name, *later), stage)
                except InputError as error:  # the default has to serve the data, others may not
                    if option is first:
                        raise
                    left[option.name] = str(error)
            self._session.progress(f"{stage.name}: chosen", 1.0)
            best = self._best(options, scores, stage.confidence(rows))
            for option in options:
                if option.name in left:
                    self.reports.append(OptionReport(stage.name, option.name, False, left[option.name]))
                else:
                    path = self._path((*plan, option.name, *later))
                    self.reports.append(self._report(stage, option.name, scores, best, path))
            plan = (*plan, best)
        return plan

    def _why_omitted(self, before: Option, scores: Mapping[str, FloatArray]) -> str:
        """Why an option that goes on from the one ``before`` is not tried; "": it is."""
        score_before = scores.get(before.name)
        if score_before is None or any(improves(other, score_before, True) for other in scores.values()):
            return "is clearly behind"
        # Each has more freedom than the one before, and several times its cost. In six fits to two rooms the third
        # gained twice, where the second had gained; where that had not, it took two thirds of the time.
        first = scores.get(before.after)
        return f"is no better than {before.after}" if first is not None and score_before.mean() <= first.mean() else ""

    def _best(self, options: Sequence[Option], scores: dict[str, FloatArray], confidence: float | None) -> str:
        """Name of the best option: the best mean of equal freedom, then the last clear gain of more freedom."""
        judged, best_of = [option for option in options if option.name in scores], []
        # The default competes with no option where these have to gain with a confidence.
        alone = None if confidence is None else judged[0].name
        for _, equal in groupby(judged, key=lambda option: (option.name == alone, option.freedom)):
            # The first of equal ones, as options may be the same for the data, but for what goes on from another one.
            best = max(equal, key=lambda option: (scores[option.name].mean(), bool(option.after)))
            best_of.append((best.name, scores[best.name]))
        return last_gain(best_of, higher_is_better=True, confidence=confidence)

    def _report(self, stage: Stage, name: str, scores: dict[str, FloatArray], best: str, path: Path) -> OptionReport:
        sign, mean = 1 if self._problem.record.task.higher_is_better else -1, float(scores[name].mean())
        why = "best" if name == best else "no clear gain" if mean > scores[best].mean() else "worse"
        seconds = float(stored_arrays(path)["seconds"])
        return OptionReport(stage.name, name, name == best, f"{why} on held-out rows", sign * mean, seconds)

    def _scores(self, fold: Fold, plan: Plan, stage: Stage) -> FloatArray:
        """Mean scores of the independent units of rows that judge a stage by a chain, the higher the better."""
        record, judging = self._problem.record, np.flatnonzero(stage.judging(self._split, fold.held_out.row))
        mean = self._predicted(fold, plan).mean
        observed = stage.judged(record, self._split, fold.held_out, mean)[judging]
        of_each = record.task.mixtures(mean[None, judging], observed)
        # Errors are independent between rows, or between receivers.
        unit = fold.held_out.receiver if self._split.held_receivers else fold.held_out.row
        return unit_means(of_each(np.ones((len(judging), 1)), np.arange(len(judging))), unit[judging])

    def _path(self, plan: Plan, finish: bool = False) -> Path:
        return self._folder / f"{CHOSEN if finish else '+'.join(plan)}.npz"

    def _predicted(self, fold: Fold, plan: Plan, finish: bool = False) -> HeldOutPrediction:
        """Predictions of held-out rows by a chain, of the ``finish``-ed one with deviations; kept in the folder."""
        path, record, begun = self._path(plan, finish), self._problem.record, time.perf_counter()
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            state = self._state(fold, plan)
            fitted = (self._finished(state, fold.split) if finish else state).fitted
            assert fitted is not None, "the last stage predicts"
            # Reception is fitted to the chosen chain alone.
            held_out = fold.held_out if finish else replace(fold.held_out, every=fold.held_out.every[:0])
            arrays = to_arrays(predicted_held_out(fitted, record, fold.numbers, held_out))
            write_arrays(path, arrays | {"seconds": np.asarray(time.perf_counter() - begun)})
        return stored_held_out(path, self._problem, fold.held_out)

    def _state(self, fold: Fold, plan: Plan) -> State:
        """The state of some options, fitted to the rows of the fold; chains share their beginnings."""
        if not plan:
            return State(fold.problem, fold=fold.split)
        if plan not in self._states:
            option = self._option(len(plan) - 1, plan[-1])
            before = self._state(fold, (*plan[:-1], option.after) if option.after else plan[:-1])
            folder = self._folder.joinpath(*plan)
            on_progress = self._session.on_progress

            def progress(stage: str, share: float, _: object = None, /) -> None:
                on_progress(f"{stage} ({option.name})", share)

            session = replace(self._session, folder=folder, on_progress=progress)
            self._states[plan] = option.fit(before, fold.split, session)
        return self._states[plan]

    def of_fold(self, name: str, predict: Callable[[State, Fold, FloatArray], FloatArray]) -> FloatArray | None:
        """``predict(state, fold, mean)`` by the chosen chain, kept in the folder; None where no rows are held out.

        ``state`` is that of the rows of the fold, ``mean`` [q, ...] what it predicts of those held out.
        """
        if self._fold is None or self.unseen is None:
            return None
        path = self._folder / f"{name}.npz"
        if not path.exists():
            values = predict(self._state(self._fold, self._plan), self._fold, self.unseen.mean)
            write_arrays(path, {"mean": values})
        return stored_arrays(path)["mean"]
