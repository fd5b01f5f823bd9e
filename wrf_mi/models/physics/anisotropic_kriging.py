"""Kriging of spectra whose correlation falls at different rates along and across the line of sight.

Waves that reach one receiver leave the transmitter within a cone around the line of sight, so a step along it turns
their phases against each other less than a step across it (`wrf_mi.models.physics.signal_kernels`): on measured
spectra half as fast as across it horizontally. Grey values are exponentially correlated over the position in lengths
of its own on each of three axes, with one unknown mean; all of it of most likelihood.

Source: `wrf_mi.models.interpolation.kriging_equations`.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize
from scipy.spatial.distance import cdist

from ...core.angles import FloatArray
from ..interpolation.kriging_equations import KrigingSystem, component_root, correlation, left_out

LENGTH = (0.03, 30.0)
"""Where the likelihood looks, in wavelengths."""
NOISE = (1e-3, 1.0)
"""The same, as a share of the variance; at least what 8 bits leave."""
START = (0.3, 0.3, 0.3, 0.01)
"""Three lengths and noise from which it sets out."""
PIXELS = 4700
"""About so many tell the lengths: neighbours say the same."""
VARIANCE = 1e-12
"""Of grey values, at least: spectra that are all the same have none."""
MOST_ROWS = 400
"""Lengths are fitted to at most so many rows."""


def line_of_sight(tx_pos_m: FloatArray, receiver_m: FloatArray) -> FloatArray:
    """Unit vector [3] from the middle of transmitters [n, 3] to the receiver [3]; up where that is in their middle."""
    way = receiver_m - tx_pos_m.mean(axis=0)
    distance = float(np.linalg.norm(way))
    around = distance < 1e-6 * max(float(np.ptp(tx_pos_m, axis=0).max()), 1e-6)
    return np.array([0.0, 0.0, 1.0]) if around else way / distance


def sight_axes(tx_pos_m: FloatArray, receiver_m: FloatArray) -> FloatArray:
    """Axes [3, 3] in rows: along the mean line of sight, horizontally across it, and across both."""
    along = line_of_sight(tx_pos_m, receiver_m)
    level = np.cross([0.0, 0.0, 1.0], along)
    if np.linalg.norm(level) < 1e-6:  # straight up or down: any level axis will do
        level = np.array([1.0, 0.0, 0.0])
    level /= np.linalg.norm(level)
    return np.stack([along, level, np.cross(along, level)])


class AnisotropicKriging:
    """The interpolation, of observations of any shape.

    Args:
        tx_pos_m: of the rows, [n, 3], metres.
        observed: [n, ...], float32.
        axes: in rows, [3, 3].
        length_m: along each, [3].
        noise: share of the variance.
    """

    def __init__(
        self, tx_pos_m: FloatArray, observed: NDArray[np.float32], axes: FloatArray, length_m: FloatArray, noise: float
    ) -> None:
        self.tx_pos_m, self.observed = tx_pos_m, observed
        self.axes, self.length_m, self.noise = axes, length_m, noise
        n = len(tx_pos_m)
        self._system = KrigingSystem(self._correlation(tx_pos_m), noise, np.ones((n, 1)))
        self._precision, self._mean = self._system.precision, self._system.coefficients(np.eye(n))[0]

    def _correlation(self, tx_pos_m: FloatArray) -> FloatArray:
        here, there = (positions @ self.axes.T / self.length_m for positions in (tx_pos_m, self.tx_pos_m))
        return correlation(here, there)

    def predict(self, tx_pos_m: ArrayLike) -> NDArray[np.float32]:
        """Expected observations at positions [q, 3], metres."""
        weights = self._correlation(np.asarray(tx_pos_m, float)) @ self._precision + self._mean
        return np.tensordot(weights.astype(np.float32), self.observed, 1)

    def std(self, tx_pos_m: ArrayLike) -> NDArray[np.float32]:
        """Standard deviation of observations at positions [q, 3], metres, about `predict`."""
        cross = self._correlation(np.asarray(tx_pos_m, float))
        return self._deviation(self.noise + self._system.variance(1.0, cross, np.ones((len(cross), 1))))

    def _deviation(self, unknown: FloatArray) -> NDArray[np.float32]:
        share = np.sqrt(unknown).reshape(-1, *[1] * (self.observed.ndim - 1))
        return (share * self._scale).astype(np.float32)

    @cached_property
    def _scale(self) -> FloatArray:
        """Standard deviation of the field, shape of an observation; of most restricted likelihood."""
        flat = self.observed.reshape(len(self.observed), -1)
        centred = flat - self._mean.astype(np.float32) @ flat
        squares = np.einsum("np,np->p", self._precision.astype(np.float32) @ centred, centred)
        variance = squares / max(len(centred) - 1, 1)
        return np.sqrt(np.maximum(variance, 0)).reshape(self.observed.shape[1:])

    def held_out(self, radius_m: float, rows: NDArray[np.int64]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Both at training rows [q], from those further away than ``radius_m``; the mean of all where none is."""
        distance = cdist(self.tx_pos_m[rows], self.tx_pos_m)
        weights = np.full(distance.shape, 1 / distance.shape[1])
        unknown = np.full(len(rows), 1 + self.noise)
        for number, (row, near) in enumerate(zip(rows, distance <= radius_m, strict=True)):
            block = np.flatnonzero(near)
            if len(block) == len(near):
                continue
            weights[number], unknown[number] = left_out(self._precision, block, row)
        return np.tensordot(weights.astype(np.float32), self.observed, 1), self._deviation(unknown)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """For `from_arrays`. Observations are kept as they are."""
        return {
            "tx_pos_m": self.tx_pos_m,
            "observed": self.observed,
            "axes": self.axes,
            "length_m": self.length_m,
            "noise": np.array(self.noise),
        }

    @classmethod
    def from_arrays(cls, arrays: dict[str, NDArray[Any]]) -> AnisotropicKriging:
        """An interpolation as `arrays` gave it."""
        names = ("tx_pos_m", "observed", "axes", "length_m")
        positions, observed, axes, length = (arrays[name] for name in names)
        return cls(positions, observed, axes, length, float(arrays["noise"]))


def fit_nearby(
    tx_pos_m: FloatArray,
    observed: NDArray[np.float32],
    receiver_m: FloatArray,
    wavelength_m: float,
    seed: int = 0,
) -> AnisotropicKriging:
    """Lengths and noise of most restricted likelihood.

    Args:
        tx_pos_m: [n, 3], metres.
        observed: [n, ...].
        receiver_m: position [3], metres.
        wavelength_m: metres.
        seed: chooses rows where there are more than `MOST_ROWS`.
    """
    axes = sight_axes(tx_pos_m, receiver_m)
    chosen = np.arange(len(tx_pos_m))
    if len(chosen) > MOST_ROWS:
        chosen = np.sort(np.random.default_rng(seed).choice(len(chosen), MOST_ROWS, replace=False))
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
