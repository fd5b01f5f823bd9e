"""Gaussian processes of several receivers that share part of their mean.

    y_r(x) = phi_r(x) . beta + f_r(x) + e,    beta ~ N(0, diag(sd^2)),  f_r ~ GP(0, k),  e ~ Student-t

beta is common to all receivers, so that what they have in common is learned from all of them at once; the fields f_r
are independent, so that the exact posterior needs one Cholesky factor for each receiver and one of the size of beta.
The noise's heavy tails are reached by reweighting: a row whose residual is large has a larger variance.

Source: Rasmussen and Williams, "Gaussian Processes for Machine Learning" (2006), sections 2.2 and 2.7 (mean with
explicit basis functions); Lange, Little and Taylor, "Robust statistical modeling using the t distribution" (1989),
JASA 84 (the weights).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.linalg import LinAlgError
from scipy.linalg import cho_solve, cholesky, solve_triangular

from ..core.angles import FloatArray

Kernel = Callable[[Any, Any], FloatArray]
"""Covariance [n, m] of the field between two sets of places."""

JITTER = 1e-9
"""Share of the field's variance that is added where places coincide."""


@dataclass(frozen=True)
class Part:
    """What one receiver observed; n rows.

    Attributes:
        places: as the kernel takes them.
        basis: phi at each row, [n, k].
        value: y, [n].
        variance: of the noise, [n].
    """

    places: Any
    basis: FloatArray
    value: FloatArray
    variance: FloatArray


@dataclass(frozen=True)
class _Solved:
    """A receiver's factor and what it has solved: lower Cholesky factor [n, n], K^-1 phi [n, k], K^-1 y [n]."""

    factor: FloatArray
    basis: FloatArray
    value: FloatArray


class PooledProcess:
    """The posterior of all receivers.

    Attributes:
        parts: of each receiver; their variances as reweighted.
        beta: posterior mean of the shared coefficients, [k].
    """

    def __init__(self, parts: Sequence[Part], kernel: Kernel, prior_sd: FloatArray, point_variance: float) -> None:
        """Factor what was observed.

        Args:
            parts: of each receiver; may be empty of rows.
            kernel: k.
            prior_sd: of beta, [k], above zero.
            point_variance: k(x, x).

        Raises:
            LinAlgError: a covariance that is not positive definite.
        """
        self.parts, self.kernel, self.point_variance = tuple(parts), kernel, point_variance
        precision, pull = np.diag(1 / np.square(prior_sd)), np.zeros(len(prior_sd))
        self._solved = []
        for part in self.parts:
            matrix = kernel(part.places, part.places)
            matrix[np.diag_indices_from(matrix)] += part.variance + JITTER * point_variance
            factor = cholesky(matrix, lower=True, overwrite_a=True, check_finite=False) if len(matrix) else matrix
            both = np.column_stack([part.basis, part.value])
            solved = cho_solve((factor, True), both, check_finite=False) if len(matrix) else both
            self._solved.append(_Solved(factor, solved[:, :-1], solved[:, -1]))
            precision = precision + part.basis.T @ solved[:, :-1]
            pull += part.basis.T @ solved[:, -1]
        self._shared = cholesky(precision, lower=True)
        self.beta: FloatArray = cho_solve((self._shared, True), pull)

    def predict(self, receiver: int, places: Any, basis: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean and variance of phi . beta + f, without noise, at m places, [m] each.

        Args:
            receiver: number of the part.
            places: as the kernel takes them.
            basis: phi at each place, [m, k].
        """
        part, solved = self.parts[receiver], self._solved[receiver]
        cross = self.kernel(places, part.places)
        mean = basis @ self.beta + cross @ (solved.value - solved.basis @ self.beta)
        variance = np.full(len(basis), self.point_variance)
        if len(part.value):
            half = solve_triangular(solved.factor, cross.T, lower=True, check_finite=False)
            variance -= np.square(half).sum(axis=0)
        gap = solve_triangular(self._shared, (basis - cross @ solved.basis).T, lower=True)
        return mean, np.maximum(variance, 0) + np.square(gap).sum(axis=0)

    def reweighted(self, degrees: float, variance: Sequence[FloatArray]) -> list[Part]:
        """Parts whose variances follow their residuals, as a Student-t noise asks for.

        Args:
            degrees: of freedom of the noise.
            variance: scale of each row's noise, squared, [n] for each receiver.

        The expected squared residual, posterior variance of the field included, is compared with the scale:
        v = scale (degrees + e^2 / scale) / (degrees + 1).
        """
        out = []
        for part, solved, scale in zip(self.parts, self._solved, variance, strict=True):
            if not len(part.value):
                out.append(part)
                continue
            inverse = solve_triangular(solved.factor, np.eye(len(part.value)), lower=True, check_finite=False)
            precision = np.square(inverse).sum(axis=0)
            residual = part.variance * (solved.value - solved.basis @ self.beta)
            square = residual**2 + np.maximum(part.variance - part.variance**2 * precision, 0)
            out.append(replace(part, variance=scale * (degrees + square / scale) / (degrees + 1)))
        return out


def fit_pooled(
    parts: Sequence[Part],
    kernel: Kernel,
    prior_sd: FloatArray,
    point_variance: float,
    degrees: float = np.inf,
    rounds: int = 0,
) -> PooledProcess:
    """Fit, with ``rounds`` of reweighting for Student-t noise; see `PooledProcess`.

    Raises:
        LinAlgError: a covariance that is not positive definite.
    """
    process = PooledProcess(parts, kernel, prior_sd, point_variance)
    scale = [part.variance for part in parts]
    for _ in range(rounds if np.isfinite(degrees) else 0):
        process = PooledProcess(process.reweighted(degrees, scale), kernel, prior_sd, point_variance)
    return process


__all__ = ["Kernel", "LinAlgError", "Part", "PooledProcess", "fit_pooled"]
