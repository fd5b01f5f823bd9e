"""Forms of tables: how they are recognised, their columns by meaning, and units.

`FORMS` lists the forms, `MEANINGS` the columns that all of them may have, by name and unit. Names are compared in small
letters without unit, blanks and marks (`ColumnName`).
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase

import numpy as np

from ...core import DataFault, InputError
from ...core.files import listed, one_line
from ...datasets.unknown import STRENGTH, long_columns, name_words, preferred
from ...scene.coordinates import is_geographic
from .column_names import DIGITS, LOWEST_DBM, METRES, NEVER_STRENGTHS, PIXELS, QUANTITIES, SERVING, ColumnName, unit_of
from .files import Frame, Table, package
from .programs import MAC

AFFIXES = ("", "coord", "coordinate", "pos", "position", "loc", "location", "point", "p", "gt", "true", "tag")
"""Words before or after x, y and z in names of coordinates."""
AXES = {"x": "|easting|east|ecoord|rechtswert|este", "y": "|northing|north|ncoord|hochwert|norte", "z": "|height"}
MEANINGS = {
    **{axis: "|".join(f"{affix}{axis}|{axis}{affix}" for affix in AFFIXES) + other for axis, other in AXES.items()},
    "lat": "lat|latitude|gpslat|gpslatitude|currentlatitude|latitud|breite|breitengrad",
    "lon": "lon|lng|long|longitude|gpslon|gpslongitude|currentlongitude|longitud|laenge|laengengrad",
    "floor": "floor|floorid|floornumber|storey|level",
    "heading": "heading|yaw|orientation|bearing|azimuth|course|compass",
    "time": "time|timestamp|ts|datetime|date|rxtime|unixtime|epoch|t|firstseen",
    "seen": "lastseen|lastseentimestamp|lastseentime",
    "run": "run|session|visit|campaign|trajectory|track|walk|device|phone|handset|user",
    "split": "split|subset",
    "frequency": "frequency|freq|carrier|carrierfrequency|primaryfrequency|centerfreq|centrefrequency|centerfrequency",
}
"""Names of the columns of each meaning, in all forms."""
STATED = (*MEANINGS, "id", "rssi", "cell")  # meanings of `parsed_columns`
ROWS = "write a row for each reading"
MOST_TEXTS = 0.5  # share of negative numbers above which a text in a column is a fault
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
FEWEST_SLOTS = 2
MOST_SHOWN = 6


@dataclass
class Columns:
    """Columns by meaning.

    Attributes:
        of: name of the column of each meaning, of `STATED`.
        strengths: id of the receiver of each column of strengths of a wide table; empty for a long one.
        kept: further columns.
    """

    of: dict[str, str] = field(default_factory=dict)
    strengths: dict[str, str] = field(default_factory=dict)
    kept: list[str] = field(default_factory=list)

    def unit(self, meaning: str) -> str:
        """Unit in the name of a meaning's column, or ""."""
        return unit_of(self.of[meaning]) if meaning in self.of else ""


def parsed_columns(text: str) -> dict[str, str]:
    """Columns by meaning from ``x=X,y=Y,rssi=level``; the name ``-`` means that there is none."""
    parts = re.split(r",(?=\s*\w+\s*=)", text)  # names may have commas
    pairs = [part.partition("=") for part in parts if part.strip()]
    for meaning, equals, name in pairs:
        if meaning.strip() not in STATED or not equals or not name.strip():
            text = f"--columns: {one_line(meaning)!r} is not understood; give MEANING=COLUMN with a meaning of"
            raise InputError(f"{text} {', '.join(STATED)}")
    return {meaning.strip(): name.strip() for meaning, _, name in pairs}


def find_columns(table: Table, stated: Mapping[str, str], receivers: Sequence[str] = ()) -> Columns:
    """Meanings of a table's columns, by the first of `FORMS` that it has.

    Args:
        table: the table.
        stated: columns by meaning that are not guessed; ``-``: there is none.
        receivers: patterns of the columns of strengths, with ``*``.

    Raises:
        InputError: no such column, or none that can be strengths.
    """
    names = list(table.frame.columns)
    stated = {meaning: name for meaning, name in table.columns.items() if name in names} | dict(stated)
    # A unit that all fields of a column have stands in its name, where whoever states the column does not know of it.
    with_unit = {ColumnName(name).without_unit: name for name in names if unit_of(name)}
    stated = {meaning: name if name in names else with_unit.get(name, name) for meaning, name in stated.items()}
    if lacking := set(stated.values()) - {*names, "-"}:
        text = f"no column {one_line(min(lacking))} (columns: {shown_names(names)})"
        raise DataFault(table.files[0][0], f"{text}; correct --columns", line=1)
    stating = table.frame.columns[table.frame.notna().any()]
    of = named_columns([name for name in stating if not _in_pattern(name, receivers)], stated)
    for columns_of in FORMS.values():
        if (columns := columns_of(table, of, receivers)) is not None:
            columns.kept = list(table.frame.columns.drop([*columns.of.values(), *columns.strengths]))
            _refuse_pooling(table, columns, receivers)
            return columns
    if len(names) == 1:
        raise DataFault(table.files[0][0], f"no table; {ROWS} with a header, such as x,y,bssid,rssi", line=1)
    for name, values in table.frame.drop(columns=list(of.values()), errors="ignore").items():
        is_text = values.dtype.kind not in "biufM"  # one among strengths
        if is_text and package("pandas").to_numeric(values, errors="coerce").lt(0).mean() > MOST_TEXTS:
            table.numbers(name)
    text, suggested = f"no column of signal strengths among {shown_names(names)}", suggested_columns(table, of)
    remedy = f"try --columns {suggested}" if suggested else f"{ROWS}, with strengths in dBm"
    remedy += ", or --receivers 'PATTERN*' for a column of each receiver"
    raise DataFault(table.files[0][0], f"{text}; {remedy}", line=1)


def _refuse_pooling(table: Table, columns: Columns, receivers: Sequence[str]) -> None:
    """Refuse columns of strengths of several receivers, which another column names."""
    if not columns.strengths or receivers:
        return
    strength, of, is_single = next(iter(columns.strengths)), columns.of, len(columns.strengths) == 1
    tellers = [name for name in columns.kept if _tells_receivers(table, name)]
    if not is_single:
        tellers = [name for name in tellers if _has_addresses(table, name) and table.frame[name].nunique() > 1]
    elif not tellers:  # names that differ from row to row at one place
        pair = next((pair for pair in (("x", "y"), ("lon", "lat")) if set(pair) <= of.keys()), ())
        keys = [of[name] for name in (*pair, "time") if name in of] + ([] if pair else _planar(table, of))
        texts = [name for name in columns.kept if table.frame[name].astype(str).str.contains("[A-Za-z]").all()]
        tellers = [name for name in texts if keys and table.frame.groupby(keys)[name].nunique().median() > 1]
    if tellers:
        text = f"{one_line(tellers[0])} has names, {one_line(strength)} strengths"
        suggested = of | {"id": tellers[0], "rssi": strength}
        other = f"--receivers {shlex.quote(strength)}" if is_single else f"--columns run={tellers[0]} (what moved)"
        remedy = f"give --columns {suggested_columns(table, suggested)}, or {one_line(other)}"
        raise DataFault(table.files[0][0], f"{text}: readings of several receivers, or of one; {remedy}", line=1)


def suggested_columns(table: Table, of: Mapping[str, str], meanings: Sequence[str] = ("x", "y", "id", "rssi")) -> str:
    """Text of ``--columns`` for a table, by the values of its columns; "" where a meaning has no likely one.

    Positions are left out where no two columns may be them.
    """
    free = [name for name in table.frame.columns if name not in of.values()]
    numeric = [name for name in free if table.is_numeric(name)]
    texts = [name for name in free if name not in numeric]
    addresses = [name for name in texts if _has_addresses(table, name)]
    tellers = [name for name in texts if _tells_receivers(table, name)]
    repeated = [name for name in texts if 1 < table.frame[name].nunique() < len(table)]
    strengths = [name for name in numeric if _is_dbm(table, name)]
    planar = _planar(table, of)
    likely = {"x": planar, "y": planar[1:], "id": [*addresses, *tellers, *repeated], "rssi": strengths}
    chosen = {meaning: of.get(meaning) or next(iter(likely[meaning]), "") for meaning in meanings}
    if {"x", "y"} <= of.keys() or {"lon", "lat"} <= of.keys() or not (chosen.get("x") and chosen.get("y")):
        chosen = {meaning: name for meaning, name in chosen.items() if meaning not in ("x", "y")}
    elif is_geographic(np.column_stack([table.numbers(chosen[axis]) for axis in "xy"])):  # as most tables order them
        chosen = {{"x": "lat", "y": "lon"}.get(meaning, meaning): name for meaning, name in chosen.items()}
    if not chosen or not all(chosen.values()):
        return ""
    return shlex.quote(one_line(",".join(f"{meaning}={name}" for meaning, name in chosen.items())))


def _planar(table: Table, of: Mapping[str, str]) -> list[str]:
    """Two columns of numbers that may be positions in a plane, by their names or else values; none without."""
    numeric = [name for name in table.frame.columns if name not in of.values() and table.is_numeric(name)]
    for pair in AXIS_WORDS:
        named = [[name for name in numeric if name_words(name) & words] for words in pair]
        if all(named):
            return [max(group, key=lambda name: table.frame[name].nunique()) for group in named]
    names = [name for name in numeric if table.frame[name].nunique() > 1 and not _is_dbm(table, name)]
    names = [name for name in names if not name_words(name) & BESIDE]
    names = [name for name in names if unit_of(name) in ("", *METRES, *PIXELS, "deg", "degrees")]
    for name in names if len(names) > 2 else ():  # counts and times
        values = table.numbers(name)
        if len(names) > 2 and (values == np.round(values)).all() and (np.diff(values) >= 0).all():
            names = [other for other in names if other != name]
    return names[:2] if len(names) > 1 else []


def _has_addresses(table: Table, name: str) -> bool:
    """Whether a column has hardware addresses."""
    texts = table.frame[name].dropna().astype(str).str.strip()
    return bool(texts.str.fullmatch(MAC.pattern, case=False).any())


def _tells_receivers(table: Table, name: str) -> bool:
    """Whether a column has addresses, or several names under a heading of receivers."""
    return _has_addresses(table, name) or (ColumnName(name).is_identity and table.frame[name].nunique() > 1)


def _is_dbm(table: Table, name: str) -> bool | None:
    """Whether a column holds strengths; None where nothing was heard."""
    if not table.is_numeric(name):
        return False
    values = np.unique(table.numbers(name))
    values = values[~np.isnan(values) & ~np.isin(values, list(NEVER_STRENGTHS)) & (values > LOWEST_DBM)]
    return bool(values[-1] < 0) if len(values) else None


def shown_names(names: Sequence[str]) -> str:
    """The first names of columns, for a message."""
    return one_line(listed(names))


def named_columns(names: Sequence[str], stated: Mapping[str, str]) -> dict[str, str]:
    """Columns by meaning that are stated, or have one of the names in `MEANINGS`."""
    of = {meaning: name for meaning, name in stated.items() if name != "-"}
    for meaning, words in MEANINGS.items():
        candidates = [name for name in names if ColumnName(name).plain in words.split("|") and name not in of.values()]
        if candidates and meaning not in stated:
            of[meaning] = candidates[0]
    return of


def _readings(table: Table, of: dict[str, str], patterns: Sequence[str]) -> Columns | None:
    """A row for each reading: a column that names receivers, and one of strengths."""
    if patterns:
        return None

    def is_free(name: str) -> bool:
        """Whether a column may name the receivers or hold the strengths."""
        column = ColumnName(name)
        if "rssi" in of and column.words & STRENGTH:
            return False
        if column.words & STRENGTH and column.words & QUANTITIES and "id" not in of:  # noise in dBm
            return False
        # "level" is a strength in tables of Android and a storey elsewhere.
        return name not in of.values() or column.plain == "level"

    alias = {of[meaning]: word for meaning, word in (("id", "bssid"), ("rssi", "rssi")) if meaning in of}
    names = [alias.get(name, name) for name in table.frame.columns if name in alias or is_free(name)]
    anchors = [name for name in names if "tag" not in name_words(name) or ColumnName(name).is_strength]  # tags move
    if (long := long_columns(anchors) or long_columns(names)) is None:
        return None
    chosen = {"id": of.get("id", long[0]), "rssi": of.get("rssi", long[1])}
    if "id" not in of and "ssid" in name_words(chosen["id"]):  # a network that several access points have
        addresses = [name for name in table.frame.columns if is_free(name) and _has_addresses(table, name)]
        chosen["id"] = addresses[0] if addresses else chosen["id"]
    return Columns(chosen | {meaning: name for meaning, name in of.items() if name not in chosen.values()})


def _by_pattern(table: Table, of: dict[str, str], patterns: Sequence[str]) -> Columns | None:
    """A column for each receiver, whose name a pattern states."""
    return _wide(of, [name for name in table.frame.columns if _in_pattern(name, patterns)])


def _by_name(table: Table, of: dict[str, str], patterns: Sequence[str]) -> Columns | None:
    """A column for each receiver, with a word such as RSSI in its name."""
    names = [name for name in table.frame.columns if name not in of.values() and ColumnName(name).is_strength]
    # Of several quantities of receivers one counts: RSRP and RSSI of a cell are not two receivers.
    by_receiver: dict[str, list[str]] = {}
    for name in names:
        by_receiver.setdefault(ColumnName(name).receiver, []).append(name)
    if any(len(columns) > 1 for columns in by_receiver.values()):
        first = {preferred(columns)[0] for columns in by_receiver.values()}
        names = [name for name in names if name in first]
    return None if patterns else _wide(of, names)


def _by_values(table: Table, of: dict[str, str], patterns: Sequence[str]) -> Columns | None:
    """A column for each receiver, named alike, whose numbers are dBm or marks of "not heard"."""
    by_stem: dict[str, list[bool | None]] = {}
    names = [] if patterns else [name for name in table.frame.columns if name not in of.values()]
    for name in names:
        by_stem.setdefault(ColumnName(name).stem, []).append(_is_dbm(table, name))
    stems = {stem for stem, verdicts in by_stem.items() if any(verdicts) and False not in verdicts}
    columns = map(ColumnName, names)
    return _wide(of, [column.text for column in columns if column.stem in stems and not column.words & QUANTITIES])


def _wide(of: dict[str, str], names: Sequence[str]) -> Columns | None:
    """Columns of a wide table; ids are the names of columns where these differ only in the quantity or its unit."""
    ids = [ColumnName(name).receiver or name.strip() for name in names]
    ids = ids if len(set(ids)) == len(ids) else list(names)
    return Columns(of, dict(zip(names, ids, strict=True))) if names else None


FORMS: Mapping[str, Callable[[Table, dict[str, str], Sequence[str]], Columns | None]] = {
    "readings": _readings,
    "receivers by stated patterns": _by_pattern,
    "receivers by names of columns": _by_name,
    "receivers by values of columns": _by_values,
}
"""Forms in the order of trial, and how their columns are found from meanings that are known and patterns of receivers.

Tables of slots (`without_slots`) become tables of readings first.
"""


def without_slots(table: Table) -> Table:
    """A table with a row for each slot that heard a cell, or the table itself without such columns.

    In ``PCI - 1, RSRP - 1, PCI - 2, RSRP - 2``, as drive-test programs write, slot k holds the k-th strongest cell,
    which is another one from row to row: a receiver is a cell, not a slot. Columns without a slot are repeated.
    """
    columns_of: dict[str, dict[str, str]] = {}
    for name in table.frame.columns if table.has_header else ():
        numbers = DIGITS.findall(name) or ["0"] * bool(name_words(name) & SERVING)
        if len(numbers) == 1:
            columns_of.setdefault(numbers[0], {})[ColumnName(name).without_slot] = name
    slots = [columns for columns in columns_of.values() if _is_slot([*map(ColumnName, columns)])]
    if len(slots) < FEWEST_SLOTS:
        return table
    shared = table.frame.drop(columns=[name for columns in slots for name in columns.values()])
    parts = [shared.join(table.frame[list(columns.values())].set_axis(list(columns), axis=1)) for columns in slots]
    frame: Frame = package("pandas").concat(parts)
    identities = [stem for stem in frame.columns.drop(list(shared)) if ColumnName(stem).is_identity]
    strengths = [stem for stem in frame.columns.drop(list(shared)) if ColumnName(stem).is_strength]
    nameless = int((frame[identities].isna().all(axis=1) & frame[strengths].notna().any(axis=1)).sum())
    frame = frame.dropna(subset=identities, how="all").sort_index(kind="stable")
    note = (
        f"{table.files[0][0].name}: {len(slots)} slots of cells in each row, {len(frame)} readings of cells by identity"
    )
    note += f"; {nameless} without one are left out" * bool(nameless)
    return replace(table, frame=frame, notes=(*table.notes, note))


def _is_slot(columns: Sequence[ColumnName]) -> bool:
    return any(column.is_identity for column in columns) and any(column.is_strength for column in columns)


def _in_pattern(name: str, patterns: Sequence[str]) -> bool:
    return any(fnmatchcase(name, pattern.replace("[", "[[]")) for pattern in patterns)


def described(table: Table, columns: Columns, units: Mapping[str, str]) -> list[str]:
    """Lines of a table: column, meaning, unit and number of values; columns of many receivers in one line."""
    groups = [(meaning, units.get(meaning, ""), [name]) for meaning, name in columns.of.items()]
    groups.append(("strength of a receiver", "dBm", list(columns.strengths)))
    groups.append(("kept, not used", "", columns.kept))
    rows = [("column", "meaning", "unit", "values")]
    for meaning, unit, names in groups:
        values = int(table.frame[names].notna().to_numpy().sum())
        few = len(names) <= MOST_SHOWN
        shown = one_line(", ".join(names) if few else f"{names[0]} ... {names[-1]} ({len(names)})")
        rows += [(shown, meaning, unit, str(values))] if names else []
    wide = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(f"{cell:<{width}}" for cell, width in zip(row, wide, strict=True)).rstrip() for row in rows]
