"""Covariances of an element signal over transmitter positions, and their shares by maximum likelihood.

A wave that leaves the transmitter towards unit vector q turns its phase by k q . (x - x') between two positions; seen
from the line of sight, which leaves towards q0, by k (q - q0) . (x - x'). Scatterers that are not points at infinity,
and whatever stands between, let it lose coherence over some length. So the covariance of a signal that has the phase of
the line of sight taken out is a sum, with shares >= 0, of

    exp(-|x - x'| / length) exp(j k (q - q0) . (x - x'))

over lengths and over directions q around q0, and of noise.

Source: the double-directional channel, Molisch, "Wireless Communications" (2011), section 6.7; shares by the
minorise-maximise steps of Zhou, Hu, Zhou and Lange, "MM algorithms for variance components models" (2019).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from ...core.angles import FloatArray, fibonacci_sphere
from ..interpolation.kriging_equations import KrigingSystem

ComplexArray = NDArray[np.complex128]

LEAST_NOISE = 3e-3
"""Of a signal's power: below what 8-bit spectra tell of it."""
NEGLIGIBLE = 1e-4
"""Shares below this part of the greatest are dropped on the way."""
TINY = 1e-100
"""Stands for zero where something is divided by it."""


@dataclass(frozen=True)
class Covariances:
    """A dictionary of covariances: each length with each turn.

    Attributes:
        lengths_m: over which coherence is lost, [s], metres.
        turns: phase gradients k (q - q0), [t, 3], rad/m; the first one is zero.
    """

    lengths_m: FloatArray
    turns: FloatArray

    @property
    def count(self) -> int:
        """Of covariances."""
        return len(self.lengths_m) * len(self.turns)

    def __call__(self, tx_pos_m: FloatArray) -> ComplexArray:
        """Each one among positions [n, 3] (metres), shape [count, n, n], length slowest."""
        n = len(tx_pos_m)
        decay = np.exp(-cdist(tx_pos_m, tx_pos_m) / self.lengths_m[:, None, None])
        phase = np.exp(1j * (self.turns @ tx_pos_m.T))
        product: ComplexArray = decay[:, None] * (phase[:, :, None] * phase[:, None, :].conj())
        return product.reshape(self.count, n, n)

    def mixed(self, a_m: FloatArray, b_m: FloatArray, weight: FloatArray) -> ComplexArray:
        """Sums with weights [s, count] between positions [n, 3] and [m, 3] (metres), shape [s, n, m].

        A sum over turns is a product of two thin matrices: nothing as large as the dictionary is made.
        """
        distance = cdist(a_m, b_m)
        here, there = np.exp(1j * (a_m @ self.turns.T)), np.exp(-1j * (b_m @ self.turns.T))
        total = np.zeros((len(weight), *distance.shape), complex)
        for length, shares in enumerate(weight.reshape(len(weight), len(self.lengths_m), -1).swapaxes(0, 1)):
            decay = np.exp(-distance / self.lengths_m[length])
            for part, share in zip(total, shares, strict=True):
                used = np.flatnonzero(share)
                if len(used):
                    part += decay * ((here[:, used] * share[used]) @ there[:, used].T)
        return total


def departures(towards: FloatArray, wavenumber: float, cone_deg: float, count: int) -> FloatArray:
    """Turns [t, 3] of waves that leave within a cone around the line of sight; the first is that of the latter.

    Args:
        towards: unit vector from the transmitters to the receiver, [3].
        wavenumber: 2 pi over the wavelength, rad/m.
        cone_deg: half angle.
        count: directions on the whole sphere of which those in the cone are taken.
    """
    directions = fibonacci_sphere(count)
    inside = directions[directions @ towards > np.cos(np.radians(cone_deg))]
    return np.concatenate([np.zeros((1, 3)), wavenumber * (inside - towards)])


@dataclass(frozen=True)
class Shares:
    """Shares of one signal's covariance.

    Attributes:
        weight: of each covariance, [c], >= 0.
        noise: variance of the noise.
        cost: twice the negative logarithm of the likelihood, without its constant.
    """

    weight: FloatArray
    noise: float
    cost: float


def fit_shares(signal: ComplexArray, covariances: ComplexArray, steps: int, least_power: float = 0.0) -> Shares:
    """Shares of most likelihood of one complex Gaussian signal.

    Args:
        signal: [n].
        covariances: [c, n, n].
        steps: of the iteration; each raises the likelihood.
        least_power: what a signal without any is taken to have; its shares are then those of rounding.
    """
    count, n = len(covariances), len(signal)
    flat = covariances.reshape(count, -1)
    power = max(float(np.mean(np.abs(signal) ** 2)), least_power, TINY)
    weight, noise = np.full(count, power / count), 0.1 * power
    for step in range(steps + 1):
        system = KrigingSystem((weight @ flat).reshape(n, n), noise)
        solved = system.solve(signal)
        if step == steps:
            break
        inverse = system.precision
        explained = (flat @ np.outer(solved.conj(), solved).ravel()).real
        expected = (flat @ inverse.T.ravel()).real
        weight = weight * np.sqrt(np.maximum(explained, 0) / np.maximum(expected, TINY))
        weight[weight < NEGLIGIBLE * weight.max()] = 0
        noise *= np.sqrt(float((np.abs(solved) ** 2).sum()) / float(np.trace(inverse).real))
        noise = max(noise, LEAST_NOISE * power)
    cost = float((signal.conj() @ solved).real) + system.log_determinant
    return Shares(weight, noise, cost)
