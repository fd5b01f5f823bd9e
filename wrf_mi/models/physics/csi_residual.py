"""What image sources leave of channels: a diffuse field, kriged where measurements lie close together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ...core.angles import FloatArray
from ..interpolation.kriging_equations import simple_weights

NEIGHBOURS = 32
SHARES = (0.3, 0.6, 0.9, 0.99, 0.999)
"""Shares of the power that may be a field, the rest being noise; what predicts rows left out best is taken."""

CERTAIN = 3.0
"""Standard errors by which a field must predict better than none."""

Complex = NDArray[np.complex128]


@dataclass(frozen=True)
class Diffuse:
    """Complex Gaussian field with covariance sin(k d) / (k d): waves from all directions with equal power.

    Source: Cook et al., "Measurement of correlation coefficients in reverberant sound fields" (1955), J. Acoust. Soc.
    Am. 27; the same holds for scalar waves of any kind.

    Attributes:
        position_m: of the rows [n, 3].
        value: what is left there [n, subcarriers].
        k: mean wave number, rad/m.
        power: mean of abs(value)^2.
        share: of the power that is a field, the rest is noise of each row.
    """

    position_m: FloatArray
    value: Complex
    k: float
    power: float
    share: float

    def predict(self, position_m: FloatArray) -> tuple[Complex, FloatArray]:
        """Mean [m, subcarriers] and variance [m] of the field at positions [m, 3] and of what is no field there."""
        return self._krige(position_m, 0)

    def _krige(self, position_m: FloatArray, skip: int) -> tuple[Complex, FloatArray]:
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


def fit_diffuse(position_m: FloatArray, value: Complex, k: float) -> Diffuse:
    """The share of a field that predicts best, each row from the others (logarithmic score).

    Args:
        position_m: of the rows [n, 3].
        value: what is left of the channels there [n, subcarriers].
        k: mean wave number, rad/m.
    """
    power = float(np.square(np.abs(value)).mean()) if len(value) else 0.0
    found = Diffuse(position_m, value, k, power, 0.0)
    best = _scores(found) if power > 0 and len(value) > 2 else np.zeros(0)
    for share in SHARES if len(best) else ():
        field = Diffuse(position_m, value, k, power, share)
        scores = _scores(field)
        gain = best - scores
        # A field that is none adds its neighbours' errors to what was right: only one that is certain is taken.
        if gain.mean() > CERTAIN * gain.std() / np.sqrt(len(gain)):
            best, found = scores, field
    return found


def _scores(field: Diffuse) -> FloatArray:
    """Of each row from the others [n]; robust: one that lacks a path is no reason to give up the field elsewhere."""
    mean, variance = field._krige(field.position_m, 1)
    error = np.square(np.abs(field.value - mean)).mean(axis=1)
    return np.asarray(np.log(variance) + 2 * np.log1p(error / variance))
