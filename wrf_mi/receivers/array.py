"""Antenna arrays: response to a plane wave, Bartlett spectrum, the instrument's scaling.

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


def array_response(positions_m: ArrayLike, directions: ArrayLike, frequency_hz: float) -> ComplexArray:
    """Element signals exp(+j k p . u) of a plane wave of unit amplitude from unit vector u.

    Args:
        positions_m: positions p of the elements [m, 3] in the array's frame, metres.
        directions: unit vectors u [..., 3] towards the source, in the array's frame.
        frequency_hz: carrier frequency.

    Returns:
        Complex signals [..., m].

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
        frequency_hz: carrier frequency.
        height: elevations over the upper hemisphere.
        width: azimuths over the full circle.

    Returns:
        Shape [..., height, width], in the unit of ``h``.

    Source: Van Trees, "Optimum Array Processing" (2002), section 6.2.
    """
    signals = np.asarray(h, dtype=complex)
    # A power of two keeps squares within the range of double precision, without rounding.
    exponent = np.clip(np.frexp(np.abs(signals).max(initial=0))[1], -1000, 1000)
    flat = signals.reshape(-1, signals.shape[-1]) * np.ldexp(1.0, -exponent)
    images = beams(positions_m, frequency_hz, height, width).magnitude(flat)
    images *= np.ldexp(1.0, exponent)
    return images.reshape(*signals.shape[:-1], height, width)


def minmax_scale(spectrum: ArrayLike) -> FloatArray:
    """Scale each image [..., height, width] by its minimum and maximum to 0..1, as the instrument does.

    A constant image (nothing received) becomes 0.
    """
    image = np.asarray(spectrum, float)
    low = image.min(axis=(-2, -1), keepdims=True)
    span = image.max(axis=(-2, -1), keepdims=True) - low
    return np.divide(image - low, span, out=np.zeros_like(image), where=span > 0)
