"""Specular paths of known chains of planes, evaluated for new transmitters in one batch.

The search for chains (`wrf_mi.tracing.search.shoot`) is done once, from the receiver. A transmitter then costs a
mirrored position for each chain, a test of the points of reflection against the planes' bounds, and a few rays along
the legs of the remaining paths, all transmitters and chains together.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ...backend.device import on_device, to_float, to_uint, to_vectors
from ...core.angles import FloatArray
from ...core.types import IntArray
from ...tracing.image_method import image_sources, meeting_point
from ...tracing.material_parameters import read_materials
from ...tracing.materials import absorbs
from ...tracing.surfaces import Surfaces, find_planes, scene_surfaces

ABSORBING = 1.001, 1e-6, 1e8
"""Constants of a slab in an absorber's place: nearly air, so that it reflects less than 3 % of the amplitude 6 degrees
above grazing, and so thick that no wave passes."""
MARGIN_M = 1e-3
"""Slack of a plane's bounds, and greatest distance of a leg's end from the mesh at a reflection."""
NEAR_M = 5e-4
"""A surface so close to the beginning of a leg is the surface at which the leg begins."""
PAIRS_PER_CHUNK = 1 << 19
"""Pairs of transmitter and chain that are computed together: some 100 MB."""
FEW_PAIRS = 1 << 15
"""Pairs of ray and triangle up to which all are tried in NumPy: some 5 ms."""
EDGE = 1e-9
"""Slack of a triangle's edges, as a share of them, so that no ray slips between two triangles."""
LEAST_LANES = 256
"""Rays are traced in powers of two from this number on: a kernel is compiled for each number."""
Hit = tuple[IntArray, FloatArray, IntArray, FloatArray]
"""Rays that meet a surface: index, distance in metres, object, normal."""


@dataclass(frozen=True)
class Room:
    """Objects of triangles and their materials; b objects. Without objects: free space.

    ``corners`` are each object's triangles [f, 3, 3] in metres; ``slabs`` [3, b] relative permittivity, conductivity
    (S/m) and thickness (m) of each object.
    """

    names: tuple[str, ...]
    corners: tuple[FloatArray, ...]
    slabs: FloatArray

    @classmethod
    def of(cls, scene: Any | None) -> Room:
        """Triangles and materials of a ``sionna.rt.Scene``; None: free space."""
        if scene is None:
            return cls((), (), np.zeros((3, 0)))
        surfaces, known = scene_surfaces(scene), read_materials(scene)
        constants = np.stack([known.permittivity, known.conductivity, known.thickness_m], axis=1)
        of_material = dict(zip(known.names, constants, strict=True))
        slabs = np.empty((3, len(surfaces.names)))
        for index, name in enumerate(surfaces.names):
            material = scene.objects[name].radio_material
            slabs[:, index] = ABSORBING if absorbs(material) else of_material[material.name]
        return cls(surfaces.names, tuple(surfaces.triangles[a:b] for a, b in pairwise(surfaces.first_face)), slabs)

    def with_sheets(self, sheets: FloatArray, slabs: FloatArray) -> Room:
        """The room with further rectangles, four corners in order each [s, 4, 3] in metres, of ``slabs`` [3, s]."""
        corners = (np.stack([sheet[[0, 1, 2]], sheet[[0, 2, 3]]]) for sheet in sheets)
        names = (f"learned {len(self.names) + i}" for i in range(len(sheets)))
        joined = np.concatenate([self.slabs, slabs], axis=1)
        return Room((*self.names, *names), (*self.corners, *corners), joined)

    def open(self) -> tuple[Any, Surfaces] | None:
        """A Mitsuba scene of the objects (as ``.mi_scene``) and their planes; None for free space."""
        if not self.names:
            return None
        parts: dict[str, Any] = {"type": "scene"}
        for index, corners in enumerate(self.corners):
            key = f"thing{index:09}"  # Mitsuba sorts shapes by name
            mesh = mi.Mesh(key, 3 * len(corners), len(corners))
            parameters = mi.traverse(mesh)
            parameters["vertex_positions"] = to_float(corners)
            parameters["faces"] = to_uint(np.arange(3 * len(corners)))
            parameters.update()
            parts[key] = mesh
        scene: Any = mi.load_dict(parts)
        pointers: list[Any] = [dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape)) for shape in scene.shapes()]
        ids = np.array([int(pointer[0]) for pointer in pointers], np.uint32)
        first = np.cumsum([0, *(len(corners) for corners in self.corners)])
        triangles = np.concatenate(self.corners).astype(np.float32).astype(float)
        return SimpleNamespace(mi_scene=scene), find_planes(self.names, ids, first, triangles)


@dataclass(frozen=True)
class ChainPaths:
    """Paths from n transmitters by known chains; p paths, sorted by transmitter.

    Attributes:
        tx: transmitter of each path, [p].
        chain: chain of each path, 0 the direct path, [p].
        image_m: the transmitter's image less the receiver's position, world frame, [p, 3].
        objects: object at each interaction from the transmitter on, -1 beyond the last, [p, depth].
        plane: plane of each reflection, -1 at transmissions and beyond the last interaction, [p, depth].
        normal: normal of the surface at each interaction, [p, depth, 3].
    """

    tx: IntArray
    chain: IntArray
    image_m: FloatArray
    objects: IntArray
    plane: IntArray
    normal: FloatArray

    def __len__(self) -> int:
        """Number of paths."""
        return len(self.tx)


class ChainTable:
    """Chains of reflecting planes seen from a receiver [3], and the scene that blocks them.

    ``opened_room`` is from `Room.open`; None: the direct path alone, unobstructed.
    """

    def __init__(
        self, opened_room: tuple[Any, Surfaces] | None, receiver_m: FloatArray, chain: IntArray, passed: int = 1
    ) -> None:
        self.receiver_m, self.passed = np.asarray(receiver_m, float), passed
        self.chain = np.concatenate([np.full((1, chain.shape[1]), -1), chain])
        self.length = np.count_nonzero(self.chain >= 0, axis=1)
        self._scene: Any = None
        self.surfaces: Surfaces | None = None
        self.normal, self.offset_m = np.zeros((0, 3)), np.zeros(0)
        if opened_room is not None:
            self._scene, self.surfaces = opened_room
            self.normal, self.offset_m = self.surfaces.normal, self.surfaces.offset
            self._objects = np.full(int(self.surfaces.shape_ids.max(initial=0)) + 1, -1)
            self._objects[self.surfaces.shape_ids] = np.arange(len(self.surfaces.names))

    def images(self, tx_pos_m: FloatArray, chain: IntArray) -> FloatArray:
        """Images [p, reflections + 1, 3] of transmitters [p, 3] after each reflection of chains [p], last first."""
        # The last plane of a chain, counted from the receiver, is the first that the transmitter's wave meets.
        return image_sources(self.normal, self.offset_m, self.chain[chain][:, ::-1], tx_pos_m)[:, ::-1]

    def __call__(self, tx_pos_m: FloatArray) -> ChainPaths:
        """Unobstructed paths of transmitters [n, 3] in metres, through at most ``passed`` surfaces."""
        step = max(1, PAIRS_PER_CHUNK // len(self.chain))
        parts = [self._part(tx_pos_m[i : i + step], i) for i in range(0, max(len(tx_pos_m), 1), step)]
        return ChainPaths(*(np.concatenate(column) for column in zip(*parts, strict=True)))

    def _part(self, tx_pos_m: FloatArray, first: int) -> tuple[NDArray[Any], ...]:
        n, count = len(tx_pos_m), len(self.chain)
        tx, chain = np.repeat(np.arange(n), count), np.tile(np.arange(count), n)
        images = self.images(tx_pos_m[tx], chain)
        good, vertices = self.vertices(images, chain)
        tx, chain, images, vertices = tx[good], chain[good], images[good], vertices[good]
        objects, plane, normal, good = self._walk(tx_pos_m[tx], chain, vertices)
        image = images[good, 0] - self.receiver_m
        return tx[good] + first, chain[good], image, objects[good], plane[good], normal[good]

    def vertices(self, images: FloatArray, chain: IntArray) -> tuple[NDArray[np.bool_], FloatArray]:
        """Whether all points of reflection lie within their planes' bounds [p], and these points, receiver first."""
        planes = self.chain[chain]
        good = np.ones(len(chain), bool)
        vertices = np.full((len(chain), planes.shape[1], 3), np.nan)
        here = np.broadcast_to(self.receiver_m, (len(chain), 3)).copy()
        for level in range(planes.shape[1]):
            row = np.flatnonzero(good & (planes[:, level] >= 0))
            if not len(row):
                break
            s, which = self.surfaces, planes[row, level]
            assert s is not None
            met, near, far = meeting_point(here[row], images[row, level], s.normal[which], s.offset[which])
            fine = near * far < 0
            along = np.einsum("pc,pac->pa", met, s.axes[which])
            fine &= ((along >= s.low[which] - MARGIN_M) & (along <= s.high[which] + MARGIN_M)).all(axis=1)
            here[row] = vertices[row, level] = met
            good[row[~fine]] = False
        return good, vertices

    def _walk(
        self, tx_pos_m: FloatArray, chain: IntArray, vertices: FloatArray
    ) -> tuple[IntArray, IntArray, FloatArray, NDArray[np.bool_]]:
        """Objects, planes and normals at each path's interactions from the transmitter on, and whether it arrives."""
        count, depth = len(chain), self.chain.shape[1] + self.passed
        objects, plane = np.full((2, count, depth), -1)
        normal = np.zeros((count, depth, 3))
        good, used = np.ones(count, bool), np.zeros(count, np.int64)
        length, passed = self.length[chain], np.zeros(count, np.int64)
        here = np.array(tx_pos_m, float)
        for leg in range(self.chain.shape[1] + 1):
            row = np.flatnonzero(good & (leg <= length))
            if not len(row):
                break
            level = length[row] - 1 - leg  # of the reflection that ends this leg; -1 at the receiver
            last = level < 0
            there = np.where(last[:, None], self.receiver_m, vertices[row, np.maximum(level, 0)])
            ended = last.copy()
            for lane, met, at_end, direction in self._hits(here[row], there):
                mirrors = at_end & ~last[lane]
                ended[lane[mirrors]] = True
                passed[row[lane[~at_end]]] += 1
                for some, mirror in ((~at_end, False), (mirrors, True)):
                    path = row[lane[some]]
                    fits = used[path] < depth
                    good[path[~fits]] = False
                    path, which = path[fits], np.flatnonzero(some)[fits]
                    objects[path, used[path]], normal[path, used[path]] = met[which], direction[which]
                    if mirror:
                        plane[path, used[path]] = self.chain[chain[path], level[lane[which]]]
                    used[path] += 1
            good[row[~ended]] = False
            here[row] = there
        return objects, plane, normal, good & (passed <= self.passed)

    def _hits(
        self, start_m: FloatArray, end_m: FloatArray
    ) -> Iterator[tuple[IntArray, IntArray, NDArray[np.bool_], FloatArray]]:
        """Surfaces along legs in order: leg, object, whether it lies at the leg's end, and its normal."""
        if self.surfaces is None:
            return
        way = end_m - start_m
        length = np.linalg.norm(way, axis=1)
        direction = way / np.maximum(length, 1e-12)[:, None]
        few = len(length) * len(self.surfaces.triangles) <= FEW_PAIRS
        hits = self._hits_by_numpy if few else self._hits_by_mitsuba
        for lane, travelled, met, normal in hits(start_m, direction, length + MARGIN_M):
            if not len(lane):
                return
            yield lane, met, np.abs(travelled - length[lane]) < MARGIN_M, normal

    def _hits_by_numpy(self, start_m: FloatArray, direction: FloatArray, far_m: FloatArray) -> Iterator[Hit]:
        """First, second, ... surface on each ray by trying all triangles, which is fastest for one transmitter.

        Source: Moeller and Trumbore, "Fast, minimum storage ray-triangle intersection" (1997).
        """
        surfaces = self.surfaces
        assert surfaces is not None
        corner = surfaces.triangles[:, 0]
        first, second = surfaces.triangles[:, 1] - corner, surfaces.triangles[:, 2] - corner
        across = np.cross(direction[:, None], second[None])
        determinant = np.einsum("fi,pfi->pf", first, across)
        with np.errstate(divide="ignore", invalid="ignore"):
            from_corner = start_m[:, None] - corner
            u = np.einsum("pfi,pfi->pf", from_corner, across) / determinant
            turned = np.cross(from_corner, first[None])
            v = np.einsum("pi,pfi->pf", direction, turned) / determinant
            distance = np.einsum("fi,pfi->pf", second, turned) / determinant
            inside = (u >= -EDGE) & (v >= -EDGE) & (u + v <= 1 + EDGE) & (np.abs(determinant) > EDGE)
        distance = np.where(inside, distance, np.inf)
        begin = np.full(len(start_m), NEAR_M)
        for _ in range(self.passed + 2):
            ahead = np.where(distance > begin[:, None], distance, np.inf)
            face = ahead.argmin(axis=1)
            begin = ahead[np.arange(len(face)), face]
            lane = np.flatnonzero(begin < far_m)
            face = face[lane]
            yield lane, begin[lane], surfaces.object_of(face), surfaces.normal[surfaces.plane[face]]
            begin = begin + NEAR_M

    def _hits_by_mitsuba(self, start_m: FloatArray, direction: FloatArray, far_m: FloatArray) -> Iterator[Hit]:
        """First, second, ... surface on each ray by Mitsuba, which is fastest for many transmitters."""
        lanes = max(LEAST_LANES, 1 << (len(far_m) - 1).bit_length())

        def padded(values: FloatArray) -> FloatArray:
            return np.concatenate([values, np.zeros((lanes - len(values), *values.shape[1:]))])

        d, origin = to_vectors(padded(direction), mi.Vector3f), to_vectors(padded(start_m), mi.Point3f)
        far = to_float(padded(far_m))
        active: Any = on_device(np.arange(lanes) < len(far_m), mi.Bool)
        begin: Any = mi.Float(NEAR_M)
        found = []
        # All that may be passed, one too many, and the end of the leg itself.
        for _ in range(self.passed + 2):
            ray = mi.Ray3f(origin + d * begin, d)
            hit = self._scene.mi_scene.ray_intersect(ray, ray_flags=mi.RayFlags.Minimal, coherent=False, active=active)
            travelled = begin + hit.t
            active &= hit.is_valid() & (travelled < far)
            shape: Any = dr.reinterpret_array(mi.UInt32, hit.shape)
            found.append((mi.Bool(active), mi.UInt32(shape), mi.Float(travelled), mi.Normal3f(hit.n)))
            begin = travelled + NEAR_M
        dr.eval(found)
        for some, shape, travelled, n in found:
            lane = np.flatnonzero(some.numpy())
            met = self._objects[shape.numpy()[lane]]
            yield lane, travelled.numpy()[lane].astype(float), met, n.numpy().T[lane].astype(float)
