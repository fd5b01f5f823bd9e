"""The stage *residual* of signal strengths: kriging about their mean, pooled over receivers."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial

from ..core import Split
from ..core.types import FloatArray
from ..models.interpolation.strength_fit import SEARCHED
from ..models.interpolation.strengths import (
    BY_SEARCH,
    DEFAULT,
    SHADOWINGS,
    Strengths,
    StrengthSettings,
    calibrated,
    fit_strengths,
)
from ..models.model import Problem, Session
from .engine import CONFIDENCE
from .stage import Option, Stage, State

FEW_ROWS = 8
"""Held-out rows below which other lengths than the default have to gain with `CONFIDENCE`: by the mean of four rows of
a flat, the worst of three origins of lengths was taken as often as the best."""


@dataclass(frozen=True)
class StrengthResidual(Stage):
    """Kriging of signal strengths, by default, searched or likely lengths of shadowing.

    Hyperparameters of the settings that are ``stated`` hold.
    """

    settings: StrengthSettings
    stated: Collection[str] = ()
    name = "residual"

    def confidence(self, rows: int) -> float | None:
        """The default is left for a clear gain by few rows alone: lengths of rooms are known from many."""
        return CONFIDENCE if rows < FEW_ROWS else None

    def options(self, problem: Problem, split: Split) -> Sequence[Option]:
        """Origins of the lengths, or the one that the settings state."""
        names = SHADOWINGS
        if self.settings.shadowing is not None:
            names = (self.settings.shadowing,)
        elif {*SEARCHED} <= {*self.stated}:
            names = (DEFAULT,)
        return [Option(name, partial(self._fit, replace(self.settings, shadowing=name))) for name in names]

    def _fit(self, settings: StrengthSettings, state: State, split: Split, session: Session) -> State:
        record, rows = state.problem.record, split.all_train
        fitted = fit_strengths(record, rows, state.mean, settings, session.report, self.stated, calibrate=False)
        return replace(state, fitted=fitted)

    def continued(self, option: Option, chosen: State, scores: Mapping[str, FloatArray]) -> Option:
        """Lengths that were searched hold for all rows, too, of which those of a search would be much the same."""
        if option.name != BY_SEARCH:
            return option
        assert isinstance(chosen.fitted, Strengths)
        found = replace(self.settings, shadowing=DEFAULT, **asdict(chosen.fitted.field.hyperparameters))

        def fit(state: State, split: Split, session: Session) -> State:
            state = self._fit(found, state, split, session)
            assert isinstance(state.fitted, Strengths)
            return replace(state, fitted=replace(state.fitted, shadowing=BY_SEARCH))

        return option._replace(fit=fit)

    def finish(self, state: State, split: Split, session: Session) -> State:
        """Deviations, shift and noise of each receiver, by stretches that are held out."""
        assert isinstance(state.fitted, Strengths)
        fitted = calibrated(state.fitted, state.problem.record, split.all_train, session.report, self.stated)
        return replace(state, fitted=fitted)
