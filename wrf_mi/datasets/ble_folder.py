"""The layout of the BLE signal-strength data of a flat: one folder of CSV files (``docs/data.md`` has their columns).

Source: M. Kolakowski, "Automated calibration of RSS fingerprinting based systems using a mobile robot and machine
learning", Sensors 21, 6270, 2021; files at https://doi.org/10.5281/zenodo.5457591. Their transmitter stood on a pole
1.3 m above the floor. Each receiver averages the powers of two perpendicular antennas; their orientation is the
identity.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import Antenna, DataFault, InputError, Receiver, Record
from ..core.angles import FloatArray
from ..core.antenna import ANTENNA, UPRIGHT
from ..core.carriers import FREQUENCY
from ..core.files import atomic_folder, one_line, write_csv
from ..core.types import IntArray
from .faults import attempt, refuse, stop_at_faults
from .folder_files import (
    ANTENNA_WORDS,
    RUN,
    TX_ANTENNA_WORDS,
    CsvTable,
    carriers_of,
    data_folder,
    folder_record,
    read_antenna,
    read_csv,
    refuse_runs,
    refuse_unstated,
    runs_of,
    shown,
    write_extra,
)
from .unknown import Table, long_columns, table_text

logger = logging.getLogger(__name__)

ANCHORS, TRAINING, TEST = "anchors.csv", "calibration_df.csv", "test_robot_df.csv"
TAG_HEIGHT_M = 1.3
"""Height of the transmitter above the floor where the files have no column ``z`` (the data set's description)."""
CARRIER_HZ = 2.44e9
"""Carrier of files without a column ``frequency_hz``. The data are means over BLE's three advertising channels, 2402,
2426 and 2480 MHz (Bluetooth Core Specification, volume 6, part A): the middle of that band."""
RSSI, COUNT, STD, TX = "rssi_", "count_", "std_", "tx_"
MOST_READINGS = 10**6
"""Largest number of readings of a row's mean."""
COLUMNS = ("id", "x", "y", "z", *TX_ANTENNA_WORDS, *(TX + word for word in TX_ANTENNA_WORDS))
"""Columns of ``anchors.csv``."""
WHOLE = re.compile(r"([+-]?)0*(\d+?)(?:\.0*)?", re.ASCII)
"""A whole number, also as pandas writes it in a column of floats: ``3``, ``3.0``."""
NO_NAME = re.compile(r"[+-]?\d*\.\d*|nan", re.ASCII | re.IGNORECASE)
"""A number with decimals, or pandas' mark of a missing value."""


def read_ble_folder(path: str | Path, name: str | None = None) -> Record:
    """Read and check a folder in the layout of the BLE data (see ``docs/data.md``).

    The record has the folder's name unless another is given.

    Returns:
        A record with ``task="rssi"``: ``observation`` [n_rx, n] in dBm, NaN where nothing was received; the rows of
        ``calibration_df.csv``, then those of ``test_robot_df.csv``, which is the official split.

    Raises:
        InputError: anything missing, unreadable or inconsistent; one line with the file and the row.
    """
    folder = data_folder(path, f"{ANCHORS}, {TRAINING} and {TEST}")
    anchors, *tables = (attempt(read_csv, folder / file) for file in (ANCHORS, TRAINING, TEST))
    ids = attempt(_read_ids, anchors, complete=True)
    anchors_m = attempt(_positions, anchors, "xyz", True)
    rx_antennas, tx_antenna = attempt(_antennas, anchors, ""), attempt(_tx_antenna, anchors)
    plane = [attempt(_positions, table, "xy") for table in tables]
    stated = {column: attempt(_in_both, column, tables) for column in ("z", "heading", FREQUENCY, RUN)}
    strengths = [attempt(_signal_strength, table, ids) for table in tables]
    noise = {kind: attempt(_of_anchors, kind, tables, ids, strengths) for kind in (COUNT, STD)}
    stop_at_faults()
    n_train, n_test = (len(table.value.rows) for table in tables)
    height = stated["z"].value
    if height is None:
        logger.info("%s: no column z; all transmitters are taken to be %g m above the floor", folder, TAG_HEIGHT_M)
        height = np.full(n_train + n_test, TAG_HEIGHT_M)
    counts = noise[COUNT].value
    record = folder_record(
        folder,
        name,
        "rssi",
        tx_pos_m=np.column_stack([np.concatenate([part.value for part in plane]), height]),
        receivers=tuple(
            Receiver(_name(anchor), position, np.array(UPRIGHT), antenna)
            for anchor, position, antenna in zip(ids.value, anchors_m.value, rx_antennas.value, strict=True)
        ),
        observation=np.concatenate([part.value for part in strengths], axis=1),
        official=(np.arange(n_train), n_train + np.arange(n_test)),
        frequencies_hz=np.array([CARRIER_HZ]),
        tx_heading_rad=stated["heading"],
        tx_antenna=tx_antenna,
        n_readings=None if counts is None else np.nan_to_num(counts).astype(np.int64),
        std=noise[STD],
        runs=stated[RUN],
    )
    carriers_hz = stated[FREQUENCY].value
    return record if carriers_hz is None else record.at_carriers(carriers_hz)


def write_ble_folder(
    path: str | Path,
    record: Record,
    replace: bool = False,
    extra: Mapping[str, str | bytes] | None = None,
    further: Mapping[str, NDArray[Any]] | None = None,
) -> Path:
    """Write signal strengths atomically in the layout of the BLE data.

    The official split assigns rows to the files, so they are read in the order of that split. ``extra`` is the content
    of further files by their paths in the folder, ``further`` columns [n] of the rows that are not read.

    Raises:
        InputError: the folder exists or cannot be written, or the record does not fit the layout.
    """
    official, ids = _writable(path, record)
    carriers, hz = record.carriers_hz, record.frequencies_hz
    if hz is not None and hz[0] != CARRIER_HZ:
        carriers = np.full(len(record), hz[0])
    with atomic_folder(Path(path), replace) as part:
        antennas = {TX: [record.tx_antenna] * len(ids), "": [receiver.antenna for receiver in record.receivers]}
        stated = {
            prefix + word: [getattr(antenna, word) for antenna in group]
            for prefix, group in antennas.items()
            for word in TX_ANTENNA_WORDS
            if any(antenna != ANTENNA for antenna in group)
        }
        positions = np.stack([receiver.position_m for receiver in record.receivers])
        columns: dict[str, Any] = {"id": ids, **dict(zip("xyz", positions.T.tolist(), strict=True)), **stated}
        write_csv(part / ANCHORS, columns, zip(*columns.values(), strict=True))
        of_rows = {**_columns(record, ids, carriers), **(further or {})}
        for file, rows in zip((TRAINING, TEST), official, strict=True):
            write_csv(part / file, of_rows, zip(*(values[rows] for values in of_rows.values()), strict=True))
        write_extra(part, extra)
    return Path(path)


def _columns(record: Record, ids: list[str], carriers_hz: FloatArray | None) -> dict[str, NDArray[Any]]:
    """Columns of the tables of rows."""
    columns: dict[str, NDArray[Any] | None] = dict(zip("xyz", record.tx_pos_m.T, strict=True))
    columns |= {"heading": record.tx_heading_rad, FREQUENCY: carriers_hz, RUN: record.runs}
    counts = None if record.n_readings is None else record.n_readings.astype(object)
    if counts is not None:
        counts[counts == 0] = None  # an empty field where nothing was received, as of strength and noise
    for prefix, values in ((RSSI, record.observation), (COUNT, counts), (STD, record.std)):
        if values is not None:
            columns |= {prefix + anchor: received for anchor, received in zip(ids, values, strict=True)}
    return {name: values for name, values in columns.items() if values is not None}


def _writable(path: str | Path, record: Record) -> tuple[tuple[IntArray, IntArray], list[str]]:
    """The official split and the receivers' ids of a record, checked to fit the layout."""
    text, rows = f"{path}: {record.name} cannot be written in the layout of {ANCHORS}", np.arange(len(record))
    if record.task != "rssi" or record.official is None:
        raise InputError(f"{text}: it needs signal strengths with an official split; set Record.official")
    if not np.array_equal(np.sort(np.concatenate(record.official)), rows) or not all(map(len, record.official)):
        raise InputError(f"{text}: each row must be in one part of the official split, and each part have rows")
    if record.carriers_hz is None and (record.frequencies_hz is None or len(record.frequencies_hz) != 1):
        raise InputError(f"{text}: its carrier is not known; set Record.frequencies_hz to it, [1], Hz")
    refuse_unstated(path, record, "folds", "truth", "uplink")
    refuse_runs(path, record)
    numbers = (record.tx_pos_m, np.zeros(0) if record.tx_heading_rad is None else record.tx_heading_rad)
    if not all(np.isfinite(values).all() for values in numbers) or np.isinf(record.observation).any():
        raise InputError(f"{text}: a position, heading or signal strength is not finite; correct or remove its row")
    ids: list[str] = []
    for rx in record.receivers:
        if rx.array_m is not None or rx.orientation_xyzw.tolist() != list(UPRIGHT) or rx.antenna.frame != "world":
            what = "it states no array, orientation or frame of an antenna"
            raise InputError(f"{text}: receiver {rx.name}: {what}; set those of the world")
        anchor = number if _name(number := rx.name.removeprefix("anchor")) == rx.name else rx.name
        wrong = _wrong_id(anchor, ids) or ("" if _name(_id(anchor)) == rx.name else "would be read as another")
        if wrong:
            raise InputError(f"{text}: the name of receiver {shown(rx.name)} {wrong}; rename it")
        ids.append(anchor)
    return record.official, ids


def _read_ids(table: CsvTable) -> list[str]:
    """Ids of the anchors in normal form."""
    if unused := [column for column in table.header if column not in COLUMNS]:
        known = ", ".join(COLUMNS)
        logger.warning("%s: columns that are not used: %s (known: %s)", table.path, ", ".join(unused), known)
    ids: list[str] = []
    for row, text in enumerate(table.texts("id"), start=1):
        anchor = _id(text)
        wrong = None if row - 1 in table.damaged else _wrong_id(anchor, ids)
        if wrong:
            remedy = "give each anchor a number or name that no other has"
            refuse(DataFault(table.path, f"id {shown(text)} {wrong}; {remedy}", row=row))
        ids.append(anchor)
    if table.damaged:
        stop_at_faults()  # an anchor without id
    return ids


def _positions(table: CsvTable, axes: str, may_be_empty: bool = False) -> FloatArray:
    """Coordinates [rows, axes] in metres; NaN where they are empty and may be so."""
    columns = [attempt(table.numbers, axis, may_be_empty) for axis in axes]
    return np.stack([column.value for column in columns], axis=-1)


def _tx_antenna(anchors: CsvTable) -> Antenna:
    """The transmitter's antenna, which every row of the anchors states."""
    first, *others = _antennas(anchors, TX)
    for row, antenna in enumerate(others, start=2):
        if antenna != first:
            text = f"{TX}pattern or {TX}polarization differs from row 1"
            remedy = "there is one transmitter: state the same in every row"
            refuse(DataFault(anchors.path, f"{text}; {remedy}", row=row))
    return first


def _antennas(table: CsvTable, prefix: str) -> list[Antenna]:
    """The antenna of each row; an empty field or a missing column is the default."""
    stated = {key: table.texts(prefix + key) for key in TX_ANTENNA_WORDS if prefix + key in table.header}
    entries = [
        {key: text for key, texts in stated.items() if (text := texts[row].strip())} for row in range(len(table.rows))
    ]
    antennas = [
        attempt(read_antenna, table.path, f"{prefix}antenna", entry, ANTENNA_WORDS, row)
        for row, entry in enumerate(entries, start=1)
    ]
    return [antenna.value for antenna in antennas]


def _id(text: str) -> str:
    """Normal form of an id: a whole number without leading zeros and decimals, any other text unchanged."""
    number = WHOLE.fullmatch(text.strip())
    return text.strip() if number is None else number[1].replace("+", "") + number[2]


def _name(anchor: str) -> str:
    """Name of the receiver of an id."""
    return f"anchor{anchor}" if WHOLE.fullmatch(anchor) else anchor


def _wrong_id(anchor: str, before: list[str]) -> str | None:
    """Reason why an id cannot follow others, or None."""
    if not anchor:
        return "is empty"
    if not anchor.isprintable():
        return "does not go into one line"
    if "/" in anchor or "\\" in anchor or anchor in (".", ".."):
        return "cannot name a file"
    if NO_NAME.fullmatch(anchor):
        return "is neither a whole number nor a name"
    names = [_name(other) for other in before]
    if _name(anchor) in names:
        return f"gives the name {_name(anchor)}, as row {names.index(_name(anchor)) + 1} does"
    return None


def _in_both(column: str, tables: list[CsvTable]) -> Any:
    """An optional column of all tables, which all or none must have, concatenated; None where no table has it."""
    having = [table for table in tables if column in table.header]
    for table in tables:
        if having and table not in having:
            text = f"no column {column}, but {having[0].path.name} has one; give it in both files or in neither"
            refuse(DataFault(table.path, text, line=1))
    columns: list[Any] = [runs_of(table) if column == RUN else table.numbers(column) for table in having]
    if column == FREQUENCY:
        for table, values in zip(having, columns, strict=True):
            carriers_of(table.path, values)
    return np.concatenate(columns) if columns else None


def _by_anchor(prefix: str, table: CsvTable) -> dict[str, str]:
    """Columns of a table that begin with a prefix, by the anchor that they name."""
    columns: dict[str, str] = {}
    for column in table.header:
        if column.startswith(prefix):
            first = columns.setdefault(_id(column.removeprefix(prefix)), column)
            if first != column:
                text = f"{first} and {column} name one anchor; remove one of them"
                refuse(DataFault(table.path, text, line=1))
    return columns


def _of_anchors(
    prefix: str, tables: list[CsvTable], ids: list[str], strengths: list[NDArray[np.float32]]
) -> FloatArray | None:
    """Numbers of readings or standard deviations [anchors, rows], NaN where nothing was received; None: not stated."""
    columns_by_anchor = [_by_anchor(prefix, table) for table in tables]
    if not any(anchor in columns for columns in columns_by_anchor for anchor in ids):
        return None
    parts = []
    for table, columns, strength in zip(tables, columns_by_anchor, strengths, strict=True):
        if lacking := [anchor for anchor in ids if anchor not in columns]:
            text = f"no column {prefix}{lacking[0]}; give one for every anchor in both files, or none"
            refuse(DataFault(table.path, text, line=1))
        else:
            parts.append(_noise(prefix, table, columns, ids, strength))
    if len(parts) < len(tables):
        stop_at_faults()
    return np.concatenate(parts, axis=1)


def _noise(
    prefix: str, table: CsvTable, columns: dict[str, str], ids: list[str], strength: NDArray[np.float32]
) -> FloatArray:
    """Numbers of readings or standard deviations [anchors, rows] of one table."""
    counts = prefix == COUNT
    values = np.stack([table.numbers(columns[anchor], may_be_empty=True) for anchor in ids])
    if counts:
        values[values == 0] = np.nan
    good = values > 0 if not counts else (values > 0) & (values == np.floor(values)) & (values <= MOST_READINGS)
    read = ~(np.isinf(values) | np.isinf(strength))  # the others are refused already
    for row, anchor in np.argwhere((np.where(np.isnan(strength), ~np.isnan(values), ~good) & read).T):
        what = f"{columns[ids[anchor]]} is {shown(table.rows[row][table.header.index(columns[ids[anchor]])])}"
        if np.isnan(strength[anchor, row]):
            remedy = f"but {RSSI}{ids[anchor]} is empty; leave it empty, too"
        else:
            remedy = "give the number of readings, 1 to a million" if counts else "give the noise in dB, above 0"
            remedy = f"where {RSSI}{ids[anchor]} is known; {remedy}"
        refuse(DataFault(table.path, f"{what}, {remedy}", row=int(row) + 1))
    return values


def _signal_strength(table: CsvTable, ids: list[str]) -> NDArray[np.float32]:
    columns = _by_anchor(RSSI, table)
    unknown = sorted(column for anchor, column in columns.items() if anchor not in ids)
    lacking = [anchor for anchor in ids if anchor not in columns]
    if unknown or lacking:
        text = f"{len(columns)} columns {RSSI}*, but {ANCHORS} has {len(ids)} anchors"
        which = f"{one_line(unknown[0])} belongs to none" if unknown else f"{RSSI}{lacking[0]} is missing"
        remedy = "give one column per anchor, named by its id"
        if not columns and long_columns(table.header):
            remedy = table_text(Table(table.path.name, tuple(table.header)))
        raise DataFault(table.path, f"{text} ({which}); {remedy}")
    return np.stack([table.numbers(columns[anchor], may_be_empty=True) for anchor in ids]).astype(np.float32)
