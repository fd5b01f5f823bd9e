"""Trainable antenna pattern: a smooth complex factor of direction.

    F(u) = exp(sum_{l=1..L} sum_m (a_lm + j b_lm) Y_lm(u))

with real spherical harmonics Y_lm of degree 1 and up. It multiplies a pattern of Sionna RT (isotropic by default) in
both polarisations; degree 0, a constant, is the instrument's gain. Zero coefficients give F = 1.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from .options import MAX_DEGREE


def pattern_coefficients(degree: int) -> NDArray[np.float32]:
    """Coefficients of F = 1: zeros [2, (degree + 1)^2 - 1], real and imaginary parts, by degree and order.

    Raises:
        ValueError: a degree outside 1..8.
    """
    if not 1 <= degree <= MAX_DEGREE:
        raise ValueError(f"pattern_coefficients: degree {degree}; give 1 to {MAX_DEGREE}")
    return np.zeros((2, (degree + 1) ** 2 - 1), np.float32)


def pattern_factor(coefficients: Any, direction: list[Any]) -> tuple[Any, Any]:
    """Complex factor F(u) of directions in the antenna's frame. Differentiable in both arguments.

    Args:
        coefficients: tensor [2, (L + 1)^2 - 1] from `pattern_coefficients`.
        direction: unit vectors u, three arrays [p] of any float type, which is that of the result.

    Returns:
        Real and imaginary part, arrays [p].

    Source: real spherical harmonics as in Sloan, "Efficient spherical harmonic evaluation" (2013), JCGT 2(2).
    """
    float_type = type(direction[0])
    count, paths = coefficients.shape[1], dr.width(direction[0])
    vector_type: Any = dr.float64_array_t(mi.Vector3f) if float_type == dr.float64_array_t(mi.Float) else mi.Vector3f
    harmonics = dr.sh_eval(vector_type(*direction), int(np.sqrt(count + 1)) - 1)[1:]
    tensor_type: Any = dr.tensor_t(float_type)
    # A matrix product: the reverse pass of a sum would have a kernel for each coefficient.
    table = tensor_type(dr.concat(harmonics), (count, paths))
    series = (tensor_type(coefficients) @ table).array
    index = dr.arange(dr.uint32_array_t(float_type), paths)
    amplitude, phase = (dr.gather(float_type, series, index + part * paths) for part in (0, 1))
    sine, cosine = dr.sincos(phase)
    amplitude = dr.exp(amplitude)
    return amplitude * cosine, amplitude * sine
