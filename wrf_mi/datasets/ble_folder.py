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

from .. import tasks
from ..core import DataFault, InputError, Receiver, Record
from ..core.angles import FloatArray
from ..core.carriers import FREQUENCY
from ..core.files import atomic_folder, one_line, write_csv
from ..core.types import IntArray
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
    receiver_of,
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
MOST_READINGS = 10**6  # largest number of readings of a row's mean


def read_ble_folder(path: str | Path, name: str | None = None) -> Record:
    """Read and check a folder in the layout of the BLE data (see ``docs/data.md``).

    Returns:
        A record, by default named after the folder, with ``task="rssi"``: ``observation`` [n_rx, n] in dBm, NaN where
        nothing was received. The rows of ``train.csv``, then those of ``test.csv``, are the official split; in
        ``measurements.csv`` the column ``split`` states that split or spatial folds.

    Raises:
        InputError: anything missing, unreadable or inconsistent; one line with the file and the row.
    """
    folder = files.data_folder(
        path, f"{RECEIVERS[0]}, {TRAINING[0]} and {TEST[0]}, or {RECEIVERS[0]} and {MEASUREMENTS[0]}"
    )
    anchors, *tables = (attempt(files.read_csv, file) for file in _files(folder))
    ids = attempt(read_ids, anchors, complete=True)
    anchors_m = attempt(read_positions, anchors, "xyz", True)
    orientations, receivers_hz = attempt(read_orientations, anchors), attempt(_receiver_carriers, anchors, tables)
    rx_antennas = attempt(read_antennas, anchors, "", orientations)
    tx_antenna = attempt(read_transmitter, anchors)
    plane = attempt(np.concatenate, [attempt(read_positions, table, "xy") for table in tables])
    optional = {column: attempt(_in_both, column, tables) for column in ("z", "heading", FREQUENCY, files.RUN)}
    split = attempt(_read_split, tables)
    strengths = [attempt(_signal_strength, table, ids, anchors) for table in tables]
    observation = attempt(np.concatenate, strengths, 1)
    noise = {kind: attempt(_of_anchors, kind, tables, ids, strengths) for kind in (COUNT, STD)}
    stop_at_faults()
    height, counts = optional["z"].value, noise[COUNT].value
    if height is None:
        logger.info("%s: no column z; all transmitters are taken to be %g m above the floor", folder, TAG_HEIGHT_M)
        height = np.full(len(plane.value), TAG_HEIGHT_M)
    columns = ids.value, anchors_m.value, orientations.value, rx_antennas.value
    record = files.folder_record(
        folder,
        name,
        tasks.RSSI,
        tx_pos_m=np.column_stack([plane.value, height]),
        receivers=tuple(receiver_of(*fields) for fields in zip(*columns, strict=True)),
        observation=observation,
        frequencies_hz=np.array([CARRIER_HZ]),
        tx_heading_rad=optional["heading"],
        tx_antenna=tx_antenna,
        n_readings=None if counts is None else np.nan_to_num(counts).astype(np.int64),
        std=noise[STD],
        runs=optional[files.RUN],
        **split.value,
    )
    return record.at_carriers(optional[FREQUENCY].value).at_receiver_carriers(receivers_hz.value)


def _files(folder: Path) -> list[Path]:
    """File of the receivers and those of the rows: one, or those of training and test rows."""
    rows = (MEASUREMENTS,) if _present(folder, MEASUREMENTS) else (TRAINING, TEST)
    for groups in ((RECEIVERS,), (TRAINING,), (TEST,), (*rows, TRAINING, TEST) if len(rows) == 1 else ()):
        if len(same := _present(folder, *groups)) > 1:
            raise DataFault(folder, f"{same[0]} and {same[1]} state the same; remove one of them")
    # A missing file is reported by the name that goes with those of the others.
    historic = bool(_present(folder, *(names[1:] for names in FILES)))
    return [folder / (_present(folder, names) or [names[historic]])[0] for names in (RECEIVERS, *rows)]


def _present(folder: Path, *groups: tuple[str, ...]) -> list[str]:
    return [name for names in groups for name in names if (folder / name).exists()]


def _read_split(tables: list[files.CsvTable]) -> dict[str, Any]:
    """The attributes ``official`` or ``folds`` of the record."""
    if len(tables) > 1:
        n_train, n_test = (len(table.rows) for table in tables)
        return {"official": (np.arange(n_train), n_train + np.arange(n_test))}
    table = tables[0]
    if SPLIT not in table.header:
        return {}
    texts = table.texts(SPLIT)
    words = np.array([text.strip().lower() for text in texts], object)
    words[list(table.damaged)] = PARTS[0]  # refused already; any word serves there
    if all(map(WHOLE.fullmatch, words)):
        return {"folds": np.unique(words.astype(float), return_inverse=True)[1].reshape(-1).astype(np.int64)}
    for row in np.flatnonzero(~np.isin(words, PARTS)):
        text = f"{SPLIT} is {files.shown(texts[row])}; give train or test, or in all rows a fold's number"
        refuse(DataFault(table.path, text, row=int(row) + 1))
    official = np.flatnonzero(words == PARTS[0]), np.flatnonzero(words == PARTS[1])
    if not all(map(len, official)):
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
        files.write_patterns(part, record)
        files.write_extra(part, extra)
    return Path(path)


def _columns(record: Record, ids: list[str]) -> dict[str, NDArray[Any]]:
    counts = None if record.n_readings is None else record.n_readings.astype(object)
    if counts is not None:
        counts[counts == 0] = None  # an empty field where nothing was received, as of strength and noise
    columns: dict[str, NDArray[Any] | None] = dict(zip("xyz", record.tx_pos_m.T, strict=True))
    columns |= {"heading": record.tx_heading_rad, FREQUENCY: _carriers_hz(record)}
    columns |= {files.RUN: record.runs, SPLIT: record.folds}
    for prefix, values in ((RSSI, record.observation), (COUNT, counts), (STD, record.std)):
        if values is not None:
            columns |= {prefix + anchor: received for anchor, received in zip(ids, values, strict=True)}
    return {name: values for name, values in columns.items() if values is not None}


def _carriers_hz(record: Record) -> FloatArray | None:
    """Carrier of each row where it is not `CARRIER_HZ`; None where the receivers state theirs."""
    hz = record.frequencies_hz
    if hz is None or hz[0] == CARRIER_HZ or record.receiver_carriers_hz is not None:
        return record.carriers_hz
    return np.full(len(record), hz[0])


def _writable(path: str | Path, record: Record) -> list[str]:
    """The receivers' ids of a record, checked to fit the layout."""
    text = f"{path}: {record.name} cannot be written in the layout of {RECEIVERS[0]}"
    if record.task is not tasks.RSSI:
        raise InputError(f"{text}: it needs signal strengths")
    files.refuse_unstated(path, record, "truth", "uplink")
    if record.official is not None:
        files.refuse_unstated(path, record, "folds")
        _check_official(text, record.official, len(record))
    if record.carriers_hz is None and np.asarray(record.frequencies_hz).shape != (1,):
        raise InputError(f"{text}: its carrier is not known; set Record.frequencies_hz to it, [1], Hz")
    files.refuse_runs(path, record)
    heading_rad = np.zeros(0) if record.tx_heading_rad is None else record.tx_heading_rad
    numbers = np.concatenate([record.tx_pos_m.ravel(), heading_rad])
    if not np.isfinite(numbers).all() or np.isinf(record.observation).any():
        raise InputError(f"{text}: a position, heading or signal strength is not finite; correct or remove its row")
    ids: list[str] = []
    for receiver in record.receivers:
        ids.append(_id(text, receiver, ids))
    return ids


def _check_official(text: str, official: tuple[IntArray, IntArray], n: int) -> None:
    if not np.array_equal(np.sort(np.concatenate(official)), np.arange(n)) or not all(map(len, official)):
        raise InputError(f"{text}: each row must be in one part of the official split, and each part have rows")


def _id(text: str, receiver: Receiver, before: list[str]) -> str:
    """Id of a receiver after those ``before``; ``text`` begins messages."""
    if receiver.array_m is not None:
        raise InputError(f"{text}: receiver {receiver.name}: it states no array; set Receiver.array_m to None")
    number = receiver.name.removeprefix("anchor")
    anchor = number if receiver_name(number) == receiver.name else receiver.name
    wrong = wrong_id(anchor, before)
    if not wrong and receiver_name(plain_id(anchor)) != receiver.name:
        wrong = "would be read as another"
    if wrong:
        raise InputError(f"{text}: the name of receiver {files.shown(receiver.name)} {wrong}; rename it")
    return anchor


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
    columns = [_optional_column(column, table) for table in having]
    return np.concatenate(columns) if columns else None


def _optional_column(column: str, table: files.CsvTable) -> NDArray[Any]:
    if column == files.RUN:
        return files.runs_of(table)
    values = table.numbers(column)
    return files.carriers_of(table.path, values) if column == FREQUENCY else values


def _by_anchor(prefix: str, table: files.CsvTable) -> dict[str, str]:
    """Columns of a table that begin with a prefix, by the anchor that they name."""
    columns: dict[str, str] = {}
    for column in table.header:
        if column.startswith(prefix):
            first = columns.setdefault(plain_id(column.removeprefix(prefix)), column)
            if first != column:
                refuse(DataFault(table.path, f"{first} and {column} name one anchor; remove one of them", line=1))
    return columns


def _of_anchors(
    prefix: str, tables: list[files.CsvTable], ids: list[str], strengths: list[NDArray[np.float32]]
) -> FloatArray | None:
    """Numbers of readings or standard deviations [anchors, rows], NaN where nothing was received; None: not stated."""
    columns_by_anchor = [_by_anchor(prefix, table) for table in tables]
    if not any(map(set(ids).intersection, columns_by_anchor)):
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
    remedy = "give the number of readings, 1 to a million" if counts else "give the noise in dB, above 0"
    for row, anchor in np.argwhere((np.where(np.isnan(strength), ~np.isnan(values), ~good) & read).T):
        column, strength_column = columns[ids[anchor]], f"{RSSI}{ids[anchor]}"
        text = f"{column} is {files.shown(table.rows[row][table.header.index(column)])}, "
        if np.isnan(strength[anchor, row]):
            text += f"but {strength_column} is empty; leave it empty, too"
        else:
            text += f"where {strength_column} is known; {remedy}"
        refuse(DataFault(table.path, text, row=int(row) + 1))
    return values


def _signal_strength(table: files.CsvTable, ids: list[str], anchors: files.CsvTable) -> NDArray[np.float32]:
    columns = _by_anchor(RSSI, table)
    unknown = sorted(columns[anchor] for anchor in columns.keys() - ids)
    lacking = [anchor for anchor in ids if anchor not in columns]
    if columns.keys() != set(ids):
        text = f"{len(columns)} columns {RSSI}*, but {anchors.path.name} has {len(ids)} anchors"
        which = f"{one_line(unknown[0])} belongs to none" if unknown else f"{RSSI}{lacking[0]} is missing"
        remedy = "give one column per anchor, named by its id"
        if not columns and long_columns(table.header):
            remedy = table_text(Table(table.path.name, tuple(table.header)))
        raise DataFault(table.path, f"{text} ({which}); {remedy}")
    return np.stack([table.numbers(columns[anchor], may_be_empty=True) for anchor in ids]).astype(np.float32)
