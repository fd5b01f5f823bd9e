"""What a model takes its errors to be before it has measured anything: a Gaussian process over positions.

Errors at positions are jointly normal, and rows that were measured lower their variance by an amount that depends on
where these rows are and not on what was read there (Rasmussen and Williams, "Gaussian Processes for Machine Learning"
(2006), equation 2.24). So the worth of a measurement can be computed before it is made (`wrf_mi.apps.maps.plan`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from ..core.angles import FloatArray

JITTER = 1e-9  # share of the variance that keeps covariances of coincident positions positive definite


class Covariance(Protocol):
    """Prior covariance of errors at positions."""

    def __call__(self, a_m: FloatArray, b_m: FloatArray) -> FloatArray:
        """Covariances [n, m] between positions [n, 3] and [m, 3], metres."""


@dataclass(frozen=True)
class ErrorPrior:
    """Prior of the errors of the predictions of one receiver, and the rows that it was measured at.

    Units are those of an observation, squared; of images and channels, of the mean of their values.
    """

    covariance: Covariance
    measured_m: FloatArray  # positions of the receiver's training rows [n, 3], metres
    noise: FloatArray  # variance of each of these observations about what the model predicts [n]
    new_noise: float  # variance of a further observation

    def posterior(self, positions_m: FloatArray) -> FloatArray:
        """Covariances of the errors at positions [m, 3] after the training rows, [m, m]."""
        # One evaluation for rows and positions: terms of a scene are traced anew in each.
        count = len(self.measured_m)
        total = self.covariance(*[np.concatenate([self.measured_m, positions_m])] * 2)
        prior, cross, rows = total[count:, count:], total[:count, count:], total[:count, :count]
        if not count:
            return prior
        rows[np.diag_indices(count)] += self.noise + JITTER * rows.diagonal().max()
        return np.asarray(prior - cross.T @ cho_solve(cho_factor(rows, lower=True), cross))


def with_columns(
    covariance: Covariance, columns: Callable[[FloatArray], FloatArray], deviation: FloatArray
) -> Covariance:
    """The covariance of a field and of independent terms: columns [n, k] of positions, with deviations [k]."""

    def total(a_m: FloatArray, b_m: FloatArray) -> FloatArray:
        of_a = columns(a_m)
        of_b = of_a if b_m is a_m else columns(b_m)
        return np.asarray(covariance(a_m, b_m) + (of_a * deviation**2) @ of_b.T)

    return total
