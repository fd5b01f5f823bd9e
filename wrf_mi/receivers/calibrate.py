"""What measured spectra tell of the instrument that made them.

| what | from | told |
| --- | --- | --- |
| frequency x spacing | the span of the lags | yes; not each by itself |
| row and column offset of the grid | the span of the lags | yes; the column's because the lattice is not round |
| magnitudes scaled and cut | residual of the span, pixels at the highest level | yes |
| complex element signals of each row | `wrf_mi.receivers.retrieve` | yes, up to phase and mirror image |
| element gains | `wrf_mi.receivers.gains`: few waves, rows elsewhere | as far as waves are few; by hold-out |
| orientation | strongest lobe against line of sight | only together with a phase that grows over the array |
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.constants import speed_of_light
from scipy.optimize import minimize

from ..core import InputError, Record, pixel_directions
from ..core.angles import FloatArray
from ..core.receivers import receiver_index
from ..core.types import IntArray
from .gains import SelfCalibration, self_calibrate
from .lags import Lags
from .physical_array import Array
from .retrieve import Retrieved, Unscaled, align_signals, retrieve_signals, unscale

GEOMETRY_ROWS = 20
"""Spectra from which the grid is fitted, in each of `GEOMETRY_PARTS`: they agree to 1e-4 of the spacing."""
GEOMETRY_PARTS = 4
"""Disjoint draws of rows: their scatter is the interval."""
NEAR_SIGHT = 0.35
"""Largest difference of direction cosines, 20 degrees, at which the strongest lobe counts as the line of sight's."""
GROUPS = 5
"""Regions of space where the record has no folds."""


@dataclass(frozen=True)
class Interval:
    """A value and half of its 95 % interval."""

    value: float
    half: float


@dataclass(frozen=True)
class ArrayFit:
    """What the spectra of some rows tell.

    Attributes:
        elements_m: the stated elements, times ``spacing`` where that is told from one.
        spacing: factor on the stated product of frequency and spacing.
        row_offset: rows by which the first one lies above the horizon.
        column_offset: columns by which the first one lies beyond the array's x axis.
        unscaled: spectra with their scaling undone.
        cut: whether digits were cut off, not rounded: one pixel alone is at the highest level.
        retrieved: element signals.
        signals: the same, aligned over the rows.
        calibration: gains of the elements; None if the spectra are no single snapshots.
        shift: direction cosines (x, y) by which the strongest lobe lies off the line of sight, where it is near it.
        near_sight: share of the rows where it is.
    """

    elements_m: FloatArray
    spacing: Interval
    row_offset: Interval
    column_offset: Interval
    unscaled: Unscaled
    cut: bool
    retrieved: Retrieved
    signals: NDArray[np.complex128]
    calibration: SelfCalibration | None
    shift: tuple[Interval, Interval]
    near_sight: float

    def array(self, record: Record) -> Array:
        """The array with the gains that were told; with equal ones where they were not."""
        own = self.calibration
        return Array(self.elements_m, _carrier_hz(record), own.gain if own is not None and own.told else None)

    def plain(self) -> dict[str, Any]:
        """In plain numbers, for a report."""
        own = self.calibration
        gains = own and {
            "told": own.told,
            "amplitude": np.abs(own.gain).tolist(),
            "amplitude_std": own.amplitude_std.tolist(),
            "phase_deg": np.degrees(np.angle(own.gain)).tolist(),
            "phase_std_deg": np.degrees(own.phase_std_rad).tolist(),
            "unexplained": float(np.average(own.unexplained, weights=own.rows)),
            "unexplained_ideal": float(np.average(own.unexplained_ideal, weights=own.rows)),
        }
        intervals = {name: getattr(self, name) for name in ("spacing", "row_offset", "column_offset")}
        intervals |= {"shift_x": self.shift[0], "shift_y": self.shift[1]}
        return {name: [each.value, each.half] for name, each in intervals.items()} | {
            "residual": float(np.sqrt(np.square(self.unscaled.residual).mean())),
            "rounding": float(np.sqrt(np.square(self.unscaled.rounding).mean())),
            "cut": self.cut,
            "retrieved": float(self.retrieved.found.mean()),
            "near_sight": self.near_sight,
            "gains": gains,
        }


def fit_array(record: Record, rows: ArrayLike, receiver: int | str = 0, waves: int = 3, seed: int = 0) -> ArrayFit:
    """Calibrate a receiver's array by its own spectra.

    Args:
        record: of spectra that an array scaled to their own minimum and maximum; with its stated array and carrier.
        rows: training rows.
        receiver: name, or number from 0.
        waves: plane waves in each row, see `wrf_mi.receivers.gains`.
        seed: of the draws of rows and of starts.

    Returns:
        The fit; 20 s of one core for 160 spectra of 90 x 360, most of it for the grid.

    Raises:
        InputError: a record of another task or without its array and carrier; too few rows; no such receiver.
    """
    index = receiver_index(record.receivers, receiver)
    array_m = record.receivers[index].array_m
    if record.observation.ndim != 4 or array_m is None or record.frequencies_hz is None:
        raise InputError(
            f"{record.name}: calibration needs spectra with their array and carrier; give them in the data"
        )
    elements, frequency_hz = np.asarray(array_m, float), _carrier_hz(record)
    chosen = np.asarray(rows, np.int64)
    if len(chosen) < 2 * GEOMETRY_PARTS:
        raise InputError(f"{record.name}: {len(chosen)} rows to calibrate by; give {2 * GEOMETRY_PARTS} or more")
    grey = np.asarray(record.observation[index, chosen], float)
    height, width = grey.shape[1:]
    spacing, row_offset, column_offset = _grid(grey, elements, frequency_hz, seed)
    if abs(spacing.value - 1) > spacing.half:
        elements = elements * spacing.value
    lags = Lags(elements, frequency_hz, height, width)
    # Rounding would put every pixel within half a level of the peak at the highest one; cutting off, the peak alone.
    cut = bool(np.median((grey == 1).sum(axis=(1, 2))) == 1)
    unscaled = unscale(grey, lags, cut=cut)
    retrieved = retrieve_signals(unscaled, lags, seed)
    signals = align_signals(retrieved.signals, record.tx_pos_m[chosen], elements)
    pose = record.receivers[index]
    sight = (record.tx_pos_m[chosen] - pose.position_m) @ pose.to_world
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    groups = _groups(record, chosen)
    good = retrieved.found
    calibration = None
    if len(np.unique(groups[good])) > 1:
        calibration = self_calibrate(signals[good], elements, frequency_hz, sight[good], groups[good], waves)
    shift, near = _shift(grey, sight, groups)
    return ArrayFit(
        elements,
        spacing,
        row_offset,
        column_offset,
        unscaled,
        cut,
        retrieved,
        signals,
        calibration,
        shift,
        near,
    )


def _carrier_hz(record: Record) -> float:
    assert record.frequencies_hz is not None
    return float(record.frequencies_hz[0])


def _groups(record: Record, rows: IntArray) -> IntArray:
    """Regions of space: the record's folds, else slices along the longest axis of the positions."""
    if record.folds is not None:
        return record.folds[rows]
    centred = record.tx_pos_m[rows] - record.tx_pos_m[rows].mean(axis=0)
    axis = np.linalg.svd(centred, full_matrices=False)[2][0]
    order = np.argsort(np.argsort(centred @ axis, kind="stable"), kind="stable")
    return order * GROUPS // len(rows)


def _grid(
    grey: FloatArray, elements: FloatArray, frequency_hz: float, seed: int
) -> tuple[Interval, Interval, Interval]:
    """Spacing, row and column offset that leave least outside the span of the lags, from disjoint draws of rows."""
    order = np.random.default_rng(seed).permutation(len(grey))
    size = min(GEOMETRY_ROWS, len(grey) // GEOMETRY_PARTS)
    found = []
    for part in range(GEOMETRY_PARTS):
        images = grey[order[part * size : (part + 1) * size]]
        # The residual is smooth on a scale of the lags; a fifth of a row is a fiftieth of what it bends over.
        start = np.array([1.0, 0.0, 0.0])
        simplex = start + np.concatenate([np.zeros((1, 3)), np.diag([0.005, 0.2, 0.2])])
        options = {"initial_simplex": simplex, "xatol": 3e-5, "fatol": 1e-8, "maxfev": 150}
        found.append(minimize(_left_by(images, elements, frequency_hz), start, method="Nelder-Mead", options=options).x)
    values = np.array(found)
    # Student's t of three degrees of freedom, 97.5 %: 3.18.
    half = 3.18 * values.std(axis=0, ddof=1) / np.sqrt(GEOMETRY_PARTS)
    spacing, row, column = (Interval(float(v), float(h)) for v, h in zip(values.mean(axis=0), half, strict=True))
    return spacing, row, column


def _left_by(images: FloatArray, elements: FloatArray, frequency_hz: float) -> Callable[[FloatArray], float]:
    height, width = images.shape[1:]
    step = next(k for k in (4, 3, 2, 1) if width % k == 0)
    thin = images[:, :, ::step]

    def left(setting: FloatArray) -> float:
        spacing, row, column = setting
        turn = column * 2 * np.pi / width
        # A grid that begins beyond the x axis sees the array turned back.
        rotation = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
        lags = Lags(elements @ rotation * spacing, frequency_hz, height, width // step, row)
        return float(np.square(unscale(thin, lags).residual).mean())

    return left


def _shift(grey: FloatArray, sight: FloatArray, groups: IntArray) -> tuple[tuple[Interval, Interval], float]:
    """Mean difference of the strongest lobe's and the line of sight's direction cosines; interval by groups."""
    lobe = pixel_directions(*grey.shape[1:]).reshape(-1, 3)[grey.reshape(len(grey), -1).argmax(axis=1)]
    off = (lobe - sight)[:, :2]
    near = np.linalg.norm(lobe - sight, axis=1) < NEAR_SIGHT
    if not near.any():
        return (Interval(np.nan, np.nan), Interval(np.nan, np.nan)), 0.0
    names = np.unique(groups[near])
    mean = off[near].mean(axis=0)
    without = np.array([off[near & (groups != name)].mean(axis=0) for name in names]) if len(names) > 1 else mean[None]
    # Jackknife over regions: neighbours share their echoes, so rows are no independent sample.
    half = 1.96 * np.sqrt((len(names) - 1) / len(names) * np.square(without - without.mean(axis=0)).sum(axis=0))
    x, y = (Interval(float(v), float(h)) for v, h in zip(mean, half, strict=True))
    return (x, y), float(near.mean())


def phase_gradient(gain: ArrayLike, elements_m: ArrayLike, frequency_hz: float) -> FloatArray:
    """The direction cosines (x, y) by which gains shift all directions: their phase's slope over the array, over k.

    A mount turned by that much, in rad, does the same to directions near the boresight.
    """
    g, p = np.asarray(gain, complex), np.asarray(elements_m, float)[:, :2]
    wavenumber = 2 * np.pi * frequency_hz / speed_of_light
    steps = np.linspace(-1, 1, 201)
    grid = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    beam = np.abs(np.exp(-1j * wavenumber * (grid @ p.T)) @ g)
    return grid[int(beam.argmax())]
