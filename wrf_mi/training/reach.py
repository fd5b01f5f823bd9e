"""Distance from the training transmitters up to which Gaussians correct a prediction.

    w(x) = exp(-(d(x) / reach)^2)

d is the distance from a transmitter to the nearest training transmitter, and w scales the Gaussians' signal: beside the
paths of a scene, and for channels, whose value without Gaussians is zero. Gaussians interpolate between neighbours;
farther away than a fraction of a wavelength they add noise. The reach is chosen on rows held out in groups, because
validation rows are drawn among the training rows and lie near them. A reach of 0 switches the Gaussians off, an
infinite one uses them everywhere.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2
from scipy.spatial import cKDTree

from ..core import Split
from ..core.angles import FloatArray
from ..core.types import IntArray

GROUPS = 10
"""Clusters of training positions, some of which are held out together."""
ROWS_OF_GROUP = 4
"""Least average number of rows of a cluster."""
HELD_OUT = 0.25
"""Approximate share of the training rows that are held out in clusters."""
MOST_HELD_OUT = 0.5
"""Largest share in a single cluster."""
LENGTHS = 7
"""Number of reaches tried beside 0: each twice the one before, the last four times the largest distance held out."""

NEGLIGIBLE = 1e-4
"""Weight below which Gaussians are not evaluated: the largest relative change of their signal."""


@dataclass(frozen=True)
class Reach:
    """Region in which a field's Gaussians are used.

    Attributes:
        known_m: training transmitters that each receiver observed, [k, 3] in metres.
        length_m: the reach, metres.
    """

    known_m: tuple[FloatArray, ...]
    length_m: float

    def distance(self, tx_pos_m: FloatArray, receiver: int) -> FloatArray:
        """Distance of transmitters [m, 3] from the nearest training transmitter, metres; infinite without any."""
        known = self.known_m[receiver]
        return np.asarray(cKDTree(known).query(tx_pos_m)[0]) if len(known) else np.full(len(tx_pos_m), np.inf)

    def weight(self, tx_pos_m: FloatArray, receiver: int) -> NDArray[np.float32]:
        """Weight w of the Gaussians' signal for transmitters [m, 3], 0 to 1; 0 where it is below `NEGLIGIBLE`."""
        if self.length_m == 0 or np.isinf(self.length_m):
            return np.full(len(tx_pos_m), float(self.length_m > 0), np.float32)
        weight = np.exp(-np.square(self.distance(tx_pos_m, receiver) / self.length_m))
        return np.where(weight < NEGLIGIBLE, 0, weight).astype(np.float32)

    def of_ports(self, carriers: int) -> Reach:
        """The reach by ports, as many for each receiver as there are carriers."""
        return replace(self, known_m=tuple(known for known in self.known_m for _ in range(carriers)))

    def lengths(self, tx_pos_m: Sequence[FloatArray]) -> list[float]:
        """Candidate reaches from held-out transmitters [m, 3] of each receiver, from 0 upwards."""
        found = [self.distance(tx, r) for r, tx in enumerate(tx_pos_m) if len(tx) and len(self.known_m[r])]
        largest = float(np.max(np.concatenate(found), initial=0.0)) if found else 0.0
        return [0.0, *(4 * largest * 0.5 ** np.arange(LENGTHS))[::-1]] if largest else [0.0, np.inf]


def hold_out_groups(split: Split, tx_pos_m: FloatArray) -> Split:
    """The split with clusters of its training rows moved to the validation rows, seeded by the split.

    Args:
        split: split of a record.
        tx_pos_m: positions of all rows [n, 3], metres.

    Returns:
        A split with validation rows near training rows and far from them; ``split`` itself if its rows are too few.
    """
    rows: IntArray = split.train
    count = min(GROUPS, len(rows) // ROWS_OF_GROUP, len(np.unique(tx_pos_m[rows], axis=0)))
    if count < 2:
        return split
    rng = np.random.default_rng([split.seed, 3])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # an empty cluster holds nothing out
        _, labels = kmeans2(tx_pos_m[rows], count, iter=50, minit="++", missing="warn", rng=rng)
    held = np.zeros(len(rows), bool)
    for group in rng.permutation(count):
        more = held | (labels == group)
        if more.mean() <= (HELD_OUT if held.any() else MOST_HELD_OUT):
            held = more
    if not held.any():
        return split
    return replace(split, train=rows[~held], validation=np.sort(np.concatenate([split.validation, rows[held]])))


def improves(score: FloatArray, before: FloatArray, higher_is_better: bool, errors: float = 1.0) -> bool:
    """Whether the mean gain of paired scores [rows] exceeds ``errors`` of its standard errors; NaN where nothing was
    received.
    """
    gain = (score - before) * (1 if higher_is_better else -1)
    gain = gain[np.isfinite(gain)]
    return len(gain) > 1 and float(gain.mean()) > errors * float(gain.std(ddof=1)) / np.sqrt(len(gain))


def choose_reach(
    reach: Reach,
    lengths: Sequence[float],
    tx_pos_m: Sequence[FloatArray],
    score: Callable[[int, NDArray[np.float32]], FloatArray],
    higher_is_better: bool,
) -> tuple[float, FloatArray]:
    """The reach by scores of held-out transmitters.

    Args:
        reach: reach with the training transmitters.
        lengths: candidates in ascending order, metres.
        tx_pos_m: held-out transmitters that each receiver observed, [m, 3] in metres.
        score: ``score(receiver, weight)``: scores of a receiver's held-out transmitters with weights [m].
        higher_is_better: direction of the score.

    Returns:
        The last reach that improves on the one kept before it (`improves`), metres, and its scores, all receivers
        pooled. Without held-out transmitters, the given reach and no scores.
    """
    held = [r for r, tx in enumerate(tx_pos_m) if len(tx)]
    kept, best = reach.length_m, np.zeros(0)
    for length in lengths if held else []:
        tried = replace(reach, length_m=length)
        scores = np.concatenate([np.ravel(score(r, tried.weight(tx_pos_m[r], r))) for r in held])
        if not len(best) or improves(scores, best, higher_is_better):
            kept, best = length, scores
    return kept, best
