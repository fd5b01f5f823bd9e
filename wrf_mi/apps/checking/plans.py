"""Transmitters in a plan that is mirrored or turned against the receivers, by signal strengths against distances."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ...core import Prediction, Record
from ...core.angles import FloatArray
from .units import Found, distances_m

FEWEST_ROWS = 30
MOST_ROWS = 1000  # rows from which factors of units are found: 482 of them in a second
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
FACTORS = np.geomspace(1e-3, 1e3, 241)
"""Factors of one end's coordinates: units from millimetres to kilometres, and pitches of grids, in steps of 6 %."""
LEAST_FACTOR = 1.4
"""Factors nearer to 1 are no unit: shadowing alone lets distances fit best with some tens of per cent."""
UNEXPLAINED = 0.5  # largest ratio of what distance leaves unexplained with the factor to what it leaves as stated
UNITS = {0.3048: "feet", 0.0254: "inches", 0.01: "centimetres", 0.001: "millimetres", 0.9144: "yards"}
UNIT_TOLERANCE = 0.15  # of a factor to be that of a unit: the fit is not sharper, and the units are further apart


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
    if record.task.name not in ("rssi", "csi") or not record.has_positions or len(record) < FEWEST_ROWS:
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


def unlike_units(record: Record) -> Found:
    """Receivers and transmitters in different units, by the factor with which strengths follow a distance law."""
    places = np.stack([receiver.position_m for receiver in record.receivers])
    surveyed = np.isfinite(places).all(axis=1)
    # With a single receiver a factor moves the rows as another place of it would.
    enough = surveyed.sum() >= 2 and len(record) >= FEWEST_ROWS
    if record.task.name not in ("rssi", "csi") or not record.has_positions or not enough:
        return
    rows = np.linspace(0, len(record) - 1, min(len(record), MOST_ROWS)).astype(int)
    levels, places = levels_db(record)[surveyed][:, rows], places[surveyed]
    at_m = record.tx_pos_m[rows]
    stated, _ = explained(levels, _distances_m(at_m, places))
    # A walk on a grid has its height in metres, while anchors in feet have theirs in feet, too.
    plane = [(factor, "positions of rows", at_m * [factor, factor, 1], places) for factor in FACTORS]
    whole = [(factor, "positions of receivers", at_m, places * factor) for factor in FACTORS]
    fits = [(*explained(levels, _distances_m(rx, tx)), factor, what) for factor, what, rx, tx in (*plane, *whole)]
    share, exponent, factor, what = max(fits)
    if max(factor, 1 / factor) < LEAST_FACTOR or 1 - share > UNEXPLAINED * (1 - stated):
        return
    if not EXPONENTS[0] <= exponent <= EXPONENTS[1]:
        return
    units = [name for unit, name in UNITS.items() if abs(np.log(factor / unit)) < UNIT_TOLERANCE]
    meaning = f"they are in {units[0]}" if units else "steps of a grid, or another unit"
    evidence = f"distance explains {stated:.0%} of the variance of the signal strengths as stated, {share:.0%}"
    remedy = "state both in metres (data import: --units, --pitch, or columns such as x_ft)"
    yield "unlike-units", f"{what} are {factor:.3g} m per unit ({meaning}): {evidence} with that factor; {remedy}"


def _distances_m(at_m: FloatArray, places_m: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(at_m[None] - places_m[:, None], axis=-1))


def levels_db(record: Record) -> FloatArray:
    """Received power [n_rx, n] in dB, NaN where nothing was received."""
    task = record.task
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
