"""Reference predictions that need no model, scored beside every run."""

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
    """References that the data allow (`wrf_mi.tasks.Task.references`), as [n_rx, m, ...] by key.

    Inverse-distance weighting (IDW) needs positions of training rows ``known`` and scored ``rows``; the copy of the
    uplink needs an uplink.

    Raises:
        InputError: data that allow none, uplink and downlink of different numbers of antennas, or a receiver that
            received no training row.
    """
    task, kind = TASKS[record.task], record.observation.dtype
    found: dict[str, Any] = {}
    if record.uplink is not None and task.from_uplink:
        found[UPLINK] = np.stack([_copied_uplink(record, record.uplink[rows])] * len(record.receivers)).astype(kind)
    if np.isfinite(record.tx_pos_m[np.concatenate([known, rows])]).all():
        found[task.reference] = _interpolate(task, record, known, rows).astype(kind)
    if not found:
        lacking = "positions" + (" and uplink" if task.from_uplink else "")
        raise InputError(f"{record.name}: {lacking} are not known, so there is nothing to hold a run against; add them")
    return found


def _copied_uplink(record: Record, uplink: NDArray[Any]) -> NDArray[Any]:
    """Uplink [m, antennas, subcarriers] in the shape of a downlink, [m, subcarriers] or [m, antennas, subcarriers].

    Where the numbers of subcarriers differ, each takes the uplink's at the nearest relative position in the band.
    """
    shape = record.observation.shape[2:]
    antennas = shape[0] if len(shape) == 2 else 1
    if uplink.shape[1] != antennas:
        raise InputError(
            f"{record.name}: uplink of {uplink.shape[1]} antennas, downlink of {antennas}; give both for the same ones"
        )
    nearest = np.round(np.linspace(0, uplink.shape[2] - 1, shape[-1])).astype(int)
    return uplink[:, :, nearest].reshape(len(uplink), *shape)


def _interpolate(task: Task, record: Record, known: IntArray, rows: IntArray) -> Observations:
    carriers = record.carriers_hz
    if carriers is not None:  # neighbours are rows of the same carrier

        def of_carrier(carrier_hz: float, which: IntArray) -> Observations:
            same = record.at_carrier(carrier_hz)
            return _interpolate(task, same, known[carriers[known] == carrier_hz], rows[which])

        return by_carrier(carriers[rows], of_carrier, axis=1)
    found = []
    for receiver, observed in zip(record.receivers, record.observation, strict=True):
        idw = InverseDistance(task.neighbours, softening_m=task.softening_m)
        try:
            found.append(idw.fit(record.tx_pos_m[known], observed[known]).predict(record.tx_pos_m[rows]))
        except InputError as error:
            raise InputError(f"{record.name}, receiver {receiver.name}: {error}") from None
    return np.stack(found)
