"""Predictions at new transmitter positions as a file: all of them as ``.npz``, signal strengths also as ``.csv``."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Any

import numpy as np

from ..core import InputError
from ..core.angles import FloatArray
from ..core.carriers import FREQUENCY
from ..core.files import write_atomically
from ..tasks import TASKS
from .evaluate import stored_metrics, write_predictions
from .folder import METRICS
from .tx_file import HEADING

NPZ, CSV = ".npz", ".csv"


def check_prediction_file(out: Path, run: Path) -> None:
    """Refuse a file that cannot hold what a run predicts, before anything is predicted.

    Args:
        out: file to write.
        run: folder of the run.

    Raises:
        InputError: a suffix other than ``.npz`` and ``.csv``, or ``.csv`` for a run that does not predict signal
            strengths.
    """
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


def write_prediction_file(out: Path, arrays: dict[str, Any], tx_heading_rad: FloatArray | None) -> dict[str, Any]:
    """Write predictions in the form that the suffix names.

    Args:
        out: ``.npz``: as `wrf_mi.runs.evaluate.write_predictions`. ``.csv``: one row for each position with columns
            ``x``, ``y``, ``z`` in metres, ``heading_rad`` where headings were given, ``frequency_hz`` where carriers
            were, ``<receiver>_dbm`` for each receiver and, where they are stated, standard deviations
            ``<receiver>_std_db``; a field is empty where nothing is received.
        arrays: ``row``, ``tx_pos``, ``receiver_name`` and perhaps ``frequency_hz``; ``prediction`` and perhaps
            ``std``, with a first axis of the receivers.
        tx_heading_rad: yaw of each transmitter, [m], or None.

    Returns:
        The arrays as an ``.npz`` file has them.
    """
    if out.suffix.lower() == NPZ:
        return write_predictions(out, arrays)
    names = [str(name) for name in arrays["receiver_name"]]
    header, columns = ["x", "y", "z"], list(np.asarray(arrays["tx_pos"], float).T)
    if tx_heading_rad is not None:
        header, columns = [*header, HEADING], [*columns, np.asarray(tx_heading_rad, float)]
    if FREQUENCY in arrays:
        header, columns = [*header, FREQUENCY], [*columns, arrays[FREQUENCY]]
    for key, suffix in (("prediction", "dbm"), ("std", "std_db")):
        if key in arrays:
            header, columns = [*header, *(f"{name}_{suffix}" for name in names)], [*columns, *arrays[key]]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    # str gives the shortest number that reads back as the same one.
    writer.writerows(["" if np.isnan(value) else str(value) for value in row] for row in zip(*columns, strict=True))
    write_atomically(out, text.getvalue())
    single = len(names) == 1
    return arrays | {key: arrays[key][0] for key in ("prediction", "std") if single and key in arrays}
