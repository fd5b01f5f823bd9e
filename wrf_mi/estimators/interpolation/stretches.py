"""Stretches and runs of a measurement that are held out of kriging of signal strengths."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.spatial import cKDTree

from ...core.angles import FloatArray
from ...core.types import IntArray

FOLDS = 7
STRETCH = (4, 150)
"""Bounds of the rows of a held-out stretch, else a fourteenth of all rows, so that each fold holds at least two."""
PLACE_M = 0.1  # grid whose cells are places: readings at a stop differ by what positions are known to
BUFFER = 0.25  # share of a stretch that is left out on either side of it, as consecutive rows share noise


def scales(position_m: FloatArray) -> tuple[float, float]:
    """Median distance to the nearest other position, and diagonal of the box around positions [n, 3], metres."""
    places = np.unique(position_m, axis=0)
    extent_m = float(np.linalg.norm(np.ptp(places, axis=0)))
    spacing_m = float(np.median(cKDTree(places).query(places, k=2)[0][:, 1])) if len(places) > 1 else 0.0
    return spacing_m, extent_m


def folds(position_m: FloatArray, number_of_folds: int = FOLDS) -> Iterator[tuple[IntArray, IntArray]]:
    """Training rows and held-out rows of each fold, as indices of positions [n, 3] in metres.

    Stretches of the record's order are held out. Where that is the order of time, as along a path, a stretch is
    predicted like another run: from other visits, not from the preceding row. All readings of a place are in the
    stretch of the first: lengths that other readings of the same place choose fit those, and no place in between.
    """
    count = len(position_m)
    _, first, place = np.unique(np.round(position_m / PLACE_M), axis=0, return_index=True, return_inverse=True)
    visit = first[place.reshape(-1)]
    order = np.argsort(visit, kind="stable")
    begins = np.searchsorted(visit[order], visit[order])
    stretch = int(np.clip(count // (2 * number_of_folds), *STRETCH))
    number = begins // stretch
    for fold in range(min(number_of_folds, int(number[-1]) + 1)):
        out = number % number_of_folds == fold
        near = out.copy()
        for step in range(1, int(stretch * BUFFER) + 1):
            near[step:] |= out[:-step]
            near[:-step] |= out[step:]
        if out.any() and not near.all():
            yield np.sort(order[~near]), np.sort(order[out])


def run_folds(run: IntArray) -> Iterator[tuple[IntArray, IntArray]]:
    """Training rows and held-out rows of each fold, as indices, that hold out whole runs by their numbers [n]."""
    number = np.unique(run, return_inverse=True)[1].reshape(-1) % FOLDS
    for fold in range(int(number.max()) + 1):
        yield np.flatnonzero(number != fold), np.flatnonzero(number == fold)
