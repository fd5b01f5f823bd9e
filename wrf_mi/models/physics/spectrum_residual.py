"""What a traced and fitted room leaves of its training spectra, carried over to places near them.

Spectra minus predictions are a random field over positions, whose values at one place are alike within a wavelength or
so: small objects, diffraction and scattering that no surface explains. Their posterior mean (simple kriging with mean
zero and an exponential covariance) is added to a prediction. Far from all training rows nothing is added.

Where the room explains spectra badly, kriging of the spectra themselves may predict better than the room does. So the
field may also be what a share of the prediction leaves, about an unknown mean (ordinary kriging): with share 0 it is
kriging of the spectra, with 1 kriging of residuals, in between a mix. Rows held out choose
(`wrf_mi.models.physics.spectrum`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...core.angles import FloatArray
from ..interpolation.kriging_equations import KrigingSystem, correlation

COMPONENTS = 64
"""Principal images of the rest that are kept: the square of a 4 x 4 array's spectrum has 49 degrees of freedom."""


@dataclass(frozen=True)
class RestKind:
    """Which field is kriged, and how.

    Attributes:
        share: factor of the room's prediction, whose remainder is the field.
        wavelengths: correlation length.
        noise: variance of what two spectra at one place do not share, as a share of the field's.
        centred: the field has an unknown mean; else its mean is zero.
    """

    share: float
    wavelengths: float
    noise: float
    centred: bool


RESIDUALS = tuple(RestKind(1.0, length, 0.5, False) for length in (0.6, 1.2, 2.4))
"""Of a room that explains most."""
MIXES = {
    "kriging of spectra": RestKind(0.0, 10.0, 0.1, True),
    "half of room, kriging of what it leaves": RestKind(0.5, 10.0, 0.1, True),
    "room, kriging of what it leaves": RestKind(1.0, 10.0, 0.1, True),
}
"""Where the room explains less, by name. The length is that of whole rooms: interpolation is then nearly linear, and
needs no length to be fitted to a few rows."""


@dataclass(frozen=True)
class Rest:
    """A kriged rest.

    Attributes:
        place_m: training rows' positions [n, 3].
        length_m: of correlation.
        weight: inverse covariance times principal values less their mean, shape [n, k].
        image: principal images [k, height, width].
        mean: principal values of the mean [k].
        share: factor of the room's prediction that the rest is added to.
    """

    place_m: FloatArray
    length_m: float
    weight: FloatArray
    image: NDArray[np.float32]
    mean: FloatArray
    share: float

    @classmethod
    def of(
        cls,
        place_m: FloatArray,
        spectra: NDArray[np.float32],
        predicted: NDArray[np.float32],
        kind: RestKind,
        wavelength_m: float,
    ) -> Rest:
        """From training spectra and the room's predictions of them, [n, height, width] each."""
        rest = spectra - kind.share * predicted
        flat = rest.reshape(len(rest), -1)
        # Principal images by the rows' Gram matrix: there are fewer rows than pixels.
        value, vector = np.linalg.eigh(flat.astype(float) @ flat.T.astype(float))
        kept = np.flatnonzero(value > value[-1] * 1e-9)[::-1][:COMPONENTS]
        scale = np.sqrt(value[kept])
        image = (vector[:, kept] / scale).T @ flat
        length_m = kind.wavelengths * wavelength_m
        scaled, values = place_m / length_m, vector[:, kept] * scale
        trend = np.ones((len(place_m), int(kind.centred)))
        system = KrigingSystem(correlation(scaled, scaled), kind.noise, trend)
        mean = system.coefficients(values)
        images = image.reshape(-1, *rest.shape[1:]).astype(np.float32)
        return cls(place_m, length_m, system.weights(values, mean), images, mean.sum(axis=0), kind.share)

    def __call__(self, place_m: FloatArray, predicted: NDArray[np.float32]) -> NDArray[np.float32]:
        """Spectra at positions [m, 3] of which the room predicts [m, height, width]; 0..1."""
        alike = correlation(place_m / self.length_m, self.place_m / self.length_m)
        value = (alike @ self.weight + self.mean).astype(np.float32)
        added = np.tensordot(value, self.image, axes=1)
        return np.asarray(np.clip(np.float32(self.share) * predicted + added, 0, 1))
