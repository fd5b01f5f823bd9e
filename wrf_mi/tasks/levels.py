"""Levels of observations in decibels: one number for each prediction, with its standard deviation.

The power of a quantity of mean m and standard deviation s, m and s of any unit, is |m|^2 + s^2 on average. Predicted
powers are taken to be gamma distributed, which is Nakagami's distribution of amplitudes with parameter E(P)^2 / var(P):
it is exact for a complex normal quantity of mean zero (Rayleigh fading) and within 0.6 dB of Rice's for any other.
Expectation and standard deviation of 10 log10 P are then digamma and trigamma functions.

Source: Nakagami, "The m-distribution, a general formula of intensity distribution of rapid fading" (1960).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import digamma, polygamma

from ..core import Prediction
from ..core.angles import FloatArray

DB = 10 / np.log(10)
"""Decibels of a factor e."""
CERTAIN = 1e8
"""Largest parameter of the distribution: a standard deviation of 4e-4 dB, below any that is stated."""


def decibels(power: NDArray[Any]) -> FloatArray:
    """10 log10 of powers, any shape; NaN where nothing arrives.

    >>> decibels(np.array([100.0, 0.0]))
    array([20., nan])
    """
    return np.asarray(10 * np.log10(np.where(power > 0, power, np.nan)), float)


def level_of_amplitudes(prediction: Prediction, weight: FloatArray) -> Prediction:
    """Level of the weighted mean of the powers of amplitudes.

    Errors of one observation's amplitudes are taken to be in common, which bounds the standard deviation of a mean
    from above.

    Args:
        prediction: complex coefficients or magnitudes [m, ...], with standard deviations or without.
        weight: weight of each amplitude, of sum 1, in the shape of an observation.

    Returns:
        Expectation of 10 log10 of the power [m] and, if stated, its standard deviation, dB; NaN where nothing arrives.
    """
    count, weights = len(prediction.mean), weight.ravel()
    signal = np.square(np.abs(prediction.mean)).reshape(count, -1)
    if prediction.std is None:
        return Prediction(decibels(signal @ weights))
    noise = np.square(prediction.std).reshape(count, -1)
    # Of a complex normal quantity var |h|^2 = s^4 + 2 |m|^2 s^2, of a real one twice that.
    factor = 1 if np.iscomplexobj(prediction.mean) else 2
    mean = (signal + noise) @ weights
    std = np.sqrt(factor * noise * (noise + 2 * signal)) @ weights
    with np.errstate(divide="ignore", invalid="ignore"):
        shape = np.minimum(np.square(mean / std), CERTAIN)
    return Prediction(decibels(mean) + DB * (digamma(shape) - np.log(shape)), DB * np.sqrt(polygamma(1, shape)))
