"""Fit of signal strengths: expected power, likely hyperparameters, calibration of predictions.

The processes of the receivers are those of `wrf_mi.estimators.interpolation.pooled_process`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray
from scipy.constants import speed_of_light
from scipy.optimize import minimize

from ...core.angles import FloatArray
from ...core.stored import NOT_STORED
from ...core.types import IntArray
from ...tasks.scores import LEVEL, REAL_90
from .path_loss import FREE_SPACE, NEAREST_M
from .pooled_process import Basis, PooledProcess, ReceiverObservations, of_each
from .strength_terms import PARTS_OF_NOISE, Hyperparameters, Measured, Poses, Stops, basis
from .strength_trees import Forest
from .stretches import folds, run_folds, scales

if TYPE_CHECKING:
    from ...tracing.power_map import Traced

TRUST = 100.0  # number of held-out values that weigh as much as the prior in a quantile of errors
AREA_SHADOW_DB, AREA_NOISE_DB = 6.0, 2.0  # shadowing of areas a priori, and both parts of the noise
LIKELIHOOD_STOPS, LIKELIHOOD_RECEIVERS, LIKELIHOOD_STEPS = 400, 12, 50
"""Largest numbers of stops and receivers in the likelihood, those with most rows, and of its evaluations."""
DEVIATION_STOPS = 200  # the first of these where deviations alone are wanted
SEARCH_STEP, MOST_STEPS, SEARCH_ROWS = 2.0, 4, 400
"""Factor of a step of the search, most steps of one parameter in one direction, and most rows."""
LEAST_GAIN_DB = 0.005  # least reduction of the held-out error by which the search changes a parameter


@dataclass(frozen=True)
class PriorMean:
    """Expected signal strength before anything is measured: traced power, or free space where ``traced`` is None.

    ``transmit_dbm`` includes the gains of both antennas; ``sd`` and ``rx_sd_db`` are those of `basis`;
    ``frequency_hz`` is the carrier [1], or that of each receiver [n_rx].
    """

    receivers_m: FloatArray
    transmit_dbm: float
    frequency_hz: FloatArray
    traced: Traced | None = field(metadata=NOT_STORED)
    sd: FloatArray
    rx_sd_db: float

    def columns(self, poses: Poses, receiver: int) -> tuple[FloatArray, Basis, FloatArray]:
        """Expected dBm [n], columns of its corrections, and the prior standard deviations of all receivers' [k]."""
        if self.traced is not None:
            power = self.traced(poses.position_m, receiver)
            level = power - self.traced.level_dbm  # centred, so that factor and offset are apart
        else:
            distance = np.linalg.norm(self.receivers_m[receiver] - poses.position_m, axis=1)
            frequency_hz = np.broadcast_to(self.frequency_hz, len(self.receivers_m))[receiver]
            at_1m = 20 * np.log10(speed_of_light / frequency_hz / (4 * np.pi))
            power, level = at_1m - 10 * FREE_SPACE * np.log10(np.maximum(distance, NEAREST_M)), None
        return self.transmit_dbm + power, *basis(poses, receiver, self.receivers_m, level, self.sd, self.rx_sd_db)

    def deviations(self, headings: bool) -> FloatArray:
        """Prior standard deviations of the corrections [k], see `columns`."""
        nowhere = Poses(np.zeros((0, 3)), np.zeros(0) if headings else None)
        return self.columns(nowhere, 0)[2]


@dataclass(eq=False)
class StrengthPosterior:
    """Posterior of the signal strengths, given stops (possibly none) and hyperparameters.

    ``rounds`` reweight for Student-t noise.
    Means are those of ``hyperparameters``, deviations those of ``spread`` (`likely_deviations`); None: the same.
    ``trees`` is the number of trees of what the mean terms leave; ``forest``: trees that were grown already.
    """

    prior: PriorMean
    hyperparameters: Hyperparameters
    stops: Stops
    rounds: int = 0
    spread: Hyperparameters | None = None
    trees: int = 0
    forest: Forest | None = None

    def __post_init__(self) -> None:
        self.headings = self.stops.poses.heading_rad is not None
        self._spread = self.spread or self.hyperparameters
        self._process = self._process_of(self.hyperparameters)
        if self.trees and self.forest is None:
            self.forest = Forest.grown(self._process.residuals(), self.stops.poses, self.trees)

    @cached_property
    def _moved(self) -> Poses:
        return self.stops.poses.moved(self.hyperparameters.lever_m)

    @cached_property
    def _terms(self) -> list[tuple[IntArray, Basis, FloatArray]]:
        """Of each receiver: numbers of its stops [n], columns of the mean [n], values less the expected [n]."""
        terms = []
        for receiver, values in enumerate(self.stops.value_dbm):
            received = np.flatnonzero(np.isfinite(values))
            expected, columns, _ = self.prior.columns(self._moved.take(received), receiver)
            terms.append((received, columns, values[received] - expected))
        return terms

    def _process_of(self, h: Hyperparameters, prior: PriorMean | None = None) -> PooledProcess:
        """The process of hyperparameters with this lever, and of deviations of a prior with this mean."""
        parts = []
        for (received, columns, value), count in zip(self._terms, self.stops.count, strict=True):
            # Observations of a stop average their own noise out, but not the fading that persists during the stop.
            variance = h.drift_db**2 + h.noise_db**2 / count[received]
            parts.append(ReceiverObservations(received, columns, value, variance))
        sd = (prior or self.prior).deviations(self.headings)
        return PooledProcess(self._moved, parts, h.covariance, sd, h.variance(self.headings), self.rounds)

    @cached_property
    def _spread_process(self) -> PooledProcess:
        return self._process if self._spread == self.hyperparameters else self._process_of(self._spread)

    def with_spread(self, spread: Hyperparameters | None) -> StrengthPosterior:
        """The posterior of the same means with the deviations of other hyperparameters."""
        other = copy(self)
        other.spread, other._spread = spread, spread or self.hyperparameters
        vars(other).pop("_spread_process", None)
        return other

    def cost(self, prior: PriorMean, h: Hyperparameters) -> float:
        """Minus twice the logarithm of the marginal likelihood of the stops, up to a constant.

        ``h`` has the lever of these hyperparameters, and ``prior`` other deviations about this mean.
        """
        return self._process_of(h, prior).cost

    def predict(self, poses: Sequence[Poses], receiver: int) -> list[tuple[FloatArray, FloatArray]]:
        """Mean in dBm, and variance of the local mean power about it, [m] each, of several poses [m]."""
        h = self.hyperparameters
        moved = [each.moved(h.lever_m) for each in poses]
        # Paths may be traced for the mean, which is not for threads.
        terms = [self.prior.columns(each, receiver)[:2] for each in moved]

        def posterior(k: int) -> tuple[FloatArray, FloatArray]:
            mean, variance = spread.predict(receiver, moved[k], terms[k][1])
            if spread is not self._process:
                mean = self._mean(moved[k], receiver, terms[k][1])
            if self.forest is not None:
                more = self.forest.predict(poses[k], receiver)
                mean, variance = mean + more[0], variance + more[1]
            return terms[k][0] + mean, variance

        spread = self._spread_process  # made here, not on threads
        return of_each(posterior, range(len(poses)), sum(map(len, poses)))

    def without(self, left: Sequence[NDArray[np.bool_]], trees: int = 0) -> list[tuple[FloatArray, FloatArray]]:
        """Mean in dBm and variance of the local mean power, [n_rx, s] each, without stops, where these are; else NaN.

        ``left`` are masks [n_rx, s] of the stops that a fold leaves out, ``trees`` the number of trees of each fold.
        """
        received = [terms[0] for terms in self._terms]
        blocks = [[np.flatnonzero(mask[k, rows]) for k, rows in enumerate(received)] for mask in left]
        folds = self._process.without(blocks)
        spread = folds if self._spread_process is self._process else self._spread_process.without(blocks)
        predictions = []
        for mask, block, means, variances in zip(left, blocks, folds, spread, strict=True):
            mean, variance = np.full((2, *mask.shape), np.nan)
            residuals = self._process.residuals(means.beta)
            training_residuals = [
                (rows[~mask[k, rows]], value[~mask[k, rows]]) for k, (rows, value) in enumerate(residuals)
            ]
            forest = Forest.grown(training_residuals, self.stops.poses, trees) if self.trees else None
            for k, rows in enumerate(received):
                out, (_, _, value) = rows[block[k]], self._terms[k]
                # Values of the process are less what is expected.
                expected = self.stops.value_dbm[k, out] - value[block[k]]
                mean[k, out], variance[k, out] = expected + means.mean[k], variances.variance[k]
                if forest is not None:
                    mean[k, out], variance[k, out] = np.add(
                        (mean[k, out], variance[k, out]), forest.predict(self.stops.poses.take(out), k)
                    )
            predictions.append((mean, variance))
        return predictions

    @property
    def noise(self) -> float:
        """Variance of a single observation about the local mean power, dB^2."""
        return self._spread.drift_db**2 + self._spread.noise_db**2

    def mean(self, poses: Poses, receiver: int) -> FloatArray:
        """The mean of `predict`, dBm."""
        moved = poses.moved(self.hyperparameters.lever_m)
        expected, columns, _ = self.prior.columns(moved, receiver)
        mean = expected + self._mean(moved, receiver, columns)
        return mean if self.forest is None else mean + self.forest.predict(poses, receiver)[0]

    def _mean(self, moved: Poses, receiver: int, columns: Basis) -> FloatArray:
        """What corrects the expected power at antennas [m], without trees, dB."""
        field = self.hyperparameters.weighted_covariance(moved, *self._process.weights(receiver))
        return self._process.trend(columns) + field


def by_likelihood(
    prior: PriorMean,
    stops: Stops,
    start: Hyperparameters,
    stated: Collection[str] = (),
    limit: int = LIKELIHOOD_STOPS,
) -> tuple[PriorMean, Hyperparameters]:
    """Mean and hyperparameters by the likelihood of the stops, for areas of any extent.

    Shadowing, noise and the deviation of the receivers' patterns, which may be sectors, have the greatest posterior
    density. The length is a priori the geometric mean of the stops' spacing and half of their extent, uncertain by a
    factor e. Hyperparameters that are ``stated`` hold. Of more than ``limit`` stops that many count.
    """
    few, most = _most_heard(prior, stops.value_dbm)
    stops = stops.at_receivers(most).thinned(limit)
    spacing_m, extent_m = scales(stops.poses.position_m)
    length_m = max(np.sqrt(spacing_m * extent_m / 2), NEAREST_M)  # rows may all be at one place
    middle = np.log([AREA_SHADOW_DB, length_m, AREA_NOISE_DB, prior.rx_sd_db])
    deviation = np.array([0.5, 1.0, 0.5, 1.0])

    def at(logarithms: FloatArray, prior: PriorMean) -> tuple[PriorMean, Hyperparameters]:
        shadow_db, shadow_m, noise_db, rx_sd_db = map(float, np.exp(logarithms))
        chosen = {"shadow_db": shadow_db, "shadow_m": shadow_m, "drift_db": noise_db, "noise_db": noise_db}
        field = replace(start, **{name: value for name, value in chosen.items() if name not in stated})
        return replace(prior, rx_sd_db=rx_sd_db), field

    parts = (("shadow_db",), ("shadow_m",), PARTS_OF_NOISE)
    free = np.array([*(not {*names} <= {*stated} for names in parts), True])

    def every(chosen: FloatArray) -> FloatArray:
        logarithms = middle.copy()
        logarithms[free] = chosen
        return logarithms

    posterior = StrengthPosterior(few, start, stops)

    def cost(chosen: FloatArray) -> float:
        penalty = float(np.square((chosen - middle[free]) / deviation[free]).sum())
        return posterior.cost(*at(every(chosen), few)) + penalty

    simplex = np.vstack([middle[free], middle[free] + np.diag(deviation[free])])
    options = {"initial_simplex": simplex, "maxfev": LIKELIHOOD_STEPS, "xatol": 0.05, "fatol": 0.1}
    return at(every(minimize(cost, middle[free], method="Nelder-Mead", options=options).x), prior)


def _most_heard(prior: PriorMean, value_dbm: FloatArray) -> tuple[PriorMean, IntArray]:
    """The mean at the receivers with most values [n_rx, n], `LIKELIHOOD_RECEIVERS` at most, and their numbers."""
    count = len(prior.receivers_m)
    if count <= LIKELIHOOD_RECEIVERS:
        return prior, np.arange(count)
    received = np.isfinite(value_dbm).sum(axis=1)
    most = np.sort(np.argsort(-received, kind="stable")[:LIKELIHOOD_RECEIVERS])
    frequency_hz = np.broadcast_to(prior.frequency_hz, count)[most]
    traced = None if prior.traced is None else prior.traced.at(most)
    return replace(prior, receivers_m=prior.receivers_m[most], frequency_hz=frequency_hz, traced=traced), most


def by_search(
    prior: PriorMean,
    measured: Measured,
    join: Callable[[Measured], Stops],
    start: Hyperparameters,
    stated: Collection[str] = (),
) -> Hyperparameters:
    """Hyperparameters that predict held-out stretches of the rows with the smallest mean absolute error.

    Shadowing, its length and both parts of the noise are changed in turn, as long as the error falls by
    `LEAST_GAIN_DB`; those that are ``stated`` hold. ``join`` makes stops of rows. Rows that are all at one place choose
    nothing. Of more than `SEARCH_ROWS` rows and `LIKELIHOOD_RECEIVERS` receivers that many count.
    """
    prior, most = _most_heard(prior, measured.value_dbm)
    precision = None if measured.precision is None else measured.precision[most]
    measured = replace(measured, value_dbm=measured.value_dbm[most], precision=precision)
    heard = np.flatnonzero(np.isfinite(measured.value_dbm).any(axis=0))
    measured = measured.take(heard[np.unique(np.linspace(0, len(heard) - 1, SEARCH_ROWS).round().astype(np.int64))])
    # Every second fold: all of them choose much the same.
    parts = [
        (join(measured.take(train)), measured.take(out)) for train, out in [*folds(measured.poses.position_m)][::2]
    ]

    def error_db(hyperparameters: Hyperparameters) -> float:
        errors = list[FloatArray]()
        for stops, out in parts:
            field = StrengthPosterior(prior, hyperparameters, stops)
            errors += [
                np.abs(field.mean(out.poses, receiver) - out.value_dbm[receiver]) for receiver in range(len(most))
            ]
        return float(np.nanmean(np.concatenate(errors)))

    chosen, best = start, error_db(start) if parts else 0.0
    for names in (("shadow_m",), ("shadow_db",), PARTS_OF_NOISE) if parts else ():
        free = [name for name in names if name not in stated]
        for factor in (SEARCH_STEP, 1 / SEARCH_STEP) if free else ():
            for _ in range(MOST_STEPS):
                other = replace(chosen, **{name: getattr(chosen, name) * factor for name in free})
                if (error := error_db(other)) > best - LEAST_GAIN_DB:
                    break
                chosen, best = other, error
    return chosen


def likely_deviations(
    prior: PriorMean, stops: Stops, hyperparameters: Hyperparameters, stated: Collection[str]
) -> Hyperparameters:
    """Hyperparameters with the deviations of shadowing and noise by likelihood, at the stated or chosen length.

    Hyperparameters that predict well may state deviations that are wrong: a mean depends on the ratio of field and
    noise, and little on that. The likelihood tells both, by differences of rows at all distances, so that what a
    reading adds to the uncertainty of the mean is known. Parameters that are ``stated`` hold.
    """
    return by_likelihood(prior, stops, hyperparameters, {*stated, "shadow_m"}, DEVIATION_STOPS)[1]


def held_out(
    field: StrengthPosterior,
    measured: Measured,
    stop: IntArray,
    new_runs: bool = False,
    unheard: bool = False,
    trees: int = 0,
) -> tuple[FloatArray, FloatArray]:
    """Mean (dBm) and standard deviation of a reading [n_rx, n] of each row by the fold without it; NaN where none.

    Held out are stretches (`folds`), or with ``new_runs`` runs, and hyperparameters are those of all rows. With
    ``unheard``, receivers are predicted from the others: every second one by the first two folds.

    Args:
        field: posterior of all rows.
        measured: the rows.
        stop: number of the stop of each row in the posterior [n], -1 where it has none.
        new_runs: whether runs are held out.
        unheard: whether receivers are.
        trees: number of trees of each fold, if the posterior has any.
    """
    by_run, receivers = new_runs and measured.poses.run is not None, np.arange(len(measured.value_dbm))
    every = run_folds(cast(IntArray, measured.poses.run)) if by_run else folds(measured.poses.position_m)
    used, left = list(every)[: 2 if unheard else None], list[NDArray[np.bool_]]()
    hidden = [(receivers % 2 == number) & unheard for number in range(len(used))]
    for (train, _), unknown in zip(used, hidden, strict=True):
        others = np.delete(stop, train)
        left.append(np.isin(np.arange(len(field.stops.poses)), others) | unknown[:, None])
    mean, std = np.full((2, *measured.value_dbm.shape), np.nan)
    for (_, out), unknown, (value, variance) in zip(used, hidden, field.without(left, trees), strict=True):
        for receiver in np.flatnonzero(unknown | (not unheard)):
            rows = out[np.isfinite(measured.value_dbm[receiver, out]) & (stop[out] >= 0)]
            mean[receiver, rows] = value[receiver, stop[rows]]
            std[receiver, rows] = np.sqrt(variance[receiver, stop[rows]] + field.noise)
    return mean, std


def widening(residual_db: FloatArray, std_db: FloatArray) -> FloatArray:
    """Factors [n_rx] of standard deviations with which 90 % of the held-out residuals lie in the 90 % interval.

    The factor of a receiver with few residuals tends to that of all, and that of few residuals in all to 1.
    """
    score = np.abs(residual_db) / std_db / REAL_90
    finite = np.isfinite(score)

    def quantile(values: FloatArray, prior: float) -> float:
        weight = len(values) / (len(values) + TRUST)
        return float(np.quantile(values, LEVEL) ** weight * prior ** (1 - weight)) if len(values) else prior

    pooled = quantile(score[finite], 1.0)
    return np.array([quantile(row[which], pooled) for row, which in zip(score, finite, strict=True)])
