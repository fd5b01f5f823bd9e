"""Measured buildings: the hybrid beside simple models, and devices that a handful of their own readings calibrates.

Sets are public measurements in which nothing was tuned on test rows; each is a fit of the hybrid without a plan, with
the set's plan where it has one, and of four simple models to the training rows, scored on the test rows, which lie on
other paths or walks. No model can be better than the noise of single readings: the median difference of two readings of
a receiver within a metre, over the square root of two, stands beside.
"""

import tempfile
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

import wrf_mi
from wrf_mi.core import InputError, Record
from wrf_mi.core.angles import FloatArray
from wrf_mi.datasets import load
from wrf_mi.datasets.registry import data_home
from wrf_mi.runs.results import read_run
from wrf_mi.runs.run import Run
from wrf_mi.scene.make import make_scene
from wrf_mi.tasks.scores import REAL_90, block_bootstrap

from .bench import FLAT
from .comparison import data_folder, line, measured_on, say, stored_part
from .declared import lined

CAMPUS, FLOOR, MALL = "duke-cbrs", "wifi-office", "mall-f3"  # folders of measured data beside the known data sets
SETS = ((FLAT, 64), (FLAT, None), (CAMPUS, None), (FLOOR, None), (MALL, None))
"""Data sets and numbers of training rows; None: all."""
HEARD = 60  # least training rows of a receiver of the shopping centre
HYBRID, WITH_PLAN, SIMPLE = "hybrid", "hybrid with plan", ("kriging", "trees", "idw", "mri")
PLANS = {FLAT: ("layout.csv", 2.7), MALL: ("geojson_map.json", 4.0)}  # file of a set's plan, and height of its walls, m
NEAR_M, LEAST_PAIRS = 1.0, 20  # distance of two readings whose difference is noise, and fewest pairs that tell it
OWN = (0, 1, 3, 10, 30)  # numbers of a device's own readings
ADDED_DB = 0.0, 10.0  # offsets of phones: those of the walks, and of another make
SEED = 0


def source_folder(name: str) -> Path:
    """Folder of the data of a set; `InputError` where they are not on this machine."""
    if name == FLAT:
        return data_folder(name)
    if not (data_home() / name).exists():
        raise InputError(f"{name}: not on this machine; give a folder of measured data by WRF_MI_DATA")
    return data_home() / name


def measured_set(folder: Path, name: str) -> Record:
    """A set by name, imported into a folder where needed; `InputError` where its data are not on this machine."""
    place = source_folder(name)
    files = {FLOOR: ("database_office_train.csv", "database_office_test.csv"), MALL: ("train.csv", "test.csv")}
    if name in files and not (folder / name).exists():
        train, test = ([str(place / file)] for file in files[name])
        options: Any = {"pitch_m": 0.6} if name == FLOOR else {"min_heard": HEARD}
        wrf_mi.import_measurements(train, folder / name, test=test, **options)
    return load(name if name == FLAT else folder / name if name in files else place)


def noise_db(record: Record) -> float:
    """Median absolute error that single readings leave of any model, dB."""
    differences = list[FloatArray]()
    for received in np.asarray(record.observation, float):
        rows = np.flatnonzero(np.isfinite(received))
        pairs = rows[cKDTree(record.tx_pos_m[rows]).query_pairs(NEAR_M, output_type="ndarray")]
        # Of one position, rows may be repeated.
        a, b = pairs[(record.tx_pos_m[pairs[:, 0]] != record.tx_pos_m[pairs[:, 1]]).any(axis=1)].T
        differences.append(received[a] - received[b])
    every = np.abs(np.concatenate(differences))
    return float(np.median(every) / np.sqrt(2)) if len(every) >= LEAST_PAIRS else np.nan


def measured(folder: Path, name: str, count: int | None) -> dict[str, Any]:
    """``rows``: the scores of each model on a set, with the paired gain of the hybrid over it."""
    record, errors, rows = measured_set(folder, name), dict[str, FloatArray](), list[dict[str, Any]]()
    noise = noise_db(record)
    for model in (HYBRID, *[WITH_PLAN] * (name in PLANS), *SIMPLE):
        scene = None
        if model == WITH_PLAN:
            file, height_m = PLANS[name]
            scene = make_scene(
                source_folder(name) / file, folder / f"{name}-plan", height_m=height_m, replace=True
            ).folder
        out = folder / f"{name}-{count or 'all'}-{model}"
        how: dict[str, Any] = {"split": "official", "n_train": count, "seed": SEED, "out": out}
        run = wrf_mi.train(record, model.partition(" ")[0], scene, preset="fast" if scene else None, **how)
        results = read_run(run.folder)
        error = np.abs(np.asarray(results.prediction, float) - results.truth)
        errors[model] = error
        received = np.isfinite(error)
        # Receivers of one row have errors in common, and so have the rows of one walk.
        block = np.arange(error.shape[1])
        if record.runs is not None and len(walks := np.unique(record.runs[results.row])) > 1:
            block = np.searchsorted(walks, record.runs[results.row])
        gain = block_bootstrap((error - errors[HYBRID])[received], np.broadcast_to(block, error.shape)[received])
        row: dict[str, Any] = {"set": name, "n_train": count, "model": model, "noise": noise}
        row |= {"median": float(np.median(error[received])), "mean": float(error[received].mean())}
        row |= {"inside": run.metrics.get("inside_90"), "seconds": run.metrics["train_seconds"]}
        rows.append(row | {"gain": gain.value, "low": gain.low, "high": gain.high})
        say("buildings", f"{name}: {model}: {row['median']:.2f} dB, mean {row['mean']:.2f} dB")
    return {"rows": rows}


def main() -> dict[str, Any]:
    """Measure the sets that are not stored; ``rows`` has a line for each set and model."""
    parts, rows = list[dict[str, Any]](), list[dict[str, Any]]()
    _ = [source_folder(name) for name, _ in SETS]  # before hours of work
    with tempfile.TemporaryDirectory() as place:
        for name, count in SETS:
            part = partial(measured, Path(place), name, count)
            parts.append(stored_part("buildings", f"{name}-{count or 'all'}", part))
            rows += parts[-1]["rows"]
    for row in rows:
        row["cell"] = f"{row['set']}, {row['n_train'] or 'all'} rows"
        inside = "" if row["inside"] is None else f"; {row['inside']:.0%} inside"
        row["scores"] = f"{row['median']:.2f}, {row['mean']:.2f}{inside}"
        row["over"] = "" if row["model"] == HYBRID else f"{row['gain']:+.2f} ({row['low']:+.2f} to {row['high']:+.2f})"
        row["bound"] = "" if np.isnan(row["noise"]) else f"{row['noise']:.2f}"
        row |= line(f"{row['cell']}: {row['model']}", row["scores"])
    return {"rows": rows, "measured": measured_on(parts)}


table = lined(
    "| data | model | median, mean absolute error (dB) | gain of the hybrid in the mean | noise (dB) | fit (s) |",
    "| {cell} | {model} | {scores} | {over} | {bound} | {seconds:.0f} |",
)


def devices() -> dict[str, Any]:
    """Walks of the shopping centre that are held out, by the number of their own readings that calibrate each."""
    source_folder(MALL)
    with tempfile.TemporaryDirectory() as place:
        part = stored_part("devices", "walks", partial(_of_walks, Path(place)))
    for row in part["rows"]:
        row["phone"] = f"{row['added']:.0f} dB louder" if row["added"] else "as measured"
        row |= line(f"{row['phone']}, {row['readings']} own readings", f"{row['mean']:.2f} dB")
    rows = part["rows"]
    return {"rows": rows, "measured": measured_on([part])}


def _of_walks(folder: Path) -> dict[str, Any]:
    record = measured_set(folder, MALL)
    run = wrf_mi.train(record, HYBRID, split="official", seed=SEED, out=folder / "run")
    every = [(added_db, count) for added_db in ADDED_DB for count in OWN]
    return {"rows": [{"added": add, "readings": count, **_calibrated(run, record, count, add)} for add, count in every]}


def _calibrated(run: Run, record: Record, count: int, added_db: float = 0.0) -> dict[str, Any]:
    """Scores of each walk's test rows behind its first `OWN` readings, of which ``count`` calibrate it.

    ``added_db`` is added to what was measured, as of another phone.
    """
    assert record.runs is not None
    assert record.official is not None
    receiver_names = [receiver.name for receiver in record.receivers]
    numbers = [receiver_names.index(receiver.name) for receiver in run.receivers]
    observed, test = np.asarray(record.observation[numbers], float) + added_db, record.official[1]
    error, inside, offset, std = list[FloatArray](), list[FloatArray](), list[float](), list[float]()
    for walk in np.unique(record.runs[test]):
        rows = test[record.runs[test] == walk]
        rows = rows[np.isfinite(observed[:, rows]).any(axis=0)]
        if len(rows) <= 2 * OWN[-1]:
            continue
        device_rows, scored = rows[:count], rows[OWN[-1] :]
        device = run.with_readings(record.tx_pos_m[device_rows], observed[:, device_rows]) if count else run
        predicted = device.predict(record.tx_pos_m[scored])
        left = observed[:, scored] - predicted.mean
        received = np.isfinite(left)
        error.append(np.abs(left[received]))
        inside.append((np.abs(left) <= REAL_90 * np.asarray(predicted.std))[received])
        offset.append(device.device.mean_db)
        std.append(device.device.std_db)
    of_walks = [float(values.mean()) for values in error]
    row: dict[str, Any] = {"walks": len(error), "mean": float(np.mean(of_walks)), "worst": max(of_walks)}
    row |= {"inside": float(np.concatenate(inside).mean()), "std_db": float(np.mean(std)), "offset_db": offset}
    return row


devices_table = lined(
    "| phone | own readings | mean absolute error (dB) | of the worst walk | inside 90 % intervals | deviation (dB) |",
    "| {phone} | {readings} | {mean:.2f} | {worst:.2f} | {inside:.0%} | {std_db:.1f} |",
)
