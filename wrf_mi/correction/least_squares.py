"""Least squares with correlated, heavy-tailed errors and a Gaussian prior, in NumPy.

The residuals r_i of a row i (the pixels of a spectrum, the subcarriers of a channel) are correlated, and rows that the
model cannot explain (behind furniture that no scan saw) have large ones. A row counts as n_eff independent values of
variance s^2, and its log-likelihood is that of Student's t distribution with `FREEDOM` degrees of freedom:

    -log L = sum_i (FREEDOM + n_eff) / 2 log(1 + n_eff m_i / (FREEDOM s^2)),   m_i = mean of r_i^2

with n_eff = tr(R)^2 / tr(R^2) of the covariance R of the residuals, the participation ratio of its eigenvalues.

Source: Gauss-Newton with iterated weights, Nocedal and Wright, "Numerical Optimization" (2006), section 10.3; t
distribution, Lange, Little and Taylor, "Robust Statistical Modeling Using the t Distribution", JASA 84 (1989).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ..core.types import FloatArray, IntArray

FREEDOM = 4.0  # degrees of freedom of the rows' t distribution: ten times the median squared error weighs a quarter
MEDIAN_OF_MEAN = 0.8
"""Median of a row's mean squared residual in units of the variance: that of a chi-squared variable of 3 to 10 degrees
of freedom, divided by its mean, is 0.79 to 0.93."""
LEAST_VARIANCE = (
    1e-10  # smallest variance of a residual in a unit of about 1: observations are rounded to single precision
)
TRIALS = 8  # largest number of damping factors tried in a step, each `HARDER` times the one before
HARDER = 8.0  # factor of the damping after a step that fails, and its inverse after one that succeeds
FIRST_DAMPING, LEAST_DAMPING = 1e-3, 1e-6  # damping of the first step and the smallest, relative to the diagonal
CONVERGED = 0.1  # least decrease of the cost in a step: a parameter off by a standard deviation costs 0.5
T = TypeVar("T")
Linearised = tuple[Callable[[T], float], FloatArray, FloatArray]
"""A likelihood at a step: cost of what a model has, and its information [k, k] and gradient [k] by the free entries."""


@dataclass(frozen=True)
class Noise:
    """Size and correlation of the residuals of a row."""

    variance: float  # s^2, in squares of the residuals' unit
    values: float  # n_eff, number of independent values in a row

    @classmethod
    def of(cls, residual: FloatArray) -> Noise:
        """Noise of residuals [rows, values]; a row without observation is NaN."""
        observed = residual[np.isfinite(residual).all(axis=1)]
        count = _independent(observed)
        # A median, which rows that nothing explains do not move.
        variance = float(np.median(np.square(observed).mean(axis=1))) / MEDIAN_OF_MEAN if len(observed) else 1.0
        return cls(max(variance, LEAST_VARIANCE), min(max(count, 1.0), float(residual.shape[1])))

    def cost(self, residual: FloatArray) -> float:
        """Negative logarithm of the likelihood of residuals [rows, values]."""
        return float(self.costs(np.square(residual).mean(axis=1)))

    def costs(self, mean_squares: FloatArray) -> FloatArray:
        """The same of means of each row's squared residuals [..., rows], NaN without observation: [...]."""
        return np.asarray((FREEDOM + self.values) / 2 * np.log1p(self._excess(mean_squares)).sum(axis=-1))

    def weights(self, residual: FloatArray) -> FloatArray:
        """Weights [rows] of squared residuals: (FREEDOM + n_eff) / FREEDOM / s^2 at most, 0 without observation."""
        # They are divided by values per independent value: sums over all values are then sums over independent ones.
        share = self.values / residual.shape[1] / self.variance
        mean = np.square(residual).mean(axis=1)
        weight = share * (FREEDOM + self.values) / FREEDOM / (1 + self._excess(mean))
        return np.where(np.isfinite(mean), weight, 0)

    def _excess(self, mean_squares: FloatArray) -> FloatArray:
        mean = np.where(np.isfinite(mean_squares), mean_squares, 0)
        return np.asarray(self.values * mean / (FREEDOM * self.variance))


def _independent(residual: FloatArray) -> float:
    """Participation ratio of the eigenvalues of the covariance of rows [n, values] of equal length."""
    # tr(R^2) is estimated from pairs of different rows: with the rows themselves it is too large by a share of values /
    # n. Rows of unit length, as a few of large residuals would outweigh all others.
    size = np.linalg.norm(residual, axis=1, keepdims=True)
    unit = (residual / np.where(size > 0, size, 1))[size[:, 0] > 0]
    # The smaller of the two products of the matrix with its transpose: their squares have equal traces.
    product = unit.T @ unit if unit.shape[1] <= len(unit) else unit @ unit.T
    pairs = float(np.square(product).sum()) - len(unit)
    if len(unit) < 2:
        return 1.0
    return len(unit) * (len(unit) - 1) / pairs if pairs > 0 else float(residual.shape[1])


@dataclass(frozen=True)
class Prior:
    """Gaussian prior of p parameters: mean [p] and inverse covariance [p, p]."""

    mean: FloatArray
    precision: FloatArray

    def cost(self, vector: FloatArray) -> float:
        """Negative logarithm of the density, without its constant."""
        away = vector - self.mean
        return float(away @ self.precision @ away) / 2


@dataclass(frozen=True)
class Jacobian:
    """Derivatives of residuals [rows, values] by k parameters, 0 without observation.

    An observation of few signals has few independent derivatives: those of a row may be stated by their coefficients in
    an orthonormal basis, so that sums over values are over coefficients.
    """

    columns: NDArray[np.floating]  # derivatives [k, rows, values], or coefficients [k, rows, m]
    basis: NDArray[np.floating] | None = None  # orthonormal vectors [rows, values, m]

    def at(self, row: int) -> FloatArray:
        """Derivatives of a row's values [k, values]."""
        columns = self.columns[:, row]
        return (columns if self.basis is None else columns @ self.basis[row].T).astype(float)

    def normal(self, residual: FloatArray, noise: Noise) -> tuple[FloatArray, FloatArray]:
        """Fisher information [k, k] and gradient [k] at residuals [rows, values]."""
        # J W J^T and J W r with W split between both factors: one product in the precision of the derivatives.
        root = np.sqrt(noise.weights(residual))[:, None]
        kind = self.columns.dtype
        scaled = (self.columns * root.astype(kind)).reshape(len(self.columns), -1)
        values = (np.where(root > 0, residual, 0) * root).astype(kind)
        if self.basis is not None:
            values = np.matmul(values[:, None], self.basis)
        return (scaled @ scaled.T).astype(float), (scaled @ values.ravel()).astype(float)


Residuals = Callable[[FloatArray], FloatArray]  # residuals [rows, values] of a vector [p]
Derivatives = Callable[[FloatArray], Jacobian]


def minimised(
    residual: Residuals,
    jacobian: Derivatives,
    start: FloatArray,
    free: IntArray,
    prior: Prior,
    steps: int,
    on_step: Callable[[int], None] = lambda step: None,
    noise: Noise | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Levenberg-Marquardt steps from ``start``; each decreases the cost, as the noise has it.

    ``residual`` gives residuals [rows, values] of parameters [p], model minus observation, NaN without observation;
    ``jacobian`` their derivatives by the entries ``free`` [k], whose prior is ``prior``. ``on_step`` is called with the
    number of a step, from 0, before it. ``noise`` is that of all steps; None: of the residuals before each. Returns the
    most probable parameters [p] and their residuals.
    """

    # Iterated weights: the noise, and by it the weight of each row, is that of the residuals before a step.
    def linearised(vector: FloatArray, present: FloatArray) -> Linearised[FloatArray]:
        of_step = noise or Noise.of(present)
        return of_step.cost, *jacobian(vector).normal(present, of_step)

    return damped_steps(residual, linearised, start, free, prior, steps, on_step)


def damped_steps(
    evaluated: Callable[[FloatArray], T],
    linearised: Callable[[FloatArray, T], Linearised[T]],
    start: FloatArray,
    free: IntArray,
    prior: Prior,
    steps: int,
    on_step: Callable[[int], None],
) -> tuple[FloatArray, T]:
    """`minimised` for any model, ``evaluated`` at parameters [p] and ``linearised`` there before each step."""
    vector, damping = np.array(start, float), FIRST_DAMPING
    present = evaluated(vector)
    for step in range(steps):
        on_step(step)
        cost, information, slope = linearised(vector, present)
        before = cost(present) + prior.cost(vector[free])
        matrix = information + prior.precision
        # Gauss-Newton equations of likelihood and prior, damped by their diagonal (Marquardt).
        downhill = -slope - prior.precision @ (vector[free] - prior.mean)
        for _ in range(TRIALS):
            trial = vector.copy()
            trial[free] += np.linalg.solve(matrix + damping * np.diag(np.diag(matrix)), downhill)
            tried = evaluated(trial)
            after = cost(tried) + prior.cost(trial[free])
            if after < before:
                break
            damping *= HARDER
        else:
            break
        vector, present, damping = trial, tried, max(damping / HARDER, LEAST_DAMPING)
        if before - after < CONVERGED:
            break
    return vector, present


def posterior_covariance(derivative: Jacobian, residual: FloatArray, prior: Prior, noise: Noise) -> FloatArray:
    """Covariance [p, p] at a solution of derivatives by p parameters, residuals [rows, values], prior and noise."""
    return np.asarray(np.linalg.inv(derivative.normal(residual, noise)[0] + prior.precision), float)


def left_out_residuals(derivative: Jacobian, residual: FloatArray, covariance: FloatArray, noise: Noise) -> FloatArray:
    """Residuals [rows, values] of each row by a fit to the others, to first order; NaN without observation.

    Derivatives by p parameters, residuals [rows, values], covariance [p, p] and noise are those of the solution.
    Source: the residual of a row over one minus its leverage, Cook and Weisberg, "Residuals and Influence in
    Regression" (1982), section 2.2; here of all values of a row.
    """
    left_out = np.full(residual.shape, np.nan)
    for row in np.flatnonzero(np.isfinite(residual).all(axis=1)).tolist():
        # Leverage of all values of a row: w J^T C J.
        slope = derivative.at(row)
        leverage = noise.weights(residual[row : row + 1])[0] * slope.T @ covariance @ slope
        left_out[row] = np.linalg.solve(np.eye(len(leverage)) - leverage, residual[row])
    return left_out
