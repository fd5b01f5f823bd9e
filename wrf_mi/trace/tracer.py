"""Ray tracing as a model of a data set: from transmitter positions to what its receivers report."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core import Antenna, InputError, Paths, Receiver, Record
from ..core.angles import FloatArray
from ..core.antenna import ANTENNA
from ..receive import antenna_csi, bartlett_spectrum, csi, element_signals, minmax_scale, rssi_dbm
from .options import DEFAULTS, TraceOptions
from .result import TraceResult
from .scenes import open_scene
from .solve import Prepared, keeps_direction, trace_paths


@dataclass(frozen=True)
class Instrument:
    """What is measured, by whom and how.

    Attributes:
        task: see `wrf_mi.core.Record`.
        receivers: that measure.
        frequencies_hz: of the carrier [1] or the subcarriers [k].
        array_m: elements of the array behind a spectrum, or antennas of a receiver of channel coefficients, [m, 3],
            receiver's frame, metres; None for receivers with one antenna.
        size: height and width of a spectrum; None otherwise.
        tx_antenna: antenna of the transmitters.
    """

    task: str
    receivers: tuple[Receiver, ...]
    frequencies_hz: FloatArray
    array_m: FloatArray | None = None
    size: tuple[int, int] | None = None
    tx_antenna: Antenna = ANTENNA

    @property
    def carrier_hz(self) -> float:
        """The frequency that is traced at: the middle of the subcarriers."""
        return float(np.mean(self.frequencies_hz))

    def observe(self, paths: Paths) -> NDArray[Any]:
        """What the receivers report of traced paths, [n_rx, n_tx, ...] as in a record of this task.

        Spectra are Bartlett spectra of the array, each scaled to its own minimum and maximum as the instrument does.
        Signal strengths add the powers of the paths (dBm for 0 dBm sent, NaN where no path arrives). Channel
        coefficients add the paths' fields, at each antenna where there are several.
        """
        if self.task == "rssi":
            return rssi_dbm(paths)
        if self.task == "csi" and self.array_m is not None:
            return antenna_csi(paths, self.receivers, self.array_m, self.frequencies_hz)
        if self.task == "csi":
            return csi(paths, self.frequencies_hz)
        assert self.array_m is not None
        assert self.size is not None
        signals = element_signals(paths, self.receivers, self.array_m, self.carrier_hz)
        # One transmitter at a time: an array of spectra in float64 would be several times what is kept.
        images = np.empty((*signals.shape[:2], *self.size), np.float32)
        for index in np.ndindex(signals.shape[:2]):
            images[index] = minmax_scale(bartlett_spectrum(signals[index], self.array_m, self.carrier_hz, *self.size))
        return images


def instrument_of(record: Record) -> Instrument:
    """The instrument behind a record.

    Raises:
        InputError: the data do not tell positions, the carrier frequency or, for spectra and several antennas, the
            array.
    """
    places = [record.tx_pos_m, *(receiver.position_m for receiver in record.receivers)]
    if not all(np.isfinite(place).all() for place in places):
        raise InputError(f"{record.name}: positions unknown, so there is nothing to trace between; use another method")
    if record.frequencies_hz is None:
        stated = (
            "frequencies_hz in base-station.yml" if record.task == "csi" else "frequency_hz in its gateway_info.yml"
        )
        raise InputError(f"{record.name}: carrier frequency unknown; state {stated}")
    single = Instrument(record.task, record.receivers, record.frequencies_hz, tx_antenna=record.tx_antenna)
    if record.task == "rssi" or (record.task == "csi" and record.observation.ndim == 3):
        return single
    if record.task == "csi" and record.array_m is not None:
        return replace(single, array_m=record.array_m)
    if record.array_m is None:
        raise InputError(f"{record.name}: antenna array unknown; state array in its gateway_info.yml")
    height, width = record.observation.shape[-2:]
    return replace(single, array_m=record.array_m, size=(height, width))


class RayTracer:
    """Traces a scene and reports as an instrument would.

    Attributes:
        scene: the ``sionna.rt.Scene``, at the instrument's carrier.
        instrument: what is reported.
        options: what is traced.
    """

    def __init__(
        self, scene: str | Path, instrument: Instrument, options: TraceOptions = DEFAULTS, material: str | None = None
    ) -> None:
        """Open a scene.

        Args:
            scene: see `wrf_mi.trace.open_scene`.
            instrument: from `instrument_of`.
            options: what is traced.
            material: of a bare mesh.

        Raises:
            InputError: a scene that cannot be opened.
        """
        self.instrument = instrument
        self.options = options
        self.scene = open_scene(scene, instrument.carrier_hz, material=material)
        self._prepared = Prepared(self.scene)

    def trace(self, tx_pos_m: ArrayLike, progress: bool = False, first_row: int = 0) -> TraceResult:
        """Paths from transmitter positions [n, 3] (metres), ``first_row`` and following, to all receivers."""
        ends = self.instrument.receivers, self.options, progress, self._prepared, first_row
        return trace_paths(self.scene, tx_pos_m, *ends, self.instrument.tx_antenna)

    def rays(self, tx_pos_m: ArrayLike) -> int:
        """How many rays search if these positions [n, 3] (metres) are the first: ``"auto"`` is settled on them."""
        positions, receivers = self._prepared.placed(np.asarray(tx_pos_m, float), tuple(self.instrument.receivers))
        ends = positions, np.stack([receiver.position_m for receiver in receivers])
        return self._prepared.rays(*(ends if keeps_direction(self.options) else ends[::-1]), self.options)

    def __call__(self, tx_pos_m: ArrayLike) -> NDArray[Any]:
        """What every receiver reports for transmitter positions [n, 3] (metres), [n_rx, n, ...]."""
        return self.instrument.observe(self.trace(tx_pos_m).paths)
