"""Element signals as a Gaussian process over transmitter positions, from spectra that tell no common phase.

A spectrum tells its element signals up to a common phase and scale, and for an array that is its own mirror image up to
the exchange with the mirrored conjugate (`wrf_mi.receivers.retrieve`). Rows are turned so that neighbours agree; then,
in turn,

1. the principal components of the signals are taken as independent complex Gaussian processes, and the shares of the
   dictionary of `wrf_mi.models.physics.signal_kernels` are fitted to each, and
2. each row is turned (or exchanged) to what all others predict for it.

Of the two exchanges of all rows at once that with the greater likelihood is kept: waves leave towards the receiver,
not away from it, and that tells them apart.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.distance import cdist

from ...core.angles import FloatArray
from ...receivers.beams import mirror_order
from ...receivers.retrieve import align_signals
from ..interpolation.kriging_equations import KrigingSystem, left_out
from .signal_kernels import ComplexArray, Covariances, Shares, fit_shares

RICH = 8
"""Principal components that get the whole dictionary; the others, some per cent of the power, no turns."""
ROUNDS = 3
STEPS = 25
SWEEPS = 3
"""Of alignment in each round: rows stop changing after two."""
LEAST_POWER = 1e-6
"""Of a component, where a row's is 1: with fewer rows than elements some have nothing but numerical rounding."""
MOST_ROWS = 320
"""Shares are fitted to at most so many rows, a dictionary of 200 on which takes 300 MB."""


@dataclass(frozen=True)
class Posterior:
    """Element signals at q positions: independent complex Gaussian components.

    Attributes:
        mean: [q, m] in the elements.
        variance: of each component, [q, m].
        basis: columns are the components, [m, m].
        prior: variance of each component far from all measurements, [m].
    """

    mean: ComplexArray
    variance: FloatArray
    basis: ComplexArray
    prior: FloatArray

    @property
    def ignorance(self) -> FloatArray:
        """Variance left as a share of that without measurements, [q]: 0 known, 1 unknown."""
        return self.variance.sum(axis=1) / self.prior.sum()


class SignalProcess:
    """The process, conditioned on training rows.

    Args:
        tx_pos_m: of the rows, [n, 3], metres.
        signals: aligned, [n, m].
        covariances: the dictionary.
        basis: principal components in its columns, [m, m].
        weight: shares, [m, c].
        noise: of each component, [m].
    """

    def __init__(
        self,
        tx_pos_m: FloatArray,
        signals: ComplexArray,
        covariances: Covariances,
        basis: ComplexArray,
        weight: FloatArray,
        noise: FloatArray,
    ) -> None:
        self.tx_pos_m, self.signals, self.covariances = tx_pos_m, signals, covariances
        self.basis, self.weight, self.noise = basis, weight, noise
        self._components: ComplexArray = signals @ basis.conj()
        own = covariances.mixed(tx_pos_m, tx_pos_m, weight)
        self._inverse: ComplexArray = np.stack(
            [KrigingSystem(part, level).precision for part, level in zip(own, noise, strict=True)]
        )
        self._solved: ComplexArray = np.einsum("cij,jc->ci", self._inverse, self._components)

    def predict(self, tx_pos_m: ArrayLike) -> Posterior:
        """Posterior at positions [q, 3], metres."""
        cross = self.covariances.mixed(np.asarray(tx_pos_m, float), self.tx_pos_m, self.weight)
        mean = np.einsum("cqi,ci->qc", cross, self._solved)
        known = np.einsum("cqi,cij,cqj->qc", cross, self._inverse, cross.conj(), optimize=True).real
        return self._posterior(mean, self.prior - known)

    @property
    def prior(self) -> FloatArray:
        """Variance of each component without measurements, [m], noise included."""
        total: FloatArray = self.weight.sum(axis=1) + self.noise
        return total

    def _posterior(self, mean: ComplexArray, variance: FloatArray) -> Posterior:
        return Posterior(mean @ self.basis.T, np.maximum(variance, self.noise), self.basis, self.prior)

    def held_out(self, radius_m: float, rows: NDArray[np.int64]) -> Posterior:
        """Posterior at training rows [q] from the rows further away than ``radius_m``."""
        mean = np.zeros((len(rows), len(self.noise)), complex)
        variance = np.zeros(mean.shape)
        near = cdist(self.tx_pos_m[rows], self.tx_pos_m) <= radius_m
        for number, row in enumerate(rows):
            block = np.flatnonzero(near[number])
            if len(block) == near.shape[1]:
                variance[number] = self.prior
                continue
            for c, inverse in enumerate(self._inverse):
                weights, variance[number, c] = left_out(inverse, block, row)
                mean[number, c] = weights @ self._components[:, c]
        return self._posterior(mean, variance)

    def arrays(self) -> dict[str, NDArray]:
        """For `from_arrays`."""
        return {
            "tx_pos_m": self.tx_pos_m,
            "signals": self.signals,
            "lengths_m": self.covariances.lengths_m,
            "turns": self.covariances.turns,
            "basis": self.basis,
            "weight": self.weight,
            "noise": self.noise,
        }

    @classmethod
    def from_arrays(cls, arrays: dict[str, NDArray]) -> SignalProcess:
        """A process as `arrays` gave it."""
        names = ("tx_pos_m", "signals", "basis", "weight", "noise")
        positions, signals, basis, weight, noise = (arrays[name] for name in names)
        return cls(positions, signals, Covariances(arrays["lengths_m"], arrays["turns"]), basis, weight, noise)


def fit_signals(
    signals: ComplexArray,
    tx_pos_m: FloatArray,
    elements_m: FloatArray,
    covariances: Covariances,
    seed: int = 0,
    on_progress: Callable[[float], None] = lambda share: None,
) -> SignalProcess:
    """Align rows and fit the process.

    Args:
        signals: of each row, any phase and scale, [n, m].
        tx_pos_m: [n, 3], metres.
        elements_m: [m, 3].
        covariances: the dictionary.
        seed: chooses the rows that shares are fitted to where there are more than `MOST_ROWS`.
        on_progress: hears the share that is done.
    """
    unit = signals / np.linalg.norm(signals, axis=1, keepdims=True)
    opposite = mirror_order(elements_m)
    aligned = align_signals(unit, tx_pos_m, elements_m)
    chosen = np.arange(len(unit))
    if len(unit) > MOST_ROWS:
        chosen = np.sort(np.random.default_rng(seed).choice(len(unit), MOST_ROWS, replace=False))
    dictionary = covariances(tx_pos_m[chosen])
    exchanges = [aligned] if opposite is None else [aligned, aligned[:, opposite].conj()]
    best: tuple[float, SignalProcess] | None = None
    done, rounds = 0, ROUNDS * len(exchanges)
    for start in exchanges:
        rows = start[chosen]
        for number in range(ROUNDS):
            cost, process = _fit(rows, tx_pos_m[chosen], covariances, dictionary)
            if number < ROUNDS - 1:
                rows = _realigned(process, opposite)
            done += 1
            on_progress(done / rounds)
        if best is None or cost < best[0]:
            best = cost, process
    assert best is not None
    process = best[1]
    if len(chosen) == len(unit):
        return process
    predicted = process.predict(tx_pos_m).mean
    whole = np.stack([_turned(row, _ones(row), to, opposite) for row, to in zip(unit, predicted, strict=True)])
    return SignalProcess(tx_pos_m, whole, covariances, process.basis, process.weight, process.noise)


def _ones(row: ComplexArray) -> ComplexArray:
    return np.eye(len(row), dtype=complex)


def _fit(
    rows: ComplexArray, tx_pos_m: FloatArray, covariances: Covariances, dictionary: ComplexArray
) -> tuple[float, SignalProcess]:
    _, basis = np.linalg.eigh(rows.T @ rows.conj() / len(rows))
    basis = basis[:, ::-1]
    components = rows @ basis.conj()
    straight = np.arange(len(covariances.lengths_m)) * len(covariances.turns)
    weight = np.zeros((basis.shape[1], covariances.count))
    shares: list[Shares] = []
    for c, signal in enumerate(components.T):
        which = slice(None) if c < RICH else straight
        shares.append(fit_shares(signal, dictionary[which], STEPS, LEAST_POWER))
        weight[c, which] = shares[-1].weight
    noise = np.array([s.noise for s in shares])
    return sum(s.cost for s in shares), SignalProcess(tx_pos_m, rows, covariances, basis, weight, noise)


def _realigned(process: SignalProcess, opposite: NDArray[np.int64] | None) -> ComplexArray:
    """Each row turned towards what all others predict, in the metric of their certainty."""
    basis, inverse = process.basis, process._inverse
    rows = process.signals.copy()
    components = rows @ basis.conj()
    for _ in range(SWEEPS):
        for i in range(len(rows)):
            certainty = inverse[:, i, i].real
            others = components[i] - np.einsum("cj,jc->c", inverse[:, i], components) / certainty
            rows[i] = _turned(rows[i], (basis * certainty) @ basis.conj().T, others @ basis.T, opposite)
            components[i] = rows[i] @ basis.conj()
    return rows


def _turned(
    row: ComplexArray, certainty: ComplexArray, target: ComplexArray, opposite: NDArray[np.int64] | None
) -> ComplexArray:
    """The row, or its mirrored conjugate, times the phase that brings it nearest to a target."""
    found: list[tuple[float, ComplexArray]] = []
    for choice in [row] if opposite is None else [row, row[opposite].conj()]:
        overlap = np.vdot(choice, certainty @ target)
        gain = 2 * float(np.abs(overlap)) - float(np.vdot(choice, certainty @ choice).real)
        found.append((gain, choice * np.exp(1j * np.angle(overlap))))
    return max(found, key=lambda pair: pair[0])[1]
