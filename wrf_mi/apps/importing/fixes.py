"""Readings that were received earlier than they were written, and positions in rows of their own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...core.angles import FloatArray
from .column_names import ColumnName
from .files import Table
from .forms import named_columns
from .places import PLACES, seconds, ticks
from .programs import MAC

STALE_S = 2.0  # readings that are older when written are of another place: walkers go three metres in that time
CLOCKS_S = 86_400.0  # largest median age of one clock: phones state times since their start, too


def without_stale(table: Table, stated: Mapping[str, str]) -> Table:
    """A table without readings that a phone repeats from an earlier scan: their column ``last_seen`` is 2 s ago.

    The time of the others becomes that when they were received.
    """
    of = named_columns(list(table.frame.columns), dict(stated))
    if not {"time", "seen"} <= of.keys():
        return table
    written, last_seen = (seconds(table, of[name], may_be_empty=True) for name in ("time", "seen"))
    age_s = (written - last_seen) / ticks(written)
    file, name = table.files[0][0].name, of["seen"]
    if np.isfinite(age_s).any() and abs(float(np.nanmedian(age_s))) > CLOCKS_S:
        return replace(table, notes=(*table.notes, f"{file}: {name} is of another clock than {of['time']}: not used"))
    stale = age_s > STALE_S
    note = f"{file}: {np.count_nonzero(stale)} of {np.isfinite(last_seen).sum()} readings were cached, older than"
    times = np.where(np.isfinite(last_seen), last_seen, written)[~stale]
    frame = table.frame[~stale].assign(**{of["time"]: times})
    return replace(table, frame=frame, notes=(*table.notes, f"{note} {STALE_S:g} s ({name}): left out"))


def with_fixes(table: Table, stated: Mapping[str, str]) -> Table:
    """A table whose readings have the positions of other rows, interpolated in time, and without rows of no fix.

    Latitude and longitude 0, 0 are no fix.
    """
    names = list(table.frame.columns)
    told = {meaning: name for meaning, name in {**table.columns, **stated}.items() if name in (*names, "-")}
    of = named_columns(names, told)
    pair = next((names for names in (("x", "y"), ("lon", "lat")) if set(names) <= of.keys()), None)
    if pair is None or not all(table.is_numeric(of[name]) for name in pair):
        return table
    xy = np.column_stack([table.numbers(of[name]) for name in pair])
    if pair == ("lon", "lat"):
        xy[(xy == 0).all(axis=1)] = np.nan
    is_fix = np.asarray(np.isfinite(xy).all(axis=1))
    if is_fix.all():
        return table
    heard, file = _heard(table, of), table.files[0][0].name
    # Where most readings have a position of their own, a row without one is a fault, and one without strengths a place
    # where nothing was received.
    if "time" in of and (is_fix & ~heard).any() and np.count_nonzero(heard & ~is_fix) > np.count_nonzero(heard) / 2:
        return _interpolated(table, of, is_fix, heard)
    if pair == ("x", "y") or not is_fix.any():
        return table
    note = f"{file}: {np.count_nonzero(~is_fix)} rows have no fix (0, 0 or empty {of['lat']}): left out"
    return replace(table, frame=table.frame[is_fix], notes=(*table.notes, note))


def _heard(table: Table, of: Mapping[str, str]) -> NDArray[np.bool_]:
    """Rows with a strength."""
    free = table.frame.columns.drop(list(of.values()))
    names = [name for name in free if ColumnName(name).is_strength or MAC.fullmatch(name.strip())]
    names += [of[meaning] for meaning in ("rssi",) if meaning in of]
    return np.asarray(table.frame[names].notna().any(axis=1).to_numpy(bool))


def _interpolated(table: Table, of: Mapping[str, str], is_fix: NDArray[np.bool_], heard: NDArray[np.bool_]) -> Table:
    """Readings at positions between those of the rows with a fix, of each run; those before or after are left out."""
    time_s = seconds(table, of["time"], may_be_empty=True)
    runs = table.frame[of["run"]].astype(str).to_numpy() if "run" in of else np.full(len(table), "")
    names = [of[meaning] for meaning in PLACES if meaning in of and meaning not in ("floor", "heading")]
    values: dict[str, FloatArray] = {name: table.numbers(name).copy() for name in names}
    floors = table.frame[of["floor"]].to_numpy(object).copy() if "floor" in of else np.array([])
    within, gap = np.zeros(len(table), bool), 0.0
    for run in np.unique(runs):
        fixes = np.flatnonzero((runs == run) & is_fix & np.isfinite(time_s))
        fixes = fixes[np.argsort(time_s[fixes], kind="stable")]
        rows = np.flatnonzero((runs == run) & heard)
        if not len(fixes):
            continue
        within[rows] = (time_s[rows] >= time_s[fixes[0]]) & (time_s[rows] <= time_s[fixes[-1]])
        gap = max(gap, float(np.diff(time_s[fixes]).max(initial=0.0)))
        if "floor" in of:  # that of the fix before
            floors[rows] = floors[fixes[np.searchsorted(time_s[fixes], time_s[rows], side="right").clip(1) - 1]]
        for name in names:
            values[name][rows] = np.interp(time_s[rows], time_s[fixes], values[name][fixes])
    text = f"{table.files[0][0].name}: positions are in rows of their own ({np.count_nonzero(is_fix & ~heard)}): linear"
    text += f" between them in time, at most {gap / ticks(time_s):.3g} s apart"
    if outside := int(np.count_nonzero(heard & ~within)):
        text += f"; {outside} readings before or after them are left out"
    floor_column = {of["floor"]: floors} if "floor" in of else {}
    return replace(table, frame=table.frame.assign(**values, **floor_column)[within], notes=(*table.notes, text))
