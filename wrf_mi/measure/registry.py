"""The data sets that are known by name, where they lie, and how any of them is read."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from importlib.resources import as_file, files
from pathlib import Path

import pooch

from ..core import InputError, Record
from .spectrum_folder import parse_folds, read_spectrum_folder

DATA_VARIABLE = "WRF_MI_DATA"
"""Environment variable: a folder that holds data sets as ``<name>/``; it takes the place of the user's cache."""


@dataclass(frozen=True)
class RemoteFile:
    """One file of a public original: its place in our folder, its SHA-256 (hex) and its path below the base URL."""

    path: str
    sha256: str
    remote: str


@dataclass(frozen=True)
class DataSet:
    """A data set that is known by name.

    Attributes:
        name: as in ``load(name)``.
        task: see `wrf_mi.core.Record`.
        licence: of the data.
        origin: who made it, where.
        base_url: where the public original's files are found; None where it is made on this machine.
        manifest: text file in this package with one line per file: SHA-256, file, remote path; None likewise.
        folds: text file in this package with the spatial fold of each row, or None.
    """

    name: str
    task: str
    licence: str
    origin: str
    base_url: str | None = None
    manifest: str | None = None
    folds: str | None = None


@dataclass(frozen=True)
class DataSetStatus:
    """A known data set and the folder where this machine has it, or None."""

    dataset: DataSet
    location: Path | None


KNOWN = (
    DataSet(
        name="rfid-lab",
        task="spectrum",
        licence="MIT",
        origin="data by the authors of NeRF2; GitHub wenchaozheng/WRF-GSplus, folder data_test200",
        base_url="https://raw.githubusercontent.com/wenchaozheng/WRF-GSplus",
        manifest="rfid-lab.txt",
        folds="rfid-lab-blocked_folds.txt",
    ),
    DataSet(
        name="laboratory",
        task="spectrum",
        licence="MIT",
        origin="traced on this machine by Sionna RT in the scene of the same name (wrf_mi.trace.load_record)",
    ),
)


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
    """The files of a data set's public original, from its manifest; empty where it is made on this machine."""
    if dataset.manifest is None:
        return []
    lines = (files(__package__) / "data" / dataset.manifest).read_text(encoding="utf-8").splitlines()
    entries = [line.split() for line in lines if line and not line.startswith("#")]
    return [RemoteFile(path, sha256, remote) for sha256, path, remote in entries]


def user_cache() -> Path:
    """The folder in the user's cache directory where data sets are kept."""
    return Path(pooch.os_cache("wrf-mi"))


def data_home() -> Path:
    """Where data sets are fetched to: the folder that ``WRF_MI_DATA`` names, or else the user's cache."""
    chosen = os.environ.get(DATA_VARIABLE)
    return Path(chosen).expanduser() if chosen else user_cache()


def locate(name: str) -> Path | None:
    """The folder of a data set by name: below ``WRF_MI_DATA``, else in the user's cache, else None."""
    for home in (data_home(), user_cache()):
        if (home / name).is_dir():
            return home / name
    return None


def datasets() -> list[DataSetStatus]:
    """Every known data set with the folder where it lies, or None where it is not on this machine yet."""
    return [DataSetStatus(dataset, locate(dataset.name)) for dataset in KNOWN]


def load(name_or_folder: str | Path) -> Record:
    """Read a data set: a folder, or a known one by its name.

    A path to a folder is taken first, then ``<name>/`` below ``WRF_MI_DATA``, then in the user's cache.

    Raises:
        InputError: not there (the line says how to get it), or what the reader finds wrong.
    """
    if Path(name_or_folder).is_dir():
        return read_spectrum_folder(name_or_folder)
    if isinstance(name_or_folder, Path) or Path(name_or_folder).name != name_or_folder:
        raise InputError(f"{name_or_folder}: no such folder; give a folder or a known data set's name")
    dataset = known(name_or_folder)
    folder = locate(dataset.name)
    if folder is None:
        how = f"run `wrf-mi data fetch {dataset.name}`, or set {DATA_VARIABLE} to a folder that holds {dataset.name}/"
        if dataset.manifest is None:
            how = f"wrf_mi.trace.load_record({dataset.name!r}) traces it in under a minute"
        raise InputError(f"data set {dataset.name}: not on this machine; {how}")
    record = read_spectrum_folder(folder, dataset.name)
    if record.folds is None and dataset.folds is not None:
        with as_file(files(__package__) / "data" / dataset.folds) as path:
            record = replace(record, folds=parse_folds(path, len(record)))
    return record
