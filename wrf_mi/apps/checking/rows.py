"""Rows that hold no measurement: numbers for what was not heard, zeros, repeated rows, and values that never change."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core import InputError, Record, Split
from ...core.digest import content_digest
from ...core.files import listed
from ...core.types import IntArray
from ...datasets.observations import FEW_ROWS, LEAST_ROWS, fitted_receivers
from ...datasets.sentinels import suspicious_values
from ...tasks import task_of
from .units import NamedTexts, is_above_0_dbm

FEWEST_STRENGTHS = 4
"""Least number of receivers that received a repeated row: strengths in whole dB of fewer receivers repeat by chance
where a transmitter stands still."""
SHOWN = 6  # receivers with their rows that a text names
BESIDE_OTHERS = (
    "far more often than the strengths next to it: clipped at the sensitivity, or a number for 'not heard'",
    "where nothing was heard, leave the field empty; clipped strengths are learned as measured",
)
APART = (
    "apart from all other strengths: a number for 'not heard', which is learned as measured",
    "leave the field empty where nothing was heard (NaN in a wrf_mi.Record, -100 in NeRF2's layout)",
)
"""What a suspicious strength is, and the remedy."""


def not_heard(record: Record) -> NamedTexts:
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


def _strengths(record: Record) -> NamedTexts:
    observed = list(map(_in_dbm, record.observation))
    received = np.array(list(map(len, observed)))
    by_receiver = list(map(suspicious_values, observed))
    # A number that each receiver has once or twice shows in all of them together.
    pooled = [value for value in suspicious_values(np.concatenate(observed)) if not value.adjoins]
    suspects = {value.dbm: value for value in (*chain.from_iterable(by_receiver), *pooled)}
    for dbm, value in sorted(suspects.items()):
        counts = np.array([np.count_nonzero(values == dbm) for values in observed])
        what, remedy = APART
        if value.adjoins:  # other receivers may have measured it
            counts *= [any(each.dbm == dbm for each in values) for values in by_receiver]
            what, remedy = BESIDE_OTHERS
        yield "not-heard", f"{dbm:g} dBm, {what}: {_named_counts(record, counts, received)}; {remedy}"


def _in_dbm(observed: NDArray[Any]) -> NDArray[Any]:
    """Received strengths; none if they differ and are all positive: on a scale that `strength_scale` reports."""
    values = observed[np.isfinite(observed)].astype(float)
    return values[:0] if is_above_0_dbm(values) and np.ptp(values) else values


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


def few_rows(record: Record) -> NamedTexts:
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
        named = listed(f"{name} ({rows})" for name, rows in scarce.items())
        what = f"fewer than {least} training rows were received by {named}"
        fits = "predict these receivers from the others" if strengths else "leave these receivers out"
        yield "few-rows", f"{what}: fits {fits}; give more rows of theirs, or remove them"


def named_rows(rows: IntArray) -> str:
    """Rows, counted from 1, in words: the first and the number of the others."""
    return f"row{'s' if len(rows) > 1 else ''} {listed(str(row + 1) for row in rows)}"


def repeated_rows(record: Record) -> NamedTexts:
    """Rows with position, conditions and observation of an earlier row, and test rows among the training rows."""
    received = _received_values(record) >= (FEWEST_STRENGTHS if record.task == "rssi" else 1)
    per_receiver = (record.observation, record.n_readings, record.std)
    parts = [np.moveaxis(part, 1, 0) for part in per_receiver if part is not None]
    per_row = (record.tx_pos_m, record.tx_heading_rad, record.carriers_hz, record.uplink)
    first = _first_equal([*(part for part in per_row if part is not None), *parts])
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


def constant_observations(record: Record) -> NamedTexts:
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


def _received_values(record: Record) -> IntArray:
    """Number of finite values of each row [n], over all receivers."""
    finite = np.isfinite(record.observation)
    return np.asarray(np.moveaxis(finite, 1, 0).reshape(len(record), -1).sum(axis=1), np.int64)


def _first_equal(parts: Sequence[NDArray[Any]]) -> IntArray:
    """Number of the first row that is equal in all parts [n, ...], for each row; NaN equals NaN."""
    rows: dict[str, int] = {}
    digests = (content_digest(*values) for values in zip(*parts, strict=True))
    return np.array([rows.setdefault(digest, row) for row, digest in enumerate(digests)], np.int64)
