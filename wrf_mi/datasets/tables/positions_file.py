"""Positions of a table's rows in a table of their own, or in the names of cells."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ...core import DataFault
from ...core.angles import FloatArray
from ...core.files import one_line
from .columns import MOST_FLOORS, named_columns
from .files import Table, package

MOST_OUTSIDE = 0.5  # share of rows outside the time of the positions above which the times are not in one unit
PLACES = ("x", "y", "z", "lat", "lon", "floor", "heading")


def with_positions(values: Table, positions: Table, stated: Mapping[str, str]) -> tuple[Table, str]:
    """A table with the columns of another one that has the positions of its rows, and how they were matched.

    Rows are matched by a column that both tables have (a point's number), by time, between whose entries positions are
    linear, or else by their order, in tables of equal length.

    Raises:
        InputError: the rows cannot be matched.
    """
    positions = _with_names(positions, stated)
    in_values, in_positions = list(values.frame.columns), list(positions.frame.columns)
    of = named_columns(in_positions, {key: name for key, name in stated.items() if name in in_positions})
    new = [of[meaning] for meaning in PLACES if meaning in of]
    time, other_time = named_columns(in_values, {}).get("time"), of.get("time")
    shared = sorted(set(in_positions) & set(in_values) - {*new, time, other_time}, key=in_positions.index)
    if shared and values.has_header and positions.has_header:
        return _looked_up(values, positions, shared[0], new), f"by the column {one_line(shared[0])}"
    if time and other_time:
        return _interpolated(values, time, positions, other_time, new)
    return _row_by_row(values, positions, new), "row by row"


def _row_by_row(values: Table, positions: Table, new: Sequence[str]) -> Table:
    if len(values) != len(positions):
        text = f"{len(positions)} rows for {len(values)} of {values.files[0][0].name}, and no column that both have"
        remedy = "give a position for each row, or a column time or point in both"
        raise DataFault(positions.files[0][0], f"{text}; {remedy}")
    free = values.frame.rename(columns={name: f"value_{name}" for name in values.frame if name in new})
    return replace(values, frame=package("pandas").concat([free, positions.frame[new]], axis=1))


def _with_names(positions: Table, stated: Mapping[str, str]) -> Table:
    """Columns of a file without header that are not stated: x, y, and a third one that is the floor or z."""
    columns = list(positions.frame.columns)
    if positions.has_header or len(columns) not in (2, 3) or set(columns) & set(stated.values()):
        return positions
    names = ["x", "y"]
    if len(columns) == 3:
        third = positions.numbers("3")
        is_floor = bool((third == np.round(third)).all()) and len(np.unique(third)) <= MOST_FLOORS
        names.append("floor" if is_floor else "z")
    return replace(positions, frame=positions.frame.set_axis(names, axis=1), has_header=True)


def _looked_up(values: Table, positions: Table, key: str, new: Sequence[str]) -> Table:
    table = positions.frame[[key, *new]].drop_duplicates()
    if len(twice := table[table[key].duplicated()]):
        text = f"{one_line(key)} {one_line(twice[key].iloc[0])} has two positions; give one row for each"
        raise DataFault(positions.files[0][0], text)
    frame = values.frame.drop(columns=[name for name in new if name in values.frame]).merge(table, "left", on=key)
    return replace(values, frame=frame)


def _interpolated(values: Table, time: str, positions: Table, other: str, new: Sequence[str]) -> tuple[Table, str]:
    at, known = seconds(values, time), seconds(positions, other)
    within = (at >= np.nanmin(known)) & (at <= np.nanmax(known))
    outside = len(at) - np.count_nonzero(within)
    if outside > MOST_OUTSIDE * len(at):
        what = f"its time is outside those of {positions.files[0][0].name}, as those of {outside} rows are"
        raise values.fault(f"{what}; give both in one unit and time zone", int(np.argmin(within)))
    order = np.argsort(known, kind="stable")
    columns = {name: np.interp(at, known[order], positions.numbers(name)[order]) for name in new}
    text = f"; {outside} rows before or after them are left out" if outside else ""
    return replace(values, frame=values.frame.assign(**columns)[within]), f"by time, linear between positions{text}"


def with_cells(table: Table, column: str) -> Table:
    """A table with the columns x, y, and floor if it is stated, from the last numbers in the texts of a column."""
    if column not in table.frame:
        raise DataFault(table.files[0][0], f"no column {one_line(column)}; correct --columns", line=1)
    numbers = table.frame[column].astype(str).str.findall(r"\d+")
    count = int(numbers.str.len().min())
    if count < 2:
        row = int(np.argmin(numbers.str.len()))
        text = f"{one_line(column)} is {str(table.frame[column].iloc[row])[:40]!r}"
        raise table.fault(f"{text}; give a text with the numbers x and y, such as L4-31-2", row)
    names = ["floor", "x", "y"][-count:]
    columns = {name: numbers.str[place - len(names)].astype(float) for place, name in enumerate(names)}
    return replace(table, frame=table.frame.assign(**columns))


def seconds(table: Table, column: str) -> FloatArray:
    """Times of a column in its unit, or in seconds where they are dates."""
    if table.is_numeric(column):
        return table.numbers(column)
    pandas = package("pandas")
    times = pandas.to_datetime(table.frame[column], errors="coerce", format="mixed", utc=True)
    if len(wrong := np.flatnonzero(times.isna().to_numpy())):
        text = f"{one_line(column)} is {str(table.frame[column].iloc[wrong[0]])[:40]!r}"
        raise table.fault(f"{text}; give a time as a number or an ISO date", int(wrong[0]))
    return np.asarray((times - pandas.Timestamp(0, tz="UTC")).dt.total_seconds().to_numpy(float))
