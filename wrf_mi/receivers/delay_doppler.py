"""Channels over time, and delay-Doppler spectra, of paths whose lengths change by motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.constants import speed_of_light

from ..core import InputError, Paths
from ..core.memory import require_memory
from ..core.types import FloatArray
from .channel import csi

TIMES, FEWEST_SUBCARRIERS, MOST_SUBCARRIERS = 64, 64, 1 << 16
TIMES_PER_PERIOD = 2.5  # samples in a period of the largest shift: above 2, so that no shift is aliased


@dataclass(frozen=True)
class Sampling:
    """Subcarriers and times at which a channel is sampled, evenly spaced.

    Attributes:
        frequencies_hz: subcarriers [k], Hz, around the carrier.
        times_s: times [t] from 0, s.
    """

    frequencies_hz: FloatArray
    times_s: FloatArray

    @classmethod
    def of_paths(cls, paths: Paths, carrier_hz: float, bandwidth_hz: float) -> Sampling:
        """Sampling that aliases no path: enough subcarriers for the longest delay, and times for the largest shift.

        The times span 64 / 2.5, some 26 periods of the largest Doppler shift, in which that path changes by as many
        wavelengths; the Doppler resolution is 4 % of that shift.

        Raises:
            InputError: a bandwidth that is not in (0, 2 carrier_hz), paths at rest, or too many subcarriers.
        """
        if not 0 < bandwidth_hz < 2 * carrier_hz:
            raise InputError(f"bandwidth {bandwidth_hz:g} Hz: give a number above 0, below twice {carrier_hz:g} Hz")
        largest_hz = float(np.abs(paths.doppler_hz(carrier_hz + bandwidth_hz / 2)).max(initial=0.0))
        if not largest_hz:
            raise InputError("no path changes: transmitters, receivers and the objects that paths meet are at rest")
        longest = bandwidth_hz * float(paths.length_m.max()) / speed_of_light
        count = max(FEWEST_SUBCARRIERS, 1 << int(np.ceil(np.log2(longest + 1))))
        if count > MOST_SUBCARRIERS:
            text = f"delays to {longest / bandwidth_hz:.3g} s take {count} subcarriers, above {MOST_SUBCARRIERS}"
            raise InputError(f"bandwidth {bandwidth_hz:g} Hz: {text}; give a smaller bandwidth")
        frequencies_hz = carrier_hz + (np.arange(count) / count - 0.5) * bandwidth_hz
        return cls(frequencies_hz, np.arange(TIMES) / (TIMES_PER_PERIOD * largest_hz))

    @property
    def delays_s(self) -> FloatArray:
        """Delays [k] of the bins of a delay-Doppler spectrum, s; their spacing is 1 / bandwidth."""
        return np.arange(len(self.frequencies_hz)) / (len(self.frequencies_hz) * _step(self.frequencies_hz))

    @property
    def dopplers_hz(self) -> FloatArray:
        """Doppler shifts [t] of the bins of a delay-Doppler spectrum, ascending, Hz."""
        return np.fft.fftshift(np.fft.fftfreq(len(self.times_s), _step(self.times_s)))


def _step(values: FloatArray) -> float:
    return float(values[1] - values[0])


def csi_over_time(paths: Paths, sampling: Sampling) -> NDArray[np.complex64]:
    """Channel coefficients [n_rx, n_tx, t, k] at the times and subcarriers of a `Sampling`.

    A sum over paths of gain exp(-j 2 pi f (length + t rate) / c): gains stay, and each subcarrier has its own Doppler
    shift. At the carrier it is ``sionna.rt.Paths.cfr`` with ``num_time_steps``, without normalised delays.

    Raises:
        InputError: channels that do not fit into memory.
    """
    shape = paths.n_rx, paths.n_tx, len(sampling.times_s), len(sampling.frequencies_hz)
    # Of the result, of its spectrum while that is computed, and of the spectrum.
    require_memory(4 * 8 * int(np.prod(shape)), "channels over time", "give fewer rows, or a smaller bandwidth")
    channel = np.empty(shape, np.complex64)
    for number, seconds in enumerate(sampling.times_s):
        channel[:, :, number] = csi(paths.after(float(seconds)), sampling.frequencies_hz)
    return channel


def delay_doppler_spectrum(channel: NDArray[np.complex64]) -> NDArray[np.float32]:
    """Power [..., delay, Doppler shift] of channels [..., t, k] over time and subcarriers.

    |(1 / (t k)) sum over times n and subcarriers m of h[n, m] exp(j 2 pi m l / k) exp(-j 2 pi n d / t)|^2 at delay l
    and Doppler shift d, on the axes `Sampling.delays_s` and `Sampling.dopplers_hz`: a path in the middle of a bin has
    the power of its gain.
    """
    over_delays = np.fft.ifft(channel, axis=-1)
    spectrum = np.fft.fftshift(np.fft.fft(over_delays, axis=-2, norm="forward"), axes=-2)
    return np.swapaxes(np.abs(spectrum) ** 2, -1, -2).astype(np.float32)
