"""What every run is held against: predictions that need no model."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import InputError, Record
from ..core.carriers import by_carrier
from ..core.types import IntArray
from ..models.interpolation.idw import InverseDistance
from ..tasks import TASKS, UPLINK, Task
from .results import Observations


def reference_predictions(record: Record, known: IntArray, rows: IntArray) -> dict[str, Observations]:
    """The references that the data allow, see `wrf_mi.tasks.Task.references`.

    The blend needs positions, of training and of scored rows; the copy needs an uplink.

    Args:
        record: of any task.
        known: training rows.
        rows: those to predict, [m].

    Returns:
        By key, [n_rx, m, ...] in the observations' type.

    Raises:
        InputError: data that allow none, or a receiver that received no training row.
    """
    task, kind = TASKS[record.task], record.observation.dtype
    found: dict[str, Any] = {}
    if record.uplink is not None and task.from_uplink:
        found[UPLINK] = np.stack([copied_uplink(record, rows)] * len(record.receivers)).astype(kind)
    if np.isfinite(record.tx_pos_m[np.concatenate([known, rows])]).all():
        found[task.reference] = _blend(task, record, known, rows).astype(kind)
    if not found:
        lacking = "positions" + (" and uplink" if task.from_uplink else "")
        raise InputError(f"{record.name}: {lacking} are not known, so there is nothing to hold a run against; add them")
    return found


def copied_uplink(record: Record, rows: IntArray) -> NDArray[np.complex64]:
    """The uplink of some rows in the shape of one receiver's downlink, [m, subcarriers] or [m, antennas, subcarriers].

    Where the two have different numbers of subcarriers, each takes the uplink's that is as far along its band.

    Raises:
        InputError: no uplink, or one of another number of antennas.
    """
    if record.uplink is None:
        raise InputError(f"{record.name}: no uplink to copy")
    uplink, shape = record.uplink[rows], record.observation.shape[2:]
    antennas = shape[0] if len(shape) == 2 else 1
    if uplink.shape[1] != antennas:
        raise InputError(
            f"{record.name}: uplink of {uplink.shape[1]} antennas, downlink of {antennas}; give both for the same ones"
        )
    nearest = np.round(np.linspace(0, uplink.shape[2] - 1, shape[-1])).astype(int)
    return uplink[:, :, nearest].reshape(len(rows), *shape)


def _blend(task: Task, record: Record, known: IntArray, rows: IntArray) -> Observations:
    carriers = record.carriers_hz
    if carriers is not None:  # neighbours are rows of the same carrier

        def of_carrier(carrier_hz: float, which: IntArray) -> Observations:
            own = record.at_carrier(carrier_hz)
            return _blend(task, own, known[carriers[known] == carrier_hz], rows[which])

        return by_carrier(carriers[rows], of_carrier, axis=1)
    blends = []
    for receiver, observed in zip(record.receivers, record.observation, strict=True):
        blend = InverseDistance(task.neighbours, softening_m=task.softening_m)
        try:
            blends.append(blend.fit(record.tx_pos_m[known], observed[known]).predict(record.tx_pos_m[rows]))
        except InputError as error:
            raise InputError(f"{record.name}, receiver {receiver.name}: {error}") from None
    return np.stack(blends)
