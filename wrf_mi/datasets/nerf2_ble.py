"""The layout of NeRF2's signal strengths: one folder with gateways, positions and a table of powers.

Source: NeRF2, Zhao et al., MobiCom 2023, https://github.com/XPengZhao/NeRF2, class ``BLE_dataset`` of its
``dataloader.py``. ``docs/data.md`` has the files. In both tables a header may number the columns, ``0,1,...``, as
pandas does; any other header of numbers is refused, because it is most likely a row. Blank lines are skipped. The
gateways' antennas are not stated: their orientation is the identity.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core import InputError, Receiver, Record
from ..core.antenna import UPRIGHT
from .folder_files import (
    POSITIONS,
    CsvTable,
    data_folder,
    finite_numbers,
    read_csv,
    read_official,
    read_yaml,
    shown,
)

GATEWAYS, POWERS = "gateway_position.yml", "gateway_rssi.csv"
NOT_RECEIVED_DBM = -100.0
CARRIER_HZ = 2.44e9
"""The middle of BLE's band, 2402 to 2480 MHz (Bluetooth Core Specification, volume 6, part A)."""
FEWEST = 2
"""Least number of rows: one to train on and one to score."""


def read_nerf2_ble(path: str | Path, name: str | None = None) -> Record:
    """Read and check a folder in the layout of NeRF2's signal strengths (see ``docs/data.md``).

    Args:
        path: path of the folder.
        name: name of the record; by default that of the folder.

    Returns:
        A record with ``task="rssi"``: ``observation`` [n_rx, n] in dBm, NaN where nothing was received.

    Raises:
        InputError: anything missing, unreadable or inconsistent, a gateway that received nothing at all, or a single
            transmission; one line with the file and the row.
    """
    folder = data_folder(path, f"{GATEWAYS}, {POSITIONS} and {POWERS}")
    found = read_yaml(folder / GATEWAYS)
    if not found:
        raise InputError(f"{folder / GATEWAYS}: no gateway in it; give one line NAME: [x, y, z] for each, metres")
    for key in found:
        if not str(key).isprintable():
            text = f"gateway {shown(key)} does not go into one line"
            raise InputError(f"{folder / GATEWAYS}: {text}; call it gateway1, gateway2, ...")
    gateways = {str(key): finite_numbers(folder / GATEWAYS, f"{key}: position", at, 3) for key, at in found.items()}
    table = _headed(folder / POSITIONS)
    if len(table.header) != 3:
        text = f"header {','.join(table.header)[:40]!r} has {len(table.header)} columns"
        raise InputError(f"{table.path}: line 1: {text}; give x,y,z in metres")
    lower = [column.lower() for column in table.header]
    axes = [lower.index(axis) for axis in "xyz"] if sorted(lower) == ["x", "y", "z"] else [0, 1, 2]
    positions = np.stack([table.numbers(table.header[axis], index=axis) for axis in axes], axis=-1)
    power = _read_powers(folder / POWERS, list(gateways))
    rows = len(positions)
    if power.shape[1] != rows:
        text = f"{power.shape[1]} rows, but {POSITIONS} has {rows}"
        raise InputError(f"{folder / POWERS}: {text}; give one row of each per transmission")
    if rows < FEWEST:
        raise InputError(f"{folder / POSITIONS}: {rows} row; give {FEWEST} at least, to train on and to score")
    return Record(
        name=name or folder.resolve().name,
        task="rssi",
        tx_pos_m=positions,
        receivers=tuple(Receiver(gateway, at, np.array(UPRIGHT)) for gateway, at in gateways.items()),
        observation=power,
        official=read_official(folder, rows, first=0),
        frequencies_hz=np.array([CARRIER_HZ]),
        source=str(folder),
    )


def _read_powers(path: Path, gateways: list[str]) -> NDArray[np.float32]:
    table = _headed(path)
    if len(table.header) != len(gateways):
        text = f"{len(table.header)} columns, but {GATEWAYS} has {len(gateways)} gateways"
        raise InputError(f"{path}: line 1: {text}; give one column per gateway")
    named = set(table.header) & set(gateways)
    if named != set(gateways) and _numbered(table):
        named = set()  # pandas' numbers, though a gateway may have such a name
    if named and named != set(gateways):
        lacking = next(gateway for gateway in gateways if gateway not in named)
        raise InputError(f"{path}: line 1: no column {lacking}; name all columns as {GATEWAYS} does, or none")
    if named:
        columns, power = gateways, np.stack([table.numbers(gateway) for gateway in gateways])
    else:
        columns = [f"{column} ({gateway})" for column, gateway in zip(table.header, gateways, strict=True)]
        power = np.stack([table.numbers(f"column {what}", index=index) for index, what in enumerate(columns)])
    power[power == NOT_RECEIVED_DBM] = np.nan
    silent = np.flatnonzero(np.isnan(power).all(axis=1))
    if len(silent):
        what = f"every row is {NOT_RECEIVED_DBM:g}, so gateway {gateways[silent[0]]} received nothing"
        text = f"column {columns[silent[0]]}: {what}"
        raise InputError(f"{path}: {text}; remove it here and from {GATEWAYS}")
    return power.astype(np.float32)


def _headed(path: Path) -> CsvTable:
    """A table with a header: NeRF2's loader reads any first line as the header, so a row there is refused."""
    table = read_csv(path, skip_blank=True)
    try:
        [float(column) for column in table.header]
    except ValueError:
        return table
    if _numbered(table):
        return table
    raise InputError(f"{path}: line 1: {','.join(table.header)[:40]!r} is a row of numbers; put a header above it")


def _numbered(table: CsvTable) -> bool:
    """Whether the header is 0, 1, ..., as pandas writes it for columns without names."""
    return table.header == [str(place) for place in range(len(table.header))]
