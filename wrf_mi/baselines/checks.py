"""What every baseline is spared: data that it does not serve, and inputs that it cannot predict from."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ..core import InputError, Record
from ..measure.observations import count_not_finite, place_of
from ..tasks import task_of
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
    if not method.serves(record.task):
        served = " and ".join(method.tasks or ())
        able = [other.name for other in others if other.serves(record.task)]
        named = f": {', '.join(able)}" if able else ""
        text = f"holds {record.task}; {method.name} serves {served}, so choose another model{named}"
        raise InputError(f"{place_of(record)}: {text}")
    if method.needs_uplink and record.uplink is None:
        raise InputError(
            f"{place_of(record)}: has no uplink channels, from which {method.name} predicts; choose data with an uplink"
        )
    task_of(record).check(record)


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
