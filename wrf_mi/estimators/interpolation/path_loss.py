"""The log-distance path-loss law P(d) = T - 10 gamma log10(d): power T at one metre, exponent gamma.

Source: Rappaport, "Wireless Communications" (2002), section 4.9.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...core.angles import FloatArray

NEAREST_M = 0.01  # least distance of two antennas in the law: below 1 cm none is a point
FREE_SPACE = 2.0  # exponent of the distance in free space


@dataclass(frozen=True)
class Trend:
    """Columns of a trend: one unknown mean, or the log-distance law a + b 10 log10(d).

    Source: Rappaport, "Wireless Communications" (2002), section 4.9.
    """

    receiver_m: FloatArray | None = None  # position [3] from which d is the distance, metres; None: one unknown mean

    def __call__(self, positions_m: FloatArray) -> FloatArray:
        """Columns [n, p] at positions [n, 3]."""
        mean = np.ones(len(positions_m))
        if self.receiver_m is None:
            return mean[:, None]
        # The logarithm must not diverge on a transmitter at the receiver.
        distance = np.maximum(np.linalg.norm(positions_m - self.receiver_m, axis=1), NEAREST_M)
        return np.stack([mean, 10 * np.log10(distance)], axis=1)


def shows_exponent(columns: FloatArray, power_dbm: NDArray[np.floating]) -> bool:
    """Whether received rows are at two distances or more; arguments as of `fit_path_loss`."""
    received = np.isfinite(power_dbm)
    return int(received.sum()) > 1 and bool(np.ptp(columns[received][:, 1]) > 0)


def fit_path_loss(columns: FloatArray, power_dbm: NDArray[np.floating], exponent: float = FREE_SPACE) -> FloatArray:
    """Power at one metre in dBm and minus the exponent [2], by least squares.

    Args:
        columns: columns of `Trend` at the positions of rows [..., 2].
        power_dbm: what was received [...], NaN where nothing was.
        exponent: exponent of rows that are all at one distance, which state a level alone.
    """
    received = np.isfinite(power_dbm)
    x, y = columns[received], np.asarray(power_dbm[received], float)
    if shows_exponent(columns, power_dbm):
        return np.asarray(np.linalg.lstsq(x, y, rcond=None)[0])
    return np.array([np.mean(y + exponent * x[:, 1]) if len(y) else 0.0, -exponent])
