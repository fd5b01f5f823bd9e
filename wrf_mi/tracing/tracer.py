"""Ray tracing as a model of a data set: observations at positions, offsets of receivers, cross-polarised links."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core import Antenna, InputError, Receiver
from ..core.carriers import by_carrier
from ..core.types import FloatArray, IntArray
from ..receivers import received_power
from ..receivers.instruments import Instrument
from .options import DEFAULTS, TraceOptions
from .paths.result import TraceResult, recompute, recomputed_gains
from .paths.solve import Prepared, spread, trace_paths
from .sionna.scenes import open_scene

logger = logging.getLogger(__name__)

GAIN_DB = 10.0
"""Gain in median power by the other polarisation above which a link counts as cross-polarised. Reflections turn the
polarisation of some paths, but a co-polarised link keeps most of its power."""
SAMPLE = 256  # transmitters on which the gain is judged
TRACED, ROUGH = 32, TraceOptions(transmission=True, depth=2, reflections=1, rays=1 << 12)
"""Transmitters and options of the trace for models that do not trace all transmitters at once."""
TRIED = 16  # receivers of that trace: antennas of one building are alike, and each takes a search


class RayTracer:
    """Traces a scene and observes it as an instrument does.

    Args:
        scene: see `wrf_mi.tracing.open_scene`.
        instrument: receivers and their observations, see `wrf_mi.tasks.instrument_of`.
        options: kinds of path, depth, rays.
        material: radio material of a bare mesh.

    Attributes:
        scene: the ``sionna.rt.Scene``, at the instrument's carrier.

    Raises:
        InputError: a scene that cannot be opened.
    """

    def __init__(
        self, scene: str | Path, instrument: Instrument, options: TraceOptions = DEFAULTS, material: str | None = None
    ) -> None:
        self.instrument = replace(instrument, phase_error=options.phase_error or instrument.phase_error)
        self.options = options
        self._at = cache(partial(open_scene, scene, material=material))
        self.scene = self._at(instrument.carrier_hz)
        self._prepared = Prepared(self.scene)

    def trace(
        self,
        tx_pos_m: ArrayLike,
        progress: bool = False,
        first_row: int = 0,
        carriers_hz: FloatArray | None = None,
    ) -> TraceResult:
        """Paths from transmitter positions to all receivers.

        Args:
            tx_pos_m: positions [n, 3], metres.
            progress: show a bar on standard error.
            first_row: number of the first position in error messages, from 0.
            carriers_hz: carrier of each position [n], Hz, of the scene's materials and the paths' gains; paths are
                searched for once. None: the instrument's carrier for all.

        Raises:
            InputError: a position inside a solid object, or a material that is not known at one of the carriers, among
                them those that receivers state.
        """
        receivers, antenna = self.instrument.receivers, self.instrument.tx_antenna
        place = progress, self._prepared, first_row
        traced = trace_paths(self.scene, tx_pos_m, receivers, self.options, *place, tx_antenna=antenna)
        if carriers_hz is None:
            return traced

        # Paths do not depend on the carrier, and are searched for once; gains are those of each row's carrier.
        def gains(carrier_hz: float, which: IntArray) -> NDArray[Any]:
            return recomputed_gains(traced.select(which), self._at(carrier_hz))

        if len(traced.paths):
            traced = traced.with_gains(by_carrier(carriers_hz[traced.paths.tx], gains))
        return replace(traced, carriers_hz=carriers_hz)

    def observe(self, traced: TraceResult) -> NDArray[Any]:
        """Observations of all receivers [n_rx, n, ...] for traced paths, each row at its carrier."""
        return self.instrument.observe_rows(traced.paths, traced.carriers_hz)

    def rays(self, tx_pos_m: ArrayLike) -> int:
        """Number of rays per search for positions [n, 3] (metres); with ``"auto"`` that which converges for them."""
        positions, receivers = self._prepared.placed(np.asarray(tx_pos_m, float), tuple(self.instrument.receivers))
        ends = positions, np.stack([receiver.position_m for receiver in receivers])
        return self._prepared.rays(*(ends if self.options.sampled else ends[::-1]), self.options)

    def __call__(self, tx_pos_m: ArrayLike) -> NDArray[Any]:
        """Observations of all receivers [n_rx, n, ...] for transmitter positions [n, 3] (metres)."""
        return self.observe(self.trace(tx_pos_m))


@dataclass(frozen=True)
class Offsets:
    """Offsets of traced signal strengths."""

    offset_db: FloatArray  # offset of each receiver, shape [n_rx]
    floor_dbm: (
        FloatArray  # weakest measured signal of each receiver, shape [n_rx], the observation where no path arrives
    )

    def __call__(self, traced_dbm: ArrayLike) -> FloatArray:
        """Traced signal strengths [n_rx, n] (dBm for 0 dBm sent, NaN without a path) on the receivers' scales."""
        moved = np.asarray(traced_dbm, float) + self.offset_db[:, None]
        return np.where(np.isnan(moved), self.floor_dbm[:, None], moved)


def fit_offsets(traced_dbm: ArrayLike, measured_dbm: ArrayLike) -> Offsets:
    """Fit an offset to each receiver: the median of measured minus traced training rows [n_rx, n].

    Values are NaN where no path arrives, or where nothing was received. A receiver that received nothing takes the mean
    offset of the others, and their weakest signal; `InputError` for one whose rows are not traced.
    """
    traced, measured = np.asarray(traced_dbm, float), np.asarray(measured_dbm, float)
    difference = measured - traced
    heard = ~np.isnan(measured).all(axis=1)
    for receiver, comparable in enumerate(~np.isnan(difference)):
        if heard[receiver] and not comparable.any():
            text = "no training row is both received and reached by a path; trace more kinds of path"
            raise InputError(f"receiver {receiver}: {text}")
    offset_db, floor_dbm = np.empty((2, len(measured)))
    # The median minimises the absolute error, by which signal strengths are scored.
    offset_db[heard], floor_dbm[heard] = np.nanmedian(difference[heard], axis=1), np.nanmin(measured[heard], axis=1)
    offset_db[~heard], floor_dbm[~heard] = offset_db[heard].mean(), floor_dbm[heard].min()
    return Offsets(offset_db, floor_dbm)


def cross_polarized(traced: TraceResult, scene: Any) -> dict[str, float]:
    """Gains in dB, `GAIN_DB` or more, by the names of receivers whose polarisation is turned by 90 degrees."""
    # A sample, evenly spaced, in the scene in which it was traced: gains alone are computed anew.
    sample = traced.select(np.isin(traced.paths.tx, spread(len(traced.tx_pos_m), SAMPLE)))
    if sample.carriers_hz is not None:  # both at the scene's carrier
        sample = recompute(sample, scene)
    unturned = _median_power(sample)
    receivers = tuple(replace(rx, antenna=rx.antenna.turned) for rx in traced.receivers)
    turned = _median_power(recompute(replace(sample, receivers=receivers), scene))
    tiny = np.finfo(np.float32).tiny
    gain_db = 10 * np.log10(np.maximum(turned, tiny) / np.maximum(unturned, tiny))
    return {rx.name: float(g) for rx, g in zip(traced.receivers, gain_db, strict=True) if g >= GAIN_DB}


def warn_of_cross_polarization(traced: TraceResult, scene: Any) -> None:
    """Warn of receivers that `cross_polarized` finds, naming the option that turns their polarisation."""
    gains_db = cross_polarized(traced, scene)
    if not gains_db:
        return
    first, count = next(iter(gains_db)), len(traced.receivers)
    now = next(rx.antenna for rx in traced.receivers if rx.name == first)
    who = f"receiver {first}" if count == 1 else f"{len(gains_db)} of {count} receivers (first: {first})"
    options = f"--rx-polarization {now.turned.polarization}" + (" or --rx-frame world" if now.frame == "array" else "")
    text = "%s: turning the receive polarisation by 90 degrees raises the median traced power by %.0f dB; "
    text += "state the antenna in the data, or try %s (now: %s, frame %s)"
    logger.warning(text, who, gains_db[first], options, now.polarization, now.frame)


def check_polarization(scene: Any, tx_pos_m: FloatArray, receivers: Sequence[Receiver], tx_antenna: Antenna) -> None:
    """Trace a few of the transmitters [n, 3], metres, and warn of cross-polarised ones among a few stated receivers.

    Whoever has not stated where a receiver is has not stated its antenna either.
    """
    few, surveyed = (
        tx_pos_m[spread(len(tx_pos_m), TRACED)],
        [receiver for receiver in receivers if receiver.is_surveyed],
    )
    if surveyed:
        tried = [surveyed[place] for place in spread(len(surveyed), TRIED)]
        traced = trace_paths(scene, few, tried, ROUGH, tx_antenna=tx_antenna, check=False)
        warn_of_cross_polarization(traced, scene)


def _median_power(traced: TraceResult) -> FloatArray:
    """Median over the transmitters with a path of the power at each receiver [n_rx]; 0 without any path."""
    power = received_power(traced.paths)
    reached = np.zeros(power.shape, bool)
    reached[traced.paths.rx, traced.paths.tx] = True
    return np.array([np.median(row[has]) if has.any() else 0.0 for row, has in zip(power, reached, strict=True)])
