"""Received signal strength: expectation by mesh (`PowerMap`) or free space, corrected by measurements.

``docs/physics.md`` has the corrections. Their common parts are in `rssi_terms`; hyperparameters, the noise of each
receiver, and the calibration of predictions come from held-out stretches of the training rows (`rssi_fit`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core import InputError, Receiver, Record, receiver_arrays, stored_receivers
from ...core.angles import FloatArray
from ...core.settings import CheckedSettings, Count, Finite, Positive
from ...core.types import IntArray
from ...tasks import require
from ...training.session import OnProgress, quiet
from ..model import Arrays, field_arrays, from_field_arrays
from .rssi_fit import Field, Fit, PriorMean, shift_of, widening
from .rssi_terms import Hyperparameters, Measured, Poses, PowerMap, Stops, stops_of, trace_map
from .selection import PhysicsModel, physics_model

HEADINGS = 8
"""Headings over which the prediction is averaged where the heading is unknown."""
ROBUST_ROUNDS = 2
WIDER = 2.0
"""Factor of the stops' extent during the search, which takes a third of the time for the same choice."""


@dataclass(frozen=True)
class RssiSettings(CheckedSettings, Hyperparameters):
    """Settings of the fit of an RSSI physics model: hyperparameters at the start of the search, and the following.

    Attributes:
        transmit_dbm: transmit power a priori, gains of both antennas included.
        offset_sd_db: standard deviation of the common offset of all receivers.
        receiver_sd_db: standard deviation of each receiver's offset from the common one.
        exponent_sd: standard deviation of the exponent of distance about that of the expected value.
        traced_sd: standard deviation of the factor of the traced decibels about one.
        body_pattern_db: first harmonic of the transmitter's pattern, standard deviation; 0: none.
        receiver_pattern_db: first harmonic of each receiver's pattern, standard deviation; 0: none.
        skew_db: shift of predictions a priori, as fades reach deeper than peaks.
        search_rows: least number of training rows with which held-out rows choose hyperparameters.
        search_rounds: rounds of that search; 0: none.
        stop_m: consecutive rows within that distance are joined.
        stop_rad: and within that turn.
        stop_rows: and at most so many.
        spacing_m: spacing of the traced grid.
        smooth_m: standard deviation of the Gaussian over which the traced power is averaged.
        max_depth: interactions of a traced path, transmissions included.
        max_reflections: reflections of a traced path.
    """

    transmit_dbm: Finite = 0.0
    offset_sd_db: Positive = 10.0
    receiver_sd_db: Positive = 4.0
    exponent_sd: float = 1.0
    traced_sd: float = 0.5
    body_pattern_db: float = 1.0
    receiver_pattern_db: float = 2.0
    skew_db: Finite = 0.4
    search_rows: int = 500
    search_rounds: int = 1
    stop_m: float = 0.1
    stop_rad: float = 0.2
    stop_rows: Count = 20
    spacing_m: Positive = 0.25
    smooth_m: float = 0.3
    max_depth: int = 6
    max_reflections: int = 2

    @property
    def hyperparameters(self) -> Hyperparameters:
        """Start of the search."""
        return Hyperparameters(**{one.name: getattr(self, one.name) for one in fields(Hyperparameters)})

    def prior_sd(self, traced: bool) -> FloatArray:
        """Standard deviations of the mean's coefficients with or without a traced map, see `rssi_terms.basis`."""
        exponent, traced_sd = np.array([1, 0.3]) * self.exponent_sd, np.array([1, 0.4]) * self.traced_sd * traced
        body = np.array([1, 0.2]) * self.body_pattern_db
        return np.array([(self.offset_sd_db, self.receiver_sd_db), exponent, traced_sd, body])


@dataclass(eq=False, repr=False)
class RssiPhysics(PhysicsModel):
    """A fitted RSSI physics model; made by `fit_rssi`. Standard deviations are those of a single report.

    Attributes:
        receivers: in the record's order.
        field: posterior of the signal strengths.
        shift_db: shift of predictions.
        widen: factor of each receiver's standard deviations [n_rx].
        fit_facts: entries of `summary` about the fit.
    """

    receivers: tuple[Receiver, ...]
    field: Field
    shift_db: float
    widen: FloatArray
    fit_facts: dict[str, float]

    @property
    def uses_heading(self) -> bool:
        """Whether the training rows had headings."""
        return self.field.headings

    def predict_mean(
        self, tx_pos_m: ArrayLike, receiver: int | str = 0, tx_heading_rad: ArrayLike | None = None
    ) -> NDArray[Any]:
        """The mean of `predict` in a fraction of its time: variances take the most of that."""
        positions, index, heading = self._checked(tx_pos_m, receiver, tx_heading_rad)
        mean = np.empty(len(positions))
        for begin in range(0, len(positions), self.chunk_size):
            rows = slice(begin, begin + self.chunk_size)
            headings = self._headings(len(positions[rows]), None if heading is None else heading[rows])
            means = [self.field.mean(Poses(positions[rows], turn), index) for turn in headings]
            mean[rows] = np.mean(means, axis=0) + self.shift_db
        return mean

    def _headings(self, count: int, heading_rad: FloatArray | None) -> list[FloatArray | None]:
        """Headings that predictions are averaged over: the given ones, or several where they count and are unknown."""
        if heading_rad is None and self.uses_heading:
            return [np.full(count, turn) for turn in 2 * np.pi * np.arange(HEADINGS) / HEADINGS]
        return [heading_rad]

    def _predict(self, tx_pos_m: FloatArray, receiver: int, heading_rad: FloatArray | None) -> tuple[Any, Any]:
        headings = self._headings(len(tx_pos_m), heading_rad)
        means, variances = zip(*(self.field.predict(Poses(tx_pos_m, h), receiver) for h in headings), strict=True)
        variance = np.mean(variances, axis=0) * self.widen[receiver] ** 2 + np.var(means, axis=0)
        return np.mean(means, axis=0) + self.shift_db, np.sqrt(variance)

    def arrays(self) -> Arrays:
        """Arrays for `from_arrays`."""
        field = self.field
        stops, prior = field.stops, field.prior
        arrays: dict[str, Any] = {
            **receiver_arrays(self.receivers),
            **field_arrays(stops.poses, "stop."),
            **{f"stop.{name}": getattr(stops, name) for name in ("value_dbm", "count", "row")},
            "base": np.array([prior.transmit_dbm, prior.frequency_hz]),
            "prior.shared": prior.sd,
            "prior.rx": prior.rx_sd_db,
            "ratio": field.ratio,
            "rounds": field.rounds,
            "shift_db": self.shift_db,
            "widen": self.widen,
            "fact.name": np.array(list(self.fit_facts)),
            "fact.value": np.array(list(self.fit_facts.values()), float),
            **field_arrays(field.hyperparameters, "knob."),
        }
        if prior.traced is not None:
            arrays |= field_arrays(prior.traced, "map.")
        return {name: np.asarray(value) for name, value in arrays.items()}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> RssiPhysics:
        """The model that `arrays` stored."""
        traced = from_field_arrays(PowerMap, arrays, "map.") if "map.power_dbm" in arrays else None
        transmit_dbm, frequency_hz = map(float, arrays["base"])
        sd, rx_sd_db = arrays["prior.shared"], float(arrays["prior.rx"])
        prior = PriorMean(arrays["receiver_position_m"], transmit_dbm, frequency_hz, traced, sd, rx_sd_db)
        hyperparameters = from_field_arrays(Hyperparameters, arrays, "knob.")
        stops = Stops(
            from_field_arrays(Poses, arrays, "stop."),
            arrays["stop.value_dbm"],
            arrays["stop.count"],
            arrays["stop.row"],
        )
        field = Field(prior, hyperparameters, arrays["ratio"], stops, int(arrays["rounds"]))
        facts = dict(zip(map(str, arrays["fact.name"]), map(float, arrays["fact.value"]), strict=True))
        return cls(stored_receivers(arrays), field, float(arrays["shift_db"]), arrays["widen"], facts)

    def summary(self) -> dict[str, Any]:
        """Hyperparameters, calibration, and error on held-out rows."""
        return {
            "stops": len(self.field.stops.poses),
            "traced": self.field.prior.traced is not None,
            "headings": self.field.headings,
            **asdict(self.field.hyperparameters),
            "noise_ratio": [float(ratio) for ratio in self.field.ratio],
            "shift_db": self.shift_db,
            "widen": [float(factor) for factor in self.widen],
            **self.fit_facts,
        }


def fit_rssi(
    record: Record,
    rows: IntArray,
    scene: Any | None,
    settings: RssiSettings = RssiSettings(),
    seed: int = 0,
    on_progress: OnProgress = quiet,
) -> RssiPhysics:
    """Fit an RSSI physics model to ``rows`` of a record; arguments as ``fit`` of `physics_model`.

    Rows should be in the order of time (`wrf_mi.models.physics.rssi_fit.folds`); without rows the scene alone predicts,
    without a scene free space is expected. Nothing is drawn, so ``seed`` is unused.

    Raises:
        InputError: a record of another task or without its frequency, or neither rows nor a scene.
    """
    require(record, "rssi", why="this physics model predicts signal strengths")
    if record.frequencies_hz is None:
        text = "carrier frequency unknown, which the physics model needs; state it in the data"
        raise InputError(f"{record.name}: {text}")
    rows = np.unique(np.asarray(rows, np.int64))
    values = np.asarray(record.observation[:, rows], float)
    received = np.isfinite(values).any(axis=0)
    rows, values = rows[received], values[:, received]
    if not len(rows) and scene is None:
        raise InputError(f"{record.name}: neither a training row that was received nor a scene; give one of them")
    traced = None
    if scene is not None:
        on_progress("tracing a map", 0.0)
        shape = settings.spacing_m, settings.smooth_m, settings.max_depth, settings.max_reflections
        traced = trace_map(scene, record, *shape)
    receivers_m = np.stack([receiver.position_m for receiver in record.receivers]).astype(float)
    carrier_hz, prior_sd = float(np.mean(record.frequencies_hz)), settings.prior_sd(traced is not None)
    prior = PriorMean(receivers_m, settings.transmit_dbm, carrier_hz, traced, prior_sd, settings.receiver_pattern_db)
    heading = None if record.tx_heading_rad is None else np.asarray(record.tx_heading_rad, float)[rows]
    poses = Poses(np.asarray(record.tx_pos_m, float)[rows], heading)
    measured = Measured(poses, values, rows, record.precision(rows))
    hyperparameters = settings.hyperparameters

    def join(rows: Measured, factor: float = 1.0) -> Stops:
        return stops_of(rows, factor * settings.stop_m, factor * settings.stop_rad, settings.stop_rows)

    ratio, widen = np.ones((2, len(receivers_m)))
    shift, facts = settings.skew_db, {"rows": float(len(rows))}
    if len(rows) > 1:
        if settings.search_rounds and len(rows) >= settings.search_rows:
            search = Fit(prior, measured, partial(join, factor=WIDER))
            search.set_ratio(hyperparameters)
            hyperparameters = search.search(
                hyperparameters, settings.search_rounds, lambda share: on_progress("choosing", 0.1 + 0.7 * share)
            )
        fit = Fit(prior, measured, join)
        fit.set_ratio(hyperparameters)
        on_progress("predicting held-out rows", 0.8)
        mean, std = fit.held_out(hyperparameters, ROBUST_ROUNDS)
        residual = values - mean
        shift, ratio = shift_of(residual, settings.skew_db), fit.ratio
        widen = widening(residual - shift, std)
        if np.isfinite(residual).any():
            facts["held_out_db"] = float(np.nanmedian(np.abs(residual - shift)))
    on_progress("fitting all rows", 0.9)
    stops = join(measured)
    field = Field(prior, hyperparameters, ratio, stops, ROBUST_ROUNDS)
    on_progress("done", 1.0)
    return RssiPhysics(record.receivers, field, shift, widen, facts)


# Readings that a receiver did not report at a stop.
MODEL = physics_model("rssi", RssiSettings, fit_rssi, RssiPhysics.from_arrays, gaps=("stop.value_dbm",))
