"""Positions on a mesh: the centres of its faces."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh

from ..core import InputError
from ..core.angles import FloatArray
from ..scene.coordinates import require_near
from ..scene.surfaces import mesh_parts
from .grid import LARGEST

ROUNDS = 20
"""Largest number of times that an edge is halved: a kilometre into millimetres."""


@dataclass(frozen=True)
class SurfaceMesh:
    """Triangles at whose centres a map is computed.

    Attributes:
        triangles_m: corners of the triangles [m, 3, 3], metres.
    """

    triangles_m: FloatArray

    @property
    def positions_m(self) -> FloatArray:
        """Centres of the triangles [m, 3], metres."""
        return np.asarray(self.triangles_m.mean(axis=1))


def surface_of(mesh: str | Path, step_m: float | None = None) -> SurfaceMesh:
    """Triangles of a mesh file, halved until no edge is longer than a step.

    Args:
        mesh: a format of `wrf_mi.scene.surfaces.mesh_parts`, in metres and the frame of the data.
        step_m: longest edge of a triangle, metres; None: the faces as they are.

    Raises:
        InputError: a file without faces, a coordinate that is not finite, or more than `LARGEST` triangles.
    """
    if not Path(mesh).is_file():
        raise InputError(f"{mesh}: no such file; give a mesh (PLY, STL, OBJ, GLB)")
    parts = [np.asarray(part.triangles, float) for part in mesh_parts(mesh)]
    if not parts:
        raise InputError(f"{mesh}: no faces; give a mesh with triangles")
    triangles = np.concatenate(parts)
    require_near(triangles.reshape(-1, 3), mesh)
    if step_m is not None:
        if not (np.isfinite(step_m) and step_m > 0):
            raise InputError(f"step {step_m:g} m: give a positive number of metres")
        edges = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=-1).max(axis=1)
        # Each halving makes four triangles of one.
        count = (4.0 ** np.ceil(np.log2(np.maximum(edges / step_m, 1)))).sum()
        if count > LARGEST:
            raise InputError(f"step {step_m:g} m: {count:.3g} triangles, the limit is {LARGEST}; give a larger step")
        faces = np.arange(3 * len(triangles)).reshape(-1, 3)
        vertices, faces = trimesh.remesh.subdivide_to_size(triangles.reshape(-1, 3), faces, step_m, max_iter=ROUNDS)
        triangles = vertices[faces]
    return SurfaceMesh(triangles)
