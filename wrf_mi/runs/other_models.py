"""Predictions of models outside this package as run folders, which `compare` takes beside its own runs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import AntennaOptions, InputError, Prediction, Record
from ..core.array_files import stored_arrays
from ..core.files import listed, readable
from ..core.types import IntArray
from ..datasets import make_splits
from ..datasets.folder_files import read_csv
from ..datasets.observations import place_of
from ..models import MODELS
from ..synthetic import load_record
from .evaluate import Scores, evaluate, pool, write_results
from .folder import RunConfig, check_new, new_run_folder, start_run
from .released_outputs import read_released
from .results import STD_MEAN
from .run import Run

REMEDY = "store row [m] and prediction [n_rx, m, ...] as predictions.npz of a run has them"
COSTS = ("train_seconds", "ms_per_sample", "peak_memory_mb")
"""Numbers that the file may state; NaN in ``metrics.json`` where it does not."""
SAME_PLACE_M = 1e-3  # distance within which a predicted position is that of a row


def score_predictions(
    data: str | Path | Record,
    predictions: str | Path,
    out: str | Path,
    name: str,
    split: str = "official",
    n_train: int | float | None = None,
    seed: int = 0,
    overwrite: bool = False,
) -> Run:
    """Score predictions that another program made, in a run folder that `wrf_mi.compare` takes like its own.

    Args:
        data: name or folder of a data set, or a loaded record.
        predictions: an ``.npz`` file with ``prediction`` [n_rx, m, ...], or [m, ...] of one receiver, as
            `wrf_mi.core.Record` has observations, and ``row`` [m], rows of the data set from 0, or ``tx_pos`` [m, 3],
            metres; optionally ``std`` of the same shape, ``receiver_name`` [n_rx], ``train_seconds``,
            ``ms_per_sample`` and ``peak_memory_mb``. Of signal strengths also a ``.csv`` with columns ``row``, or
            ``x``, ``y``, ``z``, and ``<receiver>_dbm`` and optionally ``<receiver>_std_db`` of each receiver. Also what
            the test scripts of NeRF2 and WRF-GS+ write: a folder of plots of spectra, ``result.txt`` or ``result.mat``
            (`wrf_mi.runs.released_outputs`). Rows beside the test rows are ignored.
        out: run folder to make; must not exist or be empty.
        name: name of the model, for tables and legends; none of this package's.
        split: split on whose test rows the predictions are scored; they must not have been trained on.
        n_train: number or fraction of the training rows that the model had, as of `wrf_mi.train`.
        seed: seed of the split.
        overwrite: ``out`` may be that of a run, which is replaced.

    Returns:
        The run, with its scores in ``metrics``; it cannot predict.

    Raises:
        InputError: a file that cannot be used, a test row without a prediction, or a name that is taken.

    >>> import tempfile, wrf_mi
    >>> run, folder = wrf_mi.train("laboratory", "idw", n_train=20), tempfile.mkdtemp()
    >>> score_predictions("laboratory", run.folder / "predictions.npz", folder, "theirs").metrics["model"]
    'theirs'
    """
    if name in MODELS:
        raise InputError(f"--name {name}: a model of wrf_mi; give the other model another name")
    record = data if isinstance(data, Record) else load_record(str(data))
    splits = make_splits(record, split, seed, n_train)
    path, folder = Path(predictions), Path(out)
    check_new(folder, overwrite)
    arrays = _read(path, record)
    place = _places(path, arrays, record, np.unique(np.concatenate([part.test for part in splits])))

    def predict(rows: IntArray, receiver: int) -> Prediction:
        at = place[rows]
        deviations = {name: arrays[name][receiver, at] for name in ("std", STD_MEAN) if name in arrays}
        return Prediction(arrays["prediction"][receiver, at], **deviations)

    scores: list[Scores] = [evaluate(record, part, predict) for part in splits]
    metrics, scored = scores[0] if len(scores) == 1 else pool(scores)
    costs = {key: float(arrays.get(key, np.nan)) for key in COSTS}
    source = str(data) if not isinstance(data, Record) else record.source or record.name
    config_defaults: tuple[Any, ...] = (None, None, AntennaOptions(), False, False, {})
    config = RunConfig(name, source, record.task.name, split, n_train, seed, *config_defaults)
    header = {"model": name, "dataset": source, "split": split, "seed": seed, "predictions": str(path)}
    with new_run_folder(folder, overwrite):
        start_run(folder, config, splits)
        write_results(folder, header | metrics | costs, scored)
    return Run(folder, record)


def _read(path: Path, record: Record) -> dict[str, NDArray[Any]]:
    if path.is_dir() or path.suffix.lower() in (".txt", ".mat"):
        return read_released(path, record)
    return _read_csv(path, record) if path.suffix.lower() == ".csv" else _read_npz(path, record)


def _read_npz(path: Path, record: Record) -> dict[str, NDArray[Any]]:
    """Arrays of an ``.npz`` file, with a first axis of the record's receivers."""
    with readable(path, f"{path}: no such file; give predictions as .npz or .csv", REMEDY):
        arrays = dict(stored_arrays(path))
    if "prediction" not in arrays:
        raise InputError(f"{path}: no array prediction; {REMEDY}")
    task, number = record.task, len(record.receivers)
    expected = record.observation.shape[2:]
    for key in {"prediction", "std", STD_MEAN} & arrays.keys():
        values = arrays[key]
        if number == 1 and values.shape[1:] == expected:
            values = values[None]
        if values.shape[0] != number or values.shape[2:] != expected:
            text = f"{key} has shape {list(arrays[key].shape)}; {record.name} needs {[number, 'm', *expected]}"
            raise InputError(f"{path}: {text}")
        if np.iscomplexobj(values) and not (task.is_complex and key == "prediction"):
            raise InputError(f"{path}: {key} is complex; {record.task} and deviations are real")
        arrays[key] = values
    if "receiver_name" in arrays:
        arrays |= _in_order(path, arrays, record)
    return arrays


def _in_order(path: Path, arrays: dict[str, NDArray[Any]], record: Record) -> dict[str, NDArray[Any]]:
    """Predictions in the order of the record's receivers."""
    names = [str(name) for name in arrays["receiver_name"]]
    asked = [receiver.name for receiver in record.receivers]
    if sorted(names) != sorted(asked):
        # Names that the other lacks come first: they would be cut off among hundreds.
        unknown, lacking = (sorted(of, key=others.__contains__) for of, others in ((names, asked), (asked, names)))
        raise InputError(f"{path}: receivers {listed(unknown)}; {record.name} has {listed(lacking)}")
    order = [names.index(receiver) for receiver in asked]
    return {key: arrays[key][order] for key in ("prediction", "std", STD_MEAN) if key in arrays}


def _read_csv(path: Path, record: Record) -> dict[str, NDArray[Any]]:
    """Arrays of a ``.csv`` file of signal strengths."""
    if record.task.axes:
        raise InputError(f"{path}: .csv holds signal strengths, {record.name} {record.task}; give .npz")
    table = read_csv(path, skip_blank=True)
    names = [receiver.name for receiver in record.receivers]
    wanted = [f"{name}_dbm" for name in names]
    if lacking := [column for column in wanted if column not in table.header]:
        raise InputError(f"{path}: no column {lacking[0]}; give one of each receiver of {place_of(record)}")
    arrays = {"prediction": np.stack([table.numbers(column) for column in wanted])}
    for key in ("std", STD_MEAN):
        deviations = [f"{name}_{key}_db" for name in names]
        if all(column in table.header for column in deviations):
            arrays[key] = np.stack([table.numbers(column) for column in deviations])
    if "row" in table.header:
        return arrays | {"row": table.numbers("row")}
    return arrays | {"tx_pos": np.stack([table.numbers(axis) for axis in "xyz"], axis=-1)}


def _places(path: Path, arrays: dict[str, NDArray[Any]], record: Record, test: IntArray) -> IntArray:
    """Place in the file of the prediction of each row of the record, -1 for rows that are not tested."""
    count, place = arrays["prediction"].shape[1], np.full(len(record), -1)
    if "row" in arrays:
        rows = np.asarray(arrays["row"], float)
        if rows.shape != (count,):
            raise InputError(f"{path}: {rows.size} rows and {count} predictions; give one each")
        wrong = np.flatnonzero((rows != np.round(rows)) | (rows < 0) | (rows >= len(record)))
        if len(wrong):
            text = f"row {rows[wrong[0]]:g} (entry {wrong[0] + 1}) is none of {record.name}, which has {len(record)}"
            raise InputError(f"{path}: {text}, counted from 0")
        place[rows.astype(np.int64)] = np.arange(count)
    elif arrays.get("tx_pos", np.zeros(0)).shape == (count, 3):
        place[test] = _nearest(path, np.asarray(arrays["tx_pos"], float), record.tx_pos_m[test], test)
    else:
        raise InputError(f"{path}: neither row [m] nor tx_pos [m, 3] of its {count} predictions; {REMEDY}")
    missing = test[place[test] < 0]
    if len(missing):
        text = f"{len(missing)} of the {len(test)} test rows have no prediction (first: row {missing[0]})"
        raise InputError(f"{path}: {text}; predict them all")
    values = arrays["prediction"][:, place[test]]
    # What was not received is not scored, and need not be predicted.
    needed = np.isfinite(record.scored[:, test])
    broken = np.flatnonzero((needed & ~np.isfinite(values)).reshape(*needed.shape[:2], -1).any(axis=(0, 2)))
    if len(broken):
        raise InputError(f"{path}: the prediction of row {test[broken[0]]} is not finite; correct it")
    return place


def _nearest(path: Path, given_m: NDArray[Any], asked_m: NDArray[Any], test: Sequence[int] | IntArray) -> IntArray:
    from scipy.spatial import cKDTree

    distance_m, nearest = cKDTree(given_m).query(asked_m)
    far = np.flatnonzero(distance_m > SAME_PLACE_M)
    if len(far):
        text = f"no prediction at the position of test row {test[far[0]]}, nearest {distance_m[far[0]]:.3g} m away"
        raise InputError(f"{path}: {text}; give row [m], or all test positions")
    if len(np.unique(nearest)) < len(nearest):
        raise InputError(f"{path}: several test rows have one position; give row [m]")
    return np.asarray(nearest, np.int64)
