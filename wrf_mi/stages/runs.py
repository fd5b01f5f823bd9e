"""The stage *runs* of signal strengths: whether the runs of a measurement, such as walks or devices, have offsets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from ..core import Split
from ..datasets.observations import LEAST_RUNS, trained_runs
from ..estimators.model import Problem, Session
from .stage import Option, Stage, State

POOLED, OFFSETS = "pooled", "offsets"
MOST_RUNS = 2000  # runs with offsets, whose equations take the cube of their number


class Runs(Stage):
    """Offsets of the runs, common to all receivers, or none (`wrf_mi.estimators.interpolation.run_offsets`)."""

    name = "runs"

    def options(self, problem: Problem, split: Split) -> Sequence[Option]:
        """Both, which held-out runs choose from; none without several runs."""
        if not LEAST_RUNS <= len(trained_runs(problem.record, split.all_train)) <= MOST_RUNS:
            return []
        return [Option(POOLED, self._pooled), Option(OFFSETS, self._offsets)]

    def _pooled(self, state: State, split: Split, session: Session) -> State:
        return state

    def _offsets(self, state: State, split: Split, session: Session) -> State:
        return replace(state, kept={**state.kept, self.name: True})
