"""Antenna arrays in NumPy: element positions, response to a plane wave, Bartlett spectrum.

Conventions (`wrf_mi.core.angles`): elements lie in the array's x-y plane, boresight +z. With the time factor
exp(+j omega t), a wave that arrives *from* unit vector u reaches the element at p with the phase +k p . u
relative to the array's origin.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.constants import speed_of_light

from ..core.angles import FloatArray, pixel_directions

ComplexArray = NDArray[np.complex128]


def planar_array(rows: int, columns: int, spacing_m: float) -> FloatArray:
    """Element positions of a uniform planar array, centred on its origin.

    Args:
        rows: elements along y.
        columns: elements along x.
        spacing_m: distance between neighbours along both axes, metres.

    Returns:
        Shape [rows * columns, 3] in metres, x fastest, z = 0.

    Raises:
        ValueError: fewer than one row or column, or a spacing that is not positive.
    """
    if rows < 1 or columns < 1 or not spacing_m > 0:
        raise ValueError(f"planar_array: {rows} x {columns} elements {spacing_m} m apart; all three must be positive")
    x = (np.arange(columns) - (columns - 1) / 2) * spacing_m
    y = (np.arange(rows) - (rows - 1) / 2) * spacing_m
    grid_y, grid_x = np.meshgrid(y, x, indexing="ij")
    return np.stack([grid_x.ravel(), grid_y.ravel(), np.zeros(rows * columns)], axis=-1)


def array_response(positions_m: ArrayLike, directions: ArrayLike, frequency_hz: float) -> ComplexArray:
    """Element signals exp(+j k p . u) of a plane wave of unit amplitude from unit vector u.

    Args:
        positions_m: elements p [m, 3] in the array's frame, metres.
        directions: unit vectors u [..., 3] towards where the wave comes from, in the array's frame.
        frequency_hz: of the carrier.

    Returns:
        Shape [..., m].

    Source: Van Trees, "Optimum Array Processing" (2002), section 2.2, with the direction towards the source.
    """
    wavenumber = 2 * np.pi * frequency_hz / speed_of_light
    response: ComplexArray = np.exp(1j * wavenumber * (np.asarray(directions) @ np.asarray(positions_m).T))
    return response


def bartlett_spectrum(h: ArrayLike, positions_m: ArrayLike, frequency_hz: float, height: int, width: int) -> FloatArray:
    """Magnitude of the Bartlett (delay-and-sum) beam former at every pixel, abs(sum_m h_m exp(-j k p_m . u)).

    Args:
        h: complex element signals [..., m].
        positions_m: elements [m, 3] in the array's frame, metres.
        frequency_hz: of the carrier.
        height: elevations over the upper hemisphere.
        width: azimuths over the full circle.

    Returns:
        Shape [..., height, width], in the unit of ``h``.

    Source: Van Trees, "Optimum Array Processing" (2002), section 6.2; the real spectra obey it.
    """
    steering = array_response(positions_m, pixel_directions(height, width).reshape(-1, 3), frequency_hz).conj()
    signals = np.asarray(h, dtype=complex)
    return np.abs(signals @ steering.T).reshape(*signals.shape[:-1], height, width)


def minmax_scale(spectrum: ArrayLike) -> FloatArray:
    """Scale each image [..., height, width] to its own minimum and maximum, as the instrument does, to 0..1.

    An image without contrast (nothing received) becomes 0.
    """
    image = np.asarray(spectrum, float)
    low = image.min(axis=(-2, -1), keepdims=True)
    span = image.max(axis=(-2, -1), keepdims=True) - low
    return np.divide(image - low, span, out=np.zeros_like(image), where=span > 0)
