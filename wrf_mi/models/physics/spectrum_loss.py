"""How far predicted element signals are from observed spectra, free of scale and phase, with its derivative.

An instrument scales each spectrum to its own extremes, so what counts is its shape: with s the observed and b the
predicted magnitudes on a grid of directions, both as vectors of unit length, 1 - (s . b)^2 is about the power of what
is predicted wrongly, as a share of all. How large that is differs from row to row by a factor of a hundred (a
transmitter behind a shelf, or in plain sight), and is not known: with a variance of its own for each row, the logarithm
of the likelihood falls by half the degrees of freedom times the logarithm of that share, which is the loss. Structural
similarity falls nearly linearly with the same logarithm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...core.angles import FloatArray, pixel_directions
from ...receivers.array import array_response

ComplexArray = NDArray[np.complex128]
FREEDOM = 15.0
"""Half the degrees of freedom of a spectrum of 16 signals without common scale and phase."""
FLOOR = 0.01
"""Share that counts as well explained: what eight bits and small objects leave."""
ROWS, COLUMNS = 10, 18
"""Directions of the grid: a 4 x 4 array's spectrum has 49 degrees of freedom, so every few pixels will do."""


@dataclass(frozen=True)
class Grid:
    """Some pixels of a spectrum.

    Attributes:
        row: their rows, shape [r].
        column: their columns, shape [c].
        steering: conjugate response of the array there, [r * c, m].
    """

    row: NDArray[np.int64]
    column: NDArray[np.int64]
    steering: ComplexArray

    @classmethod
    def of(cls, height: int, width: int, array_m: FloatArray, frequency_hz: float) -> Grid:
        """An even grid over ``height`` elevations and ``width`` azimuths for an array [m, 3] in metres."""
        row = np.unique(
            np.linspace(0, height, min(ROWS, height), endpoint=False).astype(np.int64) + height // ROWS // 2
        )
        row = row[row < height]
        column = np.unique(np.linspace(0, width, min(COLUMNS, width), endpoint=False).astype(np.int64))
        directions = pixel_directions(height, width)[np.ix_(row, column)].reshape(-1, 3)
        return cls(row, column, array_response(array_m, directions, frequency_hz).conj())

    def shapes(self, spectra: NDArray[np.float32]) -> FloatArray:
        """Observed spectra [n, height, width] as unit vectors on the grid [n, r * c]; a dark one is 0."""
        values = spectra[:, self.row][:, :, self.column].reshape(len(spectra), -1).astype(float)
        norm = np.linalg.norm(values, axis=1, keepdims=True)
        return np.divide(values, norm, out=np.zeros_like(values), where=norm > 0)

    def loss(self, signals: ComplexArray, shapes: FloatArray) -> tuple[FloatArray, ComplexArray]:
        """Loss of each row and its derivative.

        Args:
            signals: predicted element signals [n, m], of any unit.
            shapes: from `shapes`, [n, r * c].

        Returns:
            Losses [n], 0 at best, and G [n, m]: a change dh of the signals changes a loss by 2 Re(conj(G) . dh).
        """
        field = signals @ self.steering.T
        power = np.abs(field) ** 2
        # The root has no derivative at zero: a millionth of the mean is far below what 8 bits can show.
        magnitude = np.sqrt(power + 1e-6 * power.mean(axis=1, keepdims=True) + np.finfo(float).tiny)
        norm = np.linalg.norm(magnitude, axis=1, keepdims=True)
        likeness = (shapes * magnitude).sum(axis=1, keepdims=True) / norm
        slope = -2 * likeness * (shapes / norm - likeness * magnitude / norm**2)
        share = 1 - likeness[:, 0] ** 2
        slope *= FREEDOM / (share + FLOOR)[:, None]
        return FREEDOM * np.log1p(share / FLOOR), (slope / (2 * magnitude) * field) @ self.steering.conj()
