"""Paths by their sums: gains, lengths and directions without places of interactions."""

from typing import Any

import numpy as np

from wrf_mi.core import Paths


def paths_of(tx, rx, gain, length_m, arrival, n_tx: int, n_rx: int, kinds: Any = None) -> Paths:
    """Paths whose departures are opposite to their arrivals [n, 3]; ``kinds``: their interactions [n, k], else none."""
    kinds = np.zeros((len(tx), 1), np.uint8) if kinds is None else kinds.astype(np.uint8)
    places, objects = np.full((*kinds.shape, 3), np.nan), np.full(kinds.shape, -1, np.int32)
    return Paths(tx, rx, gain, length_m, -arrival, arrival, kinds, places, objects, (), n_tx, n_rx)
