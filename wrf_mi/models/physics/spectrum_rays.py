"""Specular paths of known chains of planes, evaluated for new transmitters in one batch.

The search for chains (`wrf_mi.tracing.search.shoot`) is done once, from the receiver. After that a transmitter costs a
mirrored position for each chain, an arithmetic test of the points of reflection against the planes' bounds, and a few
rays along the legs of those that are left, all transmitters and chains at once.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.angles import FloatArray
from ...core.types import IntArray
from ...tracing.image_method import image_sources, meeting_point
from ...tracing.search import shoot
from ...tracing.surfaces import Surfaces, find_planes

MARGIN_M = 1e-3
"""Slack of a plane's bounds, and how near to its plane a leg's end has to meet the mesh."""
NEAR_M = 5e-4
"""What lies so close to the beginning of a leg is the surface that it begins at."""


PAIRS_PER_CHUNK = 1 << 19
"""Pairs of transmitter and chain at once: some 100 MB."""
FEW_PAIRS = 1 << 15
"""Pairs of ray and triangle that are tried one by one: some 5 ms."""
EDGE = 1e-9
"""Slack of a triangle's edges, as a share of them, so that no ray slips between two."""
Hit = tuple[IntArray, FloatArray, IntArray, FloatArray]
"""Rays that meet a surface: which, after how many metres, whose, with what normal."""
LEAST_LANES = 256
"""Rays are shot in numbers that are powers of two from this on: a kernel is compiled for each number."""


@dataclass(frozen=True)
class Things:
    """Objects of a room as triangles; b objects.

    Attributes:
        names: of the objects.
        corners: of each object's triangles, [f, 3, 3] in metres, one array an object.
    """

    names: tuple[str, ...]
    corners: tuple[FloatArray, ...]

    def with_sheets(self, sheets: FloatArray) -> Things:
        """The same and further rectangles, each given by its four corners in order: [s, 4, 3], metres."""
        more = tuple(np.stack([sheet[[0, 1, 2]], sheet[[0, 2, 3]]]) for sheet in sheets)
        names = (f"learned {len(self.names) + i}" for i in range(len(sheets)))
        return Things((*self.names, *names), (*self.corners, *more))


def opened(things: Things) -> tuple[Any, Surfaces]:
    """A Mitsuba scene of the objects (as ``.mi_scene``) and their planes."""
    import drjit as dr
    import mitsuba as mi

    from ...backend.device import to_float, to_uint

    keys = [f"thing{index}" for index in range(len(things.names))]
    parts: dict[str, Any] = {"type": "scene"}
    for key, corners in zip(keys, things.corners, strict=True):
        mesh = mi.Mesh(key, 3 * len(corners), len(corners))
        parameters = mi.traverse(mesh)
        parameters["vertex_positions"] = to_float(corners)
        parameters["faces"] = to_uint(np.arange(3 * len(corners)))
        parameters.update()
        parts[key] = mesh
    scene: Any = mi.load_dict(parts)
    # Mitsuba sorts what it is given by name; each shape is asked for its own number.
    ids = np.zeros(len(things.names), np.uint32)
    for shape in scene.shapes():
        pointer: Any = dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))
        ids[keys.index(shape.id())] = int(pointer[0])
    first = np.cumsum([0, *(len(part) for part in things.corners)])
    triangles = np.concatenate([np.zeros((0, 3, 3)), *things.corners]).astype(np.float32).astype(float)
    return SimpleNamespace(mi_scene=scene), find_planes(things.names, ids, first, triangles)


@dataclass(frozen=True)
class Met:
    """Paths from n transmitters by known chains; p paths, sorted by transmitter.

    Attributes:
        tx: transmitter of each, shape [p].
        chain: index of its chain, 0 the direct path, shape [p].
        image_m: the transmitter's image less the receiver's position, world frame, shape [p, 3].
        thing: object met at each interaction from the transmitter on, -1 beyond the last, shape [p, depth].
        plane: plane of each reflection, -1 where the wave passes through or nothing is met, shape [p, depth].
        normal: of the surface that is met, shape [p, depth, 3].
    """

    tx: IntArray
    chain: IntArray
    image_m: FloatArray
    thing: IntArray
    plane: IntArray
    normal: FloatArray

    def __len__(self) -> int:
        """Number of paths."""
        return len(self.tx)


class ChainTable:
    """Chains of reflecting planes seen from one receiver, and the scene that blocks them.

    Args:
        opened_room: from `opened`, or None: the direct path alone, which nothing blocks.
        receiver_m: position [3], metres.
        chain: planes from the receiver on, shape [c, reflections], -1 beyond the last; see `find_chains`.
        passed: surfaces that a path may pass through at most.
    """

    def __init__(
        self, opened_room: tuple[Any, Surfaces] | None, receiver_m: FloatArray, chain: IntArray, passed: int = 1
    ) -> None:
        self.receiver_m, self.passed = np.asarray(receiver_m, float), passed
        self.chain = np.concatenate([np.full((1, chain.shape[1]), -1), chain])
        self.length = np.count_nonzero(self.chain >= 0, axis=1)
        self._scene: Any = None if opened_room is None else opened_room[0]
        self.surfaces: Surfaces | None = None if opened_room is None else opened_room[1]
        self._things = np.zeros(0, np.int64)
        self.normal, self.offset_m = np.zeros((0, 3)), np.zeros(0)
        if self.surfaces is not None:
            self.normal, self.offset_m = self.surfaces.normal, self.surfaces.offset
            self._things = np.full(int(self.surfaces.shape_ids.max(initial=0)) + 1, -1)
            self._things[self.surfaces.shape_ids] = np.arange(len(self.surfaces.names))

    @property
    def depth(self) -> int:
        """Interactions of a path at most."""
        return int(self.chain.shape[1] + self.passed)

    def images(self, tx_pos_m: FloatArray, chain: IntArray) -> FloatArray:
        """Images of transmitters after each reflection, from the transmitter on: shape [p, reflections + 1, 3].

        Args:
            tx_pos_m: of each path [p, 3].
            chain: of each path [p].
        """
        # From the receiver on, the last plane of a chain is the first that the transmitter's wave meets.
        return image_sources(self.normal, self.offset_m, self.chain[chain][:, ::-1], tx_pos_m)[:, ::-1]

    def __call__(self, tx_pos_m: FloatArray) -> Met:
        """Unobstructed paths of transmitters [n, 3] in metres, through at most ``passed`` surfaces."""
        step = max(1, PAIRS_PER_CHUNK // len(self.chain))
        parts = [self._part(tx_pos_m[i : i + step], i) for i in range(0, len(tx_pos_m), step)]
        return Met(*(np.concatenate(column) for column in zip(*parts, strict=True)))

    def _part(self, tx_pos_m: FloatArray, first: int) -> tuple[NDArray[Any], ...]:
        n, count = len(tx_pos_m), len(self.chain)
        tx, chain = np.repeat(np.arange(n), count), np.tile(np.arange(count), n)
        images = self.images(tx_pos_m[tx], chain)
        good, vertices = self.vertices(images, chain)
        tx, chain, images, vertices = tx[good], chain[good], images[good], vertices[good]
        thing, plane, normal, good = self._walk(tx_pos_m[tx], chain, vertices)
        image = images[good, 0] - self.receiver_m
        return tx[good] + first, chain[good], image, thing[good], plane[good], normal[good]

    def vertices(self, images: FloatArray, chain: IntArray) -> tuple[NDArray[np.bool_], FloatArray]:
        """Which paths have all points of reflection within their planes' bounds, and these points, receiver first."""
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
        """What each path meets from the transmitter on, and whether it arrives."""
        count, depth = len(chain), self.depth
        thing, plane = np.full((2, count, depth), -1)
        normal = np.zeros((count, depth, 3))
        good, used = np.ones(count, bool), np.zeros(count, np.int64)
        if not count:
            return thing, plane, normal, good
        length, passed = self.length[chain], np.zeros(count, np.int64)
        here = np.array(tx_pos_m, float)
        for leg in range(self.chain.shape[1] + 1):
            row = np.flatnonzero(good & (leg <= length))
            if not len(row):
                break
            level = length[row] - 1 - leg  # of the reflection that ends this leg; -1 at the receiver
            last = level < 0
            there = np.where(last[:, None], self.receiver_m, vertices[row, np.maximum(level, 0)])
            hits = self._hits(here[row], there)
            ended = last.copy()
            for lane, met, at_end, direction in hits:
                ends = at_end & ~last[lane]
                ended[lane[ends]] = True
                through = ~at_end
                passed[row[lane[through]]] += 1
                for some, mirror in ((through, False), (ends, True)):
                    path = row[lane[some]]
                    fits = used[path] < depth
                    good[path[~fits]] = False
                    path, which = path[fits], np.flatnonzero(some)[fits]
                    thing[path, used[path]], normal[path, used[path]] = met[which], direction[which]
                    if mirror:
                        plane[path, used[path]] = self.chain[chain[path], level[lane[which]]]
                    used[path] += 1
            good[row[~ended]] = False
            here[row] = there
        good &= passed <= self.passed
        return thing, plane, normal, good

    def _hits(
        self, start_m: FloatArray, end_m: FloatArray
    ) -> list[tuple[IntArray, IntArray, NDArray[np.bool_], FloatArray]]:
        """Surfaces along legs, one after the other: leg, object, whether it is at the leg's end, and its normal."""
        if self.surfaces is None:
            return []
        way = end_m - start_m
        length = np.linalg.norm(way, axis=1)
        direction = way / np.maximum(length, 1e-12)[:, None]
        few = len(length) * len(self.surfaces.triangles) <= FEW_PAIRS
        met = self._met_by_hand if few else self._met_by_mitsuba
        out = []
        for lane, travelled, thing, normal in met(start_m, direction, length + MARGIN_M):
            if not len(lane):
                break
            out.append((lane, thing, np.abs(travelled - length[lane]) < MARGIN_M, normal))
        return out

    def _met_by_hand(self, start_m: FloatArray, direction: FloatArray, far_m: FloatArray) -> Iterator[Hit]:
        """First, second, ... surface on each ray: all triangles are tried, which for one transmitter is soonest done.

        Source: Moeller and Trumbore, "Fast, minimum storage ray-triangle intersection" (1997).
        """
        surfaces = self.surfaces
        assert surfaces is not None
        corner = surfaces.triangles[:, 0]
        one, two = surfaces.triangles[:, 1] - corner, surfaces.triangles[:, 2] - corner
        across = np.cross(direction[:, None], two[None])
        determinant = np.einsum("fi,pfi->pf", one, across)
        with np.errstate(divide="ignore", invalid="ignore"):
            from_corner = start_m[:, None] - corner
            u = np.einsum("pfi,pfi->pf", from_corner, across) / determinant
            turned = np.cross(from_corner, one[None])
            v = np.einsum("pi,pfi->pf", direction, turned) / determinant
            distance = np.einsum("fi,pfi->pf", two, turned) / determinant
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

    def _met_by_mitsuba(self, start_m: FloatArray, direction: FloatArray, far_m: FloatArray) -> Iterator[Hit]:
        """The same with a tree of triangles and many rays at once."""
        import drjit as dr
        import mitsuba as mi

        from ...backend.device import on_device, to_float, to_vectors

        lanes = max(LEAST_LANES, 1 << (len(far_m) - 1).bit_length())

        def padded(values: FloatArray) -> FloatArray:
            more = np.zeros((lanes - len(values), *values.shape[1:]))
            return np.concatenate([values, more])

        d, origin = to_vectors(padded(direction), mi.Vector3f), to_vectors(padded(start_m), mi.Point3f)
        far = to_float(padded(far_m))
        active: Any = on_device(np.arange(lanes) < len(far_m), mi.Bool)
        begin: Any = mi.Float(NEAR_M)
        found = []
        # One more than may be passed: the end of the leg itself.
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
            thing = self._things[shape.numpy()[lane]]
            yield lane, travelled.numpy()[lane].astype(float), thing, n.numpy().T[lane].astype(float)


def find_chains(
    opened_room: tuple[Any, Surfaces],
    receiver_m: FloatArray,
    reflections: int,
    passed: int,
    rays: int,
    seed: int,
    most: int,
) -> IntArray:
    """Chains of planes seen from a receiver, shape [c, reflections], -1 beyond the last.

    Args:
        opened_room: from `opened`.
        receiver_m: position [3], metres.
        reflections: at most.
        passed: surfaces that a ray may go straight through at most.
        rays: that search.
        seed: of their directions.
        most: chains that are kept: those of fewest reflections.
    """
    scene, surfaces = opened_room
    found = shoot(scene, surfaces, receiver_m, rays, reflections + passed, reflections, seed)
    order = np.argsort(np.count_nonzero(found >= 0, axis=1), kind="stable")
    return found[order[:most]]
