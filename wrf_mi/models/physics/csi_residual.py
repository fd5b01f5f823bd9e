"""Residuals of channels that image sources leave: a diffuse field, kriged where measurements lie close together."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import KDTree

from ...core.angles import FloatArray
from ..interpolation.kriging_equations import simple_weights
from .csi_repair import Complex

NEIGHBOURS = 32
SHARES = (0.3, 0.6, 0.9, 0.99, 0.999)
"""Candidate shares of the field in the residual power, the rest being noise; held-out rows choose."""
CERTAIN = 3.0
"""Standard errors by which predictions with the field must be better than without."""


@dataclass(frozen=True)
class DiffuseField:
    """Complex Gaussian field with covariance sin(k d) / (k d): waves from all directions with equal power.

    Source: Cook et al., "Measurement of correlation coefficients in reverberant sound fields" (1955), J. Acoust. Soc.
    Am. 27; the same holds for scalar waves of any kind.

    Attributes:
        position_m: positions of the rows [n, 3].
        value: residual channels there [n, subcarriers].
        k: mean wave number, rad/m.
        power: mean of abs(value)^2.
        share: share of the field in the power; the rest is noise of each row.
    """

    position_m: FloatArray
    value: Complex
    k: float
    power: float
    share: float

    def predict(self, position_m: FloatArray, skip: int = 0) -> tuple[Complex, FloatArray]:
        """Mean [m, subcarriers] and variance [m] of residuals, noise included, at positions [m, 3] in metres.

        The ``skip`` nearest rows are not used: 1 leaves out the row at the position itself.
        """
        count = len(position_m)
        if self.share == 0 or len(self.position_m) <= skip:
            return np.zeros((count, self.value.shape[1]), complex), np.full(count, self.power)
        near = min(NEIGHBOURS, len(self.position_m) - skip)
        distance, index = KDTree(self.position_m).query(position_m, k=list(range(1 + skip, near + skip + 1)))
        between = np.linalg.norm(self.position_m[index][:, :, None] - self.position_m[index][:, None], axis=-1)
        matrix = self.share * np.sinc(self.k * between / np.pi) + (1 - self.share) * np.eye(near)
        across = self.share * np.sinc(self.k * distance / np.pi)
        weight, known = simple_weights(matrix, across)
        mean = np.einsum("mn,mnf->mf", weight, self.value[index])
        return mean, self.power * np.maximum(1 - known, 1e-6)


def fit_diffuse(position_m: FloatArray, value: Complex, k: float) -> DiffuseField:
    """The field whose share predicts each row best from the others (logarithmic score).

    ``value`` [n, subcarriers] holds residual channels at positions [n, 3] in metres, ``k`` the mean wave number, rad/m.
    """
    power = float(np.square(np.abs(value)).mean()) if len(value) else 0.0
    best = DiffuseField(position_m, value, k, power, 0.0)
    if power == 0 or len(value) <= 2:
        return best
    lowest = _scores(best)
    for share in SHARES:
        field = replace(best, share=share)
        scores = _scores(field)
        gain = lowest - scores
        # A spurious field adds its neighbours' errors to correct predictions: only a certain gain is accepted.
        if gain.mean() > CERTAIN * gain.std() / np.sqrt(len(gain)):
            lowest, best = scores, field
    return best


def _scores(field: DiffuseField) -> FloatArray:
    """Score of each row predicted from the others [n]; robust to rows that lack a path."""
    mean, variance = field.predict(field.position_m, skip=1)
    error = np.square(np.abs(field.value - mean)).mean(axis=1)
    return np.asarray(np.log(variance) + 2 * np.log1p(error / variance))
