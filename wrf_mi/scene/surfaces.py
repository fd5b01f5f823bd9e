"""The surfaces that a scene is made of: named triangle meshes with a role in the building."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import trimesh

from ..core.angles import FloatArray
from ..core.types import IntArray

Kind = Literal["floor", "ceiling", "wall", "other"]
KINDS: tuple[Kind, ...] = get_args(Kind)


@dataclass(frozen=True)
class Surface:
    """A named part of a scene, one sheet or body of triangles.

    Radio materials act on both sides, so the order of a face's vertices has no meaning.

    Attributes:
        name: unique in its scene; letters, digits, ``_`` and ``-``.
        kind: its role, which decides its material.
        vertices_m: shape [v, 3], metres.
        faces: vertex indices, shape [f, 3].
    """

    name: str
    kind: Kind
    vertices_m: FloatArray
    faces: IntArray

    @property
    def area_m2(self) -> float:
        """Sum of the areas of its faces."""
        return float(trimesh.triangles.area(self.vertices_m[self.faces]).sum())


def number_names(kinds: Sequence[Kind]) -> list[str]:
    """A unique name for each surface: ``floor``, or ``wall_01``, ``wall_02``, ... where a kind comes more than once."""
    names, seen = [], dict.fromkeys(KINDS, 0)
    for kind in kinds:
        seen[kind] += 1
        names.append(kind if kinds.count(kind) == 1 else f"{kind}_{seen[kind]:02d}")
    return names


def moved(surfaces: Sequence[Surface], matrix: FloatArray) -> list[Surface]:
    """Surfaces moved by a matrix [4, 4]."""
    return [replace(surface, vertices_m=trimesh.transform_points(surface.vertices_m, matrix)) for surface in surfaces]
