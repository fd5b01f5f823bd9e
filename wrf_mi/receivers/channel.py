"""Coherent sums of traced paths at antennas and subcarriers, received power, and draws of uncertain phases."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.constants import speed_of_light
from scipy.special import ndtri

from ..core import Paths, Receiver
from ..core.types import FloatArray, IntArray
from .scaling import strength_db

ComplexArray = NDArray[np.complex128]

WAVES_PER_CHUNK = 1 << 20  # pairs of path and antenna in one chunk: 16 MiB for each complex array
SPECULAR_KINDS = (0, 1, 4)  # kinds of interaction that keep a wave spherical: none, reflection, transmission
CERTAIN_KINDS = (0, 4)  # kinds of interaction that add no uncertain phase: none, transmission
DRAWS = 16  # draws of uncertain phases: their mean differs from that of 512 by 0.005 of grey in a furnished room


def antenna_csi(
    paths: Paths, receivers: Receiver | Sequence[Receiver], positions_m: ArrayLike, frequencies_hz: ArrayLike
) -> ComplexArray:
    """Channel coefficient of each antenna of an array per subcarrier: sum over paths of g (d / d_m) exp(-j k d_m).

    Each specular path is a spherical wave from its image source, which lies at the path's unfolded length d from the
    array's origin in the direction of arrival; d_m is its distance to antenna m. For flat mirrors that is exact, near
    field included. Not modelled: paths that are blocked for some antennas only, and the change of the reflection
    coefficient over the array.

    Args:
        paths: traced to the arrays' origins at the carrier.
        receivers: poses of the ``n_rx`` arrays.
        positions_m: antennas [m, 3] in the array's frame, metres.
        frequencies_hz: subcarriers, shape [k].

    Returns:
        Shape [n_rx, n_tx, m, k], 0 where no path arrives.

    Source: image method, Balanis, "Advanced Engineering Electromagnetics" (2012), section 7.4.
    """
    arrays = (receivers,) if isinstance(receivers, Receiver) else tuple(receivers)
    elements = np.stack([np.asarray(positions_m, float) @ receiver.to_world.T for receiver in arrays])
    channel = _spherical_waves(paths, paths.arrival, paths.length_m, elements, frequencies_hz)
    return channel.reshape(paths.n_rx, paths.n_tx, *channel.shape[1:])


def csi(paths: Paths, frequencies_hz: ArrayLike) -> ComplexArray:
    """Channel coefficient per subcarrier: sum over paths of gain exp(-j 2 pi f length / c).

    Gains are those of the carrier at every subcarrier; phases are computed in float64.

    Args:
        paths: traced at the carrier.
        frequencies_hz: subcarriers, shape [k].

    Returns:
        Shape [n_rx, n_tx, k], 0 where no path arrives.
    """
    # At the origin only lengths count: one axis for all, exact whatever the precision of the directions.
    along = np.broadcast_to([0.0, 0.0, 1.0], paths.arrival.shape)
    channel = _spherical_waves(paths, along, paths.length_m, np.zeros((paths.n_rx, 1, 3)), frequencies_hz)
    return channel.reshape(paths.n_rx, paths.n_tx, -1)


def array_channels(paths: Paths, receiver: Receiver, array_m: FloatArray, frequencies_hz: ArrayLike) -> ComplexArray:
    """Channel coefficients of paths that were traced from an array (as transmitter) to users (as receivers).

    A path reaches the array as a spherical wave from the point of its last scattering or diffraction, mirrored by the
    reflections that follow; without any, from the user's image. Phases follow each element's distance from there and
    each frequency; gains are those of the array's origin at the carrier. The second curvature of a wave that an edge
    diffracts is not modelled.

    Args:
        paths: from the array's origin, "transmitter" 0, to n users as "receivers", with gains of antennas that are
            polarised along the world's z axis.
        receiver: the array's pose.
        array_m: its elements [m, 3], metres.
        frequencies_hz: subcarriers, shape [k].

    Returns:
        Complex coefficients [n, m, k], 0 where no path arrives.
    """
    elements = np.broadcast_to(array_m @ receiver.to_world.T, (paths.n_rx, *array_m.shape))
    # Unfolded distance from the array to the source of each path's spherical wave.
    count, depth = paths.interactions.shape
    last_m = np.broadcast_to(receiver.position_m, (count, 3))
    radius, unfinished = np.zeros(count), np.ones(count, bool)
    for level in range(depth):
        kind, vertex_m = paths.interactions[:, level], paths.vertices_m[:, level]
        unfinished &= kind != 0
        radius[unfinished] += np.linalg.norm(vertex_m - last_m, axis=1)[unfinished]
        last_m = np.where(unfinished[:, None], vertex_m, last_m)
        unfinished &= np.isin(kind, SPECULAR_KINDS)
    scattered = (~np.isin(paths.interactions, SPECULAR_KINDS)).any(axis=1)
    radius = np.where(scattered, radius, paths.length_m)
    return _spherical_waves(paths, paths.departure, radius, elements, frequencies_hz)


def _spherical_waves(
    paths: Paths, direction: FloatArray, radius_m: FloatArray, elements_m: FloatArray, frequencies_hz: ArrayLike
) -> ComplexArray:
    """Sums [n_rx * n_tx, m, k] at elements [n_rx, m, 3] of waves from sources at ``radius_m`` in ``direction``."""
    frequencies = np.atleast_1d(np.asarray(frequencies_hz, float))
    channel = np.zeros((paths.n_rx * paths.n_tx, elements_m.shape[1], len(frequencies)), np.complex128)
    pair: IntArray = paths.rx * paths.n_tx + paths.tx
    order = np.argsort(pair, kind="stable")
    step = max(1, WAVES_PER_CHUNK // elements_m.shape[1])
    for start in range(0, len(paths), step):
        chunk = order[start : start + step]
        radius = radius_m[chunk, None]
        distance = np.linalg.norm((direction[chunk] * radius)[:, None, :] - elements_m[paths.rx[chunk]], axis=-1)
        delay = (paths.length_m[chunk, None] - radius + distance) / speed_of_light
        # The gain is that at the origin, ``radius`` from the wave's source: at an element the amplitude is radius /
        # distance times as large, and the way longer by distance - radius.
        wave = paths.gain[chunk, None] * radius / distance * np.exp(-2j * np.pi * frequencies[0] * delay)
        pairs, first = np.unique(pair[chunk], return_index=True)
        gap = 0.0
        for k, frequency in enumerate(frequencies):
            if k:
                # From one subcarrier to the next a wave turns by one angle: a product in place of an exponential.
                if frequency - frequencies[k - 1] != gap:
                    gap = frequency - frequencies[k - 1]
                    turn = np.exp(-2j * np.pi * gap * delay)
                wave = wave * turn
            # Paths are sorted by pair of devices, so each sum is of a run.
            channel[pairs, :, k] += np.add.reduceat(wave, first, axis=0)
    return channel


def received_power(paths: Paths) -> FloatArray:
    """Sum of the powers of all paths, shape [n_rx, n_tx]; 0 where no path arrives."""
    # Powers of paths add up after averaging over positions of a wavelength or over a wide band.
    power = np.zeros((paths.n_rx, paths.n_tx))
    np.add.at(power, (paths.rx, paths.tx), np.abs(paths.gain) ** 2)
    return power


def rssi_dbm(paths: Paths) -> FloatArray:
    """Received signal strength in dBm for 0 dBm sent, shape [n_rx, n_tx], NaN where no path arrives."""
    return np.asarray(strength_db(received_power(paths)))


def phase_draws(count: int) -> FloatArray:
    """`DRAWS` quantiles of a standard normal variable for each of ``count`` paths [count, DRAWS], in random order."""
    # Those of a path are the same for any number of others.
    order = np.random.default_rng(0).random((count, DRAWS)).argsort(axis=1)
    return np.asarray(ndtri((order + 0.5) / DRAWS), float)


def with_phase_errors(paths: Paths, phase_error: float) -> list[Paths]:
    """`DRAWS` copies of a receiver's paths, with phases to each reflection of which a normal error was added.

    A mesh that is off by centimetres knows the powers of paths, but not how they interfere. ``phase_error`` is the
    standard deviation of the phase that each interaction but transmission adds, rad, independently.
    """
    # Draws by a path's number among those of its transmitter, so that they do not depend on other transmitters.
    number = np.arange(len(paths)) - np.searchsorted(paths.tx, paths.tx)
    draws = phase_draws(int(number.max(initial=0)) + 1)[number]
    uncertain = (~np.isin(paths.interactions, CERTAIN_KINDS)).sum(axis=1)
    # Independent errors of interactions add as squares.
    phase = phase_error * np.sqrt(uncertain)[:, None] * draws
    return [replace(paths, gain=paths.gain * np.exp(1j * angle)) for angle in phase.T]
