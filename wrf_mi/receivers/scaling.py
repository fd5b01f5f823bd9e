"""Scaling of spectra and powers in dB, for NumPy and Dr.Jit arrays alike.

`wrf_mi.receivers.receiver_models` has what instruments observe. Dr.Jit is imported on request: a command that only
reads data does without it.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.angles import FloatArray
from ..core.types import IntArray

SQUARED_MAGNITUDE_EPS = 1e-8  # added to |R|^2 under a root or logarithm, whose gradient is unbounded at zero
LEAST_POWER = 1e-20  # constant added to a power before its logarithm in a fit: the lowest observation is -200 dB
SILENCE = 4 * LEAST_POWER  # power up to which nothing arrives in a fit: above the constants that are added to powers
FLOOR_DB = 1e-3  # distance from the floor up to which an observation is the floor, dB: rounding to single precision


def strength_db(power: Any, floor: Any = math.nan, least: float = 0.0) -> Any:
    """Power in dB, 10 log10(power + least), of NumPy or Dr.Jit arrays; ``floor`` stands for powers up to 4 ``least``.

    NaN as ``floor``: none, as in a record. ``least`` bounds the derivative of the logarithm where little arrives
    (`LEAST_POWER`).
    """
    if isinstance(power, np.ndarray):
        return 10 * np.log10(np.where(power > 4 * least, power + least, floor))
    import drjit as dr

    # Dr.Jit has logarithms of base 2 and e alone.
    return 10 * dr.log2(dr.select(power > 4 * least, power + least, floor)) / math.log2(10)


def arrives(observed_db: NDArray[Any], floor: float) -> NDArray[np.bool_]:
    """Whether observations in dB are above the floor, a power."""
    above: NDArray[np.bool_] = np.abs(observed_db - 10 * math.log10(floor)) > FLOOR_DB
    return above


def minmax_scale(spectrum: ArrayLike) -> FloatArray:
    """Scale each image [..., height, width] by its extremes to 0..1, as the instrument does; a constant one to 0."""
    image = np.asarray(spectrum, float)
    low = image.min(axis=(-2, -1), keepdims=True)
    span = image.max(axis=(-2, -1), keepdims=True) - low
    result: FloatArray = np.divide(image - low, span, out=np.zeros_like(image), where=span > 0)
    return result


def scaled(image: Any, pixels: int) -> Any:
    """`minmax_scale` of Dr.Jit images of ``pixels`` values each, flat."""
    # Differentiable, extremes included: a pixel that sets the scale moves all others.
    import drjit as dr

    index = dr.arange(dr.uint32_array_t(type(image)), dr.width(image)) // pixels
    low, high = (dr.block_reduce(op, image, pixels) for op in (dr.ReduceOp.Min, dr.ReduceOp.Max))
    span = high - low
    # The inner selection keeps the derivative of an image without contrast finite.
    inverse = dr.select(span > 0, dr.rcp(dr.select(span > 0, span, 1)), 0)
    return (image - dr.gather(type(image), low, index)) * dr.gather(type(image), inverse, index)


def magnitudes(image: NDArray[np.complex64]) -> NDArray[np.float32]:
    """Magnitudes of complex numbers, as `wrf_mi.receivers.device_paths.magnitude` has them."""
    return np.sqrt(np.square(image.real) + np.square(image.imag) + np.float32(SQUARED_MAGNITUDE_EPS))


def scaled_rows(spectrum: NDArray[np.float32]) -> tuple[NDArray[np.float32], IntArray, IntArray, NDArray[np.float32]]:
    """Rows scaled to 0..1, places of their least and largest values [n, 1], and the factor by which they are scaled."""
    low, high = spectrum.argmin(axis=1)[:, None], spectrum.argmax(axis=1)[:, None]
    least = np.take_along_axis(spectrum, low, axis=1)
    span = np.take_along_axis(spectrum, high, axis=1) - least
    inverse = np.divide(1, span, out=np.zeros_like(span), where=span > 0)
    return (spectrum - least) * inverse, low, high, inverse
