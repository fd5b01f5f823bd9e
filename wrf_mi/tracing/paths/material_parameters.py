"""Radio materials as parameters without bounds.

Relative permittivity 1 + exp(x), conductivity exp(y) in S/m and thickness exp(z) in metres: a step of an optimiser
changes each by a factor, and permittivity > 1, conductivity > 0, thickness > 0 hold by construction. At another
frequency f than that f0 of the scene, the conductivity is exp(y) (f / f0)^d, the law of ITU-R P.2040; the exponent d
is an optional parameter, too.

A scene has them for each of its named materials or, started from those, for each of its surfaces, the faces of an
object in a plane. The thickness is an optional parameter.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ...backend.device import columns_on_device
from ...core.angles import FloatArray
from ...core.types import IntArray
from ..search.surfaces import Surfaces
from ..sionna.materials import conductivity_exponent

LEAST_SUSCEPTIBILITY = 1e-3
"""Start of permittivity - 1 for materials of permittivity 1 (metal, air), whose logarithm has no derivative."""
LEAST_CONDUCTIVITY = 1e-6
"""Start of the conductivity of lossless materials, S/m."""

PREFIX, EXPONENT = "material.", "exponent"
SURFACE = "surface"
"""In place of a material's name: parameters [n] of all surfaces."""
QUANTITIES = ("permittivity", "conductivity", "thickness", EXPONENT)
"""Constants of a material that may be parameters."""
TRAINED = QUANTITIES[:2]
"""Those that are by default."""
LEAST = {"permittivity": 1.0, "conductivity": 0.0, "thickness": 0.0}
"""Least value of the constants whose parameter is the logarithm of what they are above it."""
COLUMNS = ("permittivity", "conductivity", "thickness_m", "reflected", "exponent")
"""Constants of `SlabMaterials`, each an array."""
ATTRIBUTE = {"thickness": "thickness_m"}
"""Names of constants in `SlabMaterials` that differ from those of parameters."""
MaterialGrouping = Literal["named", "surface"]
"""Whether each named material, or each surface, has a permittivity and a conductivity."""


def name_of(material: str, quantity: str) -> str:
    """A material's parameter: ``material.<name>.permittivity``, ``.conductivity``, ``.thickness`` or ``.exponent``;
    `SURFACE` for all surfaces.
    """
    return f"{PREFIX}{material}.{quantity}"


@dataclass(frozen=True)
class SlabMaterials:
    """The n stated materials of a scene, with the constants that are not parameters.

    Attributes:
        names: names in the scene; of surfaces ``<object>/<plane>``, the plane's number in `Surfaces`.
        permittivity: relative, shape [n].
        conductivity: S/m, shape [n].
        thickness_m: thickness of the slab that stands for a surface, shape [n].
        reflected: share of the reflected amplitude that is not scattered, shape [n].
        exponent: exponent of the frequency in the conductivity, shape [n].
        grouping: parameters are [1] for each named material, or [n] for all surfaces.
    """

    names: tuple[str, ...]
    permittivity: FloatArray
    conductivity: FloatArray
    thickness_m: FloatArray
    reflected: FloatArray
    exponent: FloatArray
    grouping: MaterialGrouping = "named"

    def select(self, slabs: IntArray) -> SlabMaterials:
        """Materials by their numbers, in that order."""
        columns = {name: getattr(self, name)[slabs] for name in COLUMNS}
        return replace(self, names=tuple(self.names[slab] for slab in slabs), **columns)

    def parameters(self, quantities: Sequence[str] = TRAINED) -> dict[str, NDArray[np.float32]]:
        """Parameters of some of `QUANTITIES`: of each material [1], or of all surfaces [n]."""
        values = {
            "permittivity": np.log(np.maximum(self.permittivity - 1, LEAST_SUSCEPTIBILITY)),
            "conductivity": np.log(np.maximum(self.conductivity, LEAST_CONDUCTIVITY)),
            "thickness": np.log(self.thickness_m),
            EXPONENT: self.exponent,
        }
        columns = {quantity: values[quantity].astype(np.float32) for quantity in quantities}
        if self.grouping == "surface":
            return {name_of(SURFACE, quantity): column for quantity, column in columns.items() if len(column)}
        each = [(name, k, quantity) for k, name in enumerate(self.names) for quantity in columns]
        return {name_of(name, quantity): columns[quantity][k : k + 1] for name, k, quantity in each}

    def fitted(self, parameters: Mapping[str, NDArray[Any]]) -> SlabMaterials:
        """Materials with the constants of ``parameters``, where these have any."""
        columns = {quantity: getattr(self, ATTRIBUTE.get(quantity, quantity)).astype(float) for quantity in QUANTITIES}
        for quantity, column in columns.items():
            for index, name in enumerate([SURFACE] if self.grouping == "surface" else self.names):
                if (parameter := parameters.get(name_of(name, quantity))) is not None:
                    value = np.ravel(np.asarray(parameter, float))
                    rows = slice(None) if name == SURFACE else slice(index, index + 1)
                    column[rows] = LEAST[quantity] + np.exp(value) if quantity in LEAST else value
        return replace(self, **{ATTRIBUTE.get(quantity, quantity): column for quantity, column in columns.items()})

    @property
    def table(self) -> FloatArray:
        """Relative permittivity, conductivity in S/m and thickness in metres [n, 3]."""
        return np.stack([self.permittivity, self.conductivity, self.thickness_m], axis=1).astype(float)

    def constants(self, float_type: Any) -> list[Any]:
        """Stated permittivity, conductivity, thickness, reflected share and exponent, [n] each, on the device."""
        return columns_on_device([getattr(self, name) for name in COLUMNS], float_type)

    def tables(
        self, parameters: Mapping[str, Any], stated: Sequence[Any], frequency_ratio: float = 1.0
    ) -> tuple[Any, Any, Any, Any]:
        """Relative permittivity, conductivity, thickness and reflected share [n], from parameters where there are any.
        Differentiable.

        Args:
            parameters: Dr.Jit tensors by the names of `parameters`.
            stated: `constants`, whose float type is that of the result.
            frequency_ratio: frequency over that at which the scene and parameters state the conductivity.
        """

        def column(quantity: str) -> Any:
            attribute = ATTRIBUTE.get(quantity, quantity)
            constant = stated[COLUMNS.index(attribute)]
            float_type: Any = type(constant)

            def value(parameter: Any) -> Any:
                x = float_type(parameter.array)
                return LEAST[quantity] + dr.exp(x) if quantity in LEAST else x

            if self.grouping == "surface":
                of_all = parameters.get(name_of(SURFACE, quantity))
                return constant if of_all is None else value(of_all)
            each = [parameters.get(name_of(name, quantity)) for name in self.names]
            if all(parameter is None for parameter in each):
                return constant
            pairs = zip(getattr(self, attribute), each, strict=True)
            return dr.concat([float_type(float(x)) if p is None else value(p) for x, p in pairs])

        conductivity = column("conductivity")
        if frequency_ratio != 1:
            conductivity = conductivity * dr.exp(column(EXPONENT) * math.log(frequency_ratio))
        return column("permittivity"), conductivity, column("thickness"), stated[COLUMNS.index("reflected")]


def read_materials(scene: Any) -> SlabMaterials:
    """The radio materials of a ``sionna.rt.Scene`` that are slabs (all of ITU-R P.2040 are)."""
    known = {n: m for n, m in scene.radio_materials.items() if hasattr(m, "relative_permittivity")}

    def column(quantity: str) -> FloatArray:
        return np.array([float(np.ravel(getattr(m, quantity))[0]) for m in known.values()])

    reflected = np.sqrt(1 - column("scattering_coefficient") ** 2)
    constants = column("relative_permittivity"), column("conductivity"), column("thickness")
    hz = float(scene.frequency[0])
    exponent = np.array([conductivity_exponent(material, hz) for material in known.values()])
    return SlabMaterials(tuple(known), *constants, reflected, exponent)


def slabs_of_faces(scene: Any, surfaces: Surfaces, grouping: MaterialGrouping) -> tuple[SlabMaterials, IntArray]:
    """The slabs of a ``sionna.rt.Scene``, by named material or by surface, and the index of each face's slab [f].

    The index is -1 where the face's material is not a slab.
    """
    named = read_materials(scene)
    kinds = [scene.objects[name].radio_material.name for name in surfaces.names]
    number = np.array([named.names.index(kind) if kind in named.names else -1 for kind in kinds], np.int64)
    object_index = surfaces.object_of(np.arange(len(surfaces.plane)))
    slab_of_face = number[object_index] if len(object_index) else np.zeros(0, np.int64)
    if grouping == "named":
        return named, slab_of_face
    is_slab = slab_of_face >= 0
    pairs, surface = np.unique(np.stack([object_index, surfaces.plane], axis=1)[is_slab], axis=0, return_inverse=True)
    slab_of_face[is_slab] = surface.reshape(-1)
    names = tuple(f"{surfaces.names[index]}/{plane}" for index, plane in pairs)
    return replace(named.select(number[pairs[:, 0]]), names=names, grouping=grouping), slab_of_face
