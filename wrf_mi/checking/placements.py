"""Other readings of a plan: positions with axes swapped, mirrored or turned."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..core import Record
from ..core.angles import FloatArray

_MOTIONS = {
    "y is mirrored": ((1, 0), (0, -1)),
    "x is mirrored": ((-1, 0), (0, 1)),
    "x and y are swapped": ((0, 1), (1, 0)),
    "the plan is turned by 180 degrees": ((-1, 0), (0, -1)),
    "the plan is turned by 90 degrees": ((0, -1), (1, 0)),
    "the plan is turned by -90 degrees": ((0, 1), (-1, 0)),
    "x and y are swapped and both are mirrored": ((0, -1), (-1, 0)),
}
"""What is wrong in words, and the matrix that corrects it."""


SMALLEST_OFFSET_M = 0.005
"""Smaller offsets are rounding."""


@dataclass(frozen=True)
class Placement:
    """Another reading of the positions.

    Attributes:
        motion: what is wrong.
        remedy: how to correct it.
        positions_m: the corrected positions [n, 3].
    """

    motion: str
    remedy: str
    positions_m: FloatArray


def placements(positions_m: FloatArray, *centres_m: FloatArray) -> Iterator[Placement]:
    """The seven other orientations of positions [n, 3], by right angles and mirror images, seen from above.

    Each one is taken about the origin, as where a sign was changed, and about points [2], such as the middle of a
    picture that was turned over.
    """
    for about in (*centres_m, np.zeros(2)):
        for motion, rows in _MOTIONS.items():
            matrix = np.array(rows, float)
            offset = about - matrix @ about
            moved = positions_m.copy()
            moved[:, :2] = positions_m[:, :2] @ matrix.T + offset
            formula = ", ".join(_formula(axis, matrix[k], offset[k]) for k, axis in enumerate("xy"))
            yield Placement(motion, f"use {formula}", moved)


def other_plans(record: Record) -> Iterator[Placement]:
    """Other placements of a record's transmitters among its receivers, about the middle of both and of the former."""
    receivers = np.stack([receiver.position_m for receiver in record.receivers])
    both = np.concatenate([record.tx_pos_m, receivers])
    yield from placements(record.tx_pos_m, _middle(both), _middle(record.tx_pos_m))


def _middle(positions_m: FloatArray) -> FloatArray:
    xy = positions_m[:, :2]
    return (xy.min(axis=0) + xy.max(axis=0)) / 2


def _formula(axis: str, row: FloatArray, offset_m: float) -> str:
    """A coordinate as text, such as ``x = 9.07 - y``."""
    source = "xy"[int(np.flatnonzero(row)[0])]
    if abs(offset_m) < SMALLEST_OFFSET_M:
        return f"{axis} = {source}" if row.sum() > 0 else f"{axis} = -{source}"
    if row.sum() < 0:
        return f"{axis} = {offset_m:.2f} - {source}"
    return f"{axis} = {source} {'-' if offset_m < 0 else '+'} {abs(offset_m):.2f}"
