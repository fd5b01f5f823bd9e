"""Triangles of a Sionna RT scene in float64, their planes, and closed screens of them for rays.

Rays in single precision miss triangles that they meet on an edge, and sheets that were modelled one by one may leave a
gap of rounding at their seam. A wave that meets an edge counts as meeting its surface (`visibility`), so faces are
enlarged a little at free and sharp edges, and no ray passes at a seam.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import shapely
import trimesh
from numpy.typing import NDArray

from ...core.digest import content_digest
from ...core.types import FloatArray, IntArray
from ...scene.mesh.surfaces import Body, bodies, bounds, shared_edges

COPLANAR_M = 2e-5  # largest distance of a face's corners from its plane: 30 times the rounding of float32 at 10 m
COPLANAR_COS = 0.99  # of the normals of a face and its plane, 8 degrees: above a sliver's rounding, below a thin rim
MERGED_M2 = 0.01  # smallest area of a plane that takes in other faces
MESH_FILE = re.compile(r'^\s*name = "(.*)",?$', re.MULTILINE)  # Mitsuba has it in a description alone
MERGED_COUNT = 1000  # number of planes, largest first, that take in other faces: bounds the time for meshes without any
SOLID_M = 0.5  # mean thickness, 2 volume / area, below which a body is an object (cabinet: 0.3 m), not a room (0.94 m)
ENLARGED = 4e-5
"""Distance by which faces are enlarged, as a share of `scale_m`: 0.4 mm at 10 m. Four times as far as positions are
displaced (`images.DISPLACED`), so that a path through a free edge stays blocked when displaced."""
OVERLAP = 5e-7
"""The same at edges at which a face goes on in another: eight times the rounding of a coordinate in single precision,
by which edges of enlarged faces do not match."""
SMOOTH_COS = np.cos(np.radians(10))
"""Cosine of the bend of two faces up to which one goes on in the other: facets of curved furniture would otherwise
overlap, and waves that pass such a body would meet two facets in place of one."""
POINTS_TOGETHER = 1 << 16  # points whose near planes are looked for together: bounds the memory of the pairs
FEW_PLANES = 256  # up to which heights above all planes are computed sooner than a tree is asked
FARTHEST = 25.0  # largest scale by that about the middle of the scene: a room at 10 km from the origin keeps its doors
MOST_AT_CORNER = 8.0  # farthest that a corner moves, in units of the enlargement: slivers reach to infinity


@dataclass(frozen=True)
class Surfaces:
    """Faces of all objects, and their planes; f faces, q planes, b objects."""

    names: tuple[str, ...]  # names of the objects
    shape_ids: NDArray[np.uint32]  # Mitsuba's registry index of each object's mesh, shape [b]
    first_face: IntArray  # index of each object's first face, shape [b + 1]; face = first_face[object] + primitive
    triangles: FloatArray  # corners of the faces [f, 3, 3], metres
    plane: IntArray  # plane of each face, shape [f]
    normal: FloatArray  # unit normals [q, 3]
    offset: FloatArray  # n . x of each plane, shape [q], metres
    face: IntArray  # largest face of each plane, shape [q]
    axes: FloatArray  # two unit vectors in each plane [q, 2, 3]
    low: FloatArray  # bounds of the plane's faces along ``axes``, shape [q, 2], metres
    high: FloatArray  # bounds of the plane's faces along ``axes``, shape [q, 2], metres
    files: tuple[str, ...] = ()  # name of each object's mesh file, "" for none; empty without files

    @cached_property
    def digest(self) -> str:
        """Digest of the geometry: equal for scenes of equal faces in equal order."""
        return content_digest(self.triangles, self.first_face)

    @cached_property
    def flattest(self) -> IntArray:
        """Largest face of the same object in the same plane, for each face [f].

        Its normal is that of the plane. Floors that are triangulated from an outline have slivers, whose corners are in
        a line in single precision: a path that meets one has no normal from its corners.
        """
        _, part = np.unique(
            np.stack([self.object_of(np.arange(len(self.plane))), self.plane]), axis=1, return_inverse=True
        )
        part = part.reshape(-1)
        return largest_face(part, trimesh.triangles.area(self.triangles))[part]

    @cached_property
    def first_by_shape(self) -> IntArray:
        """First face of each object, by the index of its mesh in Mitsuba's registry."""
        first = np.zeros(int(self.shape_ids.max(initial=0)) + 1, np.int64)
        first[self.shape_ids] = self.first_face[:-1]
        return first

    @cached_property
    def faces_on_device(self) -> tuple[Any, Any]:
        """`first_by_shape`, and plane of each face: Dr.Jit arrays, ``mi.UInt32``."""
        from ...backend.device import to_uint

        return to_uint(self.first_by_shape), to_uint(self.plane)

    @cached_property
    def box_m(self) -> FloatArray:
        """Least and largest coordinates [2, 3] of the scene, zero without faces."""
        return bounds(self.triangles) if len(self.triangles) else np.zeros((2, 3))

    @cached_property
    def centre_m(self) -> FloatArray:
        """Middle of the box around the scene [3], from which single precision is finest; the origin without faces."""
        return self.box_m.sum(axis=0) / 2

    @cached_property
    def scale_m(self) -> float:
        """Length by which distances that single precision does not resolve grow: that of roundings of corners in files.

        The largest coordinate plus 1 m; far from the origin at most `FARTHEST` times the same about the middle.
        """
        about = (self.triangles, self.triangles - self.centre_m)
        from_origin, centred = (1.0 + float(np.abs(part).max(initial=0.0)) for part in about)
        return min(from_origin, FARTHEST * centred)

    @cached_property
    def screens(self) -> Any:
        """Mitsuba scene of the faces about `centre_m`, closed at their seams."""
        return screens(self.triangles - self.centre_m, self.scale_m)

    @cached_property
    def boxes(self) -> tuple[shapely.STRtree, FloatArray]:
        """Boxes around the enlarged rectangle of each plane's faces [q, 2, 3], and a tree of their extents in x, y."""
        ends = np.stack([self.low, self.high])
        sides = [np.stack([self.axes[:, k] * end[:, k, None] for end in ends]) for k in (0, 1)]
        corners = self.normal * self.offset[:, None] + sides[0][:, None] + sides[1][None]
        low, high = (
            corners.min(axis=(0, 1)) - ENLARGED * self.scale_m,
            corners.max(axis=(0, 1)) + ENLARGED * self.scale_m,
        )
        return shapely.STRtree(shapely.box(*low[:, :2].T, *high[:, :2].T)), np.stack([low, high], axis=1)

    def near(self, points_m: FloatArray, margin_m: float) -> tuple[IntArray, IntArray]:
        """Pairs of points [n, 3] and planes within a margin of each other, where faces are within it, too.

        Some pairs have no face so near: bounds are those of rectangles. Points ascend, and planes of each.
        """
        (tree, boxes), parts = self.boxes, [np.zeros((2, 0), np.int64)]
        for start in range(0, len(points_m), POINTS_TOGETHER):
            points = points_m[start : start + POINTS_TOGETHER]
            low, high = points - margin_m, points + margin_m
            if len(self.normal) > FEW_PLANES:
                pair = tree.query(shapely.box(*low[:, :2].T, *high[:, :2].T))
                point, plane = pair[:, np.lexsort((pair[1], pair[0]))]
            else:
                point, plane = np.nonzero(np.abs(points @ self.normal.T - self.offset) < 2 * margin_m)
            near = ((high[point] >= boxes[plane, 0]) & (low[point] <= boxes[plane, 1])).all(axis=1)
            height = np.einsum("pc,pc->p", points[point], self.normal[plane]) - self.offset[plane]
            near &= np.abs(height) < margin_m
            parts.append(np.stack([start + point[near], plane[near]]))
        point, plane = np.concatenate(parts, axis=1)
        return point, plane

    @cached_property
    def face_edges(self) -> tuple[FloatArray, FloatArray]:
        """Unit vectors [f, 3, 3] in each face across its edges, inwards, and their products with the edges [f, 3]."""
        # Across an edge, in the face: the product of the face's normal and the edge.
        along = np.roll(self.triangles, -1, axis=1) - self.triangles
        inwards = np.cross(trimesh.triangles.cross(self.triangles)[:, None], along)
        size = np.linalg.norm(inwards, axis=2, keepdims=True)
        inwards = np.divide(inwards, size, out=np.zeros_like(inwards), where=size > 0)
        return inwards, (inwards * self.triangles).sum(axis=2)

    @cached_property
    def faces_by_plane(self) -> tuple[IntArray, IntArray]:
        """Faces sorted by their plane, and the first of each plane among them [q + 1]."""
        order = np.argsort(self.plane, kind="stable")
        return order, np.searchsorted(self.plane[order], np.arange(len(self.normal) + 1))

    @cached_property
    def plane_centres_m(self) -> FloatArray:
        """Centroids of the planes' faces [q, 3], metres."""
        area, count = trimesh.triangles.area(self.triangles), len(self.normal)
        moment = [np.bincount(self.plane, area * c, minlength=count) for c in self.triangles.mean(axis=1).T]
        centre = np.stack(moment, axis=1) / np.maximum(np.bincount(self.plane, area, count), 1e-30)[:, None]
        # Faces lie in their plane within a tolerance only; so does their centroid.
        return centre - self.normal * ((centre * self.normal).sum(axis=1) - self.offset)[:, None]

    def moved_planes(
        self, shift_m: FloatArray, tilt: FloatArray, planes: IntArray | slice = slice(None)
    ) -> tuple[FloatArray, FloatArray]:
        """Normals [k, 3] and offsets [k], metres, of planes (by default all) that are shifted and tilted.

        Shifts [k] are along the normals, metres; tilts [k, 2], rad, are about the centres towards both axes
        (`wrf_mi.tracing.paths.scene_parameters`).
        """
        # A tilt is a rotation to first order; the normal is scaled to unit length again.
        normal = self.normal[planes] + np.einsum("qa,qad->qd", tilt, self.axes[planes])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        return normal, (normal * self.plane_centres_m[planes]).sum(axis=1) + shift_m

    @cached_property
    def planes_on_device(self) -> tuple[Any, ...]:
        """``normal``, ``offset``, both ``axes``, ``low`` and ``high`` of the planes: Dr.Jit vectors [q]."""
        import mitsuba as mi

        from ...backend.device import columns_on_device

        columns = (self.normal, self.offset[:, None], self.axes[:, 0], self.axes[:, 1], self.low, self.high)
        x = columns_on_device(np.hstack(columns).T, mi.Float)
        axes = mi.Vector3f(*x[4:7]), mi.Vector3f(*x[7:10])
        return mi.Vector3f(*x[:3]), x[3], *axes, mi.Point2f(*x[10:12]), mi.Point2f(*x[12:])

    @cached_property
    def solids(self) -> list[tuple[Body, FloatArray]]:
        """Each closed, consistently oriented body that is an object rather than a room, and its normals outwards."""
        # There are fewer normals than faces where faces have no area.
        solids = []
        for body in bodies(self.triangles):
            # Mean thickness 2 V / A of a slab: thin bodies are objects, thick ones rooms, whose inside is air.
            area = trimesh.triangles.area(body.corners_m).sum()
            if body.closed and 0 < 2 * abs(body.volume_m3) < SOLID_M * area:
                normals, _ = trimesh.triangles.normals(body.corners_m)
                solids.append((body, np.sign(body.volume_m3) * normals))
        return solids

    @cached_property
    def solid_bounds_m(self) -> FloatArray:
        """Lowest and highest coordinates of the solids [2, s, 3], metres."""
        return np.reshape([body.bounds_m for body, _ in self.solids], (-1, 2, 3)).swapaxes(0, 1)

    def called(self, index: int) -> str:
        """Name of an object in error messages, with its mesh file if that has another name."""
        name, file = self.names[index], self.files[index] if self.files else ""
        return repr(name) if Path(file).stem in ("", name) else f"{name!r} ({file})"

    def object_of(self, face: IntArray) -> IntArray:
        """Object of each face."""
        return np.searchsorted(self.first_face, face, side="right") - 1


_FOUND: WeakKeyDictionary[Any, Surfaces] = WeakKeyDictionary()


def scene_surfaces(scene: Any) -> Surfaces:
    """Read the triangles of a ``sionna.rt.Scene`` and find its planes, once while they stay where they are."""
    objects = scene.objects  # a copy in each access
    names = tuple(objects)
    ids, files, triangles = [], [], [np.zeros((0, 3, 3))]
    for name in names:
        mesh = objects[name].mi_mesh
        corners = np.asarray(mesh.vertex_positions_buffer(), float).reshape(-1, 3)
        triangles.append(corners[np.asarray(mesh.faces_buffer(), np.int64).reshape(-1, 3)])
        ids.append(shape_id(mesh))
        stated_file = MESH_FILE.search(str(mesh))
        files.append(stated_file[1] if stated_file else "")
    first, every = np.cumsum([len(part) for part in triangles]), np.concatenate(triangles)
    cached, identity = _FOUND.get(scene), (names, tuple(ids), tuple(files))
    if (
        cached is None
        or (cached.names, tuple(cached.shape_ids), cached.files) != identity
        or not np.array_equal(cached.triangles, every)
    ):
        cached = replace(find_planes(names, np.asarray(ids, np.uint32), first, every), files=identity[2])
        _FOUND[scene] = cached
    return cached


def shape_id(mesh: Any) -> int:
    """Index of a mesh in Mitsuba's registry."""
    import drjit as dr
    import mitsuba as mi

    pointer: Any = dr.reinterpret_array(mi.UInt32, mi.ShapePtr(mesh))
    return int(pointer[0])


def find_planes(
    names: tuple[str, ...], shape_ids: NDArray[np.uint32], first_face: IntArray, triangles: FloatArray
) -> Surfaces:
    """Group faces into planes by rounded normal and offset; the largest planes then take in all faces within them."""
    # The second step joins a wall with its slivers, whose normals are inexact.
    centre, cross = triangles.mean(axis=1), trimesh.triangles.cross(triangles)
    area = np.linalg.norm(cross, axis=1) / 2
    # Faces without area get any normal. Rays meet some of them where rounding gives them one: see `Surfaces.flattest`.
    normal = np.tile([0.0, 0.0, 1.0], (len(cross), 1))
    np.divide(cross, 2 * area[:, None], out=normal, where=area[:, None] > 0)
    largest = np.abs(normal).argmax(axis=1)[:, None]
    normal *= np.sign(np.take_along_axis(normal, largest, axis=1))  # both sides of a sheet have one normal
    offset = (normal * centre).sum(axis=1)

    # First equal rounded normals and offsets, in one pass; a face on the border of two cells is taken in below.
    rounded = np.round(np.column_stack([normal, offset]) / COPLANAR_M).astype(np.int64)
    _, plane = np.unique(rounded, axis=0, return_inverse=True)
    plane = plane.reshape(-1)
    total = np.bincount(plane, area)
    seeds = np.argsort(-total, kind="stable")[:MERGED_COUNT]
    biggest = largest_face(plane, area)
    free = np.ones(len(plane), bool)
    for seed in seeds[total[seeds] >= MERGED_M2]:
        face = biggest[seed]
        if not free[face]:
            continue
        candidates = np.flatnonzero(free & (np.abs(centre @ normal[face] - offset[face]) < COPLANAR_M))
        near = np.abs(triangles[candidates] @ normal[face] - offset[face]).max(axis=1) < COPLANAR_M
        near &= np.abs(normal[candidates] @ normal[face]) > COPLANAR_COS
        near |= candidates == face  # its own corners may be off by more: the normal of a sliver is inexact
        plane[candidates[near]] = seed
        free[candidates[near]] = False
    labels, plane = np.unique(plane, return_inverse=True)
    plane = plane.reshape(-1)
    # The plane is that of the face which took in the others: theirs may be tilted within the tolerance.
    is_own_plane = plane[biggest[labels]] == np.arange(len(labels))
    face = np.where(is_own_plane, biggest[labels], largest_face(plane, area))
    normal, offset = normal[face], offset[face]
    # Axes along and across an edge of the largest face.
    edge = triangles[face][:, 1] - triangles[face][:, 0]
    edge /= np.maximum(np.linalg.norm(edge, axis=1, keepdims=True), 1e-30)
    axes = np.stack([edge, np.cross(normal, edge)], axis=1)
    low, high = plane_bounds(plane, np.einsum("fcx,fax->fca", triangles, axes[plane]), len(face))
    return Surfaces(names, shape_ids, first_face, triangles, plane, normal, offset, face, axes, low, high)


def largest_face(plane: IntArray, area: FloatArray) -> IntArray:
    """Largest face of each plane; the first of equals."""
    order = np.lexsort((-area, plane))
    return order[np.searchsorted(plane[order], np.arange(plane.max(initial=-1) + 1))]


def plane_bounds(plane: IntArray, corners_m: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
    """Bounds [count, k] of the faces of each plane, of which [f] are the planes and [f, 3, k] the corners."""
    low, high = (np.full((count, corners_m.shape[-1]), end) for end in (np.inf, -np.inf))
    np.minimum.at(low, plane, corners_m.min(axis=1))
    np.maximum.at(high, plane, corners_m.max(axis=1))
    return low, high


def screens(triangles: FloatArray, scale_m: float) -> Any:
    """A Mitsuba scene of one mesh for rays, whose primitives are the triangles [f, 3, 3] in their order, enlarged."""
    import mitsuba as mi

    mesh = triangle_mesh("screens", enlarged(triangles, scale_m))
    # Embree's robust mode loses fewer rays at edges; OptiX is watertight as it is.
    return mi.load_dict({"type": "scene", "mesh": mesh, "embree_use_robust_intersections": True})


def triangle_mesh(name: str, triangles: FloatArray, **properties: Any) -> Any:
    """A Mitsuba mesh of triangles [f, 3, 3] without common vertices, with properties such as ``mesh_bsdf``."""
    import mitsuba as mi

    from ...backend.device import on_device

    props = mi.Properties()
    for key, value in properties.items():
        props[key] = value
    mesh: Any = mi.Mesh(name, 3 * len(triangles), len(triangles), props=props)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = on_device(triangles, mi.Float)
    parameters["faces"] = on_device(np.arange(3 * len(triangles)), mi.UInt32)
    parameters.update()
    return mesh


def enlarged(triangles: FloatArray, scale_m: float) -> FloatArray:
    """Triangles [f, 3, 3] enlarged in their planes by `ENLARGED` at edges that are free, sharp or of three faces."""
    # At other edges they overlap by rounding. Degenerate triangles stay as they are.
    if not len(triangles):
        return triangles
    along = np.roll(triangles, -1, axis=1) - triangles  # edge k runs from corner k to corner k + 1
    length = np.linalg.norm(along, axis=2, keepdims=True)
    along = np.divide(along, length, out=np.zeros_like(along), where=length > 0)
    incoming = np.roll(along, 1, axis=1)
    sine = np.linalg.norm(np.cross(incoming, along), axis=2, keepdims=True)
    margin = np.where(_smooth(triangles), OVERLAP, ENLARGED)[..., None] * scale_m
    # Both edges at a corner are shifted outwards by their margins: the corner moves to where the shifted lines meet.
    moved = np.roll(margin, 1, axis=1) * -along + margin * incoming
    moved = np.divide(moved, sine, out=np.zeros_like(moved), where=sine > 0)
    farthest = MOST_AT_CORNER * margin.max(initial=0.0)
    size = np.linalg.norm(moved, axis=2, keepdims=True)
    moved *= np.minimum(1.0, np.divide(farthest, size, out=np.ones_like(size), where=size > 0))
    solid = trimesh.triangles.area(triangles) > 0
    return np.where(solid[:, None, None], triangles + moved, triangles)


def _smooth(triangles: FloatArray) -> Any:
    """Mask of edges [f, 3] at which a face goes on in exactly one other face, bent by less than 10 degrees."""
    edge = shared_edges(triangles)[0]
    count = np.bincount(edge)
    order = np.argsort(edge, kind="stable")
    pairs = order[np.repeat(count, count) == 2].reshape(-1, 2)
    # From the edge to the third corner of each of both faces: opposite directions where the faces are in one plane.
    start, end, third = (np.roll(triangles, -k, axis=1).reshape(-1, 3)[pairs] for k in range(3))
    along = end - start
    share = ((third - start) * along).sum(axis=-1, keepdims=True)
    square = (along * along).sum(axis=-1, keepdims=True)
    away = third - start - along * np.divide(share, square, out=np.zeros_like(share), where=square > 0)
    cosine = (away[:, 0] * away[:, 1]).sum(axis=-1)
    sizes = np.linalg.norm(away, axis=-1).prod(axis=1)
    smooth = np.zeros(3 * len(triangles), bool)
    smooth[pairs[cosine < -SMOOTH_COS * sizes]] = True
    return smooth.reshape(-1, 3)
