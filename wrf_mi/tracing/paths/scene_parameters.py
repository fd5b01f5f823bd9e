"""Radio materials and planes of a scene as parameters.

Materials: relative permittivity 1 + exp(x), conductivity exp(y) in S/m and thickness exp(z) in metres: a step of an
optimiser changes each by a factor, and permittivity > 1, conductivity > 0, thickness > 0 hold by construction. At
another frequency f than that f0 of the scene, the conductivity is exp(y) (f / f0)^d, the law of ITU-R P.2040;
thickness and exponent d are optional parameters. A scene has them for each of its named materials or, started from
those, for each of its surfaces, the faces of an object in a plane.

Planes: a plane n . x = d with unit vectors a, b in it and the centroid c of its faces becomes

    n' = (n + t_a a + t_b b) / abs(n + t_a a + t_b b),   d' = n' . c + s

with the shift s in metres and the tilts t_a, t_b in rad: small tilts are rotations about b and -a through c.
`wrf_mi.tracing.search.surfaces.Surfaces.moved_planes` is the NumPy version.

The chains of surfaces are searched for on the mesh as stated and kept when planes move, as a moved mesh has gaps at its
corners through which rays leave. Paths follow their planes continuously. Not modelled are paths that appear or vanish
within about the shift from an edge of a plane's outline, a share of shift / size of the plane: 1 % for 3 cm of a wall
of 3 m. So, unlike a receiver's position, a shift of a quarter of a wavelength needs no new search.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ...backend.device import columns_on_device, on_device, to_uint
from ...backend.vectors import Float64, Vector
from ...core.types import FloatArray, IntArray
from ..search.surfaces import Surfaces
from ..sionna.materials import conductivity_exponent
from .field_calculator import Level

LEAST_SUSCEPTIBILITY = 1e-3  # start of permittivity - 1 where it is 0 (metal, air) and has no logarithm
LEAST_CONDUCTIVITY = 1e-6  # start of the conductivity of lossless materials, S/m

PREFIX, EXPONENT = "material.", "exponent"
SURFACE = "surface"  # in place of a material's name: parameters [n] of all surfaces
QUANTITIES = ("permittivity", "conductivity", "thickness", EXPONENT)  # constants of a material that may be parameters
TRAINED = QUANTITIES[:2]  # those that are parameters by default
LEAST = {"permittivity": 1.0, "conductivity": 0.0, "thickness": 0.0}
"""Least value of the constants whose parameter is the logarithm of what they are above it."""
COLUMNS = (*QUANTITIES, "reflected")  # constants of `SlabMaterials`, each an array
MaterialGrouping = Literal["named", "surface"]  # whether each named material, or each surface, has parameters
SHIFT, TILT = "plane.shift", "plane.tilt"  # parameters [q], metres, and [q, 2], rad, of the planes of `Surfaces`


def name_of(material: str, quantity: str) -> str:
    """A material's parameter, ``material.<name>.<quantity>`` with one of `QUANTITIES`; `SURFACE` for all surfaces."""
    return f"{PREFIX}{material}.{quantity}"


@dataclass(frozen=True)
class SlabMaterials:
    """The n stated materials of a scene, with the constants that are not parameters."""

    names: tuple[str, ...]  # names in the scene; of surfaces ``<object>/<plane>``, the plane's number in `Surfaces`
    permittivity: FloatArray  # relative, shape [n]
    conductivity: FloatArray  # S/m, shape [n]
    thickness: FloatArray  # thickness of the slab that stands for a surface, metres, shape [n]
    exponent: FloatArray  # exponent of the frequency in the conductivity, shape [n]
    reflected: FloatArray  # share of the reflected amplitude that is not scattered, shape [n]
    grouping: MaterialGrouping = "named"  # parameters are [1] for each named material, or [n] for all surfaces

    def select(self, slabs: IntArray) -> SlabMaterials:
        """Materials by their numbers, in that order."""
        columns = {name: getattr(self, name)[slabs] for name in COLUMNS}
        return replace(self, names=tuple(self.names[slab] for slab in slabs), **columns)

    def _owners(self) -> list[tuple[str, slice]]:
        """Names that parameters have in place of a material's, and the materials that each is of."""
        if self.grouping == "surface":
            return [(SURFACE, slice(None))] if self.names else []
        return [(name, slice(index, index + 1)) for index, name in enumerate(self.names)]

    def parameters(self, quantities: Sequence[str] = TRAINED) -> dict[str, NDArray[np.float32]]:
        """Parameters of some of `QUANTITIES`: of each material [1], or of all surfaces [n]."""
        values = {
            "permittivity": np.log(np.maximum(self.permittivity - 1, LEAST_SUSCEPTIBILITY)),
            "conductivity": np.log(np.maximum(self.conductivity, LEAST_CONDUCTIVITY)),
            "thickness": np.log(self.thickness),
            EXPONENT: self.exponent,
        }
        columns = {quantity: values[quantity].astype(np.float32) for quantity in quantities}
        return {name_of(owner, q): column[rows] for owner, rows in self._owners() for q, column in columns.items()}

    def fitted(self, parameters: Mapping[str, NDArray[Any]]) -> SlabMaterials:
        """Materials with the constants of ``parameters``, where these have any."""
        columns = {quantity: getattr(self, quantity).astype(float) for quantity in QUANTITIES}
        for quantity, column in columns.items():
            for owner, rows in self._owners():
                if (parameter := parameters.get(name_of(owner, quantity))) is not None:
                    x = np.ravel(np.asarray(parameter, float))
                    column[rows] = LEAST[quantity] + np.exp(x) if quantity in LEAST else x
        return replace(self, **columns)

    @property
    def table(self) -> FloatArray:
        """Relative permittivity, conductivity in S/m and thickness in metres [n, 3]."""
        return np.stack([self.permittivity, self.conductivity, self.thickness], axis=1).astype(float)

    def constants(self, float_type: Any = Float64) -> dict[str, Any]:
        """Stated constants by the names of `COLUMNS`, [n] each, on the device."""
        return dict(zip(COLUMNS, columns_on_device([getattr(self, name) for name in COLUMNS], float_type), strict=True))

    def tables(
        self, parameters: Mapping[str, Any], stated: Mapping[str, Any], frequency_ratio: float = 1.0
    ) -> tuple[Any, Any, Any, Any]:
        """Relative permittivity, conductivity, thickness and reflected share [n], from parameters where there are any.

        Differentiable. ``parameters`` are Dr.Jit tensors by the names of `parameters`, ``stated`` is that of
        `constants`, whose float type the result has; ``frequency_ratio``: frequency over that at which conductivities
        are stated.
        """

        def column(quantity: str) -> Any:
            owners = [parameters.get(name_of(owner, quantity)) for owner, _ in self._owners()]
            float_type: Any = type(stated[quantity])
            if all(parameter is None for parameter in owners):
                return stated[quantity]

            def value(parameter: Any) -> Any:
                x = float_type(parameter.array)
                return LEAST[quantity] + dr.exp(x) if quantity in LEAST else x

            if self.grouping == "surface":
                return value(owners[0])
            pairs = zip(getattr(self, quantity), owners, strict=True)
            return dr.concat([float_type(float(x)) if p is None else value(p) for x, p in pairs])

        conductivity = column("conductivity")
        if frequency_ratio != 1:
            conductivity = conductivity * dr.exp(column(EXPONENT) * math.log(frequency_ratio))
        return column("permittivity"), conductivity, column("thickness"), stated["reflected"]


def read_materials(scene: Any) -> SlabMaterials:
    """The radio materials of a ``sionna.rt.Scene`` that are slabs (all of ITU-R P.2040 are)."""
    slabs = {n: m for n, m in scene.radio_materials.items() if hasattr(m, "relative_permittivity")}

    def column(quantity: str) -> FloatArray:
        return np.array([float(np.ravel(getattr(m, quantity))[0]) for m in slabs.values()])

    hz = float(scene.frequency[0])
    exponent = np.array([conductivity_exponent(material, hz) for material in slabs.values()])
    # Scattering takes S^2 of the reflected power (Degli-Esposti 2007), which leaves sqrt(1 - S^2) of the amplitude.
    reflected = np.sqrt(1 - column("scattering_coefficient") ** 2)
    constants = column("relative_permittivity"), column("conductivity"), column("thickness")
    return SlabMaterials(tuple(slabs), *constants, exponent, reflected)


def slabs_of_faces(scene: Any, surfaces: Surfaces, grouping: MaterialGrouping) -> tuple[SlabMaterials, IntArray]:
    """Slabs of a ``sionna.rt.Scene``, by named material or surface, and the index of each face's slab [f], -1: none."""
    named = read_materials(scene)
    objects = scene.objects  # a copy in each access
    kinds = [objects[name].radio_material.name for name in surfaces.names]
    number = np.array([named.names.index(kind) if kind in named.names else -1 for kind in kinds], np.int64)
    object_index = surfaces.object_of(np.arange(len(surfaces.plane)))
    slab_of_face = number[object_index] if len(object_index) else np.zeros(0, np.int64)
    if grouping == "named":
        return named, slab_of_face
    # A surface is a pair of object and plane: a box has six, which may be of different materials.
    is_slab = slab_of_face >= 0
    pairs, surface = np.unique(np.stack([object_index, surfaces.plane], axis=1)[is_slab], axis=0, return_inverse=True)
    slab_of_face[is_slab] = surface.reshape(-1)
    names = tuple(f"{surfaces.names[index]}/{plane}" for index, plane in pairs)
    return replace(named.select(number[pairs[:, 0]]), names=names, grouping=grouping), slab_of_face


@dataclass
class PlaneTables:
    """Stated planes of a scene, float64 arrays [q] on the device."""

    normal: Vector  # unit normals, three arrays [q]
    offset_m: Any  # n . x, metres, [q]
    centre_m: Vector  # centres of the tilts, metres, three arrays [q]
    axes: list[Vector]  # two unit vectors in each plane, three arrays [q] each

    @classmethod
    def of(cls, surfaces: Surfaces, planes: IntArray | slice = slice(None)) -> PlaneTables:
        """Tables of a scene's surfaces, or of some of its planes in the order of their numbers ``planes`` [q]."""

        def columns(vectors: NDArray[Any]) -> Vector:
            return columns_on_device(vectors[planes].T, Float64)

        axes = [columns(surfaces.axes[:, k]) for k in range(2)]
        offset = on_device(surfaces.offset[planes], Float64)
        return cls(columns(surfaces.normal), offset, columns(surfaces.plane_centres_m), axes)

    def parameters(self) -> dict[str, NDArray[np.float32]]:
        """Parameters of the stated planes: zeros [q] and [q, 2]; none for a scene without planes."""
        count = dr.width(self.offset_m)
        return {SHIFT: np.zeros(count, np.float32), TILT: np.zeros((count, 2), np.float32)} if count else {}

    def moved(self, parameters: Mapping[str, Any]) -> tuple[Vector, Any]:
        """Normals (three arrays [q]) and offsets [q] with the shifts and tilts of ``parameters``. Differentiable."""
        normal, offset = self.normal, self.offset_m
        if TILT in parameters:
            flat = parameters[TILT].array
            first = 2 * dr.arange(mi.UInt32, dr.width(offset))
            tilt = [Float64(dr.gather(type(flat), flat, first + k)) for k in range(2)]
            normal = [n + tilt[0] * a + tilt[1] * b for n, a, b in zip(normal, *self.axes, strict=True)]
            inverse = 1 / dr.sqrt(sum(c * c for c in normal))
            normal = [c * inverse for c in normal]
            # The centre of the faces stays in the plane: tilts then shift no path on average.
            offset = sum(n * c for n, c in zip(normal, self.centre_m, strict=True))
        if SHIFT in parameters:
            offset = offset + Float64(parameters[SHIFT].array)
        return normal, offset

    def move(self, levels: list[Level], parameters: Mapping[str, Any]) -> list[Level]:
        """Interactions at the moved planes; ``levels`` themselves without a parameter of planes."""
        if SHIFT not in parameters and TILT not in parameters:
            return levels
        normal, offset = self.moved(parameters)
        result = []
        for level in levels:
            at = level.plane, level.reflects | level.transmits  # place holders stay zero
            tilted = [dr.gather(Float64, c, *at) for c in normal] if TILT in parameters else level.normal
            result.append(replace(level, normal=tilted, offset_m=dr.gather(Float64, offset, *at)))
        return result


@dataclass(frozen=True)
class SceneTables:
    """Stated materials and planes."""

    slabs: SlabMaterials  # materials, or those of each surface
    slab_of_face: IntArray  # index of the material of each face [f], -1 where it is no slab
    constants: dict[str, Any]  # `SlabMaterials.constants`
    planes: PlaneTables  # planes on the device

    @classmethod
    def of(cls, scene: Any, surfaces: Surfaces, grouping: MaterialGrouping) -> SceneTables:
        """Tables of a ``sionna.rt.Scene`` and its surfaces."""
        slabs, slab_of_face = slabs_of_faces(scene, surfaces, grouping)
        return cls(slabs, slab_of_face, slabs.constants(), PlaneTables.of(surfaces))

    def select(self, surfaces: Surfaces, planes: IntArray, slabs: IntArray) -> SceneTables:
        """Tables of some planes and materials by their numbers, in that order; other faces have no material (-1)."""
        chosen, number = self.slabs.select(slabs), np.full(len(self.slabs.names) + 1, -1)
        number[slabs] = np.arange(len(slabs))
        slab_of_face = number[self.slab_of_face]  # the last one, -1, for faces without a material
        return SceneTables(chosen, slab_of_face, chosen.constants(), PlaneTables.of(surfaces, planes))


def renumbered(levels: Sequence[Level], planes: IntArray, slabs: IntArray) -> list[Level]:
    """Interactions with planes and materials numbered by their places in ``planes`` and ``slabs``, ascending."""
    # Both have all those that a path meets; place holders get any of these numbers.

    def places(numbers: Any, chosen: IntArray) -> Any:
        return to_uint(np.minimum(np.searchsorted(chosen, np.asarray(numbers)), len(chosen) - 1))

    columns = ((level, places(level.plane, planes), places(level.material, slabs)) for level in levels)
    return [replace(level, plane=plane, material=material) for level, plane, material in columns]
