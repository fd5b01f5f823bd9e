"""Readings of a table: numbers for "not heard", means of places, and other columns."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.angles import FloatArray
from ...core.files import listed, one_line
from ...core.types import IntArray
from ...datasets.receivers_file import plain_id
from ...datasets.sentinels import CUSTOMARY_DBM, suspicious_values
from .files import Table, package
from .forms import MAC, METRES, RANGES, Columns, unit_of

POOLED_READINGS = 4.0
"""Weight, in readings, of all places' variance in that of a place, of which few readings tell little."""
LEAST_STD_DB = 0.05  # noise of a mean of whole dB is not below this
RESERVED = ("x", "y", "z", "heading", "frequency_hz", "run", "split")
PREFIXES = ("rssi_", "count_", "std_")  # columns of the layout, which kept columns must not be taken for
FEWEST_EQUAL = 3
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

    An address may stand beside other words, as in ``02:00:00:00:00:01;Guest``.
    """
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


def chosen(readings: Readings, receivers: IntArray) -> Readings:
    """Readings of some receivers."""
    number = np.full(len(readings.ids), -1)
    number[receivers] = np.arange(len(receivers))
    renumbered = number[readings.receiver]
    part = renumbered >= 0
    ids = tuple(readings.ids[k] for k in receivers)
    return Readings(ids, readings.row[part], renumbered[part], readings.dbm[part])


def further_columns(
    table: Table, columns: Columns, readings: Readings, place: IntArray
) -> tuple[dict[str, NDArray[Any]], list[str]]:
    """Kept columns [places] by name, and what they are in words.

    Numbers are averaged over the rows of a place, lengths in metres; different texts are joined by a bar.
    """
    values: dict[str, NDArray[Any]] = {}
    notes: list[str] = []
    if "time" in columns.of:
        values["time"] = table.frame[columns.of["time"]].to_numpy()[np.unique(place, return_index=True)[1]]
    for name, (quantity, receiver) in columns.others.items():
        numbers, unit = table.numbers(name), ""
        if quantity in RANGES:
            numbers, mark = _without_mark(numbers)
            numbers, unit = numbers * METRES.get(unit_of(name), 1.0), "_m"
            notes += [f"{number:g} is no {quantity}: empty fields" for number in mark]
        means = {receiver: _means(numbers, place)} if receiver else _by_receiver(numbers, readings, place)
        values |= {f"{quantity}_{normal_id(receiver_id)}{unit}": column for receiver_id, column in means.items()}
    values |= {one_line(name): _of_places(table, name, place) for name in columns.kept}
    if values:
        notes.append(f"kept as columns that no model uses: {listed(values)}")
    return {_free(name): column for name, column in values.items()}, list(dict.fromkeys(notes))


def _by_receiver(numbers: FloatArray, readings: Readings, place: IntArray) -> dict[str, FloatArray]:
    places, columns = int(place.max()) + 1, {}
    for number, receiver in enumerate(readings.ids):
        rows = readings.row[readings.receiver == number]
        columns[receiver] = _means(numbers[rows], place[rows], places)
    return columns


def _free(name: str) -> str:
    return f"source_{name}" if name in RESERVED or name.startswith(PREFIXES) else name


def _without_mark(values: FloatArray) -> tuple[FloatArray, list[float]]:
    """Ranges without a number that stands for none: equal in several rows and further away than all others spread."""
    distinct, counts = np.unique(values[~np.isnan(values)], return_counts=True)
    for end, inner in ((-1, slice(None, -1)), (0, slice(1, None))):
        others = distinct[inner]
        if len(others) > 1 and counts[end] >= FEWEST_EQUAL and abs(distinct[end] - others[end]) > np.ptp(others):
            return np.where(values == distinct[end], np.nan, values), [float(distinct[end])]
    return values, []


def _means(values: FloatArray, place: IntArray, places: int | None = None) -> FloatArray:
    """Means over the rows of each place, NaN without a number."""
    known = ~np.isnan(values)
    size = int(place.max()) + 1 if places is None else int(places)
    with np.errstate(invalid="ignore"):
        total = np.bincount(place[known], values[known], minlength=size)
        return np.asarray(total / np.bincount(place[known], minlength=size))


def _of_places(table: Table, name: str, place: IntArray) -> NDArray[Any]:
    """Means of numbers, or the different texts of each place in the order of its rows."""
    if table.is_numeric(name):
        return _means(table.numbers(name), place)
    frame = package("pandas").DataFrame({"place": place, "text": table.frame[name].astype("object")}).dropna()
    frame = frame.drop_duplicates()
    texts = np.full(int(place.max()) + 1, "", object)
    for number, part in frame.groupby("place", sort=False)["text"]:
        texts[number] = SEPARATOR.join(one_line(text) for text in part)
    return texts
