"""Predictions of a run at new positions, written to a file chunk by chunk."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import Prediction
from ..core.angles import FloatArray
from ..models import Inputs
from ..parallel import PartsProgress, Scheduler, row_parts
from .prediction_file import check_prediction_file, spooled, write_prediction_file
from .results import RECEPTION, STD_MEAN
from .run import MOST_PER_CHUNK, PREDICTED_PER_CHUNK, Run, known_inputs, open_run

Collect = Callable[[slice, int, Prediction], None]
"""Takes the predictions of some rows at the receiver of an index."""


def predict_to_file(
    folder: str | Path,
    tx_pos_m: np.ndarray,
    out: str | Path,
    tx_heading_rad: np.ndarray | None = None,
    scheduler: Scheduler | None = None,
    operator: bool = True,
    uplink: NDArray[Any] | None = None,
    carriers_hz: FloatArray | None = None,
    progress: bool = False,
) -> dict[str, tuple[int, ...]]:
    """Predict at new transmitter positions and write an ``.npz`` or ``.csv`` file.

    Memory is needed for a chunk of the positions at a time; a temporary file beside ``out`` holds the others.

    Args:
        folder: run folder with one fitted model.
        tx_pos_m: positions [m, 3], metres; NaN where unknown.
        out: file to write. ``.npz``: keys ``row`` (0..m-1), ``prediction`` ([m, H, W] for one receiver, else
            [n_rx, m, H, W]), ``tx_pos`` [m, 3] and ``receiver_name``, as in ``predictions.npz``, and ``std`` of models
            that state it. ``.csv``: signal strengths (`wrf_mi.runs.prediction_file.write_prediction_file`).
        tx_heading_rad: as that of `Run.predict`, as are the next two.
        scheduler: computes chunks of the positions; None: this process. Its workers must see the run folder, data set
            and scene under the same names.
        operator: learned fields predict by operator where they can.
        uplink: uplink channels.
        carriers_hz: carriers, stored as ``frequency_hz``.
        progress: show progress on standard error.

    Returns:
        Shape of each array that ``.npz`` has.

    Raises:
        InputError: a run over several blocks, inputs that the model does not predict from, or a file name with another
            suffix or of a format that cannot hold the predictions.
    """
    inputs = known_inputs(tx_pos_m, tx_heading_rad, uplink, carriers_hz)
    return write_run_predictions(open_run(folder, operator=operator), inputs, Path(out), scheduler, progress)


def write_run_predictions(
    run: Run, inputs: Inputs, out: Path, scheduler: Scheduler | None = None, progress: bool = False
) -> dict[str, tuple[int, ...]]:
    """Predict at all receivers of a run and write a file; arguments and errors of `predict_to_file`."""
    check_prediction_file(out, run.folder)
    run.check_inputs(inputs)
    shape, arrays = (len(run.receivers), len(inputs)), dict[str, NDArray[Any]]()

    def collect(rows: slice, receiver: int, chunk: Prediction) -> None:
        named_arrays = ("prediction", chunk.mean), ("std", chunk.std), (STD_MEAN, chunk.std_mean)
        for name, values in (*named_arrays, (RECEPTION, chunk.reception)):
            if values is not None:
                values = values if name == "prediction" else values.astype(np.float32)
                if name not in arrays:
                    arrays[name] = spooled(out.parent, (*shape, *values.shape[1:]), values.dtype)
                arrays[name][receiver, rows] = values

    if scheduler is None or not len(inputs):
        _collect(run, inputs, collect, progress)
    else:
        _collect_parts(run, inputs, collect, scheduler)
    written = write_prediction_file(out, inputs, [receiver.name for receiver in run.receivers], arrays)
    return {key: value.shape for key, value in written.items()}


def _collect(run: Run, inputs: Inputs, collect: Collect, progress: bool) -> None:
    total = len(run.receivers) * len(inputs)
    shown = PartsProgress("predicting", total, lines=total > MOST_PER_CHUNK) if progress else nullcontext()
    with shown as bar:
        for receiver in range(len(run.receivers)):
            for rows, chunk in run.predicted_parts(inputs, receiver):
                collect(rows, receiver, chunk)
                if bar is not None:
                    bar.add(rows.stop - rows.start, 1)


def _collect_parts(run: Run, inputs: Inputs, collect: Collect, scheduler: Scheduler) -> None:
    parts = row_parts(len(inputs), scheduler.workers, most=PREDICTED_PER_CHUNK)

    def each(part: int, predictions: list[Prediction]) -> None:
        for receiver, prediction in enumerate(predictions):
            collect(parts[part], receiver, prediction)
        predictions.clear()  # the scheduler keeps results to the end

    opener = partial(open_run, run.folder, operator=run.operator, scene=run.scene, own=run.own)
    sizes = [p.stop - p.start for p in parts]
    chosen = [inputs.rows(rows) for rows in parts]
    scheduler.map(_predict_part, chosen, opener, what="predicting", sizes=sizes, each=each, lines=True)


def _predict_part(run: Run, inputs: Inputs) -> list[Prediction]:
    return [run.predict_inputs(inputs, index) for index in range(len(run.receivers))]
