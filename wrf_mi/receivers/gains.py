"""Gains of an array's elements from its own measurements, without a reference source.

One signal vector h tells nothing of the gains: any diag(g) can be taken out of it. What tells them is that waves are
few and gains are always the same: h_i = diag(g) sum_k a_ik exp(+j k p . u_ik) over rows i, with few plane waves in
each, the line of sight among them, whose direction is known. Directions and amplitudes are found by matching pursuit
with the present gains, gains by least squares with the present waves, in turn.

What stays open: a common complex factor; for an array that is its own mirror image, the exchange of g_m with the
conjugate of the opposite element's, of the signals with it; and, but for the known direction of the line of sight, a
phase that grows linearly over the array, which shifts all directions alike. Whether the gains are real or only
explain these rows, rows from elsewhere tell: `self_calibrate` holds out each spatial group in turn.

Source: Paulraj and Kailath, "Direction of arrival estimation by eigenstructure methods with unknown sensor gain and
phase" (1985), for what can be told; Pati, Rezaiifar and Krishnaprasad, "Orthogonal matching pursuit" (1993).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core import InputError
from ..core.angles import FloatArray
from ..core.types import IntArray
from .array import array_response

ComplexArray = NDArray[np.complex128]

GRID_STEPS = 61
"""Points across the disc of direction cosines: 0.033 apart, a fifteenth of the half-wavelength 4 x 4 beam."""
ROUNDS = 25
"""Of waves and gains in turn; measured gains settle to a degree in 15."""


@dataclass(frozen=True)
class SelfCalibration:
    """Gains of the elements, and how far they may be trusted.

    Attributes:
        gain: complex [m], mean power 1, phase of the sum 0.
        amplitude_std: of abs(gain), [m], by leaving groups of rows out (jackknife).
        phase_std_rad: of its phase, [m].
        unexplained_ideal: share of the held-out rows' power that the waves leave with equal gains, [groups].
        unexplained: the same with the gains fitted to all other groups, [groups].
        rows: in each group, [groups].
        waves: plane waves in a row, the line of sight included.
    """

    gain: ComplexArray
    amplitude_std: FloatArray
    phase_std_rad: FloatArray
    unexplained_ideal: FloatArray
    unexplained: FloatArray
    rows: IntArray
    waves: int

    @property
    def told(self) -> bool:
        """Whether gains fitted elsewhere explain every held-out group better than equal ones."""
        return bool((self.unexplained < self.unexplained_ideal).all())


def self_calibrate(
    signals: ArrayLike,
    elements_m: ArrayLike,
    frequency_hz: float,
    line_of_sight: ArrayLike,
    groups: ArrayLike,
    waves: int = 3,
) -> SelfCalibration:
    """Fit gains, and hold out each group of rows in turn.

    Args:
        signals: element signals [n, m], each row with any common phase, mirror images chosen alike
            (`wrf_mi.receivers.retrieve.align_signals`).
        elements_m: [m, 3], the array's frame, in one plane z = 0, metres.
        frequency_hz: of the carrier.
        line_of_sight: unit vectors to the transmitters [n, 3], the array's frame.
        groups: of each row, whole numbers [n]: regions of space, so that neighbours are not held out alone.
        waves: plane waves in each row, the line of sight included; far fewer than m / 1.5, what the phases can tell.

    Raises:
        InputError: fewer than two groups, or too many waves for the elements.
    """
    h = np.asarray(signals, complex)
    names, group = np.unique(np.asarray(groups), return_inverse=True)
    if len(names) < 2:
        raise InputError("gains: one group of rows; give two or more regions, to hold each out in turn")
    if not 1 <= waves <= h.shape[1] // 3:
        raise InputError(f"gains: {waves} waves in {h.shape[1]} elements; choose 1 to {h.shape[1] // 3}")
    h = h / np.linalg.norm(h, axis=1, keepdims=True)
    elements = np.asarray(elements_m, float)
    atoms = array_response(elements, _disc(), frequency_hz)
    sight = array_response(elements, np.asarray(line_of_sight, float), frequency_hz)
    ideal = np.ones(h.shape[1], complex)

    def left(rows: NDArray[np.bool_], gain: ComplexArray) -> float:
        return float(
            np.square(np.abs(h[rows] - _pursue(h[rows], sight[rows], atoms, gain, waves) * gain)).sum(axis=1).mean()
        )

    gain = _fit(h, sight, atoms, waves, ideal)
    without, held, plain = [], [], []
    for k in range(len(names)):
        out = group == k
        fitted = _fit(h[~out], sight[~out], atoms, waves, ideal)
        without.append(fitted)
        plain.append(left(out, ideal))
        held.append(left(out, fitted))
    ratio = np.array(without) / gain
    spread = np.sqrt((len(names) - 1) / len(names))
    return SelfCalibration(
        gain,
        spread * np.sqrt(np.square((np.abs(ratio) - 1) * np.abs(gain)).sum(axis=0)),
        spread * np.sqrt(np.square(np.angle(ratio)).sum(axis=0)),
        np.array(plain),
        np.array(held),
        np.bincount(group).astype(np.int64),
        waves,
    )


def _fit(h: ComplexArray, sight: ComplexArray, atoms: ComplexArray, waves: int, start: ComplexArray) -> ComplexArray:
    gain = start
    for _ in range(ROUNDS):
        x = _pursue(h, sight, atoms, gain, waves)
        gain = (h * x.conj()).sum(axis=0) / np.square(np.abs(x)).sum(axis=0)
        gain = gain / np.sqrt(np.square(np.abs(gain)).mean()) * np.exp(-1j * np.angle(gain.sum()))
    return gain


def _pursue(h: ComplexArray, sight: ComplexArray, atoms: ComplexArray, gain: ComplexArray, waves: int) -> ComplexArray:
    """Sums [n, m] of plane waves whose product with the gains is nearest to h, by orthogonal matching pursuit."""
    seen = atoms * gain
    direction = seen / np.linalg.norm(seen, axis=1, keepdims=True)
    chosen = [sight]
    for _ in range(waves):
        waves_m = np.stack(chosen, axis=2)
        amplitude = np.linalg.pinv(waves_m * gain[:, None]) @ h[..., None]
        fitted: ComplexArray = (waves_m @ amplitude)[..., 0]
        if len(chosen) == waves:
            break
        rest = h - fitted * gain
        chosen.append(atoms[np.abs(rest @ direction.conj().T).argmax(axis=1)])
    return fitted


def _disc() -> FloatArray:
    """Directions [n, 3] with both cosines on a grid; z does not count for elements in the plane."""
    steps = np.linspace(-1, 1, GRID_STEPS)
    x, y = (c.ravel() for c in np.meshgrid(steps, steps))
    inside = x**2 + y**2 <= 1
    x, y = x[inside], y[inside]
    return np.stack([x, y, np.sqrt(np.maximum(1 - x**2 - y**2, 0))], axis=1)
