"""Numbers for "not heard" among signal strengths.

Such a number, as -200, -100 or 100 dBm, differs from measured strengths in that many rows have exactly the same one, at
an end of the distribution. Either nothing lies near it, or it adjoins the weakest strengths, as those do that are
clipped at the sensitivity; then the data do not tell which of the two it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..core.angles import FloatArray
from ..core.types import IntArray

IMPOSSIBLE_DBM = -150.0  # thermal noise in 250 Hz at room temperature (-174 dBm per Hz): no receiver observes less
STRONG_DBM = -10.0  # values at the upper end are suspicious from here: below, they are rows next to the receiver
CUSTOMARY_DBM = frozenset({-999.0, -200.0, -128.0, -127.0, -120.0, -113.0, -110.0, -105.0, -101.0, -100.0, 0.0, 100.0})
"""Numbers that drivers and data sets give for "not heard": fewer rows and smaller gaps suffice."""
ALONE_DB = {1: 40.0, 2: 20.0, 3: 12.0}
CUSTOMARY_ALONE_DB = {1: 30.0, 2: 12.0, 3: 5.0}
"""Gap beyond which a value at an end stands alone, by its least number of rows: a single deep fade lies some 30 dB
below the median, and three equal values 12 dB below all others are no fade."""
STEPS = 4.0  # least such gap in steps of strengths that are quantised coarsely
FEWEST_OTHERS = 10  # least number of other rows beside one or two that stand alone
NEAR_DB, LEVELS = 3.0, 2.5
"""Values near another: within 3 dB, or within so many of their steps where they are quantised more coarsely."""
FEWEST, SHARE, RATIO = 6, 0.02, 3.0
"""Least number of rows and share of a value at an end that adjoins others, and least ratio to the most frequent value
near it. A tail has few rows at its end; one that is cut off, for rows below it are empty, as many as next to it."""
INNER_FEWEST, INNER_SHARE, INNER_RATIO, WEAKER = 10, 0.02, 8.0, 0.25
"""The same for a value among the weakest quarter: the mode of strengths in whole dB, of a transmitter that stands still
for instance, is not near an end, and its neighbours are frequent, too."""
MOST_VALUES = 4  # largest number of values that are found in one receiver, one after the other


@dataclass(frozen=True)
class Value:
    """A value that is suspicious, and whether it adjoins the other strengths."""

    dbm: float
    adjoins: bool


def suspicious_values(strengths_dbm: FloatArray) -> list[Value]:
    """Values that stand for "not heard" among strengths [n] of a receiver, one after the other without those before."""
    suspicious: list[Value] = []
    while len(suspicious) < MOST_VALUES:
        values, counts = np.unique(strengths_dbm, return_counts=True)
        if len(values) < 2:
            break  # one value in every row is reported as constant
        step = float(np.median(np.diff(values)))
        value = _value_alone(values, counts, step) or _frequent_value(values, counts, step)
        if value is None:
            break
        suspicious.append(value)
        strengths_dbm = strengths_dbm[strengths_dbm != value.dbm]
    return suspicious


def _value_alone(values: FloatArray, counts: IntArray, step: float) -> Value | None:
    """A value at an end that is far from all others."""
    # The lower end last: next to a mark of 100 dBm the weakest strength may stand alone, too.
    for end, inward in ((-1, -2), (0, 1)):
        value, neighbour, count = float(values[end]), float(values[inward]), int(counts[end])
        if end and value < STRONG_DBM:
            continue
        if abs(values[end] - values[inward]) >= _least_gap_db(value, neighbour, count, int(counts.sum()) - count, step):
            return Value(value, adjoins=False)
    return None


def _least_gap_db(value: float, neighbour: float, count: int, others: int, step: float) -> float:
    """Gap from which a value at an end in ``count`` rows is alone; infinite beside too few rows to tell."""
    gaps_db = CUSTOMARY_ALONE_DB if value in CUSTOMARY_DBM else ALONE_DB
    if value < IMPOSSIBLE_DBM or value >= 0 > neighbour:
        return gaps_db[3]
    if count < 3 and others < FEWEST_OTHERS:
        return np.inf
    return max(gaps_db[min(count, 3)], STEPS * step if others > count else 0)


def _frequent_value(values: FloatArray, counts: IntArray, step: float) -> Value | None:
    """A value at an end, or among the weakest, that is far more frequent than those near it."""
    rows, near_db = int(counts.sum()), max(NEAR_DB, LEVELS * step)
    below = np.cumsum(counts) - counts
    for place in np.flatnonzero((counts >= FEWEST) & (counts >= SHARE * rows)).tolist():
        near = (np.abs(values - values[place]) <= near_db) & (values != values[place])
        ratio = counts[place] / max(int(counts[near].max(initial=0)), 1)
        ends = place == 0 or (place == len(values) - 1 and values[place] >= STRONG_DBM)
        # Rows below the value as a share of the others, of which a mark may leave few.
        weak = below[place] <= WEAKER * (rows - counts[place])
        inner = counts[place] >= max(INNER_FEWEST, INNER_SHARE * rows) and weak
        if (ends and ratio >= RATIO) or (inner and ratio >= INNER_RATIO):
            return Value(float(values[place]), adjoins=bool(near.any()))
    return None
