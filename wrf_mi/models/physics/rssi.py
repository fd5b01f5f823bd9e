"""Signal strengths in a scene: kriging of what the local mean of traced power leaves."""

from __future__ import annotations

from dataclasses import dataclass

from ...core import Split
from ...core.settings import Positive
from ...tracing.power_map import trace_map
from ..interpolation.strengths import Strengths, StrengthSettings, fit_strengths
from ..model import Fitted, Problem, Session
from .selection import physics_entry


@dataclass(frozen=True)
class RssiSettings(StrengthSettings):
    """Settings of the physics model for signal strengths.

    Attributes:
        spacing_m: spacing of the traced grid.
        smooth_m: standard deviation of the Gaussian over which the traced power is averaged.
        max_depth: interactions of a traced path, transmissions included.
        max_reflections: reflections of a traced path.
    """

    spacing_m: Positive = 0.25
    smooth_m: float = 0.3
    max_depth: int = 6
    max_reflections: int = 2


def _fit(problem: Problem, split: Split, session: Session) -> Fitted:
    settings: RssiSettings = problem.settings
    session.report("tracing a map", 0.0)
    shape = settings.spacing_m, settings.smooth_m, settings.max_depth, settings.max_reflections
    power_map = trace_map(problem.opened_scene, problem.record, *shape)
    return fit_strengths(problem.record, problem.rows(split), power_map, settings, session.report)


# Readings that a receiver did not report at a stop.
MODEL = physics_entry("rssi", RssiSettings, _fit, Strengths.from_arrays, gaps=("stop.value_dbm",))
