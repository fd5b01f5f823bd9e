"""Offsets of the runs of a measurement, such as walks or devices: phones differ by decibels, and how they are held.

An offset is common to all receivers. What the receivers of one place have in common, such as a crowd or a shelf around
it, is so, too, and a run covers some places only: under fields that are independent between receivers, the likelihood
takes the one for the other (6 dB in a shopping centre whose walks differ by 2 dB). So offsets are told by differences
of different runs near each other alone.

Source: Robinson, "That BLUP is a good thing: the estimation of random effects" (1991), Statistical Science 6(1).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ...core.angles import FloatArray
from ...core.types import IntArray
from .strength_terms import Stops, run_numbers

RUN_SD_DB = 3.0
"""Standard deviation of offsets where no runs tell it: walks of one phone differ by 1 to 3 dB, phones by 5 to 10."""
NEAR_M, FAR_M = 2.0, 10.0
"""Least and largest distance within which stops of two runs are compared: the correlation length of shadowing indoors,
and what positions outdoors are known to. Of runs farther apart, the law of distance would pass for offsets."""
MOST_STOPS = 2000  # stops of a receiver that are compared: pairs are as many as their square where runs are dense
SHARE = 0.1  # least share of stops that are compared with another run, which few campaigns cross at a step's distance
ALIKE = 20  # differences of two runs that count at most: those of one aisle, or of one receiver, have errors in common
LEAST_DIFFERENCES = 3  # differences of two runs from which their mean tells the deviation of offsets
LEAST_SD_DB = 0.5  # least deviation of offsets, as few differences may vary less than their noise


@dataclass(frozen=True)
class RunOffsets:
    """Offsets of runs.

    Attributes:
        names: names of the runs [k].
        offset_db: their offsets about the mean of runs [k].
        sd_db: standard deviation of the offset of another run.
    """

    names: NDArray[np.str_]
    offset_db: FloatArray
    sd_db: float

    @classmethod
    def fit(cls, stops: Stops, names: Sequence[str]) -> RunOffsets:
        """Offsets by the differences of nearby stops of different runs, whose numbers `Stops.poses` has.

        They are normal a priori; their variance is that of the mean differences of pairs of runs beyond noise, half of
        it, by the method of moments, and the noise that of differences within runs.
        """
        count, pairs = len(names), np.concatenate([np.zeros((0, 3)), *_differences(stops)])
        first, second, difference = pairs[:, 0].astype(int), pairs[:, 1].astype(int), pairs[:, 2]
        within, between = first == second, first != second
        noise = float(np.mean(np.square(difference[within]))) if within.sum() >= ALIKE else 2 * RUN_SD_DB**2
        key, place = np.unique(first[between] * count + second[between], return_inverse=True)
        number = np.bincount(place.reshape(-1), minlength=len(key))
        mean = np.bincount(place.reshape(-1), difference[between], len(key)) / np.maximum(number, 1)
        variance = noise / np.minimum(number, ALIKE)
        told = number >= LEAST_DIFFERENCES
        sd_db = RUN_SD_DB
        if told.any():
            sd_db = np.sqrt(max(float(np.mean(np.square(mean[told]) - variance[told])) / 2, LEAST_SD_DB**2))
        # Normal equations of the differences with the prior (Robinson 1991, equation 1.2).
        system, right = np.eye(count) / sd_db**2, np.zeros(count)
        for a, b, value, weight in zip(key // count, key % count, mean, 1 / variance, strict=True):
            system[[a, b], [a, b]] += weight
            system[[a, b], [b, a]] -= weight
            right[[a, b]] += weight * value, -weight * value
        return cls(np.asarray(names, str), np.asarray(np.linalg.solve(system, right), float), float(sd_db))

    def of(self, runs: NDArray[np.str_] | None, count: int) -> tuple[FloatArray, FloatArray]:
        """Offsets [m] and their variances [m] of m rows of some runs, dB and dB^2; None: of another run.

        Of an empty name, the mean of all runs: without an offset.
        """
        offsets, variances = np.zeros(count), np.full(count, self.sd_db**2)
        if runs is not None:
            number = run_numbers(runs, self.names.tolist())
            has_offset = (number >= 0) & (number < len(self.names))
            offsets[has_offset] = self.offset_db[number[has_offset]]
            variances[number < len(self.names)] = 0.0
        return offsets, variances


def _differences(stops: Stops) -> Iterator[FloatArray]:
    """Runs of two stops that are near each other, and the difference of what a receiver received there [q, 3]."""
    run, position_m = stops.poses.run, stops.poses.position_m
    assert run is not None
    in_run = run >= 0
    reach_m = float(np.clip(_apart_m(position_m[in_run], run[in_run]), NEAR_M, FAR_M))
    for values in stops.value_dbm:
        received = np.flatnonzero(np.isfinite(values) & in_run)
        if len(received) > MOST_STOPS:
            received = received[np.linspace(0, len(received) - 1, MOST_STOPS).round().astype(np.int64)]
        near = cKDTree(position_m[received]).query_pairs(reach_m, output_type="ndarray")
        a, b = received[near].T
        swapped = run[a] > run[b]
        a, b = np.where(swapped, b, a), np.where(swapped, a, b)
        yield np.column_stack([run[a], run[b], values[a] - values[b]])


def _apart_m(position_m: FloatArray, run: IntArray) -> float:
    """Distance to the nearest stop of another run that a share `SHARE` of the stops has, metres."""
    nearest = np.full(len(run), np.inf)
    for number in np.unique(run):
        in_run = run == number
        nearest[in_run] = cKDTree(position_m[~in_run]).query(position_m[in_run])[0] if (~in_run).any() else np.inf
    return float(np.quantile(nearest, SHARE)) if len(run) and np.isfinite(nearest).all() else 0.0
