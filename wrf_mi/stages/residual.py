"""The stage *residual* of signal strengths: kriging or trees of what their mean leaves, pooled over receivers."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial

from ..core import Split
from ..datasets.observations import rows_received
from ..models.interpolation.strength_settings import (
    DEFAULT,
    LIKELIHOOD,
    NONE,
    SHADOWINGS,
    TREES,
    Shadowing,
    StrengthSettings,
)
from ..models.interpolation.strength_terms import Hyperparameters
from ..models.interpolation.strength_trees import LEAST_STOPS
from ..models.interpolation.strengths import Strengths, calibrated, fit_strengths
from ..models.model import Problem, Session
from .stage import Option, Stage, State


@dataclass(frozen=True)
class StrengthResidual(Stage):
    """What is added to the mean of signal strengths: kriging, trees, or nothing (`StrengthSettings.shadowing`).

    Hyperparameters of the settings that are ``stated`` hold.
    """

    settings: StrengthSettings
    stated: Collection[str] = ()
    name = "residual"
    trusts_default = True  # lengths of rooms are known from many

    def options(self, problem: Problem, split: Split) -> Sequence[Option]:
        """Origins of the shadowing, or the one that the settings state."""
        names: Sequence[Shadowing] = SHADOWINGS
        if self.settings.shadowing is not None:
            names = (self.settings.shadowing,)
        elif not {each.name for each in fields(Hyperparameters)}.isdisjoint(self.stated):
            names = DEFAULT, LIKELIHOOD  # kriging alone has hyperparameters
        elif rows_received(problem.record, split.all_train).max(initial=0) < LEAST_STOPS:
            names = DEFAULT, LIKELIHOOD, NONE  # no trees are grown
        # Trees follow the fading of a run, too, and so need a clear gain.
        return [
            Option(name, partial(self._fit, replace(self.settings, shadowing=name)), freedom=int(name == TREES))
            for name in names
        ]

    def _fit(self, settings: StrengthSettings, state: State, split: Split, session: Session) -> State:
        record, rows = state.problem.record, split.all_train
        fitted = fit_strengths(record, rows, state.mean, settings, session.report, self.stated, calibrate=False)
        return replace(state, fitted=fitted)

    def finish(self, state: State, split: Split, session: Session) -> State:
        """Deviations, shift and noise of each receiver, by stretches that are held out."""
        assert isinstance(state.fitted, Strengths)
        fitted = calibrated(state.fitted, state.problem.record, split.all_train, session.report, self.stated)
        return replace(state, fitted=fitted)
