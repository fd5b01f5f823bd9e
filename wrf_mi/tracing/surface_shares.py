"""How much of the received power depends on the loss at each surface: derivatives of strengths by surfaces."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..core import Antenna, Receiver
from ..core.angles import FloatArray
from .options import TraceOptions
from .paths.solve import Prepared, trace_paths
from .search.devices import solid_around


def surface_shares(
    scene: Any, tx_pos_m: FloatArray, receivers: Sequence[Receiver], options: TraceOptions, tx_antenna: Antenna
) -> tuple[tuple[str, ...], FloatArray]:
    """Names of surfaces, and derivatives [n_rx, m, surfaces] of received powers by the dB that an interaction adds.

    The power of transmitters [m, 3] is a sum over paths, so the derivative is the mean number of interactions of a path
    with the surface, weighted by power. 0 without a path and for transmitters inside solids.
    """
    prepared = Prepared(scene)
    outside = np.flatnonzero(solid_around(prepared.surfaces, tx_pos_m) < 0)
    how: dict[str, Any] = {"prepared": prepared, "tx_antenna": tx_antenna, "check": False}
    paths = trace_paths(scene, tx_pos_m[outside], receivers, options, **how).paths
    power, pair = np.abs(paths.gain) ** 2, paths.rx * len(outside) + paths.tx
    pairs, surfaces = len(receivers) * len(outside), len(paths.object_names)
    total, sums = np.bincount(pair, power, minlength=pairs), np.zeros(pairs * surfaces)
    for surface in paths.objects.T:  # one interaction of each path
        met = surface >= 0
        sums += np.bincount(pair[met] * surfaces + surface[met], power[met], minlength=len(sums))
    mean = sums.reshape(pairs, surfaces) / np.maximum(total, np.finfo(float).tiny)[:, None]
    shares = np.zeros((len(receivers), len(tx_pos_m), surfaces))
    shares[:, outside] = mean.reshape(len(receivers), len(outside), surfaces)
    return tuple(paths.object_names), shares
