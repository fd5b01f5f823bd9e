"""Gaussian processes of several receivers that share part of their mean.

    y_r(x) = phi_r(x) . beta + f_r(x) + e,    beta ~ N(0, diag(sd^2)),  f_r ~ GP(0, k),  e ~ Student-t

beta is common to all receivers and learned from all of them; the fields f_r are independent, so that the exact
posterior needs one Cholesky factor for each receiver (`wrf_mi.models.interpolation.kriging_equations`). The noise's
heavy tails are reached by reweighting: a row with a large residual has a larger variance.

Source: Rasmussen and Williams, "Gaussian Processes for Machine Learning" (2006), sections 2.2 and 2.7 (mean with
explicit basis functions); Lange, Little and Taylor, "Robust statistical modeling using the t distribution" (1989),
JASA 84 (the weights).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...core.angles import FloatArray
from ..interpolation.kriging_equations import KrigingSystem

Kernel = Callable[[Any, Any], FloatArray]
"""Covariance [n, m] of the field between two sets of inputs."""

JITTER = 1e-9
"""Noise added to coincident inputs, as a share of the field's variance."""
DEGREES = 4.0
"""Degrees of freedom of the noise's Student-t distribution: fades are deep."""


@dataclass(frozen=True)
class Part:
    """Observations of one receiver: inputs of the kernel, phi [n, k], y [n], variance of the noise [n]."""

    inputs: Any
    basis: FloatArray
    value: FloatArray
    variance: FloatArray


class PooledProcess:
    """The posterior of all receivers.

    Args:
        parts: observations of each receiver, which may have no rows.
        kernel: k.
        prior_sd: standard deviations of beta, [k], above zero.
        point_variance: k(x, x).

    Attributes:
        beta: posterior mean of the shared coefficients, [k].

    Raises:
        numpy.linalg.LinAlgError: a covariance that is not positive definite.
    """

    def __init__(self, parts: Sequence[Part], kernel: Kernel, prior_sd: FloatArray, point_variance: float) -> None:
        self._parts, self._kernel, self._point_variance = parts, kernel, point_variance
        jitter = JITTER * point_variance
        self._systems = [KrigingSystem(kernel(p.inputs, p.inputs), p.variance + jitter, p.basis) for p in parts]
        pairs = list(zip(self._systems, parts, strict=True))
        self._information = np.diag(1 / np.square(prior_sd)) + sum(system.information for system in self._systems)
        self.beta = np.linalg.solve(self._information, sum(system.projected(part.value) for system, part in pairs))
        self._weights = [system.weights(part.value, self.beta) for system, part in pairs]

    def predict(self, receiver: int, inputs: Any, basis: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean and variance [m] of phi . beta + f, without noise, at m inputs with phi ``basis`` [m, k]."""
        cross = self._kernel(inputs, self._parts[receiver].inputs)
        mean = basis @ self.beta + cross @ self._weights[receiver]
        return mean, self._systems[receiver].variance(self._point_variance, cross, basis, self._information)

    def reweighted(self, variance: Sequence[FloatArray]) -> list[Part]:
        """Parts with the noise variances that their residuals imply for Student-t noise.

        The expected squared residual, posterior variance of the field included, is compared with the squared scale
        ``variance`` of each row's noise, [n] for each receiver: v = s (degrees + e^2 / s) / (degrees + 1).
        """
        parts = []
        for part, system, weights, scale in zip(self._parts, self._systems, self._weights, variance, strict=True):
            precision = np.square(system.whiten(np.eye(len(part.value)))).sum(axis=0)
            residual = part.variance * weights
            square = residual**2 + np.maximum(part.variance - part.variance**2 * precision, 0)
            parts.append(replace(part, variance=scale * (DEGREES + square / scale) / (DEGREES + 1)))
        return parts


def fit_pooled(
    parts: Sequence[Part], kernel: Kernel, prior_sd: FloatArray, point_variance: float, rounds: int = 0
) -> PooledProcess:
    """`PooledProcess` of the same arguments after ``rounds`` of reweighting for Student-t noise."""
    process = PooledProcess(parts, kernel, prior_sd, point_variance)
    scale = [part.variance for part in parts]
    for _ in range(rounds):
        process = PooledProcess(process.reweighted(scale), kernel, prior_sd, point_variance)
    return process
