"""The model ``kriging``: the covariance that suits the task and the data, else that of the observations themselves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from ..core import InputError, Split
from ..estimators.interpolation.diffuse import ChannelKriging
from ..estimators.interpolation.kriging import GENERIC_ONLY, GenericKriging, KrigingSettings, asks_generic
from ..estimators.interpolation.spectra import SpectrumKriging, SpectrumKrigingSettings
from ..estimators.interpolation.strength_settings import POOLED_ONLY, StrengthSettings, unused_of_pooled
from ..estimators.interpolation.strengths import EXACT, Strengths
from ..estimators.model import Arrays, Fitted, Model, Problem, Session, known_positions
from .engine import Engine
from .residual import StrengthResidual
from .runs import Runs

POOLED = "field"  # array of pooled strengths, which generic kriging has not
STOPS = "value_dbm"  # array of readings, NaN where a receiver observed nothing at a stop


class StrengthKriging(GenericKriging):
    """Kriging of signal strengths, pooled over receivers where a single, known carrier states free space."""

    settings, new_receivers, gaps = StrengthSettings, True, (STOPS, EXACT)

    def pools_receivers(self, problem: Problem) -> bool:
        """Whether strengths have a single, known carrier and settings ask for no other covariance."""
        return not asks_generic(problem) and problem.record.frequencies_hz is not None

    def uses_places(self, problem: Problem, splits: Sequence[Split]) -> bool:
        """Pooled kriging is about the law of distance."""
        return self.pools_receivers(problem) or super().uses_places(problem, splits)

    def fit(self, problem: Problem, split: Split, session: Session) -> Fitted:
        """Kriging of all receivers together where they are pooled, else of each by itself."""
        if not self.pools_receivers(problem):
            return super().fit(problem, split, session)
        known_positions(problem.record, problem.rows(split), self.name)
        stages = Runs(), StrengthResidual(problem.settings, problem.stated_settings)
        engine = Engine(self, stages, problem, split, session)
        fitted = engine.fit().fitted
        assert isinstance(fitted, Strengths)
        fitted.options, fitted.unseen = engine.stated_reports(), engine.unseen
        return fitted

    def selects(self, problem: Problem, splits: Sequence[Split]) -> bool:
        """Where receivers are pooled, by held-out rows."""
        return self.pools_receivers(problem)

    def unused_settings(self, problem: Problem, splits: Sequence[Split]) -> Mapping[str, str]:
        """Settings of pooled receivers where each is kriged alone; and of headings that do not count."""
        unused = super().unused_settings(problem, splits)
        if self.pools_receivers(problem):
            return {**unused, **unused_of_pooled(problem)}
        why = "no single carrier is known"
        if generic_settings := sorted(GENERIC_ONLY & problem.stated_settings) or ["generic"] * problem.settings.generic:
            why = f"each receiver is kriged alone with {generic_settings[0]}"
        return {**unused, **dict.fromkeys(POOLED_ONLY, why)}

    def load(self, arrays: Arrays, problem: Problem, folder: Path) -> Fitted:
        """The model of either kind."""
        return Strengths.from_arrays(arrays) if POOLED in arrays else super().load(arrays, problem, folder)

    def check(self, problem: Problem, splits: Sequence[Split]) -> None:
        """Refuse receivers without training rows where receivers are not pooled."""
        for split in splits:
            if split.held_receivers and not len(split.left) and not self.pools_receivers(problem):
                text = "kriging of each receiver alone, without a single known carrier, predicts for trained receivers"
                raise InputError(f"split {split.name}: {text}; choose mri, or leave them rows, as receiver+20 does")


GENERIC = GenericKriging()
BY_TASK: Mapping[str, Model] = {"rssi": StrengthKriging(), "spectrum": SpectrumKriging(), "csi": ChannelKriging()}


class KrigingModel(StrengthKriging):
    """Kriging of any task; of strengths it serves receivers without rows, which it states before the data are known."""

    def serving(self, task: str, with_scene: bool) -> Model:
        """Kriging with the covariance that suits a task."""
        return BY_TASK.get(task, GENERIC)

    def settings_by_data(self) -> Mapping[str, type]:
        """Settings of each covariance."""
        return {
            "signal strengths": StrengthSettings,
            "spectra": SpectrumKrigingSettings,
            "channel coefficients and other tasks": KrigingSettings,
        }


MODEL = KrigingModel()
