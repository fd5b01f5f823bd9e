"""Adding an entry to the table, and scoring stored predictions again."""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass
from dataclasses import replace as replace_fields
from pathlib import Path
from typing import Any

import numpy as np

from ...core import InputError, Record
from ...core.array_files import stored_arrays, write_arrays
from ...core.files import readable, write_atomically
from ...core.yaml_files import read_yaml
from ...datasets.registry import KNOWN
from ...runs.compare_page import command
from ...runs.folder import CONFIG, PREDICTIONS, RunConfig, is_finished, known_config, stored_versions
from ...runs.other_models import score_predictions
from ...runs.results import REMEDY, STD_MEAN, Results, read_run
from ...runs.sweep import dataset_files
from ...synthetic import load_record
from .entries import ALL, ALL_ROWS, Entry, entry_of, predictions_digest, read_entries, write_entry
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
            run, run_facts = _of_run(folder)
            source, _ = source_of(table, data or run.dataset)
            stated = run_facts | stated
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
        compressed_file = Path(place) / "kept.npz"
        write_arrays(compressed_file, arrays, compressed=True)
        # Where a split holds receivers out, nothing is predicted at the others: no file of another program.
        stored = _predictions(table, entry.name)
        if compressed_file.stat().st_size <= MOST_BYTES and np.isfinite(arrays["prediction"]).all():
            stored.parent.mkdir(exist_ok=True)
            write_atomically(stored, compressed_file.read_bytes())
        else:
            stored.unlink(missing_ok=True)  # of the entry that is replaced
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


@dataclass(frozen=True)
class Checked:
    """What a check of a table found."""

    entries: int  # number of entries
    scored: int  # number of entries whose stored predictions were scored again
    absent: list[str]  # data sets that are not on this machine, of which nothing was checked
    faults: list[str]  # unknown data sets, changed splits, and predictions that score otherwise, in words


def check_table(table: Path) -> Checked:
    """Check a table: entries, data sets and splits of this machine, and stored predictions."""
    entries, sources = read_entries(table), read_sources(table)
    faults = [
        f"{each.name}: data set {each.dataset} has no file" for each in entries.values() if each.dataset not in sources
    ]
    # Known data sets that are not here would be traced for minutes, and others have no name of their own.
    local_names = {data.name for data in KNOWN} | {name for name in sources if Path(name).exists()}
    records = {name: load_record(name) for name in sources if name in local_names and dataset_files(name)}
    for name, record in records.items():
        faults += faults_of(sources[name], record)
    stored = [
        name for name, entry in entries.items() if entry.dataset in records and _predictions(table, name).exists()
    ]
    for name in stored:
        faults += _scored_again(table, entries[name], records[entries[name].dataset])
    return Checked(len(entries), len(stored), sorted(sources.keys() - records.keys()), faults)


def _predictions(table: Path, name: str) -> Path:
    return table / KEPT / f"{name}.npz"


def _scored_again(table: Path, entry: Entry, record: Record) -> list[str]:
    """What differs between an entry and the scores of its stored predictions."""
    with tempfile.TemporaryDirectory() as place:
        share = None if entry.rows == ALL else entry.share
        where = record, _predictions(table, entry.name), Path(place) / "run", f"{entry.method} again"
        again = score_predictions(*where, entry.split, share, entry.seed or 0)
        scores = {key: again.metrics[entry.of.block][key] for key in entry.score}
        faults = [
            f"{entry.name}: {key} {value}, its predictions score {scores[key]}"
            for key, value in entry.score.items()
            if not np.isclose(scores[key], value, rtol=SAME, atol=SAME)
        ]
        if predictions_digest(read_run(again.folder)) != entry.predictions:
            faults.append(f"{entry.name}: other predictions are stored than its entry states")
        return faults
