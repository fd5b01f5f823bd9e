"""Predictions of training rows by models that are fitted without them."""

from __future__ import annotations

import warnings
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
from ..training.reach import hold_out_groups
from .model import Fitted, Model, Problem, Session, inputs_of

FOLDS = 5
"""Parts of rows that are left to receivers, or of positions at a held-out carrier, of which one is held out; largest
number of groups of held-out observations."""
MOST_HELD_OUT, MOST_VALUES = (200, 600), 20_000
"""Largest number of held-out observations that weights and intervals are chosen from: 600 single numbers, fewer of many
values, but 200.
"""


def hold_out(record: Record, split: Split) -> Split | None:
    """The split of the training rows whose test rows are held out: the one hold-out of every choice.

    Clusters of positions are held out with the validation rows (`wrf_mi.training.reach.hold_out_groups`), so that some
    held-out rows lie as far from the others as those of a blocked split, and some as near as those of a random split.
    Of rows that are too few for clusters, the two that lie farthest from the others are held out.

    Where the split holds out receivers, half of the trained receivers are held out instead, but for as many rows as the
    split leaves; where it holds out a carrier, one of the trained carriers is, at held-out positions if the split's
    test positions are not among the training rows'.

    Args:
        record: data with known positions.
        split: split whose training and validation rows are divided.

    Returns:
        A split; None for fewer than three rows, fewer than two positions, or a single trained receiver or carrier.
    """
    if split.held_receivers:
        return _without_receivers(record, split)
    rows, positions = split.all_train, record.tx_pos_m[split.all_train]
    if len(rows) < 3 or len(np.unique(positions, axis=0)) < 2:
        return None
    if record.carriers_hz is not None and not np.isin(record.carriers_hz[split.test], _carriers(record, split)).any():
        return _without_carrier(record, split)
    groups = hold_out_groups(split, record.tx_pos_m)
    out = groups.validation
    if groups is split or len(out) < 2:
        distance, _ = cKDTree(positions).query(positions, k=2)
        out = np.sort(rows[np.argsort(-distance[:, 1], kind="stable")[: 2 if len(rows) > 3 else 1]])
    train, validation = (np.setdiff1d(part, out) for part in (split.train, split.validation))
    fold = Split("held out", split.seed, train, validation, out)
    return fold if rows_received(record, fold.all_train).max() >= LEAST_ROWS else None


def _without_receivers(record: Record, split: Split) -> Split | None:
    trained = np.setdiff1d(np.arange(len(record.receivers)), split.held_receivers)
    if len(trained) < 2:
        return None
    # The half that judges a correction (`wrf_mi.correction.correct`): offsets differ, and few say little of others.
    group = np.random.default_rng([split.seed, 9]).permutation(trained)[: len(trained) // 2].tolist()
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


def _carriers(record: Record, split: Split) -> FloatArray:
    """Carriers of the training rows, ascending, Hz."""
    assert record.carriers_hz is not None
    return np.unique(record.carriers_hz[split.all_train])


def _without_carrier(record: Record, split: Split) -> Split | None:
    carriers, rows = _carriers(record, split), split.all_train
    if len(carriers) < 2:
        return None
    assert record.carriers_hz is not None
    place = np.unique(record.tx_pos_m, axis=0, return_inverse=True)[1].reshape(-1)
    known = np.isin(place[split.test], place[rows]).any()
    rng = np.random.default_rng([split.seed, 4])
    order = rng.permutation(np.unique(place[rows]))
    held = order if known else order[: -(-len(order) // FOLDS)]
    at, there = record.carriers_hz == rng.choice(carriers), np.isin(place, held)
    gone = rows[at[rows] | (there[rows] if not known else False)]
    train, validation = (np.setdiff1d(part, gone) for part in (split.train, split.validation))
    test = rows[at[rows] & there[rows]]
    enough = len(test) and len(train) + len(validation) >= 2
    return Split("held out", split.seed, train, validation, test) if enough else None


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
    """Held-out observations: q pairs of a receiver and a row that it received.

    Attributes:
        receiver: number of the receiver [q].
        row: row of the record [q].
        distance_m: distance to the nearest row that remained and that the receiver received [q], metres.
        group: group of independent errors [q], fewer than `FOLDS`: clusters of positions, or receivers.
    """

    receiver: IntArray
    row: IntArray
    distance_m: FloatArray
    group: IntArray

    @classmethod
    def of(cls, record: Record, fold: Split, seed: int) -> HeldOut:
        """Held-out observations of a fold, or as many of them, drawn with a seed, as `MOST_HELD_OUT` allows."""
        parts: list[tuple[IntArray, IntArray, FloatArray]] = []
        distance = RowDistance(record.seen(fold), fold.all_train)
        for receiver in fold.held_receivers or fitted_receivers(record, [fold])[0]:
            rows = np.setdiff1d(fold.test, fold.left[fold.left[:, 0] == receiver, 1])
            rows = rows[np.isfinite(record.observation[receiver, rows]).reshape(len(rows), -1).all(axis=1)]
            parts.append((np.full(len(rows), receiver), rows, distance(record.tx_pos_m[rows], receiver)))
        receiver, row, away = (np.concatenate(values) for values in zip(*parts, strict=True))
        most = int(np.clip(MOST_VALUES // int(np.prod(record.observation.shape[2:])), *MOST_HELD_OUT))
        if len(row) > most:
            drawn = np.sort(np.random.default_rng([seed, 5]).permutation(len(row))[:most])
            receiver, row, away = receiver[drawn], row[drawn], away[drawn]
        if fold.held_receivers:
            group = np.unique(receiver, return_inverse=True)[1].reshape(-1) % FOLDS
        else:
            group = _clusters(record.tx_pos_m[row], seed)
        return cls(receiver, row, away, group)

    def __len__(self) -> int:
        """Number of held-out observations."""
        return len(self.row)

    def observed(self, record: Record) -> NDArray[np.float32] | NDArray[np.complex64]:
        """Observations [q, ...]."""
        return record.observation[self.receiver, self.row]


def _clusters(positions_m: FloatArray, seed: int) -> IntArray:
    """Clusters of positions [q, 3], at most `FOLDS`."""
    count = min(FOLDS, len(np.unique(positions_m, axis=0)))
    if count < 2:
        return np.zeros(len(positions_m), np.int64)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # an empty cluster has no row
        rng = np.random.default_rng([seed, 6])
        return np.asarray(kmeans2(positions_m, count, iter=50, minit="++", missing="warn", rng=rng)[1], np.int64)


def labelled(session: Session, label: str) -> Session:
    """A session that reports progress under a label."""

    def on_progress(stage: str, share: float, progress: Progress | None = None, /) -> None:
        session.on_progress(f"{label}: {stage.rpartition(': ')[2]}", share)

    return replace(session, on_progress=on_progress)


def fit_model(entry: Model, problem: Problem, split: Split, session: Session) -> tuple[Fitted, Problem]:
    """A fitted model, and the problem with the settings that its `Model.prepare` chose."""
    settings = entry.prepare(problem, [split], session)
    if settings is not problem.settings:  # a new problem would open its scene anew
        problem = replace(problem, settings=settings)
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


def as_unseen(mean: NDArray[Any], problem: Problem, held: HeldOut) -> NDArray[Any]:
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
    entry: Model, problem: Problem, fold: Split, held: HeldOut, session: Session, name: str
) -> Prediction:
    """Predictions of held-out observations by a model that is fitted to the rest.

    They are kept in the session's folder; a stopped fit goes on with them.

    Args:
        entry: model.
        problem: data, scene and settings.
        fold: split of `hold_out`.
        held: its held-out observations, or some of them.
        session: folder for files, progress callback and stop condition.
        name: name of the model for the progress callback.

    Returns:
        Mean and, where the model states it, standard deviation, [q, ...].

    Raises:
        InputError: rows that the model cannot be fitted to.
    """
    record, kept = problem.record, session.folder / "held_out.npz"
    if not kept.exists():
        session.folder.mkdir(parents=True, exist_ok=True)
        fitted, numbers = fit_fold(entry, problem, fold, labelled(session, f"{name}, held-out rows"))
        found = [
            predicted_rows(fitted, record, held.row[held.receiver == receiver], place)
            for place, receiver in enumerate(numbers)
            if (held.receiver == receiver).any()
        ]
        # Found receiver by receiver, while a fold may hold receivers out in any order.
        order = np.argsort(np.argsort(held.receiver, kind="stable"), kind="stable")
        arrays = {"mean": np.concatenate([one.mean for one in found])[order]}
        if found[0].std is not None:
            arrays["std"] = np.concatenate([one.stated_std for one in found])[order]
        write_arrays(kept, arrays)
    arrays = stored_arrays(kept)
    return Prediction(as_unseen(arrays["mean"], problem, held), arrays.get("std"))
