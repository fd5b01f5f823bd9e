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

from ..core import DataFault, InputError, Receiver, Record
from ..core.angles import FloatArray
from ..core.antenna import UPRIGHT
from ..core.array_files import stored_array
from ..core.files import atomic_folder, readable
from ..core.yaml_files import read_yaml
from ..tasks import CSI
from . import folder_files as files
from .faults import attempt, recoverable, refuse, stop_at_faults

CHANNELS, STATION, TRUTH = "csidata.npy", "base-station.yml", "downlink_truth.npy"
FEWEST = 2  # least number of samples: one to train on and one to score


def read_nerf2_csi(path: str | Path, name: str | None = None) -> Record:
    """Read and check a folder in the layout of NeRF2's channel coefficients (see ``docs/data.md``).

    The record has the folder's name unless another is given.

    Returns:
        A record with ``task="csi"`` and one receiver at the middle of the antennas: ``observation``
        [1, n, antennas, subcarriers / 2] of the downlink, ``uplink`` [n, antennas, subcarriers / 2], positions NaN
        where there is no ``tx_pos.csv``.

    Raises:
        InputError: anything missing, unreadable or inconsistent; one line with the file and the sample.
    """
    folder = files.data_folder(path, f"{CHANNELS} and {STATION}")
    station = folder / STATION
    channel = attempt(_read_channels, folder / CHANNELS)
    n = attempt(_count_samples, folder / CHANNELS, channel)
    info = attempt(read_yaml, station)
    receiver = attempt(_read_station, station, info)
    with recoverable():
        count, antennas = len(np.asarray(receiver.value.array_m)), channel.value.shape[1]
        if count != antennas:
            text = f"{count} positions in base_station, but {CHANNELS} has {antennas} antennas"
            raise DataFault(station, f"{text}; give one for each")
    frequencies = attempt(_frequencies, station, info, channel)
    positions = folder / files.POSITIONS
    table = attempt(files.read_positions, positions, ()) if positions.exists() else None
    with recoverable():
        if table is not None and len(table.value.positions_m) != n.value:
            text = f"{len(table.value.positions_m)} rows, but {CHANNELS} has {n.value} samples; give one for each"
            raise DataFault(positions, text)
    truth = attempt(_read_truth, folder / TRUTH, channel)
    official = attempt(files.read_official, folder, n, 0, CHANNELS)
    tx_antenna = attempt(files.read_tx_antenna, station, info)
    stop_at_faults()
    half, hz = channel.value.shape[2] // 2, frequencies.value
    return files.folder_record(
        folder,
        name,
        CSI,
        tx_pos_m=np.full((n.value, 3), np.nan) if table is None else table.value.positions_m,
        receivers=(receiver.value,),
        observation=channel.value[None, :, :, half:],
        official=official,
        frequencies_hz=None if hz is None else hz[half:],
        uplink=channel.value[:, :, :half],
        uplink_hz=None if hz is None else hz[:half],
        truth=truth,
        tx_antenna=tx_antenna,
    )


def write_nerf2_csi(
    path: str | Path, record: Record, replace: bool = False, extra: Mapping[str, str | bytes] | None = None
) -> Path:
    """Write a record atomically in the layout of NeRF2's channel coefficients.

    The record has one receiver with antennas (``array_m``), and an uplink of as many subcarriers as the downlink.
    ``extra`` is the content of further files by their paths in the folder.

    Raises:
        InputError: the folder exists or cannot be written, or the record does not fit the layout.
    """
    down, up, array_m = record.observation, record.uplink, record.receivers[0].array_m
    if down.ndim != 4 or up is None or down.shape != (1, *up.shape) or array_m is None:
        need = "one receiver with array_m, and an uplink of as many antennas and subcarriers as the downlink"
        raise InputError(f"{path}: {record.name} cannot be written as {CHANNELS}; it needs {need}")
    files.refuse_unstated(path, record, "folds", "tx_heading_rad", "n_readings", "std", "carriers_hz", "runs")
    with atomic_folder(Path(path), replace) as part:
        np.save(part / CHANNELS, np.concatenate([up, down[0]], axis=-1).astype(np.complex64))
        text = yaml.safe_dump(_station_info(record, array_m), sort_keys=False, default_flow_style=None)
        (part / STATION).write_text(text, encoding="utf-8")
        if np.isfinite(record.tx_pos_m).all():
            files.write_positions(part / files.POSITIONS, files.PositionTable(record.tx_pos_m))
        if record.truth is not None:
            np.save(part / TRUTH, record.truth[0].astype(np.complex64))
        files.write_official(part, record.official, first=0)
        files.write_patterns(part, record)
        files.write_extra(part, extra)
    return Path(path)


def _station_info(record: Record, array_m: FloatArray) -> dict[str, Any]:
    receiver = record.receivers[0]
    info: dict[str, Any] = {
        "base_station": (receiver.position_m + array_m @ receiver.to_world.T).tolist(),
        "orientation": receiver.orientation_xyzw.tolist(),
    }
    if record.uplink_hz is not None and record.frequencies_hz is not None:
        info["frequencies_hz"] = [*record.uplink_hz.tolist(), *record.frequencies_hz.tolist()]
    antennas = {"antenna": files.antenna_entry(receiver.antenna), "tx_antenna": files.antenna_entry(record.tx_antenna)}
    return info | {key: value for key, value in antennas.items() if value}


def _read_channels(path: Path) -> NDArray[np.complex64]:
    """Complex coefficients [n, antennas, subcarriers] of a ``.npy`` file, finite in single precision."""
    missing = DataFault(path, "missing; give a file that exists, or complete its folder")
    with readable(path, missing, "write it again with numpy.save"):
        values = stored_array(path)
    wanted = "give complex numbers [samples, antennas, subcarriers]"
    if not isinstance(values, np.ndarray) or values.ndim != 3 or 0 in values.shape:
        raise DataFault(path, f"shape {list(getattr(values, 'shape', ()))}; {wanted}")
    if values.dtype.kind != "c":
        raise DataFault(path, f"holds {values.dtype}; {wanted}")
    with np.errstate(over="ignore"):
        single = values.astype(np.complex64)
    bad = ~np.isfinite(single)
    for sample in np.flatnonzero(bad.any(axis=(1, 2))):
        antenna, subcarrier = (int(k) for k in np.argwhere(bad[sample])[0])
        value = values[sample, antenna, subcarrier]
        what = "too large for single precision" if np.isfinite(value) else "not finite"
        place = f"sample {sample}, antenna {antenna}, subcarrier {subcarrier} (from 0)"
        refuse(DataFault(path, f"{value} is {what}; correct or remove the sample", row=int(sample), place=place))
    return single


def _count_samples(path: Path, channel: NDArray[np.complex64]) -> int:
    """Number of samples, checked together with the number of subcarriers."""
    n, _, subcarriers = channel.shape
    if n < FEWEST:
        refuse(DataFault(path, f"{n} sample; give {FEWEST} at least, to train on and to score"))
    if subcarriers % 2:
        text = f"{subcarriers} subcarriers do not halve into uplink and downlink; give as many of each"
        refuse(DataFault(path, text))
    return n


def _frequencies(path: Path, info: dict[Any, Any], channel: NDArray[np.complex64]) -> FloatArray | None:
    """Frequencies of all subcarriers, if ``base-station.yml`` states any."""
    if (entry := info.get("frequencies_hz")) is None:
        return None
    frequencies, subcarriers = files.numbers_of(entry), channel.shape[2]
    positive = (frequencies > 0) & (frequencies <= files.SINGLE_MAX)
    if frequencies.ndim != 1 or not len(frequencies) or not positive.all():
        raise DataFault(path, f"frequencies_hz is {files.shown(entry)}; give a list of frequencies in Hz")
    if len(frequencies) != subcarriers:
        text = f"{len(frequencies)} frequencies_hz, but {CHANNELS} has {subcarriers} subcarriers"
        raise DataFault(path, f"{text}; give one for each, the uplink's first")
    return frequencies


def _read_truth(path: Path, channel: NDArray[np.complex64]) -> NDArray[np.complex64] | None:
    """The downlink without noise [1, n, antennas, subcarriers / 2], None where there is no file."""
    if not path.exists():
        return None
    truth, shape = _read_channels(path), [*channel.shape[:2], channel.shape[2] // 2]
    if list(truth.shape) != shape:
        raise DataFault(path, f"shape {list(truth.shape)}, expected {shape}, as the downlink of {CHANNELS}; correct it")
    return truth[None]


def _read_station(path: Path, info: dict[Any, Any]) -> Receiver:
    places = info.get("base_station")
    elements = files.numbers_of(places)
    orientation = attempt(files.unit_quaternion, path, "base_station", info.get("orientation", list(UPRIGHT)))
    antenna = attempt(files.read_antenna, path, "antenna", info.get("antenna"))
    if elements.ndim != 2 or elements.shape[1] != 3 or not files.fits_single(elements):
        raise DataFault(path, f"base_station is {files.shown(places)}; give x, y, z in metres of each antenna")
    receiver = Receiver("base-station", elements.mean(axis=0), orientation.value, antenna.value)
    return dataclasses.replace(receiver, array_m=(elements - receiver.position_m) @ receiver.to_world)
