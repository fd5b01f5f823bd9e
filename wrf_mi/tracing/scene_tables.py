"""A scene's materials and planes as traced fields read them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from ..core.types import IntArray
from .material_parameters import MaterialGrouping, SlabMaterials, slabs_of_faces
from .plane_parameters import PlaneTables
from .surfaces import Surfaces

Float64: Any = dr.float64_array_t(mi.Float)


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
