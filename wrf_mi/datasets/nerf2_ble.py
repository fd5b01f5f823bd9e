"""The layout of NeRF2's signal strengths: one folder with gateways, positions and a table of powers.

Source: NeRF2, Zhao et al., MobiCom 2023, https://github.com/XPengZhao/NeRF2, class ``BLE_dataset`` of its
``dataloader.py``. ``docs/data.md`` has the files. In both tables a header may number the columns, ``0,1,...``, as
pandas does; any other header of numbers is refused, because it is most likely a row. Blank lines are skipped. The
gateways' antennas are not stated: their orientation is the identity.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import DataFault, Receiver, Record
from ..core.angles import FloatArray
from ..core.antenna import UPRIGHT
from ..core.yaml_files import read_yaml
from ..tasks import RSSI
from . import folder_files as files
from .faults import attempt, recoverable, refuse

GATEWAYS, POWERS = "gateway_position.yml", "gateway_rssi.csv"
NOT_RECEIVED_DBM = -100.0  # what the authors' files state where a gateway received nothing
CARRIER_HZ = 2.44e9  # the middle of BLE's band, 2402 to 2480 MHz (Bluetooth Core Specification, volume 6, part A)
FEWEST = 2  # least number of rows: one to train on and one to score


def read_nerf2_ble(path: str | Path, name: str | None = None) -> Record:
    """Read and check a folder in the layout of NeRF2's signal strengths (see ``docs/data.md``).

    Returns:
        A record, by default named after the folder, with ``task="rssi"``: ``observation`` [n_rx, n] in dBm, NaN where
        nothing was received.

    Raises:
        InputError: anything missing, unreadable or inconsistent, or a single transmission; one line with the file and
            the row.
    """
    folder = files.data_folder(path, f"{GATEWAYS}, {files.POSITIONS} and {POWERS}")
    info = attempt(read_yaml, folder / GATEWAYS)
    receivers = attempt(_read_gateways, folder / GATEWAYS, info)
    table = attempt(_headed, folder / files.POSITIONS)
    positions = attempt(_read_positions, table)
    power = attempt(_read_powers, folder / POWERS, info)
    rows = attempt(_count_rows, table)
    with recoverable():
        if power.value.shape[1] != rows.value:
            text = f"{power.value.shape[1]} rows, but {files.POSITIONS} has {rows.value}"
            raise DataFault(folder / POWERS, f"{text}; give one row of each per transmission")
    official = attempt(files.read_official, folder, rows, 0)
    return files.folder_record(
        folder,
        name,
        RSSI,
        tx_pos_m=positions,
        receivers=receivers,
        observation=power,
        official=official,
        frequencies_hz=np.array([CARRIER_HZ]),
    )


def _read_gateways(path: Path, info: dict[Any, Any]) -> tuple[Receiver, ...]:
    if not info:
        raise DataFault(path, "no gateway in it; give one line NAME: [x, y, z] for each, metres")
    for key in info:
        if not str(key).isprintable():
            text = f"gateway {files.shown(key)} does not go into one line; call it gateway1, gateway2, ..."
            refuse(DataFault(path, text))
    places = {str(key): attempt(files.finite_numbers, path, f"{key}: position", at, 3) for key, at in info.items()}
    return tuple(Receiver(key, place.value, np.array(UPRIGHT)) for key, place in places.items())


def _read_positions(table: files.CsvTable) -> FloatArray:
    if len(table.header) != 3:
        text = f"header {','.join(table.header)[:40]!r} has {len(table.header)} columns; give x,y,z in metres"
        raise DataFault(table.path, text, line=1)
    lower = [column.lower() for column in table.header]
    axes = [lower.index(axis) for axis in "xyz"] if sorted(lower) == ["x", "y", "z"] else [0, 1, 2]
    return np.stack([table.numbers(table.header[axis], index=axis) for axis in axes], axis=-1)


def _count_rows(table: files.CsvTable) -> int:
    rows = len(table.rows)
    if rows < FEWEST:
        refuse(DataFault(table.path, f"{rows} row; give {FEWEST} at least, to train on and to score"))
    return rows


def _read_powers(path: Path, info: dict[Any, Any]) -> NDArray[np.float32]:
    """Powers [gateways, rows] in dBm, NaN where nothing was received."""
    table = _headed(path)
    columns = _columns(table, list(map(str, info)))
    power = np.stack([table.numbers(name, index=index) for name, index in columns])
    power[power == NOT_RECEIVED_DBM] = np.nan
    return power.astype(np.float32)


def _columns(table: files.CsvTable, gateways: list[str]) -> list[tuple[str, int | None]]:
    """Name in messages and index of each gateway's column, None where the name is that of the column."""
    if len(table.header) != len(gateways):
        text = f"{len(table.header)} columns, but {GATEWAYS} has {len(gateways)} gateways; give one column per gateway"
        raise DataFault(table.path, text, line=1)
    lacking = [gateway for gateway in gateways if gateway not in table.header]
    if not lacking:
        return [(gateway, None) for gateway in gateways]
    # Gateways may be called like some of pandas' numbers.
    if len(lacking) < len(gateways) and not _numbered(table):
        raise DataFault(table.path, f"no column {lacking[0]}; name all columns as {GATEWAYS} does, or none", line=1)
    pairs = zip(table.header, gateways, strict=True)
    return [(f"column {column} ({gateway})", index) for index, (column, gateway) in enumerate(pairs)]


def _headed(path: Path) -> files.CsvTable:
    """A table with a header: NeRF2's loader reads any first line as the header, so a row there is refused."""
    table = files.read_csv(path, skip_blank=True)
    try:
        [float(column) for column in table.header]
    except ValueError:
        return table
    if _numbered(table):
        return table
    raise DataFault(path, f"{','.join(table.header)[:40]!r} is a row of numbers; put a header above it", line=1)


def _numbered(table: files.CsvTable) -> bool:
    """Whether the header is 0, 1, ..., as pandas writes it for columns without names."""
    return table.header == [str(place) for place in range(len(table.header))]
