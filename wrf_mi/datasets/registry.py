"""The data sets that are known by name, where they lie, and how any of them is read."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from importlib.resources import as_file, files
from pathlib import Path

import numpy as np
import pooch

from ..core import InputError, Record
from ..core.arrays import planar_array
from .layouts import is_data, layout_of
from .spectrum_folder import parse_folds

DATA_VARIABLE = "WRF_MI_DATA"
"""Environment variable: a folder that holds data sets as ``<name>/``; it takes the place of the user's cache."""


@dataclass(frozen=True)
class RemoteFile:
    """One file of a public original.

    Attributes:
        path: its place in our folder.
        sha256: hex; of the file, or of the arrays in it (`wrf_mi.datasets.newrf.arrays_sha256`).
        remote: its path below the base URL.
        converted: whether ours is made from the original's; then the hash is that of our arrays.
    """

    path: str
    sha256: str
    remote: str
    converted: bool = False


@dataclass(frozen=True)
class DataSet:
    """A data set that is known by name.

    Attributes:
        name: as in ``load(name)``.
        task: see `wrf_mi.core.Record`.
        licence: of the data.
        origin: who made it, where.
        base_url: where the public original's files are found; None where it is made on this machine.
        manifest: text file in this package with one line per file: SHA-256, file, remote path; None likewise. The
            SHA-256 of arrays in a converted file is marked ``arrays:``.
        folds: text file in this package with the spatial fold of each row, or None.
        file: the one file of the folder that holds the record, or None where it is the folder.
        shared_folder: name of a folder that may hold it beside others, in place of ``<name>/``.
        frequency_hz: of the carrier, where the files do not tell.
        array: rows, columns and spacing (m) of the planar array, where the files do not tell.
        note: what a user who fetches it has to know.
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
    array: tuple[int, int, float] | None = None
    note: str = ""


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
        # Only frequency times spacing can be told from the spectra; 915 MHz and 0.161 m fit as well.
        frequency_hz=920e6,
        array=(4, 4, 0.16),
    ),
    DataSet(
        name="flat-ble",
        task="rssi",
        licence="CC BY 4.0",
        origin="M. Kolakowski, Sensors 21, 6270 (2021), doi 10.5281/zenodo.5457591; "
        "GitHub marckolak/ble-rss-fingerprints-calib2021",
        base_url="https://raw.githubusercontent.com/marckolak/ble-rss-fingerprints-calib2021",
        manifest="flat-ble.txt",
        note="lidar/points.npz and lidar/gridmap.npz, which some copies of this data set hold, were derived from its "
        "scans by steps that are not published: they cannot be made again here. layout.csv has the walls.",
    ),
    *(
        DataSet(
            name=f"newrf-{room}",
            task="csi",
            licence="MIT",
            origin="channels computed by MATLAB's ray tracer (image method); H. Lu, GitHub LuHaofan/NeWRF",
            base_url="https://raw.githubusercontent.com/LuHaofan/NeWRF",
            manifest=f"newrf-{room}.txt",
            file=f"{room}.npz",
            shared_folder="newrf",
        )
        for room in ("conference", "office")
    ),
    DataSet(
        name="laboratory",
        task="spectrum",
        licence="MIT",
        origin="traced on this machine by Sionna RT in the scene of the same name (wrf_mi.synthetic.load_record)",
    ),
    DataSet(
        name="traced-room",
        task="spectrum",
        licence="MIT",
        origin="traced on this machine by Sionna RT in the laboratory with furniture (wrf_mi.synthetic.load_record)",
        note="room/ in it is the scene that a model may be given: bare walls, some centimetres off, of one material.",
    ),
    *(
        DataSet(
            name=f"traced-csi-{place}",
            task="csi",
            licence="MIT",
            origin=f"traced on this machine by Sionna RT in a made-up {place} (wrf_mi.synthetic.load_record)",
            note="uplink and downlink are noisy at 25 dB; scores are held against the downlink without noise. "
            "floor/ in it is the scene that a model may be given: bare walls, some centimetres off, of one material.",
        )
        for place in ("flat", "office")
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
    return [
        RemoteFile(path, sha256.removeprefix("arrays:"), remote, sha256.startswith("arrays:"))
        for sha256, path, remote in entries
    ]


def user_cache() -> Path:
    """The folder in the user's cache directory where data sets are kept."""
    return Path(pooch.os_cache("wrf-mi"))


def data_home() -> Path:
    """Where data sets are fetched to: the folder that ``WRF_MI_DATA`` names, or else the user's cache."""
    chosen = os.environ.get(DATA_VARIABLE)
    return Path(chosen).expanduser() if chosen else user_cache()


def locate(name: str, home: Path | None = None) -> Path | None:
    """The folder of a known data set: below ``home``, or else below ``WRF_MI_DATA``, then in the user's cache, or None.

    Raises:
        InputError: no data set of that name is known.
    """
    dataset = known(name)
    for place in (home,) if home else (data_home(), user_cache()):
        for folder in (place / name, place / (dataset.shared_folder or name)):
            if folder.is_dir() and (dataset.file is None or (folder / dataset.file).is_file()):
                return folder
    return None


def datasets() -> list[DataSetStatus]:
    """Every known data set with the folder where it lies, or None where it is not on this machine yet."""
    return [DataSetStatus(dataset, locate(dataset.name)) for dataset in KNOWN]


def load(name_or_folder: str | Path) -> Record:
    """Read a data set: a folder, a room's ``.npz`` file, a capture in HDF5, or a known one by its name.

    A path to a folder is taken first, then ``<name>/`` below ``WRF_MI_DATA``, then in the user's cache. Its files tell
    the layout (`wrf_mi.datasets.layouts`).

    Raises:
        InputError: not there (the line says how to get it), or what the reader finds wrong.
    """
    path = Path(name_or_folder)
    if is_data(path):
        return _read(path)
    if isinstance(name_or_folder, Path) or path.name != name_or_folder:
        raise InputError(f"{name_or_folder}: no such folder; give a folder or a known data set's name")
    dataset = known(name_or_folder)
    folder = locate(dataset.name)
    if folder is None:
        how = f"run `wrf-mi data fetch {dataset.name}`, or set {DATA_VARIABLE} to a folder that holds {dataset.name}/"
        if dataset.manifest is None:
            how = f"wrf_mi.synthetic.load_record({dataset.name!r}) traces it"
        raise InputError(f"data set {dataset.name}: not on this machine; {how}")
    return _complete(dataset, _read(folder / (dataset.file or ""), dataset.name))


def stated_task(name_or_folder: str | Path) -> str | None:
    """The task of a data set, told without reading it: by its layout, or of known ones by name; None: not known."""
    path = Path(name_or_folder)
    if path.exists():
        return layout_of(path).task
    return next((dataset.task for dataset in KNOWN if dataset.name == str(name_or_folder)), None)


def _read(path: Path, name: str | None = None) -> Record:
    return layout_of(path).read(path, name)


def _complete(dataset: DataSet, record: Record) -> Record:
    """Add what is known of a data set and not in its files."""
    if record.folds is None and dataset.folds is not None:
        with as_file(files(__package__) / "data" / dataset.folds) as path:
            record = replace(record, folds=parse_folds(path, len(record)))
    if record.frequencies_hz is None and dataset.frequency_hz is not None:
        record = replace(record, frequencies_hz=np.array([dataset.frequency_hz]))
    if dataset.array is not None:
        array_m = planar_array(*dataset.array)
        own = (one if one.array_m is not None else replace(one, array_m=array_m) for one in record.receivers)
        record = replace(record, receivers=tuple(own))
    return record
