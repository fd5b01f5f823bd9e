"""The layout of the BLE signal-strength data of a flat: one folder of CSV files (``docs/data.md`` has their columns).

Source: M. Kolakowski, "Automated calibration of RSS fingerprinting based systems using a mobile robot and machine
learning", Sensors 21, 6270, 2021; files at https://doi.org/10.5281/zenodo.5457591. Their transmitter stood on a pole
1.3 m above the floor. Each receiver averages the powers of two perpendicular antennas; their orientation is the
identity.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import DataFault, InputError, Receiver, Record
from ..core.angles import FloatArray
from ..core.antenna import UPRIGHT
from ..core.carriers import FREQUENCY
from ..core.files import atomic_folder, one_line, write_csv
from . import folder_files as files
from .faults import attempt, refuse, stop_at_faults
from .receivers_file import (
    WHOLE,
    plain_id,
    read_antennas,
    read_ids,
    read_orientations,
    read_positions,
    read_transmitter,
    receiver_columns,
    receiver_name,
    wrong_id,
)
from .unknown import Table, long_columns, table_text

logger = logging.getLogger(__name__)

RECEIVERS, TRAINING = ("receivers.csv", "anchors.csv"), ("train.csv", "calibration_df.csv")
TEST, MEASUREMENTS = ("test.csv", "test_robot_df.csv"), ("measurements.csv",)
FILES = (RECEIVERS, TRAINING, TEST, MEASUREMENTS)
"""Names of the files: that which is written, then that of the BLE data."""
TAG_HEIGHT_M = 1.3
"""Height of the transmitter above the floor where the files have no column ``z`` (the data set's description)."""
CARRIER_HZ = 2.44e9
"""Carrier of files without a column ``frequency_hz``. The data are means over BLE's three advertising channels, 2402,
2426 and 2480 MHz (Bluetooth Core Specification, volume 6, part A): the middle of that band."""
RSSI, COUNT, STD, SPLIT = "rssi_", "count_", "std_", "split"
PARTS = ("train", "test")
"""Words of the column ``split``, which otherwise has numbers of spatial folds."""
MOST_READINGS = 10**6
"""Largest number of readings of a row's mean."""


def read_ble_folder(path: str | Path, name: str | None = None) -> Record:
    """Read and check a folder in the layout of the BLE data (see ``docs/data.md``).

    The record has the folder's name unless another is given.

    Returns:
        A record with ``task="rssi"``: ``observation`` [n_rx, n] in dBm, NaN where nothing was received. The rows of
        ``train.csv``, then those of ``test.csv``, are the official split; in ``measurements.csv`` the column ``split``
        states that split or spatial folds.

    Raises:
        InputError: anything missing, unreadable or inconsistent; one line with the file and the row.
    """
    folder = files.data_folder(
        path, f"{RECEIVERS[0]}, {TRAINING[0]} and {TEST[0]}, or {RECEIVERS[0]} and {MEASUREMENTS[0]}"
    )
    anchors, *tables = (attempt(files.read_csv, file) for file in _files(folder))
    ids = attempt(read_ids, anchors, complete=True)
    anchors_m = attempt(read_positions, anchors, "xyz", True)
    orientations, receivers_hz = (
        attempt(read_orientations, anchors),
        attempt(_receiver_carriers, anchors, tables),
    )
    rx_antennas = attempt(read_antennas, anchors, "", orientations)
    tx_antenna = attempt(read_transmitter, anchors)
    plane = [attempt(read_positions, table, "xy") for table in tables]
    stated = {column: attempt(_in_both, column, tables) for column in ("z", "heading", FREQUENCY, files.RUN)}
    split = attempt(_read_split, tables)
    strengths = [attempt(_signal_strength, table, ids, anchors) for table in tables]
    noise = {kind: attempt(_of_anchors, kind, tables, ids, strengths) for kind in (COUNT, STD)}
    stop_at_faults()
    height, counts = stated["z"].value, noise[COUNT].value
    plane_m = np.concatenate([part.value for part in plane])
    if height is None:
        logger.info("%s: no column z; all transmitters are taken to be %g m above the floor", folder, TAG_HEIGHT_M)
        height = np.full(len(plane_m), TAG_HEIGHT_M)
    upright = np.array(UPRIGHT)
    columns = ids.value, anchors_m.value, orientations.value, rx_antennas.value
    record = files.folder_record(
        folder,
        name,
        "rssi",
        tx_pos_m=np.column_stack([plane_m, height]),
        receivers=tuple(
            Receiver(receiver_name(anchor), position, upright if orientation is None else orientation, antenna)
            for anchor, position, orientation, antenna in zip(*columns, strict=True)
        ),
        observation=np.concatenate([part.value for part in strengths], axis=1),
        frequencies_hz=np.array([CARRIER_HZ]),
        tx_heading_rad=stated["heading"],
        tx_antenna=tx_antenna,
        n_readings=None if counts is None else np.nan_to_num(counts).astype(np.int64),
        std=noise[STD],
        runs=stated[files.RUN],
        **split.value,
    )
    if receivers_hz.value is not None:
        return record.at_receiver_carriers(receivers_hz.value)
    carriers_hz = stated[FREQUENCY].value
    return record if carriers_hz is None else record.at_carriers(carriers_hz)


def _files(folder: Path) -> list[Path]:
    """File of the receivers and those of the rows: one, or those of training and test rows."""
    present = {names: [name for name in names if (folder / name).exists()] for names in FILES}
    both = [name for names in (TRAINING, TEST) for name in present[names]]
    for same in (*present.values(), [*present[MEASUREMENTS], *both] if present[MEASUREMENTS] else []):
        if len(same) > 1:
            raise DataFault(folder, f"{same[0]} and {same[1]} state the same; remove one of them")
    # A missing file is reported by the name that goes with those of the others.
    historic = any(names.index(name) for names, named in present.items() for name in named)
    rows = (MEASUREMENTS,) if present[MEASUREMENTS] else (TRAINING, TEST)
    return [folder / (present[names] or [names[historic]])[0] for names in (RECEIVERS, *rows)]


def _read_split(tables: list[files.CsvTable]) -> dict[str, Any]:
    """The attributes ``official`` or ``folds`` of the record."""
    if len(tables) > 1:
        n_train, n_test = (len(table.rows) for table in tables)
        return {"official": (np.arange(n_train), n_train + np.arange(n_test))}
    table = tables[0]
    if SPLIT not in table.header:
        return {}
    texts = table.texts(SPLIT)
    # Rows that are damaged have been refused already; any word serves there.
    words = np.array([PARTS[0] if row in table.damaged else text.strip().lower() for row, text in enumerate(texts)])
    if all(map(WHOLE.fullmatch, words)):
        return {"folds": np.unique(words.astype(float), return_inverse=True)[1].reshape(-1).astype(np.int64)}
    for row in np.flatnonzero(~np.isin(words, PARTS)):
        text = f"{SPLIT} is {files.shown(texts[row])}; give train or test, or in all rows a fold's number"
        refuse(DataFault(table.path, text, row=int(row) + 1))
    official = np.flatnonzero(words == PARTS[0]), np.flatnonzero(words == PARTS[1])
    if not (len(official[0]) and len(official[1])):
        raise DataFault(table.path, f"all rows have {words[0]} in the column {SPLIT}; mark others, or omit the column")
    return {"official": official}


def write_ble_folder(
    path: str | Path,
    record: Record,
    replace: bool = False,
    extra: Mapping[str, str | bytes] | None = None,
    further: Mapping[str, NDArray[Any]] | None = None,
) -> Path:
    """Write signal strengths atomically in the layout of the BLE data.

    Rows go into ``train.csv`` and ``test.csv`` by the official split, and are read in its order; without one into
    ``measurements.csv``. ``extra`` is the content of further files by their paths in the folder, ``further`` columns
    [n] of the rows that are not read.

    Raises:
        InputError: the folder exists or cannot be written, or the record does not fit the layout.
    """
    ids = _writable(path, record)
    with atomic_folder(Path(path), replace) as part:
        columns = receiver_columns(record, ids)
        write_csv(part / RECEIVERS[0], columns, zip(*columns.values(), strict=True))
        of_rows = {**_columns(record, ids), **(further or {})}
        file_names = (MEASUREMENTS,) if record.official is None else (TRAINING, TEST)
        parts = (np.arange(len(record)),) if record.official is None else record.official
        for names, rows in zip(file_names, parts, strict=True):
            write_csv(part / names[0], of_rows, zip(*(values[rows] for values in of_rows.values()), strict=True))
        files.write_extra(part, extra)
    return Path(path)


def _columns(record: Record, ids: list[str]) -> dict[str, NDArray[Any]]:
    """Columns of the tables of rows."""
    carriers_hz, hz = record.carriers_hz, record.frequencies_hz
    if hz is not None and hz[0] != CARRIER_HZ and record.receiver_carriers_hz is None:
        carriers_hz = np.full(len(record), hz[0])
    columns: dict[str, NDArray[Any] | None] = dict(zip("xyz", record.tx_pos_m.T, strict=True))
    columns |= {"heading": record.tx_heading_rad, FREQUENCY: carriers_hz, files.RUN: record.runs, SPLIT: record.folds}
    counts = None if record.n_readings is None else record.n_readings.astype(object)
    if counts is not None:
        counts[counts == 0] = None  # an empty field where nothing was received, as of strength and noise
    for prefix, values in ((RSSI, record.observation), (COUNT, counts), (STD, record.std)):
        if values is not None:
            columns |= {prefix + anchor: received for anchor, received in zip(ids, values, strict=True)}
    return {name: values for name, values in columns.items() if values is not None}


def _writable(path: str | Path, record: Record) -> list[str]:
    """The receivers' ids of a record, checked to fit the layout."""
    text, rows = f"{path}: {record.name} cannot be written in the layout of {RECEIVERS[0]}", np.arange(len(record))
    if record.task != "rssi":
        raise InputError(f"{text}: it needs signal strengths")
    files.refuse_unstated(path, record, "truth", "uplink")
    if record.official is not None:
        files.refuse_unstated(path, record, "folds")
        if not np.array_equal(np.sort(np.concatenate(record.official)), rows) or not all(map(len, record.official)):
            raise InputError(f"{text}: each row must be in one part of the official split, and each part have rows")
    if record.carriers_hz is None and (record.frequencies_hz is None or len(record.frequencies_hz) != 1):
        raise InputError(f"{text}: its carrier is not known; set Record.frequencies_hz to it, [1], Hz")
    files.refuse_runs(path, record)
    numbers = (record.tx_pos_m, np.zeros(0) if record.tx_heading_rad is None else record.tx_heading_rad)
    if not all(np.isfinite(values).all() for values in numbers) or np.isinf(record.observation).any():
        raise InputError(f"{text}: a position, heading or signal strength is not finite; correct or remove its row")
    ids: list[str] = []
    for rx in record.receivers:
        if rx.array_m is not None:
            raise InputError(f"{text}: receiver {rx.name}: it states no array; set Receiver.array_m to None")
        anchor = number if receiver_name(number := rx.name.removeprefix("anchor")) == rx.name else rx.name
        wrong = wrong_id(anchor, ids)
        if not wrong and receiver_name(plain_id(anchor)) != rx.name:
            wrong = "would be read as another"
        if wrong:
            raise InputError(f"{text}: the name of receiver {files.shown(rx.name)} {wrong}; rename it")
        ids.append(anchor)
    return ids


def _receiver_carriers(anchors: files.CsvTable, tables: list[files.CsvTable]) -> FloatArray | None:
    """Carrier of each receiver [n_rx], Hz; None without the column."""
    if FREQUENCY not in anchors.header:
        return None
    for table in tables:
        if FREQUENCY in table.header:
            text = f"{FREQUENCY} is a column of {anchors.path.name}, too; remove one of them"
            raise DataFault(table.path, text, line=1)
    return files.carriers_of(anchors.path, anchors.numbers(FREQUENCY))


def _in_both(column: str, tables: list[files.CsvTable]) -> Any:
    """An optional column of all tables, which all or none must have, concatenated; None where no table has it."""
    having = [table for table in tables if column in table.header]
    for table in tables:
        if having and table not in having:
            text = f"no column {column}, but {having[0].path.name} has one; give it in both files or in neither"
            refuse(DataFault(table.path, text, line=1))
    columns: list[Any] = [files.runs_of(table) if column == files.RUN else table.numbers(column) for table in having]
    if column == FREQUENCY:
        for table, values in zip(having, columns, strict=True):
            files.carriers_of(table.path, values)
    return np.concatenate(columns) if columns else None


def _by_anchor(prefix: str, table: files.CsvTable) -> dict[str, str]:
    """Columns of a table that begin with a prefix, by the anchor that they name."""
    columns: dict[str, str] = {}
    for column in table.header:
        if column.startswith(prefix):
            first = columns.setdefault(plain_id(column.removeprefix(prefix)), column)
            if first != column:
                text = f"{first} and {column} name one anchor; remove one of them"
                refuse(DataFault(table.path, text, line=1))
    return columns


def _of_anchors(
    prefix: str, tables: list[files.CsvTable], ids: list[str], strengths: list[NDArray[np.float32]]
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
    prefix: str, table: files.CsvTable, columns: dict[str, str], ids: list[str], strength: NDArray[np.float32]
) -> FloatArray:
    """Numbers of readings or standard deviations [anchors, rows] of one table."""
    counts = prefix == COUNT
    values = np.stack([table.numbers(columns[anchor], may_be_empty=True) for anchor in ids])
    if counts:
        values[values == 0] = np.nan
    good = values > 0 if not counts else (values > 0) & (values == np.floor(values)) & (values <= MOST_READINGS)
    read = ~(np.isinf(values) | np.isinf(strength))  # the others are refused already
    for row, anchor in np.argwhere((np.where(np.isnan(strength), ~np.isnan(values), ~good) & read).T):
        what = f"{columns[ids[anchor]]} is {files.shown(table.rows[row][table.header.index(columns[ids[anchor]])])}"
        if np.isnan(strength[anchor, row]):
            remedy = f"but {RSSI}{ids[anchor]} is empty; leave it empty, too"
        else:
            remedy = "give the number of readings, 1 to a million" if counts else "give the noise in dB, above 0"
            remedy = f"where {RSSI}{ids[anchor]} is known; {remedy}"
        refuse(DataFault(table.path, f"{what}, {remedy}", row=int(row) + 1))
    return values


def _signal_strength(table: files.CsvTable, ids: list[str], anchors: files.CsvTable) -> NDArray[np.float32]:
    columns = _by_anchor(RSSI, table)
    unknown = sorted(column for anchor, column in columns.items() if anchor not in ids)
    lacking = [anchor for anchor in ids if anchor not in columns]
    if unknown or lacking:
        text = f"{len(columns)} columns {RSSI}*, but {anchors.path.name} has {len(ids)} anchors"
        which = f"{one_line(unknown[0])} belongs to none" if unknown else f"{RSSI}{lacking[0]} is missing"
        remedy = "give one column per anchor, named by its id"
        if not columns and long_columns(table.header):
            remedy = table_text(Table(table.path.name, tuple(table.header)))
        raise DataFault(table.path, f"{text} ({which}); {remedy}")
    return np.stack([table.numbers(columns[anchor], may_be_empty=True) for anchor in ids]).astype(np.float32)
