"""Paths between many transmitters and receivers: direction of the search, number of rays, chunks."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from rich.console import Console
from rich.progress import Progress

from ...core import Antenna, InputError, Paths, Receiver
from ...core.antenna import ANTENNA
from ...core.files import listed
from ...core.types import FloatArray, IntArray
from ..options import DEFAULTS, MAX_RAYS, TraceOptions
from ..search.chains import PathInteractions, ReflectionChains, check_search, join, shoot
from ..search.devices import before_surfaces, check_devices, from_behind
from ..search.images import image_sources, specular_paths
from ..search.surfaces import Surfaces, scene_surfaces
from ..sionna.path_solver import AT_ANTENNA_M, sampled_paths
from ..sionna.scattering import scattering_coefficients, scattering_materials, scatters
from .result import TraceResult, device_ends, gains_of_receivers

if TYPE_CHECKING:
    from .scene_parameters import MaterialGrouping, SceneTables

logger = logging.getLogger(__name__)

SOURCES_TOGETHER = 32  # sources whose paths are searched together: a search has a fixed cost
PAIRS_TOGETHER = 4096  # pairs of source and target in a chunk
FIRST_RAYS = 1 << 14  # first number of rays of `converged_rays`
GROWTH = 5e-4  # share by which paths, and their summed free-space power, grow at most in two doublings at convergence
SAMPLE = (4, 256)  # sources and targets on which convergence is judged


class Prepared:
    """State that the traces of a scene share: its planes, and chains of planes that rays from fixed points have found.

    The ``sionna.rt.Scene`` is of constant geometry and, for traced fields, materials; ``surfaces`` are found if None.
    """

    def __init__(self, scene: Any, surfaces: Surfaces | None = None) -> None:
        self.scene, self.surfaces = scene, surfaces or scene_surfaces(scene)
        self._chains: dict[tuple[bytes, TraceOptions, int], ReflectionChains] = {}
        self._rays: dict[TraceOptions, int] = {}
        self._tables: dict[MaterialGrouping, SceneTables] = {}
        self._checked: set[bytes | float | None] = set()

    def check(self, tx_pos_m: FloatArray, receivers: tuple[Receiver, ...], first_row: int = 0) -> None:
        """Refuse antennas inside solids and warn of those near surfaces (`check_devices`), each position once."""
        transmitters, receiver_names = _names(len(tx_pos_m), receivers, first_row)
        sides = (transmitters, tx_pos_m), (receiver_names, np.stack([receiver.position_m for receiver in receivers]))
        for names, antennas_m in sides:
            new = np.array([row for row in range(len(names)) if antennas_m[row].tobytes() not in self._checked], int)
            traced = from_behind(self.surfaces, antennas_m[new])
            if len(moved := new[(antennas_m[new] != traced).any(axis=1)]):
                text = "%d of %d antennas lie up to 1 cm behind a surface (first: %s): traced from 0.1 mm before it"
                logger.warning(text, len(moved), len(new), names[moved[0]])
            check_devices(self.surfaces, before_surfaces(self.surfaces, traced), [names[row] for row in new])
            self._checked.update(antennas_m[row].tobytes() for row in new)

    def log_scattering(self, options: TraceOptions) -> None:
        """Log once what options of scattering replace in the scene's materials, or that none scatters."""
        coefficient = options.scattering_coefficient
        if not options.scattering or coefficient in self._checked:
            return
        self._checked.add(coefficient)
        others = {name: s for name, s in scattering_coefficients(self.scene).items() if s != coefficient}
        if coefficient is not None and others:
            names = listed([f"{name} {s:g}" for name, s in others.items()])
            logger.info("scattering_coefficient %g replaces those of the scene's materials: %s", coefficient, names)
        elif not scatters(self.scene, options):
            text = "scattering has no effect: no material of the scene has a scattering_coefficient; state it there"
            logger.warning("%s, or as a setting for all", text)

    def placed(self, tx_pos_m: FloatArray, receivers: tuple[Receiver, ...]) -> tuple[FloatArray, tuple[Receiver, ...]]:
        """Transmitters [n, 3] and receivers as they are traced (`wrf_mi.tracing.search.devices.from_behind`)."""
        antennas_m = np.concatenate([tx_pos_m, [receiver.position_m for receiver in receivers]])
        # Those on a surface stay: their paths are searched for before it, and have the lengths from the surface.
        positions, others = np.split(from_behind(self.surfaces, antennas_m), [len(tx_pos_m)])
        return positions, tuple(replace(rx, position_m=at) for rx, at in zip(receivers, others, strict=True))

    def tables(self, grouping: MaterialGrouping) -> SceneTables:
        """Materials and planes as traced fields read them, those of the first call."""
        from .scene_parameters import SceneTables  # Dr.Jit is imported where paths have derivatives

        if grouping not in self._tables:
            self._tables[grouping] = SceneTables.of(self.scene, self.surfaces, grouping)
        return self._tables[grouping]

    def rays(self, sources_m: FloatArray, targets_m: FloatArray, options: TraceOptions) -> int:
        """Number of rays per search; for ``"auto"`` that which converged for the positions of the first call."""
        if options.rays != "auto":
            return options.rays
        if options not in self._rays:
            self._rays[options] = converged_rays(self, sources_m, targets_m, options)
        return self._rays[options]

    def chains(self, sources_m: FloatArray, options: TraceOptions, rays: int) -> ReflectionChains:
        """Sequences of planes that rays from points [s, 3] meet."""
        key = sources_m.tobytes(), options, rays
        if key not in self._chains:
            check_search(options, rays, len(sources_m))
            self._chains[key] = self.new_chains(sources_m, options, rays, options.seed)
        return self._chains[key]

    def new_chains(self, sources_m: FloatArray, options: TraceOptions, rays: int, seed: int) -> ReflectionChains:
        """Chains from points [s, 3] by rays of any seed, not kept here."""
        surfaces = self.surfaces
        planes = [shoot(self.scene, surfaces, source_m, options, rays, seed) for source_m in sources_m]
        source = np.repeat(np.arange(len(planes)), [len(plane) for plane in planes])
        plane = np.concatenate(planes)
        image = image_sources(surfaces.normal, surfaces.offset, plane, sources_m[source])[:, 1:]
        return ReflectionChains(plane, image, source)


def _stated_devices(
    tx_pos_m: ArrayLike, receivers: Receiver | Sequence[Receiver]
) -> tuple[FloatArray, tuple[Receiver, ...]]:
    positions = np.atleast_2d(np.asarray(tx_pos_m, float))
    if positions.ndim != 2 or positions.shape[1] != 3 or not np.isfinite(positions).all():
        raise ValueError(f"trace_paths: tx_pos_m has shape {np.shape(tx_pos_m)}; give finite [n, 3]")
    devices = (receivers,) if isinstance(receivers, Receiver) else tuple(receivers)
    if not len(positions) or not devices:
        raise InputError(f"trace_paths: {len(positions)} transmitters and {len(devices)} receivers; give one at least")
    return positions, devices


def trace_paths(
    scene: Any,
    tx_pos_m: ArrayLike,
    receivers: Receiver | Sequence[Receiver],
    options: TraceOptions = DEFAULTS,
    progress: bool = False,
    prepared: Prepared | None = None,
    first_row: int = 0,
    *,
    tx_antenna: Antenna = ANTENNA,
    check: bool = True,
    gains: bool = True,
    search_from: Literal["receivers", "transmitters"] | None = None,
) -> TraceResult:
    """Trace the paths from every transmitter position to every receiver.

    Sequences of reflecting planes that the rays of one source find are tried for every position of the other side, so
    that rays are not shot for each; rays along their legs decide which are paths (`wrf_mi.tracing.search.visibility`),
    and Sionna RT's field calculator gives their gains. The paths of a pair are the same alone and among others, as long
    as the number of rays is not ``"auto"``.

    Memory grows with the paths found, about 1 kB for each at six interactions (measured), and not with the positions
    tried: chunks are bounded by `wrf_mi.tracing.search.images.CANDIDATES_PER_CHUNK` and
    `wrf_mi.tracing.search.chains.PAIRS_PER_CHUNK`.

    Args:
        scene: from `wrf_mi.tracing.open_scene`, at the carrier frequency.
        tx_pos_m: transmitter positions [n, 3], world frame, metres.
        receivers: one or several.
        options: kinds of path, depth, rays.
        progress: show a progress bar on standard error.
        prepared: shared state of the scene for repeated traces to the same receivers: rays leave only the first time.
        first_row: number of the first transmitter in error messages, from 0.
        tx_antenna: antenna of the transmitters; receivers hold their antennas.
        check: refuse antennas inside solids, warn of those near surfaces.
        gains: evaluate the gains of the paths; otherwise they are NaN, for callers that need geometry alone.
        search_from: side from which rays leave, a second for each position; a path and its gain are the same both ways,
            but rays miss some that take small surfaces, others from each side. None: receivers, but transmitters with
            diffraction (always) or scattering, whose fields at lossy wedges, and by the angle of incidence, are not
            reciprocal in Sionna RT.

    Returns:
        The paths, reproducible for a seed whatever the chunks. Lengths and directions are float64: a float32 length
        is too coarse for phases (2e-3 rad at 28 GHz and 100 m).

    Raises:
        ValueError: positions of another shape or not finite.
        InputError: no transmitter or no receiver, or an antenna inside a solid object.
    """
    # Positions and devices, checked.
    positions, devices = _stated_devices(tx_pos_m, receivers)
    shared = prepared or Prepared(scene)
    if check:
        shared.check(positions, devices, first_row)
        shared.log_scattering(options)
    # Devices are placed before the surfaces that they are on.
    positions, devices = shared.placed(positions, devices)

    # The side that rays leave from: the receivers, as each takes a second, but for fields that are not reciprocal.
    side = search_from or ("transmitters" if options.sampled else "receivers")
    swap = side == "receivers" and not options.diffraction
    transmitters, rx_devices = device_ends(positions, devices, tx_antenna)
    ends = (rx_devices, transmitters) if swap else (transmitters, rx_devices)
    sources, targets = ends[0].position_m, ends[1].position_m
    rays = shared.rays(sources, targets, options)

    with scattering_materials(scene, options):
        # Search: interactions of all paths, chunk by chunk.
        legs = _search(shared, sources, targets, options, rays, progress)

        # Gains by Sionna RT's field calculator, which knows diffraction and scattering.
        gain = np.full(len(legs), np.nan, np.complex128)
        if gains:
            receiver = legs.source if swap else legs.target
            gain = gains_of_receivers(scene, shared.surfaces, legs, ends, rays, devices, receiver)

        # Result: sorted from transmitters to receivers, with each triangle's number in its object, as in a file.
        paths, legs = _paths(legs.reverse() if swap else legs, gain, shared.surfaces, positions, rx_devices.position_m)
        primitives = np.where(legs.face >= 0, legs.face - shared.surfaces.first_face[paths.objects], -1)
        hz, arrays = float(scene.frequency[0]), (primitives.astype(np.int32), legs.probability, legs.wedge)
        traced = TraceResult(paths, positions, devices, *arrays, options, int(rays), swap, hz, tx_antenna)
        traced = traced.unabsorbed(scene)
        if gains:
            traced = traced.with_gains(traced.paths.gain)
    if check:
        _warn_of_silence(traced.paths, positions, devices, first_row)
    return traced


def _names(transmitters: int, receivers: Sequence[Receiver], first_row: int) -> tuple[list[str], list[str]]:
    rows = range(first_row + 1, first_row + 1 + transmitters)
    return [f"transmitter {row}" for row in rows], [f"receiver {receiver.name}" for receiver in receivers]


def _warn_of_silence(paths: Paths, tx_pos_m: FloatArray, receivers: Sequence[Receiver], first_row: int) -> None:
    """Warn of transmitters and of receivers without any path: behind a wall, or of too few interactions."""
    transmitters, receiver_names = _names(len(tx_pos_m), receivers, first_row)
    sides = [("transmitters", paths.tx, transmitters, tx_pos_m)]
    sides += [("receivers", paths.rx, receiver_names, np.stack([rx.position_m for rx in receivers]))]
    for what, reached, names, positions in sides:
        silent = np.setdiff1d(np.arange(len(names)), reached)
        # A single transmitter need not reach every receiver, and predictions of one after another would repeat it.
        if len(silent) and (len(tx_pos_m) > 1 or len(silent) == len(names)):
            at = ", ".join(f"{x:.2f}" for x in positions[silent[0]])
            text = "%d of %d %s have no path (first: %s at (%s) m): check that they are inside, and the kinds of path"
            logger.warning(text, len(silent), len(names), what, names[silent[0]], at)


def _search(
    shared: Prepared, sources: FloatArray, targets: FloatArray, options: TraceOptions, rays: int, progress: bool
) -> PathInteractions:
    parts = []
    with Progress(console=Console(stderr=True), transient=True, disable=not progress) as bar:
        task = bar.add_task("tracing paths", total=len(sources) * len(targets))
        for first in range(0, len(sources), SOURCES_TOGETHER):
            group = sources[first : first + SOURCES_TOGETHER]
            # Chunks of targets bound the memory of candidates; chains of a group are shot once.
            chains, step = shared.chains(group, options, rays), max(1, PAIRS_TOGETHER // len(group))
            for start in range(0, len(targets), step):
                batch = targets[start : start + step]
                kinds = [specular_paths(shared.surfaces, chains, group, batch, options)]
                if options.sampled and len(shared.surfaces.plane):
                    for index, source in enumerate(group):
                        legs = sampled_paths(shared.scene, shared.surfaces, source, batch, options, rays)
                        kinds.append(replace(legs, source=np.full_like(legs.source, index)))
                legs = join(kinds)
                parts.append(replace(legs, source=legs.source + first, target=legs.target + start))
                bar.advance(task, len(group) * len(batch))
    return join(parts)


def converged_rays(shared: Prepared, sources_m: FloatArray, targets_m: FloatArray, options: TraceOptions) -> int:
    """Number of rays that find (nearly) every path, judged on up to 4 sources and 256 targets.

    The number is doubled, from 2^14 to at most 2^24 (with a warning), until in two consecutive doublings neither the
    number of paths nor the power sum 1 / length^2 in free space grew by more than 0.05 %; the last number but two is
    returned. Each number has different rays, so that a path found by chance once does not count as converged.
    """
    if not len(shared.surfaces.plane) or not options.most_reflections:
        return FIRST_RAYS
    ends = (sources_m, SAMPLE[0]), (targets_m, SAMPLE[1])
    sources, targets = (positions[spread(len(positions), most)] for positions, most in ends)
    plain = replace(options, diffraction=False, scattering=False)
    best, calm, rays = np.zeros(2), 0, FIRST_RAYS
    while True:
        chains = shared.new_chains(sources, plain, rays, options.seed + rays.bit_length())
        legs = specular_paths(shared.surfaces, chains, sources, targets, plain)
        count_and_power = np.array([len(legs), (_lengths(legs, sources, targets) ** -2).sum()])
        calm = calm + 1 if (count_and_power <= best * (1 + GROWTH)).all() else 0
        best = np.maximum(best, count_and_power)  # other rays may lose what a smaller number found
        logger.info("%d rays: %d paths on a sample of positions", rays, len(legs))
        if calm == 2:
            return rays // 4
        if rays >= MAX_RAYS:
            logger.warning("paths still grow at %d rays from each source: surfaces are too finely divided", rays)
            return rays
        rays *= 2


def spread(count: int, most: int) -> IntArray:
    """Indices of up to ``most`` of ``count`` rows, evenly spaced."""
    return np.unique(np.linspace(0, count - 1, min(most, count)).round().astype(int))


def _lengths(legs: PathInteractions, sources_m: FloatArray, targets_m: FloatArray) -> FloatArray:
    """Unfolded lengths [p] in float64."""
    # From point to point: beyond the last interaction the point stays, which adds nothing.
    point, length = sources_m[legs.source], np.zeros(len(legs))
    for level in range(legs.interactions.shape[1]):
        following = np.where(legs.interactions[:, level, None] != 0, legs.vertices_m[:, level], point)
        length += np.linalg.norm(following - point, axis=1)
        point = following
    return length + np.linalg.norm(targets_m[legs.target] - point, axis=1)


def _paths(
    legs: PathInteractions, gain: NDArray[np.complex128], surfaces: Surfaces, tx_pos_m: FloatArray, rx_pos_m: FloatArray
) -> tuple[Paths, PathInteractions]:
    """Paths sorted by receiver, transmitter and length, and the legs (from transmitters to receivers) in that order."""
    length = _lengths(legs, tx_pos_m, rx_pos_m)
    # Faces in order decide between equal lengths, as in mirrored rooms: the order is that of every run.
    order = np.lexsort((*legs.face.T[::-1], length, legs.source, legs.target))
    legs, gain, length = legs.select(order), gain[order], length[order]
    tx, rx, vertices = tx_pos_m[legs.source], rx_pos_m[legs.target], legs.vertices_m
    objects = np.where(legs.interactions != 0, surfaces.object_of(np.maximum(legs.face, 0)), -1).astype(np.int32)
    departure, arrival = _directions(tx, rx, vertices), _directions(rx, tx, vertices[:, ::-1])
    met = legs.interactions, vertices, objects, surfaces.names
    paths = Paths(legs.source, legs.target, gain, length, departure, arrival, *met, len(tx_pos_m), len(rx_pos_m))
    return paths, legs


def _directions(ends_m: FloatArray, others_m: FloatArray, points_m: FloatArray) -> FloatArray:
    """Unit vectors [p, 3] from ends of paths towards the next points [p, depth, 3] (NaN: none), or the other ends."""
    # Nearest points that tell a direction: an antenna may be within a sheet that its path passes.
    apart = np.nan_to_num(np.linalg.norm(points_m - ends_m[:, None], axis=2)) > AT_ANTENNA_M
    nearest = points_m[np.arange(len(points_m)), apart.argmax(axis=1)]
    way = np.where(apart.any(axis=1)[:, None], nearest, others_m) - ends_m
    return np.asarray(way / np.linalg.norm(way, axis=1, keepdims=True))
