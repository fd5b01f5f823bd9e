"""Retrieval of the complex element signals of an array from a stored spectrum.

A spectrum that was scaled by its minimum and maximum and cut to grey levels determines the element signals up to a
common factor:

1. The lowest magnitude. Scaling subtracted a constant c from the magnitude; (grey + c)^2 lies in the span of the
   array's lags, grey^2 alone does not. So c is a linear least-squares problem.
2. The signals. Lags are sums of products h_m conj(h_n); for a planar array of two or more rows and columns there are
   more lags than signals. Phase retrieval from an autocorrelation is unique up to a common phase and, where the array
   is its own mirror image through its centre, the exchange of h_m with the conjugate of the opposite element's signal,
   which leaves the magnitude unchanged. It has local minima, hence several random starts.

Source: Hayes, "The reconstruction of a multidimensional sequence from the phase or magnitude of its Fourier transform"
(1982) for uniqueness; More, "The Levenberg-Marquardt algorithm" (1978).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core import InputError
from ..core.types import FloatArray, IntArray
from ..parallel.threads import on_threads
from .array import Lags, mirror_order

ComplexArray = NDArray[np.complex128]

STARTS = 200  # random starts for one spectrum at most; half of 160 measured spectra needed 5 or fewer, the slowest 76
GOOD_ENOUGH = 4.0  # a start has converged when its residual is at most this many times that of the grey levels
STEPS = 120  # steps of one start; starts that converge take 20 to 60
TOGETHER = 64  # spectra whose starts take their steps together
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-2, 1e-9, 1e6
"""Damping of the first step, the smallest, and the one at which a descent ends, relative to the diagonal."""
SOFTER, HARDER = 5.0, 4.0  # factors of the damping after a step that decreased the cost, and after another
CONVERGED = 1e-7  # relative decrease of the cost below which a start has converged: grey levels leave far more
LEVELS = 255  # highest grey level; digits below a level are cut off


@dataclass(frozen=True)
class Unscaled:
    """Spectra before their minimum was subtracted, in units of each spectrum's range."""

    squared: FloatArray  # squared magnitudes [n, height, width]
    lowest: FloatArray  # c, the magnitude that became 0, over the range that became 1, [n]
    residual: FloatArray  # root mean square over pixels of the part outside the span of the array's lags, [n]
    rounding: FloatArray  # the residual that the grey levels alone explain, [n]


def unscale(grey: ArrayLike, lags: Lags) -> Unscaled:
    """Undo the scaling of stored spectra [n, height, width], 0 to 1, magnitudes cut to multiples of 1 / `LEVELS`.

    ``lags`` are those of the array on the spectra's grid; `InputError` for another grid.
    """
    stored = np.asarray(grey, float)
    # Cutting off takes half a level on average, but not from the highest.
    middle = stored + 0.5 / LEVELS * (stored < 1)
    curved, straight = (lags.residual(image).reshape(len(stored), -1) for image in (middle**2, middle))
    # The variance of the levels' rounding is subtracted from both sums. Where only rounding lies outside the span, c is
    # not determined; it is then estimated too low, not at random.
    rounding = (1 - lags.count / middle[0].size) * middle[0].size / (12 * LEVELS**2)
    across = (curved * straight).sum(axis=1) - 2 * middle.mean(axis=(1, 2)) * rounding
    square = np.square(straight).sum(axis=1)
    lowest = np.maximum(-across / (2 * np.maximum(square - rounding, rounding)), 0)
    left = curved + 2 * lowest[:, None] * straight
    magnitude = middle + lowest[:, None, None]
    outside = np.sqrt(np.square(left).mean(axis=1))
    levels = np.sqrt(np.square(2 * magnitude / LEVELS).mean(axis=(1, 2)) / 12)
    return Unscaled(magnitude**2, lowest, outside, levels)


@dataclass(frozen=True)
class Retrieved:
    """Element signals of spectra."""

    signals: ComplexArray  # [n, m], each row up to a common phase (and the exchange with its mirror image)
    residual: FloatArray  # root mean square over pixels of the unexplained squared spectrum in the lags' span, [n]
    explained: NDArray[np.bool_]  # whether grey levels explain it, [n]; else a local minimum, or several snapshots


def retrieve_signals(unscaled: Unscaled, lags: Lags, seed: int = 0, starts: int = STARTS) -> Retrieved:
    """Signals whose squared spectra are nearest in the least-squares sense, from random starts.

    ``lags`` are those of the array on the spectra's grid, ``starts`` is the largest number of starts of a spectrum.
    `InputError` for an array whose lags do not determine its signals: a line, or fewer than four elements.
    """
    m = lags.elements
    # A second singular value of zero: all lags are on one line, whose spectra other signals have too.
    extent = np.linalg.svd(lags.lag_m, compute_uv=False)
    if lags.count < 2 * m - 1 or extent[1] < 1e-6 * extent[0]:
        raise InputError(f"retrieval: {m} elements on a line or too few lags; it takes an array of two dimensions")
    # P = x^T F x with x = (Re h, Im h), a symmetric F for each coordinate.
    real, imaginary = (lags.to_coordinates(part).reshape(m, m, -1) for part in lags.pairs)
    form = np.concatenate([np.concatenate(row, axis=1) for row in ((real, -imaginary), (imaginary, real))])
    form = (form + form.transpose(1, 0, 2)) / 2
    pixels = lags.shape[0] * lags.shape[1]
    wanted = lags.coordinates(unscaled.squared)
    enough = GOOD_ENOUGH * unscaled.rounding * np.sqrt(lags.count / pixels)
    # The mean of P over directions is about the sum of |h_m|^2, that is 2 m times a real part's variance.
    size = np.sqrt(unscaled.squared.mean(axis=(1, 2)) / (2 * m))
    draws = np.random.default_rng(seed).normal(size=(len(wanted), starts, 2 * m))
    signals, residual = np.zeros((len(wanted), m), complex), np.full(len(wanted), np.inf)

    def descend(rows: IntArray) -> None:
        left, done = rows, 0
        while len(left) and done < starts:
            # Several starts at once as soon as few rows are left: the calls take longer than small products.
            together = min(max(1, len(rows) // len(left)), starts - done)
            start = (size[left, None, None] * draws[left, done : done + together]).reshape(-1, 2 * m)
            x, norm = _descend(form, np.repeat(wanted[left], together, axis=0), start)
            norm = norm.reshape(-1, together) / np.sqrt(pixels)
            best = norm.argmin(axis=1)
            x, norm = (values.reshape(len(left), together, -1)[np.arange(len(left)), best] for values in (x, norm))
            better = norm[:, 0] < residual[left]
            residual[left[better]], signals[left[better]] = norm[better, 0], x[better, :m] + 1j * x[better, m:]
            left, done = left[residual[left] >= enough[left]], done + together

    on_threads(descend, np.array_split(np.arange(len(wanted)), -(-len(wanted) // TOGETHER)) if len(wanted) else [])
    return Retrieved(signals, residual, residual < enough)


def _descend(form: FloatArray, target: FloatArray, start: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Levenberg-Marquardt from n starts [n, 2 m] of real and imaginary parts: signals, and norms of residuals [n]."""
    # All starts take their steps together, each with its damping: the calls of a single step take longer than its sums.
    flat = form.reshape(len(form), -1)

    def evaluated(x: FloatArray, of: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        half_slope = (x @ flat).reshape(len(x), len(form), -1)  # of the coordinates x^T F x by x
        residual = np.matmul(x[:, None], half_slope)[:, 0] - target[of]
        return half_slope, residual, np.square(residual).sum(axis=1)

    x, damping, active = start.copy(), np.full(len(start), FIRST_DAMPING), np.arange(len(start))
    half_slope, residual, cost = evaluated(x, active)
    best = cost.copy()
    for _ in range(STEPS):
        matrix = 4 * half_slope @ half_slope.transpose(0, 2, 1)
        diagonal = np.einsum("nii->ni", matrix)
        diagonal *= 1 + damping[active, None]  # a view: Marquardt's scaling
        step = np.linalg.solve(matrix, -2 * half_slope @ residual[:, :, None])[:, :, 0]
        tried = evaluated(x[active] + step, active)
        lower = tried[2] < cost
        damping[active] = np.where(lower, np.maximum(damping[active] / SOFTER, LEAST_DAMPING), damping[active] * HARDER)
        x[active[lower]] += step[lower]
        # Steps that decrease the cost no more end a descent, and so do ever smaller ones.
        goes_on = np.where(lower, cost - tried[2] > CONVERGED * cost, damping[active] < MOST_DAMPING)
        half_slope, residual, cost = (
            np.where(lower.reshape(-1, *[1] * (new.ndim - 1)), new, old)[goes_on]
            for new, old in zip(tried, (half_slope, residual, cost), strict=True)
        )
        best[active[lower]] = tried[2][lower]
        active = active[goes_on]
        if not len(active):
            break
    return x, np.sqrt(best)


def align_signals(signals: ArrayLike, tx_pos_m: ArrayLike, elements_m: ArrayLike) -> ComplexArray:
    """Choose each row's common phase, and one of its two mirror images, so that neighbours in space agree.

    Rows of ``signals`` [n, m], of transmitters at ``tx_pos_m`` [n, 3], are joined nearest first (Prim's tree). The
    exchange of all rows with their mirror images stays undetermined.
    """
    aligned, positions = np.array(signals, complex), np.asarray(tx_pos_m, float)
    opposite = mirror_order(elements_m)
    count = len(aligned)
    near, partner = np.linalg.norm(positions - positions[0], axis=1), np.zeros(count, np.int64)
    waiting = np.ones(count, bool)
    waiting[0] = False
    while waiting.any():
        row = int(np.where(waiting, near, np.inf).argmin())
        choices = [aligned[row]] + ([] if opposite is None else [aligned[row][opposite].conj()])
        overlap = [np.vdot(choice, aligned[partner[row]]) for choice in choices]
        best = int(np.argmax(np.abs(overlap)))
        aligned[row] = choices[best] * np.exp(1j * np.angle(overlap[best]))
        waiting[row] = False
        distance = np.linalg.norm(positions - positions[row], axis=1)
        closer = distance < near
        near[closer], partner[closer] = distance[closer], row
    return aligned
