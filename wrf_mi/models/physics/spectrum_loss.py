"""Array and loss of observed spectra: misfit of element signals, free of scale and phase, with its derivative.

An instrument scales each spectrum to its extremes, so only the shape counts: with s the observed and b the predicted
magnitudes on a grid of directions, both as vectors of unit length, 1 - (s . b)^2 is about the share of the power that
is predicted wrongly. With an unknown variance for each row the logarithm of the likelihood falls by half the degrees of
freedom times the logarithm of that share, which is the loss; structural similarity falls nearly linearly with it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.constants import speed_of_light

from ...core import Antenna, Receiver
from ...core.angles import FloatArray, pixel_directions
from ...core.antenna import ANTENNA, MountedAntenna
from ...receivers.array import array_response, bartlett_spectrum, minmax_scale

ComplexArray = NDArray[np.complex128]
FREEDOM = 15.0
"""Half the degrees of freedom of a spectrum of 16 signals without common scale and phase."""
FLOOR = 0.01
"""Share that counts as well explained: the effect of eight bits and small objects."""
ROWS, COLUMNS = 10, 18
"""Directions of the grid: a 4 x 4 array's spectrum has 49 degrees of freedom."""


@dataclass(frozen=True)
class Grid:
    """Some pixels of a spectrum: rows [r], columns [c], conjugate response of the array there [r * c, m]."""

    row: NDArray[np.int64]
    column: NDArray[np.int64]
    steering: ComplexArray

    @classmethod
    def of(cls, height: int, width: int, array_m: FloatArray, frequency_hz: float) -> Grid:
        """An even grid over ``height`` elevations and ``width`` azimuths for an array [m, 3] in metres."""
        row = np.linspace(0, height, min(ROWS, height), endpoint=False).astype(np.int64) + height // ROWS // 2
        row = np.unique(row[row < height])
        column = np.unique(np.linspace(0, width, min(COLUMNS, width), endpoint=False).astype(np.int64))
        directions = pixel_directions(height, width)[np.ix_(row, column)].reshape(-1, 3)
        return cls(row, column, array_response(array_m, directions, frequency_hz).conj())

    def shapes(self, spectra: NDArray[np.float32]) -> FloatArray:
        """Observed spectra [n, height, width] as unit vectors on the grid [n, r * c]; zero spectra as 0."""
        values = spectra[:, self.row][:, :, self.column].reshape(len(spectra), -1).astype(float)
        norm = np.linalg.norm(values, axis=1, keepdims=True)
        result: FloatArray = np.divide(values, norm, out=np.zeros_like(values), where=norm > 0)
        return result

    def loss(self, signals: ComplexArray, shapes: FloatArray) -> tuple[FloatArray, ComplexArray]:
        """Losses [n], at least 0, of element signals [n, m] of any unit, and derivative G [n, m].

        A change dh of the signals changes a loss by 2 Re(conj(G) . dh). Shapes [n, r * c] are from `shapes`.
        """
        field = signals @ self.steering.T
        power = np.abs(field) ** 2
        # The root has no derivative at zero: a millionth of the mean is far below the resolution of 8 bits.
        magnitude = np.sqrt(power + 1e-6 * power.mean(axis=1, keepdims=True) + np.finfo(float).tiny)
        norm = np.linalg.norm(magnitude, axis=1, keepdims=True)
        likeness = (shapes * magnitude).sum(axis=1, keepdims=True) / norm
        slope = -2 * likeness * (shapes / norm - likeness * magnitude / norm**2)
        share = 1 - likeness[:, 0] ** 2
        slope *= FREEDOM / (share + FLOOR)[:, None]
        return FREEDOM * np.log1p(share / FLOOR), (slope / (2 * magnitude) * field) @ self.steering.conj()


@dataclass(frozen=True)
class Spectrometer:
    """A receiver's array that reports spectra [height, width] at a carrier frequency, and the transmitters' antenna."""

    receiver: Receiver
    frequency_hz: float
    height: int
    width: int
    tx_antenna: Antenna = ANTENNA

    @property
    def wavenumber(self) -> float:
        """2 pi over the wavelength, rad/m."""
        result: float = 2 * np.pi * self.frequency_hz / speed_of_light
        return result

    @property
    def wavelength_m(self) -> float:
        """Wavelength, metres."""
        result: float = speed_of_light / self.frequency_hz
        return result

    @property
    def array_m(self) -> FloatArray:
        """Elements [m, 3], receiver's frame, metres."""
        assert self.receiver.array_m is not None, "see `wrf_mi.models.physics.spectrum.fit_spectrum`"
        return self.receiver.array_m

    @cached_property
    def antennas(self) -> tuple[MountedAntenna, MountedAntenna]:
        """Antennas of the transmitters and of the elements."""
        receiver = self.receiver
        return self.tx_antenna.mounted(), receiver.antenna.mounted(receiver.orientation_xyzw)

    @cached_property
    def elements_m(self) -> FloatArray:
        """Elements less the origin, world frame [m, 3]."""
        return np.asarray(self.array_m @ self.receiver.to_world.T)

    @cached_property
    def grid(self) -> Grid:
        """Directions on which spectra are compared."""
        return Grid.of(self.height, self.width, self.array_m, self.frequency_hz)

    def report(self, signals: ComplexArray) -> NDArray[np.float32]:
        """Spectra of element signals [n, m] as the instrument scales them, [n, height, width]."""
        grid = self.array_m, self.frequency_hz, self.height, self.width
        images = [minmax_scale(bartlett_spectrum(signal, *grid)) for signal in signals]
        return np.array(images, np.float32).reshape(-1, self.height, self.width)
