"""Position by the k nearest neighbours among the training rows' signal strengths (fingerprinting), as a reference.

Source: Bahl and Padmanabhan, "RADAR: an in-building RF-based user location and tracking system" (2000), INFOCOM.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from sklearn.neighbors import KNeighborsRegressor

from ..core import Record, Split
from ..core.angles import FloatArray
from ..core.types import IntArray

COUNTS = (1, 2, 3, 4, 5, 6, 8, 10, 13, 16, 20, 25, 32, 40)  # numbers of neighbours to choose from
METRICS = ("euclidean", "nan_euclidean")
"""Distances: a receiver without a value has its weakest training value, or is left out and the others are scaled up."""


@dataclass(frozen=True)
class Neighbours:
    """Settings of k nearest neighbours.

    Attributes:
        count: number k of neighbours.
        metric: one of `METRICS`.
    """

    count: int
    metric: str = METRICS[0]

    def locate(self, record: Record, rows: IntArray, observed_dbm: FloatArray) -> FloatArray:
        """Mean positions [m, 3] of the nearest of some training rows.

        Args:
            record: data with known positions.
            rows: training rows [n].
            observed_dbm: signal strengths [n_rx, m] of the transmitters, NaN where nothing was received.
        """
        known = np.asarray(record.observation[:, rows].T, float)
        rows = rows[np.isfinite(known).any(axis=1)]
        known = known[np.isfinite(known).any(axis=1)]
        asked = np.asarray(observed_dbm.T, float)
        if self.metric == METRICS[0]:
            heard = np.isfinite(known)
            weakest = np.where(heard.any(axis=0), np.where(heard, known, np.inf).min(axis=0), 0.0)
            known, asked = (np.where(np.isfinite(values), values, weakest) for values in (known, asked))
        model = KNeighborsRegressor(min(self.count, len(rows)), metric=self.metric)
        return np.asarray(model.fit(known, record.tx_pos_m[rows]).predict(asked))


def choose_neighbours(record: Record, folds: Sequence[Split]) -> tuple[Neighbours, float]:
    """The number of neighbours and the distance with the least mean held-out error, and that error in metres."""
    best, least = Neighbours(1), np.inf
    for metric in METRICS:
        for count in COUNTS:
            chosen, errors = Neighbours(count, metric), []
            for fold in folds:
                test = fold.test[np.isfinite(record.observation[:, fold.test]).any(axis=0)]
                if len(test):
                    found = chosen.locate(record, fold.all_train, np.asarray(record.observation[:, test], float))
                    errors.append(np.linalg.norm((found - record.tx_pos_m[test])[:, :2], axis=1))
            error = float(np.concatenate(errors).mean()) if errors else np.inf
            if error < least:
                best, least = chosen, error
    return best, least
