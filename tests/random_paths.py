"""Paths by their sums: gains, lengths and directions without places of interactions."""

from typing import Any

import numpy as np

from wrf_mi.core import Paths


def paths_of(tx: Any, rx: Any, gain: Any, length_m: Any, arrival: Any, n_tx: int, n_rx: int, kinds: Any = None) -> Paths:
    """Paths whose departures are opposite to their arrivals [n, 3]; ``kinds``: their interactions [n, k], else none."""
    kinds = np.zeros((len(tx), 1)) if kinds is None else kinds
    places, objects = np.full((*kinds.shape, 3), np.nan), np.full(kinds.shape, -1, np.int32)
    kinds = kinds.astype(np.uint8)
    return Paths(tx, rx, gain, length_m, -arrival, arrival, kinds, places, objects, object_names=(), n_tx=n_tx, n_rx=n_rx)
