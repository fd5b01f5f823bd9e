"""The spectrum that an array is expected to report where its element signals are known with an uncertainty.

At each direction the beam former's output is a complex Gaussian number, so its magnitude is Rician: mean and variance
in closed form. The instrument then scales each spectrum to its own minimum and maximum; what these are expected to be
is taken from a few draws on a coarse grid, the same draws for every position.

Source: Rice, "Mathematical analysis of random noise" (1944), section 3.10.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.constants import speed_of_light
from scipy.special import i0e, i1e

from ...core.angles import FloatArray, pixel_directions
from ...receivers.array import array_response
from .signals import Posterior

ComplexArray = NDArray[np.complex128]

DRAWS = 64
COARSE = 0.1
"""Of a lobe's width, wavelength over aperture, between the directions at which draws are evaluated."""
CLEAR = 100.0
"""From this ratio the Rician's moments are taken from their series, which then has six digits; differences have not."""


def rician(mean: NDArray[Any], variance: NDArray[Any]) -> tuple[FloatArray, FloatArray]:
    """Mean and standard deviation of abs(z), z complex Gaussian with E z = mean, E |z - mean|^2 = variance."""
    power = np.abs(mean) ** 2
    # Without variance the ratio is as large as any that matters; without either it is 0.
    half = power / np.maximum(2 * variance, 1e-9 * power + np.finfo(power.dtype).tiny)
    near = np.minimum(half, CLEAR)
    expected = np.sqrt(np.pi * variance) / 2 * ((1 + 2 * near) * i0e(near) + 2 * near * i1e(near))
    left = np.maximum(power + variance - expected**2, 0)
    rest = 1 / (8 * np.maximum(half, CLEAR))
    far = half >= CLEAR
    expected = np.where(far, np.sqrt(power + variance / 2 * (1 + rest)), expected)
    return expected, np.sqrt(np.where(far, variance / 2 * (1 - rest), left))


class ExpectedSpectrum:
    """From uncertain element signals to the spectrum that is expected.

    Args:
        elements_m: [m, 3].
        frequency_hz: of the carrier.
        height: elevations.
        width: azimuths.
    """

    def __init__(self, elements_m: FloatArray, frequency_hz: float, height: int, width: int) -> None:
        self.shape = height, width
        grid = pixel_directions(height, width)
        aperture = max(float(np.ptp(elements_m, axis=0).max()), np.finfo(float).tiny)
        apart = COARSE * speed_of_light / frequency_hz / aperture  # rad
        rows, columns = (max(round(apart * size), 1) for size in (height / (np.pi / 2), width / (2 * np.pi)))
        coarse = grid[::rows, ::columns].reshape(-1, 3)
        self._fine: NDArray[np.complex64] = (
            array_response(elements_m, grid.reshape(-1, 3), frequency_hz).conj().astype(np.complex64)
        )
        self._basis: ComplexArray | None = None
        self._coarse = array_response(elements_m, coarse, frequency_hz).conj()
        rng = np.random.default_rng(0)
        pair = rng.normal(size=(2, DRAWS, len(elements_m))) / np.sqrt(2)
        self._draws: ComplexArray = pair[0] + 1j * pair[1]

    def __call__(self, posterior: Posterior) -> tuple[FloatArray, FloatArray]:
        """Mean and standard deviation of the scaled spectra, [q, height, width]."""
        images = self._fine @ posterior.mean.T.astype(np.complex64)
        if self._basis is not posterior.basis:  # that of one process stays, and takes as long as all the rest
            self._basis, self._seen = posterior.basis, np.abs(self._fine @ posterior.basis.astype(np.complex64)) ** 2
        spread = self._seen @ posterior.variance.T.astype(np.float32)
        expected, deviation = rician(images.T, spread.T)
        noise = self._draws[None] * np.sqrt(posterior.variance)[:, None, :]
        drawn = np.abs((posterior.mean[:, None] + noise @ posterior.basis.T) @ self._coarse.T)
        lowest, highest = drawn.min(axis=2).mean(axis=1), drawn.max(axis=2).mean(axis=1)
        span = (highest - lowest)[:, None]
        grey = np.clip((expected - lowest[:, None]) / span, 0, 1)
        return grey.reshape(-1, *self.shape), (deviation / span).reshape(-1, *self.shape)
