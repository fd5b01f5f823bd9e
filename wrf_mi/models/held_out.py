"""Predictions of training rows by models that are fitted without them."""

from __future__ import annotations

import shutil
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2
from scipy.spatial import cKDTree

from ..core import Prediction, Record, Split
from ..core.angles import FloatArray
from ..core.antenna import AS_STATED
from ..core.array_files import stored_arrays, write_arrays
from ..core.types import IntArray
from ..datasets.observations import LEAST_ROWS, fitted_receivers, rows_received
from ..datasets.splits import rows_left
from ..scene.correction_data import read_correction_data
from ..tasks import task_of
from ..training.loop import Progress
from .model import Fitted, Model, Problem, Session, inputs_of

FEW_ROWS = 10
"""Number of training rows up to which each is held out by itself."""
SEPARATE_ROWS = 100
"""Number of training rows up to which regions and rows in between are held out in turn, not together: models that are
fitted to few rows gain by each."""
MANY_ROWS = 600
"""Number of training rows from which two folds are enough."""
FOLDS = 5
MOST_HELD_OUT, MOST_VALUES = (200, 600), 20_000
"""Largest number of held-out observations that weights and intervals are chosen from: 600 single numbers, fewer of many
values, but 200.
"""


def hold_out_folds(record: Record, split: Split) -> list[Split]:
    """Splits of the training rows whose test rows are a region and rows in between the others.

    The rows are divided into as many k-means clusters of positions as there are folds, and at random into as many
    parts. A fold holds out a cluster, whose rows lie as far from the remaining ones as those of a blocked split, and a
    part, whose rows lie as near as those of a random split; up to `SEPARATE_ROWS` rows, a cluster or a part. Up to
    `FEW_ROWS` rows are held out one by one.

    Where the split holds out receivers, the trained receivers are held out in as many groups as there are folds, with
    as many rows left to each as the split leaves, and those rows of its receivers are held out in turn, too; where it
    holds out a carrier, the trained carriers are held out in turn, at held-out positions if the split's test
    positions are not among the training rows'.

    Args:
        record: data with known positions.
        split: split whose training and validation rows are divided; the others keep their part. Its seed is that of
            clusters and parts.

    Returns:
        Splits; none for fewer than three rows, fewer than two positions, or a single trained receiver.
    """
    if split.held_receivers:
        return _hold_out_receivers(record, split)
    if record.carriers_hz is not None and not np.isin(record.carriers_hz[split.test], _carriers(record, split)).any():
        return _hold_out_carriers(record, split)
    rows = split.all_train
    n, positions = len(rows), record.tx_pos_m[rows]
    places = len(np.unique(positions, axis=0))
    if n < 3 or places < 2:
        return []
    rng = np.random.default_rng([split.seed, 4])
    if n <= FEW_ROWS:
        held = [np.arange(n) == row for row in range(n)]
    else:
        count = min(FOLDS if n < MANY_ROWS else 2, places)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # an empty cluster holds nothing out
            _, cluster = kmeans2(positions, count, iter=50, minit="++", missing="warn", rng=rng)
        part = rng.permutation(np.arange(n) % count)
        regions, between = ([label == fold for fold in range(count)] for label in (cluster, part))
        held = [*regions, *between] if n <= SEPARATE_ROWS else list(map(np.logical_or, regions, between))
    folds = []
    for number, out in enumerate(held):
        train, validation = (np.setdiff1d(part, rows[out]) for part in (split.train, split.validation))
        fold = Split(f"fold {number}", split.seed, train, validation, rows[out])
        if out.any() and rows_received(record, fold.all_train).max() >= LEAST_ROWS:
            folds.append(fold)
    return folds


def _hold_out_receivers(record: Record, split: Split) -> list[Split]:
    trained = np.setdiff1d(np.arange(len(record.receivers)), split.held_receivers)
    if len(trained) < 2:
        return []
    order = np.random.default_rng([split.seed, 4]).permutation(trained)
    groups = [group.tolist() for group in np.array_split(order, min(FOLDS, len(trained)))]
    each = len(split.left) // len(split.held_receivers)
    part = np.random.default_rng([split.seed, 8]).permutation(np.arange(len(split.left)) % len(groups))
    return [
        Split(
            f"fold {number}",
            split.seed,
            split.train,
            split.validation,
            split.all_train,
            (*split.held_receivers, *group),
            np.concatenate([split.left[part != number], rows_left(record, split.all_train, group, each, split.seed)]),
        )
        for number, group in enumerate(groups)
    ]


def _carriers(record: Record, split: Split) -> FloatArray:
    """Carriers of the training rows, ascending, Hz."""
    assert record.carriers_hz is not None
    return np.unique(record.carriers_hz[split.all_train])


def _hold_out_carriers(record: Record, split: Split) -> list[Split]:
    carriers, rows = _carriers(record, split), split.all_train
    if len(carriers) < 2:
        return []
    assert record.carriers_hz is not None
    place = np.unique(record.tx_pos_m, axis=0, return_inverse=True)[1].reshape(-1)
    known = np.isin(place[split.test], place[rows]).any()
    order = np.random.default_rng([split.seed, 4]).permutation(np.unique(place[rows]))
    parts = [order] * len(carriers) if known else np.array_split(order, len(carriers))
    folds = []
    for number, (carrier, held) in enumerate(zip(carriers, parts, strict=True)):
        at, there = record.carriers_hz == carrier, np.isin(place, held)
        gone = rows[at[rows] | (there[rows] if not known else False)]
        train, validation = (np.setdiff1d(part, gone) for part in (split.train, split.validation))
        test = rows[at[rows] & there[rows]]
        if len(test) and len(train) + len(validation) >= 2:
            folds.append(Split(f"fold {number}", split.seed, train, validation, test))
    return folds


class RowDistance:
    """Distance of positions to the nearest of some rows that a receiver received.

    Args:
        record: data.
        rows: the rows [n].
    """

    def __init__(self, record: Record, rows: IntArray) -> None:
        self._record, self._rows = record, rows
        self._trees: dict[int, cKDTree | None] = {}

    def __call__(self, tx_pos_m: FloatArray, receiver: int) -> FloatArray:
        """Distances [m] in metres of positions [m, 3]; infinite without any row."""
        if receiver not in self._trees:
            values = self._record.observation[receiver][self._rows]
            seen = self._rows[np.isfinite(values).reshape(len(values), -1).all(axis=1)]
            self._trees[receiver] = cKDTree(self._record.tx_pos_m[seen]) if len(seen) else None
        tree = self._trees[receiver]
        return np.full(len(tx_pos_m), np.inf) if tree is None else np.asarray(tree.query(tx_pos_m)[0])


@dataclass(frozen=True)
class HeldOut:
    """Held-out rows of all folds and receivers: q pairs of a receiver and a row that it received.

    Attributes:
        fold: number of the fold [q].
        receiver: number of the receiver [q].
        row: row of the record [q].
        distance_m: distance to the nearest row that remained in the fold and that the receiver received [q], metres.
    """

    fold: IntArray
    receiver: IntArray
    row: IntArray
    distance_m: FloatArray

    @classmethod
    def of(cls, record: Record, folds: Sequence[Split], seed: int) -> HeldOut:
        """Held-out rows of folds, or as many of them, drawn with a seed, as `MOST_HELD_OUT` allows."""
        parts: list[tuple[IntArray, IntArray, IntArray, FloatArray]] = []
        for number, fold in enumerate(folds):
            distance = RowDistance(record.seen(fold), fold.all_train)
            for receiver in fold.held_receivers or fitted_receivers(record, [fold])[0]:
                rows = np.setdiff1d(fold.test, fold.left[fold.left[:, 0] == receiver, 1])
                rows = rows[np.isfinite(record.observation[receiver, rows]).reshape(len(rows), -1).all(axis=1)]
                away = distance(record.tx_pos_m[rows], receiver)
                parts.append((np.full(len(rows), number), np.full(len(rows), receiver), rows, away))
        every = cls(*(np.concatenate(values) for values in zip(*parts, strict=True)))
        most = int(np.clip(MOST_VALUES // int(np.prod(record.observation.shape[2:])), *MOST_HELD_OUT))
        if len(every) <= most:
            return every
        return every.chosen(np.sort(np.random.default_rng([seed, 5]).permutation(len(every))[:most]))

    def __len__(self) -> int:
        """Number of held-out observations."""
        return len(self.row)

    def chosen(self, keep: NDArray[np.bool_] | IntArray) -> HeldOut:
        """A part of the held-out observations."""
        return HeldOut(self.fold[keep], self.receiver[keep], self.row[keep], self.distance_m[keep])

    def observed(self, record: Record) -> NDArray[np.float32] | NDArray[np.complex64]:
        """Observations [q, ...]."""
        return record.observation[self.receiver, self.row]


def labelled(session: Session, label: str) -> Session:
    """A session that reports progress under a label."""

    def on_progress(stage: str, share: float, progress: Progress | None = None, /) -> None:
        session.on_progress(f"{label}: {stage.rpartition(': ')[2]}", share)

    return replace(session, on_progress=on_progress)


def fit_model(entry: Model, problem: Problem, split: Split, session: Session) -> tuple[Fitted, Problem]:
    """A fitted model, and the problem with the settings that its `Model.prepare` chose."""
    if entry.prepare is not None:
        problem = replace(problem, settings=entry.prepare(problem, [split], session))
    return entry.fit(problem, split, session), problem


def fit_fold(entry: Model, problem: Problem, fold: Split, session: Session) -> tuple[Fitted, IntArray]:
    """A model fitted to a fold of the training rows, at the receivers that have enough of them in the fold.

    Returns:
        The fitted model, and the numbers of its receivers among those of the problem, ascending.
    """
    numbers, left_out = fitted_receivers(problem.record, [fold])
    if left_out:
        problem = replace(problem, dataset=problem.record.at_receivers(numbers), antennas=AS_STATED)
        fold = fold.at_receivers(numbers)
    return fit_model(entry, problem.seen(fold), fold, session)[0], numbers


def predicted_rows(fitted: Fitted, record: Record, rows: IntArray, receiver: int) -> Prediction:
    """Prediction of rows of the record, stored or made."""
    return fitted.predict_rows(rows, receiver) or fitted.predict(inputs_of(record, rows), receiver)


def _as_unseen(mean: NDArray[Any], problem: Problem, held: HeldOut) -> NDArray[Any]:
    """Predictions [q, ...] whose errors are as large as if the scene did not know the held-out rows."""
    record, data = problem.record, read_correction_data(problem.scene)
    if data is None:
        return mean
    observed, known = held.observed(record), data.knows(record.name, held.row)
    enlarged = observed + data.error_ratio * (mean - observed)
    if task_of(record).image:
        enlarged = np.maximum(enlarged, 0)
    return np.where(known.reshape(-1, *[1] * (mean.ndim - 1)), enlarged, mean)


def held_out_predictions(
    entry: Model,
    problem: Problem,
    folds: Sequence[Split],
    held: HeldOut,
    session: Session,
    name: str,
) -> Prediction:
    """Predictions of held-out observations, each by a model that is fitted to the rest of its fold.

    Finished folds are kept in the session's folder until all are; a stopped fit goes on with them.

    Args:
        entry: model.
        problem: data, scene and settings.
        folds: folds of `hold_out_folds`.
        held: their held-out observations, or some of them.
        session: folder for files, progress callback and stop condition.
        name: name of the model for the progress callback.

    Returns:
        Mean and, where the model states it, standard deviation, [q, ...].

    Raises:
        InputError: a fold that the model cannot be fitted to.
    """
    record, means, deviations = problem.record, [], []
    for number, fold in enumerate(folds):
        folder = session.folder / f"fold{number}"
        kept = folder / "held_out.npz"
        wanted = held.chosen(held.fold == number)
        if not len(wanted):
            continue
        if not kept.exists():
            folder.mkdir(parents=True, exist_ok=True)
            inner = labelled(replace(session, folder=folder), f"{name}, fold {number + 1} of {len(folds)}")
            fitted, numbers = fit_fold(entry, problem, fold, inner)
            found = [
                predicted_rows(fitted, record, wanted.row[wanted.receiver == receiver], place)
                for place, receiver in enumerate(numbers)
                if (wanted.receiver == receiver).any()
            ]
            # Found receiver by receiver, while a fold may hold receivers out in any order.
            order = np.argsort(np.argsort(wanted.receiver, kind="stable"), kind="stable")
            arrays = {"mean": np.concatenate([one.mean for one in found])[order]}
            if found[0].std is not None:
                arrays["std"] = np.concatenate([one.stated_std for one in found])[order]
            write_arrays(kept, arrays)
        arrays = stored_arrays(kept)
        means.append(arrays["mean"])
        deviations.append(arrays.get("std"))
    for number in range(len(folds)):
        shutil.rmtree(session.folder / f"fold{number}", ignore_errors=True)
    known = [one for one in deviations if one is not None]
    mean = _as_unseen(np.concatenate(means), problem, held)
    return Prediction(mean, np.concatenate(known) if len(known) == len(means) else None)
