"""Any model with prediction intervals from held-out training rows, as ``wrf-mi train --intervals`` fits it."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..core import InputError, Prediction, Record, Split
from ..core.angles import FloatArray
from ..core.types import IntArray
from ..tasks import task_of
from ..training.by_distance import GAPS, Intervals, expected_size, fit_intervals
from ..training.selection import HeldOut, RowDistance, hold_out
from .held_out import held_out_predictions
from .model import (
    Arrays,
    Decomposition,
    Fitted,
    Inputs,
    Model,
    Problem,
    Session,
    field_arrays,
    from_field_arrays,
    known_positions,
    under,
)

INTERVALS, ROWS = "intervals/", "intervals_rows"
"""Prefix of the arrays of intervals, and key of the training rows."""


class FittedWithIntervals(Fitted):
    """A fitted model whose standard deviations are those of held-out errors, by the distance to training rows [n]."""

    def __init__(self, fitted: Fitted, record: Record, rows: IntArray, intervals: Intervals) -> None:
        self.fitted, self._record, self._rows, self._intervals = fitted, record, rows, intervals
        self._distance = RowDistance.of_rows(record, rows)
        self.receivers, self.uses_heading, self.carriers_hz = fitted.receivers, fitted.uses_heading, fitted.carriers_hz

    def _stated(self, found: Prediction, tx_pos_m: FloatArray, receiver: int) -> Prediction:
        distance_m = self._distance(tx_pos_m, receiver)
        return self._intervals(found.mean, expected_size(task_of(self._record), found), distance_m)

    def predict(self, inputs: Inputs, receiver: int) -> Prediction:
        """Prediction of the model with calibrated standard deviations, [m, ...]."""
        return self._stated(self.fitted.predict(inputs, receiver), inputs.tx_pos_m, receiver)

    def predict_rows(self, rows: IntArray, receiver: int) -> Prediction | None:
        """Stored predictions of the model with calibrated standard deviations."""
        found = self.fitted.predict_rows(rows, receiver)
        return None if found is None else self._stated(found, self._record.tx_pos_m[rows], receiver)

    def decompose(self, inputs: Inputs, receiver: int, std: bool = True) -> Decomposition:
        """Decomposition of the model's prediction, with calibrated standard deviations."""
        found = self.fitted.decompose(inputs, receiver, std)
        return replace(found, whole=self._stated(found.whole, inputs.tx_pos_m, receiver))

    @property
    def depends_on_heading(self) -> bool:
        """As the model."""
        return self.fitted.depends_on_heading

    def arrays(self) -> Arrays:
        """Arrays of the model and of the intervals."""
        return self.fitted.arrays() | field_arrays(self._intervals, INTERVALS) | {ROWS: self._rows}

    def facts(self) -> dict[str, object]:
        """Facts of the model."""
        return self.fitted.facts()


def with_intervals(entry: Model) -> Model:
    """The entry of a model with calibrated intervals; its fit takes twice as long."""

    def fit(problem: Problem, split: Split, session: Session) -> Fitted:
        record = problem.record
        fitted = entry.fit(problem, split, session)
        fold = _fold(entry, problem, split)
        held = HeldOut.of(record, fold, problem.seed)
        place = replace(session, folder=session.folder / "held_out")
        found = held_out_predictions(entry, problem, fold, held, place, entry.name)
        shutil.rmtree(place.folder)
        size = expected_size(task_of(record), found)
        intervals = fit_intervals(found.mean, held.observed(record), size, held.distance_m, held.row)
        return FittedWithIntervals(fitted, record, problem.rows(split), intervals)

    def load(arrays: Arrays, problem: Problem, folder: Path) -> Fitted:
        intervals = from_field_arrays(Intervals, under(INTERVALS, arrays))
        kept = {key: values for key, values in arrays.items() if not key.startswith("intervals")}
        return FittedWithIntervals(entry.load(kept, problem, folder), problem.record, arrays[ROWS], intervals)

    def check(problem: Problem, splits: Sequence[Split]) -> None:
        for split in splits:
            _fold(entry, problem, split)
        if entry.check is not None:
            entry.check(problem, splits)

    return replace(entry, fit=fit, load=load, check=check, gaps=(*entry.gaps, *GAPS))


def _fold(entry: Model, problem: Problem, split: Split) -> Split:
    record, rows = problem.record, problem.rows(split)
    known_positions(record, rows, f"{entry.name} with intervals")
    fold = hold_out(record, split) if len(rows) else None
    if split.held_receivers and fold is None:
        raise InputError(f"{record.name}: one receiver trains; intervals at others need two at least")
    if fold is None or not np.isfinite(record.observation[:, rows]).any():
        raise InputError(f"{record.name}: {len(rows)} training rows; intervals need three at least, at two positions")
    return fold
