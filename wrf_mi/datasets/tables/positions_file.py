"""Positions in tables of their own: those of a table's rows, and those of the receivers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ...core import DataFault
from ...core.angles import FloatArray
from ...core.files import one_line
from ..unknown import RECEIVER, name_words
from .columns import MOST_FLOORS, named_columns, shown_names, unit_of
from .files import Table, package
from .places import POSITION_DIGITS, LocalFrame, plane_columns, unit_scale
from .readings import listed, normal_id

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


def receiver_positions(
    table: Table | None, ids: Sequence[str], frame: LocalFrame, units: str, height_m: float
) -> tuple[FloatArray, list[str]]:
    """Positions [n_rx, 3] in the local frame, NaN of receivers that the table lacks, and what was assumed.

    Args:
        table: columns id, x, y, z or id, lat, lon, z; None: all positions are unknown.
        ids: ids of the receivers.
        frame: frame of the rows' positions, in which coordinates without a unit are, too.
        units: unit that was stated for all coordinates, or "".
        height_m: height of receivers without z.

    Raises:
        InputError: no column of ids or positions, or a receiver that is in it twice.
    """
    positions = np.full((len(ids), 3), np.nan)
    if table is None:
        return positions, ["positions of the receivers are unknown, their fields empty; --anchors FILE states them"]
    table = _with_ids(table)
    row_of = _rows_by_id(table)
    stated_m, has_z = _stated_positions(table, frame, units, height_m)
    known = [number for number, name in enumerate(ids) if name in row_of]
    positions[known] = stated_m[[row_of[ids[number]] for number in known]].round(POSITION_DIGITS)
    positions[np.isnan(positions).any(axis=1)] = np.nan
    return positions, _position_notes(table, ids, positions, list(row_of), None if has_z else height_m)


def _stated_positions(table: Table, frame: LocalFrame, units: str, height_m: float) -> tuple[FloatArray, bool]:
    """Positions [rows, 3] of a table of receivers, and whether it states heights."""
    of = named_columns(list(table.frame.columns), {})
    first, second, geographic = plane_columns(of, table)
    if geographic and not frame.crs:
        text = "longitude and latitude, but the positions of the measurements are in metres"
        raise DataFault(table.files[0][0], f"{text}; give both in one reference system", line=1)
    if not frame.crs and (unit := unit_of(first) or units):
        frame = replace(frame, scale_m=unit_scale(unit, "--units"))
    plane_m = frame.local_m(np.column_stack([table.numbers(name) for name in (first, second)]))
    heights_m = np.full(len(table), height_m)
    if "z" in of:
        heights_m = table.numbers(of["z"]) * unit_scale(unit_of(of["z"]) or "m", "--units")
    return np.column_stack([plane_m, heights_m]), "z" in of


def _position_notes(
    table: Table, ids: Sequence[str], positions: FloatArray, stated: Sequence[str], height_m: float | None
) -> list[str]:
    used = {*named_columns(list(table.frame.columns), {}).values(), "id"}
    is_unknown = np.isnan(positions[:, 0])
    groups = {
        "columns that are not used": [name for name in table.frame.columns if name not in used],
        "receivers without position": [name for name, unknown in zip(ids, is_unknown, strict=True) if unknown],
        "receivers that are not in the measurements": sorted(set(stated) - set(ids)),
    }
    notes = [f"{len(names)} {what}: {listed(names)}" for what, names in groups.items() if names]
    notes += [] if height_m is None else [f"no column z: receivers are {height_m:g} m above the floor"]
    return [f"{table.files[0][0].name}: {note}" for note in notes]


def _rows_by_id(table: Table) -> dict[str, int]:
    row_of: dict[str, int] = {}
    for row, text in enumerate(table.frame["id"].astype(str)):
        if (name := normal_id(text)) in row_of:
            raise table.fault(f"receiver {name} stands in row {row_of[name] + 1}, too; remove one of them", row)
        row_of[name] = row
    return row_of


def _with_ids(table: Table) -> Table:
    """A table of receivers whose column of ids is called so; without header its columns are id, x, y and z."""
    names: list[str] = list(table.frame.columns)
    if not table.has_header and len(names) in (3, 4):
        names = ["id", "x", "y", "z"][: len(names)]
    elif "id" not in names:
        matches = (name for word in RECEIVER for name in names if word in name_words(name))
        if (first := next(matches, None)) is None:
            text = f"no column of receivers among {shown_names(names)}"
            raise DataFault(table.files[0][0], f"{text}; give the columns id,x,y,z", line=1)
        names[names.index(first)] = "id"
    return replace(table, frame=table.frame.set_axis(names, axis=1))
