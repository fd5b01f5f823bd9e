"""Antenna arrays in NumPy: response to a plane wave, Bartlett spectrum, the instrument's scaling.

Conventions (`wrf_mi.core.angles`): elements lie in the array's x-y plane, boresight +z. With the time factor
exp(+j omega t), a wave that arrives *from* unit vector u reaches the element at p with the phase +k p . u
relative to the array's origin.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.constants import speed_of_light

from ..core.angles import FloatArray
from .beams import beams

ComplexArray = NDArray[np.complex128]

LEAST = 1e-100
"""Signals between this and its inverse have squares in the range of double precision; others are scaled."""


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
    signals = np.asarray(h, dtype=complex)
    # Squares of numbers beyond these limits are out of range.
    largest = np.abs(signals).max(initial=0)
    factor = 1.0 if LEAST < largest < 1 / LEAST or not largest else largest
    flat: ComplexArray = signals.reshape(-1, signals.shape[-1])
    if factor != 1:
        flat = flat / factor
    images = beams(positions_m, frequency_hz, height, width).magnitude(flat)
    if factor != 1:
        images *= factor
    return images.reshape(*signals.shape[:-1], height, width)


def minmax_scale(spectrum: ArrayLike) -> FloatArray:
    """Scale each image [..., height, width] to its own minimum and maximum, as the instrument does, to 0..1.

    An image without contrast (nothing received) becomes 0.
    """
    image = np.asarray(spectrum, float)
    low = image.min(axis=(-2, -1), keepdims=True)
    span = image.max(axis=(-2, -1), keepdims=True) - low
    return np.divide(image - low, span, out=np.zeros_like(image), where=span > 0)
