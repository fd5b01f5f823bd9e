"""Randomised trees of what the mean terms leave of signal strengths.

A Gaussian process of one length is smooth across a wall; trees are piecewise constant. They are grown for each receiver
with enough stops, and add nothing at the others.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ...core.angles import FloatArray
from ...core.array_files import keyed, under
from ...core.stored import to_arrays
from ..model import Arrays
from .pooled_process import PooledProcess
from .strength_terms import Poses
from .trees import GrownTrees, Trees

TREES, TREES_OF_FOLD, LEAF = 50, 20, 3
"""Numbers of trees, of all rows and of each fold of a calibration, and least number of stops in a leaf."""
LEAST_STOPS = 12 * LEAF  # stops of a receiver below which a tree would be little more than its mean
STORED = "trees"  # beginning of the names of arrays


class Forest:
    """Trees by the number of the receiver."""

    def __init__(self, of_receiver: Mapping[int, GrownTrees]) -> None:
        self._of_receiver = of_receiver

    @classmethod
    def grown(cls, process: PooledProcess, poses: Poses, receivers: int, trees: int) -> Forest:
        """Trees of the residuals of the mean terms of a process over poses."""
        kind, of_receiver = Trees(trees, LEAF), dict[int, GrownTrees]()
        for receiver in range(receivers):
            rows, residual_db = process.residual(receiver)
            if len(rows) >= LEAST_STOPS:
                places = poses.take(rows)
                # A seed for each receiver, lest all have the same cuts.
                of_receiver[receiver] = kind.fit(places.position_m, residual_db, places.heading_rad, receiver)
        return cls(of_receiver)

    def predict(self, poses: Poses, receiver: int) -> tuple[FloatArray, FloatArray]:
        """Mean and variance of the trees at poses, [m] each, dB and dB^2; zeros at receivers without any."""
        if receiver not in self._of_receiver:
            return np.zeros(len(poses)), np.zeros(len(poses))
        values = self._of_receiver[receiver].of_each(poses.position_m, poses.heading_rad)
        return values.mean(axis=0), values.var(axis=0)

    def arrays(self) -> Arrays:
        """Arrays for `from_arrays`."""
        parts = [keyed(f"{STORED}.{receiver}.", to_arrays(trees)) for receiver, trees in self._of_receiver.items()]
        return {name: array for part in parts for name, array in part.items()}

    @classmethod
    def from_arrays(cls, arrays: Arrays) -> Forest | None:
        """The trees that `arrays` described; None: without any."""
        receivers = sorted({int(name.split(".")[1]) for name in arrays if name.startswith(f"{STORED}.")})
        trees = {receiver: GrownTrees(**under(f"{STORED}.{receiver}.", arrays)) for receiver in receivers}
        return cls(trees) if trees else None
