"""Probability that a receiver receives a transmission at all, beside the strength that a model predicts for it.

Rows in which a receiver received nothing have no value to interpolate, but they state where its signal is too weak. The
probability of reception is a weighted mean of three, with weights by the distance to the nearest training row:

- rate: the share of the training rows that the receiver received;
- strength: the probability that the signal exceeds the receiver's sensitivity (`Sensitivity`), by the latent variable
  of the Tobit model: Tobin, "Estimation of relationships for limited dependent variables" (1958), Econometrica 26;
- neighbours: the share of the nearest training rows that it received, weighted by inverse squared distance.

Sensitivity and weights maximise the likelihood of held-out training rows, received or not, given the strengths that are
predicted without them. The full Tobit likelihood has the density of received strengths, too: its log loss on other rows
is higher, as models of received rows predict too high a strength where nothing is received, and the sensitivity that
follows from the weakest received strength then overstates reception.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.spatial import cKDTree
from scipy.special import expit, logit, ndtr

from ..core import Prediction, Record
from ..core.angles import FloatArray
from ..core.array_files import keyed, under
from ..core.types import IntArray
from ..training.by_distance import HeldOutScores, Mixture, choose_weights
from ..training.selection import HeldOut, groups_in_space
from .model import Arrays, field_arrays, from_field_arrays

PREFIX, ROWS = "reception/", "rows"  # prefix of the arrays of a run file, and key of the training rows
PARTS = ("rate", "strength", "neighbours")  # probabilities that are mixed
NEIGHBOURS, SOFTENING_M = 16, 0.4  # training rows of the neighbours' share, and addend of their distances, metres
WIDTH_DB, CEILING = 6.0, 0.95  # prior medians of the width of the threshold and of the ceiling
LOG_WIDTH, LOGIT = 1.0, 2.0  # prior standard deviations of the width's logarithm and of the ceiling's logit
BETWEEN_DB, BETWEEN_LOGIT = 5.0, 1.0
"""Prior standard deviations between receivers of sensitivities and of ceilings' logits: a receiver with few missing
rows takes those of the others."""
LEAST = 1e-9  # least probability, so that logarithms are finite


@dataclass(frozen=True)
class Sensitivity:
    """Reception by the strength: P = a_r Phi((m - s_r) / sqrt(std^2 + w^2)) for a predicted strength m +- std.

    Attributes:
        sensitivity_dbm: strength s_r at which half of the ceiling is received, dBm [n_rx].
        ceiling: share a_r that is received of strong signals; others are lost by chance [n_rx].
        width_db: standard deviation w of the threshold from row to row, dB.
    """

    sensitivity_dbm: FloatArray
    ceiling: FloatArray
    width_db: float

    def __call__(self, mean_dbm: FloatArray, std_db: FloatArray, receiver: int | IntArray) -> FloatArray:
        """Probability [m] of reception by predicted strengths [m]; one receiver, or one for each."""
        spread = np.hypot(std_db, self.width_db)
        return np.asarray(self.ceiling[receiver] * ndtr((mean_dbm - self.sensitivity_dbm[receiver]) / spread))

    @classmethod
    def fit(
        cls, mean_dbm: FloatArray, std_db: FloatArray, receiver: IntArray, received: NDArray[np.bool_], count: int
    ) -> Sensitivity:
        """The sensitivities of ``count`` receivers of the greatest posterior density.

        Args:
            mean_dbm: strengths predicted for rows, received or not [q], dBm.
            std_db: their standard deviations [q].
            receiver: number of the receiver of each [q].
            received: whether it was received [q].
            count: number of receivers.
        """
        # Width, common ceiling and sensitivity, then differences of the receivers from these.
        first = np.concatenate([[np.log(WIDTH_DB), logit(CEILING), np.quantile(mean_dbm, 0.05)], np.zeros(2 * count)])
        prior = np.repeat([LOG_WIDTH, LOGIT, np.inf, BETWEEN_DB, BETWEEN_LOGIT], [1, 1, 1, count, count])

        def of(x: FloatArray) -> Sensitivity:
            return cls(x[2] + x[3 : 3 + count], expit(x[1] + x[3 + count :]), float(np.exp(x[0])))

        def cost(x: FloatArray) -> tuple[float, FloatArray]:
            """Minus the logarithm of the posterior density, and its gradient."""
            now, away = of(x), (x - first) / prior
            spread, ceiling = np.hypot(std_db, now.width_db), now.ceiling[receiver]
            z = (mean_dbm - now.sensitivity_dbm[receiver]) / spread
            p = np.clip(ceiling * ndtr(z), LEAST, 1 - LEAST)
            by_p = np.where(received, -1 / p, 1 / (1 - p))
            by_z = by_p * ceiling * np.exp(-(z**2) / 2) / np.sqrt(2 * np.pi)
            by_sensitivity = np.bincount(receiver, -by_z / spread, count)
            by_logit = np.bincount(receiver, by_p * p * (1 - ceiling), count)
            by_width = -(by_z * z * (now.width_db / spread) ** 2).sum()
            gradient = np.array([by_width, by_logit.sum(), by_sensitivity.sum(), *by_sensitivity, *by_logit])
            value = -np.log(np.where(received, p, 1 - p)).sum() + np.square(away).sum() / 2
            return float(value), gradient + away / prior

        return of(minimize(cost, first, jac=True, method="L-BFGS-B").x)


class ReceivedShares:
    """Shares of some training rows of a record that its receivers received: of all, and of those near a position.

    Attributes:
        rows: rows of the record [n].
        rate: share of them that each receiver received [n_rx].
    """

    def __init__(self, record: Record, rows: IntArray) -> None:
        self.rows, self._tree = rows, cKDTree(record.tx_pos_m[rows])
        self._received = ~np.isnan(record.observation[:, rows])
        # With half a received and half a missing row (Krichevsky and Trofimov, 1981) no share is 0 or 1.
        self.rate = (self._received.sum(axis=1) + 0.5) / (len(rows) + 1)

    def near(self, tx_pos_m: FloatArray, receiver: int) -> tuple[FloatArray, FloatArray]:
        """Share [m] of the nearest rows, and distance [m] in metres to the nearest, of positions [m, 3]."""
        count = min(NEIGHBOURS, len(self.rows))
        distance, row = self._tree.query(tx_pos_m, k=list(range(1, count + 1)))
        weight = (distance + SOFTENING_M) ** -2.0
        share = (weight * self._received[receiver][row]).sum(axis=1) / weight.sum(axis=1)
        # The rate counts as one more neighbour, so that no share is 0 or 1.
        return (count * share + self.rate[receiver]) / (count + 1), distance[:, 0]


@dataclass(frozen=True)
class Reception:
    """Probability of reception, fitted to a model's held-out predictions.

    Attributes:
        shares: shares of the training rows that were received.
        sensitivity: reception by the predicted strength.
        mixture: weights of `PARTS` by the distance to the nearest training row.
    """

    shares: ReceivedShares
    sensitivity: Sensitivity
    mixture: Mixture

    @classmethod
    def fit(
        cls, record: Record, rows: IntArray, remaining: IntArray, held_out: HeldOut, predicted: Prediction
    ) -> Reception:
        """Reception of a model that is fitted to some rows of a record.

        Args:
            record: data of signal strengths.
            rows: training rows [n].
            remaining: those of them that are not held out.
            held_out: held-out rows, with q pairs of a receiver and a row (`HeldOut.every`).
            predicted: predictions [q] of these pairs, with standard deviations, by the model fitted to ``remaining``.
        """
        receiver, row = held_out.every.T
        received = ~np.isnan(record.observation[receiver, row])
        predicted = Prediction(predicted.mean.astype(float), predicted.stated_std)
        of_receivers = receiver, received, len(record.receivers)
        sensitivity = Sensitivity.fit(predicted.mean, predicted.stated_std, *of_receivers)
        trial = cls(ReceivedShares(record, remaining), sensitivity, Mixture(np.zeros(1), np.eye(3)[:1]))
        parts, distance_m = np.empty((len(row), len(PARTS))), np.empty(len(row))
        for number in np.unique(receiver):
            pairs = receiver == number
            of_pairs = Prediction(predicted.mean[pairs], predicted.stated_std[pairs])
            parts[pairs], distance_m[pairs] = trial.parts(of_pairs, record.tx_pos_m[row[pairs]], int(number))

        def score(weights: FloatArray, chosen: IntArray) -> FloatArray:
            mixed = np.clip((weights * parts[chosen]).sum(axis=1), LEAST, 1 - LEAST)
            return np.asarray(np.log(np.where(received[chosen], mixed, 1 - mixed)))

        scores = HeldOutScores(score, distance_m, row, len(PARTS))
        # Losses by chance, which no position tells, have the rate: others are mixed in for a clear gain.
        groups = groups_in_space(record.tx_pos_m[row], 0)
        _, mixture = choose_weights(scores, groups, lambda share: None, trusted=PARTS.index("rate"))
        return cls(ReceivedShares(record, rows), sensitivity, mixture)

    def parts(self, prediction: Prediction, tx_pos_m: FloatArray, receiver: int) -> tuple[FloatArray, FloatArray]:
        """Probabilities [m, 3] by `PARTS`, and distances [m] to the nearest training row in metres."""
        near, distance_m = self.shares.near(tx_pos_m, receiver)
        of_strength = self.sensitivity(prediction.mean, prediction.stated_std, receiver)
        rate = np.full(len(near), self.shares.rate[receiver])
        return np.stack([rate, of_strength, near], axis=1), distance_m

    def __call__(self, prediction: Prediction, tx_pos_m: FloatArray, receiver: int) -> Prediction:
        """A receiver's predictions at positions [m, 3] in metres with their probability of reception."""
        parts, distance_m = self.parts(prediction, tx_pos_m, receiver)
        return replace(prediction, reception=(self.mixture(distance_m) * parts).sum(axis=1))

    def arrays(self) -> Arrays:
        """Arrays of a run file."""
        of_parts = field_arrays(self.sensitivity) | field_arrays(self.mixture) | {ROWS: self.shares.rows}
        return keyed(PREFIX, of_parts)

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]], record: Record) -> Reception | None:
        """The reception among the arrays of a run file; None where there is none."""
        stored = under(PREFIX, arrays)
        if not stored:
            return None
        fitted = from_field_arrays(Sensitivity, stored), from_field_arrays(Mixture, stored)
        return cls(ReceivedShares(record, stored[ROWS]), *fitted)

    def facts(self, record: Record) -> dict[str, Any]:
        """Entry ``sensitivity`` of ``metrics.json``: sensitivities, ceilings, width and weights."""
        fitted = self.sensitivity
        limits = zip(record.receivers, fitted.sensitivity_dbm, fitted.ceiling, strict=True)
        of_receivers = {receiver.name: {"dbm": float(dbm), "ceiling": float(c)} for receiver, dbm, c in limits}
        table = np.column_stack([self.mixture.distance_m, self.mixture.weights])
        weights = [dict(zip(("distance_m", *PARTS), map(float, row), strict=True)) for row in table]
        return {"sensitivity": {"width_db": fitted.width_db, "receivers": of_receivers, "weights": weights}}
