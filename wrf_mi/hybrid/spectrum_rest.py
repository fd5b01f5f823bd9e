"""What a traced and fitted room leaves of its training spectra, carried over to places near them.

Spectra minus predictions are a random field over positions, whose values at one place are alike within a wavelength or
so: small objects, diffraction and scattering that no surface explains. Their posterior mean (simple kriging with mean
zero and an exponential covariance) is added to a prediction. Far from all training rows nothing is added.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.distance import cdist

from ..core.angles import FloatArray

COMPONENTS = 64
"""Principal images of the rest that are kept: the square of a 4 x 4 array's spectrum has 49 degrees of freedom."""
NOISE = 0.5
"""Variance of what two spectra at one place do not share, as a share of the field's."""
LENGTHS = (0.6, 1.2, 2.4)
"""Correlation lengths that validation rows choose from, in wavelengths, beside no rest at all."""


@dataclass(frozen=True)
class Rest:
    """A kriged rest.

    Attributes:
        place_m: training rows' positions [n, 3].
        length_m: of correlation.
        weight: inverse covariance times principal values, shape [n, k].
        image: principal images [k, height, width].
    """

    place_m: FloatArray
    length_m: float
    weight: FloatArray
    image: NDArray[np.float32]

    @classmethod
    def of(cls, place_m: FloatArray, rest: NDArray[np.float32], length_m: float) -> Rest:
        """From what is left of training spectra, [n, height, width]."""
        flat = rest.reshape(len(rest), -1)
        # Principal images by the rows' Gram matrix: there are fewer rows than pixels.
        value, vector = np.linalg.eigh(flat.astype(float) @ flat.T.astype(float))
        kept = np.flatnonzero(value > value[-1] * 1e-9)[::-1][:COMPONENTS]
        scale = np.sqrt(value[kept])
        image = (vector[:, kept] / scale).T @ flat
        covariance = _alike(place_m, place_m, length_m) + NOISE * np.eye(len(place_m))
        weight = cho_solve(cho_factor(covariance), vector[:, kept] * scale)
        return cls(place_m, length_m, weight, image.reshape(-1, *rest.shape[1:]).astype(np.float32))

    def __call__(self, place_m: FloatArray) -> NDArray[np.float32]:
        """What to add to predictions at positions [m, 3], [m, height, width]."""
        value = (_alike(place_m, self.place_m, self.length_m) @ self.weight).astype(np.float32)
        return np.asarray(np.tensordot(value, self.image, axes=1))


def _alike(a_m: FloatArray, b_m: FloatArray, length_m: float) -> FloatArray:
    return np.asarray(np.exp(-cdist(a_m, b_m) / length_m))
