"""Gaussian processes of several receivers that share part of their mean.

    y_r(x) = phi_r(x) . beta + f_r(x) + e,    beta ~ N(0, diag(sd^2)),  f_r ~ GP(0, k),  e ~ Student-t

beta is common to all receivers, so that what they have in common is learned from all of them at once; the fields f_r
are independent, so that the exact posterior needs one Cholesky factor for each receiver
(`wrf_mi.models.interpolation.kriging_equations`). The noise's heavy tails are reached by reweighting: a row whose
residual is large has a larger variance.

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
            numpy.linalg.LinAlgError: a covariance that is not positive definite.
        """
        self.parts, self.kernel, self.point_variance = tuple(parts), kernel, point_variance
        jitter = JITTER * point_variance
        self._systems = [KrigingSystem(kernel(p.places, p.places), p.variance + jitter, p.basis) for p in self.parts]
        pairs = list(zip(self._systems, self.parts, strict=True))
        self._information = np.diag(1 / np.square(prior_sd)) + sum(system.information for system in self._systems)
        self.beta = np.linalg.solve(self._information, sum(system.projected(part.value) for system, part in pairs))
        self._weights = [system.weights(part.value, self.beta) for system, part in pairs]

    def predict(self, receiver: int, places: Any, basis: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean and variance of phi . beta + f, without noise, at m places, [m] each.

        Args:
            receiver: number of the part.
            places: as the kernel takes them.
            basis: phi at each place, [m, k].
        """
        cross = self.kernel(places, self.parts[receiver].places)
        mean = basis @ self.beta + cross @ self._weights[receiver]
        return mean, self._systems[receiver].variance(self.point_variance, cross, basis, self._information)

    def reweighted(self, degrees: float, variance: Sequence[FloatArray]) -> list[Part]:
        """Parts whose variances follow their residuals, as a Student-t noise asks for.

        Args:
            degrees: of freedom of the noise.
            variance: scale of each row's noise, squared, [n] for each receiver.

        The expected squared residual, posterior variance of the field included, is compared with the scale:
        v = scale (degrees + e^2 / scale) / (degrees + 1).
        """
        out = []
        for part, system, weights, scale in zip(self.parts, self._systems, self._weights, variance, strict=True):
            precision = np.square(system.whiten(np.eye(len(part.value)))).sum(axis=0)
            residual = part.variance * weights
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
        numpy.linalg.LinAlgError: a covariance that is not positive definite.
    """
    process = PooledProcess(parts, kernel, prior_sd, point_variance)
    scale = [part.variance for part in parts]
    for _ in range(rounds if np.isfinite(degrees) else 0):
        process = PooledProcess(process.reweighted(degrees, scale), kernel, prior_sd, point_variance)
    return process
