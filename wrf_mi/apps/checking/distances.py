"""Receivers and transmitters in different units, by signal strengths against distances."""

from __future__ import annotations

import numpy as np

from ...core import Prediction, Record
from ...core.angles import FloatArray
from .units import NamedTexts

FEWEST_ROWS = 30
MOST_ROWS = 1000  # rows from which factors of units are found: 482 of them in a second
EXPONENTS = (1.0, 6.0)
"""Exponents of distance laws in buildings (ITU-R P.1238: 1.5 to 5), from waveguides to thick walls."""
NEAREST_M = 0.1  # shorter distances count as this one: the far field begins there or later
FACTORS = np.geomspace(1e-3, 1e3, 241)
"""Factors of one end's coordinates: units from millimetres to kilometres, and pitches of grids, in steps of 6 %."""
LEAST_FACTOR = 1.4
"""Factors nearer to 1 are no unit: shadowing alone lets distances fit best with some tens of per cent."""
UNEXPLAINED = 0.5  # largest ratio of what distance leaves unexplained with the factor to what it leaves as stated
UNITS = {0.3048: "feet", 0.0254: "inches", 0.01: "centimetres", 0.001: "millimetres", 0.9144: "yards"}
UNIT_TOLERANCE = 0.15  # of a factor to be that of a unit: the fit is not sharper, and the units are further apart


def unlike_units(record: Record) -> NamedTexts:
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
    stated_share, _ = explained(levels, _distances_m(at_m, places))

    # Factors of the unit of either end. A walk on a grid has its height in metres, anchors in feet have theirs in feet.
    scaled = [(factor, "positions of rows", at_m * [factor, factor, 1], places) for factor in FACTORS]
    scaled += [(factor, "positions of receivers", at_m, places * factor) for factor in FACTORS]
    fits = [(*explained(levels, _distances_m(rows_m, rx_m)), factor, what) for factor, what, rows_m, rx_m in scaled]
    share, exponent, factor, what = max(fits)
    if max(factor, 1 / factor) < LEAST_FACTOR or 1 - share > UNEXPLAINED * (1 - stated_share):
        return
    if not EXPONENTS[0] <= exponent <= EXPONENTS[1]:
        return

    # The unit that such a factor means.
    units = [name for unit, name in UNITS.items() if abs(np.log(factor / unit)) < UNIT_TOLERANCE]
    meaning = f"they are in {units[0]}" if units else "steps of a grid, or another unit"
    evidence = f"distance explains {stated_share:.0%} of the variance of the signal strengths as stated, {share:.0%}"
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
    filled_levels = np.where(received, levels, 0.0)
    x, y = (np.where(received, v - v.sum(axis=1, keepdims=True) / count, 0.0) for v in (logs, filled_levels))
    covariance, spread, total = np.sum(x * y), np.sum(x * x), np.sum(y * y)
    if covariance >= 0 or spread == 0 or total == 0:
        return 0.0, 0.0
    return float(covariance**2 / (spread * total)), float(-covariance / spread)
