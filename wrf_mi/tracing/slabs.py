"""Reflection at and transmission through a homogeneous slab, on Dr.Jit types of either precision."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.constants import epsilon_0, speed_of_light

GRAZING = 1e-8
"""Least cosine of an angle of incidence: directions in single precision tell no smaller one from 0, at which a slab
that hardly differs from air has no limit of its own."""
LARGEST = 1e18
"""Largest part of a relative permittivity, and thickness in rad: products are numbers in single precision, and a slab
of this permittivity is a perfect conductor (``r`` differs from -1 by 1e-9)."""
LONGEST_RAD = 2.0**23  # phase across a slab at which neighbouring numbers of single precision are 1 rad apart


@dataclass
class SlabCoefficients:
    """Complex reflection and transmission coefficients of p passages, TE and TM."""

    reflected_te: Any
    reflected_tm: Any
    transmitted_te: Any
    transmitted_tm: Any


def slab(cosine: Any, permittivity: Any, conductivity: Any, thickness_m: Any, frequency_hz: Any) -> SlabCoefficients:
    """Reflection at and transmission through a homogeneous slab in air.

    The complex relative permittivity is eta = eps_r - j sigma / (2 pi f eps_0), for the time factor exp(+j omega t).

    Args:
        cosine: cosine of the angle of incidence theta, a Dr.Jit array [p] of either float type.
        permittivity: relative permittivity eps_r [p].
        conductivity: conductivity sigma [p], S/m.
        thickness_m: thickness d [p], metres.
        frequency_hz: carrier f, Hz.

    Returns:
        Coefficients of `slab_coefficients`.
    """
    kind: Any = mi.Complex2f if type(cosine) is mi.Float else dr.float64_array_t(mi.Complex2f)
    eta = kind(permittivity, -conductivity / (2 * np.pi * frequency_hz * epsilon_0))
    return slab_coefficients(cosine, eta, thickness_m * (2 * np.pi * frequency_hz / speed_of_light))


def slab_coefficients(cosine: Any, eta: Any, phase_rad: Any) -> SlabCoefficients:
    """Coefficients of slabs of the complex relative permittivities ``eta`` [p], ``phase_rad`` thick in air.

    With s = sqrt(eta - sin^2 theta) the Fresnel coefficients of one face are

        r_TE = (cos theta - s) / (cos theta + s),   r_TM = (eta cos theta - s) / (eta cos theta + s)

    and those of a slab of thickness d, with q = 2 pi d s / lambda,

        R = r (1 - exp(-2 j q)) / (1 - r^2 exp(-2 j q)),   T = (1 - r^2) exp(-j q) / (1 - r^2 exp(-2 j q)).

    R refers to the front face. T includes the phase of the way through the slab; that of the same way through air is
    not subtracted. A perfect conductor has r_TE = -1 and r_TM = +1. Sionna RT's ``itu_coefficients_single_layer_slab``
    evaluates these equations as they stand. At grazing incidence and of thin slabs both differences vanish, which in
    single precision leaves coefficients of up to 2.2 and 0 / 0, and constants of 1e20 overflow. Here are the same with
    the vanishing factors removed, for r = (u - s) / (u + s) and after division by cosh(Im q):

        R = j (u^2 - s^2) S / D,   T = 2 u / (cosh(Im q) D),   D = 2 u C + j (u^2 + s^2) S,

    where C = cos q / cosh(Im q) and S = sin q / (s cosh(Im q)); TM is divided by eta once more. Differentiable in all
    arguments, which are Dr.Jit arrays of one precision.

    Source: ITU-R P.2040-3, equations 37, 43 and 44.
    """
    kind: Any = type(eta)
    j = kind(0, 1)
    cosine = dr.clip(dr.abs(cosine), GRAZING, 1)
    square_cosine = dr.square(cosine)
    eta = kind(dr.minimum(eta.real, LARGEST), dr.maximum(eta.imag, -LARGEST))
    phase_rad = dr.minimum(phase_rad, LARGEST)
    contrast = eta - 1
    square = contrast + square_cosine  # s^2 = eta - sin^2, without the difference of 1 and sin^2
    root = dr.sqrt(square)
    sine, cosine_q = dr.sincos(dr.minimum(phase_rad * root.real, LONGEST_RAD))
    loss = phase_rad * root.imag  # negative: the wave decays
    damping, decay = dr.tanh(loss), dr.exp(loss)
    c = kind(cosine_q, -sine * damping)
    s = kind(sine, cosine_q * damping) / root
    share = 2 * decay / (1 + dr.square(decay))  # 1 / cosh, of which the exponential does not overflow
    through = 2 * cosine * share
    te = dr.rcp(2 * cosine * c + j * (contrast + 2 * square_cosine) * s)
    tm = dr.rcp(2 * cosine * c + j * (eta * square_cosine + square / eta) * s)
    # u^2 - s^2 of TM over eta: (eta cos^2 - s^2 / eta) has the factor eta - 1.
    difference = contrast * (square_cosine - (1 - square_cosine) / eta)
    return SlabCoefficients(-j * contrast * s * te, j * difference * s * tm, through * te, through * tm)
