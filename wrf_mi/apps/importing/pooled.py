"""Readings of several quantities, kinds of radio or floors, which are not pooled."""

from __future__ import annotations

import shlex
from typing import Any

from ...core import DataFault
from ...core.files import listed, one_line
from ...datasets.unknown import name_words
from .column_names import unit_of
from .files import Table
from .forms import Columns
from .programs import FLOOR_NAME, RADIOS, ROLES
from .readings import Readings


def refuse_per_cent(table: Table, columns: Columns) -> None:
    """Refuse strengths in per cent, whose scale is that of each program."""
    of = columns.of
    names = [of["rssi"]] if "rssi" in of and not columns.strengths else list(columns.strengths)
    for name in names:
        if unit_of(name) == "%" or name_words(name) & {"quality", "percent"}:
            text = f"{one_line(name)} is in per cent"
            raise DataFault(table.files[0][0], f"{text}; give dBm (in Windows dBm = quality / 2 - 100)")


def refuse_no_dbm(table: Table, readings: Readings) -> None:
    """Refuse strengths of which none is below 0 dBm."""
    if len(readings.dbm) and (lowest := readings.dbm.min()) >= 0:
        text = f"no strength is below 0 dBm ({lowest:g} to {readings.dbm.max():g}): per cent, mW, or without their sign"
        raise DataFault(table.files[0][0], f"{text}; give dBm (in Windows dBm = quality / 2 - 100)")


def refuse_several_kinds(table: Table, columns: Columns, readings: Readings) -> None:
    """Refuse strengths of several kinds of radio, and logs of several floors at one height."""
    if FLOOR_NAME in table.frame and FLOOR_NAME not in columns.of.values():
        floors = table.frame[FLOOR_NAME].dropna().unique()
        if len(floors) > 1:
            text = f"logs are of the floors {one_line(listed(floors))}; give --columns floor={FLOOR_NAME}"
            remedy = f"or one floor by --where {shlex.quote(f'{FLOOR_NAME}={floors[0]}')}"
            raise DataFault(table.files[0][0], f"{text}, {remedy}")
    for name in table.frame.columns:
        values = texts_of_readings(table, name, readings)
        kinds = set(values.str.lower()) if values.nunique() > 1 else {""}
        if kinds <= RADIOS or kinds <= ROLES:
            counts = listed([f"{one_line(text)} ({rows})" for text, rows in values.value_counts().items()])
            text = f"{one_line(name)} is {counts}: these are not pooled"
            remedy = f"choose one by --where {shlex.quote(f'{name}={values.value_counts().index[0]}')}"
            raise DataFault(table.files[0][0], f"{text}; {remedy}")


def texts_of_readings(table: Table, name: str, readings: Readings) -> Any:
    """Texts of a column where it is stated, by the number of the reading."""
    values = table.frame[name].iloc[readings.row].reset_index(drop=True)
    return values[values.notna()].astype(str).str.strip()
