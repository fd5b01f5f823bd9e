"""K nearest neighbours among the strengths of training rows (fingerprinting): baseline, and part of the posterior.

The estimate is the mean position of the k nearest rows. Its errors are those of rows that resemble the observation
elsewhere, those of the field's likelihood come from predictions that are too smooth: the posterior may weigh both, as
the likelihood times a circular normal density around the neighbours' estimate, whose deviation held-out rows choose.

Source: Bahl and Padmanabhan, "RADAR: an in-building RF-based user location and tracking system" (2000), INFOCOM
(neighbours); Genest and Zidek, "Combining probability distributions" (1986), Statistical Science 1 (logarithmic pool).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from sklearn.neighbors import NearestNeighbors

from ...core import Record, Split
from ...core.angles import FloatArray
from ...core.types import IntArray

COUNTS = (1, 2, 3, 4, 5, 6, 8, 10, 13, 16, 20, 25, 32, 40)  # numbers of neighbours to choose from
METRICS = ("euclidean", "nan_euclidean")
"""Distances: a receiver without a value has its weakest training value, or is left out and the others are scaled up."""
SPREADS = (3.0, 2.0, 1.4, 1.0)
"""Standard deviations of the density around the neighbours' estimate to choose from, in the order of their influence,
as multiples of the estimate's held-out deviation along an axis."""


@dataclass(frozen=True)
class Neighbours:
    """Number k of nearest neighbours, and their distance, one of `METRICS`."""

    count: int
    metric: str = METRICS[0]

    def locate(self, record: Record, rows: IntArray, observed_dbm: FloatArray) -> FloatArray:
        """Mean positions [m, 3] of the nearest of training rows [n], from strengths [n_rx, m], NaN: not received."""
        return np.asarray(nearest_places(record, rows, observed_dbm, self.metric, self.count).mean(axis=1))


def nearest_places(record: Record, rows: IntArray, observed_dbm: FloatArray, metric: str, count: int) -> FloatArray:
    """Positions [m, count, 3] of the nearest of training rows [n], the nearest first; fewer where rows are."""
    measured_dbm = np.asarray(record.observation[:, rows].T, float)
    heard = np.isfinite(measured_dbm)
    rows, measured_dbm, heard = (values[heard.any(axis=1)] for values in (rows, measured_dbm, heard))
    asked = np.asarray(observed_dbm.T, float)
    if metric == METRICS[0]:
        weakest = np.where(heard.any(axis=0), np.where(heard, measured_dbm, np.inf).min(axis=0), 0.0)
        measured_dbm, asked = (np.where(np.isfinite(values), values, weakest) for values in (measured_dbm, asked))
    model = NearestNeighbors(n_neighbors=min(count, len(rows)), metric=metric).fit(measured_dbm)
    return np.asarray(record.tx_pos_m[rows[model.kneighbors(asked, return_distance=False)]], float)


def choose_neighbours(record: Record, folds: Sequence[Split]) -> tuple[Neighbours, FloatArray]:
    """The number of neighbours and the distance with the least mean held-out error, and the errors [m] in metres."""
    best, least = Neighbours(1), np.full(1, np.inf)
    for metric in METRICS:
        errors: dict[int, list[FloatArray]] = {count: [] for count in COUNTS}
        for fold in folds:
            test = fold.test[np.isfinite(record.observation[:, fold.test]).any(axis=0)]
            if not len(test):
                continue
            observed_dbm = np.asarray(record.observation[:, test], float)
            places = nearest_places(record, fold.all_train, observed_dbm, metric, max(COUNTS))
            means = np.cumsum(places, axis=1) / np.arange(1, places.shape[1] + 1)[:, None]
            for count in COUNTS:
                mean = means[:, min(count, places.shape[1]) - 1]
                errors[count].append(np.linalg.norm((mean - record.tx_pos_m[test])[:, :2], axis=1))
        for count, parts in errors.items():
            if parts and np.concatenate(parts).mean() < least.mean():
                best, least = Neighbours(count, metric), np.concatenate(parts)
    return best, least


def log_near(positions_m: FloatArray, place_m: FloatArray, spread_m: float) -> FloatArray:
    """Logarithm [p] at positions [p, 2 or 3] of a circular normal density around a place [2 or 3], up to a constant."""
    return np.asarray(-np.square((positions_m[:, :2] - place_m[:2]) / spread_m).sum(axis=1) / 2)
