"""The layout of NeRF2's signal strengths: one folder with gateways, positions and a table of powers.

Format (NeRF2, Zhao et al., MobiCom 2023, https://github.com/XPengZhao/NeRF2, class ``BLE_dataset`` of its
``dataloader.py``):

- ``gateway_position.yml``: ``name: [x, y, z]`` of each gateway, metres.
- ``tx_pos.csv``: a header, then the transmitter's x, y, z in metres, one row per transmission.
- ``gateway_rssi.csv``: a header with one column per gateway, then the power in dBm that each received, one row per
  transmission; -100 where it received nothing. Columns that bear the gateways' names belong to these; other headers
  go by the order of ``gateway_position.yml``, as NeRF2's loader does throughout.
  In both tables a header may number the columns, ``0,1,...``, as pandas does where they have no names; any other
  header of numbers is refused, because it is most likely a row. Blank lines are skipped.
- ``train_index.txt``, ``test_index.txt``, optional: transmissions, counted from 0, one per line. Both or neither.

Nothing is known of the gateways' antennas: their orientation is the identity.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core import InputError, Receiver, Record
from ..core.angles import FloatArray
from .csv_table import CsvTable, read_csv
from .folder_files import POSITIONS, finite_numbers, read_official, read_yaml, shown

GATEWAYS, POWERS = "gateway_position.yml", "gateway_rssi.csv"
NOT_RECEIVED_DBM = -100.0
CARRIER_HZ = 2.44e9
"""The middle of BLE's band, 2402 to 2480 MHz (Bluetooth Core Specification, volume 6, part A)."""
FEWEST = 2
"""Rows: one to train on and one to score."""


def read_nerf2_ble(path: str | Path, name: str | None = None) -> Record:
    """Read and check a folder in the layout of NeRF2's signal strengths (see this module's head).

    Args:
        path: the folder.
        name: the record's name; the folder's own by default.

    Returns:
        A record with ``task="rssi"``: ``observation`` [n_rx, n] in dBm, NaN where nothing was received.

    Raises:
        InputError: anything missing, unreadable or inconsistent, a gateway that received nothing at all, or a single
            transmission; one line with the file and the row.
    """
    folder = Path(path)
    if not folder.is_dir():
        raise InputError(f"{folder}: not a folder; give one that holds {GATEWAYS}, {POSITIONS} and {POWERS}")
    gateways = _read_gateways(folder / GATEWAYS)
    positions = _read_positions(folder / POSITIONS)
    power = _read_powers(folder / POWERS, list(gateways))
    rows = len(positions)
    if power.shape[1] != rows:
        text = f"{power.shape[1]} rows, but {POSITIONS} has {rows}"
        raise InputError(f"{folder / POWERS}: {text}; give one row of each per transmission")
    if rows < FEWEST:
        raise InputError(f"{folder / POSITIONS}: {rows} row; give {FEWEST} at least, to train on and to score")
    upright = np.array([0.0, 0.0, 0.0, 1.0])
    return Record(
        name=name or folder.resolve().name,
        task="rssi",
        tx_pos_m=positions,
        receivers=tuple(Receiver(one, place, upright) for one, place in gateways.items()),
        observation=power,
        official=read_official(folder, rows, first=0),
        frequencies_hz=np.array([CARRIER_HZ]),
        source=str(folder),
    )


def _read_gateways(path: Path) -> dict[str, FloatArray]:
    found = read_yaml(path)
    if not found:
        raise InputError(f"{path}: no gateway in it; give one line NAME: [x, y, z] for each, metres")
    for one in found:
        if not str(one).isprintable():
            raise InputError(f"{path}: gateway {shown(one)} does not go into one line; call it gateway1, gateway2, ...")
    return {str(one): finite_numbers(path, f"{one}: position", place, 3) for one, place in found.items()}


def _read_positions(path: Path) -> FloatArray:
    table = _headed(path)
    if len(table.header) != 3:
        text = f"header {','.join(table.header)[:40]!r} has {len(table.header)} columns"
        raise InputError(f"{path}: line 1: {text}; give x,y,z in metres")
    lower = [column.lower() for column in table.header]
    axes = [lower.index(axis) for axis in "xyz"] if sorted(lower) == ["x", "y", "z"] else [0, 1, 2]
    return np.stack([table.numbers_at(axis, table.header[axis]) for axis in axes], axis=-1)


def _read_powers(path: Path, gateways: list[str]) -> NDArray[np.float32]:
    table = _headed(path)
    if len(table.header) != len(gateways):
        text = f"{len(table.header)} columns, but {GATEWAYS} has {len(gateways)} gateways"
        raise InputError(f"{path}: line 1: {text}; give one column per gateway")
    named = set(table.header) & set(gateways)
    if named != set(gateways) and _numbered(table):
        named = set()  # pandas' numbers, though a gateway may bear one of them
    if named and named != set(gateways):
        lacking = next(one for one in gateways if one not in named)
        raise InputError(f"{path}: line 1: no column {lacking}; name all columns as {GATEWAYS} does, or none")
    if named:
        columns, power = gateways, np.stack([table.numbers(one) for one in gateways])
    else:
        columns = [f"{one} ({gateway})" for one, gateway in zip(table.header, gateways, strict=True)]
        power = np.stack([table.numbers_at(place, f"column {what}") for place, what in enumerate(columns)])
    power[power == NOT_RECEIVED_DBM] = np.nan
    deaf = np.flatnonzero(np.isnan(power).all(axis=1))
    if len(deaf):
        what = f"every row is {NOT_RECEIVED_DBM:g}, so gateway {gateways[deaf[0]]} got nothing"
        text = f"column {columns[deaf[0]]}: {what}"
        raise InputError(f"{path}: {text}; remove it here and from {GATEWAYS}")
    return power.astype(np.float32)


def _headed(path: Path) -> CsvTable:
    """A table whose first line is no row: NeRF2's loader takes the first line for the header, whatever it holds."""
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
