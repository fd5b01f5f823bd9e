"""Holding out training rows: every choice of a fit (stages, steps, reach, weights, intervals) is made by the same ones.

Validation rows are drawn among the training rows and lie near them, where every interpolation is good. Clusters of
positions are held out with them, so that some held-out rows are as far from the others as rows to be predicted.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..core import Record, Split
from ..core.angles import FloatArray
from ..core.types import IntArray
from ..datasets.observations import LEAST_ROWS, fitted_receivers, predicts_new_runs, rows_received, trained_runs
from ..datasets.splits import rows_left

GROUPS = 10  # clusters of training positions, some of which are held out together
ROWS_OF_GROUP = 4  # least average number of rows of a cluster
HELD_OUT = 0.25  # approximate share of the training rows that are held out in clusters
MOST_HELD_OUT = 0.5  # largest share in a single cluster
FAR_POSITIONS = 5  # least number of positions that are held out as far from training rows as test rows
FOLDS = 5
"""Parts of rows that are left to receivers, or of positions at a held-out carrier, of which one is held out; largest
number of groups of held-out observations."""
MOST_OBSERVATIONS, MOST_VALUES = (200, 600), 20_000
"""Largest number of held-out observations that weights and intervals are chosen from: 600 single numbers, fewer of many
values, but 200."""
LEAST_AWAY_M = 1e-3  # distance below which test rows are at places of training rows
MOST_PAIRS = 3000  # largest number of held-out pairs of a receiver and a row, received or not


def clusters(positions_m: FloatArray, count: int, rng: np.random.Generator) -> IntArray:
    """Number of the k-means cluster of each position [n, 3]; clusters may be empty."""
    from scipy.cluster.vq import kmeans2

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of an empty cluster, which holds nothing out
        return np.asarray(kmeans2(positions_m, count, iter=50, minit="++", missing="warn", rng=rng)[1], np.int64)


def cells(places_m: FloatArray, count: int) -> IntArray:
    """Number of the cell of each place [n, 3]: cells are halved along their widest side until there are ``count``."""
    parts = [np.arange(len(places_m))]
    while len(parts) < count and max(map(len, parts)) > 1:
        halves = list[IntArray]()
        for rows in parts:
            order = rows[np.argsort(places_m[rows, np.ptp(places_m[rows], axis=0).argmax()], kind="stable")]
            halves += [half for half in np.array_split(order, 2) if len(half)]
        parts = halves
    label = np.empty(len(places_m), np.int64)
    for number, rows in enumerate(parts):
        label[rows] = number
    return label


def hold_out_groups(split: Split, tx_pos_m: FloatArray, groups: int = GROUPS) -> Split:
    """The split with clusters of its training rows moved to the validation rows, seeded by the split.

    Args:
        split: split of a record.
        tx_pos_m: positions of all rows [n, 3], metres.
        groups: number of clusters, at most; more than `GROUPS` are `cells`, the smallest of which are single places.

    Returns:
        A split with validation rows near training rows and far from them; ``split`` itself if its rows are too few.
    """
    rows: IntArray = split.train
    places_m, place = np.unique(tx_pos_m[rows], axis=0, return_inverse=True)
    count = min(groups, len(places_m)) if groups > GROUPS else min(GROUPS, len(rows) // ROWS_OF_GROUP, len(places_m))
    if count < 2:
        return split
    rng = np.random.default_rng([split.seed, 3])
    fine = groups > GROUPS
    labels = cells(places_m, count)[place.reshape(-1)] if fine else clusters(tx_pos_m[rows], count, rng)
    sizes = np.bincount(labels, minlength=count)
    is_out, total = np.zeros(len(sizes), bool), 0
    for group in rng.permutation(len(sizes)):
        # The first cluster may be larger than the share: without any, nothing could be chosen.
        if (total + sizes[group]) / len(rows) <= (HELD_OUT if total else MOST_HELD_OUT):
            is_out[group], total = True, total + sizes[group]
    out = is_out[labels]
    if not total:
        return split
    return replace(split, train=rows[~out], validation=np.sort(np.concatenate([split.validation, rows[out]])))


def hold_out_far(split: Split, tx_pos_m: FloatArray) -> Split:
    """The split with the rows around a position moved to the validation rows, so that some are as far as test rows.

    Each test row lies at some distance from the nearest training or validation row. After the move, at least
    `FAR_POSITIONS` positions of validation rows lie at the median of these distances, or farther, from training rows.

    Args:
        split: split of a record.
        tx_pos_m: positions of all rows [n, 3], metres.

    Returns:
        A split with the fewest rows moved; ``split`` itself where its validation rows are as far already, there is no
        test or validation row, or more than a share of `HELD_OUT` would have to move.
    """
    rows = split.train
    places_m = np.unique(tx_pos_m[rows], axis=0)
    if not len(split.test) or not len(split.validation) or len(places_m) <= FAR_POSITIONS:
        return split
    test_m = float(np.median(cKDTree(tx_pos_m[split.all_train]).query(tx_pos_m[split.test])[0]))
    trained = cKDTree(tx_pos_m[rows])
    far = trained.query(tx_pos_m[split.validation])[0] >= test_m
    if len(np.unique(tx_pos_m[split.validation[far]], axis=0)) >= FAR_POSITIONS:
        return split
    # A position at distance d from the middle of an empty ball of radius r is at least r - d from what is outside.
    radius_m = cKDTree(places_m).query(places_m, k=[FAR_POSITIONS])[0][:, 0] + test_m
    middle = int(np.argmin(trained.query_ball_point(places_m, radius_m, return_length=True)))
    out = np.zeros(len(rows), bool)
    out[trained.query_ball_point(places_m[middle], radius_m[middle])] = True
    if out.mean() > HELD_OUT:
        return split
    return replace(split, train=rows[~out], validation=np.sort(np.concatenate([split.validation, rows[out]])))


def hold_out(record: Record, split: Split) -> Split | None:
    """The split of the training rows whose test rows are held out: the one hold-out of every choice.

    Rows are held out as the split holds out its test rows. Usually these are clusters of positions and the validation
    rows (`hold_out_groups`); of rows that are too few for clusters, the two that lie farthest from the others.

    Where the split holds out receivers, half of the trained receivers are held out instead, but for as many rows as the
    split leaves; where it holds out a carrier, one of the trained carriers is, at held-out positions if the split's
    test positions are not among the training rows'; where it predicts other runs of the measurement than those that
    train, some of these runs.

    Args:
        record: data with known positions.
        split: split whose training and validation rows are divided.

    Returns:
        A split; None for fewer than three rows, fewer than two positions, or a single trained receiver or carrier.
    """
    if split.held_receivers:
        return _without_receivers(record, split)
    rows = split.all_train
    if len(rows) < 3 or len(np.unique(record.tx_pos_m[rows], axis=0)) < 2:
        return None
    carriers = record.carriers_hz
    if carriers is not None and len(split.test) and not np.isin(carriers[split.test], carriers[rows]).any():
        return _without_carrier(record.tx_pos_m, carriers, split)
    if predicts_new_runs(record, split):
        out = _of_runs(record, split)
        fold = _fold(split, out, out)
        numbers = np.flatnonzero(rows_received(record, fold.all_train) >= LEAST_ROWS)
        if np.isfinite(record.observation[numbers][:, out]).any():  # held-out runs may be of other receivers
            return fold
    out = _clusters_or_farthest(split, record.tx_pos_m)
    fold = _fold(split, out, out)
    return fold if rows_received(record, fold.all_train).max() >= LEAST_ROWS else None


def _of_runs(record: Record, split: Split) -> IntArray:
    """Training rows of some runs, drawn with the split's seed: about a share `HELD_OUT` of all, half of it at least
    where runs are short enough.
    """
    assert record.runs is not None
    rows, runs = split.all_train, record.runs[split.all_train]
    out = np.zeros(len(rows), bool)
    for run in np.random.default_rng([split.seed, 13]).permutation(trained_runs(record, rows)):
        more = out | (runs == run)
        if more.mean() <= (HELD_OUT if 2 * out.mean() >= HELD_OUT else MOST_HELD_OUT):
            out = more
    return rows[out]


def _clusters_or_farthest(split: Split, tx_pos_m: FloatArray) -> IntArray:
    groups, rows = _as_far_as_wanted(split, tx_pos_m), split.all_train
    if groups is not split and len(groups.validation) >= 2:
        return groups.validation
    # Where rows are sparsest, as far from the others as rows to be predicted may be.
    distance, _ = cKDTree(tx_pos_m[rows]).query(tx_pos_m[rows], k=2)
    return np.sort(rows[np.argsort(-distance[:, 1], kind="stable")[: 2 if len(rows) > 3 else 1]])


def away_as(record: Record, split: Split) -> str:
    """How far from the others the rows of `hold_out` are, in words for a report."""
    if not split.held_receivers and predicts_new_runs(record, split):
        return "of other runs"
    if len(split.wanted_m):
        return "as far from the others as the wanted positions (transductive)"
    return "as far from the others as the test positions (transductive)" if len(split.test) else "in large clusters"


def _as_far_as_wanted(split: Split, tx_pos_m: FloatArray) -> Split:
    """`hold_out_groups` of as many clusters that held-out rows are as far from the others as positions of predictions.

    These are the wanted ones of the split, or else those of its test rows. Without any, or with those of training rows,
    clusters are the largest: rows are predicted anywhere.
    """
    wanted_m, coarse = split.wanted_m if len(split.wanted_m) else tx_pos_m[split.test], hold_out_groups(split, tx_pos_m)
    wanted_m = wanted_m[np.isfinite(wanted_m).all(axis=1)]
    if coarse is split or not len(wanted_m):
        return coarse

    def away_m(positions_m: FloatArray, others: IntArray) -> float:
        return max(float(np.median(cKDTree(tx_pos_m[others]).query(positions_m)[0])), np.finfo(float).tiny)

    wanted, best, most = away_m(wanted_m, split.all_train), coarse, len(np.unique(tx_pos_m[split.train], axis=0))
    nearest, count = away_m(tx_pos_m[best.validation], best.train), GROUPS
    if wanted < LEAST_AWAY_M:
        return coarse
    # Distances fall with the number of clusters.
    while nearest > wanted and count < most:
        count *= 2
        fine = hold_out_groups(split, tx_pos_m, count)
        away = away_m(tx_pos_m[fine.validation], fine.train)
        if abs(np.log(away / wanted)) < abs(np.log(nearest / wanted)):
            best, nearest = fine, away
        elif away < wanted:
            break
    return best


def _fold(split: Split, gone: IntArray, test: IntArray) -> Split:
    """The split that trains without the rows that are ``gone``, and tests some of them."""
    train, validation = (np.setdiff1d(part, gone) for part in (split.train, split.validation))
    return Split("held out", split.seed, train, validation, test)


def _without_receivers(record: Record, split: Split) -> Split | None:
    trained = np.setdiff1d(np.arange(len(record.receivers)), split.held_receivers)
    if len(trained) < 2:
        return None
    # Half of them, which judge corrections of a scene, too: offsets differ, and few say little of others.
    group = np.random.default_rng([split.seed, 9]).permutation(trained)[: len(trained) // 2].tolist()
    # As many rows are left to each as the split leaves to its own held-out receivers.
    each = len(split.left) // len(split.held_receivers)
    # Rows that are left at the split's own receivers train, but for a part that is held out as theirs are.
    left = np.random.default_rng([split.seed, 8]).permutation(np.arange(len(split.left)) % FOLDS) != 0
    return Split(
        "held out",
        split.seed,
        split.train,
        split.validation,
        split.all_train,
        (*split.held_receivers, *group),
        np.concatenate([split.left[left], rows_left(record, split.all_train, group, each, split.seed)]),
    )


def _without_carrier(tx_pos_m: FloatArray, carriers_hz: FloatArray, split: Split) -> Split | None:
    rows = split.all_train
    carriers, place = np.unique(carriers_hz[rows]), np.unique(tx_pos_m, axis=0, return_inverse=True)[1].reshape(-1)
    if len(carriers) < 2:
        return None
    measured_places = np.isin(place[split.test], place[rows]).any()
    rng = np.random.default_rng([split.seed, 4])
    places = rng.permutation(np.unique(place[rows]))
    held_places = places if measured_places else places[: -(-len(places) // FOLDS)]
    at_carrier, at_places = carriers_hz[rows] == rng.choice(carriers), np.isin(place[rows], held_places)
    # Where test positions are new, nothing is known of them at any carrier.
    fold = _fold(split, rows[at_carrier | (at_places & ~measured_places)], rows[at_carrier & at_places])
    return fold if len(fold.test) and len(fold.all_train) >= 2 else None


def rows_at_receiver(record: Record, rows: IntArray, receiver: int) -> IntArray:
    """Those of some rows that a receiver received, whole."""
    is_whole = np.isfinite(record.observation[receiver, rows]).reshape(len(rows), -1).all(axis=1)
    return np.asarray(rows[is_whole])


class RowDistance:
    """Distance of positions to the nearest of some rows that a receiver received.

    Args:
        known_m: ``known_m(receiver)``: positions of these rows [k, 3], metres.
    """

    def __init__(self, known_m: Callable[[int], FloatArray]) -> None:
        self._known_m = known_m
        self._trees: dict[int, cKDTree] = {}

    @classmethod
    def of_rows(cls, record: Record, rows: IntArray) -> RowDistance:
        """Distance to those of the rows [n] of a record that a receiver received."""
        return cls(lambda receiver: record.tx_pos_m[rows_at_receiver(record, rows, receiver)])

    def __call__(self, tx_pos_m: FloatArray, receiver: int) -> FloatArray:
        """Distances [m] in metres of positions [m, 3]; infinite without any row."""
        if receiver not in self._trees:
            self._trees[receiver] = cKDTree(np.reshape(self._known_m(receiver), (-1, 3)))
        return np.asarray(self._trees[receiver].query(tx_pos_m)[0])

    def of_pairs(self, record: Record, receiver: IntArray, row: IntArray) -> FloatArray:
        """Distances [q] in metres of pairs of a receiver and a row of a record."""
        distance_m = np.empty(len(row))
        for number in np.unique(receiver):
            distance_m[receiver == number] = self(record.tx_pos_m[row[receiver == number]], int(number))
        return distance_m


@dataclass(frozen=True)
class HeldOut:
    """Held-out observations: q pairs of a receiver and a row that it received.

    Attributes:
        receiver: number of the receiver [q].
        row: row of the record [q].
        distance_m: distance to the nearest row that remained and that the receiver received [q], metres.
        group: group of independent errors [q], fewer than `FOLDS`: clusters of positions, or receivers.
        every: pairs of a receiver and a row of signal strengths, received or not [p, 2], by which the probability of
            reception is fitted; none where nothing is missing, or the split holds out receivers.
    """

    receiver: IntArray
    row: IntArray
    distance_m: FloatArray
    group: IntArray
    every: IntArray = field(default_factory=lambda: np.zeros((0, 2), np.int64))

    @classmethod
    def of(cls, record: Record, fold: Split, seed: int) -> HeldOut:
        """Held-out observations of a fold, or as many of them, drawn with a seed, as `MOST_OBSERVATIONS` allows."""
        parts: list[tuple[IntArray, IntArray, FloatArray]] = []
        # Rows that a receiver did not receive are no neighbours: distances differ between receivers of one row.
        distance = RowDistance.of_rows(record.seen(fold), fold.all_train)
        for receiver in fold.held_receivers or fitted_receivers(record, [fold])[0]:
            rows = np.setdiff1d(fold.test, fold.left[fold.left[:, 0] == receiver, 1])
            rows = rows_at_receiver(record, rows, receiver)
            parts.append((np.full(len(rows), receiver), rows, distance(record.tx_pos_m[rows], receiver)))
        receiver, row, away = (np.concatenate(values) for values in zip(*parts, strict=True))
        most = int(np.clip(MOST_VALUES // int(np.prod(record.observation.shape[2:])), *MOST_OBSERVATIONS))
        if len(row) > most:
            drawn = np.sort(np.random.default_rng([seed, 5]).permutation(len(row))[:most])
            receiver, row, away = receiver[drawn], row[drawn], away[drawn]
        group = np.zeros(len(row), np.int64)
        if record.runs is not None and predicts_new_runs(record, fold):
            group = np.unique(record.runs[row], return_inverse=True)[1].reshape(-1) % FOLDS
        elif fold.held_receivers:
            group = np.unique(receiver, return_inverse=True)[1].reshape(-1) % FOLDS
        elif (count := min(FOLDS, len(np.unique(record.tx_pos_m[row], axis=0)))) > 1:
            group = clusters(record.tx_pos_m[row], count, np.random.default_rng([seed, 6]))
        return cls(receiver, row, away, group, _received_or_not(record, fold, seed))

    def __len__(self) -> int:
        """Number of held-out observations."""
        return len(self.row)

    def observed(self, record: Record) -> NDArray[Any]:
        """Observations [q, ...]."""
        return record.observation[self.receiver, self.row]


def _received_or_not(record: Record, fold: Split, seed: int) -> IntArray:
    """Pairs of a receiver and a held-out row [p, 2], or some of them, drawn with a seed; see `HeldOut`."""
    numbers = fitted_receivers(record, [fold])[0]
    trained = np.concatenate([fold.all_train, fold.test])
    if (
        fold.held_receivers
        or not record.task.may_be_silent
        or not np.isnan(record.observation[numbers][:, trained]).any()
    ):
        return np.zeros((0, 2), np.int64)
    pairs = np.stack([values.ravel() for values in np.meshgrid(numbers, fold.test, indexing="ij")], axis=1)
    return pairs[np.sort(np.random.default_rng([seed, 12]).permutation(len(pairs))[:MOST_PAIRS])]
