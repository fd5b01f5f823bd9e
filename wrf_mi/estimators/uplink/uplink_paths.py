"""Propagation paths of an uplink by greedy search and nonlinear least squares, many rows at once.

Paths are found one after the other at the maximum of the matched filter of the residual, and after each addition all
paths are refined together (Levenberg and Marquardt). A row takes no further path once the Bayesian information
criterion of complex white noise of unknown power, 2 N log(residual energy) + freedom log(2 N) for N coefficients, would
rise. Paths of a scene may be known before: their parameters have a Gaussian prior.

Source: Vasisht et al. (2016), sections 5.2 to 5.4 (search on a grid, then refinement); Mamandipoor et al., "Newtonized
orthogonal matching pursuit" (2016) (refinement after each path); Schwarz, "Estimating the dimension of a model" (1978)
(criterion).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from ...core.angles import FloatArray
from ...core.types import IntArray
from ...parallel.threads import on_threads
from ..model import slices
from .uplink_waves import SINGULAR, Complex, Mask, Solved, Waves, products, strongest

T = TypeVar("T")

PASSES = 8  # passes of `expected_gains`

ROWS = 16  # rows refined together: more leave the processor's cache
FIRST_STEPS = 4  # steps of refinement of a new path before all are refined
ACCURACY = 1e-26  # share of the energy at which a fit is perfect: the squared rounding of float64 times that of sums
CONVERGED = 1e-9  # relative fall of the residual's energy below which a refinement has converged


@dataclass
class UplinkPaths:
    """Paths of n rows."""

    theta: FloatArray  # parameters [n, k, p], see `Waves`
    present: Mask  # whether a row has each of the k paths, [n, k]
    gains: Complex  # complex gains [n, k, antennas], or [n, k, 1] for all antennas


@dataclass
class Start:
    """Paths of n rows that are known before the search, such as those of a scene."""

    theta: FloatArray  # expected parameters [n, k, p], see `Waves`
    present: Mask  # whether a row has each of the k paths, [n, k]
    precision: FloatArray  # inverse variances of the parameters [n, k, p]; 0: nothing is known

    @classmethod
    def none(cls, rows: int, parameters: int) -> Start:
        """No path of any row."""
        return cls(np.zeros((rows, 0, parameters)), np.zeros((rows, 0), bool), np.zeros((rows, 0, parameters)))

    def __getitem__(self, rows: slice | IntArray) -> Start:
        return Start(self.theta[rows], self.present[rows], self.precision[rows])

    def joined(self, theta: FloatArray) -> Start:
        """With further paths [n, m, p] of which nothing is known."""
        absent = np.zeros(theta.shape[:2], bool)
        parts = (self.theta, theta), (self.present, absent), (self.precision, np.zeros_like(theta))
        return Start(*(np.concatenate(pair, axis=1) for pair in parts))

    def cost(self, theta: FloatArray) -> FloatArray:
        """Squared differences of parameters from the expected ones, in standard deviations, summed [n]."""
        return np.asarray((self.precision * np.square(theta - self.theta)).sum(axis=(1, 2)))


def find_paths(
    waves: Waves, h: Complex, max_paths: int, between: int, final: int, start: Start | None = None
) -> UplinkPaths:
    """Paths of uplinks [n, antennas, f], ``max_paths`` a row at most beside those of ``start``.

    All paths are refined by ``between`` steps after each addition, and by ``final`` steps after the last; those of the
    start by as many before.
    """
    initial = start or Start.none(len(h), 1 + waves.cosines.shape[1])
    return join_paths(in_parts(lambda rows: _find(waves, h[rows], max_paths, between, final, initial[rows]), len(h)))


def refine_paths(waves: Waves, h: Complex, theta: FloatArray, present: Mask, steps: int) -> UplinkPaths:
    """Paths of uplinks [n, antennas, f] from a start: parameters [n, k, p], which of them to use [n, k]."""
    return join_paths(in_parts(lambda rows: _finish(waves, h[rows], theta[rows], present[rows], steps), len(h)))


def in_parts(work: Callable[[slice], T], count: int) -> list[T]:
    """Results of ``work(rows)`` for `ROWS` rows at a time, in order, on all processors that this process may use."""
    return on_threads(work, slices(count, ROWS))


def join_paths(parts: list[UplinkPaths]) -> UplinkPaths:
    """Paths of all rows, as many a row as the longest part has."""
    most = max(part.present.shape[1] for part in parts)

    def padded(part: UplinkPaths, name: str) -> np.ndarray:
        values = getattr(part, name)
        missing = most - values.shape[1]
        # Parameters of an absent path repeat another's, so that they are defined.
        filler = values[:, :1] if name == "theta" else np.zeros_like(values[:, :1])
        return np.concatenate([values, np.repeat(filler, missing, axis=1)], axis=1)

    return UplinkPaths(
        *(np.concatenate([padded(part, name) for part in parts]) for name in ("theta", "present", "gains"))
    )


def _find(waves: Waves, h: Complex, max_paths: int, between: int, final: int, start: Start) -> UplinkPaths:
    count = h.shape[1] * h.shape[2]
    energy = np.square(np.abs(h)).sum(axis=(1, 2))
    # An uplink of zeros has no paths; its row is predicted as zero.
    active = np.flatnonzero(energy > 0)
    present: Mask = start.present & (energy > 0)[:, None]
    theta, best, residual = start.theta, energy.copy(), h.copy()
    if present.any():
        theta, solved = refine(waves, h, theta, present, final, start)
        best, residual = solved.energy, solved.residual
    for _ in range(max_paths):
        # A finished row gets its first path's parameters, masked.
        fresh = theta[:, 0].copy() if theta.shape[1] else strongest(waves, residual)
        if theta.shape[1] and len(active):
            fresh[active] = strongest(waves, residual[active])
        # A single path costs little to refine, and brings the refinement of all nearer to convergence.
        single = np.ones((len(active), 1), bool)
        fresh[active] = refine(waves, residual[active], fresh[active][:, None], single, FIRST_STEPS)[0][:, 0]
        theta, start = np.concatenate([theta, fresh[:, None]], axis=1), start.joined(fresh[:, None])
        present = np.concatenate([present, np.zeros((len(h), 1), bool)], axis=1)
        trial = present[active]
        trial[:, -1] = True
        refined, solved = refine(waves, h[active], theta[active], trial, between, start[active])
        left = solved.energy
        floor = ACCURACY * energy[active]
        # Bayesian information criterion (Schwarz, 1978), of noise whose power is unknown.
        gain = 2 * count * np.log(np.maximum(best[active], floor) / np.maximum(left, floor))
        better = gain > waves.freedom * np.log(2 * count)
        improved = active[better]
        theta[improved], present[improved, -1], best[improved] = refined[better], True, left[better]
        residual[improved] = solved.residual[better]
        active = improved[best[improved] > ACCURACY * energy[improved]]
        if not len(active):
            break
    return _finish(waves, h, theta, present, final, start)


def _finish(
    waves: Waves, h: Complex, theta: FloatArray, present: Mask, steps: int, start: Start | None = None
) -> UplinkPaths:
    theta, solved = refine(waves, h, theta, present, steps, start)
    return UplinkPaths(theta, present, expected_gains(waves, h, present, solved)[0])


def expected_gains(waves: Waves, h: Complex, present: Mask, solved: Solved) -> tuple[Complex, FloatArray]:
    """Expected gains of paths, and their expected powers [n, k], from the best gains (`Waves.solve`).

    Gains are complex Gaussians a priori, each of a power of its own that makes the uplink most probable; so those of
    paths that the uplink cannot tell apart stay small. The noise is what the best gains leave.

    Source: Tipping, "Sparse Bayesian learning and the relevance vector machine" (2001), section 3 (expectation
    maximisation).
    """
    count, diagonal = h.shape[1] * h.shape[2], np.arange(present.shape[1])
    right = products(solved.atoms, h)
    tiny = np.finfo(float).tiny
    noise = solved.energy / np.maximum(count - present.sum(axis=1) * waves.freedom / 2, 1)
    mean_power = np.maximum(np.square(np.abs(h)).mean(axis=(1, 2)), tiny)
    power = np.where(present, mean_power[:, None], 0.0)
    for _ in range(PASSES):
        ridge = np.where(present, np.minimum(noise[:, None] / np.maximum(power, tiny), count / ACCURACY), 0.0)
        load = (ridge + SINGULAR * solved.atoms.shape[2])[:, :, None] * np.eye(len(diagonal))
        inverse = np.linalg.inv(solved.gram + load)
        gains = inverse @ right
        # Expectation: the gains' posterior mean and variance; maximisation: a power of their expected square.
        variance = noise[:, None] * inverse[:, diagonal, diagonal].real
        mean = np.square(np.abs(gains)).reshape(*present.shape, -1).mean(axis=2)
        power = np.where(present, mean + np.maximum(variance, 0), 0.0)
    return gains, power


def refine(
    waves: Waves, h: Complex, theta: FloatArray, present: Mask, steps: int, known: Start | None = None
) -> tuple[FloatArray, Solved]:
    """Levenberg and Marquardt's steps on all paths of each row; a step that raises the cost is discarded.

    The cost is the energy of the residual, and with ``known`` paths that of their differences from it, of which a
    standard deviation counts as much as the mean power of the residual at first.
    """
    theta, solved = theta.copy(), waves.solve(theta, present, h)
    if known is None:
        known = Start.none(len(h), theta.shape[2]).joined(theta)
    noise = solved.energy / (h.shape[1] * h.shape[2])
    known = replace(known, precision=known.precision * noise[:, None, None])
    damping = np.full(len(h), 1e-3)
    energy, total = solved.energy + known.cost(theta), np.square(np.abs(h)).sum(axis=(1, 2))
    active = np.flatnonzero(energy > ACCURACY * total)
    for _ in range(steps):
        if not len(active):
            break
        now = Solved(*(values[active] for values in vars(solved).values()))
        normal, right = waves.normal(theta[active], now)
        diagonal, precision = np.arange(normal.shape[1]), known.precision[active]
        normal[:, diagonal, diagonal] += precision.reshape(len(active), -1)
        right = right + (precision * (known.theta[active] - theta[active])).reshape(len(active), -1)
        scale = np.maximum(normal[:, diagonal, diagonal], 0)
        # An absent path has no derivatives: its diagonal must not vanish.
        scale = np.maximum(scale, 1e-12 * scale.max(axis=1, keepdims=True, initial=0) + np.finfo(float).tiny)
        normal[:, diagonal, diagonal] += damping[active, None] * scale
        # In units of the diagonal: distances and cosines differ by orders of magnitude.
        root = np.sqrt(scale)
        step = np.linalg.solve(normal / (root[:, :, None] * root[:, None]), (right / root)[..., None])[..., 0] / root
        trial = waves.limit(theta[active] + step.reshape(theta[active].shape) * present[active][..., None])
        tried = waves.solve(trial, present[active], h[active])
        left = tried.energy + known[active].cost(trial)
        better = left < energy[active]
        converged = better & (left > (1 - CONVERGED) * energy[active])
        improved = active[better]
        theta[improved] = trial[better]
        for values, new_values in zip(vars(solved).values(), vars(tried).values(), strict=True):
            values[improved] = new_values[better]
        energy[improved] = left[better]
        # Towards Gauss and Newton after a success, towards steepest descent after a failure (Marquardt, 1963).
        damping[active] = np.where(better, damping[active] / 5, damping[active] * 8).clip(1e-12, 1e6)
        done = converged | (energy[active] <= ACCURACY * total[active]) | (damping[active] >= 1e6)
        active = active[~done]
    return theta, solved
