"""Signal strengths of transmitters to be located, from a table as `import_measurements` reads it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...core import DataFault
from ...core.angles import FloatArray
from ...core.types import IntArray
from .files import Table, read_table
from .fixes import with_fixes, without_stale
from .forms import Columns, find_columns, without_slots
from .places import LocalFrame, finite_columns, place_numbers, plane_columns, unit_scale
from .readings import mean_strengths, read_readings, without_not_heard


@dataclass(frozen=True)
class ObservedTable:
    """Transmitters of a table: rows of a wide one; of a long one places, or else times, or all rows together.

    Attributes:
        table: the table.
        ids: id of each receiver in normal form.
        dbm: mean strength of each receiver [n_ids, m], NaN where nothing was received.
        xy_m: positions [m, 2] in metres of the frame of the data; None: not stated.
        first_row: first row of each transmitter [m].
        is_long: whether the table has a row for each reading, so that a receiver without one received nothing.
    """

    table: Table
    ids: Sequence[str]
    dbm: FloatArray
    xy_m: FloatArray | None
    first_row: IntArray
    is_long: bool


def read_observed(path: str | Path, facts: Mapping[str, Any]) -> ObservedTable:
    """Read a table; ``facts`` of the import of the data, if any, tell its numbers for "not heard" and its frame.

    Raises:
        InputError: a table or a field that cannot be understood.
    """
    table = without_slots(with_fixes(without_stale(read_table(path), {}), {}))
    try:
        columns = find_columns(table, {})
    except DataFault as fault:  # whose remedies are options of the import
        what, _, _ = fault.text.rpartition("; ")
        remedy = "name the columns RECEIVER_dbm or rssi_RECEIVER, or BSSID and RSSI with a row for each reading"
        raise DataFault(fault.file, f"{what}; {remedy}", line=1) from None
    readings, _, _ = without_not_heard(read_readings(table, columns), facts.get("not_heard_dbm"))
    xy_m, is_long = _positions_m(table, columns, facts.get("frame")), not columns.strengths
    place = _transmitters(table, columns, xy_m) if is_long else np.arange(len(table))
    first_row = np.unique(place, return_index=True)[1]
    dbm = mean_strengths(readings, place, len(first_row), "db").dbm
    return ObservedTable(table, readings.ids, dbm, None if xy_m is None else xy_m[first_row], first_row, is_long)


def _positions_m(table: Table, columns: Columns, frame: Mapping[str, Any] | None) -> FloatArray | None:
    """Positions [rows, 2] in the frame of the import, without one metres from x and y; None: not stated."""
    if not ({"x", "y"} <= columns.of.keys() or {"lon", "lat"} <= columns.of.keys()):
        return None
    *names, geographic = plane_columns(columns.of, table)
    if frame is not None:
        return LocalFrame.from_facts(frame).local_m(finite_columns(table, names))
    if geographic:
        text = "positions in degrees, and the data of the run state no origin; give x, y in its frame, or no positions"
        raise DataFault(table.files[0][0], text, line=1)
    return finite_columns(table, names) * unit_scale(columns.unit("x"), "unit")


def _transmitters(table: Table, columns: Columns, xy_m: FloatArray | None) -> IntArray:
    """Number of the transmitter of each row of a long table."""
    # As the import averages: rows of one place; without positions, those of one scan.
    names = ("z", "floor", "heading", "run") if xy_m is not None else ("time", "run")
    keys = {name: table.frame[columns.of[name]].to_numpy() for name in names if name in columns.of}
    return place_numbers(keys, np.zeros((len(table), 2)) if xy_m is None else xy_m, 0.0)
