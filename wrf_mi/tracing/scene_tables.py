"""A scene's materials and planes as traced fields read them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..backend.device import to_uint
from ..core.types import IntArray
from .field_calculator import Level
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

    def select(self, surfaces: Surfaces, planes: IntArray, slabs: IntArray) -> SceneTables:
        """Tables of some planes and materials by their numbers, in that order; other faces have no material (-1)."""
        chosen = self.slabs.select(slabs)
        number = np.append(_places(slabs, len(self.slabs.names), -1), -1)
        constants = chosen.constants(Float64)
        return SceneTables(chosen, number[self.slab_of_face], constants, PlaneTables.of(surfaces, planes))


def renumbered(levels: Sequence[Level], planes: IntArray, slabs: IntArray) -> list[Level]:
    """Interactions with planes and materials numbered by their places in ``planes`` and ``slabs``.

    Both have all those that a path meets; interactions that are place holders get the number 0.
    """

    def places(numbers: Any, chosen: IntArray) -> Any:
        number = np.asarray(numbers)
        size = int(max(number.max(initial=0), chosen.max(initial=0))) + 1
        return to_uint(_places(chosen, size, 0)[number])

    return [
        replace(level, plane=places(level.plane, planes), material=places(level.material, slabs)) for level in levels
    ]


def _places(chosen: IntArray, count: int, missing: int) -> IntArray:
    """Place of each of ``count`` numbers among those chosen, or ``missing``."""
    places = np.full(count, missing, np.int64)
    places[chosen] = np.arange(len(chosen))
    return places
