"""The layout of the BLE signal-strength data of a flat: one folder of CSV files.

Format (M. Kolakowski, "Automated calibration of RSS fingerprinting based systems using a mobile robot and machine
learning", Sensors 21, 6270, 2021; files at https://doi.org/10.5281/zenodo.5457591):

- ``anchors.csv``: header ``id,x,y,z``; the receivers, metres.
- ``calibration_df.csv``: one row per measurement: ``x``, ``y`` of the transmitter in metres, ``heading`` of the robot
  that carried it in radians, ``rssi_<id>`` at each receiver in dBm, empty where nothing was received. Other columns
  (``ts``, the time) are not used. These rows train.
- ``test_robot_df.csv``: the same for another run; these rows test.

The transmitter stood on a pole, 1.3 m above the floor. Nothing is known of the receivers' antennas but that each has
two, perpendicular to each other, whose powers are averaged: their orientation is the identity.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core import InputError, Receiver, Record
from ..core.angles import FloatArray
from .csv_table import CsvTable, read_csv

ANCHORS, TRAINING, TEST = "anchors.csv", "calibration_df.csv", "test_robot_df.csv"
TAG_HEIGHT_M = 1.3
"""Height of the transmitter above the floor (the data set's description)."""
CARRIER_HZ = 2.44e9
"""The data are means over BLE's three advertising channels, 2402, 2426 and 2480 MHz (Bluetooth Core Specification,
volume 6, part A): the middle of that band."""
RSSI = "rssi_"


def read_ble_folder(path: str | Path, name: str | None = None) -> Record:
    """Read and check a folder in the layout of the BLE data (see this module's head).

    Args:
        path: the folder.
        name: the record's name; the folder's own by default.

    Returns:
        A record with ``task="rssi"``: ``observation`` [n_rx, n] in dBm, NaN where nothing was received; the rows of
        ``calibration_df.csv``, then those of ``test_robot_df.csv``, which is the official split.

    Raises:
        InputError: anything missing, unreadable or inconsistent; one line with the file and the row.
    """
    folder = Path(path)
    if not folder.is_dir():
        raise InputError(f"{folder}: not a folder; give one that holds {ANCHORS}, {TRAINING} and {TEST}")
    ids, anchors_m = _read_anchors(folder / ANCHORS)
    tables = [read_csv(folder / file) for file in (TRAINING, TEST)]
    n_train, n_test = (len(table.rows) for table in tables)
    heading = [table.numbers("heading") for table in tables]
    strength = np.concatenate([_signal_strength(table, ids) for table in tables], axis=1)
    deaf = np.flatnonzero(np.isnan(strength).all(axis=1))
    if len(deaf):
        text = f"{RSSI}{ids[deaf[0]]} is empty in every row, in {TEST} too"
        raise InputError(f"{folder / TRAINING}: {text}; remove the anchor and its columns")
    return Record(
        name=name or folder.resolve().name,
        task="rssi",
        tx_pos_m=np.concatenate([_positions(table) for table in tables]),
        receivers=tuple(
            Receiver(f"anchor{i}", position, np.array([0.0, 0.0, 0.0, 1.0]))
            for i, position in zip(ids, anchors_m, strict=True)
        ),
        observation=strength,
        official=(np.arange(n_train), n_train + np.arange(n_test)),
        frequencies_hz=np.array([CARRIER_HZ]),
        tx_heading_rad=np.concatenate(heading),
        source=str(folder),
    )


def _read_anchors(path: Path) -> tuple[list[int], FloatArray]:
    table = read_csv(path)
    numbers = table.numbers("id")
    for row, number in enumerate(numbers):
        if number != int(number) or number in numbers[:row]:
            text = f"id is {table.rows[row][table.header.index('id')]!r}"
            raise InputError(f"{path}: row {row + 1}: {text}; number the anchors 1, 2, ..., each once")
    return [int(number) for number in numbers], np.stack([table.numbers(axis) for axis in "xyz"], axis=-1)


def _positions(table: CsvTable) -> FloatArray:
    x, y = table.numbers("x"), table.numbers("y")
    return np.stack([x, y, np.full(len(x), TAG_HEIGHT_M)], axis=-1)


def _signal_strength(table: CsvTable, ids: list[int]) -> NDArray[np.float32]:
    found = [column for column in table.header if column.startswith(RSSI)]
    unknown = sorted(set(found) - {f"{RSSI}{i}" for i in ids})
    if unknown or len(found) < len(ids):
        text = f"{len(found)} columns {RSSI}*, but {ANCHORS} has {len(ids)} anchors"
        which = f"{unknown[0]} belongs to none" if unknown else f"{_lacking(found, ids)} is missing"
        raise InputError(f"{table.path}: {text} ({which}); give one column per anchor, named by its id")
    return np.stack([table.numbers(f"{RSSI}{i}", may_be_empty=True) for i in ids]).astype(np.float32)


def _lacking(found: list[str], ids: list[int]) -> str:
    return next(column for column in (f"{RSSI}{i}" for i in ids) if column not in found)
