"""Simple predictions of the test rows that every run is compared with."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import InputError, Record, Split
from ..core.task import IDW, NEIGHBOURS
from ..estimators.few_rows import with_few_rows
from ..estimators.interpolation.idw import MODEL as INVERSE_DISTANCE
from ..estimators.interpolation.mri import MODEL as MRI
from ..estimators.model import default_settings, inputs_of
from ..models import Inputs, Problem, Session
from ..tasks import CARRIER, LAW, UPLINK
from .baselines import COUNT
from .results import Observations, reference_key


def reference_arrays(record: Record, split: Split) -> dict[str, Observations]:
    """References that the data allow (`wrf_mi.tasks.Task.references`), as [n_rx, m, ...] of the test rows.

    Keys are those of ``predictions.npz``; `COUNT` is the number of neighbours that held-out training rows chose.

    Inverse-distance weighting (IDW) needs positions of training and test rows; the copy of the uplink needs an uplink.
    At receivers without training rows, the path-loss law of the others' training rows takes their place. Where test
    rows have carriers without training rows, IDW interpolates between carriers, and a further reference is IDW at the
    nearest carrier with training rows.

    Raises:
        InputError: data that allow none, uplink and downlink of different numbers of antennas, or a receiver that
            received no training row.
    """
    task, kind, rows = record.task, record.observation.dtype, split.test
    predictions: dict[str, Any] = {}
    counts: dict[str, Any] = {}
    if record.uplink is not None and task.from_uplink:
        predictions[UPLINK] = np.stack([_copied_uplink(record, record.uplink[rows])] * len(record.receivers))
    if np.isfinite(record.tx_pos_m[np.concatenate([split.all_train, rows])]).all():
        interpolated, facts = _interpolated(record, split)
        predictions |= interpolated
        if NEIGHBOURS in facts:
            counts[COUNT] = np.full((len(record.receivers), len(rows)), facts[NEIGHBOURS])
    if not predictions:
        lacking = "positions" + (" and uplink" if task.from_uplink else "")
        raise InputError(f"{record.name}: {lacking} are not known, so no reference can be computed; add them")
    return counts | {reference_key(key): values.astype(kind) for key, values in predictions.items()}


def _interpolated(record: Record, split: Split) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """References [n_rx, m, ...] that are computed from the positions of training rows, and facts of their fit."""
    alone = split.held_receivers and not len(split.left)
    key, entry = (LAW, MRI) if alone else (IDW, INVERSE_DISTANCE)
    problem = Problem(record, default_settings(entry, (), {}), seed=split.seed).seen(split)
    fitted = with_few_rows(entry, record.task.name).fit(problem, split, Session(Path(), Path()))  # writes no file

    def of_all(inputs: Inputs) -> NDArray[Any]:
        return np.stack([fitted.predict(inputs, receiver).mean for receiver in range(len(record.receivers))])

    inputs = inputs_of(record, split.test)
    predictions = {key: of_all(inputs)}
    if record.carriers_hz is not None and inputs.carriers_hz is not None:
        trained_hz = np.unique(record.carriers_hz[split.all_train])
        nearest = trained_hz[np.abs(np.log(inputs.carriers_hz[:, None] / trained_hz)).argmin(axis=1)]
        if (nearest != inputs.carriers_hz).any():
            predictions[CARRIER] = of_all(replace(inputs, carriers_hz=nearest))
    return predictions, fitted.facts()


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
