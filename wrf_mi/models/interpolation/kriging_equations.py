"""Linear prediction of Gaussian random fields: the algebra of every kriging in the package.

Observations at n rows are a trend, a field of zero mean and noise,

    y = B beta + z + e,   Cov(z + e) = K [n, n],

where K serves all components of an observation (columns of y). Simple kriging has no trend, ordinary kriging one
unknown mean, universal kriging any columns B. K and y may be complex (Hermitian covariance), B is real.

Source: Rasmussen and Williams, "Gaussian Processes for Machine Learning" (2006), sections 2.2, 2.7 and 5.4; Chiles and
Delfiner, "Geostatistics" (2012), section 3.4 (universal kriging); Patterson and Thompson, "Recovery of inter-block
information when block sizes are unequal" (1971) (restricted likelihood); Dubrule, "Cross validation of kriging in a
unique neighborhood" (1983) (rows left out).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, cholesky, solve_triangular
from scipy.spatial.distance import cdist

from ...core.angles import FloatArray
from ...core.types import IntArray

Values = NDArray[Any]

KERNELS: dict[str, Callable[[FloatArray], FloatArray]] = {
    "exponential": lambda d: np.exp(-d),
    "matern32": lambda d: (1 + np.sqrt(3) * d) * np.exp(-np.sqrt(3) * d),
    "gaussian": lambda d: np.exp(-(d**2) / 2),
}
"""Correlation over the distance in correlation lengths."""


def correlation(a: FloatArray, b: FloatArray, kernel: str = "exponential") -> FloatArray:
    """Correlations [n, m] between points [n, d] and [m, d], both in correlation lengths; ``kernel``: of `KERNELS`."""
    return KERNELS[kernel](cdist(a, b))


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

    def variance(
        self, prior: float, cross: FloatArray, trend: FloatArray | None = None, information: FloatArray | None = None
    ) -> FloatArray:
        """Variance of trend and field, without noise, about their prediction at m positions, [m].

        Args:
            prior: variance of the field without observations.
            cross: covariances with the rows [m, n], real.
            trend: columns at the positions [m, p]; None: zero mean.
            information: inverse covariance of the trend's coefficients [p, p] from more than these rows.
        """
        half = self.whiten(cross.T)
        left = np.maximum(prior - np.square(half).sum(axis=0), 0)
        if trend is None:
            return np.asarray(left)
        gap = trend - half.T @ self._trend
        known = self.information if information is None else information
        return np.asarray(left + (gap * np.linalg.solve(known, gap.T).T).sum(axis=1))

    @property
    def precision(self) -> Values:
        """K^-1 - K^-1 B (B^T K^-1 B)^-1 B^T K^-1, [n, n]: inverse covariance of contrasts free of the trend."""
        inverse = self.solve(np.eye(len(self._lower), dtype=self._lower.dtype))
        if not self.trend.shape[1]:
            return inverse
        columns = inverse @ self.trend
        return np.asarray(inverse - columns @ np.linalg.solve(self.information, columns.conj().T))

    def restricted_cost(self, root: FloatArray, least: float) -> float:
        """Minus twice the logarithm of the restricted likelihood of one component, the field's variance at its best.

        Args:
            root: `component_root` of the observations.
            least: lower limit of the residual sum of squares.
        """
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
    parts = np.concatenate([values.real, values.imag], axis=1) if np.iscomplexobj(values) else values
    if parts.shape[1] <= len(parts):
        return np.ascontiguousarray(parts)
    power, basis = np.linalg.eigh(parts @ parts.T)
    return np.asarray(basis * np.sqrt(np.maximum(power, 0)))


def left_out(precision: Values, block: IntArray, row: int) -> tuple[Values, float]:
    """Prediction of a row of a block of rows [k], k < n, from all rows outside the block.

    ``precision`` [n, n] is that of `KrigingSystem`. Returns the weights of the rows [n], zero in the block, and the
    variance of an observation about the prediction.
    """
    unit = (block == row).astype(float)
    column = np.linalg.solve(precision[np.ix_(block, block)], unit)
    weights = -column.conj() @ precision[block]
    weights[block] = 0
    return weights, float((unit @ column).real)
