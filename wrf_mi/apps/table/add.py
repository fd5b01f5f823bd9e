"""Adding an entry to the table, and scoring stored predictions again."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace as replace_fields
from pathlib import Path
from typing import Any

import numpy as np

from ...core import InputError
from ...core.array_files import stored_arrays, write_arrays
from ...core.files import readable, write_atomically
from ...core.yaml_files import read_yaml
from ...runs.compare_page import command
from ...runs.folder import CONFIG, PREDICTIONS, RunConfig, is_finished, known_config, stored_versions
from ...runs.other_models import score_predictions
from ...runs.results import REMEDY, STD_MEAN, Results, read_run
from ...runs.sweep import dataset_files
from ...synthetic import load_record
from .entries import ALL_ROWS, entry_of, predictions_digest, read_entries, write_entry
from .sources import faults_of, read_sources, source_of

KEPT, MOST_BYTES = "predictions", 1_000_000
"""Folder of stored predictions in that of the entries, and largest file in it."""
PREDICTED = "row", "receiver_name", "prediction", "std", STD_MEAN  # arrays that are stored
SAME = 1e-5  # relative difference of scores below which they are equal: single precision


def add_entry(
    table: Path,
    predictions: str | Path,
    data: str | None,
    method: str | None,
    split: str = "official",
    n_train: int | float | None = None,
    seed: int = 0,
    replace: bool = False,
    **stated: Any,
) -> Path:
    """Score predictions of any program on the rows of a split, and write the entry.

    Args:
        table: folder of the entries.
        predictions: file or folder of predictions as of `wrf_mi.score_predictions`, or a finished run folder, which
            states data, split, number of training rows and seed itself.
        data: name or folder of the data set, which must be among those of the table.
        method: name of the method; None: the model of the run folder.
        split: split on whose test rows the predictions are scored.
        n_train: number or share of the training rows that the method had, as of `wrf_mi.train`.
        seed: seed of the split.
        replace: an entry of the same method, data, rows and seed may be replaced.
        **stated: further fields of `Entry`: label, origin, paper, licence, machine and the costs.

    Returns:
        Path of the entry. Whole predictions of up to a megabyte are stored beside it, so that others score them again.

    Raises:
        InputError: predictions that cannot be scored, a data set that the table lacks, or an entry that exists.
    """
    with tempfile.TemporaryDirectory() as place:
        folder = Path(predictions)
        if (folder / CONFIG).exists():
            run, known = _of_run(folder)
            source, _ = source_of(table, data or run.dataset)
            stated = known | stated
            method = method or str(run.metrics["model"])
        else:
            if data is None or method is None:
                raise InputError(f"{predictions}: predictions of another program need --dataset and --method")
            folder, (source, record) = Path(place) / "run", source_of(table, data)
            score_predictions(record, predictions, folder, method, split, n_train, seed)
            run = read_run(folder)
            stated = {"split": split, "share": ALL_ROWS if n_train is None else n_train, "seed": seed} | stated
        if (config := known_config(folder)) is not None:
            stated = {"command": command(config_in_table(config, source.name), Path("RUN"))} | stated
        digest = predictions_digest(run)
        facts = {"method": method, "label": method, "dataset": source.name, "date": time.strftime("%Y-%m-%d")} | stated
        entry = entry_of(run, digest, **facts)
        if (table / f"{entry.name}.json").exists() and not replace:
            raise InputError(f"{table / entry.name}.json: exists; give --replace, or another --method")
        # Without the measurements, whose licence may not allow to pass them on.
        with readable(folder / PREDICTIONS, f"{folder}: no {PREDICTIONS}; score the run by evaluate", REMEDY):
            arrays = stored_arrays(folder / PREDICTIONS, PREDICTED)
        kept = Path(place) / "kept.npz"
        write_arrays(kept, arrays, compressed=True)
        # Where a split holds receivers out, nothing is predicted at the others: no file of another program.
        if kept.stat().st_size <= MOST_BYTES and np.isfinite(arrays["prediction"]).all():
            (table / KEPT).mkdir(exist_ok=True)
            write_atomically(table / KEPT / f"{entry.name}.npz", kept.read_bytes())
        return write_entry(table, entry)


def _of_run(folder: Path) -> tuple[Results, dict[str, Any]]:
    """A finished run, and the fields of an entry that its folder states."""
    if not is_finished(folder):
        raise InputError(f"{folder}: not a finished run; finish it by train --resume")
    config = read_yaml(folder / CONFIG)
    share = ALL_ROWS if config.get("n_train") is None else config["n_train"]
    facts = {"split": config["split"], "share": share, "seed": config["seed"]}
    return read_run(folder), facts | {"versions": dict(stored_versions(folder))}


def config_in_table(config: RunConfig, dataset: str) -> RunConfig:
    """A run's configuration with the table's name of its data set, and its scene without the folders of a machine."""
    return replace_fields(config, dataset=dataset, scene=config.scene and Path(config.scene).name)


def faults(table: Path) -> Iterator[str]:
    """What is wrong with a table, in words: unknown data sets, changed splits, and predictions that score otherwise.

    Data sets that are not on this machine are passed over.
    """
    entries, sources = read_entries(table), read_sources(table)
    yield from (f"{e.name}: data set {e.dataset} has no file" for e in entries.values() if e.dataset not in sources)
    records: dict[str, Any] = {}
    for source in sources.values():
        try:
            if not dataset_files(source.name):  # it would be traced for minutes
                continue
            records[source.name] = load_record(source.name)
        except InputError:
            continue
        yield from faults_of(source, records[source.name])
    for name, entry in entries.items():
        file = table / KEPT / f"{name}.npz"
        if not file.exists() or entry.dataset not in records:
            continue
        with tempfile.TemporaryDirectory() as place:
            share = None if entry.share == ALL_ROWS and isinstance(entry.share, float) else entry.share
            where = records[entry.dataset], file, Path(place) / "run", f"{entry.method} again"
            score_predictions(*where, entry.split, share, entry.seed or 0)
            again = entry_of(run := read_run(Path(place) / "run"), method="", label="", dataset="", split="", date="")
            for key, value in entry.score.items():
                if not np.isclose(again.score[key], value, rtol=SAME, atol=SAME):
                    yield f"{name}: {key} {value}, its predictions score {again.score[key]}"
            if predictions_digest(run) != entry.predictions:
                yield f"{name}: {file} holds other predictions than its entry states"
