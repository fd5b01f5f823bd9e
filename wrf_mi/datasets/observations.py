"""Which observations of a record can be learned from, and which can be scored."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core import InputError, Record, Split
from ..core.types import IntArray

ROWS_PER_CHUNK = 256
"""Rows that are looked at together: a record of spectra is not to be copied for it."""


def check_observations(record: Record, split: Split, complete: bool = False) -> None:
    """Refuse training rows that cannot be learned from, and uplinks that nothing can be predicted from.

    What was observed in test rows is not looked at: those that are not finite are not scored (`scorable`).

    Args:
        record: NaN throughout an observation says that the receiver received nothing in that row.
        split: rows.
        complete: refuse these too, for a model that is trained at every receiver on every row.

    Raises:
        InputError: a receiver without any training row, also at one of several carriers; an observation of a training
            row that is not finite; an uplink of any row that is not finite, or all zero.
    """
    known = split.all_train
    states = [_states(observed, known) for observed in record.observation]
    if not complete:
        for receiver, (missing, _) in zip(record.receivers, states, strict=True):
            if missing.all():
                raise InputError(
                    f"{place_of(record)}, receiver {receiver.name}: received none of {len(known)} training rows; "
                    "leave it out or use another split"
                )
    if record.carriers_hz is not None:
        for carrier in np.unique(record.carriers_hz[np.concatenate([known, split.test])]):
            own = record.carriers_hz[known] == carrier
            for receiver, (missing, _) in zip(record.receivers, states, strict=True):
                if missing[own].all():
                    text = f"received none of {own.sum()} training rows at {carrier:.10g} Hz"
                    remedy = "leave that carrier out or use another split"
                    raise InputError(f"{place_of(record)}, receiver {receiver.name}: {text}; {remedy}")
    for receiver, observed, (missing, broken) in zip(record.receivers, record.observation, states, strict=True):
        bad = np.flatnonzero(missing | broken if complete else broken)
        if len(bad):
            row = known[bad[0]]
            where = f"{place_of(record)}, receiver {receiver.name}, row {row}"
            remedy = "correct or remove the row" if broken[bad[0]] else "remove the row or choose another model"
            raise InputError(f"{where}: {count_not_finite(observed[row])}; {remedy}")
    if record.uplink is not None:
        used = np.concatenate([known, split.test])
        uplink = record.uplink[used].reshape(len(used), -1)
        bad = np.flatnonzero(~np.isfinite(uplink).all(axis=1))
        if len(bad):
            text = f"{place_of(record)}, row {used[bad[0]]}: uplink, {count_not_finite(uplink[bad[0]])}"
            raise InputError(f"{text}; correct or remove the row")
        silent = np.flatnonzero(~uplink.any(axis=1))
        if len(silent):
            text = f"{place_of(record)}, row {used[silent[0]]}: uplink of zeros, where nothing was received"
            raise InputError(f"{text}; remove the row")


def scorable(observation: NDArray[np.generic]) -> tuple[NDArray[np.generic], int]:
    """Observations with those that are not finite marked as not received, NaN throughout.

    Args:
        observation: [n_rx, m, ...].

    Returns:
        The same array where there is nothing to mark, else a copy; and how many were marked: those that are finite or
        NaN throughout are as they were.
    """
    rows = np.arange(observation.shape[1])
    broken = np.stack([_states(observed, rows)[1] for observed in observation])
    if broken.any():
        observation = observation.copy()
        observation[broken] = np.nan
    return observation, int(np.count_nonzero(broken))


def _states(observed: NDArray[np.generic], rows: IntArray) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Of a receiver's rows: whether nothing was received, and whether an observation is neither finite nor missing."""
    missing, broken = np.empty(len(rows), bool), np.empty(len(rows), bool)
    for start in range(0, len(rows), ROWS_PER_CHUNK):
        part = slice(start, start + ROWS_PER_CHUNK)
        values = observed[rows[part]].reshape(len(rows[part]), -1)
        # NaN throughout says that nothing was received; anything else that is no number is a mistake in the data.
        missing[part] = np.isnan(values).all(axis=1)
        broken[part] = ~np.isfinite(values).all(axis=1) & ~missing[part]
    return missing, broken


def place_of(record: Record) -> str:
    """Where a record was read from; its name where it was not read."""
    return record.source or record.name


def count_not_finite(values: NDArray[np.generic]) -> str:
    """How many values are not finite, in words."""
    return f"{np.count_nonzero(~np.isfinite(values))} of {values.size} values are not finite"
