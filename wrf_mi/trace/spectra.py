"""From traced paths to what an antenna array reports."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.constants import speed_of_light

from ..core import Receiver
from ..core.angles import FloatArray
from ..receive.array import bartlett_spectrum, minmax_scale
from .paths import SpecularPaths, trace_paths


def element_signals(
    paths: SpecularPaths, receiver: Receiver, positions_m: ArrayLike, frequency_hz: float
) -> NDArray[np.complex128]:
    """Coherent sum of all paths at each element of an array: sum over paths of g (d / d_m) exp(-j k d_m).

    Each specular path is a spherical wave from its image source, which lies at the path's unfolded length d from the
    array's origin in the direction of arrival; d_m is its distance to element m. For flat mirrors that is exact, near
    field included; what it leaves out is that a path may be blocked for some elements only, and that the
    reflection coefficient is that of the array's origin.

    Args:
        paths: traced to the array's origin.
        receiver: pose of the array.
        positions_m: elements [m, 3] in the array's frame, metres.
        frequency_hz: of the carrier.

    Returns:
        Complex signals [n_transmitters, m], 0 where no path arrives.

    Source: image method, Balanis, "Advanced Engineering Electromagnetics" (2012), section 7.4.
    """
    wavenumber = 2 * np.pi * frequency_hz / speed_of_light
    elements = np.asarray(positions_m, float) @ receiver.to_world.T
    image = paths.direction * paths.length_m[:, None]
    distance = np.linalg.norm(image[:, None, :] - elements[None], axis=-1)
    waves = (paths.gain * paths.length_m)[:, None] / distance * np.exp(-1j * wavenumber * distance)
    signals = np.zeros((paths.n_transmitters, len(elements)), np.complex128)
    np.add.at(signals, paths.transmitter, waves)
    return signals


def trace_spectra(
    scene: Any,
    tx_pos_m: ArrayLike,
    receiver: Receiver,
    array_m: FloatArray,
    frequency_hz: float,
    *,
    height: int = 90,
    width: int = 360,
    max_depth: int = 3,
    refraction: bool = False,
    seed: int = 1,
    progress: bool = False,
) -> NDArray[np.float32]:
    """Ray-traced spatial spectra in the form in which the instrument reports them.

    Args:
        scene: from `wrf_mi.trace.open_scene`, opened at ``frequency_hz``.
        tx_pos_m: transmitter positions [n, 3], world frame, metres.
        receiver: pose of the array.
        array_m: its elements [m, 3] in the array's frame, metres.
        frequency_hz: of the carrier.
        height: elevations of the spectrum.
        width: azimuths of the spectrum.
        max_depth: reflections per path at most.
        refraction: see `trace_paths`.
        seed: of the rays.
        progress: show a progress bar on standard error.

    Returns:
        Bartlett spectra [n, height, width], each scaled to its own minimum and maximum, 0..1; all 0 where no path
        arrives.

    Raises:
        ValueError: the scene is set to another frequency.
    """
    scene_hz = float(scene.frequency[0])
    if not np.isclose(scene_hz, frequency_hz, rtol=1e-6):  # the scene keeps it in float32
        raise ValueError(f"trace_spectra: the scene is at {scene_hz:g} Hz, not {frequency_hz:g}; open it at that")
    paths = trace_paths(
        scene, tx_pos_m, receiver, max_depth=max_depth, refraction=refraction, seed=seed, progress=progress
    )
    signals = element_signals(paths, receiver, array_m, frequency_hz)
    return minmax_scale(bartlett_spectrum(signals, array_m, frequency_hz, height, width)).astype(np.float32)
