"""The stage *runs* of signal strengths: whether the runs of a measurement, such as walks or devices, have offsets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import Record, Split
from ..datasets.observations import predicts_new_runs, trained_runs
from ..estimators.model import Problem, Session
from ..training.selection import HeldOut
from .stage import Option, Stage, State

POOLED, OFFSETS = "pooled", "offsets"
MOST_RUNS = 2000  # runs with offsets, whose equations take the cube of their number


class Runs(Stage):
    """Offsets of the runs, common to all receivers, or none (`wrf_mi.estimators.interpolation.run_offsets`)."""

    name = "runs"

    def options(self, problem: Problem, split: Split) -> Sequence[Option]:
        """Both, which held-out runs choose from; none without several runs."""
        if not 2 <= len(trained_runs(problem.record, split.all_train)) <= MOST_RUNS:
            return []
        return [Option(POOLED, lambda state, split, session: state), Option(OFFSETS, self._offsets, freedom=1)]

    def judged(self, record: Record, split: Split, held_out: HeldOut, mean: NDArray[Any]) -> NDArray[Any]:
        """Observations; of runs that are held out without what predictions leave of each, which no option knows."""
        observed = held_out.observed(record)
        if record.runs is None or not predicts_new_runs(record, split):
            return observed
        _, run = np.unique(record.runs[held_out.row], return_inverse=True)
        offset = np.bincount(run, observed - mean) / np.bincount(run)
        return np.asarray(observed - offset[run])

    def _offsets(self, state: State, split: Split, session: Session) -> State:
        return replace(state, kept={**state.kept, self.name: True})
