"""Transmitters in a plan that is mirrored or turned against the receivers, by signal strengths against distances."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ..core import Prediction, Record
from ..core.angles import FloatArray
from ..tasks import task_of
from .units import Found, distances_m

FEWEST_ROWS = 30
SHARE = 0.4
"""Gain in the share of the variance that distance explains, for one receiver, over the stated plan and over all other
motions. Shading by walls has no law, but fits one plan better than the others: random fields of some metres alone gain
as much in one case of 25. The shading of several receivers differs: the gain falls with the root of their number."""
EXPONENTS = (1.0, 6.0)
"""Exponents of distance laws in buildings (ITU-R P.1238: 1.5 to 5), from waveguides to thick walls."""
NEAREST_M = 0.1  # shorter distances count as this one: the far field begins there or later
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
SMALLEST_OFFSET_M = 0.005  # smaller offsets are rounding


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
    picture.
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


def distance_law(record: Record) -> Found:
    """The plan in which signal strengths follow a distance law, if they do not in the stated plan."""
    if record.task not in ("rssi", "csi") or not record.has_positions or len(record) < FEWEST_ROWS:
        return
    if not all(np.isfinite(receiver.position_m).all() for receiver in record.receivers):
        return
    levels = levels_db(record)
    stated, _ = explained(levels, distances_m(record))
    # Of each motion the point about which it explains most.
    best: dict[str, tuple[float, float, str, str]] = {}
    for placement in other_plans(record):
        share, exponent = explained(levels, distances_m(replace(record, tx_pos_m=placement.positions_m)))
        candidate = share, exponent, placement.motion, placement.remedy
        best[placement.motion] = max(best.get(placement.motion, candidate), candidate)
    (share, exponent, plan, remedy), (second, *_) = sorted(best.values(), reverse=True)[:2]
    gain = share - max(stated, second)  # clear of the second-best motion, too, or neither is known
    if gain < SHARE / np.sqrt(len(record.receivers)) or not EXPONENTS[0] <= exponent <= EXPONENTS[1]:
        return
    evidence = f"distance then explains {share:.0%} of the variance of the signal strengths, as stated {stated:.0%}"
    yield "plan", f"transmitters are in another plan than receivers, {plan}: {evidence}; {remedy}"


def levels_db(record: Record) -> FloatArray:
    """Received power [n_rx, n] in dB, NaN where nothing was received."""
    task = task_of(record)
    return np.stack([task.level(Prediction(observed)).mean for observed in record.observation]).astype(float)


def explained(levels: FloatArray, distance_m: FloatArray) -> tuple[float, float]:
    """Share of the variance that a common distance law explains, and its exponent; a level of its own per receiver.

    A law by which strengths rise with distance explains nothing.
    """
    received = np.isfinite(levels)
    count = np.maximum(received.sum(axis=1, keepdims=True), 1)
    logs = np.where(received, 10 * np.log10(np.maximum(distance_m, NEAREST_M)), 0.0)
    known = np.where(received, levels, 0.0)
    x, y = (np.where(received, v - v.sum(axis=1, keepdims=True) / count, 0.0) for v in (logs, known))
    covariance, spread, total = np.sum(x * y), np.sum(x * x), np.sum(y * y)
    if covariance >= 0 or spread == 0 or total == 0:
        return 0.0, 0.0
    return float(covariance**2 / (spread * total)), float(-covariance / spread)
