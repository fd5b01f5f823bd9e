"""The stage *residual* of signal strengths: kriging or trees of what their mean leaves, pooled over receivers."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import partial

from ..core import Split
from ..core.types import FloatArray
from ..datasets.observations import predicts_new_runs, rows_received
from ..estimators.interpolation.strength_settings import (
    BY_SEARCH,
    DEFAULT,
    LIKELIHOOD,
    NONE,
    SHADOWINGS,
    TREES,
    Shadowing,
    StrengthSettings,
)
from ..estimators.interpolation.strength_terms import Hyperparameters
from ..estimators.interpolation.strength_trees import LEAST_STOPS
from ..estimators.interpolation.strengths import Strengths, calibrated, fit_strengths
from ..estimators.model import Problem, Session
from .engine import CONFIDENCE
from .runs import Runs
from .stage import Option, Stage, State

FEW_ROWS = 16
"""Held-out rows below which other shadowing than the default has to gain with `CONFIDENCE`. Of 15 fits to 32 rows of a
flat, an office and a campus, 10 or 11 of them held out, the best mean score took shadowing with errors 1.8 % above
those of the default, and this rule 0.1 %; by 6 or 7 rows 0.7 % above and 0.1 % below; from 13 rows on both are within
1 %."""


@dataclass(frozen=True)
class StrengthResidual(Stage):
    """What is added to the mean of signal strengths: kriging, trees, or nothing (`StrengthSettings.shadowing`).

    Hyperparameters of the settings that are ``stated`` hold.
    """

    settings: StrengthSettings
    stated: Collection[str] = ()
    name = "residual"

    def confidence(self, rows: int) -> float | None:
        """The default is left for a clear gain by few rows alone: lengths of rooms are known from many."""
        return CONFIDENCE if rows < FEW_ROWS else None

    def options(self, problem: Problem, split: Split) -> Sequence[Option]:
        """Origins of the shadowing, or the one that the settings state."""
        names: Sequence[Shadowing] = SHADOWINGS
        if self.settings.shadowing is not None:
            names = (self.settings.shadowing,)
        elif not {each.name for each in fields(Hyperparameters)}.isdisjoint(self.stated):
            names = DEFAULT, BY_SEARCH, LIKELIHOOD  # kriging alone has hyperparameters
        elif rows_received(problem.record, split.all_train).max(initial=0) < LEAST_STOPS:
            names = DEFAULT, BY_SEARCH, LIKELIHOOD, NONE  # no trees are grown
        # Trees follow the fading of a run, too, and so need a clear gain.
        return [
            Option(name, partial(self._fit, replace(self.settings, shadowing=name)), freedom=int(name == TREES))
            for name in names
        ]

    def _fit(self, settings: StrengthSettings, state: State, split: Split, session: Session) -> State:
        record, rows = state.problem.record, split.all_train
        runs = bool(state.kept.get(Runs.name))
        fitted = fit_strengths(record, rows, state.mean, settings, session.progress, self.stated, False, runs)
        return replace(state, fitted=fitted)

    def continued(self, option: Option, chosen: State, scores: Mapping[str, FloatArray]) -> Option:
        """Lengths that were searched hold for all rows, too, of which those of a search would be much the same."""
        if option.name != BY_SEARCH:
            return option
        assert isinstance(chosen.fitted, Strengths)
        settings = replace(self.settings, shadowing=DEFAULT, **asdict(chosen.fitted.field.hyperparameters))

        def fit(state: State, split: Split, session: Session) -> State:
            state = self._fit(settings, state, split, session)
            assert isinstance(state.fitted, Strengths)
            return replace(state, fitted=replace(state.fitted, shadowing=BY_SEARCH))

        return option._replace(fit=fit)

    def finish(self, state: State, split: Split, session: Session) -> State:
        """Deviations by stretches or runs that are held out."""
        assert isinstance(state.fitted, Strengths)
        record = state.problem.record
        new_runs = predicts_new_runs(record, split)
        fitted = calibrated(state.fitted, record, split.all_train, session.progress, self.stated, new_runs)
        return replace(state, fitted=fitted)
