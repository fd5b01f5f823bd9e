"""Randomised trees of what the mean terms leave of signal strengths.

A Gaussian process of one length is smooth across a wall; trees are piecewise constant. They are grown for each receiver
with enough stops, and add nothing at the others.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from ...core.angles import FloatArray
from ...core.types import IntArray
from .strength_terms import Poses
from .trees import GrownTrees, Trees

TREES, TREES_OF_FOLD, LEAF = 50, 20, 3
"""Numbers of trees, of all rows and of each fold of a calibration, and least number of stops in a leaf."""
LEAST_STOPS = 12 * LEAF  # stops of a receiver below which a tree would be little more than its mean


@dataclass(frozen=True)
class Forest:
    """Trees by the number of the receiver."""

    of_receiver: Mapping[int, GrownTrees]

    @classmethod
    def grown(cls, residuals: Iterable[tuple[IntArray, FloatArray]], poses: Poses, trees: int) -> Forest:
        """Trees of what the mean terms leave of each receiver at poses: their numbers [n], and residuals [n] in dB."""
        kind, of_receiver = Trees(trees, LEAF), dict[int, GrownTrees]()
        for receiver, (rows, residual_db) in enumerate(residuals):
            if len(rows) >= LEAST_STOPS:
                places = poses.take(rows)
                # A seed for each receiver, lest all have the same cuts.
                of_receiver[receiver] = kind.fit(places.position_m, residual_db, places.heading_rad, receiver)
        return cls(of_receiver)

    def predict(self, poses: Poses, receiver: int) -> tuple[FloatArray, FloatArray]:
        """Mean and variance of the trees at poses, [m] each, dB and dB^2; zeros at receivers without any."""
        if receiver not in self.of_receiver:
            return np.zeros(len(poses)), np.zeros(len(poses))
        values = self.of_receiver[receiver].of_each(poses.position_m, poses.heading_rad)
        return values.mean(axis=0), values.var(axis=0)
