"""Tables in CSV of any separator and decimal mark, with comments or without header, in Parquet and Excel."""

from __future__ import annotations

import csv
import re
from collections import Counter
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core import DataFault, InputError
from ...core.angles import FloatArray
from ...core.files import listed, one_line, readable
from ...datasets.folder_files import SINGLE_MAX
from ...datasets.receivers_file import plain_id

Frame = Any  # pandas.DataFrame, which is imported where it is used

COMMENTS = ("#", "%", "//")
SEPARATORS = {";": "semicolons", "\t": "tabs", "|": "bars", ",": "commas"}
"""In the order of trial: a table with a decimal comma has commas in every line, too."""
SPACES = r"\s+"
SAMPLE = 50  # lines from which separator and decimal mark are read
MOST_FIELDS = 300_000_000  # largest number of rows times columns of all files: 2.4 GB of numbers in double precision
EMPTY = ("-", "--", "?")  # fields that are empty beside those that pandas knows (NaN, NA, null, None)
FRACTION = re.compile(r"[+-]?\d*\.\d+(?:[eE][+-]?\d+)?|[+-]?\d+\.")
COMMA_FRACTION = re.compile(r"[+-]?\d+,\d+")
NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?|nan", re.IGNORECASE)
FIELD_UNIT = re.compile(r"([+-]?(?:\d+[.,]?\d*|[.,]\d+)(?:[eE][+-]?\d+)?)\s*([a-zA-Z]{1,7}|%)")
"""A number with its unit, as in ``-65dBm``, ``2437 MHz`` and ``85%``."""
MOST_PREAMBLE = 20  # lines above the header that name the program, the device or the survey
CONVERSIONS = {
    ".json": "write its points as a table with a row for each reading: x,y,bssid,rssi",
    ".geojson": "write its points as a table with a row for each reading: lon,lat,bssid,rssi",
    ".kml": "write its points as a table with a row for each reading: lon,lat,bssid,rssi",
    ".kmz": "write its points as a table with a row for each reading: lon,lat,bssid,rssi",
    ".gpx": "write its track as a table time,lat,lon and give it by --positions",
    ".xls": "save it as .xlsx or .csv",
    ".xlsb": "save it as .xlsx or .csv",
    ".ods": "save it as .xlsx or .csv",
    ".numbers": "save it as .xlsx or .csv",
    **dict.fromkeys((".sqlite", ".db"), "export its table of readings as .csv"),
    **dict.fromkeys((".pcap", ".pcapng", ".cap"), "export time, address and strength of each frame as .csv"),
    **dict.fromkeys((".zip", ".gz", ".7z"), "unpack it"),
}
"""How files of other formats become a table, by their ending."""


def package(name: str) -> Any:
    """A package of the extra ``tables``; an `InputError` that names the extra if it is missing."""
    try:
        return import_module(name)
    except ImportError:
        raise InputError(f"data import needs {name}: pip install '.[tables]'") from None


@dataclass(frozen=True)
class Table:
    """Rows of one file or of several, one after the other.

    Attributes:
        frame: the rows; columns of a file without header are named "1", "2" and so on.
        files: path and number of rows of each file.
        notes: form of each file in words, such as its separator.
        has_header: whether the columns have names.
    """

    frame: Frame
    files: tuple[tuple[Path, int], ...]
    notes: tuple[str, ...] = ()
    has_header: bool = True

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.frame)

    def fault(self, text: str, row: int) -> DataFault:
        """The fault of a row, from 0, with its file and its number there."""
        row = int(self.frame.index[row])  # its number before rows were left out
        for path, rows in self.files:
            if row < rows:
                return DataFault(path, text, row=row + 1)
            row -= rows
        return DataFault(self.files[-1][0], text)

    def numbers(self, column: str) -> FloatArray:
        """Numbers of a column [rows], NaN where empty; an `InputError` for the first field that is no number."""
        values = self.frame[column]
        texts = values if values.dtype.kind in "biuf" else values.astype(str).str.strip()
        numbers = package("pandas").to_numeric(texts, errors="coerce").to_numpy(float, na_value=np.nan)
        wrong = np.isnan(numbers) & values.notna().to_numpy() | (np.abs(numbers) > SINGLE_MAX) & np.isfinite(numbers)
        if wrong.any():
            row = int(np.argmax(wrong))
            text = f"{one_line(column)} is {str(values.iloc[row])[:40]!r}; give a number of single precision"
            raise self.fault(f"{text}, or name another column by --columns", row)
        return np.asarray(numbers)

    def where(self, column: str, text: str) -> NDArray[np.bool_]:
        """Rows [rows] whose field of a column is a text or whole number; an `InputError` without such rows."""
        if column not in self.frame:
            raise DataFault(self.files[0][0], f"no column {one_line(column)}; correct --where", line=1)
        rows = self.frame[column].astype(str).map(plain_id).to_numpy() == plain_id(text)
        if not rows.any():
            raise DataFault(self.files[0][0], f"no row has {one_line(column)} {one_line(text)}; correct --where")
        return np.asarray(rows)

    def is_numeric(self, column: str) -> bool:
        """Whether a column holds numbers, or nothing."""
        try:
            self.numbers(column)
        except InputError:
            return False
        return True


def read_table(path: str | Path, sheet: str = "") -> Table:
    """Read a table by its ending: ``.parquet``, ``.xlsx``, or else text.

    Numbers that all have one unit in their fields, such as ``-65dBm``, are read with that unit in the column's name.

    Args:
        path: the file.
        sheet: name of the sheet of a workbook; "": its only one with cells.

    Raises:
        InputError: missing or damaged file, another format, a workbook of several sheets without ``sheet``, rows with
            more or fewer fields than the first, a column named twice, or more fields than `MOST_FIELDS`.
    """
    path, pandas = Path(path), package("pandas")
    missing = DataFault(path, "missing; give a file that exists")
    suffix = path.suffix.lower()
    if remedy := CONVERSIONS.get(suffix):
        raise DataFault(path, f"{suffix} is not read as a table; {remedy}")
    if suffix == ".parquet":
        package("pyarrow")
        with readable(path, missing, "give a file in the format of .parquet"):
            frame, note = pandas.read_parquet(path, engine="pyarrow"), ""
    elif suffix == ".xlsx":
        package("openpyxl")
        with readable(path, missing, "give a file in the format of .xlsx"):
            sheets = pandas.read_excel(path, sheet_name=None, engine="openpyxl")
        name = _chosen_sheet(path, {name: len(frame) for name, frame in sheets.items() if frame.size}, sheet)
        frame, note = sheets[name], f", sheet {one_line(name)}" * (len(sheets) > 1)
    else:
        return _read_text(path)
    frame.columns = [str(name).strip() for name in frame.columns]
    _check_names(path, list(frame.columns))
    _check_size(path, len(frame), frame.shape[1])
    return Table(_with_units(frame), ((path, len(frame)),), (f"{path.name}: {len(frame)} rows{note}",))


def _chosen_sheet(path: Path, rows: dict[str, int], sheet: str) -> str:
    """The sheet that is asked for, or the only one with cells, of those with their number of rows."""
    if sheet in rows or (not sheet and len(rows) == 1):
        return sheet or next(iter(rows))
    named = listed([f"{one_line(name)} ({count} rows)" for name, count in rows.items()])
    what = f"no sheet {one_line(sheet)} with cells" if sheet else "several sheets"
    raise DataFault(path, f"{what} ({named}); choose one by --sheet NAME")


def _with_units(frame: Frame) -> Frame:
    """Columns of numbers that all have one unit in their fields as numbers, the unit in their names."""
    names = {}
    for name in frame.columns:
        if frame[name].dtype.kind in "biufM" or not frame[name].notna().any():
            continue
        texts = frame[name].dropna().astype(str).str.strip()
        if FIELD_UNIT.fullmatch(texts.iloc[0]) is None:
            continue
        parts = texts.str.extract(f"^{FIELD_UNIT.pattern}$")
        if parts[1].nunique() == 1 and parts[1].notna().all():
            numbers = package("pandas").to_numeric(parts[0].str.replace(",", "."))
            frame = frame.assign(**{name: numbers.reindex(frame.index)})
            unit = parts[1].iloc[0]
            names[name] = name if unit.lower() in name.lower() else f"{name} ({unit})"
    return frame.rename(columns=names)


def joined(tables: list[Table]) -> Table:
    """Rows of several tables with the columns of all, empty where a table lacks one."""
    first = tables[0]
    if len(tables) == 1:
        return first
    files = tuple(file for table in tables for file in table.files)
    starts = np.cumsum([0, *(rows for _, rows in files)])  # numbers of rows count those that were left out
    frames = [table.frame.set_axis(table.frame.index + start) for table, start in zip(tables, starts, strict=False)]
    frame = package("pandas").concat(frames)
    _check_size(files[-1][0], len(frame), frame.shape[1])
    return Table(frame, files, tuple(note for table in tables for note in table.notes), first.has_header)


def _check_names(path: Path, names: list[str]) -> None:
    if twice := [name for name, count in Counter(names).items() if count > 1]:
        raise DataFault(path, f"the header has twice the column {one_line(twice[0])}; rename one of them", line=1)


def _check_size(path: Path, rows: int, columns: int) -> None:
    if rows * columns > MOST_FIELDS:
        text = f"{rows} rows of {columns} columns are more than the {MOST_FIELDS} fields that fit into memory"
        raise DataFault(path, f"{text}; remove columns or thin its rows")
    if not rows:
        raise DataFault(path, "no rows; give one per measurement")


@dataclass
class _Lines:
    """A text file: numbers of its lines without a row, its first rows, the comment above them, and its length.

    ``numbers`` are those of the first rows' lines, ``preamble`` those of lines above the header.
    """

    encoding: str
    numbers: list[int] = field(default_factory=list)
    preamble: list[int] = field(default_factory=list)
    skipped: list[int] = field(default_factory=list)
    sample: list[str] = field(default_factory=list)
    comment: str = ""
    count: int = 0

    @property
    def first(self) -> int:
        """Number of the line of the first row."""
        return self.numbers[0]


def _read_text(path: Path) -> Table:
    missing = DataFault(path, "missing; give a file that exists")
    with readable(path, missing, "give a table as text (CSV), Parquet (.parquet) or Excel (.xlsx)"):
        lines = _scan(path)
    if not lines.sample:
        raise DataFault(path, "empty; give a row per measurement")
    separator = _without_preamble(lines)
    rows = [_fields(line, separator) for line in lines.sample]
    decimal = _decimal_mark(rows)
    has_header, named = _header(lines, rows[0], separator, decimal)
    names = [name.strip() or f"column_{number + 1}" for number, name in enumerate(named)]
    _check_names(path, names)
    skipped = [*lines.skipped, *lines.preamble]
    skipped += [lines.first] if has_header == "in its first line" else []
    _check_size(path, lines.count - len(skipped), len(names))
    _check_widths(path, lines, separator, len(names))
    with readable(path, missing, "correct the line"):
        frame = package("pandas").read_csv(
            path,
            **{"sep": separator, "decimal": decimal, "encoding": lines.encoding, "skiprows": skipped},
            **{"header": None, "names": names, "index_col": False, "na_values": EMPTY},
            **{"skipinitialspace": True, "low_memory": False},
        )
    form = f"separated by {SEPARATORS.get(separator, 'blanks')}" + ", decimal comma" * (decimal == ",")
    form += f", encoding {lines.encoding}" * (lines.encoding != "utf-8-sig")
    note = f"{path.name}: {len(frame)} rows, {form}, header {has_header or 'absent'}"
    if lines.preamble:
        note += f"; {len(lines.preamble)} lines above it are left out"
    return Table(_with_units(frame), ((path, len(frame)),), (note,), bool(has_header))


def _header(lines: _Lines, first: list[str], separator: str, decimal: str) -> tuple[str, list[str]]:
    """Where the header is, "" without one, and the names of the columns."""
    if not _is_row(first, decimal):
        return "in its first line", first
    commented = _fields(lines.comment.lstrip("#%/ "), separator)
    if len(commented) == len(first) and not _is_row(commented, decimal):
        return "in a comment", commented
    return "", [str(number + 1) for number in range(len(first))]


def _scan(path: Path) -> _Lines:
    """Lines of a text file in UTF-8, UTF-16 with its mark, or else Windows' code page 1252."""
    with path.open("rb") as stream:
        marked = stream.read(2) in (b"\xff\xfe", b"\xfe\xff")
    for encoding in ["utf-16"] if marked else ["utf-8-sig", "cp1252"]:
        try:
            return _scan_as(path, encoding)
        except UnicodeDecodeError:
            continue
    raise DataFault(path, "not text; save it as UTF-8")


def _scan_as(path: Path, encoding: str) -> _Lines:
    lines = _Lines(encoding)
    with path.open(encoding=encoding) as stream:
        for number, line in enumerate(stream):
            text = line.strip()
            if not text or text.startswith(COMMENTS):
                lines.skipped.append(number)
                lines.comment = text if text and not lines.sample else lines.comment
            elif len(lines.sample) < SAMPLE:
                lines.numbers.append(number)
                lines.sample.append(line.rstrip("\n"))
            lines.count = number + 1
    return lines


def _check_widths(path: Path, lines: _Lines, separator: str, columns: int) -> None:
    """Refuse a line with more or fewer fields than the first: pandas fills missing fields silently."""
    if separator == SPACES:
        return
    skipped = {*lines.skipped, *lines.preamble}
    with path.open(encoding=lines.encoding) as stream:
        for number, line in enumerate(stream):
            fields = line.count(separator) + 1
            if fields != columns and number not in skipped and '"' not in line:
                text = f"{fields} fields, but the first line has {columns}; correct or remove the line"
                raise DataFault(path, text, line=number + 1)


def _fields(line: str, separator: str) -> list[str]:
    if separator == SPACES:
        return line.split()
    return [field.strip() for field in next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])]


def _without_preamble(lines: _Lines) -> str:
    """The separator of a file; lines above its header, which have other numbers of fields, leave the sample."""
    separator = _separator(lines.sample)
    for first in range(1, min(MOST_PREAMBLE, len(lines.sample) - 2) + 1):
        if separator[1]:
            break
        after = _separator(lines.sample[first:])
        fields = _fields(lines.sample[first], after[0])
        if after[1] and not _is_row(fields, "."):  # where a row begins the rest, a row before it is damaged
            lines.preamble, lines.numbers, lines.sample = (
                lines.numbers[:first],
                lines.numbers[first:],
                lines.sample[first:],
            )
            separator = after
    return separator[0]


def _separator(sample: list[str]) -> tuple[str, bool]:
    """The first separator with the same number of fields in all lines, or else that of most fields; and which."""
    most = ("", 1)
    for separator in (*SEPARATORS, SPACES):
        counts = {len(_fields(line, separator)) for line in sample}
        if len(counts) == 1 and counts != {1}:
            return separator, True
        if separator != SPACES and min(counts) > most[1]:
            most = separator, min(counts)
    return most[0] or ",", False


def _decimal_mark(rows: list[list[str]]) -> str:
    fields = [field for row in rows for field in row]
    with_comma = any(COMMA_FRACTION.fullmatch(field) for field in fields)
    return "," if with_comma and not any(FRACTION.fullmatch(field) for field in fields) else "."


def _is_row(fields: list[str], decimal: str) -> bool:
    """Whether fields are measurements rather than names: all numbers, or one of them negative or with decimals."""
    fields = [field.replace(decimal, ".") for field in fields if field]
    numbers = [field for field in fields if NUMBER.fullmatch(field)]
    return len(numbers) == len(fields) or any(field[0] == "-" or FRACTION.fullmatch(field) for field in numbers)
