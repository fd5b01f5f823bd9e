"""Columns of slots: the k-th strongest cell of each row, by its identity, as drive-test programs write."""

from __future__ import annotations

import re
from dataclasses import replace

from ...datasets.unknown import RECEIVER, SENT, STRENGTH, name_words
from .columns import MARKED_UNIT, QUANTITIES, unit_of
from .files import Frame, Table, package

DIGITS = re.compile(r"\d+")
FEWEST_SLOTS = 2


def without_slots(table: Table) -> Table:
    """A table with a row for each slot that heard a cell, or the table itself without such columns.

    In ``PCI - 1, RSRP - 1, PCI - 2, RSRP - 2`` slot k holds the k-th strongest cell, which is another one from row to
    row: a receiver is a cell, not a slot. Columns without a slot are repeated.
    """
    slots = _slots(table)
    if not slots:
        return table
    slotted = {name for columns in slots.values() for name in columns.values()}
    shared = table.frame[[name for name in table.frame.columns if name not in slotted]]
    frame: Frame = package("pandas").concat(
        [shared.join(table.frame[list(columns.values())].set_axis(list(columns), axis=1)) for columns in slots.values()]
    )
    identities = [stem for stem in frame.columns if stem not in shared.columns and _names_cell(stem)]
    frame = frame.dropna(subset=identities, how="all").sort_index(kind="stable")
    note = (
        f"{table.files[0][0].name}: {len(slots)} slots of cells in each row, {len(frame)} readings of cells by identity"
    )
    return replace(table, frame=frame, notes=(*table.notes, note))


def _slots(table: Table) -> dict[str, dict[str, str]]:
    """Columns by their name without the slot's number, for each slot with a cell's identity and a strength."""
    slots: dict[str, dict[str, str]] = {}
    for name in table.frame.columns if table.has_header else ():
        if len(numbers := DIGITS.findall(name)) == 1:
            slots.setdefault(numbers[0], {})[_stem(name)] = name
    complete = {
        number: columns
        for number, columns in slots.items()
        if any(map(_names_cell, columns)) and any(map(_is_strength, columns))
    }
    return complete if len(complete) >= FEWEST_SLOTS else {}


def _stem(name: str) -> str:
    """A column's name without the number of its slot and what surrounds it, its unit in brackets behind it."""
    unit = unit_of(name)
    words = DIGITS.sub(" ", MARKED_UNIT.sub("", name) if unit else name)
    stem = re.sub(r"[\s_\-.#:()\[\]]+", " ", words).strip()
    if name_words(stem) & STRENGTH:  # "Cell RSRP" is the RSRP of the cell, whose identity is another column
        stem = " ".join(word for word in stem.split() if word.lower() not in RECEIVER)
    return stem + (f" ({unit})" if unit else "")


def _names_cell(stem: str) -> bool:
    return bool(name_words(stem) & {*RECEIVER} and not name_words(stem) & {*STRENGTH, *QUANTITIES})


def _is_strength(stem: str) -> bool:
    return bool(name_words(stem) & STRENGTH and not name_words(stem) & {*QUANTITIES, *SENT})
