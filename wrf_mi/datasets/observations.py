"""Checks of the observations of a record that are learned from and scored."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ..core import InputError, Record, Split
from ..core.files import listed
from ..core.types import IntArray

logger = logging.getLogger(__name__)

ROWS_PER_CHUNK = 256  # rows that are checked at a time, so that large records are not copied
LARGEST = 1e15
"""Largest value of observations and parameters: squares of sums of ten thousand of them fit into single precision."""
LEAST_ROWS = 2
"""Training rows of a receiver that a fit needs: a level and its slope need two, as do a row that trains and another
that chooses settings."""
LEAST_RUNS = 3
"""Runs of training rows from which runs are held out: one of two leaves a single offset, of which none can be told."""
FEW_ROWS = 5
"""Training rows below which strengths of a receiver are predicted by the law of distance that all receivers share."""


def rows_received(record: Record, rows: IntArray) -> IntArray:
    """Number of some rows in which each receiver received something [n_rx].

    Of rows at several carriers the largest number at one of them, as some models are fitted to each carrier alone.
    """
    received = np.stack([~_states(observed, rows)[0] for observed in record.observation])
    if record.carriers_hz is None or not len(rows):
        return np.asarray(received.sum(axis=1), np.int64)
    carriers = np.unique(record.carriers_hz[rows])
    return np.asarray(received.astype(np.int64) @ (record.carriers_hz[rows][:, None] == carriers)).max(axis=1)


def trained_runs(record: Record, rows: IntArray) -> NDArray[np.str_]:
    """Names of the runs of the measurement that some rows are of, sorted; none where they are unknown."""
    runs = np.zeros(0, str) if record.runs is None else np.unique(record.runs[rows])
    return runs[runs != ""]


def predicts_new_runs(record: Record, split: Split) -> bool:
    """Whether the rows that a split predicts are of other runs of the measurement than those that train.

    Without test rows any may be wanted, and so those of another run. Fewer than `LEAST_RUNS` tell nothing of others.
    """
    runs = trained_runs(record, split.all_train)
    return len(runs) >= LEAST_RUNS and not np.isin(trained_runs(record, split.test), runs).any()


def fitted_receivers(
    record: Record, splits: Sequence[Split], least: int = LEAST_ROWS
) -> tuple[IntArray, dict[str, int]]:
    """Receivers with enough training rows in every split that trains them, and those without.

    Where no receiver has ``least`` rows, those with a row are enough: some models copy it, the others say what they
    need. Receivers that a split holds out need no training row there.

    Returns:
        Numbers of the receivers, ascending, and the smallest number of training rows of each of the others by name.

    Raises:
        InputError: every receiver lacks rows in one of the splits.
    """
    counts = np.full(len(record.receivers), len(record))
    for split in splits:
        trained = np.setdiff1d(np.arange(len(counts)), split.held_receivers)
        counts[trained] = np.minimum(counts[trained], rows_received(record, split.all_train)[trained])
    enough = np.flatnonzero(counts >= (least if counts.max() >= least else 1))
    if not counts.any():  # also where none is to be left out
        named = listed(receiver.name for receiver in record.receivers)
        place = f"in a fold of split {splits[0].name.partition(':')[0]}" if len(splits) > 1 else "in the training rows"
        text = f"{place_of(record)}: nothing was received {place} by any receiver ({named})"
        raise InputError(f"{text}; use another split or give more rows")
    scarce = np.setdiff1d(np.arange(len(counts)), enough)
    return enough, {record.receivers[number].name: int(counts[number]) for number in scarce}


def warn_of_left_out(record: Record, left_out: Mapping[str, int], least: int = LEAST_ROWS) -> None:
    """Log receivers that are left out for want of training rows."""
    if left_out:
        named = listed(f"{name} ({rows})" for name, rows in left_out.items())
        text = "%s: receivers with fewer than %d training rows are left out, with their number of rows: %s"
        logger.warning(text, record.name, least, named)


def warn_of_one_place(record: Record, splits: Sequence[Split]) -> None:
    """Log a split whose training rows, two or more, are all at one place."""
    for split in splits if record.has_positions else ():
        rows = split.all_train
        if len(rows) > 1 and (record.tx_pos_m[rows] == record.tx_pos_m[rows[0]]).all():
            text = "%s, split %s: all of %d training rows are at one place, which tells nothing of others; %s"
            logger.warning(text, record.name, split.name, len(rows), "measure at more places")


def check_observations(record: Record, split: Split, complete: bool = False, may_be_silent: bool = False) -> None:
    """Refuse training rows that cannot be learned from, and uplinks that nothing can be predicted from.

    NaN throughout an observation is a row without reception, which is refused only if the data must be ``complete``,
    for a model that is trained at every receiver on every row. With ``may_be_silent``, receivers may have received no
    training row. Observations of test rows are not checked: those that are not finite are not scored (`scorable`).

    Raises:
        InputError: a receiver without any training row; an observation of a training row that
            is not finite; an uplink of any row that is not finite, or all zero.
    """
    training_rows = split.all_train
    states = [_states(observed, training_rows) for observed in record.observation]
    never = np.setdiff1d(np.flatnonzero([missing.all() for missing, _ in states]), split.held_receivers)
    if len(never) and not (complete or may_be_silent):
        text = f"receiver {record.receivers[never[0]].name}: received none of {len(training_rows)} training rows"
        raise InputError(f"{place_of(record)}, {text}; leave it out or use another split")
    for receiver, observed, (missing, broken) in zip(record.receivers, record.observation, states, strict=True):
        bad = np.flatnonzero(broken | missing & complete)
        if len(bad):
            row = training_rows[bad[0]]
            where = f"{place_of(record)}, receiver {receiver.name}, row {row}"
            remedy = "correct or remove the row" if broken[bad[0]] else "remove the row or choose another model"
            raise InputError(f"{where}: {count_not_finite(observed[row])}; {remedy}")
    _check_uplink(record, np.concatenate([training_rows, split.test]))


def _check_uplink(record: Record, used: IntArray) -> None:
    if record.uplink is None:
        return
    uplink = record.uplink[used].reshape(len(used), -1)
    for row in np.flatnonzero(~computable(uplink).all(axis=1)):
        text = f"{place_of(record)}, row {used[row]}: uplink, {count_not_finite(uplink[row])}"
        raise InputError(f"{text}; correct or remove the row")
    for row in np.flatnonzero(~uplink.any(axis=1)):
        text = f"{place_of(record)}, row {used[row]}: uplink of zeros, where nothing was received"
        raise InputError(f"{text}; remove the row")


def scorable(observation: NDArray[np.generic]) -> tuple[NDArray[np.generic], int]:
    """Observations [n_rx, m, ...] with those that are not finite replaced by NaN throughout, and their number.

    The array is copied only if something is replaced; observations that are NaN throughout do not count.
    """
    rows = np.arange(observation.shape[1])
    broken = np.stack([_states(observed, rows)[1] for observed in observation])
    if broken.any():
        observation = observation.copy()
        observation[broken] = np.nan
    return observation, int(np.count_nonzero(broken))


def _states(observed: NDArray[np.generic], rows: IntArray) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Whether nothing was received in each row, and whether the observation is neither `computable` nor missing."""
    missing, broken = np.empty(len(rows), bool), np.empty(len(rows), bool)
    for start in range(0, len(rows), ROWS_PER_CHUNK):
        part = slice(start, start + ROWS_PER_CHUNK)
        values = observed[rows[part]].reshape(len(rows[part]), -1)
        missing[part] = np.isnan(values).all(axis=1)
        broken[part] = ~computable(values).all(axis=1) & ~missing[part]
    return missing, broken


def computable(values: NDArray[np.generic]) -> NDArray[np.bool_]:
    """Whether each value is finite and at most `LARGEST` in size."""
    with np.errstate(over="ignore"):  # of a complex number near the largest one
        return np.asarray(np.abs(values) <= LARGEST)


def place_of(record: Record) -> str:
    """Path that a record was read from, or its name."""
    return record.source or record.name


def count_not_finite(values: NDArray[np.generic]) -> str:
    """Number of values that are not finite or too large, in words."""
    count, what = np.count_nonzero(~computable(values)), "not finite"
    if np.isfinite(values).all():
        what = f"larger than {LARGEST:g}, as no amplitude or power is"
    return f"{count} of {values.size} values are {what}"


def check_rows(split: Split, record: Record, source: str) -> None:
    """Refuse a split with rows beyond the record's; ``source`` names the split, for the message; raises InputError."""
    rows = np.concatenate([split.train, split.validation, split.test])
    bad = rows[(rows < 0) | (rows >= len(record))]
    if len(bad):
        raise InputError(f"{source}: row {bad[0]}, but {record.name} has rows 0 to {len(record) - 1}; use other rows")
