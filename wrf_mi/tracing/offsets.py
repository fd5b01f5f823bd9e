"""The one thing that ray tracing cannot know of an uncalibrated receiver: what its decibels count from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..core import InputError
from ..core.angles import FloatArray


@dataclass(frozen=True)
class Offsets:
    """What is added to traced signal strengths.

    Attributes:
        offset_db: of each receiver, shape [n_rx].
        floor_dbm: weakest signal that each receiver is known to report, shape [n_rx]; it stands in for positions
            where no path arrives.
    """

    offset_db: FloatArray
    floor_dbm: FloatArray

    def __call__(self, traced_dbm: ArrayLike) -> FloatArray:
        """Traced signal strengths [n_rx, n] (dBm for 0 dBm sent, NaN without a path) on the receivers' scales."""
        moved = np.asarray(traced_dbm, float) + self.offset_db[:, None]
        return np.where(np.isnan(moved), self.floor_dbm[:, None], moved)


def fit_offsets(traced_dbm: ArrayLike, measured_dbm: ArrayLike) -> Offsets:
    """One offset per receiver, the median of measured minus traced, which makes the absolute error least.

    Args:
        traced_dbm: shape [n_rx, n], NaN where no path arrives.
        measured_dbm: training rows of the same shape, NaN where nothing was received.

    Raises:
        InputError: a receiver without any row that was both traced and received.
    """
    traced, measured = np.asarray(traced_dbm, float), np.asarray(measured_dbm, float)
    difference = measured - traced
    for receiver, known in enumerate(~np.isnan(difference)):
        if not known.any():
            raise InputError(
                f"receiver {receiver}: no training row is both received and reached by a path; trace more kinds of path"
            )
    return Offsets(np.nanmedian(difference, axis=1), np.nanmin(measured, axis=1))
