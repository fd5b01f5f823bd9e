"""The surfaces that a scene is made of: named triangle meshes with a role in the building."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
import trimesh

from ...core.angles import FloatArray
from ...core.types import IntArray

Kind = Literal["floor", "ceiling", "wall", "other"]
KINDS: tuple[Kind, ...] = get_args(Kind)
SAME_CORNER_M = 1e-4
"""Distance within which corners of faces coincide: STL has no shared vertices, and meshes that meet leave a gap."""


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
    def mesh(self) -> trimesh.Trimesh:
        """Its vertices and faces as they are."""
        return trimesh.Trimesh(self.vertices_m, self.faces, process=False)


def number_names(kinds: Sequence[str]) -> list[str]:
    """A unique name for each part: ``floor``, or ``wall_01``, ``wall_02``, ... where a kind comes more than once."""
    names, total, number = [], Counter(kinds), Counter[str]()
    for kind in kinds:
        number[kind] += 1
        names.append(kind if total[kind] == 1 else f"{kind}_{number[kind]:02d}")
    return names


def moved(surfaces: Sequence[Surface], matrix: FloatArray) -> list[Surface]:
    """Surfaces moved by a matrix [4, 4]."""
    return [replace(surface, vertices_m=trimesh.transform_points(surface.vertices_m, matrix)) for surface in surfaces]


def box_of(surfaces: Sequence[Surface]) -> FloatArray:
    """Lower and upper corner [2, 3] of the box around surfaces, metres."""
    corners = np.concatenate([surface.vertices_m for surface in surfaces])
    return np.stack([corners.min(axis=0), corners.max(axis=0)])


def cut_lines(surface: Surface, height_m: float) -> FloatArray:
    """Horizontal cut of a surface at a height: lines [n, 2, 2] in plan, metres; none where it is not met."""
    cut = trimesh.intersections.mesh_plane(surface.mesh, [0, 0, 1], [0, 0, height_m])
    return np.asarray(cut, float).reshape(-1, 2, 3)[..., :2]


def shared_edges(corners_m: FloatArray) -> tuple[IntArray, IntArray]:
    """Edges of triangles [f, 3, 3], the same for faces whose corners coincide.

    Returns:
        Number of the edge from each corner of each face to its next, shape [3 f], and both ends' vertices [3 f, 2].
    """
    _, vertex = np.unique(np.round(corners_m.reshape(-1, 3) / SAME_CORNER_M), axis=0, return_inverse=True)
    vertex = vertex.reshape(-1, 3)
    ends = trimesh.geometry.faces_to_edges(vertex)
    # Numbers of both vertices in one integer: NumPy's unique rows take ten times as long.
    both = np.sort(ends, axis=1) @ [len(ends), 1]
    return np.unique(both, return_inverse=True)[1].reshape(-1), ends


def sampled(triangles: FloatArray, count: int = 20_000) -> FloatArray:
    """Points [count, 3] spread evenly over triangles [f, 3, 3]."""
    mesh = trimesh.Trimesh(**trimesh.triangles.to_kwargs(triangles), process=False)
    return np.asarray(trimesh.sample.sample_surface(mesh, count, seed=0)[0])


def bodies(corners_m: FloatArray) -> list[tuple[IntArray, bool, float]]:
    """Bodies of triangles [f, 3, 3] that are connected by their edges.

    Returns:
        Of each body its faces [n], whether it is closed (two faces at every edge), and the volume in m^3 of a closed
        body: positive where the normals point outwards, 0 where they disagree.
    """
    count = len(corners_m)
    if not count:
        return []
    edge, ends = shared_edges(corners_m)
    uses, face = np.bincount(edge), np.repeat(np.arange(count), 3)
    # Faces and edges are the nodes of one graph, so that an edge of many faces costs no more.
    incidence = np.stack([face, count + edge], axis=-1)
    body = trimesh.graph.connected_component_labels(incidence, count + len(uses))[:count]
    # Neighbours of the same orientation run along their common edge in opposite directions.
    turned = np.bincount(edge, np.sign(ends[:, 1] - ends[:, 0]))
    unpaired, crossed = (np.bincount(body[face], wrong[edge]) for wrong in (uses != 2, turned != 0))
    a, b, c = (corners_m - corners_m[0, 0]).transpose(1, 0, 2)
    volume = np.bincount(body, (a * np.cross(b, c)).sum(axis=1) / 6) * (crossed == 0)
    members = np.split(np.argsort(body, kind="stable"), np.cumsum(np.bincount(body))[:-1])
    return list(zip(members, (unpaired == 0).tolist(), volume.tolist(), strict=True))
