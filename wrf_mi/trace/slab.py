"""What a slab of a radio material does to a wave: reflection and transmission, ITU-R P.2040."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.constants import epsilon_0, speed_of_light


@dataclass
class SlabCoefficients:
    """Complex coefficients of p passages, as Dr.Jit's complex arrays: reflection and transmission, TE and TM."""

    reflected_te: Any
    reflected_tm: Any
    transmitted_te: Any
    transmitted_tm: Any


def slab(cosine: Any, permittivity: Any, conductivity: Any, thickness_m: Any, frequency_hz: Any) -> SlabCoefficients:
    """Reflection at and transmission through a homogeneous slab in air. Differentiable in all arrays.

    The same equations as Sionna RT's ``itu_coefficients_single_layer_slab``, which computes in float32 whatever it is
    given; here in the type of ``cosine``.

    Args:
        cosine: of the angle of incidence, any float type, [p].
        permittivity: relative, [p].
        conductivity: S/m, [p].
        thickness_m: metres, [p].
        frequency_hz: of the carrier, a number or an array of the same float type.

    Source: ITU-R P.2040-3, equations 37, 43 and 44.
    """
    kind: Any = mi.Complex2f if type(cosine) is mi.Float else dr.float64_array_t(mi.Complex2f)
    eta = kind(permittivity, -conductivity / (2 * np.pi * frequency_hz * epsilon_0))
    root = dr.sqrt(eta - (1 - cosine * cosine))
    te = (cosine - root) / (cosine + root)
    tm = (eta * cosine - root) / (eta * cosine + root)
    once = dr.exp(kind(0, -2 * np.pi * frequency_hz / speed_of_light) * thickness_m * root)
    twice = once * once
    through_te, through_tm = (dr.rcp(1 - r * r * twice) for r in (te, tm))
    return SlabCoefficients(
        te * (1 - twice) * through_te,
        tm * (1 - twice) * through_tm,
        (1 - te * te) * once * through_te,
        (1 - tm * tm) * once * through_tm,
    )
