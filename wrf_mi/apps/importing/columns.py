"""Meaning and unit of each column of a table, guessed from names and values, or stated."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase

import numpy as np

from ...core import DataFault, InputError
from ...core.files import listed, one_line
from ...datasets.unknown import SENT, STRENGTH, long_columns, name_words, preferred
from .files import Table

AFFIXES = ("", "coord", "coordinate", "pos", "position", "loc", "location", "point", "p", "gt", "true", "tag")
"""Words before or after x, y and z in names of coordinates."""
AXES = {"x": "|easting|east|ecoord", "y": "|northing|north|ncoord", "z": "|height"}
NAMES = {
    **{axis: "|".join(f"{affix}{axis}|{axis}{affix}" for affix in AFFIXES) + other for axis, other in AXES.items()},
    "lat": "lat|latitude|gpslat|gpslatitude|currentlatitude",
    "lon": "lon|lng|long|longitude|gpslon|gpslongitude|currentlongitude",
    "floor": "floor|floorid|floornumber|storey|level",
    "heading": "heading|yaw|orientation|bearing|azimuth|course|compass",
    "time": "time|timestamp|ts|datetime|date|rxtime|unixtime|epoch|t|firstseen",
    "run": "run|session|visit|campaign|trajectory|track|walk",
    "split": "split|subset",
    "frequency": "frequency|freq|carrier|carrierfrequency|primaryfrequency|centerfreq|centrefrequency|centerfrequency",
}
"""Names of columns, in small letters without units, blanks and marks."""
MEANINGS = (*NAMES, "id", "rssi", "cell")
QUANTITIES = (
    "rtt",
    "range",
    "distance",
    "dist",
    "tof",
    "rsrq",
    "snr",
    "sinr",
    "std",
    "count",
    "variance",
    "noise",
    "quality",
)
"""Words of columns that hold another quantity of a receiver; the first five are a length or a time."""
RANGES = QUANTITIES[:4]
METRES = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "km": 1e3, "ft": 0.3048, "feet": 0.3048, "inch": 0.0254}
HERTZ = {"hz": 1.0, "khz": 1e3, "mhz": 1e6, "ghz": 1e9}
UNITS = (*METRES, *HERTZ, "deg", "degrees", "rad", "dbm", "mw", "s", "ms", "%")
MARKED_UNIT = re.compile(r"[(\[]\s*([A-Za-z]+|%)\s*[)\]]|[_ ]([A-Za-z]+|%)$")
NEVER_STRENGTHS = frozenset({0.0, 1.0, 100.0, 127.0})
"""Numbers above or at 0 dBm that columns of strengths hold where nothing was heard."""
LOWEST_DBM = -150.0
MAC = re.compile(r"(?:[0-9a-f]{2}[:_-]){5}[0-9a-f]{2}", re.IGNORECASE)
MOST_FLOORS, MOST_SHOWN = 20, 6


@dataclass
class Columns:
    """Columns by meaning.

    Attributes:
        of: name of the column of each meaning, of `MEANINGS`.
        strengths: id of the receiver of each column of strengths of a wide table; empty for a long one.
        others: quantity and id of further columns of single receivers.
        kept: columns of no known meaning.
    """

    of: dict[str, str] = field(default_factory=dict)
    strengths: dict[str, str] = field(default_factory=dict)
    others: dict[str, tuple[str, str]] = field(default_factory=dict)
    kept: list[str] = field(default_factory=list)

    def unit(self, meaning: str) -> str:
        """Unit in the name of a meaning's column, or ""."""
        return unit_of(self.of[meaning]) if meaning in self.of else ""


def unit_of(name: str) -> str:
    """Unit that a column's name ends with, as in ``x_mm`` and ``X (m)``; "" without."""
    units = [(first or second).lower() for first, second in MARKED_UNIT.findall(name)]
    return next((unit for unit in units if unit in UNITS), "")


def parsed_columns(text: str) -> dict[str, str]:
    """Columns by meaning from ``x=X,y=Y,rssi=level``; the name ``-`` means that there is none."""
    pairs = [part.partition("=") for part in text.split(",") if part.strip()]
    for meaning, equals, name in pairs:
        if meaning.strip() not in MEANINGS or not equals or not name.strip():
            text = f"--columns: {one_line(meaning)!r} is not understood; give MEANING=COLUMN with a meaning of"
            raise InputError(f"{text} {', '.join(MEANINGS)}")
    return {meaning.strip(): name.strip() for meaning, _, name in pairs}


def find_columns(table: Table, stated: Mapping[str, str], receivers: Sequence[str] = ()) -> Columns:
    """Meanings of a table's columns.

    Args:
        table: the table.
        stated: columns by meaning that are not guessed; ``-``: there is none.
        receivers: patterns of the columns of strengths, with ``*``.

    Raises:
        InputError: no such column, or none that can be strengths.
    """
    names = list(table.frame.columns)
    # A unit that all fields of a column have stands in its name, where whoever states the column does not know of it.
    with_unit = {MARKED_UNIT.sub("", name).strip(): name for name in names if unit_of(name)}
    stated = {meaning: name if name in names else with_unit.get(name, name) for meaning, name in stated.items()}
    if lacking := set(stated.values()) - {*names, "-"}:
        text = f"no column {one_line(min(lacking))} (columns: {shown_names(names)})"
        raise DataFault(table.files[0][0], f"{text}; correct --columns", line=1)
    of = named_columns([name for name in names if not _in_pattern(name, receivers)], stated)
    free = [name for name in names if name not in of.values()]
    long = None if receivers else _long_columns(names, of)
    columns = Columns(long or of)
    if long is None:
        chosen = _wide_columns(table, free, receivers)
        columns.strengths = dict(zip(chosen, _receiver_ids(chosen), strict=True))
    _sort_others(table, columns)
    return columns


def shown_names(names: Sequence[str]) -> str:
    """The first names of columns, for a message."""
    return one_line(listed(names))


def named_columns(names: Sequence[str], stated: Mapping[str, str]) -> dict[str, str]:
    """Columns by meaning that are stated, or have one of the names in `NAMES`."""
    of = {meaning: name for meaning, name in stated.items() if name != "-"}
    for meaning, words in NAMES.items():
        candidates = [name for name in names if _plain(name) in words.split("|") and name not in of.values()]
        if candidates and meaning not in stated:
            of[meaning] = candidates[0]
    return of


def _long_columns(names: Sequence[str], of: Mapping[str, str]) -> dict[str, str] | None:
    """Columns by meaning of a table with a row for each reading, None for a wide one."""
    alias = {of[meaning]: word for meaning, word in (("id", "bssid"), ("rssi", "rssi")) if meaning in of}
    long = long_columns([alias.get(name, name) for name in names if name in alias or _is_free(name, of)])
    if long is None:
        return None
    receiver, strength = of.get("id", long[0]), of.get("rssi", long[1])
    others = {meaning: name for meaning, name in of.items() if name not in (receiver, strength)}
    return {"id": receiver, "rssi": strength} | others


def _is_free(name: str, of: Mapping[str, str]) -> bool:
    """Whether a column may name the receivers of a long table or hold its strengths."""
    if "rssi" in of and name_words(name) & STRENGTH:
        return False
    # "level" is a strength in tables of Android and a storey elsewhere.
    return name not in of.values() or _plain(name) == "level"


def _wide_columns(table: Table, names: Sequence[str], patterns: Sequence[str]) -> list[str]:
    """Columns of strengths: those of patterns, with words such as RSSI, or with values in dBm."""
    matching = [name for name in table.frame.columns if _in_pattern(name, patterns)]
    named = [name for name in names if name_words(name) & STRENGTH and not name_words(name) & {*QUANTITIES, *SENT}]
    chosen = matching if patterns else _one_quantity(named) or _by_values(table, names)
    if not chosen:
        text = f"no column of signal strengths among {shown_names(list(table.frame.columns))}"
        remedy = "name it by --columns rssi=...,id=... or by --receivers 'PATTERN*'"
        raise DataFault(table.files[0][0], f"{text}; {remedy}", line=1)
    return chosen


def _one_quantity(names: list[str]) -> list[str]:
    """Columns of one quantity where receivers have several: RSRP and RSSI of a cell are not two receivers."""
    by_receiver: dict[str, list[str]] = {}
    for name in names:
        by_receiver.setdefault(_words_beside(name), []).append(name)
    if all(len(columns) == 1 for columns in by_receiver.values()):
        return names
    first = {preferred(columns)[0] for columns in by_receiver.values()}
    return [name for name in names if name in first]


def _sort_others(table: Table, columns: Columns) -> None:
    """Sort further columns into quantities of single receivers and those that are kept."""
    ids = {*columns.strengths.values()} if columns.strengths else {""}
    used = {*columns.of.values(), *columns.strengths}
    for name in table.frame.columns.drop(list(used)):
        quantity = next((word for word in QUANTITIES if word in name_words(name)), None)
        receiver = _receiver_id(name) if columns.strengths else ""
        if quantity and receiver in ids and table.is_numeric(name):
            columns.others[name] = quantity, receiver
        else:
            columns.kept.append(name)


def _by_values(table: Table, names: Sequence[str]) -> list[str]:
    """Columns whose numbers are strengths in dBm or marks of "not heard", and others that are named alike."""
    by_stem: dict[str, list[bool | None]] = {}
    for name in names:
        by_stem.setdefault(_stem(name), []).append(_is_dbm(table, name))
    stems = {stem for stem, verdicts in by_stem.items() if any(verdicts) and False not in verdicts}
    return [name for name in names if _stem(name) in stems and not name_words(name) & set(QUANTITIES)]


def _is_dbm(table: Table, name: str) -> bool | None:
    """Whether a column holds strengths; None where nothing was heard."""
    if not table.is_numeric(name):
        return False
    values = np.unique(table.numbers(name))
    values = values[~np.isnan(values) & ~np.isin(values, list(NEVER_STRENGTHS)) & (values > LOWEST_DBM)]
    return bool(values[-1] < 0) if len(values) else None


def _stem(name: str) -> str:
    """The name without its number; one stem for all hardware addresses."""
    return "MAC address" if MAC.fullmatch(name.strip()) else re.sub(r"\d+", "#", name)


def _in_pattern(name: str, patterns: Sequence[str]) -> bool:
    return any(fnmatchcase(name, pattern.replace("[", "[[]")) for pattern in patterns)


def _plain(name: str) -> str:
    """A name in small letters without unit, blanks and marks."""
    if unit_of(name):
        name = MARKED_UNIT.sub("", name)
    return re.sub("[^a-z0-9]", "", name.lower())


def _receiver_ids(names: Sequence[str]) -> list[str]:
    """Ids of columns of strengths; their names where these differ only in the quantity or its unit."""
    ids = [_receiver_id(name) for name in names]
    return ids if len(set(ids)) == len(ids) else list(names)


def _receiver_id(name: str) -> str:
    """What a column's name has beside the quantity and its unit; the name where nothing is left."""
    return _words_beside(name) or name.strip()


def _words_beside(name: str) -> str:
    words = "|".join({*STRENGTH, *QUANTITIES})
    short = re.sub(r"\(.*?\)|\[.*?\]", " ", name)
    short = re.sub(rf"(?<![a-z])(?:{words})(?![a-z])", " ", short, flags=re.IGNORECASE)
    return re.sub(r"\s+", " ", short).strip(" _.-:")


def described(table: Table, columns: Columns, units: Mapping[str, str]) -> list[str]:
    """Lines of a table: column, meaning, unit and number of values; columns of many receivers in one line."""
    groups = [(meaning, units.get(meaning, ""), [name]) for meaning, name in columns.of.items()]
    groups.append(("strength of a receiver", "dBm", list(columns.strengths)))
    by_quantity: dict[str, list[str]] = {}
    for name, (quantity, _) in columns.others.items():
        by_quantity.setdefault(quantity, []).append(name)
    for quantity, names in by_quantity.items():
        groups.append((f"{quantity} of a receiver, kept", unit_of(names[0]), names))
    groups.append(("kept, not used", "", columns.kept))
    rows = [("column", "meaning", "unit", "values")]
    for meaning, unit, names in groups:
        values = int(table.frame[names].notna().to_numpy().sum())
        rows += [(_named(names), meaning, unit, str(values))] if names else []
    wide = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(f"{cell:<{width}}" for cell, width in zip(row, wide, strict=True)).rstrip() for row in rows]


def _named(names: Sequence[str]) -> str:
    few = len(names) <= MOST_SHOWN
    return one_line(", ".join(names) if few else f"{names[0]} ... {names[-1]} ({len(names)})")
