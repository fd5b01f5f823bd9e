"""Linear prediction of Gaussian random fields: the algebra of every kriging in the package.

Observations at n rows are a trend, a field of zero mean and noise,

    y = B beta + z + e,   Cov(z + e) = K [n, n],

where K serves all components of an observation (columns of y). Simple kriging has no trend, ordinary kriging one
unknown mean, universal kriging any columns B. K and y may be complex (Hermitian covariance), B is real.

Waves that reach one receiver leave the transmitter within a cone around the line of sight
(`wrf_mi.estimators.interpolation.signals`), so a step along it changes their relative phases less than a step across
it: on measured spectra half as fast. `AnisotropicKriging` has an exponential correlation with a length for each of
three axes, and one unknown mean.

Source: Rasmussen and Williams, "Gaussian Processes for Machine Learning" (2006), sections 2.2, 2.7 and 5.4; Chiles and
Delfiner, "Geostatistics" (2012), section 3.4 (universal kriging); Patterson and Thompson, "Recovery of inter-block
information when block sizes are unequal" (1971) (restricted likelihood); Dubrule, "Cross validation of kriging in a
unique neighborhood" (1983) (rows left out).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import cho_solve, cholesky, solve_triangular
from scipy.linalg.lapack import get_lapack_funcs
from scipy.optimize import minimize
from scipy.spatial.distance import cdist

from ...core.angles import FloatArray
from ...core.types import IntArray
from ..model import slices

Values = NDArray[Any]

LENGTH = (0.03, 30.0)  # bounds of the lengths in wavelengths
NOISE = (1e-3, 1.0)  # bounds of the noise as a share of the variance, at least that of 8 bits
START = (0.3, 0.3, 0.3, 0.01)  # three lengths and noise from which the search starts
PIXELS = 4700  # approximate number of pixels in the likelihood: neighbouring pixels are redundant
VARIANCE = 1e-12  # least variance of grey values, for equal spectra
COLUMNS = 4096  # components that are solved for at once: 50 MB of a thousand rows and a half in double precision
MOST_ROWS = 400  # rows in the likelihood at most

KERNELS: dict[str, Callable[[FloatArray], FloatArray]] = {
    "exponential": lambda d: np.exp(-d),
    "matern32": lambda d: (1 + np.sqrt(3) * d) * np.exp(-np.sqrt(3) * d),
    "gaussian": lambda d: np.exp(-(d**2) / 2),
}
"""Correlation over the distance in correlation lengths."""


def correlation(a: FloatArray, b: FloatArray, kernel: str = "exponential") -> FloatArray:
    """Correlations [n, m] between points [n, d] and [m, d], both in correlation lengths; ``kernel``: of `KERNELS`."""
    return KERNELS[kernel](cdist(a, b))


class Block(NamedTuple):
    """What the other rows of a `KrigingSystem` tell of the m rows of a block."""

    error: Values  # observations less their prediction without a trend [m]
    gap: Values  # the same of the columns of the trend [m, p]
    variance: FloatArray  # variance of an observation, noise included, about its prediction at a known trend [m]
    information: Values  # what the trend's `KrigingSystem.information` loses without the block [p, p]
    projected: Values  # what `KrigingSystem.projected` loses without it [p]


class KrigingSystem:
    """Covariance of n rows, factored, with the columns of a trend.

    Args:
        covariance: covariance of the field at the rows, [n, n], real or complex; overwritten.
        noise: variance added to the diagonal, of all rows or of each [n].
        trend: columns B [n, p], or None: zero mean.

    Raises:
        numpy.linalg.LinAlgError: the covariance is not positive definite.
    """

    def __init__(self, covariance: Values, noise: float | FloatArray = 0.0, trend: FloatArray | None = None) -> None:
        n = len(covariance)
        covariance[np.diag_indices(n)] += noise
        self._lower = cholesky(covariance, lower=True, overwrite_a=True, check_finite=False)
        self.trend = np.zeros((n, 0)) if trend is None else trend
        self._trend = self.whiten(self.trend)

    def whiten(self, values: Values) -> Values:
        """L^-1 v of columns v [n, q], K = L L^H."""
        return np.asarray(solve_triangular(self._lower, values, lower=True, check_finite=False))

    def solve(self, values: Values) -> Values:
        """K^-1 v of columns v [n, q] or one [n]."""
        return np.asarray(cho_solve((self._lower, True), values, check_finite=False))

    @property
    def inverse_diagonal(self) -> FloatArray:
        """Diagonal of K^-1 [n]."""
        (trtri,) = get_lapack_funcs(("trtri",), (self._lower,))
        half, _ = trtri(self._lower, lower=True)  # a third of the operations of solving for the unit matrix
        return np.asarray(np.einsum("ij,ij->j", half, half.conj()).real)

    @property
    def log_determinant(self) -> float:
        """Logarithm of the determinant of K."""
        return float(2 * np.log(np.diag(self._lower).real).sum())

    @property
    def information(self) -> FloatArray:
        """B^T K^-1 B [p, p]: inverse covariance of the trend's coefficients without a prior."""
        return np.asarray(self._trend.conj().T @ self._trend)

    def projected(self, values: Values) -> Values:
        """B^T K^-1 y [p, q] of observations [n, q]."""
        return self.trend.T @ self.solve(values)

    def coefficients(self, values: Values) -> Values:
        """Coefficients [p, q] of the trend by generalised least squares of observations [n, q]."""
        return np.asarray(np.linalg.solve(self.information, self.projected(values)))

    def weights(self, values: Values, coefficients: Values) -> Values:
        """K^-1 (y - B beta) [n, q]: a prediction is b . beta plus covariances with the rows times these."""
        return self.solve(values - self.trend @ coefficients)

    def regression(self, values: Values) -> tuple[Values, Values]:
        """`coefficients` [p, q] and `weights` [n, q] of observations [n, q] of any precision, both in double precision.

        A thousand images in double precision are gigabytes, so their pixels are solved for in parts.
        """
        kind = np.result_type(values, float)
        beta, weights = (np.empty((rows, values.shape[1]), kind) for rows in (self.trend.shape[1], len(values)))
        solved_trend = self.solve(self.trend)
        for part in slices(values.shape[1], COLUMNS):
            # K^-1 y serves both: solving is most of the time, and the columns of the trend are few.
            solved = self.solve(values[:, part].astype(kind))
            beta[:, part] = np.linalg.solve(self.information, self.trend.T @ solved)
            weights[:, part] = solved - solved_trend @ beta[:, part]
        return beta, weights

    def variance(
        self, prior: float, cross: FloatArray, trend: FloatArray | None = None, covariance: FloatArray | None = None
    ) -> FloatArray:
        """Variance of trend and field, without noise, about their prediction at m positions, [m].

        Args:
            prior: variance of the field without observations.
            cross: covariances with the rows [m, n], real.
            trend: columns at the positions [m, p]; None: zero mean.
            covariance: covariance of the trend's coefficients [p, p] by more than these rows.
        """
        # k(x, x) - k^T K^-1 k (Rasmussen and Williams, equation 2.26); rounding may take it below zero.
        half = self.whiten(cross.T)
        left = np.maximum(prior - np.einsum("nm,nm->m", half, half), 0)
        if trend is None:
            return np.asarray(left)
        # And that of the trend's coefficients, R^T (B^T K^-1 B)^-1 R with R = b - B^T K^-1 k (equation 2.42).
        gap = trend - half.T @ self._trend
        if covariance is None:
            return np.asarray(left + (gap * np.linalg.solve(self.information, gap.T).T).sum(axis=1))
        return np.asarray(left + np.einsum("mp,mp->m", gap @ covariance, gap))

    @property
    def precision(self) -> Values:
        """K^-1 - K^-1 B (B^T K^-1 B)^-1 B^T K^-1, [n, n]: inverse covariance of contrasts free of the trend."""
        half = self._half_inverse()
        inverse: Values = np.tril(half) + np.tril(half, -1).conj().T
        if not self.trend.shape[1]:
            return inverse
        columns = inverse @ self.trend
        return np.asarray(inverse - columns @ np.linalg.solve(self.information, columns.conj().T))

    def _half_inverse(self) -> Values:
        """Lower triangle of K^-1 [n, n]; the rest is of no meaning."""
        (potri,) = get_lapack_funcs(("potri",), (self._lower,))
        half, _ = potri(self._lower, lower=True)  # a third of the operations of solving for the unit matrix
        return np.asarray(half)

    def without(self, blocks: Sequence[IntArray], values: Values) -> list[Block]:
        """Prediction of observations [n] of each block of rows, ascending, by all rows but these.

        It takes no further factor of n rows: a block of K^-1 is the inverse of the covariance of its rows given all
        others, and so its inverse times K^-1 y is what these others leave of the block's observations (Dubrule, 1983).
        """
        half, trend, solved = self._half_inverse(), self.solve(self.trend), self.solve(values)
        results = []
        for rows in blocks:
            system = KrigingSystem(half[np.ix_(rows, rows)])
            error, gap = system.solve(solved[rows]), system.solve(trend[rows])
            lost = trend[rows].T @ gap, trend[rows].T @ error
            if len(rows) == len(half):  # the same, and without rounding nothing is left of both
                lost = self.information, self.trend.T @ solved
            results.append(Block(error, gap, system.inverse_diagonal, *lost))
        return results

    def restricted_cost(self, root: FloatArray, least: float) -> float:
        """Minus twice the logarithm of the restricted likelihood of one component, the field's variance at its best.

        ``root`` is the `component_root` of the observations, ``least`` the lower limit of the residual sum of squares.
        """
        # Residual sum of squares of the whitened rows beside an orthonormal basis of the whitened trend, whose triangle
        # has the square root of the determinant of B^T K^-1 B.
        half = self.whiten(root)
        basis, triangle = np.linalg.qr(self._trend)
        left = max(float(np.square(half).sum() - np.square(basis.T @ half).sum()), least)
        free = len(half) - self._trend.shape[1]
        volume = self.log_determinant + 2 * np.log(np.abs(np.diag(triangle))).sum()
        return float(free * np.log(left / max(free, 1)) + volume)


def component_root(values: Values) -> FloatArray:
    """A matrix [n, r] with the same real part of Y Y^H as the components Y [n, q], r at most n.

    The likelihood needs no more of them, and an image has many more pixels than there are rows.
    """
    parts = (values.real, values.imag) if np.iscomplexobj(values) else (values,)
    if len(parts) * values.shape[1] <= len(values):
        return np.concatenate(parts, axis=1, dtype=float)
    gram = np.zeros((len(values), len(values)))
    for part in slices(values.shape[1], COLUMNS):
        for component in parts:
            columns = component[:, part].astype(float)
            gram += columns @ columns.T
    # Y Y^T = V diag(p) V^T, so V sqrt(p) serves as well; negative p are rounding.
    power, basis = np.linalg.eigh(gram)
    return np.asarray(basis * np.sqrt(np.maximum(power, 0)))


def left_out(precision: Values, block: IntArray, row: int) -> tuple[Values, float]:
    """Prediction of a row of a block of rows [k], k < n, from all rows outside the block.

    ``precision`` [n, n] is that of `KrigingSystem`. Returns the weights of the rows [n], zero in the block, and the
    variance of an observation about the prediction.
    """
    # A block of the precision is the inverse of the covariance given all other rows (Dubrule, 1983).
    unit = (block == row).astype(float)
    column = np.linalg.solve(precision[np.ix_(block, block)], unit)
    weights = -column.conj() @ precision[block]
    weights[block] = 0
    return weights, float((unit @ column).real)


def line_of_sight(tx_pos_m: FloatArray, receiver_m: FloatArray) -> FloatArray:
    """Unit vector [3] from the centre of transmitters [n, 3] to the receiver [3]; up for a receiver at the centre."""
    way = receiver_m - tx_pos_m.mean(axis=0)
    distance = float(np.linalg.norm(way))
    # A receiver among the transmitters has no line of sight in common.
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
        # In correlation lengths along the axes, in which the correlation is isotropic.
        scaled, rows = (positions @ self.axes.T / self.length_m for positions in (tx_pos_m, self.tx_pos_m))
        return correlation(scaled, rows)

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
        variance = squares / max(len(centred) - 1, 1)  # one degree of freedom went to the mean
        return np.asarray(np.sqrt(np.maximum(variance, 0)).reshape(self.observed.shape[1:]))

    def held_out(self, radius_m: float, rows: IntArray) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Prediction and deviation at rows [q] from rows beyond ``radius_m``; without any, the mean of all."""
        distance = cdist(self.tx_pos_m[rows], self.tx_pos_m)
        weights = np.full(distance.shape, 1 / distance.shape[1])
        unknown = np.full(len(rows), 1 + self.noise)
        for number, (row, near) in enumerate(zip(rows, distance <= radius_m, strict=True)):
            if not near.all():  # else no row remains, and the mean of all is as good a guess as any
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
    # In wavelengths, so that bounds and start of the search serve every carrier.
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
    *lengths, noise = np.exp(minimize(cost, np.log(START), method="L-BFGS-B", bounds=bounds).x)
    length_m = np.array(lengths) * wavelength_m
    return AnisotropicKriging(tx_pos_m, np.asarray(observed, np.float32), axes, length_m, float(noise))
