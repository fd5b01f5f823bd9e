"""Ray tracing as a model of a data set: observations at transmitter positions, offsets of uncalibrated receivers."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core import InputError
from ..core.angles import FloatArray
from ..core.carriers import by_carrier
from ..core.types import IntArray
from ..receivers.instruments import Instrument, SpectrumInstrument
from .options import DEFAULTS, TraceOptions
from .paths.result import TraceResult, recompute
from .paths.solve import Prepared, trace_paths
from .sionna.scenes import open_scene


class RayTracer:
    """Traces a scene and reports as an instrument does.

    Args:
        scene: see `wrf_mi.tracing.open_scene`.
        instrument: receivers and their reports, see `wrf_mi.tasks.Task.instrument`.
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
        if options.phase_error and isinstance(instrument, SpectrumInstrument):
            instrument = replace(instrument, phase_error=options.phase_error)
        self.instrument = instrument
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
            InputError: a position inside a solid object, or a material that is not known at one of the carriers.
        """
        instrument = self.instrument
        traced = trace_paths(
            self.scene,
            tx_pos_m,
            instrument.receivers,
            self.options,
            progress,
            self._prepared,
            first_row,
            instrument.tx_antenna,
        )
        if carriers_hz is None:
            return traced

        def gains(carrier_hz: float, which: IntArray) -> NDArray[Any]:
            return recompute(traced.select(which), self._at(carrier_hz)).paths.gain

        paths = traced.paths
        if len(paths):
            paths = replace(paths, gain=by_carrier(carriers_hz[paths.tx], gains))
        return replace(traced, paths=paths, carriers_hz=carriers_hz)

    def observe(self, traced: TraceResult) -> NDArray[Any]:
        """Observations of all receivers [n_rx, n, ...] for traced paths, each row at its carrier."""
        return self.instrument.observe_rows(traced.paths, traced.carriers_hz)

    def rays(self, tx_pos_m: ArrayLike) -> int:
        """Number of rays per search for positions [n, 3] (metres); with ``"auto"`` that which converges for them."""
        positions, receivers = self._prepared.placed(np.asarray(tx_pos_m, float), tuple(self.instrument.receivers))
        ends = positions, np.stack([receiver.position_m for receiver in receivers])
        return self._prepared.rays(*(ends if self.options.diffraction else ends[::-1]), self.options)

    def __call__(self, tx_pos_m: ArrayLike) -> NDArray[Any]:
        """Observations of all receivers [n_rx, n, ...] for transmitter positions [n, 3] (metres)."""
        return self.observe(self.trace(tx_pos_m))


@dataclass(frozen=True)
class Offsets:
    """Offsets of traced signal strengths.

    Attributes:
        offset_db: offset of each receiver, shape [n_rx].
        floor_dbm: weakest measured signal of each receiver, shape [n_rx], the report where no path arrives.
    """

    offset_db: FloatArray
    floor_dbm: FloatArray

    def __call__(self, traced_dbm: ArrayLike) -> FloatArray:
        """Traced signal strengths [n_rx, n] (dBm for 0 dBm sent, NaN without a path) on the receivers' scales."""
        moved = np.asarray(traced_dbm, float) + self.offset_db[:, None]
        return np.where(np.isnan(moved), self.floor_dbm[:, None], moved)


def fit_offsets(traced_dbm: ArrayLike, measured_dbm: ArrayLike) -> Offsets:
    """Fit an offset to each receiver: the median of measured minus traced, which minimises the absolute error.

    A receiver that received nothing takes the mean offset of the others, and their weakest signal.

    Args:
        traced_dbm: shape [n_rx, n], NaN where no path arrives.
        measured_dbm: measured training rows [n_rx, n], NaN where nothing was received.

    Raises:
        InputError: a receiver that received rows, but none that was traced.
    """
    traced, measured = np.asarray(traced_dbm, float), np.asarray(measured_dbm, float)
    difference = measured - traced
    heard = ~np.isnan(measured).all(axis=1)
    for receiver, known in enumerate(~np.isnan(difference)):
        if heard[receiver] and not known.any():
            raise InputError(
                f"receiver {receiver}: no training row is both received and reached by a path; trace more kinds of path"
            )
    offset_db, floor_dbm = np.empty((2, len(measured)))
    offset_db[heard], floor_dbm[heard] = np.nanmedian(difference[heard], axis=1), np.nanmin(measured[heard], axis=1)
    offset_db[~heard], floor_dbm[~heard] = offset_db[heard].mean(), floor_dbm[heard].min()
    return Offsets(offset_db, floor_dbm)
