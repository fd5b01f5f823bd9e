"""Residual kriging: residuals of a traced and fitted room at its training spectra, interpolated to nearby positions.

Spectra minus predictions are a random field over positions that correlates within a wavelength or so: small objects,
diffraction and scattering that no surface explains. Its posterior mean (simple kriging with mean zero and an
exponential covariance) is added to a prediction. Far from all training rows nothing is added.

Where the room explains spectra badly, kriging of the spectra themselves may predict better. So the field may also be
the residual of a share of the prediction, about an unknown mean (ordinary kriging): share 0 is kriging of the spectra,
share 1 kriging of residuals. Held-out rows choose (`wrf_mi.models.physics.spectrum`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...core.angles import FloatArray
from ..interpolation.kriging_equations import KrigingSystem, correlation

COMPONENTS = 64
"""Principal images of the residuals at most: the square of a 4 x 4 array's spectrum has 49 degrees of freedom."""


@dataclass(frozen=True)
class ResidualField:
    """The field that is kriged, and its covariance.

    Attributes:
        share: factor of the room's prediction, whose residual is the field.
        wavelengths: correlation length.
        noise: variance by which two spectra at one position differ, as a share of the field's.
        centred: the field has an unknown mean; else its mean is zero.
    """

    share: float
    wavelengths: float
    noise: float
    centred: bool


RESIDUALS = tuple(ResidualField(1.0, length, 0.5, False) for length in (0.6, 1.2, 2.4))
"""Fields for a room that explains most."""
MIXES = {
    "kriging of spectra": ResidualField(0.0, 10.0, 0.1, True),
    "half of room, kriging of what it leaves": ResidualField(0.5, 10.0, 0.1, True),
    "room, kriging of what it leaves": ResidualField(1.0, 10.0, 0.1, True),
}
"""Fields where the room explains less, by name. With a length of whole rooms interpolation is nearly linear, and a few
rows suffice."""


@dataclass(frozen=True)
class ResidualKriging:
    """Kriging of the residuals of n training rows.

    Attributes:
        place_m: positions of the training rows [n, 3].
        length_m: correlation length.
        weight: inverse covariance times principal values less their mean, shape [n, k].
        image: principal images [k, height, width].
        mean: principal values of the mean [k].
        share: factor of the room's prediction to which the residual is added.
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
        position_m: FloatArray,
        spectra: NDArray[np.float32],
        predicted: NDArray[np.float32],
        field: ResidualField,
        wavelength_m: float,
    ) -> ResidualKriging:
        """Fit to training spectra and the room's predictions of them, [n, height, width] each."""
        residual = spectra - field.share * predicted
        flat = residual.reshape(len(residual), -1)
        # Principal images by the rows' Gram matrix, as there are fewer rows than pixels.
        value, vector = np.linalg.eigh(flat.astype(float) @ flat.T.astype(float))
        kept = np.flatnonzero(value > value[-1] * 1e-9)[::-1][:COMPONENTS]
        scale = np.sqrt(value[kept])
        image = (vector[:, kept] / scale).T @ flat
        length_m = field.wavelengths * wavelength_m
        scaled, values = position_m / length_m, vector[:, kept] * scale
        trend = np.ones((len(position_m), int(field.centred)))
        system = KrigingSystem(correlation(scaled, scaled), field.noise, trend)
        mean = system.coefficients(values)
        images = image.reshape(-1, *residual.shape[1:]).astype(np.float32)
        return cls(position_m, length_m, system.weights(values, mean), images, mean.sum(axis=0), field.share)

    def __call__(self, position_m: FloatArray, predicted: NDArray[np.float32]) -> NDArray[np.float32]:
        """Spectra [m, height, width] in 0..1 at positions [m, 3], given the room's predictions of them."""
        alike = correlation(position_m / self.length_m, self.place_m / self.length_m)
        value = (alike @ self.weight + self.mean).astype(np.float32)
        added = np.tensordot(value, self.image, axes=1)
        return np.asarray(np.clip(np.float32(self.share) * predicted + added, 0, 1))
