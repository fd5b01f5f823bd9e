"""Planes of a scene as parameters: shifts along their normals and tilts about their centres.

A plane n . x = d with unit vectors a, b in it and the centroid c of its faces becomes

    n' = (n + t_a a + t_b b) / abs(n + t_a a + t_b b),   d' = n' . c + s

with the shift s in metres and the tilts t_a, t_b in rad: small tilts are rotations about b and -a through c.
`wrf_mi.tracing.search.surfaces.Surfaces.moved_planes` is the NumPy version.

The chains of surfaces are searched for on the mesh as stated and kept when planes move, as a moved mesh has gaps at its
corners through which rays leave. Paths follow their planes continuously. Not modelled are paths that appear or vanish
within about the shift from an edge of a plane's outline, a share of shift / size of the plane: 1 % for 3 cm of a wall
of 3 m. So, unlike a receiver's position, a shift of a quarter of a wavelength needs no new search.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ...backend.device import columns_on_device, on_device, to_uint
from ...backend.vectors import Float64, Vector
from ...core.types import IntArray
from ..search.surfaces import Surfaces
from .field_calculator import Level
from .material_parameters import MaterialGrouping, SlabMaterials, slabs_of_faces

SHIFT, TILT = "plane.shift", "plane.tilt"
"""Names of the parameters [q] in metres and [q, 2] in rad of the q planes of `Surfaces`, shared by all receivers."""


@dataclass
class PlaneTables:
    """Stated planes of a scene, float64 arrays [q] on the device.

    Attributes:
        normal: unit normals, three arrays [q].
        offset_m: n . x, metres, [q].
        centre_m: centres of the tilts, metres, three arrays [q].
        axes: two unit vectors in each plane, three arrays [q] each.
    """

    normal: Vector
    offset_m: Any
    centre_m: Vector
    axes: list[Vector]

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
            at = level.plane, level.reflects | level.transmits
            tilted = [dr.gather(Float64, c, *at) for c in normal] if TILT in parameters else level.normal
            result.append(replace(level, normal=tilted, offset_m=dr.gather(Float64, offset, *at)))
        return result


@dataclass(frozen=True)
class SceneTables:
    """Stated materials and planes.

    Attributes:
        slabs: materials, or those of each surface.
        slab_of_face: index of the material of each face [f], -1 where it is no slab.
        constants: `SlabMaterials.constants`, float64.
        planes: planes on the device.
    """

    slabs: SlabMaterials
    slab_of_face: IntArray
    constants: list[Any]
    planes: PlaneTables

    @classmethod
    def of(cls, scene: Any, surfaces: Surfaces, grouping: MaterialGrouping) -> SceneTables:
        """Tables of a ``sionna.rt.Scene`` and its surfaces."""
        slabs, slab_of_face = slabs_of_faces(scene, surfaces, grouping)
        return cls(slabs, slab_of_face, slabs.constants(Float64), PlaneTables.of(surfaces))

    def select(self, surfaces: Surfaces, planes: IntArray, slabs: IntArray) -> SceneTables:
        """Tables of some planes and materials by their numbers, in that order; other faces have no material (-1)."""
        chosen, number = self.slabs.select(slabs), np.full(len(self.slabs.names) + 1, -1)
        number[slabs] = np.arange(len(slabs))
        slab_of_face = number[self.slab_of_face]  # the last one, -1, for faces without a material
        return SceneTables(chosen, slab_of_face, chosen.constants(Float64), PlaneTables.of(surfaces, planes))


def renumbered(levels: Sequence[Level], planes: IntArray, slabs: IntArray) -> list[Level]:
    """Interactions with planes and materials numbered by their places in ``planes`` and ``slabs``, ascending.

    Both have all those that a path meets; interactions that are place holders get any of these numbers.
    """

    def places(numbers: Any, chosen: IntArray) -> Any:
        return to_uint(np.minimum(np.searchsorted(chosen, np.asarray(numbers)), len(chosen) - 1))

    return [
        replace(level, plane=places(level.plane, planes), material=places(level.material, slabs)) for level in levels
    ]
