"""Carriers of readings: of each row, or of each receiver."""

from __future__ import annotations

import numpy as np

from ...core.angles import FloatArray
from ...core.files import listed, one_line
from .column_names import HERTZ, unit_of
from .files import Table
from .places import finite_columns
from .readings import Readings

BAND = 0.25  # largest relative spread of the channels of one band: 0.14 of Wi-Fi at 5 GHz, while 2.4 and 5 GHz are two


def carriers_of_receivers(carriers_hz: FloatArray, readings: Readings) -> tuple[dict[str, float], list[str]]:
    """Carrier of each receiver, and what was assumed; none where rows have carriers of their own.

    In a scan of Wi-Fi networks each receiver has one. ``carriers_hz`` [rows] are those of the table's rows.
    """
    heard = np.column_stack([readings.receiver, carriers_hz[readings.row]])
    pairs, count = np.unique(heard, axis=0, return_counts=True)
    # Access points change their channels now and then; where carriers are compared, every receiver has several.
    parts = [np.flatnonzero(pairs[:, 0] == number) for number in np.unique(pairs[:, 0])]
    several = [part for part in parts if len(part) > 1]
    one_band = all(np.ptp(pairs[part, 1]) <= BAND * pairs[part, 1].min() for part in several)
    if len(np.unique(pairs[:, 1])) == 1 or 2 * len(several) >= len(parts) or not one_band:
        return {}, []
    most = [pairs[part[np.argmax(count[part])]] for part in parts]
    notes = []
    if several:
        named = listed([readings.ids[int(pairs[part[0], 0])] for part in several])
        text = f"{len(several)} of {len(parts)} receivers changed their channel, and have that of most readings"
        notes.append(f"{text}: {named}")
    return {readings.ids[int(number)]: float(carrier) for number, carrier in most}, notes


def column_hz(table: Table, column: str) -> FloatArray:
    """Carriers in Hz, from the unit of their column or else by their size."""
    values = finite_columns(table, [column])[:, 0]
    if (wrong := values <= 0).any():
        row = int(np.argmax(wrong))
        raise table.fault(f"{one_line(column)} is {values[row]:g}; give the carrier, or --columns frequency=-", row)
    largest = values.max()
    return values * HERTZ.get(unit_of(column), 1e9 if largest < 1e3 else 1e6 if largest < 1e6 else 1.0)
