"""Offsets of uncalibrated receivers: traced signal strengths on the scales of the receivers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..core import InputError
from ..core.angles import FloatArray


@dataclass(frozen=True)
class Offsets:
    """Offsets of traced signal strengths.

    Attributes:
        offset_db: offset of each receiver, shape [n_rx].
        floor_dbm: weakest measured signal of each receiver, shape [n_rx], the report where no path arrives.
    """

    offset_db: FloatArray
    floor_dbm: FloatArray

    def __call__(self, traced_dbm: ArrayLike) -> FloatArray:
        """Traced signal strengths [n_rx, n] (dBm for 0 dBm sent, NaN without a path) on the receivers' scales."""
        moved = np.asarray(traced_dbm, float) + self.offset_db[:, None]
        return np.where(np.isnan(moved), self.floor_dbm[:, None], moved)


def fit_offsets(traced_dbm: ArrayLike, measured_dbm: ArrayLike) -> Offsets:
    """Fit an offset to each receiver: the median of measured minus traced, which minimises the absolute error.

    A receiver that received nothing takes the mean offset of the others, and their weakest signal.

    Args:
        traced_dbm: shape [n_rx, n], NaN where no path arrives.
        measured_dbm: measured training rows [n_rx, n], NaN where nothing was received.

    Raises:
        InputError: a receiver that received rows, but none that was traced.
    """
    traced, measured = np.asarray(traced_dbm, float), np.asarray(measured_dbm, float)
    difference = measured - traced
    heard = ~np.isnan(measured).all(axis=1)
    for receiver, known in enumerate(~np.isnan(difference)):
        if heard[receiver] and not known.any():
            raise InputError(
                f"receiver {receiver}: no training row is both received and reached by a path; trace more kinds of path"
            )
    offset_db, floor_dbm = np.empty((2, len(measured)))
    offset_db[heard], floor_dbm[heard] = np.nanmedian(difference[heard], axis=1), np.nanmin(measured[heard], axis=1)
    offset_db[~heard], floor_dbm[~heard] = offset_db[heard].mean(), floor_dbm[heard].min()
    return Offsets(offset_db, floor_dbm)
