"""Tables in CSV of any separator and decimal mark, with comments or without header, in Parquet, Excel and documents."""

from __future__ import annotations

import io
import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core import DataFault, InputError
from ...core.angles import FloatArray
from ...core.files import listed, one_line, readable
from ...core.memory import require_memory
from ...datasets.folder_files import SINGLE_MAX
from ...datasets.receivers_file import plain_id
from . import fields
from .documents import event_log_of, read_document, read_events, read_messages
from .programs import CELL, POSE_NAMES, QUATERNION, Frame, cell_parts, headerless_form, program_of
from .workbooks import read_sheets

COMMENTS = ("#", "%", "//")
SAMPLE = 50  # lines from which separator and decimal mark are read
TEXT_MEMORY, FIELD_MEMORY = 6, 16  # bytes of memory for each byte of a text file and its lines, and for each field
THIN = "remove columns or thin its rows"
EMPTY = ("-", "--", "?", "not detected", "not heard", "no signal", "n.d.")
"""Fields that are empty beside those that pandas knows (NaN, NA, null, None)."""
MOST_FIELDS = 12  # names of columns that a message has at most
DOCUMENTS = (".json", ".geojson", ".jsonl", ".ndjson", ".yaml", ".yml")
TRY_COLUMNS = "--columns x=X,y=Y,id=BSSID,rssi=RSSI (names of its columns)"
CONVERSIONS = {
    **dict.fromkeys((".kml", ".kmz"), "write its points as a table of readings: lon,lat,bssid,rssi"),
    ".gpx": "write its track as a table time,lat,lon and give it by --positions",
    **dict.fromkeys((".xls", ".xlsb", ".ods", ".numbers"), "save it as .xlsx or .csv"),
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
        columns: columns by meaning that the program tells which wrote the file.
        image: picture in whose pixels positions are, or "".
    """

    frame: Frame
    files: tuple[tuple[Path, int], ...]
    notes: tuple[str, ...] = ()
    has_header: bool = True
    columns: Mapping[str, str] = field(default_factory=dict)
    image: str = ""

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
        numbers = package("pandas").to_numeric(texts, errors="coerce")
        if texts is not values and (numbers.isna() & values.notna()).any():
            plain = fields.plain_numbers(texts.where(values.notna()).dropna()).reindex(texts.index)
            numbers = package("pandas").to_numeric(plain, errors="coerce")
        numbers = numbers.to_numpy(float, na_value=np.nan)
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


def read_table(path: str | Path, sheet: str = "", as_is: bool = False) -> Table:
    """Read a table by its ending: ``.parquet``, ``.xlsx``, a document (``.json``, ``.yaml``), or else text.

    Numbers that all have one unit in their fields, such as ``-65dBm``, are read with that unit in the column's name.

    Args:
        path: the file; ``FILE.xlsx#SHEET`` names a sheet of its own.
        sheet: name of the sheet of a workbook, or first column of one of the tables in a text; "": the only one.
        as_is: whether columns keep the names that the program gave them, where others state their meaning.

    Raises:
        InputError: missing or damaged file, another format, a workbook of several sheets without ``sheet``, rows with
            more or fewer fields than the first, a column named twice, or more fields than memory
            holds.
    """
    workbook, mark, own_sheet = str(path).rpartition("#")
    if mark and workbook.lower().endswith(".xlsx") and not Path(path).exists():
        path, sheet = workbook, own_sheet
    path, pandas = Path(path), package("pandas")
    missing = DataFault(path, "missing; give a file that exists")
    suffix = path.suffix.lower()
    if remedy := CONVERSIONS.get(suffix):
        raise DataFault(path, f"{suffix} is not read as a table; {remedy}, then {TRY_COLUMNS}")
    if suffix == ".parquet":
        package("pyarrow")
        with readable(path, missing, "give a file in the format of .parquet"):
            frame, note = pandas.read_parquet(path, engine="pyarrow"), ""
    elif suffix == ".xlsx":
        package("openpyxl")
        with readable(path, missing, "give a file in the format of .xlsx"):
            sheets = read_sheets(path)
        name = _chosen_sheet(path, {name: len(frame) for name, (frame, _) in sheets.items() if frame.size}, sheet)
        frame, above = sheets[name]
        note = f", sheet {one_line(name)}" * (len(sheets) > 1) + f"; {above} rows above it are left out" * bool(above)
    else:
        return _of_program(_read_text(path, sheet), as_is)
    frame.columns = [str(name).strip() for name in frame.columns]
    _check_names(path, list(frame.columns))
    _check_size(path, len(frame), frame.shape[1])
    table = Table(fields.with_units(frame), ((path, len(frame)),), (f"{path.name}: {len(frame)} rows{note}",))
    return _of_program(table, as_is)


def _of_program(table: Table, as_is: bool) -> Table:
    """A table with the names and meanings of columns that its program tells."""
    frame, file = table.frame, table.files[0][0]
    if not table.has_header and (form := headerless_form(frame)):
        note = f"{file.name}: columns of {form.name}, which has no header"
        frame = frame.set_axis(list(form.columns), axis=1)
        table = replace(table, frame=frame, has_header=True, notes=(*table.notes, note))
    if set(QUATERNION) <= set(frame.columns):
        frame = frame.rename(columns=POSE_NAMES)
    program = program_of(list(frame.columns))
    for column, number in program.unknown.items() if program else ():
        frame = frame.assign(**{column: frame[column].mask(frame[column] == number)})
    if program is not None and not as_is:
        frame = frame.rename(columns=program.new_name)
        notes = (*table.notes, f"{file.name}: columns of {program.name}")
        return replace(table, frame=frame, columns=program.columns, notes=notes)
    if not as_is and (parts := cell_parts(list(frame.columns))):
        complete = frame[parts].notna().all(axis=1)
        texts = frame[parts].astype("string").apply(lambda column: column.str.strip().map(plain_id, na_action="ignore"))
        identity = texts[parts[0]].str.cat(texts[parts[1:]], sep="-").where(complete)
        notes = (*table.notes, f"{file.name}: a cell is told by {', '.join(parts)} together")
        return replace(table, frame=frame.assign(**{CELL: identity}), columns={"id": CELL}, notes=notes)
    return replace(table, frame=frame)


def _chosen_sheet(path: Path, rows: dict[str, int], sheet: str) -> str:
    """The sheet or table that is asked for, or the only one with cells, of those with their number of rows."""
    if sheet in rows or (not sheet and len(rows) == 1):
        return sheet or next(iter(rows))
    named = listed([f"{one_line(name)} ({count} rows)" for name, count in rows.items()])
    what = f"no sheet {one_line(sheet)} with cells" if sheet else "several sheets"
    shown = shlex.quote(max(rows, key=lambda name: rows[name], default="NAME"))
    raise DataFault(path, f"{what} ({named}); choose one by --sheet NAME, such as --sheet {shown}")


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
    notes = tuple(note for table in tables for note in table.notes)
    return replace(first, frame=frame, files=files, notes=notes)


def _check_names(path: Path, names: list[str]) -> None:
    if twice := [name for name, count in Counter(names).items() if count > 1]:
        raise DataFault(path, f"the header has twice the column {one_line(twice[0])}; rename one of them", line=1)


def _check_size(path: Path, rows: int, columns: int) -> None:
    require_memory(FIELD_MEMORY * rows * columns, f"{path}: {rows} rows of {columns} columns", THIN)
    if not rows:
        raise DataFault(path, "no rows; give one per measurement")


def _read_text(path: Path, sheet: str) -> Table:
    """A table of text, whose separator, decimal mark and header are recognised from its first lines."""
    missing = DataFault(path, "missing; give a file that exists")
    with readable(path, missing, "give a table as text (CSV), Parquet (.parquet) or Excel (.xlsx)"):
        encoding, text = _decoded(path)
    if path.suffix.lower() in DOCUMENTS:
        objects, image = read_document(path, text)
        return _of_rows(path, objects, image)
    # Numbers and texts of the lines of rows, after a blank line or not, and the comment above the first of them.
    rows, comment, blank, first = list[tuple[int, str]](), "", False, list[int]()
    for number, line in enumerate(text.split("\n"), start=1):
        plain = line.strip()
        if plain and not plain.startswith(COMMENTS):
            first += [len(rows)] * blank
            rows.append((number, line))
        elif plain and not rows:
            comment = plain
        blank = not plain
    if not rows:
        raise DataFault(path, "empty; give a row per measurement")
    lines = [line for _, line in rows]
    if (log := event_log_of(lines)) is not None:
        return _of_rows(path, read_events(path, text, rows, log))
    if messages := read_messages(lines):
        return _of_rows(path, messages, left_out=len(lines) - len(messages))
    rows, note_of_tables = _chosen_table(path, rows, first, sheet)

    # Separator and decimal mark, without lines above the header.
    separator, above = fields.separator_below([line for _, line in rows[:SAMPLE]])
    rows = rows[above:]
    sample = [fields.split_line(line, separator) for _, line in rows[: SAMPLE - above]]
    decimal = fields.decimal_mark(sample)

    # The header is the first line, the comment above it, or absent.
    header, named = "in its first line", sample[0]
    if fields.is_row(named, decimal):
        header, named = "in a comment", fields.split_line(comment.lstrip("#%/ "), separator)
        if len(named) != len(sample[0]) or fields.is_row(named, decimal):
            header, named = "absent", [str(number + 1) for number in range(len(sample[0]))]
    names = [name.strip() or f"column_{number + 1}" for number, name in enumerate(named)]
    _check_names(path, names)

    # Fields: pandas fills missing ones silently.
    program = program_of(names)
    for index, (number, line) in enumerate(rows) if separator != fields.SPACES else ():
        if (count := line.count(separator) + 1) != len(names) and '"' not in line:
            if program is not None and program.free in names and count > len(names):
                rows[index] = number, _quoted(line, separator, names.index(program.free), count - len(names))
                continue
            text = f"{count} fields, but the first line has {len(names)}"
            shown = one_line(", ".join(names[:MOST_FIELDS]))
            remedy = "correct or remove the line, or write a row for each reading with a header and give"
            raise DataFault(path, f"{text} ({shown}); {remedy} {TRY_COLUMNS}", line=number)
    rows = rows[header == "in its first line" :]
    _check_size(path, len(rows), len(names))
    with readable(path, missing, "correct the line"):
        content = "\n".join(line for _, line in rows)
        options: dict[str, Any] = {"sep": separator, "decimal": decimal, "names": names}
        options |= {"header": None, "index_col": False, "na_values": EMPTY, "skipinitialspace": True}
        frame = package("pandas").read_csv(io.StringIO(content), **options, low_memory=False)
        note_of_marks = ""
        if doubtful := fields.thousandths(frame):
            texts = package("pandas").read_csv(io.StringIO(content), **options, usecols=doubtful, dtype=str)
            frame, note_of_marks = fields.without_groups(path, frame, texts, decimal)

    # What was recognised, in words.
    form = f"separated by {fields.SEPARATORS.get(separator, 'blanks')}" + ", decimal comma" * (decimal == ",")
    form += f", encoding {encoding}" * (encoding != "utf-8-sig")
    note = f"{path.name}: {len(frame)} rows, {form}, header {header}"
    note += f"; {above} lines above it are left out" * bool(above) + note_of_tables + note_of_marks
    return Table(fields.with_units(frame), ((path, len(frame)),), (note,), header != "absent")


def _quoted(line: str, separator: str, column: int, surplus: int) -> str:
    """A line whose field of free text has the separator in it, with this field in quotes."""
    parts = line.split(separator)
    text = separator.join(parts[column : column + surplus + 1]).strip()
    return separator.join([*parts[:column], f'"{text}"', *parts[column + surplus + 1 :]])


def _chosen_table(
    path: Path, rows: list[tuple[int, str]], first: Sequence[int], sheet: str
) -> tuple[list[tuple[int, str]], str]:
    """Rows of one of several tables in a text, and what was left out; ``first`` rows follow a blank line.

    A table begins with a header, which is the first line or follows a blank one.
    """
    headers = {
        row: fields.split_line(rows[row][1], fields.separator_of([rows[row][1]])[0]) for row in sorted({0, *first})
    }
    starts = [
        row
        for row, names in headers.items()
        if row == 0 or (len(names) > 1 and not any(map(fields.NUMBER.fullmatch, names)))
    ]
    if len(headers[0]) == 1:  # lines above the header
        starts = starts[:1]
    ends = [*starts[1:], len(rows)]
    tables = {headers[start][0]: rows[start:end] for start, end in zip(starts, ends, strict=True)}
    counts = {name: len(lines) - 1 for name, lines in tables.items()}
    if len(tables) == 1:
        return rows, ""
    program_sheets = [name for name, lines in tables.items() if program_of(fields.split_line(lines[0][1], ","))]
    name = _chosen_sheet(path, counts, sheet or (program_sheets[0] if program_sheets else ""))
    others = listed([f"{one_line(other)} ({counts[other]} rows)" for other in tables if other != name])
    return tables[name], f"; tables that are left out, by their first column (--sheet): {others}"


def _of_rows(path: Path, rows: Sequence[Mapping[str, Any]], image: str = "", left_out: int = 0) -> Table:
    """A table of rows with named fields, texts of numbers read as numbers."""
    frame = package("pandas").DataFrame(rows)
    for name in frame.columns:
        with suppress(ValueError, TypeError):
            frame[name] = package("pandas").to_numeric(frame[name])
    _check_size(path, len(frame), frame.shape[1])
    note = f"{path.name}: {len(frame)} rows" + f", points of {image}" * bool(image)
    note += f"; {left_out} lines of other topics are left out" * bool(left_out)
    return Table(fields.with_units(frame), ((path, len(frame)),), (note,), image=image)


def _decoded(path: Path) -> tuple[str, str]:
    """Encoding and text of a file in UTF-8, UTF-16 with its mark, or else Windows' code page 1252."""
    require_memory(TEXT_MEMORY * path.stat().st_size, f"{path}", THIN)
    content = path.read_bytes()
    wide = {b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16"}.get(content[:2])
    if wide is None and b"\0" in content[:2]:  # without its mark
        wide = "utf-16-be" if content[:1] == b"\0" else "utf-16-le"
    for encoding in ["utf-8-sig", "cp1252"] if wide is None else [wide]:
        with suppress(UnicodeDecodeError):
            text = content.decode(encoding).replace("\r\n", "\n").replace("\r", "\n")
            return encoding, text.replace(fields.MINUS, "-")
    raise DataFault(path, "not text; save it as UTF-8")
