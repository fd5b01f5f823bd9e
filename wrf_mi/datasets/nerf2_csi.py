"""The layout of NeRF2's channel coefficients: uplink and downlink of a base station with many antennas.

Source: NeRF2, Zhao et al., MobiCom 2023, https://github.com/XPengZhao/NeRF2, class ``CSI_dataset`` of its
``dataloader.py``. The authors' data have 8 antennas, and 26 and 26 subcarriers of the ArgosV2 traces. ``docs/data.md``
has the files, and what is ours and optional.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from ..core import InputError, Receiver, Record
from ..core.angles import FloatArray
from ..core.antenna import UPRIGHT
from ..core.files import atomic_folder, readable
from .folder_files import (
    AXES,
    POSITIONS,
    TX_ANTENNA_WORDS,
    antenna_entry,
    data_folder,
    fits_single,
    numbers_of,
    read_antenna,
    read_columns,
    read_official,
    read_yaml,
    refuse_unstated,
    shown,
    unit_quaternion,
    write_official,
    write_positions,
)

CHANNELS, STATION, TRUTH = "csidata.npy", "base-station.yml", "downlink_truth.npy"
FEWEST = 2
"""Least number of samples: one to train on and one to score."""


def read_nerf2_csi(path: str | Path, name: str | None = None, frequencies_hz: FloatArray | None = None) -> Record:
    """Read and check a folder in the layout of NeRF2's channel coefficients (see ``docs/data.md``).

    Args:
        path: path of the folder.
        name: name of the record; by default that of the folder.
        frequencies_hz: frequencies of all subcarriers, uplink and downlink, in Hz, in place of those of
            ``base-station.yml``.

    Returns:
        A record with ``task="csi"`` and one receiver at the middle of the antennas: ``observation``
        [1, n, antennas, subcarriers / 2] of the downlink, ``uplink`` [n, antennas, subcarriers / 2], positions NaN
        where there is no ``tx_pos.csv``.

    Raises:
        InputError: anything missing, unreadable or inconsistent; one line with the file and the sample.
    """
    folder = data_folder(path, f"{CHANNELS} and {STATION}")
    channel = _read_channels(folder / CHANNELS)
    n, antennas, subcarriers = channel.shape
    if n < FEWEST:
        raise InputError(f"{folder / CHANNELS}: {n} sample; give {FEWEST} at least, to train on and to score")
    if subcarriers % 2:
        text = f"{subcarriers} subcarriers do not halve into uplink and downlink"
        raise InputError(f"{folder / CHANNELS}: {text}; give as many of each")
    half = subcarriers // 2
    station = folder / STATION
    info = read_yaml(station)
    receiver = _read_station(station, info, antennas)
    stated = info.get("frequencies_hz") if frequencies_hz is None else frequencies_hz
    frequencies = None if stated is None else numbers_of(stated)
    if frequencies is not None:
        if frequencies.ndim != 1 or not len(frequencies) or not (fits_single(frequencies) and (frequencies > 0).all()):
            raise InputError(f"{station}: frequencies_hz is {shown(stated)}; give a list of frequencies in Hz")
        if len(frequencies) != subcarriers:
            text = f"{len(frequencies)} frequencies_hz, but {CHANNELS} has {subcarriers} subcarriers"
            raise InputError(f"{station}: {text}; give one for each, the uplink's first")
    positions = np.full((n, 3), np.nan)
    if (folder / POSITIONS).exists():
        positions = read_columns(folder / POSITIONS, AXES)
        if len(positions) != n:
            text = f"{len(positions)} rows, but {CHANNELS} has {n} samples"
            raise InputError(f"{folder / POSITIONS}: {text}; give one for each")
    truth = None
    if (folder / TRUTH).exists():
        truth = _read_channels(folder / TRUTH)[None]
        if truth.shape[1:] != (n, antennas, half):
            text = f"shape {list(truth.shape[1:])}, expected {[n, antennas, half]}"
            raise InputError(f"{folder / TRUTH}: {text}, as the downlink of {CHANNELS}; correct it")
    return Record(
        name=name or folder.resolve().name,
        task="csi",
        tx_pos_m=positions,
        receivers=(receiver,),
        observation=channel[None, :, :, half:],
        official=read_official(folder, n, first=0, source=CHANNELS),
        frequencies_hz=None if frequencies is None else frequencies[half:],
        uplink=channel[:, :, :half],
        uplink_hz=None if frequencies is None else frequencies[:half],
        truth=truth,
        tx_antenna=read_antenna(station, "tx_antenna", info.get("tx_antenna"), TX_ANTENNA_WORDS),
        source=str(folder),
    )


def write_nerf2_csi(
    path: str | Path, record: Record, replace: bool = False, extra: Mapping[str, str] | None = None
) -> Path:
    """Write a record atomically in the layout of NeRF2's channel coefficients.

    Args:
        path: path of the folder.
        record: record with ``task="csi"``, one receiver, antennas (``array_m``) and an uplink of as many subcarriers as
            the downlink.
        replace: replace an existing folder.
        extra: text of further files by their names.

    Raises:
        InputError: the folder exists or cannot be written, or the record does not fit the layout.
    """
    down, up, array_m = record.observation, record.uplink, record.receivers[0].array_m
    if down.ndim != 4 or len(down) != 1 or up is None or up.shape != down.shape[1:] or array_m is None:
        need = "one receiver with array_m, and an uplink of as many antennas and subcarriers as the downlink"
        raise InputError(f"{path}: {record.name} cannot be written as {CHANNELS}; it needs {need}")
    refuse_unstated(path, record, "folds", "tx_heading_rad", "n_readings", "std", "carriers_hz")
    receiver = record.receivers[0]
    info: dict[str, Any] = {
        "base_station": (receiver.position_m + array_m @ receiver.to_world.T).tolist(),
        "orientation": receiver.orientation_xyzw.tolist(),
    }
    if record.uplink_hz is not None and record.frequencies_hz is not None:
        info["frequencies_hz"] = [*record.uplink_hz.tolist(), *record.frequencies_hz.tolist()]
    antennas = {"antenna": antenna_entry(receiver.antenna), "tx_antenna": antenna_entry(record.tx_antenna)}
    info |= {key: value for key, value in antennas.items() if value}
    with atomic_folder(Path(path), replace) as part:
        np.save(part / CHANNELS, np.concatenate([up, down[0]], axis=-1).astype(np.complex64))
        text = yaml.safe_dump(info, sort_keys=False, default_flow_style=None)
        (part / STATION).write_text(text, encoding="utf-8")
        if np.isfinite(record.tx_pos_m).all():
            write_positions(part / POSITIONS, record.tx_pos_m)
        if record.truth is not None:
            np.save(part / TRUTH, record.truth[0].astype(np.complex64))
        write_official(part, record, first=0)
        for file, content in (extra or {}).items():
            (part / file).write_text(content, encoding="utf-8")
    return Path(path)


def _read_channels(path: Path) -> NDArray[np.complex64]:
    """Complex coefficients [n, antennas, subcarriers] of a ``.npy`` file, finite in single precision."""
    missing = f"{path}: missing; give a file that exists, or complete its folder"
    with readable(path, missing, "write it again with numpy.save"):
        values = np.load(path, allow_pickle=False)
    wanted = "give complex numbers [samples, antennas, subcarriers]"
    if not isinstance(values, np.ndarray) or values.ndim != 3 or 0 in values.shape:
        raise InputError(f"{path}: shape {list(getattr(values, 'shape', ()))}; {wanted}")
    if values.dtype.kind != "c":
        raise InputError(f"{path}: holds {values.dtype}; {wanted}")
    with np.errstate(over="ignore"):
        single = values.astype(np.complex64)
    bad = ~np.isfinite(single)
    if bad.any():
        sample, antenna, subcarrier = (int(k) for k in np.argwhere(bad)[0])
        where = f"sample {sample}, antenna {antenna}, subcarrier {subcarrier} (from 0)"
        value = values[sample, antenna, subcarrier]
        text = f"{value} is {'too large for single precision' if np.isfinite(value) else 'not finite'}"
        raise InputError(f"{path}: {where}: {text}; correct or remove the sample")
    return single


def _read_station(path: Path, info: dict[Any, Any], antennas: int) -> Receiver:
    places = info.get("base_station")
    elements = numbers_of(places)
    if elements.ndim != 2 or elements.shape[1] != 3 or not fits_single(elements):
        raise InputError(f"{path}: base_station is {shown(places)}; give x, y, z in metres of each antenna")
    if len(elements) != antennas:
        text = f"{len(elements)} positions in base_station, but {CHANNELS} has {antennas} antennas"
        raise InputError(f"{path}: {text}; give one for each")
    orientation = unit_quaternion(path, "base_station", info.get("orientation", list(UPRIGHT)))
    antenna = read_antenna(path, "antenna", info.get("antenna"))
    receiver = Receiver("base-station", elements.mean(axis=0), orientation, antenna)
    return dataclasses.replace(receiver, array_m=(elements - receiver.position_m) @ receiver.to_world)
