"""Terms of a signal strength: law of distance or traced power, patterns, shadowing.

    y = base(x) + offset + slope . law(x) + tx(psi) + rx(phi) + f(x, heading) + e

base is the local mean of traced power (`wrf_mi.tracing.power_map`) where there is a scene, else free space. Every
coefficient is the sum of a part common to all receivers and a part of each receiver with a smaller prior. psi is the
bearing of the receiver in the transmitter's body (whose pattern is common to all receivers), phi the bearing in the
world (the receiver's pattern). f is shadowing, exponential in distance, and a part that depends on the heading of the
body.

Source: Gudmundson, "Correlation model for shadow fading in mobile radio systems" (1991), Electronics Letters 27(23)
(the exponential covariance); Rappaport, "Wireless Communications" (2002), section 4.9 (the law of distance).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from ...core.angles import FloatArray
from ...core.settings import Finite, Positive
from ...core.types import IntArray
from .path_loss import NEAREST_M
from .pooled_process import Basis

HARMONICS = 3
"""Harmonics of the transmitter's pattern over psi; more changed the held-out error of flat-ble by under 0.005 dB."""
RX_HARMONICS = 2  # harmonics of each receiver's pattern, which its rows alone determine
GAP = 5  # a stop ends where so many rows of the record are not among the given rows
PARTS_OF_NOISE = ("drift_db", "noise_db")
OF_HEADINGS = ("body_db", "body_m", "concentration", "lever_m")  # hyperparameters that count with headings alone
NO_RUN = -1  # number of the run of a row that states none
MOST_PAIRS = 2
"""Pairs of a distinct position and a distinct heading, relative to the poses, up to which all pairs are evaluated."""


@dataclass(frozen=True)
class Poses:
    """Positions [n, 3] and headings [n] of the transmitter; None where the data have no headings.

    ``run`` [n] is the number of the run of the measurement, see `run_numbers`; None where runs do not matter.
    """

    position_m: FloatArray
    heading_rad: FloatArray | None = None
    run: IntArray | None = None

    def __len__(self) -> int:
        """Number of poses."""
        return len(self.position_m)

    def take(self, which: NDArray[np.bool_] | IntArray) -> Poses:
        """The poses of a mask or of indices."""
        heading = None if self.heading_rad is None else self.heading_rad[which]
        return Poses(self.position_m[which], heading, None if self.run is None else self.run[which])

    def moved(self, lever_m: float) -> Poses:
        """The poses displaced by ``lever_m`` along their headings, to the antenna."""
        if self.heading_rad is None or lever_m == 0:
            return self
        ahead = np.stack([np.cos(self.heading_rad), np.sin(self.heading_rad), np.zeros(len(self))], axis=-1)
        return replace(self, position_m=self.position_m + lever_m * ahead)


@dataclass(frozen=True)
class Hyperparameters:
    """Parameters of field and noise that a fit may choose.

    The covariance of the field is s^2 exp(-d / l) + b^2 exp(-d / m) exp(c (cos(h - h') - 1)) in dB^2, d being the
    distance and h the headings.

    Attributes:
        shadow_db: s, standard deviation of shadowing.
        shadow_m: l, its correlation length.
        body_db: b, standard deviation of the heading's effect that varies with the position.
        body_m: m, its correlation length.
        concentration: c, concentration of that effect in the heading.
        drift_db: standard deviation of noise common to all rows of a stop.
        noise_db: standard deviation of noise of each row.
        lever_m: distance of the antenna ahead of the stated position, see `Poses.moved`.
    """

    shadow_db: Positive = 4.5
    shadow_m: Positive = 2.0
    body_db: float = 1.5
    body_m: Positive = 1.5
    concentration: float = 1.0
    drift_db: float = 2.8
    noise_db: Positive = 2.8
    lever_m: Finite = 0.0

    def covariance(self, a: Poses, b: Poses) -> FloatArray:
        """Covariance of the field [n, m] between poses, dB^2."""
        distance = cdist(a.position_m, b.position_m)
        covariance = self.shadow_db**2 * np.exp(distance / -self.shadow_m)
        if a.heading_rad is not None and b.heading_rad is not None:
            # cos(h - h') is the product of unit vectors: no cosine of each pair.
            turn = _directions(a.heading_rad) @ _directions(b.heading_rad).T
            distance /= self.body_m
            turn *= self.concentration
            turn -= self.concentration
            turn -= distance
            covariance += self.body_db**2 * np.exp(turn, out=turn)
        return np.asarray(covariance)

    def weighted_covariance(self, a: Poses, b: Poses, weights: FloatArray) -> FloatArray:
        """Covariances times weights [m], shape [n]; positions and headings that repeat are evaluated once."""
        if a.heading_rad is None:
            return np.asarray(self.covariance(a, b) @ weights)
        places, place = np.unique(a.position_m, axis=0, return_inverse=True)
        turns, turn = np.unique(a.heading_rad, return_inverse=True)
        if len(places) * len(turns) > MOST_PAIRS * len(a):
            return np.asarray(self.covariance(a, b) @ weights)
        # A map has every position at every heading: the body's part factors into one of positions and one of headings.
        distance = cdist(places, b.position_m)
        total = np.asarray(self.shadow_db**2 * (np.exp(-distance / self.shadow_m) @ weights))[place.ravel()]
        if b.heading_rad is not None:
            shares = np.exp(self.concentration * (np.cos(turns[:, None] - b.heading_rad) - 1)) * weights
            body = self.body_db**2 * (np.exp(-distance / self.body_m) @ shares.T)
            total = total + body[place.ravel(), turn]
        return total

    def variance(self, headings: bool) -> float:
        """Variance of the field, with or without the part that depends on headings, dB^2."""
        return self.shadow_db**2 + (self.body_db**2 if headings else 0)


def _directions(heading_rad: FloatArray) -> FloatArray:
    """Unit vectors [n, 2]."""
    return np.stack([np.cos(heading_rad), np.sin(heading_rad)], axis=1)


def run_numbers(runs: NDArray[np.str_], names: Sequence[str]) -> IntArray:
    """Number of each of some runs [n] among names: the number of names for another one, `NO_RUN` for none."""
    number = {name: place for place, name in enumerate(names)} | {"": NO_RUN}
    distinct, place = np.unique(runs, return_inverse=True)
    return np.array([number.get(str(name), len(names)) for name in distinct], np.int64)[place.reshape(-1)]


def basis(
    poses: Poses,
    receiver: int,
    receivers_m: FloatArray,
    traced_dbm: FloatArray | None,
    sd: FloatArray,
    rx_sd_db: float,
) -> tuple[Basis, FloatArray]:
    """Columns of the mean for n poses, and the prior standard deviations of the coefficients of all receivers [k].

    ``traced_dbm`` [n] is the local mean of the traced power less a typical level, None without a scene. ``sd`` [4, 2]
    holds the deviations of the part common to all receivers and of each receiver's part: offset in dB, exponent of
    distance, factor of the traced power, first harmonic over psi in dB (the k-th has 1 / k of it); ``rx_sd_db`` that of
    the first harmonic over phi.
    """
    away = receivers_m[receiver] - poses.position_m
    distance = np.maximum(np.linalg.norm(away, axis=1), NEAREST_M)
    bearing = np.arctan2(away[:, 1], away[:, 0])
    terms = [(np.ones(len(poses)), *sd[0]), (-10 * np.log10(distance), *sd[1])]
    if traced_dbm is not None:
        terms.append((traced_dbm, *sd[2]))
    if poses.heading_rad is not None:
        # A receiver overhead has no bearing: the part of the pattern that depends on it must vanish there.
        level = np.hypot(away[:, 0], away[:, 1]) / distance
        for k in range(1, HARMONICS + 1):
            for wave in (np.cos, np.sin):
                terms.append((wave(k * (bearing - poses.heading_rad)) * level, *(sd[3] / k)))
    for k in range(1, RX_HARMONICS + 1):
        terms += [(wave(k * bearing), 0, rx_sd_db / k) for wave in (np.cos, np.sin)]
    # The part of each term that is common to all receivers, and that of each; a deviation of 0: there is no such part.
    count, columns, used, deviations = len(receivers_m), list[FloatArray](), list[int](), list[float]()
    for column, common, each in terms:
        for deviation, size, index in ((common, 1, 0), (each, count, receiver)):
            if deviation > 0:
                columns.append(column)
                used.append(len(deviations) + index)
                deviations += [deviation] * size
    return Basis(np.stack(columns, axis=1), np.array(used)), np.array(deviations)


@dataclass(frozen=True)
class Measured:
    """Training rows: poses, dBm [n_rx, n] (NaN where nothing was received), ascending numbers in the record [n].

    ``precision`` [n_rx, n] is relative to a single observation, see `wrf_mi.core.Record.precision`; None: 1.
    """

    poses: Poses
    value_dbm: FloatArray
    rows: IntArray
    precision: FloatArray | None = None

    def take(self, which: IntArray) -> Measured:
        """The rows of indices."""
        precision = None if self.precision is None else self.precision[:, which]
        return Measured(self.poses.take(which), self.value_dbm[:, which], self.rows[which], precision)


@dataclass(frozen=True)
class Stops:
    """Consecutive rows at one pose, joined; s stops.

    ``value_dbm`` [n_rx, s] is the median of each receiver's observations, weighted by precision (NaN where it received
    nothing), ``count`` [n_rx, s] the sum of these precisions, and ``row`` [s] the middle row in the record's order.
    """

    poses: Poses
    value_dbm: FloatArray
    count: FloatArray
    row: FloatArray

    def at_receivers(self, receivers: IntArray) -> Stops:
        """The stops at which one of some receivers received something, with these receivers alone."""
        which = np.flatnonzero(np.isfinite(self.value_dbm[receivers]).any(axis=0))
        chosen = np.ix_(receivers, which)
        return Stops(self.poses.take(which), self.value_dbm[chosen], self.count[chosen], self.row[which])

    def thinned(self, most: int) -> Stops:
        """At most ``most`` stops, evenly spaced."""
        if len(self.poses) <= most:
            return self
        which = np.linspace(0, len(self.poses) - 1, most).round().astype(np.int64)
        return Stops(self.poses.take(which), self.value_dbm[:, which], self.count[:, which], self.row[which])


def stops_of(measured: Measured, reach_m: float, turn_rad: float, most: int) -> Stops:
    """Join consecutive rows at one pose, at most ``most`` within ``reach_m`` and ``turn_rad`` of the first.

    Fading that persists while the transmitter stands is common to them: a hundred observations of one stop say little
    more of the position than ten, and less than those of a second visit.
    """
    position, heading, value_dbm = measured.poses.position_m, measured.poses.heading_rad, measured.value_dbm
    weight = np.ones(value_dbm.shape) if measured.precision is None else measured.precision
    number = stop_numbers(measured, reach_m, turn_rad, most)
    count = int(number.max(initial=-1)) + 1
    size = np.maximum(np.bincount(number, minlength=count), 1)

    def mean(values: FloatArray) -> FloatArray:
        return np.bincount(number, values, minlength=count) / size

    centre = np.stack([mean(axis) for axis in position.T], axis=-1)
    # Headings are averaged as unit vectors: they wrap around.
    direction = None if heading is None else np.arctan2(mean(np.sin(heading)), mean(np.cos(heading)))
    begins = np.searchsorted(number, np.arange(count + 1))
    received = np.isfinite(value_dbm)

    def sums(values: NDArray[Any]) -> NDArray[Any]:
        return np.add.reduceat(np.where(received, values, 0), begins[:-1], axis=1) if count else values

    observations, total = sums(received.astype(int)), sums(weight)
    value = np.where(observations == 1, sums(value_dbm), np.nan)
    for receiver, stop in np.argwhere(observations > 1):
        chunk = slice(begins[stop], begins[stop + 1])
        heard = received[receiver, chunk]
        # A median, as fades skew the observations of a stop.
        value[receiver, stop] = _median(value_dbm[receiver, chunk][heard], weight[receiver, chunk][heard])
    run = None if measured.poses.run is None else measured.poses.run[begins[:-1]]
    return Stops(Poses(centre, direction, run), value, total, mean(measured.rows.astype(float)))


def stop_numbers(measured: Measured, reach_m: float, turn_rad: float, most: int) -> IntArray:
    """Number of the stop of each row [n] before any are thinned out, see `stops_of`."""
    position, heading, rows = measured.poses.position_m.tolist(), measured.poses.heading_rad, measured.rows
    number, first, run = np.zeros(len(rows), np.int64), 0, measured.poses.run
    for k in range(1, len(rows)):
        # From the first row of the stop, not the previous one: a slow walk is many stops.
        far = math.dist(position[k], position[first]) > reach_m
        turned = heading is not None and abs(np.angle(np.exp(1j * (heading[k] - heading[first])))) > turn_rad
        other = run is not None and run[k] != run[first]
        if far or turned or other or k - first >= most or rows[k] - rows[k - 1] > GAP:
            first = k
        number[k] = number[k - 1] + (first == k)
    return number


def _median(values: FloatArray, weight: FloatArray) -> float:
    """Weighted median; the middle of two values between which half of the weight lies below."""
    order = np.argsort(values)
    ordered, below = values[order], np.cumsum(weight[order])
    first, last = (np.searchsorted(below, below[-1] / 2, side=side) for side in ("left", "right"))
    return float((ordered[first] + ordered[min(last, len(ordered) - 1)]) / 2)
