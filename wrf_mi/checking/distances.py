"""Signal strengths against distances: transmitters in a plan that is mirrored or turned against the receivers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..core import Prediction, Record
from ..core.angles import FloatArray
from ..tasks import task_of
from .placements import other_plans
from .units import Found, distances_m

FEWEST_ROWS = 30
SHARE = 0.4
"""Gain in the share of the variance that distance explains, for one receiver, over the stated plan and over all other
motions. Shading by walls has no law, but fits one plan better than the others: random fields of some metres alone gain
as much in one case of 25. The shading of several receivers differs: the gain falls with the root of their number."""
EXPONENTS = (1.0, 6.0)
"""Exponents of distance laws in buildings (ITU-R P.1238: 1.5 to 5), from waveguides to thick walls."""
NEAREST_M = 0.1
"""Shorter distances count as this one: the far field begins there or later."""


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
        found = share, exponent, placement.motion, placement.remedy
        best[placement.motion] = max(best.get(placement.motion, (0.0, 0.0, "", "")), found)
    (share, exponent, plan, remedy), (second, *_) = sorted(best.values(), reverse=True)[:2]
    gain = share - max(stated, second)
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
