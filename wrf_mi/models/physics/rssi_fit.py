"""Fit of an RSSI physics model: which folds judge, what they choose, how far predictions are off."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.constants import speed_of_light

from ...core.angles import FloatArray
from ...core.types import IntArray
from .gaussian_process import Part, PooledProcess, fit_pooled
from .rssi_map import PowerMap
from .rssi_terms import NEAREST_M, Covariance, Places, Priors, Stops, basis, stops_of

FREE_SPACE = 2.0
"""Exponent of the distance in free space."""
DEGREES = 4.0
"""Of freedom of the noise's Student-t distribution: fades are deep."""
FOLDS = 7
STRETCH = (4, 150)
"""Rows of a held-out stretch: a fourteenth of all within these bounds, so that each fold holds two at least."""
BUFFER = 0.25
"""Share of a stretch that is left out on either side of it, because rows in sequence share what a second visit does not
find again."""
SEARCH_STEP = 1.5
"""Factor by which the search changes one number."""
LEAST_GAIN_DB = 0.005
"""The search keeps what it has unless the held-out error falls by so much: less is chance, even over many rows."""
LEVER_STEP_M = 0.1
NOISE = "noise"
MOST_STEPS = 5
"""Of one number in one direction."""
TRUST = 500.0
"""So many held-out values count as much as the prior in what is read off their distribution."""
SKEW_TRUST = 2000.0
"""The same for the middle of their narrowest half, which is much less certain than a mean."""
RATIO = (0.5, 2.0)
"""A receiver's noise differs from the others' by a factor in between."""
COVERED = 0.9
NORMAL_90 = 1.6449
"""Half the width of the normal distribution's 90 % interval, in standard deviations."""


@dataclass(frozen=True)
class Hyperparameters:
    """The numbers that a fit may choose.

    Attributes:
        shadow_db, shadow_m, body_db, body_m, concentration: see `wrf_mi.models.physics.rssi_terms.Covariance`.
        drift_db: standard deviation of what is alike in all rows of a stop but not in a second visit.
        noise_db: of what is each row's own.
        lever_m: see `wrf_mi.models.physics.rssi_terms.Places.moved`.
    """

    shadow_db: float
    shadow_m: float
    body_db: float
    body_m: float
    concentration: float
    drift_db: float
    noise_db: float
    lever_m: float

    def changed(self, name: str, sign: int) -> Hyperparameters:
        """One number a step up or down; `NOISE` stands for both parts of the noise."""
        if name == "lever_m":
            return replace(self, lever_m=self.lever_m + sign * LEVER_STEP_M)
        names = ("drift_db", "noise_db") if name == NOISE else (name,)
        return replace(self, **{one: getattr(self, one) * SEARCH_STEP**sign for one in names})

    @property
    def covariance(self) -> Covariance:
        """Of the field."""
        return Covariance(self.shadow_db, self.shadow_m, self.body_db, self.body_m, self.concentration)


@dataclass(frozen=True)
class Base:
    """What is expected before anything is measured.

    Attributes:
        receivers_m: [n_rx, 3].
        transmit_dbm: power sent, gains of both antennas included.
        frequency_hz: of the carrier.
        traced: map of the traced power, or None: free space.
    """

    receivers_m: FloatArray
    transmit_dbm: float
    frequency_hz: float
    traced: PowerMap | None

    def columns(self, places: Places, receiver: int, priors: Priors) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Expected dBm [n], columns [n, k] of the mean's corrections, and their prior standard deviations [k]."""
        if self.traced is not None:
            power = self.traced(places.position_m, receiver)
            level = power - float(np.median(self.traced.power_dbm))
        else:
            distance = np.linalg.norm(self.receivers_m[receiver] - places.position_m, axis=1)
            at_1m = 20 * np.log10(speed_of_light / self.frequency_hz / (4 * np.pi))
            power, level = at_1m - 10 * FREE_SPACE * np.log10(np.maximum(distance, NEAREST_M)), None
        columns, sd = basis(places, receiver, self.receivers_m, level, priors)
        return self.transmit_dbm + power, columns, sd


class Field:
    """What some stops tell, with given numbers."""

    def __init__(
        self,
        base: Base,
        priors: Priors,
        hyperparameters: Hyperparameters,
        ratio: FloatArray,
        stops: Stops,
        rounds: int = 0,
    ) -> None:
        """Fit.

        Args:
            base: what is expected before.
            priors: of the mean's coefficients.
            hyperparameters: all else.
            ratio: of each receiver's noise to that of all, [n_rx].
            stops: what was measured; may be none.
            rounds: of reweighting for Student-t noise.
        """
        self.base, self.priors, self.hyperparameters, self.ratio, self.rounds = (
            base,
            priors,
            hyperparameters,
            ratio,
            rounds,
        )
        self.headings = stops.places.heading_rad is not None
        parts = []
        for receiver in range(len(base.receivers_m)):
            heard = np.isfinite(stops.value_dbm[receiver])
            places = stops.places.take(heard).moved(hyperparameters.lever_m)
            expected, columns, sd = base.columns(places, receiver, priors)
            variance = (
                hyperparameters.drift_db**2 + hyperparameters.noise_db**2 / stops.count[receiver, heard]
            ) * ratio[receiver] ** 2
            parts.append(Part(places, columns, stops.value_dbm[receiver, heard] - expected, variance))
        covariance = hyperparameters.covariance
        self._process: PooledProcess = fit_pooled(
            parts, covariance, sd, covariance.point(self.headings), DEGREES, rounds
        )

    def predict(self, places: Places, receiver: int) -> tuple[FloatArray, FloatArray]:
        """Mean in dBm, and variance of a single report about it before calibration, [m] each."""
        moved = places.moved(self.hyperparameters.lever_m)
        expected, columns, _ = self.base.columns(moved, receiver, self.priors)
        mean, variance = self._process.predict(receiver, moved, columns)
        noise = (self.hyperparameters.drift_db**2 + self.hyperparameters.noise_db**2) * self.ratio[receiver] ** 2
        return expected + mean, variance + noise


@dataclass(frozen=True)
class Measured:
    """Training rows; n of them.

    Attributes:
        places: of the rows.
        value_dbm: [n_rx, n], NaN where nothing was received.
        rows: numbers in the record, ascending.
        precision: relative to a single report [n_rx, n], see `wrf_mi.core.Record.precision`; None: 1.
    """

    places: Places
    value_dbm: FloatArray
    rows: IntArray
    precision: FloatArray | None = None

    def take(self, which: IntArray) -> Measured:
        """Some of them."""
        precision = None if self.precision is None else self.precision[:, which]
        return Measured(self.places.take(which), self.value_dbm[:, which], self.rows[which], precision)

    def folds(self) -> Iterator[tuple[IntArray, IntArray]]:
        """Rows that train and rows that are held out, as numbers into these.

        Held out are stretches of the record's order. Where that is the order of time, as in all that moves along a
        path, a stretch is predicted as another run would be: from other visits, not from the row before.
        """
        count = len(self.rows)
        stretch = int(np.clip(count // (2 * FOLDS), *STRETCH))
        buffer = int(stretch * BUFFER)
        number = np.arange(count) // stretch
        for fold in range(min(FOLDS, int(number[-1]) + 1)):
            out = number % FOLDS == fold
            near = out.copy()
            for step in range(1, buffer + 1):
                near[step:] |= out[:-step]
                near[:-step] |= out[step:]
            if not near.all():
                yield np.flatnonzero(~near), np.flatnonzero(out)


@dataclass(frozen=True)
class HeldOut:
    """Predictions of rows that did not train: mean in dBm and standard deviation in dB, [n_rx, n]; NaN where none."""

    mean_dbm: FloatArray
    std_db: FloatArray


Stopper = Callable[[Measured], Stops]


def stopper(reach_m: float, turn_rad: float, most: int) -> Stopper:
    """Joins rows into stops; see `wrf_mi.models.physics.rssi_terms.stops_of`."""
    return lambda own: stops_of(own.places, own.value_dbm, own.rows, reach_m, turn_rad, most, precision=own.precision)


class Fit:
    """Chooses on held-out stretches of the training rows."""

    def __init__(self, base: Base, priors: Priors, measured: Measured, stopper: Stopper) -> None:
        self.base, self.priors, self.measured, self.stopper = base, priors, measured, stopper
        self.ratio = np.ones(len(base.receivers_m))
        self._folds = [(stopper(measured.take(train)), held_out) for train, held_out in measured.folds()]

    def held_out(self, hyperparameters: Hyperparameters, rounds: int = 0) -> HeldOut:
        """Each row's prediction by the fold that did not have it."""
        mean = np.full(self.measured.value_dbm.shape, np.nan)
        std = mean.copy()
        for stops, out in self._folds:
            field = Field(self.base, self.priors, hyperparameters, self.ratio, stops, rounds)
            for receiver in range(len(mean)):
                heard = out[np.isfinite(self.measured.value_dbm[receiver, out])]
                if len(heard):
                    value, variance = field.predict(self.measured.places.take(heard), receiver)
                    mean[receiver, heard], std[receiver, heard] = value, np.sqrt(variance)
        return HeldOut(mean, std)

    def error_db(self, hyperparameters: Hyperparameters) -> float:
        """Mean absolute error on held-out rows; steadier than the median, which is what is scored."""
        return float(np.nanmean(np.abs(self.held_out(hyperparameters).mean_dbm - self.measured.value_dbm)))

    def set_ratio(self, hyperparameters: Hyperparameters) -> None:
        """Each receiver's noise, from the spread of its held-out residuals."""
        residual = self.held_out(hyperparameters).mean_dbm - self.measured.value_dbm
        known = np.isfinite(residual).sum(axis=1)
        spread = np.array(
            [np.median(np.abs(own[np.isfinite(own)])) if np.isfinite(own).any() else 1 for own in residual]
        )
        own = np.clip(spread / np.median(spread), *RATIO)
        weight = known / (known + TRUST)
        self.ratio = own**weight

    def search(
        self, hyperparameters: Hyperparameters, rounds: int, on_progress: Callable[[float], None]
    ) -> Hyperparameters:
        """Change one number at a time while that lowers the held-out error by `LEAST_GAIN_DB` at least.

        Args:
            hyperparameters: to begin with.
            rounds: through all numbers.
            on_progress: hears the share that is done.
        """
        names = ["shadow_db", "shadow_m", NOISE]
        if self.measured.places.heading_rad is not None:
            names += ["body_db", "body_m", "lever_m"]
        best, done = self.error_db(hyperparameters), 0
        for _ in range(rounds):
            for name in names:
                for sign in (1, -1):
                    for _ in range(MOST_STEPS):
                        candidate = hyperparameters.changed(name, sign)
                        error = self.error_db(candidate)
                        if error > best - LEAST_GAIN_DB:
                            break
                        best, hyperparameters = error, candidate
                done += 1
                on_progress(done / (rounds * len(names)))
        return hyperparameters


def shift_of(residual_db: FloatArray, prior_db: float = 0.0) -> float:
    """What to add to predictions so that half of the residuals (measured minus predicted) lie as near as can be.

    Fades reach deeper than peaks, so the narrowest half lies above the mean (the shorth). With few
    residuals, which tell little of that, the prior stands.

    Source: Andrews et al., "Robust Estimates of Location" (1972) (the shorth).
    """
    values = np.sort(residual_db[np.isfinite(residual_db)])
    half = len(values) // 2
    if half < 2:
        return prior_db
    # The middle of the narrowest half jumps about; the mean over halves of nearly that width does not.
    width = values[half:] - values[: len(values) - half]
    near = width <= width.min() * 1.01
    middle = (values[half:] + values[: len(values) - half])[near] / 2
    weight = len(values) / (len(values) + SKEW_TRUST)
    return float(weight * middle.mean() + (1 - weight) * prior_db)


def widening(residual_db: FloatArray, std_db: FloatArray) -> FloatArray:
    """Factor of each receiver's standard deviations by which 90 % of its held-out residuals lie in the interval.

    A receiver with few of them takes that of all; few of all take one.
    """
    score = np.abs(residual_db) / std_db / NORMAL_90
    known = np.isfinite(score)
    if not known.any():
        return np.ones(len(score))

    def quantile(values: FloatArray, prior: float) -> float:
        weight = len(values) / (len(values) + TRUST / 5)
        return float(np.quantile(values, COVERED) ** weight * prior ** (1 - weight)) if len(values) else prior

    pooled = quantile(score[known], 1.0)
    return np.array([quantile(own[which], pooled) for own, which in zip(score, known, strict=True)])
