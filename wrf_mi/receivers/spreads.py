"""Gain, delay spread, angular spread and K-factor of the paths that arrive at a receiver."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.constants import speed_of_light

from ..core import Paths
from ..core.types import FloatArray, IntArray

SURE = 1e-12  # concentrations of azimuths above 1 - SURE count as 1: rounding of float64


@dataclass(frozen=True)
class PathStatistics:
    """Statistics of the paths from m transmitters to one receiver; NaN where no path arrives.

    Attributes:
        path_gain_db: sum of the powers of the paths for a power of one sent, antennas' patterns included, [m], dB.
        delay_spread_s: root mean square of the delay about its mean, weighted by power, [m], seconds. Source:
            Rappaport, "Wireless Communications" (2002), section 5.4.1.
        azimuth_spread_deg: circular standard deviation sqrt(-2 ln |sum P exp(j phi)| / sum P) of the azimuth of
            arrival in the world frame, weighted by power, [m], degrees. Source: 3GPP TR 38.901, annex A.1.
        k_factor_db: power of the strongest path over that of all others together, [m], dB; infinite for one path
            alone. Source: as Rice's K-factor, Rappaport, section 5.6.2, with the strongest path as the dominant one.
    """

    path_gain_db: FloatArray
    delay_spread_s: FloatArray
    azimuth_spread_deg: FloatArray
    k_factor_db: FloatArray

    @classmethod
    def of_paths(
        cls, transmitter: IntArray, count: int, power: FloatArray, length_m: FloatArray, arrival: FloatArray
    ) -> PathStatistics:
        """Statistics of p paths.

        Args:
            transmitter: number of each path's transmitter [p].
            count: number m of transmitters.
            power: power gain of each path [p].
            length_m: unfolded length of each path [p], metres.
            arrival: unit vectors towards the incoming waves [p, 3], world frame.
        """
        arriving = power > 0
        transmitter, power, length_m = transmitter[arriving], power[arriving], length_m[arriving]

        def total(values: NDArray[Any]) -> FloatArray:
            return np.asarray(np.bincount(transmitter, power * values, count), float)

        with np.errstate(divide="ignore", invalid="ignore"):
            gain = total(np.ones(len(power)))
            gain[gain == 0] = np.nan  # makes every statistic NaN
            # About the first delay of each transmitter, as variances about zero cancel.
            first_m = np.full(count, np.inf)
            np.minimum.at(first_m, transmitter, length_m)
            excess = (length_m - first_m[transmitter]) / speed_of_light
            mean = total(excess) / gain
            spread = np.sqrt(total(np.square(excess - mean[transmitter])) / gain)
            level = arrival[arriving, :2]
            size = np.linalg.norm(level, axis=1)  # vertical paths have no azimuth
            sums = [total(part / np.where(size > 0, size, 1.0)) for part in level.T]
            concentration = np.hypot(*sums) / total(size > 0)
            concentration[concentration > 1 - SURE] = 1.0
            azimuth = np.degrees(np.sqrt(-2 * np.log(concentration)))
            strongest = np.zeros(count)
            np.maximum.at(strongest, transmitter, power)
            single = np.bincount(transmitter, minlength=count) == 1
            others = np.where(single, 0.0, gain - strongest)
            return cls(10 * np.log10(gain), spread, azimuth, 10 * np.log10(strongest / others))

    @classmethod
    def of_receiver(cls, paths: Paths, receiver: int) -> PathStatistics:
        """Statistics of traced paths at the receiver of a number."""
        arrived = paths.select(paths.rx == receiver)
        power = np.square(np.abs(arrived.gain))
        return cls.of_paths(arrived.tx, paths.n_tx, power, arrived.length_m, arrived.arrival)

    def rows(self, chosen: IntArray) -> PathStatistics:
        """The statistics of some transmitters."""
        return PathStatistics(*(getattr(self, field.name)[chosen] for field in fields(self)))

    def placed(self, rows: IntArray, count: int) -> PathStatistics:
        """The statistics as those of rows [m] of ``count`` transmitters, NaN for all others."""
        number = np.full(count, -1)
        number[rows] = np.arange(len(rows))
        none = PathStatistics(*(np.full(1, np.nan) for _ in fields(self)))
        return joined([self, none]).rows(number)


def joined(parts: Sequence[PathStatistics]) -> PathStatistics:
    """Statistics of groups of transmitters one after the other."""
    names = [field.name for field in fields(PathStatistics)]
    return PathStatistics(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))
