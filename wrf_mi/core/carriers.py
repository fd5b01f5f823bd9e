"""Rows that were measured at several carriers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .angles import FloatArray
from .types import IntArray

FREQUENCY = "frequency_hz"  # column of a file, or array, with the carrier of each row in Hz
MOST_NAMED = 4  # carriers that a message names one by one; of more, the first and the last


def by_carrier(
    carriers_hz: FloatArray, of_carrier: Callable[[float, IntArray], NDArray[Any]], axis: int = 0
) -> NDArray[Any]:
    """Values of rows, counted by ``axis``, computed carrier by carrier [m], Hz, by ``of_carrier(carrier_hz, rows)``."""
    every = rows_of_carriers(carriers_hz)
    values = np.concatenate([of_carrier(carrier, rows) for carrier, rows in every], axis=axis)
    # Rows came out carrier by carrier; the inverse permutation puts them back.
    return np.take(values, np.argsort(np.concatenate([rows for _, rows in every])), axis=axis)


def rows_of_carriers(carriers_hz: FloatArray) -> list[tuple[float, IntArray]]:
    """Carriers of rows [m], ascending, Hz, and the numbers of the rows at each."""
    return [(float(carrier), np.flatnonzero(carriers_hz == carrier)) for carrier in np.unique(carriers_hz)]


def rows_by_carrier(carriers_hz: FloatArray | None, count: int) -> list[tuple[float | None, IntArray]]:
    """`rows_of_carriers` of ``count`` rows; (None, all) for rows of a single carrier that are given none."""
    return [(None, np.arange(count))] if carriers_hz is None else list(rows_of_carriers(carriers_hz))


def middle_carrier(carriers_hz: FloatArray) -> float:
    """The carrier in the middle of those of rows [m], Hz, at which parameters of materials are stated."""
    distinct = np.unique(carriers_hz)
    return float(distinct[len(distinct) // 2])


def carriers_text(carriers_hz: FloatArray) -> str:
    """Carriers of rows in words, such as ``rows at 2 carriers, 920000000, 2440000000 Hz``."""
    carriers = [f"{carrier:.10g}" for carrier in np.unique(carriers_hz)]
    if len(carriers) == 1:
        return f"rows at {carriers[0]} Hz"
    named = ", ".join(carriers) if len(carriers) <= MOST_NAMED else f"{carriers[0]} to {carriers[-1]}"
    return f"rows at {len(carriers)} carriers, {named} Hz"
