"""Columns that are kept but not used: other quantities of receivers, such as ranges, and what has no known meaning."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.angles import FloatArray
from ...core.files import one_line
from ...core.types import IntArray
from .columns import METRES, RANGES, Columns, unit_of
from .files import Table, package
from .readings import Readings, listed, normal_id

RESERVED = ("x", "y", "z", "heading", "frequency_hz", "run", "split")
PREFIXES = ("rssi_", "count_", "std_")
"""Columns of the layout, which kept columns must not be taken for."""
FEWEST_EQUAL = 3
SEPARATOR = "|"


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
        values |= {f"{quantity}_{normal_id(one)}{unit}": column for one, column in means.items()}
    values |= {one_line(name): _of_places(table, name, place) for name in columns.kept}
    if values:
        notes.append(f"kept as columns that no model uses: {listed(list(values))}")
    return {_free(name): column for name, column in values.items()}, list(dict.fromkeys(notes))


def _by_receiver(numbers: FloatArray, readings: Readings, place: IntArray) -> dict[str, FloatArray]:
    """Means of a long table's column for each receiver."""
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
