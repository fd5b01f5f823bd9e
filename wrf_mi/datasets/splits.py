"""Splits of rows into training, validation and test: seeded, nested, stored with the run."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core import InputError, Record, Split
from ..core.array_files import stored_arrays, write_arrays
from ..core.files import readable
from ..core.stored import from_arrays, to_arrays
from ..core.types import IntArray

FOLDED = ("blocked", "frequency", "frequency-known", "receiver", "other-run")  # splits of several folds
NONE = "none"  # split whose last part trains on all rows and tests none; its scores are those of the folds before
SPLIT_NAMES = ("official", "random", *FOLDED, "trajectory", NONE)
NAME = re.compile(rf"(?:{'|'.join(FOLDED)}|receiver\+0*[1-9][0-9]*)(?::.*)?|{'|'.join(SPLIT_NAMES)}", re.DOTALL)
"""Name of a split, with the rows that it leaves each receiver and the number of a fold."""
PARTS = ("train", "validation", "test")
TRAIN_FRACTION = 0.8
"""Training share of ``random`` and ``trajectory``, as in the authors' split of rfid-lab (160 of 200)."""
FOLDS = 5  # number of spatial blocks of data without folds
FOLD_SEED = 0  # seed of the spatial blocks, which belong to the data and do not depend on the seed of a run
MOST_RECEIVERS, RECEIVER_FOLDS = 8, 4
"""Largest number of receivers that are held out in turn, and number of folds of more."""
CLUSTER_STARTS = 10  # starts of k-means; the tightest clusters without an empty one are used
SPLIT_FORMAT = 2  # version of the split file


def make_splits(
    record: Record, name: str, seed: int = 0, n_train: int | float | None = None, validation_fraction: float = 0.1
) -> list[Split]:
    """Split a record's rows by one of nine rules.

    - ``official``: the split of the data.
    - ``random``: seeded, 80 % train and 20 % test; ``trajectory``: the same in the order of the file.
    - ``blocked``: a split per spatial fold, which is its test set; the folds are ``record.folds`` or else five k-means
      clusters of the positions.
    - ``frequency``: a split per carrier, whose rows at held-out positions are its test set; rows of the other carriers
      at the other positions train. Held out are the positions of the official test rows, or else a seeded 20 %.
    - ``frequency-known``: the same test rows; all rows of the other carriers train, at the held-out positions, too.
    - ``receiver``: a split per receiver, or per fold of four of more than eight receivers (seeded), whose test set is
      what these receive in the test rows; the other receivers' training rows train. Rows are those of the official
      split, or else of the random one. ``receiver+20``: 20 training rows of each held-out receiver train, too, a seeded
      draw, nested for equal seeds.
    - ``other-run``: a split per run of the measurement, its test set, in the order of first appearance.
    - ``none``: the spatial folds of ``blocked``, and last all rows, which train, with none to test. Where positions are
      not known or fewer than five are distinct, folds are a seeded draw.

    One fold alone is ``blocked:2``, ``frequency:0`` (the lowest carrier), ``frequency-known:0``, ``receiver:1`` or
    ``other-run:0``.

    Rows that no receiver received (NaN throughout) are in no part of any split. Validation rows are a seeded draw from
    the training rows. Subsets by ``n_train`` and their validation rows are nested for equal seeds.

    Args:
        record: any record with n rows.
        name: ``official``, ``random``, ``trajectory``, or ``blocked``, ``frequency``, ``frequency-known``,
            ``receiver``, ``other-run`` with or without the number of a fold.
        seed: seed of the random split, the held-out positions, folds of receivers, the subset and the validation rows;
            not of spatial folds.
        n_train: number of training rows to keep, validation rows included, or their share (a float up to 1); by default
            all.
        validation_fraction: share of the kept training rows that is set aside to choose settings, in [0, 1).

    Returns:
        A single split, or a split per fold; rows are sorted.

    Raises:
        InputError: an unknown name, a rule that the record cannot follow, a part without any row that was received, or
            numbers out of range.

    >>> from wrf_mi import Receiver
    >>> receiver = Receiver("anchor1", np.zeros(3), np.array([0.0, 0, 0, 1]))
    >>> positions_m = np.random.default_rng(0).uniform(0, 5, (50, 3))
    >>> record = Record("made-up", "rssi", positions_m, (receiver,), np.full((1, 50), -50, np.float32))
    >>> split = make_splits(record, "random", n_train=20)[0]
    >>> len(split.train), len(split.validation), len(split.test)
    (18, 2, 10)
    >>> [one.name for one in make_splits(record, "blocked")]
    ['blocked:0', 'blocked:1', 'blocked:2', 'blocked:3', 'blocked:4']
    """
    if not 0 <= validation_fraction < 1:
        raise InputError(f"validation fraction {validation_fraction}: choose one in [0, 1)")
    if seed < 0:
        raise InputError(f"seed {seed}: choose a whole number from 0")
    return [_split(record, rows, seed, n_train, validation_fraction) for rows in _train_and_test(record, name, seed)]


def _split(record: Record, rows: _Rows, seed: int, n_train: int | float | None, validation_fraction: float) -> Split:
    what = f"{record.name}, split {rows.name}"
    for verb, part in (("trains", rows.train), ("scores", rows.test)):
        if len(part) == 0 and (rows.name != NONE or part is rows.train):
            raise InputError(f"{what}: no row that was received {verb}{_why(record)}")
    # A seeded order serves both draws, and whether its i-th row validates depends on i alone: so any prefix of it is
    # nested in a longer one, validation rows included.
    order = np.random.default_rng([seed, 1]).permutation(np.sort(rows.train))
    count = _training_count(n_train, len(order))
    if not 1 <= count <= len(order):
        raise InputError(f"{what}: n_train {n_train}; choose 1 to {len(order)} rows or a fraction in (0, 1]")
    order = order[:count]
    # Validation rows among the first i + 1; rounding keeps 30 * 0.1 from counting as 4.
    counts = np.ceil(np.round(np.arange(len(order) + 1) * validation_fraction, 9))
    validates = np.diff(np.concatenate([[0], counts[:-1]])) > 0
    parts = np.sort(order[~validates]), np.sort(order[validates]), np.sort(rows.test)
    left = rows_left(record, np.sort(order), rows.held_receivers, rows.left, seed)
    for receiver in rows.held_receivers:
        if (count_left := int((left[:, 0] == receiver).sum())) < rows.left:
            who = f"{record.name}: {record.receivers[receiver].name} received {count_left} of the training rows"
            raise InputError(f"{who}, and split {rows.name} leaves it {rows.left}; leave fewer")
    return Split(rows.name, seed, *parts, rows.held_receivers, left)


def _training_count(n_train: int | float | None, count: int) -> int:
    """Number of ``count`` training rows that are kept; 0 for a share out of range."""
    if n_train is None:
        return count
    if isinstance(n_train, int | np.integer) and not isinstance(n_train, bool):
        return int(n_train)
    return round(float(n_train) * count) if 0 < n_train <= 1 else 0


def default_split(record: Record) -> str:
    """Name of the split where none is asked for: that of the data, or else ``none``."""
    return NONE if record.official is None else "official"


def single_split(record: Record, name: str | None, seed: int = 0, n_train: int | float | None = None) -> Split:
    """Rows that correct a scene: those of a split, None: the default one; `InputError`: a split of several folds."""
    chosen = default_split(record) if name is None else name
    splits = make_splits(record, chosen, seed, n_train)
    if len(splits) > 1 and chosen != NONE:
        raise InputError(f"--split {name}: a scene is corrected by one split; choose a fold, such as {name}:0")
    return splits[-1]


def splits_below(record: Record, name: str) -> tuple[str, ...]:
    """Name of the split of rows that a split by receivers divides further; none for any other split."""
    if re.split("[+:]", name)[0] != "receiver":
        return ()
    return ("random" if record.official is None else "official",)


def rows_left(record: Record, rows: IntArray, receivers: Sequence[int], count: int, seed: int) -> IntArray:
    """Pairs [q, 2] of each of some receivers and up to ``count`` of the ``rows`` that it received, a seeded draw."""
    received = np.asarray(np.isfinite(record.observation[:, rows]).reshape(len(record.receivers), len(rows), -1).all(2))
    pairs = [np.zeros((0, 2), np.int64)]
    for receiver in receivers:
        chosen = np.sort(np.random.default_rng([seed, 7, receiver]).permutation(rows[received[receiver]])[:count])
        pairs.append(np.stack([np.full(len(chosen), receiver), chosen], axis=1))
    return np.concatenate(pairs)


def save_split(path: str | Path, split: Split) -> None:
    """Write a split as an npz file of plain arrays (no pickle), atomically.

    Keys: ``format``, ``name``, ``seed``, ``train``, ``validation``, ``test`` (rows from 0), ``held_receivers`` (numbers
    from 0, as JSON), ``left`` (pairs of such a receiver and a row that trains) and ``wanted_m`` (positions where
    predictions are wanted, metres).
    """
    write_arrays(Path(path), {"format": np.int64(SPLIT_FORMAT), **to_arrays(split)})


def load_split(path: str | Path) -> Split:
    """Read a file of `save_split`.

    Raises:
        InputError: missing, unreadable, of another version, or with a row in two of its parts.
    """
    remedy = "give a split.npz of a run folder"
    with readable(Path(path), f"{path}: missing; {remedy}", remedy):
        arrays = stored_arrays(Path(path))
        if (version := int(arrays["format"])) != SPLIT_FORMAT:
            raise InputError(f"{path}: format {version}, not {SPLIT_FORMAT}; use the version that wrote it")
        split = from_arrays(Split, arrays)
    left = split.left
    _check_rows(path, [split.train, split.validation, split.test, left])
    if not (np.isin(left[:, 0], split.held_receivers).all() and np.isin(left[:, 1], split.all_train).all()):
        raise InputError(f"{path}: leaves rows that no held-out receiver trains on; make the split again")
    return split


def _check_rows(path: str | Path, lists: list[NDArray[np.generic]]) -> None:
    """Refuse parts of a split that are not lists of different rows, or not followed by pairs of receiver and row."""
    *parts, left = lists
    rows = np.concatenate([part.ravel() for part in parts])
    shapes = [*((part.size,) for part in parts), (left.size // 2, 2)]
    numbers = [part.shape == shape and part.dtype.kind == "i" for part, shape in zip(lists, shapes, strict=True)]
    if not all(numbers) or rows.min(initial=0) < 0:
        raise InputError(f"{path}: rows are not lists of whole numbers from 0; make the split again")
    if len(np.unique(rows)) != len(rows):
        raise InputError(f"{path}: a row is in the split twice; make the split again")


def _why(record: Record, otherwise: str = "; use another split") -> str:
    """What is wrong with rows that a split cannot divide, and the remedy: no split divides those of a single place."""
    if not record.has_positions or len(np.unique(record.tx_pos_m, axis=0)) > 1:
        return otherwise
    return f": all of {len(record)} rows are at one place; measure at more places"


def position_folds(record: Record) -> IntArray:
    """The spatial fold 0, 1, ... of each row, shape [n]: those of the record, or seeded k-means clusters.

    Raises:
        InputError: positions are not known, or there are too few distinct ones for five clusters.
    """
    if record.folds is not None:
        return record.folds
    if not record.has_positions:
        text = "blocks need the position of every row, which these data do not tell"
        raise InputError(f"{record.name}: {text}; use the split random or trajectory")
    distinct = len(np.unique(record.tx_pos_m, axis=0))
    if distinct < FOLDS:
        raise InputError(f"{record.name}: {distinct} distinct positions for {FOLDS} blocks{_why(record)}")
    from scipy.cluster.vq import ClusterError, kmeans2

    # k-means ends in a local optimum that depends on its start, and may leave a cluster empty ("raise").
    best, folds = np.inf, None
    for attempt in range(CLUSTER_STARTS):
        try:
            rng = np.random.default_rng([FOLD_SEED, attempt])
            centres, labels = kmeans2(record.tx_pos_m, FOLDS, iter=50, minit="++", missing="raise", rng=rng)
        except ClusterError:
            continue
        spread = float(np.square(record.tx_pos_m - centres[labels]).sum())
        if spread < best:
            best, folds = spread, labels.astype(np.int64)
    if folds is None:
        raise InputError(f"{record.name}: its positions do not fall into {FOLDS} blocks; give blocked_folds.txt")
    return folds


class _Rows(NamedTuple):
    """Name, training and test rows of a split, the receivers that it holds out, and how many rows it leaves each."""

    name: str
    train: IntArray
    test: IntArray
    held_receivers: tuple[int, ...] = ()
    left: int = 0


def _train_and_test(record: Record, name: str, seed: int) -> list[_Rows]:
    kind = _rule_of(name)
    missing = np.isnan(record.observation).reshape(len(record.receivers), len(record), -1)
    rows = np.flatnonzero(~missing.all(axis=(0, 2)))
    if kind == "official":
        if record.official is None:
            raise InputError(f"{record.name}: has no official split; add its index files or choose another split")
        train, test = (part[np.isin(part, rows)] for part in record.official)
        return [_Rows(name, train, test)]
    if kind == NONE:
        return _all_rows(record, seed, rows)
    if kind == "receiver":
        return _receivers_held_out(record, name, seed)
    if kind in FOLDED:
        return _folds_held_out(record, name, seed, rows)
    first = round(TRAIN_FRACTION * len(rows))
    if not 0 < first < len(rows):
        text = f"{record.name}: {len(rows)} rows; a {name} split needs 3 at least"
        raise InputError(f"{text}{_why(record, otherwise='')}")
    order = np.random.default_rng(seed).permutation(rows) if kind == "random" else rows
    return [_Rows(name, order[:first], order[first:])]


def _rule_of(name: str) -> str:
    """Name of a split without the number of a fold or of the rows left; an `InputError` if it is unknown."""
    if not NAME.fullmatch(name):
        choices = f"{', '.join(SPLIT_NAMES)}, a fold such as blocked:0, or rows left such as receiver+20"
        raise InputError(f"split {name!r}: unknown; choose {choices}")
    return re.split("[+:]", name)[0]


def _all_rows(record: Record, seed: int, rows: IntArray) -> list[_Rows]:
    """Spatial folds of the rows, or drawn ones where positions do not suffice, and a part that trains on all rows."""
    fold = np.random.default_rng([seed, 8]).permutation(len(record)) % FOLDS
    if record.folds is not None or (len(np.unique(record.tx_pos_m, axis=0)) >= FOLDS and record.has_positions):
        fold = position_folds(record)
    fold = fold[rows]
    folds = [_Rows(f"{NONE}:{k}", rows[fold != k], rows[fold == k]) for k in np.unique(fold)]
    return [*folds, _Rows(NONE, rows, rows[:0])]


def _folds_held_out(record: Record, name: str, seed: int, rows: IntArray) -> list[_Rows]:
    """A split for each spatial fold, run or carrier."""
    kind = name.partition(":")[0]
    trains = tested = np.ones(len(rows), bool)
    if kind.startswith("frequency"):
        fold, tested = _carrier_numbers(record, kind)[rows], _held_out_positions(record, seed)[rows]
    else:
        fold = (position_folds if kind == "blocked" else _run_numbers)(record)[rows]
    # Held-out positions are new to the model: with "frequency-known" they are known at the other carriers.
    if kind == "frequency":
        trains = ~tested
    chosen = _folds(record, name, int(fold.max(initial=0)) + 1)
    return [_Rows(f"{kind}:{k}", rows[(fold != k) & trains], rows[(fold == k) & tested]) for k in chosen]


def _carrier_numbers(record: Record, kind: str) -> IntArray:
    """Number of each row's carrier [n], 0 for the lowest."""
    if record.carriers_hz is None:
        text = f"split {kind} holds out carriers, and these data have one"
        raise InputError(f"{record.name}: {text}; give rows of several carriers or choose another split")
    return np.unique(record.carriers_hz, return_inverse=True)[1].reshape(-1).astype(np.int64)


def _run_numbers(record: Record) -> IntArray:
    """Number of each row's run [n], 0 for that of the first row."""
    _, first, number = np.unique([] if record.runs is None else record.runs, return_index=True, return_inverse=True)
    if len(first) < 2:
        what = "state none" if record.runs is None else "have one"
        remedy = "give a column run (docs/data.md) with two at least, or choose another split"
        text = f"split other-run holds out runs of the measurement, and these data {what}"
        raise InputError(f"{record.name}: {text}; {remedy}")
    return np.argsort(np.argsort(first))[number.reshape(-1)].astype(np.int64)


def _held_out_positions(record: Record, seed: int) -> NDArray[np.bool_]:
    """Rows [n] at held-out positions: those of the official test rows, or a seeded fifth of the distinct ones."""
    if not record.has_positions:
        raise InputError(f"{record.name}: positions are not known, which this split holds out; use another split")
    distinct, number = np.unique(record.tx_pos_m, axis=0, return_inverse=True)
    number = number.reshape(-1)
    if record.official is not None:
        held_out = np.unique(number[record.official[1]])
    else:
        order = np.random.default_rng([seed, 2]).permutation(len(distinct))
        held_out = order[round(TRAIN_FRACTION * len(distinct)) :]
    return np.isin(number, held_out)


def _folds(record: Record, name: str, count: int) -> range:
    """Folds that a name asks for, of ``count``."""
    kind, colon, fold = name.partition(":")
    if not colon:
        return range(count)
    if not (fold.isascii() and fold.isdecimal() and int(fold) < count):
        raise InputError(f"split {name!r}: no such fold; {record.name} has {kind}:0 to {kind}:{count - 1}")
    return range(int(fold), int(fold) + 1)


def _receivers_held_out(record: Record, name: str, seed: int) -> list[_Rows]:
    """A split for each receiver, or for each fold of many, with rows that the trained and the held-out receive."""
    count = len(record.receivers)
    if count < 2:
        raise InputError(f"{record.name}: one receiver, and split receiver holds receivers out; use another split")
    order = np.arange(count)
    # Each fold is a fit of its own: many receivers are held out by the group.
    if count > MOST_RECEIVERS:
        order = np.random.default_rng([seed, 6]).permutation(count) % RECEIVER_FOLDS
    (rows,) = (only for below in splits_below(record, name) for only in _train_and_test(record, below, seed))
    received = np.asarray(np.isfinite(record.observation).reshape(count, len(record), -1).all(axis=2), bool)
    label = name.partition(":")[0]
    left = int("0" + label.partition("+")[2])
    splits = []
    for k in _folds(record, name, int(order.max()) + 1):
        held_out = np.asarray(order == k)
        train, test = (
            part[received[who][:, part].any(axis=0)] for who, part in ((~held_out, rows.train), (held_out, rows.test))
        )
        # A receiver without test rows cannot be scored; the others can.
        if len(test) or ":" in name:
            splits.append(_Rows(f"{label}:{k}", train, test, tuple(np.flatnonzero(held_out).tolist()), left))
    return splits
