"""Readings of a table: numbers for "not heard", means of places, and other columns."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.angles import FloatArray
from ...core.files import one_line
from ...core.types import IntArray
from ...datasets.receivers_file import plain_id
from ...datasets.sentinels import CUSTOMARY_DBM, suspicious_values
from .files import Table, package
from .forms import Columns
from .programs import MAC

POOLED_READINGS = 4.0
"""Weight, in readings, of all places' variance in that of a place, of which few readings tell little."""
LEAST_STD_DB = 0.05  # noise of a mean of whole dB is not below this
FEWEST_COMPARED, LEAST_OFFSET_DB, OFFSET_STANDARD_ERRORS = 10, 2.0, 4.0
"""Places and receivers that files share, and the difference of their strengths, from which it is said: one in 16,000
files differs by four standard errors by chance, and a quantisation to whole dB by less than 2 dB."""
CELL_ID = re.compile(r"(\d{3})[-_]?(\d{1,3})[-_](\d+)[-_](\d+)")
RESERVED = ("x", "y", "z", "heading", "frequency_hz", "run", "split")
PREFIXES = ("rssi_", "count_", "std_")  # columns of the layout, which kept columns must not be taken for
SEPARATOR = "|"


@dataclass(frozen=True)
class Readings:
    """Single signal strengths.

    Attributes:
        ids: id of each receiver, a whole number in normal form or a name.
        row: row of the table of each reading [k].
        receiver: number of its receiver [k].
        dbm: its strength [k].
    """

    ids: tuple[str, ...]
    row: IntArray
    receiver: IntArray
    dbm: FloatArray


def normal_id(text: str) -> str:
    """An id as the layout reads it, without slashes, which it refuses."""
    return re.sub(r"[/\\]", "-", plain_id(one_line(text)))


def id_key(name: str) -> str:
    """What ids of one receiver share: the digits of a hardware address in any case and notation, else the id.

    An address may stand beside other words, as in ``02:00:00:00:00:01;Guest``. A cell is told by its country, network,
    area and number, in whatever notation (``310260_7937_20161``).
    """
    if cell := CELL_ID.fullmatch(name.strip()):
        return "-".join(str(int(part)) for part in cell.groups())
    addresses = MAC.findall(name)
    digits = re.sub("[:_-]", "", addresses[0] if len(addresses) == 1 else name).lower()
    return digits if re.fullmatch("[0-9a-f]{12}", digits) else name


def read_readings(table: Table, columns: Columns) -> Readings:
    """All readings of a table that are not empty, in the order of its rows."""
    if "rssi" in columns.of and not columns.strengths:
        dbm, texts = table.numbers(columns.of["rssi"]), table.frame[columns.of["id"]]
        codes, values = package("pandas").factorize(texts)
        ids = [normal_id(str(value)) for value in values]
        wrong = np.flatnonzero((codes < 0) & ~np.isnan(dbm))
        if len(wrong):
            raise table.fault(f"{one_line(columns.of['id'])} is empty; name the receiver of the reading", int(wrong[0]))
        rows = np.flatnonzero(~np.isnan(dbm))
        return _distinct(Readings(tuple(ids), rows, codes[rows].astype(np.int64), dbm[rows]))
    parts = []
    for number, name in enumerate(columns.strengths):
        dbm = table.numbers(name)
        rows = np.flatnonzero(~np.isnan(dbm))
        parts.append((rows, np.full(len(rows), number), dbm[rows]))
    rows, receivers, dbm = (np.concatenate(values) for values in zip(*parts, strict=True))
    names = tuple(normal_id(name) for name in columns.strengths.values())
    return _distinct(Readings(names, rows, receivers, dbm))


def _distinct(readings: Readings) -> Readings:
    """Readings in which receivers with one id (7 and 7.0, AA:BB:... and aa-bb-...) are one, as it is first written."""
    names: dict[str, str] = {}
    for name in readings.ids:
        names.setdefault(id_key(name), name)
    number_of = {key: number for number, key in enumerate(names)}
    number = np.array([number_of[id_key(name)] for name in readings.ids], np.int64)
    return replace(readings, ids=tuple(names.values()), receiver=number[readings.receiver])


def without_not_heard(readings: Readings, stated: Sequence[float] | None) -> tuple[Readings, list[str], list[float]]:
    """Readings without numbers for "not heard", what was found in words, and these numbers.

    Numbers are the ``stated`` ones; for None those apart from all strengths of a receiver or of all together, and
    customary ones (-100, -101, ...) at the lower end of all that adjoin the strengths but are far more frequent.
    """
    notes = []
    if stated is None:
        stated, unclear = _marks(readings)
        for dbm in unclear:
            text = f"{dbm:g} dBm is far more frequent ({np.mean(readings.dbm == dbm):.1%} of all readings)"
            notes.append(f"{text} than the strengths next to it: kept; --not-heard {dbm:g} leaves it out")
    for dbm in stated:
        notes.append(f"{dbm:g} is not heard: {np.count_nonzero(readings.dbm == dbm)} readings are empty fields")
    heard = ~np.isin(readings.dbm, list(stated))
    part = replace(readings, row=readings.row[heard], receiver=readings.receiver[heard], dbm=readings.dbm[heard])
    return part, notes, [float(dbm) for dbm in stated]


def _marks(readings: Readings) -> tuple[list[float], list[float]]:
    """Numbers for "not heard", and numbers that may be strengths clipped at the sensitivity."""
    order = np.argsort(readings.receiver, kind="stable")
    ends = np.searchsorted(readings.receiver[order], np.arange(1, len(readings.ids)))
    apart: set[float] = set()
    unclear: set[float] = set()
    lowest = readings.dbm.min(initial=np.inf)
    for part in [readings.dbm, *np.split(readings.dbm[order], ends)]:
        for value in suspicious_values(part):
            # One receiver's strengths may pile up at -100 dBm by chance, those of all receivers do not.
            customary = value.dbm in CUSTOMARY_DBM and value.dbm == lowest and len(part) == len(readings.dbm)
            (unclear if value.adjoins and not customary else apart).add(value.dbm)
    return sorted(apart), sorted(unclear - apart)


@dataclass(frozen=True)
class Means:
    """Means of the readings of each receiver at each place.

    Attributes:
        dbm: mean strength [n_rx, n], NaN where nothing was received.
        count: number of readings [n_rx, n].
        std: standard deviation of the noise of the mean in dB [n_rx, n], NaN where nothing was received.
    """

    dbm: FloatArray
    count: IntArray
    std: FloatArray


def mean_strengths(readings: Readings, place: IntArray, places: int, average: str) -> Means:
    """Means over the readings of each place, in dB or of the powers in mW.

    The variance of a reading at a place is that of its readings, pooled with the mean variance of all places with the
    weight of four readings (Smyth, Stat. Appl. Genet. Mol. Biol. 3, 2004, with fixed degrees of freedom of the prior).
    """
    shape = (len(readings.ids), places)
    cell = readings.receiver * places + place[readings.row]

    def total(values: FloatArray | None = None) -> NDArray[np.float64]:
        return np.bincount(cell, values, minlength=shape[0] * shape[1]).astype(float)

    count = total()
    with np.errstate(invalid="ignore", divide="ignore"):
        mean_db = total(readings.dbm) / count
        squares = np.nan_to_num(total((readings.dbm - mean_db[cell]) ** 2))
        dbm = mean_db if average == "db" else 10 * np.log10(total(10 ** (readings.dbm / 10)) / count)
        freedom = np.maximum(count - 1, 0)
        pooled = squares.sum() / max(freedom.sum(), 1)
        variance = (squares + POOLED_READINGS * pooled) / (freedom + POOLED_READINGS)
        std = np.where(count > 0, np.maximum(np.sqrt(variance / count), LEAST_STD_DB), np.nan)
    return Means(dbm.reshape(shape), count.reshape(shape).astype(np.int64), std.reshape(shape))


def file_offsets(readings: Readings, place: IntArray, file: IntArray, names: Sequence[str]) -> list[str]:
    """Notes on files whose strengths differ from those of the others by a constant at the same places.

    Args:
        readings: all readings.
        place: number of the place of each row of the table.
        file: number of the file of each row.
        names: names of the files.
    """
    cell, of_file, notes = readings.receiver * (place.max() + 1) + place[readings.row], file[readings.row], list[str]()
    for number, name in enumerate(names) if len(names) > 1 else ():
        in_file = of_file == number
        shared = np.intersect1d(cell[in_file], cell[~in_file])
        means = [
            _means(readings.dbm[part], np.searchsorted(shared, cell[part]), len(shared))
            for part in (in_file & np.isin(cell, shared), ~in_file & np.isin(cell, shared))
        ]
        if len(shared) < FEWEST_COMPARED:
            continue
        difference = means[0] - means[1]
        offset = float(np.median(difference))
        # Standard error of a median of Gaussian differences, by their median absolute deviation (Rousseeuw and Croux,
        # J. Am. Stat. Assoc. 88, 1993).
        error = 1.2533 * 1.4826 * float(np.median(np.abs(difference - offset))) / np.sqrt(len(difference))
        if abs(offset) > max(LEAST_OFFSET_DB, OFFSET_STANDARD_ERRORS * error):
            text = f"{name}: strengths are {offset:+.1f} dB from those of the other files at {len(shared)} equal places"
            notes.append(f"{text}: another sent power or device, pooled here; a column device gives each an offset")
    return notes


def further_columns(table: Table, columns: Columns, place: IntArray) -> dict[str, NDArray[Any]]:
    """Kept columns [places] by name: means of numbers over the rows of a place, its different texts joined by a bar."""
    values: dict[str, NDArray[Any]] = {}
    if "time" in columns.of:
        values["time"] = table.frame[columns.of["time"]].to_numpy()[np.unique(place, return_index=True)[1]]
    for name in columns.kept:
        free = f"source_{name}" if name in RESERVED or name.startswith(PREFIXES) else name
        values[one_line(free)] = _of_places(table, name, place)
    return values


def _means(values: FloatArray, place: IntArray, places: int | None = None) -> FloatArray:
    """Means over the rows of each place, NaN without a number."""
    present = ~np.isnan(values)
    size = int(place.max()) + 1 if places is None else int(places)
    with np.errstate(invalid="ignore"):
        total = np.bincount(place[present], values[present], minlength=size)
        return np.asarray(total / np.bincount(place[present], minlength=size))


def _of_places(table: Table, name: str, place: IntArray) -> NDArray[Any]:
    """Means of numbers, NaN without any, or the different texts of each place in the order of its rows."""
    if table.is_numeric(name):
        return _means(table.numbers(name), place)
    texts = table.frame[name].astype("object").set_axis(place).dropna().map(one_line)
    joined = texts.groupby(level=0).agg(lambda part: SEPARATOR.join(dict.fromkeys(part)))
    return np.asarray(joined.reindex(range(int(place.max()) + 1), fill_value=""), object)
