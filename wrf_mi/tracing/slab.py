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
    """Complex coefficients of p passages: reflection and transmission, TE and TM."""

    reflected_te: Any
    reflected_tm: Any
    transmitted_te: Any
    transmitted_tm: Any


def slab(cosine: Any, permittivity: Any, conductivity: Any, thickness_m: Any, frequency_hz: Any) -> SlabCoefficients:
    """Reflection at and transmission through a homogeneous slab in air.

    The same equations as Sionna RT's ``itu_coefficients_single_layer_slab``, which computes in float32 whatever it is
    given; here in the type of ``cosine``. Differentiable in all of Dr.Jit's arrays.

    Args:
        cosine: of the angle of incidence, NumPy's or Dr.Jit's array of any float type, [p].
        permittivity: relative, [p].
        conductivity: S/m, [p].
        thickness_m: metres, [p].
        frequency_hz: of the carrier, a number or an array of the same type.

    Source: ITU-R P.2040-3, equations 37, 43 and 44.
    """
    functions: Any = np
    j: Any = 1j
    if not isinstance(cosine, np.ndarray):
        functions = dr
        kind: Any = mi.Complex2f if type(cosine) is mi.Float else dr.float64_array_t(mi.Complex2f)
        j = kind(0, 1)
    eta = permittivity - j * (conductivity / (2 * np.pi * frequency_hz * epsilon_0))
    root = functions.sqrt(eta - (1 - cosine * cosine))
    te = (cosine - root) / (cosine + root)
    tm = (eta * cosine - root) / (eta * cosine + root)
    once = functions.exp(-j * (2 * np.pi * frequency_hz / speed_of_light) * thickness_m * root)
    twice = once * once
    through_te, through_tm = (1 / (1 - r * r * twice) for r in (te, tm))
    return SlabCoefficients(
        te * (1 - twice) * through_te,
        tm * (1 - twice) * through_tm,
        (1 - te * te) * once * through_te,
        (1 - tm * tm) * once * through_tm,
    )
