"""Columns of numbers in CSV files, with errors that name the row."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..core import InputError
from ..core.angles import FloatArray
from ..core.files import one_line, text_lines

SINGLE_MAX = float(np.finfo(np.float32).max)
"""Largest number in single precision, in which everything is computed."""


@dataclass(frozen=True)
class CsvTable:
    """A CSV file with a header.

    Attributes:
        path: path of the file, for messages.
        header: names of the columns.
        rows: text of each field, one list per row, each as long as the header.
    """

    path: Path
    header: list[str]
    rows: list[list[str]]

    def numbers(self, column: str, may_be_empty: bool = False) -> FloatArray:
        """Numbers of a column, shape [rows]; an empty field or ``nan`` is NaN if it is allowed.

        Raises:
            InputError: no such column, or a field that is not a finite number, in single precision too.
        """
        return self.numbers_at(self._index(column), column, may_be_empty)

    def texts(self, column: str) -> list[str]:
        """Fields of a column as text.

        Raises:
            InputError: no such column.
        """
        index = self._index(column)
        return [fields[index] for fields in self.rows]

    def _index(self, column: str) -> int:
        if self.header.count(column) != 1:
            what = "has no column" if column not in self.header else "has twice the column"
            text = f"line 1: header {','.join(self.header)[:60]!r} {what} {column}"
            raise InputError(f"{self.path}: {text}; the first line must name each column once")
        return self.header.index(column)

    def numbers_at(self, index: int, what: str, may_be_empty: bool = False) -> FloatArray:
        """Numbers of the column at an index, which messages call ``what``."""
        values = np.full(len(self.rows), np.nan)
        for row, fields in enumerate(self.rows):
            text = fields[index].strip()
            if may_be_empty and text.lower() in ("", "nan"):
                continue
            try:
                values[row] = float(text)
            except ValueError:
                values[row] = np.nan
            if not abs(values[row]) <= SINGLE_MAX:
                remedy = "give a finite number" + (" of single precision" if np.isfinite(values[row]) else "")
                remedy += ", or leave it empty" if may_be_empty else ""
                raise InputError(f"{self.path}: row {row + 1}: {one_line(what)} is {text[:40]!r}; {remedy}")
        return values


def read_csv(path: Path, skip_blank: bool = False) -> CsvTable:
    """Read a CSV file whose first line is its header.

    Args:
        path: path of the file.
        skip_blank: skip blank lines, as pandas does, and count rows without them; otherwise they are refused.

    Raises:
        InputError: missing, not text, without rows, or with a row that has more or fewer fields than the header.
    """
    lines = [line for line in text_lines(path) if line.strip() or not skip_blank]
    if not lines:
        raise InputError(f"{path}: empty; give a header and one row per measurement")
    try:
        header, *rows = csv.reader(lines, strict=True)
    except csv.Error as error:
        raise InputError(f"{path}: not a CSV file ({one_line(error)}); correct it") from None
    if not rows:
        raise InputError(f"{path}: no rows below the header; give one per measurement")
    for row, fields in enumerate(rows, start=1):
        if len(fields) != len(header):
            text = f"{len(fields)} {'field' if len(fields) == 1 else 'fields'}, but the header has {len(header)}"
            raise InputError(f"{path}: row {row}: {text}; correct or remove the row")
    return CsvTable(path, [name.strip() for name in header], rows)


def read_columns(path: Path, *headers: str) -> FloatArray:
    """Numbers [rows, columns] of a CSV file with one of some headers, such as ``x,y,z``.

    Raises:
        InputError: another header, or as `read_csv` and `CsvTable.numbers`.
    """
    table = read_csv(path)
    found = ",".join(table.header)
    if found.lower() not in headers:
        raise InputError(f"{path}: line 1: header is {found[:40]!r}; it must be {' or '.join(headers)}")
    return np.stack([table.numbers_at(index, name) for index, name in enumerate(table.header)], axis=-1)
