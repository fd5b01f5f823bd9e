"""Received signal strength: what a mesh and physics expect, corrected by what was measured.

1. The traced power, averaged over a neighbourhood, is the expected value (`rssi_map`); without a mesh free space is.
2. An offset of each receiver, the exponent of the distance, the transmitter's pattern in its body and each receiver's
   pattern correct it; what receivers have in common is learned from all of them (`rssi_terms`).
3. Shadowing and the body's effect at a place are a Gaussian process (`gaussian_process`).
4. Its numbers, the noise of each receiver, and how far predictions are off, come from held-out stretches of the
   training rows (`rssi_fit`).

With few rows the priors carry; with none the mesh alone does, and the standard deviation says how little that is.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core import InputError, Prediction, Receiver, Record, receiver_arrays, stored_receivers
from ...core.angles import FloatArray
from ...core.receivers import receiver_index
from ...core.types import IntArray
from ...tasks import require
from .rssi_fit import Base, Field, Fit, Hyperparameters, Measured, shift_of, stopper, widening
from .rssi_map import PowerMap, trace_map
from .rssi_terms import Places, Priors, Stops

OnProgress = Callable[[str, float], None]

HEADINGS = 8
"""Over so many the prediction is averaged where the heading is not told."""
ROBUST_ROUNDS = 2
WIDER = 2.0
"""While numbers are chosen, stops are so much wider: a third of the time for the same choice."""
CHUNK_SIZE = 1024


@dataclass(frozen=True)
class RssiSettings:
    """How an RSSI physics model is fitted.

    Attributes:
        transmit_dbm: power sent, gains of both antennas included, before anything is measured.
        offset_sd_db: standard deviation of what the decibels of all receivers count from.
        receiver_sd_db: of what one receiver's differ by from the others'.
        exponent_sd: standard deviation of the exponent of distance about that of the expected value.
        traced_sd: of the factor of the traced decibels about one.
        body_pattern_db: of the first harmonic of the transmitter's pattern; 0: none.
        receiver_pattern_db: of the first harmonic of each receiver's.
        shadow_db: standard deviation of shadowing, dB.
        shadow_m: its correlation length, metres.
        body_db: standard deviation of the effect of the heading that differs from place to place.
        body_m: its correlation length, metres.
        concentration: how sharply that effect depends on the heading.
        drift_db: standard deviation of what stays while the transmitter stands but is not found again later.
        noise_db: of a single report.
        lever_m: the antenna is so far ahead of the stated position.
        skew_db: what is added to the mean as fades reach deeper than peaks, before held-out rows tell.
        search_rows: with fewer training rows these numbers stay as they are; with more, held-out rows choose.
        search_rounds: of that choice; 0: none.
        stop_m: rows in sequence within that distance are joined.
        stop_rad: and within that turn.
        stop_rows: and at most so many.
        spacing_m: of the grid that is traced.
        smooth_m: neighbourhood over which the traced power is averaged, standard deviation.
        max_depth: interactions of a traced path, transmissions included.
        max_reflections: of these.
    """

    transmit_dbm: float = 0.0
    offset_sd_db: float = 10.0
    receiver_sd_db: float = 4.0
    exponent_sd: float = 1.0
    traced_sd: float = 0.5
    body_pattern_db: float = 1.0
    receiver_pattern_db: float = 2.0
    shadow_db: float = 4.5
    shadow_m: float = 2.0
    body_db: float = 1.5
    body_m: float = 1.5
    concentration: float = 1.0
    drift_db: float = 2.8
    noise_db: float = 2.8
    lever_m: float = 0.0
    skew_db: float = 0.4
    search_rows: int = 500
    search_rounds: int = 1
    stop_m: float = 0.1
    stop_rad: float = 0.2
    stop_rows: int = 20
    spacing_m: float = 0.25
    smooth_m: float = 0.3
    max_depth: int = 6
    max_reflections: int = 2

    def __post_init__(self) -> None:
        """Reject what cannot be fitted.

        Raises:
            InputError: naming the setting.
        """
        free = {"transmit_dbm", "lever_m", "skew_db"}
        positive = {
            *(
                "shadow_db",
                "shadow_m",
                "body_m",
                "noise_db",
                "spacing_m",
                "offset_sd_db",
                "receiver_sd_db",
                "stop_rows",
            ),
        }
        for one in fields(self):
            value = getattr(self, one.name)
            if not np.isfinite(value) or (one.name in positive and value <= 0):
                raise InputError(f"{one.name} {value}: give a positive number")
            if one.name not in free and value < 0:
                raise InputError(f"{one.name} {value}: give 0 or more")

    @property
    def hyperparameters(self) -> Hyperparameters:
        """What the search begins with."""
        return Hyperparameters(**{one.name: getattr(self, one.name) for one in fields(Hyperparameters)})

    def priors(self, traced: bool) -> Priors:
        """Of the mean's coefficients."""
        return Priors(
            offset=(self.offset_sd_db, self.receiver_sd_db),
            slope=(self.exponent_sd, 0.3 * self.exponent_sd),
            traced=(self.traced_sd, 0.4 * self.traced_sd) if traced else (0.0, 0.0),
            tx=(self.body_pattern_db, 0.2 * self.body_pattern_db),
            rx=self.receiver_pattern_db,
        )


class RssiPhysics:
    """A fitted RSSI physics model; made by `fit_rssi`.

    Attributes:
        task: ``"rssi"``.
        receivers: in the record's order.
    """

    task: ClassVar[str] = "rssi"

    def __init__(
        self,
        receivers: tuple[Receiver, ...],
        field: Field,
        stops: Stops,
        shift_db: float,
        widen: FloatArray,
        facts: Mapping[str, float],
    ) -> None:
        self.receivers, self._field, self._stops = receivers, field, stops
        self._shift_db, self._widen, self._facts = shift_db, widen, dict(facts)

    @property
    def uses_heading(self) -> bool:
        """Whether the training rows had headings."""
        return bool(self._field.headings)

    def predict(self, tx_pos_m: ArrayLike, receiver: int | str, tx_heading_rad: ArrayLike | None = None) -> Prediction:
        """Signal strengths in dBm, [m], with the standard deviation of a single report.

        Args:
            tx_pos_m: transmitters, [m, 3], metres.
            receiver: name, or number from 0.
            tx_heading_rad: yaw of the transmitter's body, [m]; None where the fit knew headings: the average over all.

        Raises:
            InputError: positions or headings of another shape, or no such receiver.
        """
        position = np.atleast_2d(np.asarray(tx_pos_m, float))
        if position.ndim != 2 or position.shape[1] != 3 or not np.isfinite(position).all():
            raise InputError(f"predict: tx_pos_m has shape {np.shape(tx_pos_m)}; give finite [m, 3]")
        index = receiver_index(self.receivers, receiver)
        heading = None
        if tx_heading_rad is not None:
            heading = np.atleast_1d(np.asarray(tx_heading_rad, float))
            if heading.shape != (len(position),) or not np.isfinite(heading).all():
                raise InputError(f"predict: {len(position)} positions and headings {heading.shape}; give one for each")
        if not self._field.headings:
            headings: list[FloatArray | None] = [None]
        elif heading is not None:
            headings = [heading]
        else:
            headings = [np.full(len(position), turn) for turn in 2 * np.pi * np.arange(HEADINGS) / HEADINGS]
        means, variances = [], []
        for own in headings:
            parts = [self._part(position, own, index, first) for first in range(0, len(position), CHUNK_SIZE)]
            means.append(np.concatenate([part[0] for part in parts]) if parts else np.zeros(0))
            variances.append(np.concatenate([part[1] for part in parts]) if parts else np.zeros(0))
        variance = np.mean(variances, axis=0) * self._widen[index] ** 2 + np.var(means, axis=0)
        return Prediction(np.mean(means, axis=0) + self._shift_db, np.sqrt(variance))

    def _part(
        self, position: FloatArray, heading: FloatArray | None, receiver: int, first: int
    ) -> tuple[FloatArray, FloatArray]:
        own = slice(first, first + CHUNK_SIZE)
        return self._field.predict(Places(position[own], None if heading is None else heading[own]), receiver)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """All that is needed to predict again, as plain arrays."""
        field, stops, base = self._field, self._stops, self._field.base
        heading = stops.places.heading_rad
        arrays: dict[str, Any] = {
            **receiver_arrays(self.receivers),
            "stop.position_m": stops.places.position_m,
            "stop.value_dbm": stops.value_dbm,
            "stop.count": stops.count,
            "stop.row": stops.row,
            "base": np.array([base.transmit_dbm, base.frequency_hz]),
            "prior.shared": np.array([field.priors.offset, field.priors.slope, field.priors.traced, field.priors.tx]),
            "prior.rx": field.priors.rx,
            "ratio": field.ratio,
            "rounds": field.rounds,
            "shift_db": self._shift_db,
            "widen": self._widen,
            "fact.name": np.array(list(self._facts)),
            "fact.value": np.array(list(self._facts.values()), float),
            **{f"knob.{name}": value for name, value in asdict(field.hyperparameters).items()},
        }
        if heading is not None:
            arrays["stop.heading_rad"] = heading
        if base.traced is not None:
            arrays |= {f"map.{one.name}": getattr(base.traced, one.name) for one in fields(PowerMap)}
        return {name: np.asarray(value) for name, value in arrays.items()}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]], scene: Any | None = None) -> RssiPhysics:
        """What `arrays` returned; the scene is not needed: its map is in them."""
        receivers = stored_receivers(arrays)
        traced = None
        if "map.power_dbm" in arrays:
            traced = PowerMap(*(arrays[f"map.{one.name}"] for one in fields(PowerMap)))
        transmit_dbm, frequency_hz = map(float, arrays["base"])
        base = Base(arrays["receiver_position_m"], transmit_dbm, frequency_hz, traced)
        offset, slope, factor, tx = ((float(a), float(b)) for a, b in arrays["prior.shared"])
        priors = Priors(offset, slope, factor, tx, float(arrays["prior.rx"]))
        hyperparameters = Hyperparameters(
            **{one.name: float(arrays[f"knob.{one.name}"]) for one in fields(Hyperparameters)}
        )
        places = Places(arrays["stop.position_m"], arrays.get("stop.heading_rad"))
        stops = Stops(places, arrays["stop.value_dbm"], arrays["stop.count"], arrays["stop.row"])
        field = Field(base, priors, hyperparameters, arrays["ratio"], stops, int(arrays["rounds"]))
        facts = dict(zip(map(str, arrays["fact.name"]), map(float, arrays["fact.value"]), strict=True))
        return cls(receivers, field, stops, float(arrays["shift_db"]), arrays["widen"], facts)

    def summary(self) -> dict[str, Any]:
        """What was fitted, in plain numbers."""
        return {
            "stops": len(self._stops.places),
            "traced": self._field.base.traced is not None,
            "headings": self._field.headings,
            **asdict(self._field.hyperparameters),
            "noise_ratio": [float(one) for one in self._field.ratio],
            "shift_db": self._shift_db,
            "widen": [float(one) for one in self._widen],
            **self._facts,
        }


def fit_rssi(
    record: Record,
    rows: IntArray,
    scene: Any | None,
    settings: RssiSettings = RssiSettings(),
    seed: int = 0,
    on_progress: OnProgress = lambda what, share: None,
) -> RssiPhysics:
    """Fit an RSSI physics model.

    Args:
        record: of signal strengths; its rows should be in the order of time, see
            `wrf_mi.models.physics.rssi_fit.Measured.folds`.
        rows: training rows; none: the scene alone.
        scene: from `wrf_mi.tracing.open_scene`, or None: free space is expected.
        settings: see `RssiSettings`.
        seed: unused: nothing is drawn.
        on_progress: hears what is being done, and how far it is from 0 to 1.

    Raises:
        InputError: a record of another task or without its frequency, or neither rows nor a scene.
    """
    require(record, "rssi", why="this physics model predicts signal strengths")
    if record.frequencies_hz is None:
        raise InputError(
            f"{record.name}: carrier frequency unknown, which the physics model needs; state it in the data"
        )
    rows = np.unique(np.asarray(rows, np.int64))
    values = np.asarray(record.observation[:, rows], float)
    heard = np.isfinite(values).any(axis=0)
    rows, values = rows[heard], values[:, heard]
    if not len(rows) and scene is None:
        raise InputError(f"{record.name}: neither a training row that was received nor a scene; give one of them")
    traced = None
    if scene is not None:
        on_progress("tracing a map", 0.0)
        shape = settings.spacing_m, settings.smooth_m, settings.max_depth, settings.max_reflections
        traced = trace_map(scene, record, *shape)
    receivers_m = np.stack([one.position_m for one in record.receivers]).astype(float)
    base = Base(receivers_m, settings.transmit_dbm, float(np.mean(record.frequencies_hz)), traced)
    heading = None if record.tx_heading_rad is None else np.asarray(record.tx_heading_rad, float)[rows]
    places = Places(np.asarray(record.tx_pos_m, float)[rows], heading)
    measured = Measured(places, values, rows, record.precision(rows))
    priors, hyperparameters = settings.priors(traced is not None), settings.hyperparameters
    join = stopper(settings.stop_m, settings.stop_rad, settings.stop_rows)
    ratio, shift, widen, facts = (
        np.ones(len(receivers_m)),
        settings.skew_db,
        np.ones(len(receivers_m)),
        {"rows": float(len(rows))},
    )
    if len(rows) > 1:
        if settings.search_rounds and len(rows) >= settings.search_rows:
            wide = stopper(WIDER * settings.stop_m, WIDER * settings.stop_rad, settings.stop_rows)
            search = Fit(base, priors, measured, wide)
            search.set_ratio(hyperparameters)
            hyperparameters = search.search(
                hyperparameters, settings.search_rounds, lambda share: on_progress("choosing", 0.1 + 0.7 * share)
            )
        fit = Fit(base, priors, measured, join)
        fit.set_ratio(hyperparameters)
        on_progress("judging on held-out rows", 0.8)
        held_out = fit.held_out(hyperparameters, ROBUST_ROUNDS)
        residual = values - held_out.mean_dbm
        shift, ratio = shift_of(residual, settings.skew_db), fit.ratio
        widen = widening(residual - shift, held_out.std_db)
        error = np.abs(residual - shift)
        if np.isfinite(error).any():
            facts["held_out_db"] = float(np.nanmedian(error))
    on_progress("fitting all rows", 0.9)
    stops = join(measured)
    field = Field(base, priors, hyperparameters, ratio, stops, ROBUST_ROUNDS)
    on_progress("done", 1.0)
    return RssiPhysics(record.receivers, field, stops, shift, widen, facts)


__all__ = ["RssiPhysics", "RssiSettings", "fit_rssi"]
