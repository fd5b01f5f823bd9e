"""Chains of planes at which a wave may be reflected, searched for by rays, and paths as the surfaces that they meet."""

from __future__ import annotations

import logging
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ...core import InputError
from ...core.types import FloatArray, IntArray
from ..options import TraceOptions
from .surfaces import Surfaces

logger = logging.getLogger(__name__)

SPECULAR, TRANSMISSION = 1, 4  # values of Sionna RT's ``InteractionType``
ARRAYS = (
    "source",
    "target",
    "interactions",
    "face",
    "vertices_m",
    "probability",
)  # fields by path
PAIRS_PER_CHUNK = 1 << 24  # pairs of chain and position in a chunk: 64 MiB for each single-precision array
RAYS_PER_CHUNK = 1 << 20  # rays in a chunk
MARGIN_M = 1e-3  # slack of the bounds of planes
BESIDE = 1e-5
"""Slack of the sides of planes, as a share of `Surfaces.scale_m`: points of reflection that coincide in an edge, as
displaced by `wrf_mi.tracing.search.images`."""
MOST_CODES = 1 << 62  # most numbers of a 64-bit integer that stand for chains
MOST_KEPT = 1 << 27  # bytes of chains that a process keeps
SECONDS_PER_HIT = 1.2e-7  # of each surface that a ray meets, on two cores; most of it finds duplicates (docs/scenes.md)
WARN_S, MOST_S = 10.0, 3600.0  # durations from which a search is announced, and refused
_kept: OrderedDict[tuple[Any, ...], IntArray] = OrderedDict()


@dataclass(frozen=True)
class PathInteractions:
    """Interactions of p paths from source to target, the input of Sionna RT's stages."""

    source: IntArray  # index of the point from which each path comes, shape [p]
    target: IntArray  # index of the point to which it leads, shape [p]
    interactions: NDArray[np.uint8]  # ``InteractionType`` of each interaction, shape [p, depth], 0 beyond the last
    face: IntArray  # index of the face at each interaction into `Surfaces.triangles`, [p, depth], -1 beyond the last
    vertices_m: FloatArray  # interaction points [p, depth, 3], metres, NaN beyond the last
    probability: NDArray[np.float32]  # of the interaction in a random search, [p, depth]; 1 in an exhaustive one
    wedge: dict[str, NDArray[Any]]  # edges of diffraction, fields of ``WedgeGeometry`` [p, ...]; empty without

    def __len__(self) -> int:
        return len(self.source)

    def select(self, which: NDArray[Any] | slice) -> PathInteractions:
        """The paths of a mask or of indices."""
        wedge = {name: array[which] for name, array in self.wedge.items()}
        return PathInteractions(**{name: getattr(self, name)[which] for name in ARRAYS}, wedge=wedge)

    def reverse(self) -> PathInteractions:
        """The same paths from target to source; edges of diffraction keep the faces of the original direction."""
        depth = self.interactions.shape[1]
        last = np.count_nonzero(self.interactions, axis=1)[:, None] - 1
        level = np.arange(depth)
        turned = np.arange(len(self))[:, None], np.where(level <= last, last - level, level)
        arrays = {name: getattr(self, name)[turned] for name in ("interactions", "face", "vertices_m", "probability")}
        return replace(self, source=self.target, target=self.source, **arrays)


def join(parts: list[PathInteractions]) -> PathInteractions:
    """Concatenate legs of the same depth."""
    wedge: dict[str, NDArray[Any]] = {}
    for name, like in next((part.wedge for part in parts if part.wedge), {}).items():
        zeros = [np.zeros((len(part), *like.shape[1:]), like.dtype) for part in parts]
        wedge[name] = np.concatenate([part.wedge.get(name, zero) for part, zero in zip(parts, zeros, strict=True)])
    return PathInteractions(
        **{name: np.concatenate([getattr(part, name) for part in parts]) for name in ARRAYS}, wedge=wedge
    )


@dataclass(frozen=True)
class ReflectionChains:
    """Sequences of reflecting planes seen from sources; c chains."""

    plane: IntArray  # planes in their order from the source, shape [c, depth], -1 beyond the last
    image: FloatArray  # images of the source after each reflection, shape [c, depth, 3], metres, float64
    source: IntArray  # number of the source of each chain, shape [c]

    def __len__(self) -> int:
        return len(self.plane)

    @cached_property
    def length(self) -> IntArray:
        """Number of reflections of each chain, shape [c]."""
        return np.count_nonzero(self.plane >= 0, axis=1)

    @cached_property
    def on_device(self) -> tuple[Any, list[Any], list[Any]]:
        """Numbers of reflections; planes, and images of the source, of each reflection: Dr.Jit arrays [c]."""
        import mitsuba as mi

        from ...backend.device import columns_on_device, to_uint, to_vectors

        planes = columns_on_device(np.maximum(self.plane, 0).T, mi.UInt32)
        return to_uint(self.length), planes, [to_vectors(image, mi.Point3f) for image in self.image.swapaxes(0, 1)]


def shoot(
    scene: Any, surfaces: Surfaces, source_m: FloatArray, options: TraceOptions, rays: int, seed: int
) -> IntArray:
    """Chains of planes [c, reflections] at which rays from a point [3] are reflected, -1 beyond the last.

    Each chain comes once, with all its prefixes, in lexical order; the array is not to be written to. Where waves pass
    surfaces, the rays are shot once for each choice of the hits that reflect: up to two to the power of the depth. The
    seed turns the rays' lattice.
    """
    # Models, folds and carriers trace the same rooms from the same receivers.
    reach = options.surfaces_met, options.most_reflections, options.transmission
    key = surfaces.digest, source_m.tobytes(), rays, seed, *reach
    if key in _kept:
        _kept.move_to_end(key)
    else:
        _kept[key] = _chains(scene, surfaces, source_m, options, rays, seed)
        _kept[key].flags.writeable = False
        while len(_kept) > 1 and sum(chains.nbytes for chains in _kept.values()) > MOST_KEPT:
            _kept.popitem(last=False)
    return _kept[key]


def _chains(
    scene: Any, surfaces: Surfaces, source_m: FloatArray, options: TraceOptions, rays: int, seed: int
) -> IntArray:
    reflections = options.most_reflections
    chains = [np.zeros((0, reflections), np.int64)]
    if not len(surfaces.plane) or not reflections:
        return chains[0]
    turn = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    for start in range(0, rays, RAYS_PER_CHUNK):
        stop = min(start + RAYS_PER_CHUNK, rays)
        directions = turn @ lattice(start, stop, rays)  # for all patterns: sines take as long as the rays
        for reflecting in patterns(options.surfaces_met, reflections, options.transmission):
            sequence = np.full((stop - start, reflections), -1, np.int64)
            hits = _shoot(scene, surfaces, directions, source_m, options.surfaces_met, reflecting)
            sequence[:, : len(reflecting)] = hits[list(reflecting)].T
            chains.append(unique_chains(sequence))  # chunk by chunk: most rays find the same few chains
    return unique_chains(np.concatenate(chains))


def patterns(depth: int, reflections: int, passing: bool) -> list[tuple[int, ...]]:
    """Indices of the hits that reflect: all choices that are not a prefix of another one, see `shoot`."""
    if not passing:
        return [tuple(range(reflections))]
    full = list(combinations(range(depth), reflections))
    fewer = [pattern for r in range(1, reflections) for pattern in combinations(range(depth), r)]
    return full + [pattern for pattern in fewer if depth - 1 - pattern[-1] < reflections - len(pattern)]


def lattice(start: int, stop: int, count: int) -> FloatArray:
    """Directions [3, stop - start] of the Fibonacci lattice of ``count`` points on the sphere.

    Source: Gonzalez, "Measurement of areas on a sphere using Fibonacci and latitude-longitude lattices" (2010), Math.
    Geosciences 42.
    """
    index = np.arange(start, stop)
    z = 1 - (2 * index + 1) / count
    angle = 2 * np.pi * ((index * (2 / (1 + np.sqrt(5)))) % 1)
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z])


def _shoot(
    scene: Any,
    surfaces: Surfaces,
    directions: FloatArray,
    source_m: FloatArray,
    depth: int,
    reflecting: tuple[int, ...],
) -> IntArray:
    """Plane of each hit [depth, rays], -1 once a ray has left the scene; ``reflecting``: hits that reflect the ray."""
    import drjit as dr
    import mitsuba as mi

    from ...backend.device import to_vectors

    ray = mi.Ray3f(to_vectors(source_m[None], mi.Point3f), to_vectors(directions.T, mi.Vector3f))
    first, plane = surfaces.faces_on_device
    # Runtime argument, so that Dr.Jit reuses the kernel for every pattern.
    pattern = dr.opaque(mi.UInt32, sum(1 << level for level in reflecting))
    active = dr.full(mi.Bool, True, directions.shape[1])
    planes: list[Any] = []
    for level in range(depth):
        hit = scene.mi_scene.ray_intersect(ray, ray_flags=mi.RayFlags.Minimal, coherent=level == 0, active=active)
        active &= hit.is_valid()
        shape: Any = dr.reinterpret_array(mi.UInt32, hit.shape)
        face = dr.gather(mi.UInt32, first, shape, active) + hit.prim_index
        planes.append(dr.select(active, mi.Int32(dr.gather(mi.UInt32, plane, face, active)), -1))
        # Law of reflection, d' = d - 2 (d . n) n; a ray that passes keeps its direction.
        mirrored = ray.d - 2 * dr.dot(ray.d, hit.n) * hit.n
        ray = hit.spawn_ray(dr.select((pattern >> level) & 1 == 1, mirrored, ray.d))
    dr.eval(planes)
    return np.stack([np.asarray(hits, np.int64) for hits in planes])


def unique_chains(sequence: IntArray) -> IntArray:
    """Distinct sequences of planes [n, depth] with all their prefixes, without empty ones, in lexical order."""
    # Prefixes are paths, too: the wave may reach the target before the ray meets a further plane.
    once = _unique_rows(sequence)
    level = np.arange(sequence.shape[1])
    together = _unique_rows(np.concatenate([np.where(level < length, once, -1) for length in level + 1]))
    return together[(together >= 0).any(axis=1)]


def _unique_rows(rows: IntArray) -> IntArray:
    """Distinct rows of integers of -1 or more in lexical order, many times faster than `numpy.unique(axis=0)`."""
    # One number for each row, in the rows' order: numbers are sorted in a fifth of the time of rows.
    base, codes, code = int(rows.max(initial=-1)) + 2, 1, np.zeros(len(rows), np.int64)
    for column in rows.T:
        if codes > MOST_CODES // base:  # of many planes and reflections: ranks in place of numbers that would overflow
            code, codes = np.unique(code, return_inverse=True)[1].reshape(-1), len(rows)
        code, codes = code * base + column + 1, codes * base
    return rows[np.unique(code, return_index=True)[1]]


def possible(
    surfaces: Surfaces, chains: ReflectionChains, targets_m: FloatArray
) -> Iterator[tuple[IntArray, IntArray]]:
    """Indices of chains and targets [n, 3] whose points of reflection lie within the bounds of the chain's planes."""
    # A test without rays in single precision, which a few in a thousand pairs pass; some in vain, as it has some slack.
    # Pairs come in chunks, each by the number of reflections.
    import drjit as dr
    import mitsuba as mi

    from ...backend.device import to_vectors

    length, targets = chains.length, to_vectors(targets_m, mi.Point3f)
    (reflections, planes, images), tables = chains.on_device, surfaces.planes_on_device
    step = max(1, PAIRS_PER_CHUNK // len(targets_m))
    # Runtime arguments, so that Dr.Jit reuses the kernel for all numbers of targets.
    count, beside = dr.opaque(mi.UInt32, len(targets_m)), dr.opaque(mi.Float, BESIDE * surfaces.scale_m)
    for start in range(0, len(chains), step):
        part = min(step, len(chains) - start)
        lane = dr.arange(mi.UInt32, part * len(targets_m))
        row: Any = lane // count
        point: Any = dr.gather(mi.Point3f, targets, lane - row * count)
        row += dr.opaque(mi.UInt32, start)
        reflects = dr.gather(mi.UInt32, reflections, row)
        valid: Any = dr.full(mi.Bool, True, part * len(targets_m))
        for level in reversed(range(len(planes))):
            active = level < reflects
            plane = dr.gather(mi.UInt32, planes[level], row, active)
            image = dr.gather(mi.Point3f, images[level], row, active)
            n, d, u, v, low, high = (dr.gather(type(table), table, plane, active) for table in tables)
            # Backwards from the target: the line to the image meets the plane where the wave is reflected, if both
            # are on opposite sides of it.
            height, image_height = dr.dot(n, point) - d, dr.dot(n, image) - d
            met: Any = point + (image - point) * (height / (height - image_height))
            along = mi.Point2f(dr.dot(u, met), dr.dot(v, met))
            within: Any = dr.all(along >= low - MARGIN_M) & dr.all(along <= high + MARGIN_M)
            opposite = dr.select(image_height > 0, height < beside, height > -beside)
            valid &= ~active | (opposite & within)
            point = dr.select(active, met, point)
        pairs = np.asarray(dr.compress(valid), np.int64)
        chain, target = pairs // len(targets_m) + start, pairs % len(targets_m)
        order = np.argsort(length[chain], kind="stable")
        yield chain[order], target[order]


def hits(options: TraceOptions, rays: int) -> int:
    """Number of surfaces that the rays of one source meet in a closed room; an upper bound elsewhere."""
    if not options.most_reflections:
        return 0
    met = options.surfaces_met
    return len(patterns(met, options.most_reflections, options.transmission)) * rays * met


def search_seconds(options: TraceOptions, rays: int, sources: int) -> float:
    """Estimated duration of a search from a number of sources on two cores, seconds."""
    return sources * hits(options, rays) * SECONDS_PER_HIT


def check_search(options: TraceOptions, rays: int, sources: int) -> None:
    """Announce a search from a number of sources that takes long; `InputError` for one of more than an hour."""
    duration_s = search_seconds(options, rays, sources)
    if duration_s < WARN_S:
        return
    search = f"search for paths with up to {options.most_reflections} reflections"
    remedy = f"a smaller --depth ({options.depth}) or --reflections"
    if duration_s > MOST_S:
        raise InputError(f"{search}: about {duration_s / 3600:.1f} hours; give {remedy}")
    logger.warning("%s: about %.0f s; faster with %s", search, duration_s, remedy)
