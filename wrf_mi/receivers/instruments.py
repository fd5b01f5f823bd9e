"""Instruments: spectra, signal strengths or channel coefficients of traced paths, in float64."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from ..core import Antenna, Paths, Receiver
from ..core.angles import FloatArray
from ..core.antenna import ANTENNA
from ..core.carriers import by_carrier
from ..core.types import IntArray
from .array import bartlett_spectrum
from .channel import antenna_csi, csi, rssi_dbm
from .reports import minmax_scale

CHUNK_SIZE = 64
"""Transmitters whose spectra are computed together."""
DRAWS = 16
"""Draws of uncertain phases: their mean differs from that of 512 by 0.005 of grey in a furnished room."""
TRANSMISSION = 4
"""Kind of interaction (`wrf_mi.core.Paths`) that adds no uncertain phase."""


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
    def observe(self, paths: Paths) -> NDArray[Any]:
        """Observations [n_rx, n_tx, ...] of traced paths, as in a record of the task."""

    def observe_rows(self, paths: Paths, carriers_hz: FloatArray | None) -> NDArray[Any]:
        """`observe` with a carrier in Hz for each transmitter, ``carriers_hz`` [n_tx]; None: the instrument's."""
        if carriers_hz is None:
            return self.observe(paths)

        def at_carrier(carrier_hz: float, rows: IntArray) -> NDArray[Any]:
            of_rows = paths.select(np.isin(paths.tx, rows))
            of_rows = replace(of_rows, tx=np.searchsorted(rows, of_rows.tx), n_tx=len(rows))
            return replace(self, frequencies_hz=np.array([carrier_hz])).observe(of_rows)

        return by_carrier(carriers_hz, at_carrier, axis=1)

    def by_receiver(self, paths: Paths) -> list[tuple[Receiver, Paths]]:
        """Each receiver with its paths."""
        parts = []
        for index, receiver in enumerate(self.receivers):
            arriving = paths if paths.n_rx == 1 else paths.select(paths.rx == index)
            parts.append((receiver, replace(arriving, rx=np.zeros_like(arriving.rx), n_rx=1)))
        return parts


@dataclass(frozen=True)
class PowerInstrument(Instrument):
    """Received power in dBm for 0 dBm sent, [n_rx, n_tx], NaN where no path arrives: powers of paths are added."""

    def observe(self, paths: Paths) -> NDArray[Any]:
        """Received power, see `wrf_mi.receivers.rssi_dbm`."""
        return rssi_dbm(paths)


@dataclass(frozen=True)
class ChannelInstrument(Instrument):
    """Channel coefficients, [n_rx, n_tx, k], or [n_rx, n_tx, m, k] of receivers with m antennas: fields are added."""

    def observe(self, paths: Paths) -> NDArray[Any]:
        """Channel coefficients, see `wrf_mi.receivers.csi` and `wrf_mi.receivers.antenna_csi`."""
        if all(receiver.array_m is None for receiver in self.receivers):
            return csi(paths, self.frequencies_hz)
        channels = [
            antenna_csi(arriving, receiver, receiver.array_m, self.frequencies_hz)[0]
            for receiver, arriving in self.by_receiver(paths)
            if receiver.array_m is not None
        ]
        return np.stack(channels)


@dataclass(frozen=True)
class SpectrumInstrument(Instrument):
    """Bartlett spectra [n_rx, n_tx, height, width], each scaled by its minimum and maximum as instruments do.

    With a phase error a spectrum is the mean over draws of the paths' phases, its expectation: a mesh that is off by
    centimetres knows the powers of paths, but not how they interfere, and a spectrum of wrong phases has maxima and
    zeros at wrong places. Draws of a path are the same in every call.

    Attributes:
        size: height and width of a spectrum.
        phase_error: standard deviation of the phase that each interaction but transmission adds, rad, independently.
    """

    size: tuple[int, int] = (90, 360)
    phase_error: float = 0.0

    def observe(self, paths: Paths) -> NDArray[np.float32]:
        """Spectra in 0..1, see `wrf_mi.receivers.bartlett_spectrum`; all 0 where no path arrives."""
        images = np.zeros((len(self.receivers), paths.n_tx, *self.size), np.float32)
        for index, (receiver, arriving) in enumerate(self.by_receiver(paths)):
            assert receiver.array_m is not None, "see the task's instrument"
            draws = _with_phases(arriving, self.phase_error) if self.phase_error else [arriving]
            for drawn in draws:
                signals = antenna_csi(drawn, receiver, receiver.array_m, self.carrier_hz)[0, ..., 0]
                # Float64 spectra of all would take several times the memory of the result.
                for start in range(0, len(signals), CHUNK_SIZE):
                    rows = slice(start, start + CHUNK_SIZE)
                    spectra = bartlett_spectrum(signals[rows], receiver.array_m, self.carrier_hz, *self.size)
                    images[index, rows] += minmax_scale(spectra) / len(draws)
        return images


def phase_draws(count: int) -> FloatArray:
    """`DRAWS` quantiles of a standard normal variable for each of ``count`` paths [count, DRAWS], in random order.

    Those of a path are the same for any number of others.
    """
    order = np.random.default_rng(0).random((count, DRAWS)).argsort(axis=1)
    return np.asarray(ndtri((order + 0.5) / DRAWS), float)


def _with_phases(paths: Paths, phase_error: float) -> list[Paths]:
    """A receiver's paths with `DRAWS` draws of their uncertain phases.

    The draws of a path are quantiles in random order, by its number among the paths of its transmitter, so that spectra
    do not depend on others.
    """
    number = np.arange(len(paths)) - np.searchsorted(paths.tx, paths.tx)
    drawn = phase_draws(int(number.max(initial=0)) + 1)[number]
    interactions = ((paths.interactions != 0) & (paths.interactions != TRANSMISSION)).sum(axis=1)
    phase = phase_error * np.sqrt(interactions)[:, None] * drawn
    return [replace(paths, gain=paths.gain * np.exp(1j * angle)) for angle in phase.T]
