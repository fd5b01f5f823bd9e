"""What every baseline is spared: data that it does not serve, and inputs that it cannot predict from."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ..core import InputError, Record
from ..measure.observations import count_not_finite, place_of
from .method import Inputs, Method


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
        raise InputError(f"{place_of(record)}: {text}")
    if method.needs_uplink and record.uplink is None:
        raise InputError(
            f"{place_of(record)}: has no uplink channels, from which {method.name} predicts; choose data with an uplink"
        )
    if record.task != "csi":
        return
    shape = record.observation.shape
    if len(shape) not in (3, 4):
        text = "expected [receivers, rows, subcarriers] or [receivers, rows, antennas, subcarriers]"
        raise InputError(f"{place_of(record)}: channel coefficients {list(shape)}; {text}")
    frequencies = record.frequencies_hz
    if frequencies is not None and len(frequencies) not in (1, shape[-1]):
        _differ(record, "", shape[-1], len(frequencies))
    if record.uplink is None:
        return
    antennas = shape[2] if len(shape) == 4 else 1
    if record.uplink.ndim != 3 or record.uplink.shape[:2] != (shape[1], antennas):
        raise InputError(
            f"{place_of(record)}: uplink {list(record.uplink.shape)} beside a downlink of {shape[1]} rows and "
            f"{antennas} antennas; give both for the same ones"
        )
    if record.uplink_hz is not None and len(record.uplink_hz) != record.uplink.shape[2]:
        _differ(record, "uplink ", record.uplink.shape[2], len(record.uplink_hz))


def _differ(record: Record, what: str, subcarriers: int, frequencies: int) -> None:
    text = f"{subcarriers} {what}subcarriers and {frequencies} frequencies; give one for each"
    raise InputError(f"{place_of(record)}: {text}")


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
        raise InputError(f"{method.name}: uplink, row {bad[0]}: {count_not_finite(row)}; correct or remove the row")
