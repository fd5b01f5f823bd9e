"""Instruments of a record: several receivers and their observations of traced paths, in float64."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import Antenna, Paths, Receiver
from ..core.antenna import ANTENNA
from ..core.carriers import by_carrier
from ..core.types import FloatArray, IntArray
from .registry import RECEIVERS, ObservationSpec, ReceiverModel

SIZE = (90, 360)  # elevations and azimuths of a spectrum where none are stated: one each degree


@dataclass(frozen=True)
class Instrument:
    """Receivers and their observations of traced paths.

    Observations of the receiver models of this package, each [n_rx, n_tx, ...]: ``array`` Bartlett spectra [height,
    width], scaled by minimum and maximum as instruments do; ``power`` received power in dBm for 0 dBm sent, NaN where
    no path arrives; ``csi`` channel coefficients [k], or [m, k] of receivers with m antennas.

    With a phase error a spectrum is the mean over draws of the paths' phases, its expectation: a spectrum of wrong
    phases has maxima and zeros at wrong places. Draws of a path are the same in every call.

    Attributes:
        kind: name of the receiver model (`wrf_mi.receivers.registry.RECEIVERS`), such as ``"array"``.
        receivers: the ``n_rx`` receivers.
        frequencies_hz: carrier frequency [1] or those of the subcarriers [k].
        tx_antenna: antenna of the transmitters.
        size: height and width of a spectrum.
        phase_error: standard deviation of the phase that each interaction but transmission adds, rad, independently.
    """

    kind: str
    receivers: tuple[Receiver, ...]
    frequencies_hz: FloatArray
    tx_antenna: Antenna = ANTENNA
    size: tuple[int, int] = SIZE
    phase_error: float = 0.0

    @property
    def carrier_hz(self) -> float:
        """Frequency at which paths are traced: the mean of the subcarriers."""
        return float(np.mean(self.frequencies_hz))

    def model(self, receiver: Receiver) -> ReceiverModel:
        """Receiver model of one of the receivers."""
        antennas = () if receiver.array_m is None else (len(receiver.array_m),)
        outputs = (*antennas, len(self.frequencies_hz))
        form = ObservationSpec(self.kind, self.size, np.asarray(self.frequencies_hz, float), outputs)
        return RECEIVERS[self.kind].of(form, receiver).with_phase_error(self.phase_error)

    def observe(self, paths: Paths) -> NDArray[Any]:
        """Observations [n_rx, n_tx, ...] of traced paths, as in a record of the task."""
        bounds = np.searchsorted(paths.rx, np.arange(paths.n_rx + 1))  # paths are sorted by receiver
        observations = []
        for receiver, begin, end in zip(self.receivers, bounds[:-1], bounds[1:], strict=True):
            arriving = paths.select(np.arange(begin, end))
            arriving = replace(arriving, rx=np.zeros_like(arriving.rx), n_rx=1)
            observations.append(self.model(receiver).observed(arriving, receiver))
        # Spectra of one receiver are not copied: those of all rows may take gigabytes.
        return observations[0][None] if len(observations) == 1 else np.stack(observations)

    def observe_rows(self, paths: Paths, carriers_hz: FloatArray | None) -> NDArray[Any]:
        """`observe` with a carrier in Hz for each transmitter, ``carriers_hz`` [n_tx]; None: the instrument's."""
        if carriers_hz is None:
            return self.observe(paths)

        def at_carrier(carrier_hz: float, rows: IntArray) -> NDArray[Any]:
            of_rows = paths.select(np.isin(paths.tx, rows))
            of_rows = replace(of_rows, tx=np.searchsorted(rows, of_rows.tx), n_tx=len(rows))
            return replace(self, frequencies_hz=np.array([carrier_hz])).observe(of_rows)

        return by_carrier(carriers_hz, at_carrier, axis=1)
