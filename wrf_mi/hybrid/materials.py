"""Radio materials as parameters without bounds, and what a slab of them does to a wave.

Relative permittivity 1 + exp(x) and conductivity exp(y) in S/m: an optimiser may move x and y freely, a step changes
both by a factor, and the bounds (permittivity > 1, conductivity > 0) hold by construction.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.constants import epsilon_0, speed_of_light

from ..core.angles import FloatArray

LEAST_SUSCEPTIBILITY = 1e-3
"""A material of permittivity 1 (a metal, air) starts this much above it: the logarithm of 0 has no slope."""
LEAST_CONDUCTIVITY = 1e-6
"""S/m; the same for a lossless material."""

PREFIX = "material."


def name_of(material: str, quantity: str) -> str:
    """A material's parameter: ``material.<name>.permittivity`` or ``material.<name>.conductivity``."""
    return f"{PREFIX}{material}.{quantity}"


@dataclass(frozen=True)
class SlabMaterials:
    """The materials of a scene when it was read, and what of them is not a parameter; n in all.

    Attributes:
        names: in the scene.
        permittivity: relative, shape [n].
        conductivity: S/m, shape [n].
        thickness_m: of the slab that each surface stands for, shape [n].
        reflected: share of the reflected amplitude that is not scattered, shape [n].
    """

    names: tuple[str, ...]
    permittivity: FloatArray
    conductivity: FloatArray
    thickness_m: FloatArray
    reflected: FloatArray

    def parameters(self) -> dict[str, NDArray[np.float32]]:
        """Parameters x and y of each material, [1]."""
        values = {}
        for name, permittivity, conductivity in zip(self.names, self.permittivity, self.conductivity, strict=True):
            x = np.log(max(permittivity - 1, LEAST_SUSCEPTIBILITY))
            y = np.log(max(conductivity, LEAST_CONDUCTIVITY))
            values[name_of(name, "permittivity")] = np.array([x], np.float32)
            values[name_of(name, "conductivity")] = np.array([y], np.float32)
        return values

    def tables(self, parameters: Mapping[str, Any], float_type: Any) -> tuple[Any, Any]:
        """Relative permittivity and conductivity [n], each from its parameter where there is one. Differentiable."""

        def table(quantity: str, constant: FloatArray, least: float) -> Any:
            entries = []
            for name, value in zip(self.names, constant, strict=True):
                parameter = parameters.get(name_of(name, quantity))
                entries.append(
                    float_type(float(value)) if parameter is None else least + dr.exp(float_type(parameter.array))
                )
            return dr.concat(entries) if entries else dr.zeros(float_type, 0)

        return table("permittivity", self.permittivity, 1.0), table("conductivity", self.conductivity, 0.0)


def read_materials(scene: Any) -> SlabMaterials:
    """The radio materials of a ``sionna.rt.Scene`` that are slabs (all of ITU-R P.2040 are)."""
    known = {n: m for n, m in scene.radio_materials.items() if hasattr(m, "relative_permittivity")}

    def column(quantity: str) -> FloatArray:
        return np.array([float(np.ravel(getattr(m, quantity))[0]) for m in known.values()])

    return SlabMaterials(
        tuple(known),
        column("relative_permittivity"),
        column("conductivity"),
        column("thickness"),
        np.sqrt(1 - column("scattering_coefficient") ** 2),
    )


def physical(parameters: Mapping[str, NDArray[Any]]) -> dict[str, float]:
    """Relative permittivities and conductivities (S/m) of ``material.*`` parameters, by the same names."""
    values = {}
    for name, value in parameters.items():
        if name.startswith(PREFIX):
            exp = float(np.exp(np.ravel(value)[0]))
            values[name] = 1 + exp if name.endswith(".permittivity") else exp
    return values


@dataclass
class SlabCoefficients:
    """Complex coefficients of p passages, as Dr.Jit's complex arrays: reflection and transmission, TE and TM."""

    reflected_te: Any
    reflected_tm: Any
    transmitted_te: Any
    transmitted_tm: Any


def slab(cosine: Any, permittivity: Any, conductivity: Any, thickness_m: Any, frequency_hz: float) -> SlabCoefficients:
    """Reflection at and transmission through a homogeneous slab in air. Differentiable in all arrays.

    The same equations as Sionna RT's ``itu_coefficients_single_layer_slab``, which computes in float32 whatever it is
    given.

    Args:
        cosine: of the angle of incidence, any float type, [p].
        permittivity: relative, [p].
        conductivity: S/m, [p].
        thickness_m: metres, [p].
        frequency_hz: of the carrier.

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
