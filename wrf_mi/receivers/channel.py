"""What instruments report of traced paths: array signals, channel coefficients, signal strength."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.constants import speed_of_light

from ..core import Paths, Receiver
from ..core.angles import FloatArray

ComplexArray = NDArray[np.complex128]

PAIRS_PER_CHUNK = 1 << 22
"""Pairs of path and array element or subcarrier at once: 64 MiB of complex numbers for each of a few."""
WAVES_PER_CHUNK = 1 << 20
"""Pairs of path and antenna whose waves turn from subcarrier to subcarrier: less, as each is gone through again."""


def element_signals(
    paths: Paths, receivers: Receiver | Sequence[Receiver], positions_m: ArrayLike, frequency_hz: float
) -> ComplexArray:
    """Coherent sum of all paths at each element of an array: sum over paths of g (d / d_m) exp(-j k d_m).

    Each specular path is a spherical wave from its image source, which lies at the path's unfolded length d from the
    array's origin in the direction of arrival; d_m is its distance to element m. For flat mirrors that is exact, near
    field included; what it leaves out is that a path may be blocked for some elements only, and that the
    reflection coefficient is that of the array's origin.

    Args:
        paths: traced to the arrays' origins.
        receivers: poses of the ``n_rx`` arrays.
        positions_m: elements [m, 3] in the array's frame, metres.
        frequency_hz: of the carrier.

    Returns:
        Complex signals [n_rx, n_tx, m], 0 where no path arrives.

    Source: image method, Balanis, "Advanced Engineering Electromagnetics" (2012), section 7.4.
    """
    wavenumber = 2 * np.pi * frequency_hz / speed_of_light
    everyone = (receivers,) if isinstance(receivers, Receiver) else tuple(receivers)
    elements = np.stack([np.asarray(positions_m, float) @ receiver.to_world.T for receiver in everyone])
    signals = np.zeros((paths.n_rx, paths.n_tx, elements.shape[1]), np.complex128)
    step = max(1, PAIRS_PER_CHUNK // elements.shape[1])
    for start in range(0, len(paths), step):
        part = slice(start, start + step)
        length, rx = paths.length_m[part, None], paths.rx[part]
        image = paths.arrival[part] * length
        distance = np.linalg.norm(image[:, None, :] - elements[rx], axis=-1)
        waves = paths.gain[part, None] * length / distance * np.exp(-1j * wavenumber * distance)
        np.add.at(signals, (rx, paths.tx[part]), waves)
    return signals


def csi(paths: Paths, frequencies_hz: ArrayLike) -> ComplexArray:
    """Channel coefficient per subcarrier: sum over paths of gain exp(-j 2 pi f length / c).

    Gains are taken to be those of the carrier at every subcarrier; phases are computed in float64.

    Args:
        paths: traced at the carrier.
        frequencies_hz: of the subcarriers, shape [k].

    Returns:
        Shape [n_rx, n_tx, k], 0 where no path arrives.
    """
    frequencies = np.atleast_1d(np.asarray(frequencies_hz, float))
    channel = np.zeros((paths.n_rx, paths.n_tx, len(frequencies)), np.complex128)
    step = max(1, PAIRS_PER_CHUNK // len(frequencies))
    for start in range(0, len(paths), step):
        part = slice(start, start + step)
        phase = np.exp(-2j * np.pi / speed_of_light * paths.length_m[part, None] * frequencies)
        np.add.at(channel, (paths.rx[part], paths.tx[part]), paths.gain[part, None] * phase)
    return channel


def antenna_csi(
    paths: Paths, receivers: Receiver | Sequence[Receiver], positions_m: ArrayLike, frequencies_hz: ArrayLike
) -> ComplexArray:
    """Channel coefficient at each antenna of arrays per subcarrier; spherical waves as in `element_signals`.

    Args:
        paths: traced to the arrays' origins at the carrier, sorted by receiver and transmitter.
        receivers: poses of the ``n_rx`` arrays.
        positions_m: antennas [m, 3] in the array's frame, metres.
        frequencies_hz: of the subcarriers, shape [k].

    Returns:
        Shape [n_rx, n_tx, m, k], 0 where no path arrives.
    """
    everyone = (receivers,) if isinstance(receivers, Receiver) else tuple(receivers)
    elements = np.stack([np.asarray(positions_m, float) @ receiver.to_world.T for receiver in everyone])
    frequencies = np.atleast_1d(np.asarray(frequencies_hz, float))
    channel = np.zeros((paths.n_rx * paths.n_tx, elements.shape[1], len(frequencies)), np.complex128)
    step = max(1, WAVES_PER_CHUNK // elements.shape[1])
    for start in range(0, len(paths), step):
        part = slice(start, start + step)
        length, rx = paths.length_m[part, None], paths.rx[part]
        distance = np.linalg.norm((paths.arrival[part] * length)[:, None, :] - elements[rx], axis=-1)
        amplitude = paths.gain[part, None] * length / distance
        add_waves(channel, rx * paths.n_tx + paths.tx[part], amplitude, distance / speed_of_light, frequencies)
    return channel.reshape(paths.n_rx, paths.n_tx, *channel.shape[1:])


def add_waves(
    channel: ComplexArray,
    owner: NDArray[np.int64],
    amplitude: ComplexArray,
    delay_s: FloatArray,
    frequencies_hz: FloatArray,
) -> None:
    """Add amplitude exp(-j 2 pi f delay) of waves to the channels that they belong to.

    Args:
        channel: coefficients [n, m, k] of n channels at m antennas, added to in place.
        owner: channel of each of p waves, ascending, shape [p].
        amplitude: of each wave at each antenna, shape [p, m].
        delay_s: likewise, seconds.
        frequencies_hz: shape [k].
    """
    owners, first = np.unique(owner, return_index=True)
    gaps = np.diff(frequencies_hz)
    # From one subcarrier to the next a wave turns by one angle: a product in place of an exponential.
    turns = {gap: np.exp(-2j * np.pi * gap * delay_s) for gap in np.unique(gaps)}
    wave = amplitude * np.exp(-2j * np.pi * frequencies_hz[0] * delay_s)
    for k in range(len(frequencies_hz)):
        if k:
            wave *= turns[gaps[k - 1]]
        channel[owners, :, k] += np.add.reduceat(wave, first, axis=0)


def received_power(paths: Paths, frequencies_hz: ArrayLike | None = None) -> FloatArray:
    """Power gain of the channel between single antennas, shape [n_rx, n_tx]; 0 where no path arrives.

    Args:
        paths: traced at the carrier.
        frequencies_hz: shape [k]: waves interfere, abs(sum of fields)^2, and the power is the mean over these
            frequencies (of channels that an instrument hops over, or across its band). None: powers of the paths are
            added, what remains after averaging over positions of a wavelength or over a wide band.
    """
    if frequencies_hz is not None:
        return (np.abs(csi(paths, frequencies_hz)) ** 2).mean(axis=-1)
    power = np.zeros((paths.n_rx, paths.n_tx))
    np.add.at(power, (paths.rx, paths.tx), np.abs(paths.gain) ** 2)
    return power


def rssi_dbm(paths: Paths, tx_power_dbm: float = 0.0, frequencies_hz: ArrayLike | None = None) -> FloatArray:
    """Received signal strength in dBm, shape [n_rx, n_tx], NaN where no path arrives.

    Args:
        paths: traced at the carrier.
        tx_power_dbm: transmitted power.
        frequencies_hz: see `received_power`.
    """
    power = received_power(paths, frequencies_hz)
    decibel = np.full(power.shape, np.nan)
    np.log10(power, out=decibel, where=power > 0)
    return tx_power_dbm + 10 * decibel
