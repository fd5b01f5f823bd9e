"""Regular horizontal grids of transmitter positions over the area of a run."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..core import InputError
from ..core.angles import FloatArray
from ..runs.run import Run

LARGEST = 10_000_000
"""Largest number of positions of a grid: 240 MB of coordinates."""
MARGIN_M = 0.5
"""Margin around transmitter positions where no scene states the area."""


@dataclass(frozen=True)
class Grid:
    """Positions at one height.

    Attributes:
        x_m: coordinates along x [nx], ascending, metres.
        y_m: coordinates along y [ny], ascending, metres.
        height_m: height z of all positions, metres.
    """

    x_m: FloatArray
    y_m: FloatArray
    height_m: float

    @property
    def positions_m(self) -> FloatArray:
        """Positions [ny * nx, 3], metres; x varies fastest."""
        y, x = np.meshgrid(self.y_m, self.x_m, indexing="ij")
        return np.stack([x.ravel(), y.ravel(), np.full(x.size, self.height_m)], axis=-1)


def grid_over(low_m: FloatArray, high_m: FloatArray, step_m: float, height_m: float) -> Grid:
    """Grid over a rectangle, whose cells have their centres on it and cover it from the lower corner on.

    Args:
        low_m: lower corner of the rectangle [2 or more], metres; coordinates beyond the second are ignored.
        high_m: upper corner, likewise.
        step_m: distance between neighbouring positions, metres.
        height_m: height of all positions, metres.

    Raises:
        InputError: a step that is not positive and finite, or more than `LARGEST` positions.
    """
    if not (np.isfinite(step_m) and step_m > 0):
        raise InputError(f"step {step_m:g} m: give a positive number of metres")
    size = np.maximum(np.asarray(high_m, float)[:2] - np.asarray(low_m, float)[:2], 0.0)
    counts = np.maximum(np.ceil(size / step_m - 1e-9), 1.0)
    if counts.prod() > LARGEST:
        text = f"{counts.prod():.3g} positions over {size[0]:.1f} x {size[1]:.1f} m, the limit is {LARGEST}"
        raise InputError(f"step {step_m:g} m: {text}; give a larger step")
    x, y = (low + step_m * (np.arange(int(count)) + 0.5) for low, count in zip(low_m[:2], counts, strict=True))
    return Grid(x, y, float(height_m))


def area_of(run: Run, tx_pos_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Corners [3], metres, of the box around a run's scene; without one around positions [n, 3] and `MARGIN_M`.

    Raises:
        InputError: no scene, and no position that is known.
    """
    if (scene := run.problem.opened_scene) is not None:
        box = scene.mi_scene.bbox()
        return np.array(box.min, float).ravel(), np.array(box.max, float).ravel()
    known = tx_pos_m[np.isfinite(tx_pos_m).all(axis=1)]
    if not len(known):
        raise InputError(f"{run.folder}: neither scene nor transmitter positions are known; train with --scene")
    return known.min(axis=0) - MARGIN_M, known.max(axis=0) + MARGIN_M


def usual_height(run: Run, tx_pos_m: FloatArray) -> float:
    """Median height of positions [n, 3], metres; that of the middle of the run's area where none is known."""
    heights = tx_pos_m[:, 2]
    heights = heights[np.isfinite(heights)]
    if len(heights):
        return float(np.median(heights))
    low, high = area_of(run, tx_pos_m)
    return float(low[2] + high[2]) / 2
