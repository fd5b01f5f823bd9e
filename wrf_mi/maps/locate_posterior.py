"""Estimate and region of stated coverage from the probabilities of candidate positions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import softmax

from ..core.angles import FloatArray


@dataclass(frozen=True)
class Region:
    """Where a transmitter is.

    Attributes:
        estimate_m: position [2] of the least expected distance from the transmitter (geometric median), metres.
        radius_m: radius of the circle around it that holds the stated probability, metres.
        inside: candidates [p] of the highest-density region: the fewest that hold the stated probability.
    """

    estimate_m: FloatArray
    radius_m: float
    inside: NDArray[np.bool_]


def probabilities(log_likelihood: FloatArray) -> FloatArray:
    """Posterior probabilities of candidates [..., p] that are equally likely a priori."""
    return np.asarray(softmax(log_likelihood, axis=-1))


def region_of(probability: FloatArray, distance_m: FloatArray, positions_m: FloatArray, level: float) -> Region:
    """Estimate and region.

    Args:
        probability: probabilities of the candidates [p], of sum 1.
        distance_m: distances between all candidates [p, p], metres.
        positions_m: their positions [p, 2 or more], metres.
        level: probability that the region holds.
    """
    best = int(np.argmin(distance_m @ probability))
    order = np.argsort(distance_m[best], kind="stable")
    last = _last(probability[order], level)
    return Region(positions_m[best, :2], float(distance_m[best][order][last]), densest(probability, level))


def densest(probability: FloatArray, level: float) -> NDArray[np.bool_]:
    """Mask of the fewest candidates [p] that hold a probability together."""
    order = np.argsort(-probability, kind="stable")
    inside = np.zeros(len(probability), bool)
    inside[order[: _last(probability[order], level) + 1]] = True
    return inside


def _last(probability: FloatArray, level: float) -> int:
    """Index of the first of ordered candidates at which a probability is reached."""
    reached = np.cumsum(probability) >= level * (1 - 1e-12)
    return int(np.argmax(reached)) if reached.any() else len(probability) - 1
