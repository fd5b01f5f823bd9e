"""The stages *mean* and *residual* of signal strengths: what is expected, and kriging or trees of what that leaves."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial

from ..core import Split
from ..datasets.observations import LEAST_ROWS, rows_received
from ..models.interpolation.strength_terms import Hyperparameters
from ..models.interpolation.strengths import (
    DEFAULT,
    LIKELIHOOD,
    SHADOWINGS,
    Strengths,
    StrengthSettings,
    calibrated,
    fit_strengths,
)
from ..models.model import Problem, Session
from .stage import Option, Stage, State

LAW, LEVEL = "law of distance", "level"
"""Means without a scene; the latter is that of each receiver, and stands in `State.mean`."""


@dataclass(frozen=True)
class StrengthMean(Stage):
    """The mean of signal strengths without a scene: a law of distance, or a level of each receiver."""

    settings: StrengthSettings
    name = "mean"
    trusts_default = True

    def options(self, problem: Problem, split: Split) -> Sequence[Option]:
        """The law, which serves receivers without rows, too, and levels where each has some; or the stated one."""
        wanted = self.settings.distance
        options = [] if wanted is False else [Option(LAW, lambda state, split, session: state)]
        without = bool(split.held_receivers) or rows_received(problem.record, split.all_train).min() < LEAST_ROWS
        if wanted is False or (wanted is None and not without):
            options.append(Option(LEVEL, lambda state, split, session: replace(state, mean=LEVEL)))
        return options


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
        names = SHADOWINGS
        if self.settings.shadowing is not None:
            names = (self.settings.shadowing,)
        elif not {each.name for each in fields(Hyperparameters)}.isdisjoint(self.stated):
            names = DEFAULT, LIKELIHOOD  # kriging alone has hyperparameters
        return [Option(name, partial(self._fit, replace(self.settings, shadowing=name))) for name in names]

    def _fit(self, settings: StrengthSettings, state: State, split: Split, session: Session) -> State:
        record, rows, mean = state.problem.record, split.all_train, state.mean
        if mean is LEVEL:
            settings, mean = replace(settings, distance=False), None
        fitted = fit_strengths(record, rows, mean, settings, session.report, self.stated, calibrate=False)
        return replace(state, fitted=fitted)

    def finish(self, state: State, split: Split, session: Session) -> State:
        """Deviations, shift and noise of each receiver, by stretches that are held out."""
        assert isinstance(state.fitted, Strengths)
        fitted = calibrated(state.fitted, state.problem.record, split.all_train, session.report, self.stated)
        return replace(state, fitted=fitted)
