"""Known data sets by name, their folders on this machine, and reading any data set."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

import numpy as np
import pooch
import yaml

from ..core import InputError, Record
from ..core.arrays import planar_array
from .layouts import is_data, layout_of
from .spectrum_folder import parse_folds
from .unknown import unknown_data

DATA_VARIABLE = "WRF_MI_DATA"
"""Environment variable: a folder of data sets ``<name>/``, in place of the user's cache."""


@dataclass(frozen=True)
class RemoteFile:
    """A file of a public original: path in the folder of the data set, SHA-256 (hex), and path below the base URL.

    The SHA-256 of a converted file is that of its arrays (`wrf_mi.datasets.newrf.arrays_sha256`).
    """

    path: str
    sha256: str
    remote: str
    converted: bool = False


@dataclass(frozen=True)
class DataSet:
    """A data set that is known by name.

    Attributes:
        name: name for ``load(name)``.
        task: task of the record (`wrf_mi.core.Record`).
        licence: licence of the data.
        origin: author and source.
        base_url: URL of the public original's files; None for data made on this machine.
        manifest: text file in this package with a line per file: SHA-256, file, remote path; None likewise. The SHA-256
            of arrays in a converted file is marked ``arrays:``.
        folds: text file in this package with the spatial fold of each row, or None.
        file: name of the file with the record, or None where the record is the folder.
        shared_folder: name of a folder that may hold the data set beside others, in place of ``<name>/``.
        frequency_hz: carrier, where the files do not state it.
        array: rows, columns and spacing (m) of the planar array, where the files do not state it.
        runs: runs of the measurement of the training and of the test rows, where the files do not state them.
        note: remark for users who fetch the data.
    """

    name: str
    task: str
    licence: str
    origin: str
    base_url: str | None = None
    manifest: str | None = None
    folds: str | None = None
    file: str | None = None
    shared_folder: str | None = None
    frequency_hz: float | None = None
    array: list[Any] | None = None
    runs: list[str] | None = None
    note: str = ""


@dataclass(frozen=True)
class DataSetStatus:
    """A known data set and its folder on this machine, or None."""

    dataset: DataSet
    location: Path | None


FOLDER = files(__package__) / "data"  # folder with the known data sets' descriptions, manifests and folds
KNOWN = tuple(DataSet(**entry) for entry in yaml.safe_load((FOLDER / "datasets.yml").read_text(encoding="utf-8")))


def known(name: str) -> DataSet:
    """The known data set of that name.

    Raises:
        InputError: there is none.
    """
    for dataset in KNOWN:
        if dataset.name == name:
            return dataset
    raise InputError(f"data set {name!r}: neither a folder nor known; known are {', '.join(d.name for d in KNOWN)}")


def remote_files(dataset: DataSet) -> list[RemoteFile]:
    """The files of a data set's public original from its manifest; empty for data made on this machine."""
    if dataset.manifest is None:
        return []
    lines = (FOLDER / dataset.manifest).read_text(encoding="utf-8").splitlines()
    entries = [line.split() for line in lines if line and not line.startswith("#")]
    return [
        RemoteFile(path, sha256.removeprefix("arrays:"), remote, sha256.startswith("arrays:"))
        for sha256, path, remote in entries
    ]


def user_cache() -> Path:
    """The folder in the user's cache directory where data sets are kept."""
    return Path(pooch.os_cache("wrf-mi"))


def data_home() -> Path:
    """Folder of fetched data sets: that of ``WRF_MI_DATA``, or else the user's cache."""
    chosen = os.environ.get(DATA_VARIABLE)
    return Path(chosen).expanduser() if chosen else user_cache()


def locate(name: str, home: Path | None = None) -> Path | None:
    """The folder of a known data set: below ``home``, or else below ``WRF_MI_DATA``, then in the user's cache, or None.

    Raises:
        InputError: unknown name.
    """
    dataset = known(name)
    for parent in (home,) if home else (data_home(), user_cache()):
        for folder in (parent / name, parent / (dataset.shared_folder or name)):
            if folder.is_dir() and (dataset.file is None or (folder / dataset.file).is_file()):
                return folder
    return None


def datasets() -> list[DataSetStatus]:
    """Every known data set with its folder on this machine, or None."""
    return [DataSetStatus(dataset, locate(dataset.name)) for dataset in KNOWN]


def load(name_or_folder: str | Path) -> Record:
    """Read a data set: a folder, a room's ``.npz`` file, a capture in HDF5, or a known data set by its name.

    A path is tried first, then ``<name>/`` below ``WRF_MI_DATA``, then in the user's cache. The layout follows from the
    files (`wrf_mi.datasets.layouts`).

    Raises:
        InputError: the data set is missing (the message says how to get it), or its reader finds an error.
    """
    path, dataset = find(name_or_folder)
    if dataset is None:
        return layout_of(path).read(path, None)
    record = _completed(layout_of(path).read(path, dataset.name), dataset)
    if dataset.array is not None:
        array_m = planar_array(*dataset.array)
        receivers = tuple(rx if rx.array_m is not None else replace(rx, array_m=array_m) for rx in record.receivers)
        record = replace(record, receivers=receivers)
    return record


def _completed(record: Record, dataset: DataSet) -> Record:
    """A record with the folds, carrier and runs that its files do not state."""
    if record.folds is None and dataset.folds is not None:
        with as_file(FOLDER / dataset.folds) as folds:
            record = replace(record, folds=parse_folds(folds, len(record)))
    if record.frequencies_hz is None and dataset.frequency_hz is not None:
        record = replace(record, frequencies_hz=np.array([dataset.frequency_hz]))
    if record.runs is None and dataset.runs is not None and record.official is not None:
        of_test = np.isin(np.arange(len(record)), record.official[1])
        record = replace(record, runs=np.array(dataset.runs)[of_test.astype(int)])
    return record


def find(name_or_folder: str | Path) -> tuple[Path, DataSet | None]:
    """The folder or file of a data set, and the known data set that a name means.

    Raises:
        InputError: it is missing; the message says how to get it.
    """
    path = Path(name_or_folder)
    if is_data(path):
        return path, None
    if path.is_file():
        raise unknown_data(path)
    if isinstance(name_or_folder, Path) or path.name != name_or_folder:
        raise InputError(f"{name_or_folder}: no such folder; give a folder or a known data set's name")
    dataset = known(name_or_folder)
    folder = locate(dataset.name)
    if folder is None:
        how = f"run `wrf-mi data fetch {dataset.name}`, or set {DATA_VARIABLE} to a folder that holds {dataset.name}/"
        if dataset.manifest is None:
            how = f"wrf_mi.synthetic.load_record({dataset.name!r}) traces it"
        raise InputError(f"data set {dataset.name}: not on this machine; {how}")
    return folder / (dataset.file or ""), dataset
