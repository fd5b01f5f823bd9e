"""Likelihood of received signal strengths at candidate positions of the transmitter, and regions that hold it.

The residual of receiver r, observation minus predicted mean, has the scale a s_r, where s_r is the standard deviation
that the model states at the candidate position, and a Student-t distribution, whose tails are heavier than those of the
normal distribution: people, doors and furniture move. An offset that all receivers share, of a transmitter whose power
differs from that of the training rows, is normal with mean zero and integrated by adaptive quadrature. Given
position, heading and offset the receivers are independent. The heading is unknown and uniform: the likelihood is
averaged over headings jointly for all receivers, as one body shadows them.

K nearest neighbours among the training rows' strengths (fingerprinting) are the reference (`Neighbours`).

Source: Lange, Little and Taylor, "Robust statistical modeling using the t distribution" (1989), JASA 84; Liu
and Pierce, "A note on Gauss-Hermite quadrature" (1994), Biometrika 81 (the offset); Bahl and
Padmanabhan, "RADAR: an in-building RF-based user location and tracking system" (2000), INFOCOM (neighbours).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln, log_expit, logsumexp
from sklearn.neighbors import KNeighborsRegressor

from ...core import Record, Split
from ...core.angles import FloatArray
from ...core.types import IntArray

OFFSET_NODES = 7  # nodes of the quadrature over the common offset
COUNTS = (1, 2, 3, 4, 5, 6, 8, 10, 13, 16, 20, 25, 32, 40)  # numbers of neighbours to choose from
METRICS = ("euclidean", "nan_euclidean")
"""Distances: a receiver without a value has its weakest training value, or is left out and the others are scaled up."""


@dataclass(frozen=True)
class Silence:
    """Probability that a receiver reports nothing, logistic in the predicted mean."""

    middle_dbm: float  # predicted mean at which half of the rows are received
    slope_per_db: float  # logit of the reception per decibel, above 0

    def log_probability(self, mean_dbm: NDArray[np.floating], received: bool) -> NDArray[np.floating]:
        """Logarithm of the probability of reception, or of none, of the shape of the predicted mean."""
        slope = self.slope_per_db if received else -self.slope_per_db
        return np.asarray(log_expit(slope * (mean_dbm - self.middle_dbm)))


@dataclass(frozen=True)
class Likelihood:
    """Form of the likelihood."""

    degrees: float | None = 8.0  # degrees of freedom of the Student-t distribution; None: normal
    scale: float = 1.0  # factor of the stated standard deviations
    offset_db: float = 0.0  # standard deviation of the offset that all receivers share
    silence: Silence | None = None  # probability of receiving nothing; None: receivers without a value are left out

    def log(
        self, observed_dbm: NDArray[np.floating], mean_dbm: NDArray[np.floating], std_db: NDArray[np.floating]
    ) -> FloatArray:
        """Logarithm of the likelihood [p] of strengths [n_rx], NaN where nothing was received, at p candidates.

        Predicted means and standard deviations are [headings, n_rx, p], one heading where the model does not use it.
        """
        known = np.isfinite(observed_dbm)
        scale = self.scale * std_db[:, known]
        error = observed_dbm[known, None].astype(mean_dbm.dtype) - mean_dbm[:, known]
        log_density = self._with_offset(error, scale) if self.offset_db > 0 else self._density(error, scale)
        if self.silence is not None:
            for rows, received in ((known, True), (~known, False)):
                log_density = log_density + self.silence.log_probability(mean_dbm[:, rows], received).sum(axis=1)
        return np.asarray(logsumexp(log_density, axis=0) - np.log(len(mean_dbm)), float)

    def _with_offset(self, error: NDArray[np.floating], scale: NDArray[np.floating]) -> NDArray[np.floating]:
        """Logarithm of the density of residuals with a common normal offset, as `_density`.

        The nodes of each candidate are those of the offset's distribution given normal residuals, for which the
        quadrature is exact.
        """
        weight = 1 / scale**2
        variance = 1 / (1 / self.offset_db**2 + weight.sum(axis=1))
        middle = variance * (weight * error).sum(axis=1)
        nodes, weights = np.polynomial.hermite_e.hermegauss(OFFSET_NODES)
        terms = []
        for node in nodes:
            offset = middle + np.sqrt(variance) * node
            prior = -((offset / self.offset_db) ** 2 - node**2 + np.log(self.offset_db**2 / variance)) / 2
            terms.append(self._density(error - offset[:, None], scale) + prior)
        return np.asarray(logsumexp(terms, axis=0, b=(weights / weights.sum())[:, None, None]))

    def _density(self, error: NDArray[np.floating], scale: NDArray[np.floating]) -> NDArray[np.floating]:
        """Logarithm of the density [headings, p] of residuals [headings, received, p]."""
        square = (error / scale) ** 2
        if self.degrees is None:
            return np.asarray(-(square / 2 + np.log(scale) + np.log(2 * np.pi) / 2).sum(axis=1))
        n = self.degrees
        constant = gammaln((n + 1) / 2) - gammaln(n / 2) - np.log(n * np.pi) / 2
        return np.asarray((constant - (n + 1) / 2 * np.log1p(square / n) - np.log(scale)).sum(axis=1))


def region_of(probability: FloatArray, distance_m: FloatArray, level: float) -> tuple[int, float, NDArray[np.bool_]]:
    """Estimate and regions of a transmitter from probabilities [p] of candidates with distances [p, p] in metres.

    Returns:
        The candidate of the least expected distance from the transmitter (geometric median), the radius in metres of
        the circle around it that holds the probability ``level``, and a mask [p] of the highest-density region.
    """
    best = int(np.argmin(distance_m @ probability))
    order = np.argsort(distance_m[best], kind="stable")
    return best, float(distance_m[best][order][_last(probability[order], level)]), densest(probability, level)


def densest(probability: FloatArray, level: float) -> NDArray[np.bool_]:
    """Mask of the fewest candidates [p] that hold a probability together."""
    order = np.argsort(-probability, kind="stable")
    inside = np.zeros(len(probability), bool)
    inside[order[: _last(probability[order], level) + 1]] = True
    return inside


def _last(probability: FloatArray, level: float) -> int:
    """Index of the first of ordered candidates at which a probability is reached."""
    reached = np.cumsum(probability) >= level * (1 - 1e-12)
    return int(np.argmax(reached)) if reached.any() else len(probability) - 1


@dataclass(frozen=True)
class Neighbours:
    """Number k of nearest neighbours, and their distance, one of `METRICS`."""

    count: int
    metric: str = METRICS[0]

    def locate(self, record: Record, rows: IntArray, observed_dbm: FloatArray) -> FloatArray:
        """Mean positions [m, 3] of the nearest of training rows [n], from strengths [n_rx, m], NaN: not received."""
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
                    estimate = chosen.locate(record, fold.all_train, np.asarray(record.observation[:, test], float))
                    errors.append(np.linalg.norm((estimate - record.tx_pos_m[test])[:, :2], axis=1))
            error = float(np.concatenate(errors).mean()) if errors else np.inf
            if error < least:
                best, least = chosen, error
    return best, least
