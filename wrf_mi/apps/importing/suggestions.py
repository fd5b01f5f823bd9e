"""Columns that a refused table may mean, for the text of ``--columns`` in a message."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence

import numpy as np

from ...core.files import one_line
from ...datasets.unknown import name_words
from ...scene.coordinates import is_geographic
from .column_names import LOWEST_DBM, METRES, NEVER_STRENGTHS, PIXELS, QUANTITIES, ColumnName, unit_of
from .files import Table
from .programs import MAC

BESIDE = QUANTITIES | {
    "channel",
    "frequency",
    "freq",
    "time",
    "timestamp",
    "speed",
    "accuracy",
    "altitude",
    "id",
    "index",
}
"""Words in the names of columns that are no positions."""
AXIS_WORDS = (
    ({"lat", "latitude"}, {"lon", "lng", "long", "longitude"}),
    ({"x", "east", "easting", "este"}, {"y", "north", "northing", "norte"}),
)
"""Words in the names of columns of both axes."""


def suggested_columns(table: Table, of: Mapping[str, str], meanings: Sequence[str] = ("x", "y", "id", "rssi")) -> str:
    """Text of ``--columns`` for a table, by the values of its columns; "" where a meaning has no likely one.

    Positions are left out where no two columns may be them.
    """
    free = [name for name in table.frame.columns if name not in of.values()]
    numeric = [name for name in free if table.is_numeric(name)]
    texts = [name for name in free if name not in numeric]
    addresses = [name for name in texts if has_addresses(table, name)]
    tellers = [name for name in texts if tells_receivers(table, name)]
    repeated = [name for name in texts if 1 < table.frame[name].nunique() < len(table)]
    strengths = [name for name in numeric if is_dbm(table, name)]
    planar = planar_columns(table, of)
    likely = {"x": planar, "y": planar[1:], "id": [*addresses, *tellers, *repeated], "rssi": strengths}
    chosen = {meaning: of.get(meaning) or next(iter(likely[meaning]), "") for meaning in meanings}
    if {"x", "y"} <= of.keys() or {"lon", "lat"} <= of.keys() or not (chosen.get("x") and chosen.get("y")):
        chosen = {meaning: name for meaning, name in chosen.items() if meaning not in ("x", "y")}
    elif is_geographic(np.column_stack([table.numbers(chosen[axis]) for axis in "xy"])):  # as most tables order them
        chosen = {{"x": "lat", "y": "lon"}.get(meaning, meaning): name for meaning, name in chosen.items()}
    if not chosen or not all(chosen.values()):
        return ""
    return shlex.quote(one_line(",".join(f"{meaning}={name}" for meaning, name in chosen.items())))


def planar_columns(table: Table, of: Mapping[str, str]) -> list[str]:
    """Two columns of numbers that may be positions in a plane, by their names or else values; none without."""
    numeric = [name for name in table.frame.columns if name not in of.values() and table.is_numeric(name)]
    for pair in AXIS_WORDS:
        named = [[name for name in numeric if name_words(name) & words] for words in pair]
        if all(named):
            return [max(group, key=lambda name: table.frame[name].nunique()) for group in named]
    names = [name for name in numeric if table.frame[name].nunique() > 1 and not is_dbm(table, name)]
    names = [name for name in names if not name_words(name) & BESIDE]
    names = [name for name in names if unit_of(name) in ("", *METRES, *PIXELS, "deg", "degrees")]
    for name in names if len(names) > 2 else ():  # counts and times
        values = table.numbers(name)
        if len(names) > 2 and (values == np.round(values)).all() and (np.diff(values) >= 0).all():
            names = [other for other in names if other != name]
    return names[:2] if len(names) > 1 else []


def has_addresses(table: Table, name: str) -> bool:
    """Whether a column has hardware addresses."""
    texts = table.frame[name].dropna().astype(str).str.strip()
    return bool(texts.str.fullmatch(MAC.pattern, case=False).any())


def tells_receivers(table: Table, name: str) -> bool:
    """Whether a column has addresses, or several names under a heading of receivers."""
    return has_addresses(table, name) or (ColumnName(name).is_identity and table.frame[name].nunique() > 1)


def is_dbm(table: Table, name: str) -> bool | None:
    """Whether a column holds strengths; None where nothing was heard."""
    if not table.is_numeric(name):
        return False
    values = np.unique(table.numbers(name))
    values = values[~np.isnan(values) & ~np.isin(values, list(NEVER_STRENGTHS)) & (values > LOWEST_DBM)]
    return bool(values[-1] < 0) if len(values) else None
