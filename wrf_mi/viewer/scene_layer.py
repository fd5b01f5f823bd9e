"""Mesh of a view: triangles of a scene by material, and its edges."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from ..core import InputError
from ..runs.scene_view import surfaces_of
from ..scene.mesh.surfaces import Surface
from ..scene.preview import ceiling_faces, free_edges
from ..tracing import open_scene
from ..tracing.sionna.scenes import MESHES
from .content import MaterialMesh, SceneContent

MOST_TRIANGLES = 100_000  # triangles of a page, the largest: 2.4 MB
MOST_EDGES = 20_000
OPENED_HZ = 3.5e9
"""Carrier at which a scene without data is opened; materials are shown by name, so that it has no influence."""
NO_MATERIAL, ANY_MATERIAL = "no material", "concrete"  # label of a bare mesh, and the material that it is opened with


def read_scene(source: str | Path, material: str | None = None) -> tuple[list[Surface], dict[str, str]]:
    """Surfaces of a scene, and the radio material of each by its name.

    Args:
        source: name of a scene, scene folder, Mitsuba XML or mesh.
        material: radio material of a mesh; None: it is shown without one.

    Raises:
        InputError: no such scene, or one that cannot be opened.
    """
    bare = material is None and Path(source).suffix.lower() in MESHES
    if bare and not Path(source).is_file():
        raise InputError(f"{source}: no such file; give a run folder, a map or a scene")
    surfaces, materials = surfaces_in(open_scene(source, OPENED_HZ, material=ANY_MATERIAL if bare else material))
    return surfaces, dict.fromkeys(materials, NO_MATERIAL) if bare else materials


def surfaces_in(scene: Any) -> tuple[list[Surface], dict[str, str]]:
    """Surfaces of a ``sionna.rt.Scene``, and the radio material of each by its name."""
    materials = {name: thing.radio_material.name for name, thing in scene.objects.items()}
    return surfaces_of(scene), materials


def scene_content(
    surfaces: Sequence[Surface], materials: Mapping[str, str], most: int = MOST_TRIANGLES
) -> tuple[SceneContent, str | None]:
    """Triangles by material, and a note if there are more than ``most``, of which the largest are kept."""
    vertices = np.concatenate([surface.vertices_m for surface in surfaces])
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    corners = np.concatenate([surface.vertices_m[surface.faces] for surface in surfaces])
    ceiling = np.concatenate([ceiling_faces(surface, low, high) for surface in surfaces])
    number = np.repeat(np.arange(len(surfaces)), [len(surface.faces) for surface in surfaces])
    kept, note = np.ones(len(corners), bool), None
    if len(corners) > most:
        kept[:] = False
        kept[np.argsort(-trimesh.triangles.area(corners), kind="stable")[:most]] = True
        note = f"Mesh: the largest {most} of {len(corners)} triangles."
    labels = np.array([material_label(materials[surface.name]) for surface in surfaces])
    meshes = []
    for label in sorted(set(labels)):
        for above in (False, True):
            chosen = np.flatnonzero(kept & (labels[number] == label) & (ceiling == above))
            if len(chosen):
                used, index = np.unique(number[chosen], return_inverse=True)
                names = tuple(surfaces[k].name for k in used)
                meshes.append(MaterialMesh(str(label), above, corners[chosen], index, names))
    edges = np.concatenate([free_edges(surface, creases=True) for surface in surfaces if surface.kind != "ceiling"])
    length = np.linalg.norm(edges[:, 1] - edges[:, 0], axis=-1)
    return SceneContent(tuple(meshes), edges[np.argsort(-length, kind="stable")[:MOST_EDGES]]), note


def material_label(material: str) -> str:
    """Name of a radio material without the prefix of ITU-R P.2040's."""
    return material.removeprefix("itu_").removeprefix("itu-").replace("_", " ")
