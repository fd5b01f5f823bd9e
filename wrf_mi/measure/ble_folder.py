"""The layout of the BLE signal-strength data of a flat: one folder of CSV files.

Format (M. Kolakowski, "Automated calibration of RSS fingerprinting based systems using a mobile robot and machine
learning", Sensors 21, 6270, 2021; files at https://doi.org/10.5281/zenodo.5457591):

- ``anchors.csv``: header ``id,x,y,z``; the receivers, metres. An id is a whole number or a name. The receiver of id 3
  is called ``anchor3``, that of id ``kitchen`` is called ``kitchen``. Optional: ``pattern`` and ``polarization`` of the
  receiver's antenna, and of the transmitter's ``tx_pattern`` and ``tx_polarization``, the same in every row, in Sionna
  RT's terms (see `wrf_mi.core.Antenna`); an empty field is the default, isotropic and vertical.
- ``calibration_df.csv``: one row per measurement: ``x``, ``y`` of the transmitter in metres, ``rssi_<id>`` at each
  receiver in dBm, empty where nothing was received. These rows train.
  Optional: ``z`` of the transmitter in metres, and ``heading`` of the robot that carried it in radians. Other columns
  (``ts``, the time) are not used.
- ``test_robot_df.csv``: the same for another run; these rows test. A column ``z`` or ``heading`` is in both files or in
  neither.

Without a column ``z`` the height is that of the published data, whose transmitter stood on a pole 1.3 m above the
floor. Nothing is known of the receivers' antennas but that each has two, perpendicular to each other, whose powers are
averaged: their orientation is the identity.
"""

from __future__ import annotations

import logging
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core import Antenna, InputError, Receiver, Record
from ..core.angles import FloatArray
from ..core.files import one_line
from .csv_table import CsvTable, read_csv
from .folder_files import TX_ANTENNA_WORDS, read_antenna, shown

logger = logging.getLogger(__name__)

ANCHORS, TRAINING, TEST = "anchors.csv", "calibration_df.csv", "test_robot_df.csv"
TAG_HEIGHT_M = 1.3
"""Height of the transmitter above the floor where the files have no column ``z`` (the data set's description)."""
CARRIER_HZ = 2.44e9
"""The data are means over BLE's three advertising channels, 2402, 2426 and 2480 MHz (Bluetooth Core Specification,
volume 6, part A): the middle of that band."""
RSSI, TX = "rssi_", "tx_"
COLUMNS = ("id", "x", "y", "z", *TX_ANTENNA_WORDS, *(TX + word for word in TX_ANTENNA_WORDS))
"""Of ``anchors.csv``."""
WHOLE = re.compile(r"([+-]?)0*(\d+?)(?:\.0*)?", re.ASCII)
"""A whole number, also as pandas writes it in a column of floats: ``3``, ``3.0``."""
NO_NAME = re.compile(r"[+-]?\d*\.\d*|nan", re.ASCII | re.IGNORECASE)
"""A number that counts nothing, or pandas' mark of a missing value."""


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
    anchors = read_csv(folder / ANCHORS)
    ids, anchors_m = _read_anchors(anchors)
    tables = [read_csv(folder / file) for file in (TRAINING, TEST)]
    n_train, n_test = (len(table.rows) for table in tables)
    height = _in_both("z", tables)
    if height is None:
        logger.info("%s: no column z; all transmitters are taken to be %g m above the floor", folder, TAG_HEIGHT_M)
        height = np.full(n_train + n_test, TAG_HEIGHT_M)
    x, y = (np.concatenate([table.numbers(axis) for table in tables]) for axis in "xy")
    strength = np.concatenate([_signal_strength(table, ids) for table in tables], axis=1)
    deaf = np.flatnonzero(np.isnan(strength).all(axis=1))
    if len(deaf):
        text = f"{RSSI}{ids[deaf[0]]} is empty in every row, in {TEST} too"
        raise InputError(f"{folder / TRAINING}: {text}; remove the anchor and its columns")
    return Record(
        name=name or folder.resolve().name,
        task="rssi",
        tx_pos_m=np.stack([x, y, height], axis=-1),
        receivers=tuple(
            Receiver(_name(anchor), position, np.array([0.0, 0.0, 0.0, 1.0]), antenna)
            for anchor, position, antenna in zip(ids, anchors_m, _antennas(anchors, ""), strict=True)
        ),
        observation=strength,
        official=(np.arange(n_train), n_train + np.arange(n_test)),
        frequencies_hz=np.array([CARRIER_HZ]),
        tx_heading_rad=_in_both("heading", tables),
        tx_antenna=_tx_antenna(anchors),
        source=str(folder),
    )


def _read_anchors(table: CsvTable) -> tuple[list[str], FloatArray]:
    """Ids and positions [anchors, 3]."""
    if unused := [column for column in table.header if column not in COLUMNS]:
        logger.warning(
            "%s: columns that are not used: %s (known: %s)", table.path, ", ".join(unused), ", ".join(COLUMNS)
        )
    ids: list[str] = []
    for row, text in enumerate(table.texts("id"), start=1):
        found = _id(text)
        if wrong := _wrong_id(found, ids):
            raise InputError(
                f"{table.path}: row {row}: id {shown(text)} {wrong}; give each anchor a number or a name of its own"
            )
        ids.append(found)
    return ids, np.stack([table.numbers(axis) for axis in "xyz"], axis=-1)


def _antennas(table: CsvTable, prefix: str) -> list[Antenna]:
    """The antenna of each row; an empty field, like a column that is not there, is the default."""
    stated = {key: table.texts(prefix + key) for key in TX_ANTENNA_WORDS if prefix + key in table.header}
    antennas = []
    for row in range(len(table.rows)):
        own = {key: texts[row].strip() for key, texts in stated.items() if texts[row].strip()}
        antennas.append(read_antenna(table.path, f"row {row + 1}: {prefix}antenna", own))
    return antennas


def _tx_antenna(table: CsvTable) -> Antenna:
    antennas = _antennas(table, TX)
    for row, antenna in enumerate(antennas, start=1):
        if antenna != antennas[0]:
            text = f"row {row}: {TX}pattern or {TX}polarization differs from row 1"
            raise InputError(f"{table.path}: {text}; there is one transmitter: state the same in every row")
    return antennas[0]


def _id(text: str) -> str:
    """An id in one form: a whole number without leading zeros and decimals, anything else as it stands."""
    number = WHOLE.fullmatch(text.strip())
    return text.strip() if number is None else number[1].replace("+", "") + number[2]


def _name(anchor: str) -> str:
    """The receiver's name."""
    return f"anchor{anchor}" if WHOLE.fullmatch(anchor) else anchor


def _wrong_id(anchor: str, before: list[str]) -> str | None:
    """What is wrong with an id that follows others, or None."""
    if not anchor:
        return "is empty"
    if not anchor.isprintable():
        return "does not go into one line"
    if "/" in anchor or "\\" in anchor or anchor in (".", ".."):
        return "cannot name a file"
    if NO_NAME.fullmatch(anchor):
        return "is neither a whole number nor a name"
    names = [_name(one) for one in before]
    if _name(anchor) in names:
        return f"gives the name {_name(anchor)}, as row {names.index(_name(anchor)) + 1} does"
    return None


def _in_both(column: str, tables: list[CsvTable]) -> FloatArray | None:
    """An optional column of all tables, one after the other; None where none has it.

    Raises:
        InputError: one of them has it and another has not.
    """
    having = [table for table in tables if column in table.header]
    if not having:
        return None
    for table in tables:
        if table not in having:
            text = f"line 1: no column {column}, but {having[0].path.name} has one"
            raise InputError(f"{table.path}: {text}; give it in both files or in neither")
    return np.concatenate([table.numbers(column) for table in tables])


def _signal_strength(table: CsvTable, ids: list[str]) -> NDArray[np.float32]:
    found = {column: _id(column.removeprefix(RSSI)) for column in table.header if column.startswith(RSSI)}
    unknown = sorted(column for column, anchor in found.items() if anchor not in ids)
    lacking = [anchor for anchor in ids if anchor not in found.values()]
    if unknown or lacking:
        text = f"{len(found)} columns {RSSI}*, but {ANCHORS} has {len(ids)} anchors"
        which = f"{one_line(unknown[0])} belongs to none" if unknown else f"{RSSI}{lacking[0]} is missing"
        raise InputError(f"{table.path}: {text} ({which}); give one column per anchor, named by its id")
    columns = {anchor: column for column, anchor in found.items()}
    if len(columns) < len(found):
        twice = next(column for column, anchor in found.items() if columns[anchor] != column)
        raise InputError(
            f"{table.path}: line 1: {twice} and {columns[found[twice]]} name one anchor; remove one of them"
        )
    return np.stack([table.numbers(columns[anchor], may_be_empty=True) for anchor in ids]).astype(np.float32)
