"""Sheets of workbooks: their header below titles, and merged cells."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from .programs import Frame

MOST_ABOVE = 20  # rows above the header that name the survey
FILLED = 0.8  # least share of the columns that a header names


def read_sheets(path: Path) -> dict[str, tuple[Frame, int]]:
    """The sheets by name, each with the number of rows above its header; every cell of a merged range has its value.

    A name that a header has twice is completed by the cell above it, as in headers of two rows.
    """
    import pandas

    sheets = {}
    with pandas.ExcelFile(path, engine="openpyxl", engine_kwargs={"read_only": False}) as book:
        for name in book.sheet_names:
            _fill_merged(book.book[name])
            cells = pandas.read_excel(book, sheet_name=name, header=None, nrows=MOST_ABOVE).dropna(axis=1, how="all")
            rows = [[None if pandas.isna(cell) else cell for cell in row] for row in cells.to_numpy(object).tolist()]
            above, names = _header(rows)
            if names is None:
                sheets[name] = pandas.read_excel(book, sheet_name=name), 0
                continue
            frame = pandas.read_excel(book, sheet_name=name, header=None, skiprows=above + 1)
            frame = frame.reindex(columns=cells.columns).set_axis(names, axis=1).dropna(how="all")
            sheets[name] = frame.reset_index(drop=True), above
    return sheets


def _fill_merged(sheet: Any) -> None:
    for merged in list(sheet.merged_cells.ranges):
        value = sheet.cell(merged.min_row, merged.min_col).value
        sheet.unmerge_cells(str(merged))
        for row, column in merged.cells:
            sheet.cell(row, column).value = value


def _header(rows: list[list[Any]]) -> tuple[int, list[str] | None]:
    """Number of the first row that names the columns, and the names; None without one."""
    widest = max((sum(cell is not None for cell in row) for row in rows), default=0)
    for number, row in enumerate(rows):
        names = [cell for cell in row if cell is not None]
        if len(names) < max(2, FILLED * widest) or not all(isinstance(name, str) for name in names):
            continue
        above = rows[number - 1] if number else [None] * len(row)
        named = [
            f"{upper} {cell}" if names.count(cell) > 1 and upper is not None else cell or f"column_{index}"
            for index, (upper, cell) in enumerate(zip(above, row, strict=True), start=1)
        ]
        if len(set(named)) == len(named):
            return number, named
    return 0, None
