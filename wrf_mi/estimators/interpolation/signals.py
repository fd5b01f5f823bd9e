"""Element signals as a Gaussian process over transmitter positions, from spectra without a common phase.

A spectrum determines its element signals up to a common phase and scale, and for an array that is its own mirror image
up to the exchange with the mirrored conjugate (`wrf_mi.receivers.retrieve`). Rows are aligned with their neighbours;
then, in turn, the principal components of the signals are taken as independent complex Gaussian processes, whose
covariances are fitted, and each row is aligned (phase, and exchange) with its prediction from all others. Of the two
exchanges of all rows at once that of greater likelihood is kept: waves leave towards the receiver, not away from it.

A wave that leaves the transmitter towards unit vector q turns its phase by k q . (x - x') between two positions;
relative to the line of sight, which leaves towards q0, by k (q - q0) . (x - x'). Near scatterers and obstacles limit
its coherence to some length. So the covariance of a signal without the phase of the line of sight is a sum, with
shares >= 0, of

    exp(-|x - x'| / length) exp(j k (q - q0) . (x - x'))

over lengths and over directions q around q0, and of noise.

Source: the double-directional channel, Molisch, "Wireless Communications" (2011), section 6.7; shares by the
minorise-maximise steps of Zhou, Hu, Zhou and Lange, "MM algorithms for variance components models" (2019).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.distance import cdist

from ...core.angles import FloatArray, fibonacci_sphere
from ...core.types import IntArray
from ...parallel.threads import on_threads
from ...receivers.array import mirror_order
from ...receivers.retrieve import align_signals
from .kriging_equations import KrigingSystem, chosen_rows, left_out

ComplexArray = NDArray[np.complex128]
LEAST_NOISE = 3e-3  # least noise as a share of a signal's power, below the resolution of 8-bit spectra
NEGLIGIBLE = 1e-4  # shares below this part of the greatest are dropped during the iteration
TINY = 1e-100  # least denominator
RICH = 8  # principal components with the whole dictionary; the others, some per cent of the power, have no turns
ROUNDS = 3  # fits of the covariances, between which rows are aligned with their predictions
STEPS = 25  # minorise-maximise steps of a fit of shares, most of its time
SWEEPS = 3  # sweeps of alignment in each round: rows stop changing after two
LEAST_POWER = 1e-6  # least power of a component, a row's being 1: with fewer rows than elements some are only rounding
MOST_ROWS = 320  # rows of the fit of shares at most: its time grows with their cube


@dataclass(frozen=True)
class Covariances:
    """Dictionary of covariances: each length of coherence [s] (metres) with each turn [t, 3].

    Turns are phase gradients k (q - q0), rad/m; the first is zero.
    """

    lengths_m: FloatArray
    turns: FloatArray

    @property
    def count(self) -> int:
        """Number of covariances."""
        return len(self.lengths_m) * len(self.turns)

    def mixed(self, a_m: FloatArray, b_m: FloatArray, weight: FloatArray) -> ComplexArray:
        """Sums with weights [s, count] between positions [n, 3] and [m, 3] (metres), shape [s, n, m]."""
        distance = cdist(a_m, b_m)
        waves_a, waves_b = np.exp(1j * (a_m @ self.turns.T)), np.exp(1j * (b_m @ self.turns.T))
        total = np.zeros((len(weight), *distance.shape), complex)
        for length, shares in enumerate(weight.reshape(len(weight), len(self.lengths_m), -1).swapaxes(0, 1)):
            decay = np.exp(-distance / self.lengths_m[length])
            for matrix, share in zip(total, shares, strict=True):
                _add_waves(matrix, decay, waves_a, share, waves_b)
        return total


def _add_waves(
    total: ComplexArray, decay: FloatArray, waves_a: ComplexArray, shares: FloatArray, waves_b: ComplexArray
) -> None:
    """Add the covariances of one length with shares [t] of waves [n, t] and [m, t], in place."""
    used = np.flatnonzero(shares)
    if len(used):
        # A sum over turns of outer products is a product of two thin matrices; the dictionary would not fit in memory.
        total += decay * ((waves_a[:, used] * shares[used]) @ waves_b[:, used].conj().T)


class RowCovariances:
    """The dictionary's covariances between rows at positions [n, 3], metres, never as ``count`` matrices [n, n]."""

    def __init__(self, covariances: Covariances, tx_pos_m: FloatArray) -> None:
        distance = cdist(tx_pos_m, tx_pos_m)
        self.lengths, self.count = len(covariances.lengths_m), covariances.count
        self._decay: FloatArray = np.exp(-distance / covariances.lengths_m[:, None, None])
        self._wave: ComplexArray = np.exp(1j * (tx_pos_m @ covariances.turns.T))
        # Traces are sums of n^2 terms for a step that tends to its fixed point anyway: single precision is enough.
        self._coarse = self._decay.astype(np.float32), self._wave.astype(np.complex64)

    def mixed(self, weight: FloatArray) -> ComplexArray:
        """Sum of the covariances times weights [count], [n, n]."""
        total = np.zeros(self._decay.shape[1:], complex)
        for decay, shares in zip(self._decay, weight.reshape(self.lengths, -1), strict=True):
            _add_waves(total, decay, self._wave, shares, self._wave)
        return total

    def traces(self, matrix: NDArray[Any], weight: FloatArray) -> FloatArray:
        """Trace of each covariance times a Hermitian matrix [n, n], [count]; 0 where its weight is."""
        traces, single = np.zeros((self.lengths, self.count // self.lengths)), matrix.astype(np.complex64)
        for trace, decay, shares in zip(traces, self._coarse[0], weight.reshape(self.lengths, -1), strict=True):
            used = np.flatnonzero(shares)
            waves = self._coarse[1][:, used]
            trace[used] = np.einsum("nt,nt->t", waves.conj(), (decay * single) @ waves).real
        return traces.ravel()


def departures(towards: FloatArray, wavenumber: float, cone_deg: float, count: int) -> FloatArray:
    """Turns [t, 3], rad/m, of waves that leave within a cone around the line of sight; the first is zero.

    ``towards`` [3] is the unit vector to the receiver; the cone's directions are those of ``count`` on the sphere.
    """
    directions = fibonacci_sphere(count)
    inside = directions[directions @ towards > np.cos(np.radians(cone_deg))]
    return np.concatenate([np.zeros((1, 3)), wavenumber * (inside - towards)])


def fit_shares(
    signal: ComplexArray, covariances: RowCovariances, steps: int, least_power: float = 0.0, used: slice = slice(None)
) -> tuple[FloatArray, float, float]:
    """Shares of greatest likelihood of a complex Gaussian signal [n] with a dictionary of covariances.

    Each of the ``steps`` raises the likelihood; a signal below ``least_power`` is taken to have that power. ``used``
    are the covariances that may have shares.

    Returns:
        Share of each covariance [count], >= 0; variance of the noise; twice the negative logarithm of the likelihood
        without its constant.
    """
    power = max(float(np.mean(np.abs(signal) ** 2)), least_power, TINY)
    weight, noise = np.zeros(covariances.count), 0.1 * power
    weight[used] = 1.0
    weight *= power / weight.sum()
    for step in range(steps + 1):
        system = KrigingSystem(covariances.mixed(weight), noise)
        solved = system.solve(signal)
        if step == steps:
            break
        inverse = system.precision
        # A minorise-maximise step (Zhou et al.): share *= sqrt(y^H P V P y / tr(P V)), P the inverse of the
        # covariance. Both sides are scaled by the power, so that float32 holds them whatever the signal's power.
        explained = covariances.traces(np.outer(solved, solved.conj()) * power, weight)
        expected = covariances.traces(inverse * power, weight)
        weight *= np.sqrt(np.maximum(explained, 0) / np.maximum(expected, TINY))
        weight[weight < NEGLIGIBLE * weight.max()] = 0  # these vanish in the limit, and cost as much as the others
        noise *= np.sqrt(float((np.abs(solved) ** 2).sum()) / float(np.trace(inverse).real))
        noise = max(noise, LEAST_NOISE * power)  # without noise the covariance is singular where rows coincide
    cost = float((signal.conj() @ solved).real) + system.log_determinant
    return weight, noise, cost


@dataclass(frozen=True)
class Posterior:
    """Element signals at q positions: independent complex Gaussian components, the columns of ``basis`` [m, m].

    ``mean`` [q, m] is in elements, ``variance`` [q, m] and, far from all measurements, ``prior`` [m] in components.
    """

    mean: ComplexArray
    variance: FloatArray
    basis: ComplexArray
    prior: FloatArray

    @property
    def ignorance(self) -> FloatArray:
        """Posterior variance as a share of the prior variance, [q]: 0 known, 1 unknown."""
        return np.asarray(self.variance.sum(axis=1) / self.prior.sum())


@dataclass(eq=False)
class SignalProcess:
    """Gaussian process of element signals, conditioned on aligned signals [n, m] of training rows at positions [n, 3].

    Attributes:
        basis: principal components in its columns, [m, m].
        weight, noise: shares of the dictionary [m, c] and variance of the noise [m] of each component.
    """

    tx_pos_m: FloatArray
    signals: ComplexArray
    covariances: Covariances
    basis: ComplexArray
    weight: FloatArray
    noise: FloatArray

    def __post_init__(self) -> None:
        """Factor the covariances of the components."""
        self._components: ComplexArray = self.signals @ self.basis.conj()
        mixed = self.covariances.mixed(self.tx_pos_m, self.tx_pos_m, self.weight)
        self._systems = [KrigingSystem(matrix, level) for matrix, level in zip(mixed, self.noise, strict=True)]
        pairs = zip(self._systems, self._components.T, strict=True)
        self._solved: ComplexArray = np.stack([system.solve(component) for system, component in pairs])

    @cached_property
    def precision(self) -> ComplexArray:
        """Inverse covariance of the rows for each component, [m, n, n]."""
        return np.stack([system.precision for system in self._systems])

    def forget_precision(self) -> None:
        """Free `precision`, as large as the factors; `held_out` alone needs it, and computes it anew."""
        self.__dict__.pop("precision", None)

    def predict(self, tx_pos_m: ArrayLike) -> Posterior:
        """Posterior at positions [q, 3], metres."""
        # Simple kriging of each component: its mean is zero, as the phase of a row is arbitrary.
        cross = self.covariances.mixed(np.asarray(tx_pos_m, float), self.tx_pos_m, self.weight)
        mean = np.einsum("cqi,ci->qc", cross, self._solved)
        whitened = (system.whiten(part.conj().T) for system, part in zip(self._systems, cross, strict=True))
        explained = np.stack([np.square(np.abs(part)).sum(axis=0) for part in whitened], axis=1)
        return self._posterior(mean, self.prior - explained)

    @property
    def prior(self) -> FloatArray:
        """Variance of each component without measurements, [m], noise included."""
        return np.asarray(self.weight.sum(axis=1) + self.noise)

    def _posterior(self, mean: ComplexArray, variance: FloatArray) -> Posterior:
        # Noise included, below which rounding must not take the variance.
        return Posterior(mean @ self.basis.T, np.maximum(variance, self.noise), self.basis, self.prior)

    def held_out(self, radius_m: float, rows: IntArray) -> Posterior:
        """Posterior at training rows [q] from the rows further away than ``radius_m``."""
        mean = np.zeros((len(rows), len(self.noise)), complex)
        variance = np.tile(self.prior, (len(rows), 1))
        near = cdist(self.tx_pos_m[rows], self.tx_pos_m) <= radius_m
        for number, row in enumerate(rows):
            for c, precision in enumerate(self.precision) if not near[number].all() else ():
                weights, variance[number, c] = left_out(precision, np.flatnonzero(near[number]), row)
                mean[number, c] = weights @ self._components[:, c]
        return self._posterior(mean, variance)


def fit_signals(
    signals: ComplexArray,
    tx_pos_m: FloatArray,
    elements_m: FloatArray,
    covariances: Covariances,
    seed: int = 0,
    on_progress: Callable[[float], None] = lambda share: None,
) -> SignalProcess:
    """Align signals [n, m] of rows, of any phase and scale, and fit the process.

    Positions [n, 3] and elements [m, 3] are in metres; ``seed`` chooses rows where there are more than `MOST_ROWS`.
    """
    unit = signals / np.linalg.norm(signals, axis=1, keepdims=True)
    opposite = mirror_order(elements_m)
    aligned = align_signals(unit, tx_pos_m, elements_m)
    chosen = chosen_rows(len(unit), MOST_ROWS, seed)
    dictionary = RowCovariances(covariances, tx_pos_m[chosen])
    # A mirror-symmetric array leaves two solutions for all rows at once: both are fitted, the likelier one wins.
    exchanges = [aligned] if opposite is None else [aligned, aligned[:, opposite].conj()]
    fits = []
    for turn, exchange in enumerate(exchanges):
        rows = exchange[chosen]
        for number in range(ROUNDS):
            cost, process = _fit(rows, tx_pos_m[chosen], covariances, dictionary)
            if number < ROUNDS - 1:
                rows = realigned(process, opposite)
            on_progress((turn * ROUNDS + number + 1) / (ROUNDS * len(exchanges)))
        fits.append((cost, process))
    _, process = min(fits, key=lambda fit: fit[0])
    if len(chosen) == len(unit):
        return process
    # The rows that were not fitted are aligned with their predictions from those that were.
    metric, predicted = np.eye(unit.shape[1], dtype=complex), process.predict(tx_pos_m).mean
    every = np.stack([_aligned(row, metric, target, opposite) for row, target in zip(unit, predicted, strict=True)])
    return SignalProcess(tx_pos_m, every, covariances, process.basis, process.weight, process.noise)


def _fit(
    rows: ComplexArray, tx_pos_m: FloatArray, covariances: Covariances, dictionary: RowCovariances
) -> tuple[float, SignalProcess]:
    """Fit of the shares of each principal component, and its cost."""
    basis = np.linalg.eigh(rows.T @ rows.conj() / len(rows))[1][:, ::-1]
    straight = slice(None, None, len(covariances.turns))  # the first turn of each length is zero
    components = (rows @ basis.conj()).T

    def fit_component(c: int) -> tuple[FloatArray, float, float]:
        return fit_shares(components[c], dictionary, STEPS, LEAST_POWER, slice(None) if c < RICH else straight)

    weight, noise, costs = zip(*on_threads(fit_component, range(len(components))), strict=True)
    return sum(costs), SignalProcess(tx_pos_m, rows, covariances, basis, np.stack(weight), np.array(noise))


def realigned(process: SignalProcess, opposite: IntArray | None) -> ComplexArray:
    """Rows [n, m] aligned with their predictions from all others, in the metric of the predictions' precision.

    ``opposite`` is the order of the elements in the mirror image [m], or None for an array without one.
    """
    basis, precision = process.basis, process.precision
    rows = process.signals.copy()
    components = rows @ basis.conj()
    for _ in range(SWEEPS):
        for i in range(len(rows)):
            # Each row from all others by the rows of the precision (Dubrule, 1983), component by component.
            certainty = precision[:, i, i].real
            others = components[i] - np.einsum("cj,jc->c", precision[:, i], components) / certainty
            rows[i] = _aligned(rows[i], (basis * certainty) @ basis.conj().T, others @ basis.T, opposite)
            components[i] = rows[i] @ basis.conj()
    return rows


def _aligned(row: ComplexArray, metric: ComplexArray, target: ComplexArray, opposite: IntArray | None) -> ComplexArray:
    """The row, or its mirrored conjugate, times the phase that brings it nearest to a target."""
    candidates: list[tuple[float, ComplexArray]] = []
    for choice in [row] if opposite is None else [row, row[opposite].conj()]:
        # |t - r e^jp|^2 in the metric is least at the phase p of r^H M t, and then falls by 2 |r^H M t| - r^H M r.
        overlap = np.vdot(choice, metric @ target)
        gain = 2 * float(np.abs(overlap)) - float(np.vdot(choice, metric @ choice).real)
        candidates.append((gain, choice * np.exp(1j * np.angle(overlap))))
    return max(candidates, key=lambda candidate: candidate[0])[1]
