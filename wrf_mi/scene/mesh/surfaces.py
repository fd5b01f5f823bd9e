"""The surfaces that a scene is made of: named triangle meshes with a role in the building."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, get_args

import numpy as np
import shapely
import trimesh
from numpy.typing import NDArray

from ...core.angles import FloatArray
from ...core.types import IntArray

logger = logging.getLogger(__name__)

Kind = Literal["floor", "ceiling", "wall", "other"]
KINDS: tuple[Kind, ...] = get_args(Kind)
SAME_CORNER_M = 1e-4
"""Distance within which corners of faces coincide: STL has no shared vertices, and meshes that meet leave a gap."""
COPY_M = 1e-8  # the same for copies of a face: equal but for rounding of a unit
SMALLEST_FACE_M2 = 1e-10  # smaller faces are degenerate: nothing reflects from them, and their normals are noise


@dataclass(frozen=True)
class Surface:
    """A named part of a scene, one sheet or body of triangles.

    Radio materials act on both sides, so the order of a face's vertices has no meaning.

    Attributes:
        name: unique in its scene; letters, digits, ``_`` and ``-``.
        kind: its role, which decides its material.
        vertices_m: shape [v, 3], metres.
        faces: vertex indices, shape [f, 3].
        material: material of ITU-R P.2040 that its source states, else empty.
    """

    name: str
    kind: Kind
    vertices_m: FloatArray
    faces: IntArray
    material: str = ""

    @property
    def mesh(self) -> trimesh.Trimesh:
        """Its vertices and faces as they are."""
        return trimesh.Trimesh(self.vertices_m, self.faces, process=False)


@dataclass(frozen=True, eq=False)
class Body:
    """Triangles that are connected by their edges.

    Attributes:
        faces: numbers of its triangles among those that were given [n].
        corners_m: their corners [n, 3, 3], metres.
        closed: whether two of them meet at every edge.
        volume_m3: volume of a closed body: positive where the normals point outwards, 0 where they disagree.
    """

    faces: IntArray
    corners_m: FloatArray
    closed: bool
    volume_m3: float

    @cached_property
    def bounds_m(self) -> FloatArray:
        """Lowest and highest coordinates, shape [2, 3]."""
        return bounds(self.corners_m)


def without_area(corners_m: FloatArray) -> NDArray[np.bool_]:
    """Which triangles [f, 3, 3] are degenerate, smaller than `SMALLEST_FACE_M2`."""
    return np.asarray(trimesh.triangles.area(corners_m) < SMALLEST_FACE_M2)


def with_area(surfaces: Sequence[Surface], source: str) -> list[Surface]:
    """Surfaces without the triangles that have no area in a scene's files, which are counted and logged.

    Surfaces of which nothing is left are left out. ``source`` names the surfaces, for the message.
    """
    # Files hold single precision, in which the corners of narrow triangles fall into a line.
    empty = [without_area(surface.vertices_m.astype(np.float32)[surface.faces].astype(float)) for surface in surfaces]
    if lost := sum(int(rows.sum()) for rows in empty):
        logger.warning("%s: %d of %d triangles have no area and are left out", source, lost, sum(map(len, empty)))
    parts = [replace(surface, faces=surface.faces[~rows]) for surface, rows in zip(surfaces, empty, strict=True)]
    return [part for part in parts if len(part.faces)]


def number_names(kinds: Sequence[str]) -> list[str]:
    """A unique name for each part: ``floor``, or ``wall_01``, ``wall_02``, ... where a kind comes more than once."""
    names, total, number = [], Counter(kinds), Counter[str]()
    for kind in kinds:
        number[kind] += 1
        names.append(kind if total[kind] == 1 else f"{kind}_{number[kind]:02d}")
    return names


def named_kind(name: str, entry: str) -> Kind:
    """Kind of a surface of a scene folder by its name and its entry in ``materials.yml``.

    A stated material takes the place of the kind, with which the name still begins.
    """
    return next((kind for kind in KINDS if entry == kind or name.startswith(kind)), "other")


def moved(surfaces: Sequence[Surface], matrix: FloatArray) -> list[Surface]:
    """Surfaces moved by a matrix [4, 4]."""
    return [replace(surface, vertices_m=trimesh.transform_points(surface.vertices_m, matrix)) for surface in surfaces]


def bounds(points_m: FloatArray) -> FloatArray:
    """Lowest and highest coordinates [2, 3] of points [..., 3]."""
    points = points_m.reshape(-1, 3)
    return np.stack([points.min(axis=0), points.max(axis=0)])


def box_of(surfaces: Sequence[Surface]) -> FloatArray:
    """Lower and upper corner [2, 3] of the box around surfaces, metres."""
    return bounds(np.concatenate([surface.vertices_m for surface in surfaces]))


def level_area(surfaces: Sequence[Surface]) -> Any:
    """Area (shapely) that surfaces cover, seen from above."""
    corners = np.concatenate([surface.vertices_m[surface.faces][..., :2] for surface in surfaces])
    # Triangles are widened by a micrometre first: rounding leaves slits between them.
    return shapely.union_all(shapely.buffer(shapely.polygons(corners), 1e-6))


def cut_lines(surface: Surface, height_m: float) -> FloatArray:
    """Horizontal cut of a surface at a height: lines [n, 2, 2] in plan, metres; none where it is not met."""
    cut = trimesh.intersections.mesh_plane(surface.mesh, [0, 0, 1], [0, 0, height_m])
    return np.asarray(cut, float).reshape(-1, 2, 3)[..., :2]


def welded(corners_m: FloatArray, same_m: float = SAME_CORNER_M) -> trimesh.Trimesh:
    """Triangles [f, 3, 3] in their order as a mesh that has one vertex where corners coincide."""
    mesh = trimesh.Trimesh(**trimesh.triangles.to_kwargs(corners_m), process=False)
    mesh.merge_vertices(digits_vertex=trimesh.util.decimal_to_digits(same_m))
    return mesh


def first_copies(corners_m: FloatArray) -> IntArray:
    """Number of the first of triangles [f, 3, 3] that has the corners of each, in any order [f]."""
    first, group = trimesh.grouping.unique_rows(np.sort(welded(corners_m, COPY_M).faces, axis=1))
    return np.asarray(first[group])


def copies(corners_m: FloatArray) -> NDArray[np.bool_]:
    """Which triangles [f, 3, 3] have the corners of an earlier one, in any order."""
    return first_copies(corners_m) != np.arange(len(corners_m))


def shared_edges(corners_m: FloatArray) -> tuple[IntArray, IntArray]:
    """Edges of triangles [f, 3, 3], the same for faces whose corners coincide.

    Returns the number of the edge from each corner of each face to its next [3 f], and both ends' vertices [3 f, 2].
    """
    mesh = welded(corners_m)
    return np.asarray(mesh.edges_unique_inverse), np.asarray(mesh.edges)


def main_extent(corners_m: FloatArray) -> tuple[FloatArray, float, float]:
    """Unit normal [3] of the largest of triangles [f, 3, 3], and their least and largest coordinate along it."""
    cross = trimesh.triangles.cross(corners_m)
    normal = trimesh.unitize(cross[np.argmax(np.linalg.norm(cross, axis=-1))])
    along = corners_m @ normal
    return normal, float(along.min()), float(along.max())


def sampled(triangles: FloatArray, count: int = 20_000) -> FloatArray:
    """Points [count, 3] spread evenly over triangles [f, 3, 3]."""
    mesh = trimesh.Trimesh(**trimesh.triangles.to_kwargs(triangles), process=False)
    return np.asarray(trimesh.sample.sample_surface(mesh, count, seed=0)[0])


def bodies(corners_m: FloatArray) -> list[Body]:
    """Bodies of triangles [f, 3, 3], metres."""
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
    closed = (unpaired == 0).tolist()
    return [
        Body(faces, corners_m[faces], *facts) for faces, *facts in zip(members, closed, volume.tolist(), strict=True)
    ]
