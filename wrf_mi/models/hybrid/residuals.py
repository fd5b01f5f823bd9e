"""Kriging of what the scene's side leaves."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core import Record, Split
from ...core.angles import FloatArray
from ...core.types import IntArray
from ...training.selection import rows_at_receiver
from ..held_out import predicted_rows
from ..interpolation.kriging import Kriged, Kriging
from ..model import Arrays, Fitted, keyed, under

LEAST_RESIDUALS = 3
"""Fewest rows of a receiver whose residuals are interpolated."""


LeftOver = Mapping[int, tuple[IntArray, NDArray[Any]]]
"""Rows [n] by receiver, and what a model's mean leaves of their observations, [n, ...]."""


def left_over(fitted: Fitted, record: Record, split: Split) -> LeftOver:
    """What a fitted model leaves of the observations of its training rows."""
    left: dict[int, tuple[IntArray, NDArray[Any]]] = {}
    for receiver in range(len(record.receivers)):
        rows = _training_rows(record, split, receiver)
        if len(rows):
            observed = record.observation[receiver, rows]
            left[receiver] = rows, observed - predicted_rows(fitted, record, rows, receiver).mean
    return left


def _training_rows(record: Record, split: Split, receiver: int) -> IntArray:
    """Training rows of a split whose observations a receiver has."""
    rows = rows_at_receiver(record, split.all_train, receiver)
    if receiver in split.held_receivers:
        rows = np.intersect1d(rows, split.left[split.left[:, 0] == receiver, 1])
    return rows


class Residuals:
    """Kriging of what the scene's side leaves at the training rows, by receiver.

    Args:
        by_receiver: interpolation of each receiver that has enough rows, by its number.
    """

    def __init__(self, by_receiver: Mapping[int, Kriged]) -> None:
        self.by_receiver = dict(by_receiver)

    @classmethod
    def of(cls, left: LeftOver, record: Record, split: Split, seed: int) -> Residuals:
        """Residuals that a model left, at the training rows of a split that is the model's or holds out more."""
        by_receiver: dict[int, Kriged] = {}
        for receiver, (rows, residual) in left.items():
            known = np.isin(rows, _training_rows(record, split, receiver))
            if known.sum() >= LEAST_RESIDUALS:
                residual = residual if known.all() else residual[known]
                by_receiver[receiver] = Kriging(seed=seed).fit(record.tx_pos_m[rows[known]], residual)
        return cls(by_receiver)

    def __call__(self, tx_pos_m: FloatArray, receiver: int, shape: tuple[int, ...]) -> NDArray[Any] | float:
        """Expected residuals of a receiver at positions [m, 3], [m, *shape]; 0 without any rows."""
        kriged = self.by_receiver.get(receiver)
        return 0.0 if kriged is None else kriged.predict(tx_pos_m).reshape(len(tx_pos_m), *shape)

    def arrays(self) -> Arrays:
        """Arrays of a run file."""
        found: Arrays = {}
        for receiver, kriged in self.by_receiver.items():
            found |= keyed(f"{receiver}/", kriged.arrays())
        return found

    @classmethod
    def from_arrays(cls, arrays: Arrays, record: Record) -> Residuals:
        """The residuals that `arrays` described."""
        numbers = sorted({int(name.partition("/")[0]) for name in arrays})
        found = {
            number: Kriged.from_arrays(under(f"{number}/", arrays), record.receivers[number]) for number in numbers
        }
        return cls(found)
