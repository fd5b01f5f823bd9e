"""Kriging of spectra whose correlation falls at different rates along and across the line of sight.

Waves that reach one receiver leave the transmitter within a cone around the line of sight (`signals`), so a step along
it changes their relative phases less than a step across it: on measured spectra half as fast. Grey values have an
exponential correlation over the position, with a length for each of three axes, and one unknown mean.

Source: `wrf_mi.models.interpolation.kriging_equations`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize
from scipy.spatial.distance import cdist

from ...core.angles import FloatArray
from ...core.types import IntArray
from ..interpolation.kriging_equations import KrigingSystem, component_root, correlation, left_out

LENGTH = (0.03, 30.0)
"""Bounds of the lengths in wavelengths."""
NOISE = (1e-3, 1.0)
"""Bounds of the noise as a share of the variance, at least that of 8 bits."""
START = (0.3, 0.3, 0.3, 0.01)
"""Three lengths and noise from which the search starts."""
PIXELS = 4700
"""Approximate number of pixels in the likelihood: neighbouring pixels are redundant."""
VARIANCE = 1e-12
"""Least variance of grey values, for equal spectra."""
MOST_ROWS = 400
"""Rows in the likelihood at most."""


def line_of_sight(tx_pos_m: FloatArray, receiver_m: FloatArray) -> FloatArray:
    """Unit vector [3] from the centre of transmitters [n, 3] to the receiver [3]; up for a receiver at the centre."""
    way = receiver_m - tx_pos_m.mean(axis=0)
    distance = float(np.linalg.norm(way))
    around = distance < 1e-6 * max(float(np.ptp(tx_pos_m, axis=0).max()), 1e-6)
    return np.array([0.0, 0.0, 1.0]) if around else way / distance


def sight_axes(tx_pos_m: FloatArray, receiver_m: FloatArray) -> FloatArray:
    """Axes [3, 3] in rows: along the mean line of sight, horizontally across it, and across both."""
    along = line_of_sight(tx_pos_m, receiver_m)
    level = np.cross([0.0, 0.0, 1.0], along)
    if np.linalg.norm(level) < 1e-6:  # straight up or down: any level axis serves
        level = np.array([1.0, 0.0, 0.0])
    level /= np.linalg.norm(level)
    return np.stack([along, level, np.cross(along, level)])


def chosen_rows(count: int, most: int, seed: int) -> IntArray:
    """At most ``most`` of ``count`` rows, drawn at random, ascending."""
    if count <= most:
        return np.arange(count)
    return np.sort(np.random.default_rng(seed).choice(count, most, replace=False))


@dataclass(eq=False)
class AnisotropicKriging:
    """Ordinary kriging of observations [n, ...], float32, at positions [n, 3], with a correlation length for each axis.

    ``length_m`` [3] belongs to the rows of ``axes`` [3, 3]; ``noise`` is a share of the variance.
    """

    tx_pos_m: FloatArray
    observed: NDArray[np.float32]
    axes: FloatArray
    length_m: FloatArray
    noise: float

    def __post_init__(self) -> None:
        """Factor the covariance."""
        n = len(self.tx_pos_m)
        self._system = KrigingSystem(self._correlation(self.tx_pos_m), self.noise, np.ones((n, 1)))
        self._precision, self._mean = self._system.precision, self._system.coefficients(np.eye(n))[0]

    def _correlation(self, tx_pos_m: FloatArray) -> FloatArray:
        here, there = (positions @ self.axes.T / self.length_m for positions in (tx_pos_m, self.tx_pos_m))
        return correlation(here, there)

    def _weighted(self, weights: FloatArray) -> NDArray[np.float32]:
        return np.tensordot(weights.astype(np.float32), self.observed, 1)

    def predict(self, tx_pos_m: ArrayLike) -> NDArray[np.float32]:
        """Expected observations at positions [q, 3], metres."""
        return self._weighted(self._correlation(np.asarray(tx_pos_m, float)) @ self._precision + self._mean)

    def std(self, tx_pos_m: ArrayLike) -> NDArray[np.float32]:
        """Standard deviation of observations at positions [q, 3], metres, about `predict`."""
        cross = self._correlation(np.asarray(tx_pos_m, float))
        return self._deviation(self.noise + self._system.variance(1.0, cross, np.ones((len(cross), 1))))

    def _deviation(self, unknown: FloatArray) -> NDArray[np.float32]:
        share = np.sqrt(unknown).reshape(-1, *[1] * (self.observed.ndim - 1))
        return (share * self.scale).astype(np.float32)

    @cached_property
    def scale(self) -> FloatArray:
        """Standard deviation of the field, shape of an observation; of greatest restricted likelihood."""
        flat = self.observed.reshape(len(self.observed), -1)
        centred = flat - self._mean.astype(np.float32) @ flat
        squares = np.einsum("np,np->p", self._precision.astype(np.float32) @ centred, centred)
        variance = squares / max(len(centred) - 1, 1)
        return np.asarray(np.sqrt(np.maximum(variance, 0)).reshape(self.observed.shape[1:]))

    def held_out(self, radius_m: float, rows: IntArray) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Prediction and deviation at rows [q] from rows beyond ``radius_m``; without any, the mean of all."""
        distance = cdist(self.tx_pos_m[rows], self.tx_pos_m)
        weights = np.full(distance.shape, 1 / distance.shape[1])
        unknown = np.full(len(rows), 1 + self.noise)
        for number, (row, near) in enumerate(zip(rows, distance <= radius_m, strict=True)):
            if not near.all():
                weights[number], unknown[number] = left_out(self._precision, np.flatnonzero(near), row)
        return self._weighted(weights), self._deviation(unknown)


def fit_anisotropic(
    tx_pos_m: FloatArray, observed: NDArray[np.float32], receiver_m: FloatArray, wavelength_m: float, seed: int = 0
) -> AnisotropicKriging:
    """Kriging of observations [n, ...] with lengths and noise of greatest restricted likelihood.

    Positions [n, 3], the receiver's position [3] and the wavelength are in metres; ``seed`` chooses rows where there
    are more than `MOST_ROWS`.
    """
    axes = sight_axes(tx_pos_m, receiver_m)
    chosen = chosen_rows(len(tx_pos_m), MOST_ROWS, seed)
    local = tx_pos_m[chosen] @ axes.T / wavelength_m
    flat = observed[chosen].reshape(len(chosen), -1)
    flat = flat[:, :: max(round(flat.shape[1] / PIXELS), 1)].astype(float)
    root = component_root(flat) / np.sqrt(flat.shape[1])
    mean = np.ones((len(chosen), 1))

    def cost(logarithms: FloatArray) -> float:
        scaled = local / np.exp(logarithms[:3])
        system = KrigingSystem(correlation(scaled, scaled), np.exp(logarithms[3]), mean)
        return system.restricted_cost(root, VARIANCE) / len(root)

    bounds = [tuple(np.log(LENGTH))] * 3 + [tuple(np.log(NOISE))]
    found = np.exp(minimize(cost, np.log(START), method="L-BFGS-B", bounds=bounds).x)
    length_m, noise = found[:3] * wavelength_m, float(found[3])
    return AnisotropicKriging(tx_pos_m, np.asarray(observed, np.float32), axes, length_m, noise)
