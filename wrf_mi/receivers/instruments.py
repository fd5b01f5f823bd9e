"""What instruments report of traced paths: spectra, signal strengths, channel coefficients, in float64."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import Antenna, Paths, Receiver
from ..core.angles import FloatArray
from ..core.antenna import ANTENNA
from ..core.carriers import by_carrier
from ..core.types import IntArray
from .array import bartlett_spectrum, minmax_scale
from .channel import antenna_csi, csi, element_signals, rssi_dbm


@dataclass(frozen=True)
class Instrument(ABC):
    """Receivers and what they report of traced paths.

    Attributes:
        receivers: that measure.
        frequencies_hz: of the carrier [1] or the subcarriers [k].
        tx_antenna: antenna of the transmitters.
    """

    receivers: tuple[Receiver, ...]
    frequencies_hz: FloatArray
    tx_antenna: Antenna = ANTENNA

    @property
    def carrier_hz(self) -> float:
        """The frequency that is traced at: the middle of the subcarriers."""
        return float(np.mean(self.frequencies_hz))

    @abstractmethod
    def observe(self, paths: Paths) -> NDArray[Any]:
        """What the receivers report of traced paths, [n_rx, n_tx, ...] as in a record of the task."""

    def observe_rows(self, paths: Paths, carriers_hz: FloatArray | None) -> NDArray[Any]:
        """`observe` where each transmitter has the carrier in Hz of ``carriers_hz`` [n_tx]; None: the instrument's."""
        if carriers_hz is None:
            return self.observe(paths)

        def of_carrier(carrier_hz: float, rows: IntArray) -> NDArray[Any]:
            own = paths.select(np.isin(paths.tx, rows))
            own = replace(own, tx=np.searchsorted(rows, own.tx), n_tx=len(rows))
            return replace(self, frequencies_hz=np.array([carrier_hz])).observe(own)

        return by_carrier(carriers_hz, of_carrier, axis=1)


@dataclass(frozen=True)
class PowerInstrument(Instrument):
    """Received power in dBm for 0 dBm sent, [n_rx, n_tx], NaN where no path arrives: powers of paths are added."""

    def observe(self, paths: Paths) -> NDArray[Any]:
        """See `wrf_mi.receivers.channel.rssi_dbm`."""
        return rssi_dbm(paths)


@dataclass(frozen=True)
class ChannelInstrument(Instrument):
    """Channel coefficients, [n_rx, n_tx, k], or [n_rx, n_tx, m, k] of receivers with m antennas: fields are added."""

    def observe(self, paths: Paths) -> NDArray[Any]:
        """See `wrf_mi.receivers.channel.csi` and ``antenna_csi``."""
        if all(one.array_m is None for one in self.receivers):
            return csi(paths, self.frequencies_hz)
        channels = [
            antenna_csi(own, receiver, receiver.array_m, self.frequencies_hz)[0]
            for receiver, own in _by_receiver(self.receivers, paths)
            if receiver.array_m is not None
        ]
        return np.stack(channels)


@dataclass(frozen=True)
class SpectrumInstrument(Instrument):
    """Bartlett spectra [n_rx, n_tx, height, width], each scaled to its own minimum and maximum as instruments do.

    Attributes:
        size: height and width of a spectrum.
    """

    size: tuple[int, int] = (90, 360)

    def observe(self, paths: Paths) -> NDArray[np.float32]:
        """See `wrf_mi.receivers.array.bartlett_spectrum`; grey in 0..1, all 0 where no path arrives."""
        images = np.empty((len(self.receivers), paths.n_tx, *self.size), np.float32)
        for index, (receiver, own) in enumerate(_by_receiver(self.receivers, paths)):
            assert receiver.array_m is not None, "see the task's instrument"
            signals = element_signals(own, receiver, receiver.array_m, self.carrier_hz)[0]
            # One transmitter at a time: an array of spectra in float64 would be several times what is kept.
            for row, signal in enumerate(signals):
                image = bartlett_spectrum(signal, receiver.array_m, self.carrier_hz, *self.size)
                images[index, row] = minmax_scale(image)
        return images


def _by_receiver(receivers: tuple[Receiver, ...], paths: Paths) -> list[tuple[Receiver, Paths]]:
    """Each receiver with its own paths."""
    parts = []
    for index, receiver in enumerate(receivers):
        own = paths if paths.n_rx == 1 else paths.select(paths.rx == index)
        parts.append((receiver, replace(own, rx=np.zeros_like(own.rx), n_rx=1)))
    return parts
