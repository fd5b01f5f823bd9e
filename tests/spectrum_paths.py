"""Paths of several transmitters with reflections and transmissions, made up."""

from __future__ import annotations

import numpy as np

from wrf_mi.core import Paths


def made_paths(seed: int, n_tx: int = 5, each: int = 6) -> Paths:
    """The direct path and some with up to three interactions for each transmitter but the last, which has none."""
    rng = np.random.default_rng(seed)
    count = each * (n_tx - 1)
    up = rng.normal(size=(count, 3))
    up[:, 2] = np.abs(up[:, 2])
    direction = up / np.linalg.norm(up, axis=1, keepdims=True)
    kinds = rng.choice([0, 1, 1, 4], size=(count, 3))
    kinds[::each] = 0
    return Paths(
        tx=np.repeat(np.arange(n_tx - 1), each),
        rx=np.zeros(count, np.int64),
        gain=rng.normal(size=count) + 1j * rng.normal(size=count),
        length_m=np.sort(rng.uniform(2, 9, (n_tx - 1, each)), axis=1).ravel(),
        departure=-direction,
        arrival=direction,
        interactions=np.sort(kinds, axis=1)[:, ::-1].astype(np.uint8),
        vertices_m=np.full((count, 3, 3), np.nan),
        objects=np.full((count, 3), -1, np.int32),
        object_names=(),
        n_tx=n_tx,
        n_rx=1,
    )
