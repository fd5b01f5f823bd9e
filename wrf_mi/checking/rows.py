"""Rows that hold no measurement: numbers for what was not heard, zeros, repeated rows, and values that never change.

A number for "not heard", such as -200, -100 or 100 dBm, differs from measured strengths in that many rows have exactly
the same one, at an end of the distribution. Either nothing lies near it, or it adjoins the weakest strengths, as those
do that are clipped at the sensitivity; then the data do not tell which of the two it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import InputError, Record, Split
from ..core.angles import FloatArray
from ..core.digest import content_digest
from ..core.types import IntArray
from ..datasets.observations import FEW_ROWS, LEAST_ROWS, fitted_receivers
from ..tasks import task_of
from .units import Found, is_above_0_dbm

IMPOSSIBLE_DBM = -150.0  # thermal noise in 250 Hz at room temperature (-174 dBm per Hz): no receiver reports less
STRONG_DBM = -10.0  # values at the upper end are suspicious from here: below, they are rows next to the receiver
CUSTOMARY_DBM = frozenset({-999.0, -200.0, -128.0, -127.0, -120.0, -113.0, -110.0, -105.0, -101.0, -100.0, 0.0, 100.0})
"""Numbers that drivers and data sets give for "not heard": fewer rows and smaller gaps suffice."""
ALONE_DB = {1: 40.0, 2: 20.0, 3: 12.0}
CUSTOMARY_ALONE_DB = {1: 30.0, 2: 12.0, 3: 5.0}
"""Gap beyond which a value at an end stands alone, by its least number of rows: a single deep fade lies some 30 dB
below the median, and three equal values 12 dB below all others are no fade."""
STEPS = 4.0  # least such gap in steps of strengths that are quantised coarsely
FEWEST_OTHERS = 10  # least number of other rows beside one or two that stand alone
NEAR_DB, LEVELS = 3.0, 2.5
"""Values near another: within 3 dB, or within so many of their steps where they are quantised more coarsely."""
FEWEST, SHARE, RATIO = 6, 0.02, 3.0
"""Least number of rows and share of a value at an end that adjoins others, and least ratio to the most frequent value
near it. A tail has few rows at its end; one that is cut off, for rows below it are empty, as many as next to it."""
INNER_FEWEST, INNER_SHARE, INNER_RATIO, WEAKER = 10, 0.02, 8.0, 0.25
"""The same for a value among the weakest quarter: the mode of strengths in whole dB, of a transmitter that stands still
for instance, is not near an end, and its neighbours are frequent, too."""
MOST_VALUES = 4  # largest number of values that are found in one receiver, one after the other
FEWEST_STRENGTHS = 4
"""Least number of receivers that received a repeated row: strengths in whole dB of fewer receivers repeat by chance
where a transmitter stands still."""
SHOWN = 10  # number of rows that a text names


@dataclass(frozen=True)
class Value:
    """A value that is suspicious, and whether it adjoins the other strengths."""

    dbm: float
    adjoins: bool


def not_heard(record: Record) -> Found:
    """Numbers for "not heard" among signal strengths, and channels and spectra of zeros."""
    if record.task == "rssi":
        yield from _strengths(record)
        return
    what = {"csi": "channels", "spectrum": "spectra"}.get(record.task)
    if what is None:
        return
    for receiver, observed in zip(record.receivers, record.observation, strict=True):
        zeros = np.flatnonzero(~observed.reshape(len(record), -1).any(axis=1))
        if len(zeros):
            share = f"{_percent(len(zeros) / len(record))} of the rows ({len(zeros)} of {len(record)})"
            text = f"receiver {receiver.name}: {what} of zeros in {share}: {named_rows(zeros)}"
            yield "not-heard", f"{text}; zeros are learned as measured: remove the rows, or give NaN (wrf_mi.Record)"


def _strengths(record: Record) -> Found:
    # Different values that are all positive are on another scale, which `strength_scale` reports.
    observed = [values[np.isfinite(values)].astype(float) for values in record.observation]
    observed = [values[:0] if is_above_0_dbm(values) and np.ptp(values) else values for values in observed]
    by_receiver = [{value.dbm: value for value in suspicious_values(values)} for values in observed]
    # A number that each receiver has once or twice shows in all of them together.
    pooled = suspicious_values(np.concatenate(observed))
    suspects = {dbm: value for values in by_receiver for dbm, value in values.items()}
    suspects |= {value.dbm: value for value in pooled if not value.adjoins}
    for dbm, value in sorted(suspects.items()):
        counts = np.array([np.count_nonzero(values == dbm) for values in observed])
        if value.adjoins:  # other receivers may have measured it
            counts = np.where([dbm in values for values in by_receiver], counts, 0)
        where = _named_counts(record, counts, np.array([len(values) for values in observed]))
        if value.adjoins:
            what = "far more often than the strengths next to it: "
            what += "clipped at the sensitivity, or a number for 'not heard'"
            remedy = "where nothing was heard, leave the field empty; clipped strengths are learned as measured"
        else:
            what = "apart from all other strengths: a number for 'not heard', which is learned as measured"
            remedy = "leave the field empty where nothing was heard (NaN in a wrf_mi.Record, -100 in NeRF2's layout)"
        yield "not-heard", f"{dbm:g} dBm, {what}: {where}; {remedy}"


def suspicious_values(strengths_dbm: FloatArray) -> list[Value]:
    """Values that stand for "not heard" among strengths [n] of a receiver, one after the other without those before."""
    suspicious: list[Value] = []
    remaining = strengths_dbm
    while len(suspicious) < MOST_VALUES and (value := _next_value(remaining)) is not None:
        suspicious.append(value)
        remaining = remaining[remaining != value.dbm]
    return suspicious


def _next_value(strengths_dbm: FloatArray) -> Value | None:
    values, counts = np.unique(strengths_dbm, return_counts=True)
    if len(values) < 2:
        return None  # one value in every row is reported as constant
    step, rows = float(np.median(np.diff(values))), len(strengths_dbm)
    # The lower end last: next to a mark of 100 dBm the weakest strength may stand alone, too.
    for end, inward in ((len(values) - 1, -2), (0, 1)):
        value, gap_db, count = float(values[end]), abs(float(values[end] - values[inward])), int(counts[end])
        if end and value < STRONG_DBM:
            continue
        needed = CUSTOMARY_ALONE_DB if value in CUSTOMARY_DBM else ALONE_DB
        impossible = value < IMPOSSIBLE_DBM or (value >= 0 and values[inward] < 0)
        alone_db = needed[3] if impossible else max(needed[min(count, 3)], STEPS * step if rows - count > count else 0)
        if gap_db >= alone_db and (impossible or count >= 3 or rows - count >= FEWEST_OTHERS):
            return Value(value, adjoins=False)
    near_db = max(NEAR_DB, LEVELS * step)
    below = np.cumsum(counts) - counts
    for place in np.flatnonzero((counts >= FEWEST) & (counts >= SHARE * rows)).tolist():
        near = (np.abs(values - values[place]) <= near_db) & (values != values[place])
        ratio = counts[place] / max(int(counts[near].max(initial=0)), 1)
        ends = place == 0 or (place == len(values) - 1 and values[place] >= STRONG_DBM)
        # Rows below the value as a share of the others, of which a mark may leave few.
        weak = below[place] <= WEAKER * (rows - counts[place])
        inner = counts[place] >= max(INNER_FEWEST, INNER_SHARE * rows) and weak
        if (ends and ratio >= RATIO) or (inner and ratio >= INNER_RATIO):
            return Value(float(values[place]), adjoins=bool(near.any()))
    return None


def _named_counts(record: Record, counts: IntArray, received: IntArray) -> str:
    """Receivers with a value, each with the share and the number of its rows, and the share of all."""
    numbers = np.flatnonzero(counts)
    named = [
        f"{record.receivers[number].name} {_percent(counts[number] / received[number])} "
        f"({counts[number]} of {received[number]} rows)"
        for number in numbers[:SHOWN]
    ]
    if len(numbers) > SHOWN:
        share = _percent(counts.sum() / received[numbers].sum())
        named.append(f"{len(numbers) - SHOWN} more receivers, {share} of the strengths of all {len(numbers)}")
    return ", ".join(named)


def _percent(share: float) -> str:
    return f"{100 * share:.3g} %" if share >= 0.995 else f"{100 * share:.2g} %"


def few_rows(record: Record) -> Found:
    """Receivers that received too few training rows to be fitted, of the official split or of all rows."""
    strengths = task_of(record).in_decibel
    least = FEW_ROWS if strengths else LEAST_ROWS
    train, _ = record.official or (np.arange(len(record)), None)
    split = Split("official" if record.official else "all rows", 0, train, np.zeros(0, np.int64), np.zeros(0, np.int64))
    try:
        _, scarce = fitted_receivers(record, [split], least)
    except InputError as error:
        yield "few-rows", str(error)
        return
    if scarce:
        named = ", ".join(f"{name} ({rows})" for name, rows in scarce.items())
        what = f"fewer than {least} training rows were received by {named}"
        fits = "predict these receivers from the others" if strengths else "leave these receivers out"
        yield "few-rows", f"{what}: fits {fits}; give more rows of theirs, or remove them"


def named_rows(rows: IntArray) -> str:
    """Rows, counted from 1, in words: the first `SHOWN` and the number of the others."""
    text = ", ".join(str(row + 1) for row in rows[:SHOWN])
    more = f" and {len(rows) - SHOWN} more" if len(rows) > SHOWN else ""
    return f"row{'s' if len(rows) > 1 else ''} {text}{more}"


def repeated_rows(record: Record) -> Found:
    """Rows with position, conditions and observation of an earlier row, and test rows among the training rows."""
    received = _received_values(record) >= (FEWEST_STRENGTHS if record.task == "rssi" else 1)
    parts = [part for part in (record.tx_pos_m, record.tx_heading_rad, record.carriers_hz) if part is not None]
    per_receiver = [part for part in (record.observation, record.n_readings, record.std) if part is not None]
    per_row = [*parts, *(np.moveaxis(part, 1, 0) for part in per_receiver)]
    if record.uplink is not None:
        per_row.append(record.uplink)
    first = _first_equal(per_row)
    repeated = np.flatnonzero((first != np.arange(len(record))) & received)
    if record.official is not None:
        train, test = record.official
        # A row is the same as another one if both are the same as one earlier row.
        leaked = test[np.isin(first[test], first[train]) & received[test]]
        if len(leaked):
            what = f"{len(leaked)} of {len(test)} test rows are training rows too, observation included"
            yield "train-test", f"{what}: {named_rows(np.sort(leaked))}; remove them from one of the two"
            repeated = np.setdiff1d(repeated, np.flatnonzero(np.isin(first, first[leaked])))
    if len(repeated):
        what = f"{len(repeated)} of {len(record)} rows repeat an earlier row, observation included"
        yield "repeated-rows", f"{what}: {named_rows(repeated)}; remove them, or give what was measured there"


def repeated_observations(record: Record) -> Found:
    """Spectra and channels that are those of a row elsewhere."""
    if record.task == "rssi" or not record.has_positions:
        return
    first = _first_equal([np.moveaxis(record.observation, 1, 0)])
    elsewhere = (record.tx_pos_m != record.tx_pos_m[first]).any(axis=1) & (_received_values(record) > 0)
    copied = np.flatnonzero(elsewhere)
    if len(copied) and len(np.unique(first)) > 1:
        what = f"{len(copied)} of {len(record)} rows have the observation of an earlier row at another position"
        yield "repeated-observations", f"{what}: {named_rows(copied)}; give what was measured there"


def constant_observations(record: Record) -> Found:
    """Receivers whose observations are all the same, and spectra of a single grey value."""
    if len(record) < 2:
        return
    for receiver, observed in zip(record.receivers, record.observation, strict=True):
        values = observed.reshape(len(record), -1)
        received = np.flatnonzero(np.isfinite(values).all(axis=1))
        if len(received) > 1 and (values[received] == values[received[0]]).all():
            what = "received the same in every row; give what was measured, or leave the receiver out"
            yield "constant", f"receiver {receiver.name}: {what}"
        elif record.task == "spectrum":
            # Spectra of zeros are reported as not heard.
            blank = np.flatnonzero((values.min(axis=1) == values.max(axis=1)) & values.any(axis=1))
            if len(blank):
                what = f"spectra of a single grey value in {named_rows(blank)}"
                yield "constant", f"receiver {receiver.name}: {what}; give what was measured, or remove the rows"


def single_position(record: Record) -> Found:
    """A single position of the transmitter."""
    if len(record) > 1 and record.has_positions and (record.tx_pos_m == record.tx_pos_m[0]).all():
        place = ", ".join(f"{value:g}" for value in record.tx_pos_m[0])
        yield "single-position", f"all {len(record)} transmitters are at ({place}); give the position of each row"


def _received_values(record: Record) -> IntArray:
    """Number of finite values of each row [n], over all receivers."""
    finite = np.isfinite(record.observation)
    return np.asarray(np.moveaxis(finite, 1, 0).reshape(len(record), -1).sum(axis=1), np.int64)


def _first_equal(parts: Sequence[NDArray[Any]]) -> IntArray:
    """Number of the first row that is equal in all parts [n, ...], for each row; NaN equals NaN."""
    rows: dict[str, int] = {}
    digests = (content_digest(*values) for values in zip(*parts, strict=True))
    return np.array([rows.setdefault(digest, row) for row, digest in enumerate(digests)], np.int64)
