"""Ray-traced spatial spectra, as the instrument would report them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core import Receiver
from ..receivers.array import bartlett_spectrum, minmax_scale
from ..receivers.channel import element_signals
from .options import DEFAULTS, TraceOptions
from .solve import trace_paths


def trace_spectra(
    scene: Any,
    tx_pos_m: ArrayLike,
    receiver: Receiver,
    array_m: ArrayLike,
    frequency_hz: float,
    *,
    height: int = 90,
    width: int = 360,
    options: TraceOptions = DEFAULTS,
    progress: bool = False,
) -> NDArray[np.float32]:
    """Ray-traced spatial spectra in the form in which the instrument reports them.

    Args:
        scene: from `wrf_mi.tracing.open_scene`, opened at ``frequency_hz``.
        tx_pos_m: transmitter positions [n, 3], world frame, metres.
        receiver: pose of the array.
        array_m: its elements [m, 3] in the array's frame, metres.
        frequency_hz: of the carrier.
        height: elevations of the spectrum.
        width: azimuths of the spectrum.
        options: what is traced.
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
    paths = trace_paths(scene, tx_pos_m, receiver, options, progress).paths
    signals = element_signals(paths, receiver, array_m, frequency_hz)[0]
    return minmax_scale(bartlett_spectrum(signals, array_m, frequency_hz, height, width)).astype(np.float32)
