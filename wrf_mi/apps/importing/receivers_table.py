"""Receivers of an import: positions, orientations, antennas and carriers from a table of theirs."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ...core import DataFault, Receiver
from ...core.angles import FloatArray
from ...core.antenna import ANTENNA
from ...core.carriers import FREQUENCY
from ...core.files import listed, one_line
from ...datasets.folder_files import CsvTable
from ...datasets.receivers_file import COLUMNS, TX_COLUMNS, read_antennas, read_orientations, receiver_of
from ...datasets.unknown import RECEIVER, name_words
from .column_names import PIXELS, unit_of
from .files import Table
from .forms import named_columns, shown_names
from .places import POSITION_DIGITS, LocalFrame, plane_columns, unit_scale
from .programs import CELL
from .readings import id_key, normal_id

POSES = tuple(name for name in COLUMNS if name not in ("id", "x", "y", "z", *TX_COLUMNS))
"""Columns of the layout that are taken over as they are: orientation, carrier and antenna."""


def read_receivers(
    table: Table | None, ids: Sequence[str], frame: LocalFrame, units: str, height_m: float
) -> tuple[tuple[Receiver, ...], list[str]]:
    """Receivers with these ids, at NaN where the table lacks them, and what was assumed.

    Args:
        table: columns id, x, y, z or id, lat, lon, z, and those of `POSES`; None: all positions are unknown.
        ids: ids of the receivers.
        frame: frame of the rows' positions, in which coordinates without a unit are, too.
        units: unit that was stated for all coordinates, or "".
        height_m: height of receivers without z.

    Raises:
        InputError: no column of ids or positions, a receiver that is in it twice, or fields that are wrong.
    """
    unknown = {name: receiver_of(name, np.full(3, np.nan), None, ANTENNA) for name in ids}
    if table is None:
        text = "positions of the receivers are unknown, their fields empty; --anchors FILE states them"
        return tuple(unknown.values()), [text]
    measured = _measured(ids)
    table = _measured_cells(table, measured) if CELL in table.frame else _with_ids(table)
    table_receivers = _stated(table, frame, units, height_m, measured)
    if not unknown.keys() & table_receivers.keys():
        text = f"none of its ids ({listed(list(table_receivers))}) is measured ({listed(list(ids))})"
        raise DataFault(table.files[0][0], f"{text}; give the ids of the measurements, or omit --anchors")
    receivers = unknown | {name: receiver for name, receiver in table_receivers.items() if name in unknown}
    notes = _notes(table, receivers, table_receivers)
    if "z" not in named_columns(list(table.frame.columns), {}):
        notes.append(f"{table.files[0][0].name}: no column z, so receivers are {height_m:g} m above the floor")
    return tuple(receivers.values()), notes


def _measured(ids: Sequence[str]) -> dict[str, str]:
    """Ids of the measurements by what anchors may call them: the id, its address, or a part that no other id has."""
    parts = Counter(part for name in ids for part in _parts(name))
    by_part = {part: name for name in ids for part in _parts(name) if parts[part] == 1}
    return by_part | {id_key(name): name for name in ids}


def _measured_cells(table: Table, measured: Mapping[str, str]) -> Table:
    """Rows of a table of cells that are measured, with ids of as many parts as the measurements state.

    Tables of a country have millions of cells.
    """
    numbers = {key.rpartition("-")[2] for key in measured}
    identities = table.frame[CELL].dropna()
    parts = identities[identities.str.rpartition("-")[2].isin(numbers)].str.split("-")
    for count in (4, 3, 2, 1):  # country, network, area and cell, without the first ones
        keys = parts.map(lambda part, count=count: id_key("-".join(part[-count:])))
        chosen = keys[keys.isin(list(measured))]
        if chosen.duplicated().any():
            text = f"cell {chosen[chosen.duplicated()].iloc[0]} is in several areas"
            raise DataFault(table.files[0][0], f"{text}; give the measurements columns mcc, mnc, lac and cellid")
        if len(chosen):
            return replace(table, frame=table.frame.loc[chosen.index].assign(id=chosen))
    named = listed([f"{one_line(name)}" for name in table.frame[CELL].dropna()])
    raise DataFault(table.files[0][0], f"no cell ({named}) is measured ({listed(measured)}); omit --anchors")


def _parts(name: str) -> set[str]:
    """Address and network of a receiver that is named by both, as ``02:00:00:00:00:01;Guest``."""
    return {part for part in re.split(r"\s*[;|]\s*", name) if part}


def _notes(table: Table, receivers: Mapping[str, Receiver], table_receivers: Mapping[str, Receiver]) -> list[str]:
    """What the table lacks, and what of it is not used."""
    of = named_columns(list(table.frame.columns), {})
    used = ["id", *map(of.get, ("x", "y", "z", "lat", "lon")), *POSES]
    lacking = [name for name, receiver in receivers.items() if np.isnan(receiver.position_m).any()]
    groups = {
        "columns that are not used": [name for name in table.frame.columns if name not in used],
        "receivers without position, which train estimates": lacking,
        "receivers that are not in the measurements": [name for name in table_receivers if name not in receivers],
    }
    file = table.files[0][0].name
    return [f"{file}: {what} ({len(names)}): {listed(names)}" for what, names in groups.items() if names]


def _stated(
    table: Table, frame: LocalFrame, units: str, height_m: float, measured: Mapping[str, str]
) -> dict[str, Receiver]:
    """Receivers by name; those of the measurements have the names there, ``measured`` by `id_key`."""
    places = _stated_positions(table, frame, units, height_m).round(POSITION_DIGITS)
    names = [name for name in POSES if name in table.frame]
    fields = table.frame[names].astype(object).where(table.frame[names].notna(), "").astype(str)
    poses = CsvTable(table.files[0][0], names, fields.to_numpy().tolist())
    orientations, carriers = read_orientations(poses), np.full(len(table), np.nan)
    antennas = read_antennas(poses, "", orientations) if names else [ANTENNA] * len(table)
    if FREQUENCY in names:
        carriers = poses.numbers(FREQUENCY, may_be_empty=True)
    receivers: dict[str, Receiver] = {}
    for row, text in enumerate(table.frame["id"].astype(str)):
        name = measured.get(id_key(normal_id(text)), normal_id(text))
        if name in receivers:
            raise table.fault(f"receiver {name} is in an earlier row, too; remove one of them", row)
        hz = None if np.isnan(carriers[row]) else float(carriers[row])
        receivers[name] = receiver_of(name, places[row], orientations[row], antennas[row], hz)
    return receivers


def _stated_positions(table: Table, frame: LocalFrame, units: str, height_m: float) -> FloatArray:
    of = named_columns(list(table.frame.columns), {})
    first, second, geographic = plane_columns(of, table)
    if geographic and not frame.crs:
        text = "longitude and latitude, but the positions of the measurements are in metres"
        raise DataFault(table.files[0][0], f"{text}; give both in one reference system", line=1)
    unit = unit_of(first) or units
    if frame.affine and unit not in PIXELS:  # where the rows are registered to
        frame = LocalFrame(scale_m=unit_scale(unit, "--units"))
    elif not frame.crs and unit and unit not in PIXELS:
        frame = replace(frame, scale_m=unit_scale(unit, "--units"))
    plane_m = frame.local_m(np.column_stack([table.numbers(name) for name in (first, second)]))
    heights_m = np.full(len(table), height_m)
    if "z" in of:
        heights_m = table.numbers(of["z"]) * unit_scale(unit_of(of["z"]) or "m", "--units")
    return np.column_stack([plane_m, heights_m])


def _with_ids(table: Table) -> Table:
    """A table of receivers whose column of ids is called so; without header its columns are id, x, y and z."""
    names: list[str] = list(table.frame.columns)
    if not table.has_header and len(names) in (3, 4):
        names = ["id", "x", "y", "z"][: len(names)]
    elif "id" in names and "name" in names:  # programs that make the id of the name where none is stated
        return replace(table, frame=table.frame.assign(id=table.frame["id"].fillna(table.frame["name"])))
    elif "id" not in names:
        matches = (name for word in RECEIVER for name in names if word in name_words(name))
        if (first := next(matches, None)) is None:
            text = f"no column of receivers among {shown_names(names)}"
            raise DataFault(table.files[0][0], f"{text}; give the columns id,x,y,z", line=1)
        names[names.index(first)] = "id"
    return replace(table, frame=table.frame.set_axis(names, axis=1))
