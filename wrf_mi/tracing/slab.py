"""Reflection at and transmission through a slab of a radio material, ITU-R P.2040."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.constants import epsilon_0, speed_of_light


@dataclass
class SlabCoefficients:
    """Complex reflection and transmission coefficients of p passages, TE and TM."""

    reflected_te: Any
    reflected_tm: Any
    transmitted_te: Any
    transmitted_tm: Any


def slab(cosine: Any, permittivity: Any, conductivity: Any, thickness_m: Any, frequency_hz: Any) -> SlabCoefficients:
    """Reflection at and transmission through a homogeneous slab in air.

    With the complex relative permittivity eta = eps_r - j sigma / (2 pi f eps_0), for the time factor exp(+j omega t),
    and s = sqrt(eta - sin^2 theta), the Fresnel coefficients of one face are

        r_TE = (cos theta - s) / (cos theta + s),   r_TM = (eta cos theta - s) / (eta cos theta + s)

    and those of a slab of thickness d, with q = 2 pi d s / lambda,

        R = r (1 - exp(-2 j q)) / (1 - r^2 exp(-2 j q)),   T = (1 - r^2) exp(-j q) / (1 - r^2 exp(-2 j q)).

    R refers to the front face. T includes the phase of the way through the slab; that of the same way through air is
    not subtracted. A perfect conductor has r_TE = -1 and r_TM = +1. Sionna RT's ``itu_coefficients_single_layer_slab``
    has the same equations, in float32 for any input; here in the type of ``cosine``. Differentiable in all Dr.Jit
    arguments.

    Args:
        cosine: cosine of the angle of incidence theta, a Dr.Jit array of either float type, [p].
        permittivity: relative permittivity eps_r, [p].
        conductivity: sigma, S/m, [p].
        thickness_m: d, metres, [p].
        frequency_hz: carrier frequency f, a number or an array of the same type.

    Source: ITU-R P.2040-3, equations 37, 43 and 44.
    """
    kind: Any = mi.Complex2f if type(cosine) is mi.Float else dr.float64_array_t(mi.Complex2f)
    j = kind(0, 1)
    eta = permittivity - j * (conductivity / (2 * np.pi * frequency_hz * epsilon_0))
    root = dr.sqrt(eta - (1 - cosine * cosine))
    te = (cosine - root) / (cosine + root)
    tm = (eta * cosine - root) / (eta * cosine + root)
    once = dr.exp(-j * (2 * np.pi * frequency_hz / speed_of_light) * thickness_m * root)
    twice = once * once
    through_te, through_tm = (1 / (1 - r * r * twice) for r in (te, tm))
    return SlabCoefficients(
        te * (1 - twice) * through_te,
        tm * (1 - twice) * through_tm,
        (1 - te * te) * once * through_te,
        (1 - tm * tm) * once * through_tm,
    )
