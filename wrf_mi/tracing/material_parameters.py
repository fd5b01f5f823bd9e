"""Radio materials as parameters without bounds.

Relative permittivity 1 + exp(x) and conductivity exp(y) in S/m: an optimiser may move x and y freely, a step changes
both by a factor, and the bounds (permittivity > 1, conductivity > 0) hold by construction.

A scene has these two for each of its named materials or, started from those, for each of its surfaces: the faces of one
object in one plane.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..backend.device import on_device
from ..core.angles import FloatArray
from ..core.types import IntArray
from .surfaces import Surfaces

LEAST_SUSCEPTIBILITY = 1e-3
"""A material of permittivity 1 (a metal, air) starts this much above it: the logarithm of 0 has no slope."""
LEAST_CONDUCTIVITY = 1e-6
"""S/m; the same for a lossless material."""

PREFIX = "material."
SURFACE = "surface"
"""In place of a material's name: parameters [n] of all surfaces."""
Materials = Literal["named", "surface"]
"""What has a permittivity and a conductivity of its own: each named material, or each surface."""


def name_of(material: str, quantity: str) -> str:
    """A material's parameter: ``material.<name>.permittivity`` or ``.conductivity``; `SURFACE` for all surfaces'."""
    return f"{PREFIX}{material}.{quantity}"


@dataclass(frozen=True)
class SlabMaterials:
    """The materials of a scene when it was read, and what of them is not a parameter; n in all.

    Attributes:
        names: in the scene; of surfaces ``<object>/<plane>``, the plane's number in `Surfaces`.
        permittivity: relative, shape [n].
        conductivity: S/m, shape [n].
        thickness_m: of the slab that each surface stands for, shape [n].
        reflected: share of the reflected amplitude that is not scattered, shape [n].
        of: what these are: parameters are [1] for each named material, or [n] for all surfaces.
    """

    names: tuple[str, ...]
    permittivity: FloatArray
    conductivity: FloatArray
    thickness_m: FloatArray
    reflected: FloatArray
    of: Materials = "named"

    def parameters(self) -> dict[str, NDArray[np.float32]]:
        """Parameters x and y: of each material [1], or of all surfaces [n]."""
        x = np.log(np.maximum(self.permittivity - 1, LEAST_SUSCEPTIBILITY)).astype(np.float32)
        y = np.log(np.maximum(self.conductivity, LEAST_CONDUCTIVITY)).astype(np.float32)
        if self.of == "surface":
            names = name_of(SURFACE, "permittivity"), name_of(SURFACE, "conductivity")
            return dict(zip(names, (x, y), strict=True)) if len(x) else {}
        values = {}
        for k, name in enumerate(self.names):
            values[name_of(name, "permittivity")] = x[k : k + 1]
            values[name_of(name, "conductivity")] = y[k : k + 1]
        return values

    def constants(self, float_type: Any) -> list[Any]:
        """Permittivity, conductivity, thickness and reflected share as they were read, [n] each, on the device."""
        read = self.permittivity, self.conductivity, self.thickness_m, self.reflected
        return [on_device(c, float_type) for c in read]

    def tables(self, parameters: Mapping[str, Any], stated: Sequence[Any]) -> tuple[Any, Any]:
        """Relative permittivity and conductivity [n], each from its parameter where there is one. Differentiable.

        Args:
            parameters: Dr.Jit tensors by the names of `parameters`.
            stated: permittivity and conductivity of `constants`, whose float type is that of the result.
        """

        def table(quantity: str, constant: FloatArray, given: Any, least: float) -> Any:
            float_type: Any = type(given)
            if self.of == "surface":
                whole = parameters.get(name_of(SURFACE, quantity))
                return given if whole is None else least + dr.exp(float_type(whole.array))
            entries = []
            for name, value in zip(self.names, constant, strict=True):
                parameter = parameters.get(name_of(name, quantity))
                entries.append(
                    float_type(float(value)) if parameter is None else least + dr.exp(float_type(parameter.array))
                )
            return dr.concat(entries) if entries else dr.zeros(float_type, 0)

        return (
            table("permittivity", self.permittivity, stated[0], 1.0),
            table("conductivity", self.conductivity, stated[1], 0.0),
        )


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


def slabs_of_faces(scene: Any, surfaces: Surfaces, of: Materials) -> tuple[SlabMaterials, IntArray]:
    """The slabs of a scene, and which of them each face is made of.

    Args:
        scene: a ``sionna.rt.Scene``.
        surfaces: its faces [f].
        of: `Materials`.

    Returns:
        The slabs, and for each face [f] a number among them; -1 where its material is no slab.
    """
    named = read_materials(scene)
    kinds = [scene.objects[name].radio_material.name for name in surfaces.names]
    number = np.array([named.names.index(kind) if kind in named.names else -1 for kind in kinds], np.int64)
    thing = surfaces.object_of(np.arange(len(surfaces.plane)))
    own = number[thing] if len(thing) else np.zeros(0, np.int64)
    if of == "named":
        return named, own
    met = own >= 0
    pairs, inverse = np.unique(np.stack([thing[met], surfaces.plane[met]], axis=1), axis=0, return_inverse=True)
    which = number[pairs[:, 0]]
    names = tuple(f"{surfaces.names[index]}/{plane}" for index, plane in pairs)
    face = np.full(len(own), -1, np.int64)
    face[met] = inverse.reshape(-1)
    slabs = SlabMaterials(
        names,
        named.permittivity[which],
        named.conductivity[which],
        named.thickness_m[which],
        named.reflected[which],
        of="surface",
    )
    return slabs, face


def physical(parameters: Mapping[str, NDArray[Any]]) -> dict[str, float]:
    """Relative permittivities and conductivities (S/m) of ``material.*`` parameters, by the same names.

    Those of surfaces by name and number: ``material.surface.permittivity[3]``.
    """
    values = {}
    for name, value in parameters.items():
        if name.startswith(PREFIX):
            least = 1.0 if name.endswith(".permittivity") else 0.0
            several = name.startswith(name_of(SURFACE, ""))
            for k, exp in enumerate(np.exp(np.ravel(np.asarray(value, float)))):
                values[f"{name}[{k}]" if several else name] = least + float(exp)
    return values
