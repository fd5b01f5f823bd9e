"""Kriging of what the scene's side leaves."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core import Record, Split
from ...core.angles import FloatArray
from ...datasets.observations import LEAST_ROWS
from ..held_out import predicted_rows
from ..interpolation.kriging import Kriged, Kriging
from ..model import Arrays, Fitted, keyed, under

LEAST_RESIDUALS = 3  # fewest rows of a receiver whose residuals are interpolated


class Residuals:
    """Kriging of what the scene's side leaves at the training rows, by receiver.

    Args:
        by_receiver: interpolation of each receiver that has enough rows, by its number.
    """

    def __init__(self, by_receiver: Mapping[int, Kriged]) -> None:
        self.by_receiver = dict(by_receiver)

    @classmethod
    def of(cls, fitted: Fitted, record: Record, split: Split, seed: int) -> Residuals:
        """Residuals of a fitted model at the training rows of a split."""
        known: dict[int, Kriged] = {}
        rows = split.all_train
        for receiver in range(len(record.receivers)):
            observed = record.observation[receiver, rows]
            seen = rows[np.isfinite(observed).reshape(len(rows), -1).all(axis=1)]
            if receiver in split.held_receivers:
                seen = np.intersect1d(seen, split.left[split.left[:, 0] == receiver, 1])
            if len(seen) >= max(LEAST_RESIDUALS, LEAST_ROWS):
                left = record.observation[receiver, seen] - predicted_rows(fitted, record, seen, receiver).mean
                known[receiver] = Kriging(seed=seed).fit(record.tx_pos_m[seen], left)
        return cls(known)

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
