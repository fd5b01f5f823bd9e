"""What every baseline is spared: data that it does not serve or that nothing can be learned from."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from ..core import InputError, Record, Split
from ..core.types import IntArray
from .method import Inputs, Method

ROWS_AT_ONCE = 256
"""Rows that are looked at together: a record of spectra is not to be copied for it."""


def check_record(method: Method, record: Record, others: Iterable[Method] = ()) -> None:
    """Refuse a record that a method does not serve, or whose parts do not fit together.

    Args:
        method: that is to be fitted.
        record: to this.
        others: methods to be named where it does not serve.

    Raises:
        InputError: another task; no uplink for a method that needs one; numbers of rows, antennas, subcarriers and
            frequencies that differ.
    """
    if record.task not in method.tasks:
        served = " and ".join(method.tasks)
        able = [other.name for other in others if record.task in other.tasks]
        named = f": {', '.join(able)}" if able else ""
        text = f"holds {record.task}; {method.name} serves {served}, so choose another model{named}"
        raise InputError(f"{_place(record)}: {text}")
    if method.needs_uplink and record.uplink is None:
        raise InputError(
            f"{_place(record)}: has no uplink channels, from which {method.name} predicts; choose data with an uplink"
        )
    if record.task != "csi":
        return
    shape = record.observation.shape
    if len(shape) not in (3, 4):
        text = "expected [receivers, rows, subcarriers] or [receivers, rows, antennas, subcarriers]"
        raise InputError(f"{_place(record)}: channel coefficients {list(shape)}; {text}")
    frequencies = record.frequencies_hz
    if frequencies is not None and len(frequencies) not in (1, shape[-1]):
        _differ(record, "", shape[-1], len(frequencies))
    if record.uplink is None:
        return
    antennas = shape[2] if len(shape) == 4 else 1
    if record.uplink.ndim != 3 or record.uplink.shape[:2] != (shape[1], antennas):
        raise InputError(
            f"{_place(record)}: uplink {list(record.uplink.shape)} beside a downlink of {shape[1]} rows and {antennas} "
            "antennas; give both for the same ones"
        )
    if record.uplink_hz is not None and len(record.uplink_hz) != record.uplink.shape[2]:
        _differ(record, "uplink ", record.uplink.shape[2], len(record.uplink_hz))


def _differ(record: Record, what: str, subcarriers: int, frequencies: int) -> None:
    text = f"{subcarriers} {what}subcarriers and {frequencies} frequencies; give one for each"
    raise InputError(f"{_place(record)}: {text}")


def _place(record: Record) -> str:
    """Where a record was read from; its name where it was not read."""
    return record.source or record.name


def check_rows(record: Record, split: Split) -> None:
    """Refuse rows that cannot be learned from or held against.

    Raises:
        InputError: a receiver without any training row; an observation that is there in part only; coefficients of the
            uplink that are not finite, or all zero.
    """
    used = np.concatenate([split.all_train, split.test])
    states = [_received(observed, used) for observed in record.observation]
    for receiver, (received, _) in zip(record.receivers, states, strict=True):
        if not received[: len(split.all_train)].any():
            raise InputError(
                f"{_place(record)}, receiver {receiver.name}: received none of {len(split.all_train)} training rows; "
                "leave it out or use another split"
            )
    for receiver, observed, (_, broken) in zip(record.receivers, record.observation, states, strict=True):
        if broken.any():
            row = used[np.argmax(broken)]
            where = f"{_place(record)}, receiver {receiver.name}, row {row}"
            raise InputError(f"{where}: {_count(observed[row])}; correct or remove the row")
    if record.uplink is not None:
        uplink = record.uplink[used].reshape(len(used), -1)
        bad = np.flatnonzero(~np.isfinite(uplink).all(axis=1))
        if len(bad):
            text = f"{_place(record)}, row {used[bad[0]]}: uplink, {_count(uplink[bad[0]])}"
            raise InputError(f"{text}; correct or remove the row")
        silent = np.flatnonzero(~uplink.any(axis=1))
        if len(silent):
            text = f"{_place(record)}, row {used[silent[0]]}: uplink of zeros, where nothing was received"
            raise InputError(f"{text}; remove the row")


def _received(observed: NDArray[np.generic], used: IntArray) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Of a receiver's rows: whether anything of it was received, and whether it is neither whole nor missing."""
    received, broken = np.empty(len(used), bool), np.empty(len(used), bool)
    for start in range(0, len(used), ROWS_AT_ONCE):
        part = slice(start, start + ROWS_AT_ONCE)
        values = observed[used[part]].reshape(len(used[part]), -1)
        finite = np.isfinite(values)
        received[part] = finite.any(axis=1)
        # NaN throughout says that nothing was received; anything else that is no number is a mistake in the data.
        broken[part] = ~finite.all(axis=1) & ~np.isnan(values).all(axis=1)
    return received, broken


def check_inputs(inputs: Inputs, record: Record, method: Method) -> None:
    """Refuse inputs that a model fitted to a record cannot predict from.

    Raises:
        InputError: no uplink for a method that needs one, another number of antennas or subcarriers, or values that
            are not finite.
    """
    if record.uplink is None and inputs.uplink is not None:
        raise InputError(f"{method.name}: fitted to {record.name}, which has no uplink; leave uplink away")
    if inputs.uplink is None:
        if method.needs_uplink:
            form = "uplink [m, antennas, subcarriers], in the file of `predict --input`"
            raise InputError(f"{method.name}: predicts from the uplink; give {form}")
        return
    assert record.uplink is not None
    antennas, subcarriers = record.uplink.shape[1:]
    if inputs.uplink.shape != (len(inputs), antennas, subcarriers):
        raise InputError(
            f"{method.name}: uplink {list(inputs.uplink.shape)}; fitted to {antennas} antennas and {subcarriers} "
            f"subcarriers, so give [{len(inputs)}, {antennas}, {subcarriers}]"
        )
    bad = np.flatnonzero(~np.isfinite(inputs.uplink.reshape(len(inputs), -1)).all(axis=1))
    if len(bad):
        row = inputs.uplink[bad[0]].ravel()
        raise InputError(f"{method.name}: uplink, row {bad[0]}: {_count(row)}; correct or remove the row")


def _count(values: NDArray[np.generic]) -> str:
    return f"{np.count_nonzero(~np.isfinite(values))} of {values.size} values are not finite"
