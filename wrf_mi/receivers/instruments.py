"""Instruments of a record: several receivers and their reports of traced paths, in float64.

How a receiver reports is stated once, by its receiver model (`wrf_mi.receivers.receiver_models`), which is imported
when paths are observed: a command that only reads data does without Dr.Jit.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..core import Antenna, Paths, Receiver
from ..core.antenna import ANTENNA
from ..core.carriers import by_carrier
from ..core.types import FloatArray, IntArray

if TYPE_CHECKING:
    from .receiver_models import ArrayReceiver, CsiReceiver


@dataclass(frozen=True)
class Instrument(ABC):
    """Receivers and their reports of traced paths.

    Attributes:
        receivers: the ``n_rx`` receivers.
        frequencies_hz: carrier frequency [1] or those of the subcarriers [k].
        tx_antenna: antenna of the transmitters.
    """

    receivers: tuple[Receiver, ...]
    frequencies_hz: FloatArray
    tx_antenna: Antenna = ANTENNA

    @property
    def carrier_hz(self) -> float:
        """Frequency at which paths are traced: the mean of the subcarriers."""
        return float(np.mean(self.frequencies_hz))

    @abstractmethod
    def model(self, receiver: Receiver) -> ArrayReceiver | CsiReceiver:
        """Receiver model of one of the receivers."""

    def observe(self, paths: Paths) -> NDArray[Any]:
        """Observations [n_rx, n_tx, ...] of traced paths, as in a record of the task."""
        bounds = np.searchsorted(paths.rx, np.arange(paths.n_rx + 1))  # paths are sorted by receiver
        reports = []
        for receiver, begin, end in zip(self.receivers, bounds[:-1], bounds[1:], strict=True):
            arriving = paths.select(np.arange(begin, end))
            arriving = replace(arriving, rx=np.zeros_like(arriving.rx), n_rx=1)
            reports.append(self.model(receiver).observed(arriving, receiver))
        # Spectra of one receiver are not copied: those of all rows may take gigabytes.
        return reports[0][None] if len(reports) == 1 else np.stack(reports)

    def observe_rows(self, paths: Paths, carriers_hz: FloatArray | None) -> NDArray[Any]:
        """`observe` with a carrier in Hz for each transmitter, ``carriers_hz`` [n_tx]; None: the instrument's."""
        if carriers_hz is None:
            return self.observe(paths)

        def at_carrier(carrier_hz: float, rows: IntArray) -> NDArray[Any]:
            of_rows = paths.select(np.isin(paths.tx, rows))
            of_rows = replace(of_rows, tx=np.searchsorted(rows, of_rows.tx), n_tx=len(rows))
            return replace(self, frequencies_hz=np.array([carrier_hz])).observe(of_rows)

        return by_carrier(carriers_hz, at_carrier, axis=1)


@dataclass(frozen=True)
class PowerInstrument(Instrument):
    """Received power in dBm for 0 dBm sent, [n_rx, n_tx], NaN where no path arrives: powers of paths are added."""

    def model(self, receiver: Receiver) -> CsiReceiver:
        """A single antenna that adds the powers of paths."""
        from .receiver_models import PowerReceiver

        return PowerReceiver(1, 1, (self.carrier_hz,), interference=False)


@dataclass(frozen=True)
class ChannelInstrument(Instrument):
    """Channel coefficients, [n_rx, n_tx, k], or [n_rx, n_tx, m, k] of receivers with m antennas: fields are added."""

    def model(self, receiver: Receiver) -> CsiReceiver:
        """One or several antennas that report channel coefficients."""
        from .receiver_models import CsiReceiver

        return CsiReceiver(1, 1, tuple(map(float, self.frequencies_hz)), receiver.array_m)


@dataclass(frozen=True)
class SpectrumInstrument(Instrument):
    """Bartlett spectra [n_rx, n_tx, height, width], each scaled by its minimum and maximum as instruments do.

    With a phase error a spectrum is the mean over draws of the paths' phases, its expectation: a spectrum of wrong
    phases has maxima and zeros at wrong places. Draws of a path are the same in every call.

    Attributes:
        size: height and width of a spectrum.
        phase_error: standard deviation of the phase that each interaction but transmission adds, rad, independently.
    """

    size: tuple[int, int] = (90, 360)
    phase_error: float = 0.0

    def model(self, receiver: Receiver) -> ArrayReceiver:
        """An array that reports scaled spectra."""
        from .receiver_models import ArrayReceiver

        assert receiver.array_m is not None, "see the task's instrument"
        return ArrayReceiver(*self.size, receiver.array_m, self.carrier_hz, "coherent", True, self.phase_error)
