"""Paths between many transmitters and receivers: which side searches, how many rays, in what parts."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from rich.console import Console
from rich.progress import Progress

from ..core import Antenna, InputError, Paths, Receiver
from ..core.angles import FloatArray
from ..core.antenna import ANTENNA
from .buffer import Legs, join
from .devices import before_walls, check_devices, tell_moved
from .fields import path_gains, scattering_materials
from .image_method import image_sources
from .images import specular_paths
from .options import DEFAULTS, MAX_RAYS, TraceOptions
from .result import TraceResult, device_ends
from .sampled import sampled_paths
from .search import Chains, shoot
from .surfaces import Surfaces, scene_surfaces

logger = logging.getLogger(__name__)

TARGETS_PER_CHUNK = 4096
"""Positions that one source's paths are made for at once."""
FIRST_RAYS = 1 << 14
"""What `converged_rays` begins with."""
GROWTH = 5e-4
"""Paths, and their summed free-space power, grow by less than this share in each of two doublings: converged."""
SAMPLE = (4, 256)
"""Sources and targets on which convergence is judged."""


class Prepared:
    """What a scene's traces share: its planes, and what the rays from places that stand still have found.

    Args:
        scene: a ``sionna.rt.Scene`` whose geometry stays as it is.
    """

    def __init__(self, scene: Any) -> None:
        self.surfaces = scene_surfaces(scene)
        self._scene = scene
        self._found: dict[tuple[bytes, TraceOptions, int], Any] = {}
        self._rays: dict[TraceOptions, int] = {}
        self._checked: set[bytes] = set()

    def check(self, tx_pos_m: FloatArray, receivers: tuple[Receiver, ...], first_row: int = 0) -> None:
        """Refuse antennas inside solids and warn of those near surfaces, each place once.

        Args:
            tx_pos_m: transmitters as stated [n, 3], metres.
            receivers: as stated.
            first_row: what errors call the first transmitter.

        Raises:
            InputError: see `wrf_mi.tracing.devices.check_devices`.
        """
        placed, moved = self.placed(tx_pos_m, receivers)
        ends = (tx_pos_m, placed), tuple(np.stack([one.position_m for one in each]) for each in (receivers, moved))
        names = [f"transmitter {first_row + row + 1}" for row in range(len(tx_pos_m))]
        for (stated, traced), called in zip(ends, (names, [f"receiver {one.name}" for one in receivers]), strict=True):
            new = [row for row, place in enumerate(stated) if place.tobytes() not in self._checked]
            tell_moved(stated[new], traced[new], [called[row] for row in new])
            check_devices(self.surfaces, traced[new], [called[row] for row in new])
            self._checked.update(place.tobytes() for place in stated)

    def placed(self, tx_pos_m: FloatArray, receivers: tuple[Receiver, ...]) -> tuple[FloatArray, tuple[Receiver, ...]]:
        """Transmitters [n, 3] and receivers as they are traced: see `wrf_mi.tracing.devices.before_walls`."""
        places = before_walls(self.surfaces, np.stack([one.position_m for one in receivers]))
        moved = tuple(replace(one, position_m=place) for one, place in zip(receivers, places, strict=True))
        return before_walls(self.surfaces, tx_pos_m), moved

    def rays(self, sources_m: FloatArray, targets_m: FloatArray, options: TraceOptions) -> int:
        """How many rays search; for ``"auto"``, what converged for the first positions that were asked for."""
        if options.rays != "auto":
            return options.rays
        if options not in self._rays:
            self._rays[options] = converged_rays(self._scene, self.surfaces, sources_m, targets_m, options)
        return self._rays[options]

    def chains(self, source: FloatArray, options: TraceOptions, rays: int) -> Any:
        """Sequences of planes that rays from a place [3] meet."""
        key = source.tobytes(), options, rays
        if key not in self._found:
            self._found[key] = _chains(self._scene, self.surfaces, source, options, rays, options.seed)
        return self._found[key]


def trace_paths(
    scene: Any,
    tx_pos_m: ArrayLike,
    receivers: Receiver | Sequence[Receiver],
    options: TraceOptions = DEFAULTS,
    progress: bool = False,
    prepared: Prepared | None = None,
    first_row: int = 0,
    tx_antenna: Antenna = ANTENNA,
    check: bool = True,
) -> TraceResult:
    """Trace the paths from every transmitter position to every receiver.

    Rays search from the side with fewer devices: by reciprocity
    a path and its gain are the same both ways. Sequences of reflecting planes that the rays of one source find are
    tried for every position of the other side, so that rays are not shot for each; Sionna RT's image method decides
    which are paths, and its field calculator gives their gains.

    Memory grows with the paths found, about 1 kB for each at six interactions (measured), and not with the positions
    tried: parts are bounded by `wrf_mi.tracing.images.CANDIDATES_PER_CHUNK` and
        `wrf_mi.tracing.search.PAIRS_PER_CHUNK`.

    Args:
        scene: from `wrf_mi.tracing.open_scene`, at the carrier frequency.
        tx_pos_m: transmitter positions [n, 3], world frame, metres.
        receivers: one or several.
        options: what is traced.
        progress: show a progress bar on standard error.
        prepared: of the scene, where one traces again and again to the same receivers: rays then always go out from
            these, and only the first time.
        first_row: what errors call the first transmitter, where one traces in parts.
        tx_antenna: antenna of the transmitters; the receivers state theirs.
        check: refuse antennas inside solids, warn of those near surfaces; False for places that are a model's own.

    Returns:
        The paths, the same for the same seed whatever the parts. Lengths and directions are float64: a float32 length
        is too coarse for phases (2e-3 rad at 28 GHz and 100 m).

    Raises:
        ValueError: positions of another shape or not finite.
        InputError: no transmitter or no receiver, or one inside a solid object.
    """
    positions = np.atleast_2d(np.asarray(tx_pos_m, float))
    if positions.ndim != 2 or positions.shape[1] != 3 or not np.isfinite(positions).all():
        raise ValueError(f"trace_paths: tx_pos_m has shape {np.shape(tx_pos_m)}; give finite [n, 3]")
    everyone = (receivers,) if isinstance(receivers, Receiver) else tuple(receivers)
    if not len(positions) or not everyone:
        raise InputError(f"trace_paths: {len(positions)} transmitters and {len(everyone)} receivers; give one at least")
    kept = prepared or Prepared(scene)
    surfaces = kept.surfaces
    if check:
        kept.check(positions, everyone, first_row)
    positions, everyone = kept.placed(positions, everyone)
    swap = (prepared is not None or len(everyone) <= len(positions)) and not keeps_direction(options)
    transmitters, its_receivers = device_ends(positions, everyone, tx_antenna)
    ends = (its_receivers, transmitters) if swap else (transmitters, its_receivers)
    places = ends[0].position_m, ends[1].position_m
    rays = kept.rays(*places, options)
    with scattering_materials(scene, options):
        legs = _search(scene, kept, places, options, rays, progress)
        gain = path_gains(scene, surfaces, legs, ends, rays)
    hz = float(scene.frequency[0])
    return _result(legs, gain, surfaces, positions, everyone, options, rays, swap, hz, tx_antenna)


def keeps_direction(options: TraceOptions) -> bool:
    """Whether transmitters search, though receivers are fewer.

    Sionna RT's diffraction at lossy wedges is a heuristic that is not reciprocal.
    """
    return options.diffraction and options.sampled


def _search(
    scene: Any,
    kept: Prepared,
    ends: tuple[FloatArray, FloatArray],
    options: TraceOptions,
    rays: int,
    progress: bool,
) -> Legs:
    (sources, targets), surfaces = ends, kept.surfaces
    parts = []
    bar = Progress(console=Console(stderr=True), transient=True, disable=not progress)
    with bar:
        task = bar.add_task("tracing paths", total=len(sources) * len(targets))
        for index, source in enumerate(sources):
            chains = kept.chains(source, options, rays)
            for start in range(0, len(targets), TARGETS_PER_CHUNK):
                batch = targets[start : start + TARGETS_PER_CHUNK]
                found = [specular_paths(scene, surfaces, chains, source, batch, options)]
                if options.sampled and len(surfaces.plane):
                    found.append(sampled_paths(scene, surfaces, source, batch, options, rays))
                legs = join(found, max(options.max_depth, 1))
                parts.append(replace(legs, source=np.full_like(legs.source, index), target=legs.target + start))
                bar.advance(task, len(batch))
    return join(parts, max(options.max_depth, 1))


def _chains(scene: Any, surfaces: Surfaces, source: FloatArray, options: TraceOptions, rays: int, seed: int) -> Any:
    met = options.max_depth if options.transmission else options.reflections
    plane = shoot(scene, surfaces, source, rays, met, options.reflections, seed)
    return Chains(plane, image_sources(surfaces.normal, surfaces.offset, plane, source)[:, 1:])


def converged_rays(
    scene: Any, surfaces: Surfaces, sources_m: FloatArray, targets_m: FloatArray, options: TraceOptions
) -> int:
    """How many rays find (nearly) every path, judged on up to 4 sources and 256 targets.

    The number is doubled, from 2^14, until in two doublings on end neither the number of paths nor the power
    sum 1 / length^2, what the paths would carry in free space, grew by more than 0.05 %. Each number has rays of its
    own, so that a path found by luck once does not hide that it is found by luck.

    Returns:
        The last number but two: further doublings found nothing. 2^24 at most, with a warning.
    """
    if not len(surfaces.plane) or not options.reflections:
        return FIRST_RAYS
    sources = _spread(sources_m, SAMPLE[0])
    targets = _spread(targets_m, SAMPLE[1])
    plain = replace(options, diffraction=False, scattering=False)
    best, calm, rays = np.zeros(2), 0, FIRST_RAYS
    while True:
        found = np.zeros(2)
        for source in sources:
            chains = _chains(scene, surfaces, source, plain, rays, options.seed + rays.bit_length())
            legs = specular_paths(scene, surfaces, chains, source, targets, plain)
            found += len(legs), (_lengths(legs, source[None], targets) ** -2).sum()
        calm = calm + 1 if (found <= best * (1 + GROWTH)).all() else 0
        best = np.maximum(best, found)
        logger.info("%d rays: %d paths on a sample of positions", rays, found[0])
        if calm == 2:
            return rays // 4
        if rays >= MAX_RAYS:
            logger.warning("paths still grow at %d rays from each source: surfaces are too finely divided", rays)
            return rays
        rays *= 2


def _spread(points: FloatArray, count: int) -> FloatArray:
    return points[np.unique(np.linspace(0, len(points) - 1, min(count, len(points))).round().astype(int))]


def _lengths(legs: Legs, sources_m: FloatArray, targets_m: FloatArray) -> FloatArray:
    """Unfolded lengths [p] in float64."""
    here, length = sources_m[legs.source], np.zeros(len(legs))
    for level in range(legs.interactions.shape[1]):
        there = np.where(legs.interactions[:, level, None] != 0, legs.vertices_m[:, level], here)
        length += np.linalg.norm(there - here, axis=1)
        here = there
    return length + np.linalg.norm(targets_m[legs.target] - here, axis=1)


def _result(
    legs: Legs,
    gain: Any,
    surfaces: Surfaces,
    tx_pos_m: FloatArray,
    receivers: tuple[Receiver, ...],
    options: TraceOptions,
    rays: int,
    swap: bool,
    frequency_hz: float,
    tx_antenna: Antenna,
) -> TraceResult:
    ends = tx_pos_m, np.stack([receiver.position_m for receiver in receivers])
    legs = legs.reverse() if swap else legs
    length = _lengths(legs, *ends)
    order = np.lexsort((*legs.face.T[::-1], length, legs.source, legs.target))
    legs, gain, length = legs.select(order), gain[order], length[order]
    tx, rx, types, face, vertices = legs.source, legs.target, legs.interactions, legs.face, legs.vertices_m
    bounces = np.count_nonzero(types, axis=1)
    row = np.arange(len(tx))
    first = np.where(bounces[:, None] > 0, vertices[row, 0], ends[1][rx])
    last = np.where(bounces[:, None] > 0, vertices[row, np.maximum(bounces - 1, 0)], ends[0][tx])
    used = types != 0
    objects = np.where(used, surfaces.object_of(np.maximum(face, 0)), -1)
    primitives = np.where(used, face - surfaces.first_face[objects], -1)
    paths = Paths(
        tx=tx,
        rx=rx,
        gain=gain,
        length_m=length,
        departure=_unit(first - ends[0][tx]),
        arrival=_unit(last - ends[1][rx]),
        interactions=types,
        vertices_m=vertices,
        objects=objects.astype(np.int32),
        object_names=surfaces.names,
        n_tx=len(tx_pos_m),
        n_rx=len(receivers),
    )
    return TraceResult(
        paths,
        tx_pos_m,
        receivers,
        primitives.astype(np.int32),
        legs.probability,
        legs.wedge,
        options,
        int(rays),
        swap,
        frequency_hz,
        tx_antenna,
    )


def _unit(vectors: FloatArray) -> FloatArray:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
