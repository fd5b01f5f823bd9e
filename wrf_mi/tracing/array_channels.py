"""Channels between an array and users from paths that were traced from the array's middle."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.constants import speed_of_light

from ..core import Paths, Receiver
from ..core.angles import FloatArray
from ..receivers.channel import WAVES_PER_CHUNK, add_waves

SPECULAR_OR_THROUGH = (0, 1, 4)
"""Kinds of interaction (`wrf_mi.core.Paths`) that leave a spherical wave spherical."""


def array_channels(
    paths: Paths, receiver: Receiver, array_m: FloatArray, frequencies_hz: ArrayLike
) -> NDArray[np.complex128]:
    """Channel coefficients of paths that were traced from an array (as transmitter) to users (as receivers).

    A path reaches the array as a spherical wave from the place of its last scattering or diffraction, mirrored by what
    reflects it after that; without any, from the user's image. Phases follow each element's distance from there and
    each frequency; gains are those of the array's middle at the carrier. At an edge the wave has another curvature
    along the edge, which is left out.

    Args:
        paths: from the array's middle, "transmitter" 0, to n users as "receivers", sorted by these, with gains of
            antennas that are polarised along the world's z axis.
        receiver: the array's pose.
        array_m: its elements [m, 3], metres.
        frequencies_hz: of the subcarriers, shape [k].

    Returns:
        Complex coefficients [n, m, k], 0 where no path arrives.
    """
    frequencies = np.atleast_1d(np.asarray(frequencies_hz, float))
    radius, elements = _wave_radius(paths, receiver), array_m @ receiver.to_world.T
    channel = np.zeros((paths.n_rx, len(array_m), len(frequencies)), complex)
    step = max(1, WAVES_PER_CHUNK // len(array_m))
    for start in range(0, len(paths), step):
        part = slice(start, start + step)
        own = radius[part, None]
        distance = np.linalg.norm((paths.departure[part] * own)[:, None, :] - elements, axis=-1)
        delay_s = (paths.length_m[part, None] - own + distance) / speed_of_light
        add_waves(channel, paths.rx[part], paths.gain[part, None] * own / distance, delay_s, frequencies)
    return channel


def _wave_radius(paths: Paths, receiver: Receiver) -> FloatArray:
    """Unfolded distance [p] from the array to where each path's spherical wave begins."""
    count, depth = paths.interactions.shape
    here = np.broadcast_to(receiver.position_m, (count, 3))
    radius, open_ = np.zeros(count), np.ones(count, bool)
    for level in range(depth):
        kind, there = paths.interactions[:, level], paths.vertices_m[:, level]
        open_ &= kind != 0
        radius[open_] += np.linalg.norm(there - here, axis=1)[open_]
        here = np.where(open_[:, None], there, here)
        open_ &= np.isin(kind, SPECULAR_OR_THROUGH)
    point = (~np.isin(paths.interactions, SPECULAR_OR_THROUGH)).any(axis=1)
    return np.where(point, radius, paths.length_m)
