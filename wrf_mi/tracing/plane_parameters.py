"""Planes of a scene as parameters: each may be shifted along its normal and tilted about its centre.

A plane n . x = d with unit vectors a, b in it and the centroid c of its faces becomes

    n' = (n + t_a a + t_b b) / abs(n + t_a a + t_b b),   d' = n' . c + s

with the shift s in metres and the tilts t_a, t_b in rad: of small tilts, turns about b and -a through c.
`wrf_mi.tracing.walls.Walls.moved` is the same in NumPy.

Which surfaces a path meets, and between which outlines, is searched for on the mesh as its files state it, and is kept
when planes move: a moved mesh has gaps at its corners, through which rays leave. A path follows its planes
continuously. What is missed are paths that meet a plane within about the shift from an edge of its outline and would
appear or vanish, a share of shift / size of the plane: 1 % for 3 cm of a wall of 3 m. So, unlike a receiver's position,
a shift calls for no new search at a quarter of a wavelength; that far all interference is followed exactly.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..backend.device import on_device
from .field_calculator import Level, Vector
from .surfaces import Surfaces
from .walls import plane_centres

Float64: Any = dr.float64_array_t(mi.Float)
SHIFT, TILT = "plane.shift", "plane.tilt"
"""Parameters [q] in metres and [q, 2] in rad of the q planes of `Surfaces`; all receivers of a scene share them."""


@dataclass
class PlaneTables:
    """The q planes of a scene as stated, float64 arrays [q] on the device.

    Attributes:
        normal: unit normal.
        offset_m: n . x.
        centre_m: point of the plane about which it tilts.
        axes: two unit vectors in the plane.
    """

    normal: Vector
    offset_m: Any
    centre_m: Vector
    axes: list[Vector]

    @classmethod
    def of(cls, surfaces: Surfaces) -> PlaneTables:
        """Tables of a scene's surfaces."""

        def columns(vectors: NDArray[Any]) -> Vector:
            return [on_device(c, Float64) for c in vectors.T]

        axes = [columns(surfaces.axes[:, k]) for k in range(2)]
        offset = on_device(surfaces.offset, Float64)
        return cls(columns(surfaces.normal), offset, columns(plane_centres(surfaces)[0]), axes)

    def parameters(self) -> dict[str, NDArray[np.float32]]:
        """Planes as stated: zeros [q] and [q, 2]; nothing for a scene without planes."""
        count = dr.width(self.offset_m)
        return {SHIFT: np.zeros(count, np.float32), TILT: np.zeros((count, 2), np.float32)} if count else {}

    def moved(self, parameters: Mapping[str, Any]) -> tuple[Vector, Any]:
        """Normals and offsets with the shifts and tilts that ``parameters`` hold. Differentiable."""
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
        """Interactions at the moved planes; where neither parameter is there, ``levels`` as they are."""
        if SHIFT not in parameters and TILT not in parameters:
            return levels
        normal, offset = self.moved(parameters)
        result = []
        for level in levels:
            met = level.reflects | level.transmits

            def of(table: Any, level: Level = level, met: Any = met) -> Any:
                return dr.gather(Float64, table, level.plane, met)

            own = [of(c) for c in normal] if TILT in parameters else level.normal
            result.append(replace(level, normal=own, offset_m=of(offset)))
        return result
