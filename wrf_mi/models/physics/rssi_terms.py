"""What a signal strength is made of: the law of distance or the traced power, patterns, shadowing.

    y = base(x) + offset + slope . law(x) + tx(psi) + rx(phi) + f(x, heading) + e

base is the traced power where there is a scene, else free space. All coefficients have a part that the receivers share
and one of their own with a smaller prior, so that six receivers teach each other: psi is the bearing of the receiver
in the transmitter's body (its antenna and what carries it are the same for all), phi the bearing itself (the
receiver's own pattern). f is shadowing, exponential in distance, and a part that depends on how the body is turned.

Source: Gudmundson, "Correlation model for shadow fading in mobile radio systems" (1991), Electronics Letters 27(23)
(the exponential covariance); Rappaport, "Wireless Communications" (2002), section 4.9 (the law of distance).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from ...core.angles import FloatArray
from ...core.types import IntArray

NEAREST_M = 0.05
"""Distances are not taken below that: no antenna is a point."""
HARMONICS = 3
"""Of the transmitter's pattern over psi; more changed the error on held-out stretches of flat-ble by under 0.005 dB."""
RX_HARMONICS = 2


@dataclass(frozen=True)
class Places:
    """Where and how turned the transmitter is; n of them.

    Attributes:
        position_m: [n, 3].
        heading_rad: [n], or None where the data have none.
    """

    position_m: FloatArray
    heading_rad: FloatArray | None

    def __len__(self) -> int:
        """How many."""
        return len(self.position_m)

    def take(self, which: NDArray[np.bool_] | IntArray) -> Places:
        """Some of them."""
        heading = None if self.heading_rad is None else self.heading_rad[which]
        return Places(self.position_m[which], heading)

    def moved(self, lever_m: float) -> Places:
        """The places ``lever_m`` further along the headings: where the antenna is, or was when it was heard."""
        if self.heading_rad is None or lever_m == 0:
            return self
        ahead = np.stack([np.cos(self.heading_rad), np.sin(self.heading_rad), np.zeros(len(self))], axis=-1)
        return replace(self, position_m=self.position_m + lever_m * ahead)


@dataclass(frozen=True)
class Covariance:
    """Covariance of f between two places, dB^2.

    s^2 exp(-d / l) + b^2 exp(-d / m) exp(c (cos(h - h') - 1)), d the distance, h the headings.

    Attributes:
        shadow_db: s.
        shadow_m: l.
        body_db: b.
        body_m: m.
        concentration: c.
    """

    shadow_db: float
    shadow_m: float
    body_db: float
    body_m: float
    concentration: float

    def __call__(self, here: Places, there: Places) -> FloatArray:
        """Shape [n, m]."""
        distance = cdist(here.position_m, there.position_m)
        covariance = self.shadow_db**2 * np.exp(-distance / self.shadow_m)
        if here.heading_rad is not None and there.heading_rad is not None:
            turn = np.cos(here.heading_rad[:, None] - there.heading_rad[None]) - 1
            covariance += self.body_db**2 * np.exp(self.concentration * turn - distance / self.body_m)
        return covariance

    def point(self, headings: bool) -> float:
        """Variance at one place, with or without the body's part."""
        return self.shadow_db**2 + (self.body_db**2 if headings else 0)


@dataclass(frozen=True)
class Priors:
    """Standard deviations of the coefficients, dB or a slope without unit: of the shared part and of each receiver's.

    Attributes:
        offset: of what the decibels count from.
        slope: of the exponent of distance about that of the base.
        traced: of the factor of the traced power about one; unused without a scene.
        tx: of the first harmonic over psi, dB; the k-th has 1 / k of it.
        rx: of the first harmonic over phi, each receiver's own.
    """

    offset: tuple[float, float]
    slope: tuple[float, float]
    traced: tuple[float, float]
    tx: tuple[float, float]
    rx: float


def basis(
    places: Places,
    receiver: int,
    receivers_m: FloatArray,
    traced_dbm: FloatArray | None,
    priors: Priors,
) -> tuple[FloatArray, FloatArray]:
    """Columns of the mean and the prior standard deviations of their coefficients.

    Args:
        places: n of them.
        receiver: whose columns; those of other receivers' own parts are zero.
        receivers_m: positions of all [n_rx, 3].
        traced_dbm: local mean of the traced power at the places [n], less a typical level; None without a scene.
        priors: see `Priors`.

    Returns:
        Columns [n, k] and standard deviations [k]; k is the same for all receivers.
    """
    away = receivers_m[receiver] - places.position_m
    flat = np.hypot(away[:, 0], away[:, 1])
    distance = np.maximum(np.linalg.norm(away, axis=1), NEAREST_M)
    bearing = np.arctan2(away[:, 1], away[:, 0])
    columns: list[FloatArray] = []
    sd: list[float] = []

    def add(column: FloatArray, shared: float, own: float) -> None:
        if shared > 0:
            columns.append(column)
            sd.append(shared)
        if own > 0:
            columns.extend(column if k == receiver else np.zeros(len(column)) for k in range(len(receivers_m)))
            sd.extend([own] * len(receivers_m))

    add(np.ones(len(places)), *priors.offset)
    add(-10 * np.log10(distance), *priors.slope)
    if traced_dbm is not None:
        add(traced_dbm, *priors.traced)
    if places.heading_rad is not None:
        # A receiver overhead is seen under no bearing: the pattern's part that depends on it must vanish there.
        level = flat / distance
        for k in range(1, HARMONICS + 1):
            for wave in (np.cos, np.sin):
                add(wave(k * (bearing - places.heading_rad)) * level, priors.tx[0] / k, priors.tx[1] / k)
    for k in range(1, RX_HARMONICS + 1):
        for wave in (np.cos, np.sin):
            add(wave(k * bearing), 0, priors.rx / k)
    return np.stack(columns, axis=1), np.array(sd)


@dataclass(frozen=True)
class Stops:
    """Rows in sequence that were taken at one place, as one: s stops.

    Attributes:
        places: mean positions and headings.
        value_dbm: median of what each receiver reported, weighted by precision, [n_rx, s]; NaN where it received
            nothing.
        count: precision of that in those of a single report: without stated noise the number of reports, [n_rx, s].
        row: the middle row, as a number in the record's order, [s].
    """

    places: Places
    value_dbm: FloatArray
    count: FloatArray
    row: FloatArray

    def take(self, which: NDArray[np.bool_] | IntArray) -> Stops:
        """Some of them."""
        return Stops(self.places.take(which), self.value_dbm[:, which], self.count[:, which], self.row[which])


def stops_of(
    places: Places,
    value_dbm: FloatArray,
    rows: IntArray,
    reach_m: float,
    turn_rad: float,
    most: int,
    gap: int = 5,
    precision: FloatArray | None = None,
) -> Stops:
    """Join rows that follow each other at one place.

    Fading that stays while the transmitter stands is the same in all of them: a hundred reports of one stop tell
    little more of the place than ten, and less than those of a second visit.

    Args:
        places: of the rows.
        value_dbm: [n_rx, n].
        rows: their numbers in the record, ascending, [n].
        reach_m: a stop ends where the transmitter is so far from where it began.
        turn_rad: or has turned by so much.
        most: rows of a stop at most.
        gap: or where so many rows of the record are not among these.
        precision: of each report relative to a single one [n_rx, n], see `wrf_mi.core.Record.precision`; None: 1.
    """
    weight = np.ones(value_dbm.shape) if precision is None else precision
    number = np.zeros(len(rows), np.int64)
    first = 0
    for k in range(1, len(rows)):
        far = np.linalg.norm(places.position_m[k] - places.position_m[first]) > reach_m
        turned = False
        if places.heading_rad is not None:
            turned = abs(_wrapped(places.heading_rad[k] - places.heading_rad[first])) > turn_rad
        if far or turned or k - first >= most or rows[k] - rows[k - 1] > gap:
            first = k
        number[k] = number[k - 1] + (first == k)
    count = int(number[-1]) + 1 if len(rows) else 0
    size = np.maximum(np.bincount(number, minlength=count), 1)

    def mean(values: FloatArray) -> FloatArray:
        return np.bincount(number, values, minlength=count) / size

    position = np.stack([mean(axis) for axis in places.position_m.T], axis=-1)
    heading = None
    if places.heading_rad is not None:
        heading = np.arctan2(mean(np.sin(places.heading_rad)), mean(np.cos(places.heading_rad)))
    begins = np.searchsorted(number, np.arange(count + 1))
    value = np.full((len(value_dbm), count), np.nan)
    heard = np.zeros((len(value_dbm), count))
    for stop in range(count):
        for receiver, own in enumerate(value_dbm[:, begins[stop] : begins[stop + 1]]):
            known = np.isfinite(own)
            if known.any():
                share = weight[receiver, begins[stop] : begins[stop + 1]][known]
                value[receiver, stop], heard[receiver, stop] = _median(own[known], share), share.sum()
    return Stops(Places(position, heading), value, heard, mean(rows.astype(float)))


def _median(values: FloatArray, weight: FloatArray) -> float:
    """Weighted median [n] -> 1: half of the weight lies below; the middle of two values where it does so between."""
    order = np.argsort(values)
    ordered, below = values[order], np.cumsum(weight[order])
    half = below[-1] / 2
    first, last = np.searchsorted(below, half, side="left"), np.searchsorted(below, half, side="right")
    return float((ordered[first] + ordered[min(last, len(ordered) - 1)]) / 2)


def _wrapped(angle_rad: float) -> float:
    return float(np.angle(np.exp(1j * angle_rad)))
