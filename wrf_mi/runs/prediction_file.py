"""Files of predictions: inputs as ``.csv`` or ``.npz``, predictions as ``.npz`` or, of signal strengths, ``.csv``."""

from __future__ import annotations

import math
import os
import shutil
import sys
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import InputError
from ..core.array_files import stored_arrays
from ..core.carriers import FREQUENCY
from ..core.files import one_line, write_csv
from ..datasets.folder_files import read_csv
from ..estimators.model import Inputs
from ..tasks import TASKS
from .evaluate import stored_metrics, without_single_axis, write_predictions
from .folder import METRICS
from .results import RECEPTION, STD_MEAN

NPZ, CSV = ".npz", ".csv"
HEADING = "heading_rad"  # column or array of headings
POSITIONS, UPLINK = "tx_pos", "uplink"  # arrays of positions and of uplink channels
SPOOLED_BYTES = 1 << 26  # size from which predictions are collected on the disk


def read_inputs(csv_file: str | Path | None, npz_file: str | Path | None) -> Inputs:
    """Read what a model predicts from; positions are NaN where only an uplink is given.

    A CSV file has columns x, y, z in metres and optionally heading_rad and frequency_hz; in place of its name ``X,Y,Z``
    is one position. An ``.npz`` file has ``tx_pos`` [m, 3] and optionally ``heading_rad`` [m], ``frequency_hz`` [m], or
    ``uplink`` [m, antennas, subcarriers] and these.
    `InputError`: the file is missing, or a row is not made of finite numbers.
    """
    with suppress(ValueError):
        x, y, z = map(float, str(csv_file).split(","))
        if np.isfinite([x, y, z]).all():
            return Inputs(np.array([[x, y, z]]))
    path = Path(csv_file if csv_file is not None else npz_file or "")
    if not path.is_file():
        raise InputError(f"{path}: no such file; give positions x, y, z in metres")
    if csv_file is not None:
        table = read_csv(path, skip_blank=True)
        table = replace(table, header=[name.lower() for name in table.header])
        positions = np.stack([table.numbers(axis) for axis in "xyz"], axis=-1)
        heading, hz = (table.numbers(name) if name in table.header else None for name in (HEADING, FREQUENCY))
        inputs = Inputs(positions, heading, carriers_hz=hz)
    else:
        inputs = _from_npz(path)
    _check_finite(path, inputs)
    return inputs


def _check_uplink(path: Path, uplink: NDArray[Any], positions: int) -> None:
    if uplink.ndim != 3 or uplink.dtype.kind != "c":
        text = f"uplink has shape {list(uplink.shape)} of {uplink.dtype}"
        raise InputError(f"{path}: {text}; store complex numbers [m, antennas, subcarriers]")
    if len(uplink) != positions:
        raise InputError(f"{path}: {len(uplink)} rows of uplink and {positions} positions; give one each")
    bad = np.flatnonzero(~np.isfinite(uplink).all(axis=(1, 2)))
    if len(bad):
        raise InputError(f"{path}, row {bad[0] + 1}: uplink is not finite; correct or remove the row")


def _check_finite(path: Path, inputs: Inputs) -> None:
    positions = inputs.tx_pos_m
    if inputs.uplink is not None:
        _check_uplink(path, inputs.uplink, len(positions))
        if np.isnan(positions).all() and len(positions):
            return
    bad = np.flatnonzero(~np.isfinite(positions).all(axis=1))
    if len(bad):
        raise InputError(f"{path}, row {bad[0] + 1}: not a finite number; give x, y, z in metres")
    if len(positions) == 0:
        raise InputError(f"{path}: no positions; give one row x, y, z in metres for each")


def _from_npz(path: Path) -> Inputs:
    try:
        arrays = stored_arrays(path, (POSITIONS, HEADING, FREQUENCY, UPLINK))
        uplink = arrays.get(UPLINK)
        if uplink is not None:
            arrays.setdefault(POSITIONS, np.full((len(uplink), 3), np.nan))
        numbers = {name: np.asarray(arrays[name], float) for name in (POSITIONS, HEADING, FREQUENCY) if name in arrays}
    except InputError:
        raise
    except Exception as error:  # numpy and zipfile raise a dozen kinds on damaged files
        raise InputError(f"{path}: not readable as .npz ({one_line(error)}); write it with numpy.savez") from None
    if POSITIONS not in numbers:
        raise InputError(f"{path}: no array tx_pos; store positions [m, 3] under that name")
    positions = numbers[POSITIONS]
    if positions.ndim != 2 or positions.shape[1] != 3:
        raise InputError(f"{path}: tx_pos has shape {list(positions.shape)}, expected [m, 3]; store x, y, z in metres")
    return Inputs(positions, numbers.get(HEADING), uplink, carriers_hz=numbers.get(FREQUENCY))


def check_prediction_file(out: Path, run: Path) -> None:
    """Refuse by `InputError` a suffix but ``.npz`` and ``.csv``, and ``.csv`` for other than signal strengths."""
    suffix = out.suffix.lower()
    if suffix not in (NPZ, CSV):
        raise InputError(f"{out}: predictions are written as {NPZ}, or signal strengths as {CSV}; give such a name")
    if suffix == CSV:
        task = stored_metrics(run).get("task")
        if task is None:
            raise InputError(f"{run}: no {METRICS}, so no finished run; finish it with train --resume")
        if TASKS[task].axes:
            remedy = f"give {out.with_suffix(NPZ).name}"
            raise InputError(f"{out}: {CSV} holds signal strengths (rssi), but {run} predicts {task}; {remedy}")


def spooled(folder: Path, shape: tuple[int, ...], kind: np.dtype[Any]) -> NDArray[Any]:
    """Array to be filled, in memory while small, else in a temporary file, which has no name: nothing is left of it.

    The file lies in ``folder``, which is made if need be; `InputError` where the disk has no room for it.
    """
    needed = math.prod(shape) * kind.itemsize
    if needed <= SPOOLED_BYTES:
        return np.empty(shape, kind)
    folder.mkdir(parents=True, exist_ok=True)
    if needed > (free := shutil.disk_usage(folder).free):
        text = f"predictions take {needed / 2**30:.3g} GiB, and {free / 2**30:.3g} GiB of the disk are free"
        raise InputError(f"{folder}: {text}; predict fewer positions at a time, or choose another disk")
    with tempfile.TemporaryFile(dir=folder) as file:
        if sys.platform == "linux":
            os.posix_fallocate(file.fileno(), 0, needed)  # a disk that others fill later would end the process
        return np.memmap(file, kind, "w+", shape=shape)


def write_prediction_file(
    out: Path, inputs: Inputs, receivers: Sequence[str], observations: dict[str, NDArray[Any]]
) -> dict[str, Any]:
    """Write predictions, ``prediction`` and optionally others with a first axis of the receivers, by the suffix.

    ``.npz`` is as of `wrf_mi.runs.evaluate.write_predictions`. ``.csv`` has one row for each position with columns
    ``x``, ``y``, ``z`` in metres, ``heading_rad`` and ``frequency_hz`` if known, ``<receiver>_dbm`` for each receiver
    and, if stated, standard deviations ``<receiver>_std_db`` of a reading and ``<receiver>_std_mean_db`` of the mean,
    and probabilities of reception ``<receiver>_received``; empty where nothing is received.

    Returns:
        The arrays as an ``.npz`` file has them.
    """
    optional = ((HEADING, inputs.tx_heading_rad), (FREQUENCY, inputs.carriers_hz))
    input_columns = [(name, values) for name, values in optional if values is not None]
    arrays: dict[str, Any] = {"row": np.arange(len(inputs)), "tx_pos": inputs.tx_pos_m}
    arrays["receiver_name"] = np.asarray(receivers)
    if inputs.carriers_hz is not None:
        arrays[FREQUENCY] = inputs.carriers_hz
    if out.suffix.lower() == NPZ:
        return write_predictions(out, arrays | observations)
    # A list, as receivers may have equal names.
    columns: list[tuple[str, Any]] = [*zip("xyz", inputs.tx_pos_m.T, strict=True), *input_columns]
    deviations = ("std", "std_db"), (STD_MEAN, f"{STD_MEAN}_db")
    for key, suffix in (("prediction", "dbm"), *deviations, (RECEPTION, "received")):
        if key in observations:
            columns += [(f"{name}_{suffix}", v) for name, v in zip(receivers, observations[key], strict=True)]
    names, values = zip(*columns, strict=True)
    write_csv(out, names, zip(*values, strict=True))
    return without_single_axis(arrays | observations)
