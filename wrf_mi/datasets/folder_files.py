"""Files shared by several layouts: CSV, positions, index files and YAML, with errors that name the line."""

from __future__ import annotations

import csv
import shutil
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import Antenna, DataFault, InputError, Record, Task
from ..core.angles import UNIT_QUATERNION_TOLERANCE, FloatArray
from ..core.antenna import ANTENNA, pattern_path
from ..core.carriers import FREQUENCY
from ..core.files import listed, one_line, text_lines, write_csv
from ..core.types import IntArray
from .faults import Attempt, attempt, recoverable, refuse, stop_at_faults

POSITIONS = "tx_pos.csv"
AXES = "x,y,z"  # columns of positions, metres
NOT_USED = ("vx", "vy", "vz", "t")  # last columns of `POSITIONS` that are allowed and not read
RUN = "run"  # column with the run of the measurement in which each row was taken: a text without line ends
INDEX_FILES = ("train_index.txt", "test_index.txt")
TX_ANTENNA = "tx_antenna"
ANTENNA_WORDS = ("pattern", "polarization", "frame")
TX_ANTENNA_WORDS = ANTENNA_WORDS[:2]
"""Keys of a transmitter's antenna, whose frame is always the world, turned with the heading."""
SINGLE_MAX = float(np.finfo(np.float32).max)  # largest number in single precision, in which everything is computed
DIGITS = 18  # most digits of a whole number; more may not fit into 64 bits


def data_folder(path: str | Path, content: str) -> Path:
    """The path of a folder; an `InputError` that ends with ``content`` if it is none."""
    folder = Path(path)
    if not folder.is_dir():
        raise DataFault(folder, f"not a folder; give one that holds {content}")
    return folder


def folder_record(folder: Path, name: str | None, task: Task, **parts: Any) -> Record:
    """The record of a folder from its attributes, values or attempted parts, once all of these have been read.

    Raises:
        InputError: the first fault of a part.
    """
    stop_at_faults()
    values = {key: part.value if isinstance(part, Attempt) else part for key, part in parts.items()}
    return Record(name=name or folder.resolve().name, task=task, source=str(folder), **values)


def single_file(path: Path, suffixes: tuple[str, ...], what: str) -> Path:
    """The only file of a folder with one of some suffixes, or the path itself where it is no folder."""
    if not path.is_dir():
        return path
    candidates = sorted(file for file in path.iterdir() if file.suffix in suffixes)
    if len(candidates) != 1:
        names = listed(file.name for file in candidates) or "none"
        raise DataFault(path, f"{what} is read at a time, found {names}; give the file itself")
    return candidates[0]


def finite_numbers(path: Path, what: str, value: object, count: int) -> FloatArray:
    """A list of finite numbers from YAML, shape [count]; an `InputError` for anything else."""
    values = numbers_of(value)
    if values.shape != (count,) or not fits_single(values):
        raise DataFault(path, f"{one_line(what)} is {shown(value)}; give a list of {count} finite numbers")
    return values


def numbers_of(value: object) -> FloatArray:
    """An array of numbers from YAML or from a call; empty where the value is none."""
    try:
        return np.array(value, dtype=float)
    except (TypeError, ValueError, OverflowError):
        return np.empty(0)


def fits_single(values: FloatArray) -> bool:
    """Whether all values are finite in single precision."""
    return bool((np.abs(values) <= SINGLE_MAX).all())


def shown(value: object) -> str:
    """Text of a value for a message, on one line of at most 60 characters."""
    text = one_line(repr(value))
    return text if len(text) <= 60 else f"{text[:60]}..."


def unit_quaternion(path: Path, name: str, value: object) -> FloatArray:
    """An orientation from YAML: a unit quaternion x, y, z, w; an `InputError` for anything else."""
    orientation = finite_numbers(path, f"{name}: orientation", value, 4)
    norm = float(np.linalg.norm(orientation))
    if abs(norm - 1) > UNIT_QUATERNION_TOLERANCE:
        raise DataFault(path, f"{one_line(name)}: quaternion of norm {norm:.4g}; orientation must be a unit x, y, z, w")
    return orientation


def read_antenna(
    path: Path, name: str, value: object, words: tuple[str, ...] = ANTENNA_WORDS, row: int | None = None
) -> Antenna:
    """An antenna from YAML: a mapping with some of ``words``, or None for the default; else an `InputError`.

    A pattern that is a file is relative to the folder of ``path``.
    """
    if value is None:
        return ANTENNA
    if not isinstance(value, dict) or not set(value) <= set(words):
        raise DataFault(path, f"{one_line(name)} is {shown(value)}; give some of {', '.join(words)}", row=row)
    if (pattern := pattern_path(value.get("pattern"), path.parent)) is not None:
        value = {**value, "pattern": str(pattern)}
    try:
        return Antenna(**value)
    except InputError as error:
        text = str(error).removeprefix("antenna: ")
        raise DataFault(path, f"{one_line(name)}: {text}", row=row) from None


def read_tx_antenna(path: Path, info: Mapping[Any, Any]) -> Antenna:
    """The transmitter's antenna, the entry ``tx_antenna`` of a YAML file."""
    return read_antenna(path, TX_ANTENNA, info.get(TX_ANTENNA), TX_ANTENNA_WORDS)


def antenna_words(antenna: Antenna) -> dict[str, str]:
    """Attributes of an antenna as files state them; a measured pattern is a file of `write_patterns`."""
    words = {word: getattr(antenna, word) for word in ANTENNA_WORDS}
    if antenna.measured is not None:
        path = Path(antenna.pattern)
        words["pattern"] = f"{path.stem}-{antenna.digest[:8]}{path.suffix}"  # files of equal names may differ
    return words


def antenna_entry(antenna: Antenna) -> dict[str, str]:
    """Entry for `read_antenna`: the attributes that differ from the default."""
    return {word: value for word, value in antenna_words(antenna).items() if value != getattr(ANTENNA, word)}


def write_patterns(folder: Path, record: Record) -> None:
    """Copy the files of measured patterns into a folder, so that it holds all that its record needs."""
    for antenna in {record.tx_antenna, *(receiver.antenna for receiver in record.receivers)}:
        if antenna.measured is not None:
            shutil.copyfile(antenna.pattern, folder / antenna_words(antenna)["pattern"])


@dataclass(frozen=True)
class CsvTable:
    """A CSV file: names of the columns, and the text of each field, a list per row.

    Rows in ``damaged``, from 0, have more or fewer fields than the header. They are there only while faults are
    collected (`wrf_mi.datasets.faults`).
    """

    path: Path
    header: list[str]
    rows: list[list[str]]
    damaged: frozenset[int] = frozenset()

    def numbers(self, column: str, may_be_empty: bool = False, index: int | None = None) -> FloatArray:
        """Numbers of a column, shape [rows]; an empty field or ``nan`` is NaN if it is allowed.

        With an ``index`` the column is found by it, and ``column`` is its name in messages. While faults are collected,
        damaged rows and fields that are not numbers are infinite.

        Raises:
            InputError: no such column, or a field that is not a finite number, in single precision too.
        """
        index = self._index(column) if index is None else index
        with suppress(ValueError, IndexError):  # columns without a fault, at once: tables have millions of fields
            values = np.array([float(fields[index] or "nan") for fields in self.rows])
            if not self.damaged and ((np.abs(values) <= SINGLE_MAX) | (may_be_empty & np.isnan(values))).all():
                return values
        values = np.full(len(self.rows), np.nan)
        for row, fields in enumerate(self.rows):
            if row in self.damaged:
                values[row] = np.inf
                continue
            text = fields[index].strip()
            if may_be_empty and text.lower() in ("", "nan"):
                continue
            values[row] = _number(text)
            if not abs(values[row]) <= SINGLE_MAX:
                remedy = "give a finite number" + " of single precision" * bool(np.isfinite(values[row]))
                remedy += ", or leave it empty" * may_be_empty
                refuse(DataFault(self.path, f"{one_line(column)} is {text[:40]!r}; {remedy}", row=row + 1))
                values[row] = np.inf
        return values

    def texts(self, column: str) -> list[str]:
        """Fields of a column as text, empty in damaged rows."""
        index = self._index(column)
        return ["" if row in self.damaged else fields[index] for row, fields in enumerate(self.rows)]

    def _index(self, column: str) -> int:
        if self.header.count(column) != 1:
            what = "has no column" if column not in self.header else "has twice the column"
            text = f"header {','.join(self.header)[:60]!r} {what} {column}; the first line must name each column once"
            if len(self.header) == 1 and any(mark in self.header[0] for mark in ";\t|"):
                text += ", separated by commas"
            raise DataFault(self.path, text, line=1)
        return self.header.index(column)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return np.nan


def read_csv(path: Path, skip_blank: bool = False) -> CsvTable:
    """Read a CSV file whose first line is its header.

    Blank lines are refused, or skipped and not counted, as pandas does.

    Raises:
        InputError: missing, not text, without rows, or with a row that has more or fewer fields than the header.
    """
    lines = text_lines(path)
    if skip_blank:
        lines = list(filter(str.strip, lines))
    if not lines:
        raise DataFault(path, "empty; give a header and one row per measurement")
    try:
        header, *rows = csv.reader(lines, strict=True)
    except csv.Error as error:
        raise DataFault(path, f"not a CSV file ({one_line(error)}); correct it") from None
    if not rows:
        raise DataFault(path, "no rows below the header; give one per measurement")
    damaged = [row for row, fields in enumerate(rows) if len(fields) != len(header)]
    for row in damaged:
        text = f"{len(rows[row])} field{'s' * (len(rows[row]) != 1)}, but the header has {len(header)}"
        refuse(DataFault(path, f"{text}; correct or remove the row", row=row + 1))
    return CsvTable(path, list(map(str.strip, header)), rows, frozenset(damaged))


def read_columns(path: Path, *headers: str) -> FloatArray:
    """Numbers [rows, columns] of a CSV file with one of some headers, such as ``x,y,z``.

    Raises:
        InputError: another header, or as `read_csv` and `CsvTable.numbers`.
    """
    table = _read_table(path, headers)
    return np.stack([table.numbers(name, index=index) for index, name in enumerate(table.header)], axis=-1)


def _read_table(path: Path, headers: tuple[str, ...]) -> CsvTable:
    table = read_csv(path)
    header = ",".join(table.header)
    if header.lower() not in headers:
        raise DataFault(path, f"header is {header[:40]!r}; it must be {' or '.join(headers)}", line=1)
    return table


@dataclass(frozen=True)
class PositionTable:
    """Content of `POSITIONS`: positions [n, 3], metres; carriers [n], Hz, and runs [n], None without the column."""

    positions_m: FloatArray
    carriers_hz: FloatArray | None = None
    runs: NDArray[np.str_] | None = None


def read_positions(path: Path, optional: tuple[str, ...] = (FREQUENCY, RUN)) -> PositionTable:
    """Read a CSV file with the header ``x,y,z``, to which optional columns and `NOT_USED` may be added."""
    table = read_csv(path)
    table = replace(table, header=[name.lower() for name in table.header])
    if table.header != [*AXES.split(","), *(name for name in (*optional, *NOT_USED) if name in table.header)]:
        may_follow = f" and then, in this order, any of {', '.join(optional)}" if optional else ""
        raise DataFault(path, f"header is {','.join(table.header)[:40]!r}; it must be {AXES}{may_follow}", line=1)
    positions = np.stack([table.numbers(axis) for axis in AXES.split(",")], axis=-1)
    carriers = carriers_of(path, table.numbers(FREQUENCY)) if FREQUENCY in table.header else None
    return PositionTable(positions, carriers, runs_of(table) if RUN in table.header else None)


def carriers_of(path: Path, carriers_hz: FloatArray) -> FloatArray:
    """Carriers [n] of a file's column `FREQUENCY`; an `InputError` if one is not positive."""
    for row in np.flatnonzero(carriers_hz <= 0):
        text = f"{FREQUENCY} is {carriers_hz[row]:g}; give the carrier in Hz, such as 920e6"
        refuse(DataFault(path, text, row=int(row) + 1))
    return carriers_hz


def runs_of(table: CsvTable) -> NDArray[np.str_]:
    """Runs [rows] of a table's column `RUN`; an `InputError` if one is empty."""
    runs = [text.strip() for text in table.texts(RUN)]
    for row, run in enumerate(runs):
        if not run and row not in table.damaged:
            refuse(DataFault(table.path, f"{RUN} is empty; give the name or number of the run", row=row + 1))
    return np.array(runs)


def refuse_runs(path: str | Path, record: Record) -> None:
    """Refuse to write runs that `runs_of` would read as others."""
    for row, run in enumerate([] if record.runs is None else record.runs.tolist()):
        if not run or run != run.strip() or not run.isprintable():
            text = f"{path}: {record.name}, row {row}: run {shown(run)} does not fit into a field"
            raise InputError(f"{text}; give a text of one line without spaces around it")


def whole_number(path: Path, line: int, text: str) -> int:
    """The whole number from 0 on a line; an `InputError` for anything else."""
    digits = text.strip()
    if not (digits.isascii() and digits.isdecimal()):
        raise DataFault(path, f"{text.strip()[:40]!r} is not a whole number; correct it", line=line)
    if len(digits) > DIGITS:
        raise DataFault(path, f"{digits[:40]!r} has more than {DIGITS} digits; correct it", line=line)
    return int(digits)


def read_official(folder: Path, rows: int, first: int, source: str = POSITIONS) -> tuple[IntArray, IntArray] | None:
    """Training and test rows, from 0, of a folder's index files, which begin with ``first``; None without these files.

    Raises:
        InputError: one of the two is missing, or a line is no row of ``source``, out of range, twice, or in both.
    """
    files = [folder / name for name in INDEX_FILES]
    if not any(file.exists() for file in files):
        return None
    train, test = (attempt(_read_index, path, rows, first, source) for path in files)
    for row in np.intersect1d(train.value, test.value):
        refuse(DataFault(files[1], f"row {row + first} is in {files[0].name} as well; remove it from one of them"))
    return train.value, test.value


def _read_index(path: Path, rows: int, first: int, source: str) -> IntArray:
    line_of_row: dict[int, int] = {}
    lines = text_lines(path)
    for line, text in enumerate(lines, start=1):
        with recoverable():
            row = whole_number(path, line, text)
            if not first <= row < rows + first:
                valid_range = f"{source} has rows {first} to {rows + first - 1}"
                raise DataFault(path, f"row {row} is out of range; {valid_range}", line=line)
            if row in line_of_row:
                text = f"row {row} stands in line {line_of_row[row]} already; remove one of them"
                raise DataFault(path, text, line=line)
            line_of_row[row] = line
    if not lines:
        raise DataFault(path, "no rows in it; give one row number per line")
    return np.array(list(line_of_row), np.int64) - first


def refuse_unstated(path: str | Path, record: Record, *names: str) -> None:
    """Refuse to write a record with one of some attributes, which a layout does not state."""
    for name in names:
        if getattr(record, name) is not None:
            remedy = f"set Record.{name} to None, or use another layout"
            raise InputError(f"{path}: {record.name} has {name}, which this layout does not state; {remedy}")


def write_official(folder: Path, official: tuple[IntArray, IntArray] | None, first: int, digits: int = 1) -> None:
    """Write the index files of an official split, if there is one; `read_official` reads them."""
    for file, rows in zip(INDEX_FILES, official or (), strict=False):
        write_lines(folder / file, [f"{row + first:0{digits}d}" for row in rows])


def write_lines(path: Path, lines: list[str]) -> None:
    """Write lines of text, each with a line end."""
    path.write_text("\n".join([*lines, ""]), encoding="utf-8", newline="\n")


def write_positions(path: Path, stated: PositionTable) -> None:
    """Write positions and carriers to the last digit, and runs; `read_positions` reads them."""
    columns: dict[str, list[Any]] = dict(zip(AXES.split(","), stated.positions_m.astype(float).T.tolist(), strict=True))
    for name, values in ((FREQUENCY, stated.carriers_hz), (RUN, stated.runs)):
        if values is not None:
            columns[name] = values.tolist()
    write_csv(path, columns, zip(*columns.values(), strict=True))


def write_extra(folder: Path, extra: Mapping[str, str | bytes] | None) -> None:
    """Write further files by their paths in a folder."""
    for name, content in (extra or {}).items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)
