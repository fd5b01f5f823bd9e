"""Measured antenna patterns: gains on a sphere, interpolated by cubic splines with NumPy or Dr.Jit."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .angles import FloatArray
from .errors import InputError

MOST_EFFICIENCY = 10 ** (0.5 / 10)
"""Largest radiated power over the accepted one: gains are measured to some 0.5 dB, and two cuts are no whole sphere."""
MOST_DB = 300.0  # largest gain or attenuation; more would not be a number in single precision
MOST_DIRECTIONS = 2_000_000  # 16 MB for a table, which every kernel reads


@dataclass(frozen=True, eq=False)
class MeasuredPattern:
    """Complex amplitude of a polarised antenna as a function of direction.

    Attributes:
        table: coefficients of bicubic B-splines of the amplitude's real and, where a phase was measured, imaginary
            part [1 or 2, n + 3, m + 3] over n steps of the zenith angle and m of the azimuth, with a margin of one
            before and two behind.
        peak_dbi: largest gain of a sample, dBi.
        peak_deg: azimuth and elevation of that sample, degrees, in the antenna's frame.
        efficiency: radiated power, the mean gain over the sphere.
        frequency_hz: frequency of the measurement; None: not stated.
    """

    table: FloatArray
    peak_dbi: float
    peak_deg: tuple[float, float]
    efficiency: float
    frequency_hz: float | None = None

    @classmethod
    def of_gains(
        cls, gain_db: FloatArray, phase_rad: FloatArray | None = None, frequency_hz: float | None = None
    ) -> MeasuredPattern:
        """Pattern of gains [n + 1, m] in dBi at zenith angles of 0 to pi and azimuths of 0 to 2 pi, in equal steps.

        At the poles the mean amplitude over all azimuths counts. ``phase_rad``: phases of the far field for the time
        factor exp(+j omega t) [n + 1, m]; None: zero.

        Raises:
            InputError: the mean gain over the sphere exceeds 1, gains of no antenna, or too many directions.
        """
        if gain_db.size > MOST_DIRECTIONS:
            raise InputError(f"{gain_db.size} directions; give {MOST_DIRECTIONS} at most")
        if not np.abs(gain_db).max() <= MOST_DB:
            raise InputError(f"gains beyond {MOST_DB:g} dB; give gains in dBi")
        amplitude = 10 ** (gain_db / 20) * np.exp(1j * (np.zeros(1) if phase_rad is None else phase_rad))
        amplitude[[0, -1]] = amplitude[[0, -1]].mean(axis=1, keepdims=True)
        # Zones between the middles of the zenith angles: their areas add up to that of the sphere.
        middles = np.append(0, (np.arange(len(amplitude) - 1) + 0.5) / (len(amplitude) - 1)), 1
        zones = -np.diff(np.cos(math.pi * np.append(*middles))) / 2
        efficiency = float(zones @ (np.abs(amplitude) ** 2).mean(axis=1))
        if efficiency > MOST_EFFICIENCY:
            text = f"gains add up to {10 * math.log10(efficiency):.2f} dB more power than is accepted (their integral "
            raise InputError(f"{text}over the sphere exceeds 4 pi); give gains in dBi, not relative to another antenna")
        parts = [amplitude.real] if phase_rad is None else [amplitude.real, amplitude.imag]
        row, column = np.unravel_index(np.argmax(gain_db), gain_db.shape)
        elevation = 90 - 180 * float(row) / (len(gain_db) - 1)
        azimuth = (360 * float(column) / gain_db.shape[1] + 180) % 360 - 180
        table = np.stack([_coefficients(part) for part in parts])
        return cls(table, float(gain_db.max()), (azimuth, elevation), efficiency, frequency_hz)

    def __str__(self) -> str:
        """Gain, direction of its maximum in the antenna's frame, efficiency and frequency."""
        azimuth, elevation = self.peak_deg
        text = f"{self.peak_dbi:.1f} dBi at azimuth {azimuth:g} deg, elevation {elevation:g} deg"
        frequency_text = "" if self.frequency_hz is None else f", measured at {self.frequency_hz / 1e6:g} MHz"
        return f"{text}, efficiency {self.efficiency:.0%}{frequency_text}"

    def amplitude(self, arrays: Any, zenith: Any, azimuth: Any, tables: list[Any] | None = None) -> list[Any]:
        """Real and, where a phase was measured, imaginary part at zenith angles and azimuths (-pi to pi), rad.

        With Dr.Jit as ``arrays`` in place of NumPy, ``tables`` are those of `flat` on the device, in the type of the
        angles: inputs of a recorded function. Differentiable in the angles.
        """
        _, rows, columns = self.table.shape
        down = zenith * ((rows - 3) / math.pi)
        along = azimuth * ((columns - 3) / (2 * math.pi))
        along = (arrays.where if arrays is np else arrays.select)(along < 0, along + (columns - 3), along)
        # The last cell includes its end: zenith angles of pi, and azimuths that rounding takes to 2 pi.
        row = arrays.minimum(arrays.floor(down), rows - 4.0)
        column = arrays.minimum(arrays.floor(along), columns - 4.0)
        of_row, of_column = _weights(down - row), _weights(along - column)
        integer: Any = np.int64 if arrays is np else arrays.uint32_array_t(type(zenith))
        first = integer(row) * columns + integer(column)

        def spline(table: Any) -> Any:
            """Weighted sum of the 4 x 4 coefficients around each direction."""
            total: Any = 0.0
            for i, of_this_row in enumerate(of_row):
                for j, of_this_column in enumerate(of_column):
                    place = first + (i * columns + j)
                    value = table[place] if arrays is np else arrays.gather(type(zenith), table, place)
                    total = total + of_this_row * of_this_column * value
            return total

        return [spline(table) for table in (self.flat if tables is None else tables)]

    @property
    def flat(self) -> list[FloatArray]:
        """Coefficients of each part, flat."""
        return [part.ravel() for part in self.table]


def _coefficients(values: NDArray[np.float64]) -> FloatArray:
    """B-spline coefficients [n + 3, m + 3] of values [n + 1, m] on a sphere, which the spline interpolates."""
    from scipy.ndimage import spline_filter1d  # not needed for the help of the command

    # Across a pole the zenith angle goes on at the opposite azimuth: the sphere is a torus of twice as many rows.
    n, m = len(values) - 1, values.shape[1]
    torus = np.concatenate([values, np.roll(values[-2:0:-1], m // 2, axis=1)])
    for axis in (0, 1):
        torus = spline_filter1d(torus, axis=axis, mode="grid-wrap")
    return np.asarray(torus[np.arange(-1, n + 2)][:, np.arange(-1, m + 2) % m])


def _weights(t: Any) -> list[Any]:
    """Weights of the four cubic B-splines at a place ``t``, 0 to 1, of a cell.

    Source: Unser, "Splines: a perfect fit for signal and image processing" (1999).
    """
    u = 1 - t
    return [
        u * u * u / 6,
        (3 * t * t * t - 6 * t * t + 4) / 6,
        (3 * u * u * u - 6 * u * u + 4) / 6,
        t * t * t / 6,
    ]
