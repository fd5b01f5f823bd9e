"""Probability that a receiver receives a transmission at all, beside the strength that a model predicts for it.

Rows in which a receiver received nothing have no value to interpolate, but they state where its signal is too weak. The
probability of reception is a mean of three, with weights by the distance to the nearest training row (`Weights`):

- rate: the share of the training rows that the receiver received;
- strength: the probability that the signal exceeds the receiver's sensitivity (`Sensitivity`), by the latent variable
  of the Tobit model: Tobin, "Estimation of relationships for limited dependent variables" (1958), Econometrica 26;
- neighbours: the share of the nearest training rows that it received, weighted by inverse squared distance.

Sensitivity and weights maximise the likelihood of held-out training rows, received or not, given the strengths that are
predicted without them. Parts other than the rate keep their weights where these rows gain by them, each group of rows
scored by what is fitted to the others. The full Tobit likelihood has the density of received strengths, too: its log
loss on other rows is higher, as models of received rows predict too high a strength where nothing is received, and the
sensitivity that follows from the weakest received strength then overstates reception.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.spatial import cKDTree
from scipy.special import expit, logit, ndtr, softmax

from ..core import Prediction, Record
from ..core.angles import FloatArray
from ..core.stored import NOT_STORED
from ..core.types import IntArray
from ..tasks.scores import probability_scores
from ..training.gains import improves
from ..training.selection import FOLDS, HeldOut, clusters

PARTS = ("rate", "strength", "neighbours")  # probabilities that are mixed
NEIGHBOURS, SOFTENING_M = 16, 0.4  # training rows of the neighbours' share, and addend of their distances, metres
WIDTH_DB = 6.0  # prior median of the width of the threshold
LOG_WIDTH, LOGIT = 1.0, 2.0  # prior standard deviations of the width's logarithm and of the ceiling's logit
BETWEEN_DB, BETWEEN_LOGIT = 5.0, 0.5
"""Prior standard deviations between receivers of sensitivities and of ceilings' logits: a receiver with few missing
rows takes those of the others."""
LEVEL, SLOPE = 2.0, 1.0
"""Prior standard deviations of the weights' logits, and of their slopes over the logarithm of the distance."""
NEAREST = 0.05  # distance below which weights do not change, as a share of the median held-out distance
FEWEST = 10  # held-out pairs that were not received, or were, below which the rate is used alone: fewer are chance
LEAST = 1e-9  # least probability, so that logarithms are finite
NO_WEIGHT = -50.0  # logit of parts without weight


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
        cls, mean_dbm: FloatArray, std_db: FloatArray, receiver: IntArray, received: NDArray[np.bool_], rate: FloatArray
    ) -> Sensitivity:
        """The sensitivities of the greatest posterior density.

        Args:
            mean_dbm: strengths predicted for rows, received or not [q], dBm.
            std_db: their standard deviations [q].
            receiver: number of the receiver of each [q].
            received: whether it was received [q].
            rate: share of all training rows that each receiver received [n_rx].
        """
        # Width, common sensitivity and ceiling above the rate, then differences of the receivers from these: if losses
        # are by chance, ceilings are the rates, of which the training rows say more than the held-out ones.
        count, of_rate = len(rate), logit(rate)
        first = np.concatenate([[np.log(WIDTH_DB), 0, np.quantile(mean_dbm, 0.05)], np.zeros(2 * count)])
        prior = np.repeat([LOG_WIDTH, LOGIT, np.inf, BETWEEN_DB, BETWEEN_LOGIT], [1, 1, 1, count, count])

        def of(x: FloatArray) -> Sensitivity:
            return cls(x[2] + x[3 : 3 + count], expit(of_rate + x[1] + x[3 + count :]), float(np.exp(x[0])))

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


MOST_KEPT = 4_000_000  # distances to nearest rows that are kept, 64 MB with the numbers of the rows


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
        self._kept: dict[bytes, tuple[FloatArray, IntArray]] = {}

    def near(self, tx_pos_m: FloatArray, receiver: int) -> tuple[FloatArray, FloatArray]:
        """Share [m] of the nearest rows, and distance [m] in metres to the nearest, of positions [m, 3]."""
        count, key = min(NEIGHBOURS, len(self.rows)), tx_pos_m.tobytes()
        # A map asks for the same chunks of positions at each receiver.
        if key not in self._kept:
            if sum(distance.size for distance, _ in self._kept.values()) > MOST_KEPT:
                self._kept.clear()
            self._kept[key] = self._tree.query(tx_pos_m, k=list(range(1, count + 1)))
        distance, row = self._kept[key]
        weight = (distance + SOFTENING_M) ** -2.0
        share = (weight * self._received[receiver][row]).sum(axis=1) / weight.sum(axis=1)
        # The rate counts as one more neighbour, so that no share is 0 or 1.
        return (count * share + self.rate[receiver]) / (count + 1), distance[:, 0]


@dataclass(frozen=True)
class Weights:
    """Weights of `PARTS`: softmax of level + slope log(d / scale + `NEAREST`) at the distance d to the nearest row.

    Neighbours say most near the training rows, the strength beyond.

    Attributes:
        scale_m: unit of the distance, metres.
        level: logits at the unit [3]; that of the rate is 0.
        slope: slopes of the logits [3].
    """

    scale_m: float
    level: FloatArray
    slope: FloatArray

    def __call__(self, distance_m: FloatArray) -> FloatArray:
        """Weights [m, 3] at distances [m], of sum 1."""
        x = np.log(distance_m / self.scale_m + NEAREST)[:, None]
        return np.asarray(softmax(self.level + self.slope * x, axis=1))

    @classmethod
    def fit(cls, parts: FloatArray, distance_m: FloatArray, received: NDArray[np.bool_]) -> Weights:
        """The weights of the greatest posterior density, by probabilities [q, 3] of pairs, received or not [q]."""
        scale_m = float(np.median(distance_m)) or 1.0
        if min(received.sum(), (~received).sum()) < FEWEST:
            return cls(scale_m, np.array([0, NO_WEIGHT, NO_WEIGHT]), np.zeros(3))
        # The rate and the strength need no row nearby.
        first, prior = np.array([0, 0, 0, -1.0]), np.repeat([LEVEL, SLOPE], 2)
        x = np.log(distance_m / scale_m + NEAREST)

        def of(values: FloatArray) -> Weights:
            return cls(scale_m, np.concatenate([[0.0], values[:2]]), np.concatenate([[0.0], values[2:]]))

        def cost(values: FloatArray) -> tuple[float, FloatArray]:
            """Minus the logarithm of the posterior density, and its gradient."""
            weights, away = of(values)(distance_m), (values - first) / prior
            p = np.clip((weights * parts).sum(axis=1), LEAST, 1 - LEAST)
            by_p = np.where(received, -1 / p, 1 / (1 - p))
            by_logit = (by_p[:, None] * weights * (parts - p[:, None]))[:, 1:]
            value = -np.log(np.where(received, p, 1 - p)).sum() + np.square(away).sum() / 2
            return float(value), np.concatenate([by_logit.sum(axis=0), x @ by_logit]) + away / prior

        return of(minimize(cost, first, jac=True, method="L-BFGS-B").x)


@dataclass(frozen=True)
class Reception:
    """Probability of reception, fitted to a model's held-out predictions.

    Attributes:
        rows: training rows of the record [n].
        sensitivity: reception by the predicted strength.
        weights: weights of `PARTS` by the distance to the nearest training row.
        held_out: scores of held-out pairs by the ``mixture`` fitted to other groups of rows, by the ``rate`` and by the
            ``neighbours`` alone; None: too few pairs, or a run of an earlier version.
    """

    record: Record = field(metadata=NOT_STORED)
    rows: IntArray
    sensitivity: Sensitivity
    weights: Weights
    held_out: dict[str, dict[str, float]] | None = None

    @cached_property
    def shares(self) -> ReceivedShares:
        """Shares of the training rows that were received."""
        return ReceivedShares(self.record, self.rows)

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
        mean, std = predicted.mean.astype(float), predicted.stated_std
        shares = ReceivedShares(record, remaining)
        near, distance_m = np.empty(len(row)), np.empty(len(row))
        for number in np.unique(receiver):
            pairs = receiver == number
            near[pairs], distance_m[pairs] = shares.near(record.tx_pos_m[row[pairs]], int(number))

        def fitted(used_pairs: NDArray[np.bool_]) -> tuple[Sensitivity, Weights, FloatArray]:
            """Sensitivity and weights by some pairs [q], and probabilities of all pairs by the parts [q, 3]."""
            by_strength = Sensitivity.fit(
                mean[used_pairs], std[used_pairs], receiver[used_pairs], received[used_pairs], shares.rate
            )
            parts = np.stack([shares.rate[receiver], by_strength(mean, std, receiver), near], axis=1)
            return by_strength, Weights.fit(parts[used_pairs], distance_m[used_pairs], received[used_pairs]), parts

        sensitivity, weights, parts = fitted(np.ones(len(row), bool))
        scores, group = None, _groups(record, row)
        if min(received.sum(), (~received).sum()) >= FEWEST and len(np.unique(group)) > 1:
            crossed = np.empty(len(row))
            for number in np.unique(group):
                _, of_others, others = fitted(group != number)
                crossed[group == number] = (of_others(distance_m) * others).sum(axis=1)[group == number]
            by_name = {"mixture": crossed, "rate": parts[:, 0], "neighbours": near}
            scores = {name: probability_scores(values, received) for name, values in by_name.items()}
            # Receivers of one row are lost together: a row counts once.
            _, place = np.unique(row, return_inverse=True)
            of_mixture, of_rate = (
                np.bincount(place, -np.log(np.clip(np.where(received, values, 1 - values), LEAST, 1)))
                / np.bincount(place)
                for values in (crossed, parts[:, 0])
            )
            if not improves(of_mixture, of_rate, higher_is_better=False):
                weights = replace(weights, level=np.array([0, NO_WEIGHT, NO_WEIGHT]), slope=np.zeros(3))
        return cls(record, rows, sensitivity, weights, scores)

    def __call__(self, prediction: Prediction, tx_pos_m: FloatArray, receiver: int) -> Prediction:
        """A receiver's predictions at positions [m, 3] in metres with their probability of reception."""
        parts, distance_m = _parts(self.shares, self.sensitivity, prediction, tx_pos_m, receiver)
        return replace(prediction, reception=(self.weights(distance_m) * parts).sum(axis=1))

    def facts(self) -> dict[str, Any]:
        """Entry ``sensitivity`` of ``metrics.json``: sensitivities, ceilings, width and weights."""
        fitted = self.sensitivity
        limits = zip(self.record.receivers, fitted.sensitivity_dbm, fitted.ceiling, strict=True)
        of_receivers = {receiver.name: {"dbm": float(dbm), "ceiling": float(c)} for receiver, dbm, c in limits}
        # At the median distance of the held-out rows.
        weights = dict(zip(PARTS, map(float, self.weights(np.array([self.weights.scale_m]))[0]), strict=True))
        weights["distance_m"] = self.weights.scale_m
        facts = {"width_db": fitted.width_db, "receivers": of_receivers, "weights": weights}
        return {"sensitivity": facts | ({} if self.held_out is None else {"held_out": self.held_out})}


def _groups(record: Record, row: IntArray) -> IntArray:
    """Group of each of some rows [q] that its reception is scored without, fewer than `FOLDS`: runs, or clusters."""
    runs = np.zeros(len(row), str) if record.runs is None else record.runs[row]
    if len(np.unique(runs)) > 1:
        return np.asarray(np.unique(runs, return_inverse=True)[1].reshape(-1) % FOLDS)
    places_m = record.tx_pos_m[row]
    count = min(FOLDS, len(np.unique(places_m, axis=0)))
    return clusters(places_m, count, np.random.default_rng(0)) if count > 1 else np.zeros(len(row), np.int64)


def _parts(
    shares: ReceivedShares, sensitivity: Sensitivity, prediction: Prediction, tx_pos_m: FloatArray, receiver: int
) -> tuple[FloatArray, FloatArray]:
    """Probabilities [m, 3] by `PARTS` at positions [m, 3], and distances [m] to the nearest training row, metres."""
    near, distance_m = shares.near(tx_pos_m, receiver)
    of_strength = sensitivity(prediction.mean, prediction.stated_std, receiver)
    return np.stack([np.full(len(near), shares.rate[receiver]), of_strength, near], axis=1), distance_m
