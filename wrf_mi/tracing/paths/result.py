"""A trace: paths with the data that gains for other materials or antennas need, and its file."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core import Antenna, InputError, Paths, Receiver
from ...core.antenna import ANTENNA
from ...core.carriers import by_carrier
from ...core.paths import ARRAYS, read_paths_file, save_paths
from ...core.stored import NOT_STORED, from_arrays, to_arrays
from ...core.types import FloatArray, IntArray
from ..options import TraceOptions
from ..search.chains import SPECULAR, PathInteractions
from ..search.surfaces import Surfaces, scene_surfaces
from ..sionna.materials import absorbs, at_frequency
from ..sionna.path_solver import Devices, Ends, path_gains
from ..sionna.scattering import scattering_coefficients, scattering_materials

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class TraceResult:
    """Paths with the settings and devices of their trace.

    Attributes:
        paths: the p paths.
        tx_pos_m: transmitters [n_tx, 3], metres.
        receivers: the ``n_rx`` receivers.
        primitives: triangle of the object at each interaction, int32, shape [p, depth], -1 beyond the last.
        probability: probability of each random interaction [p, depth], see
            `wrf_mi.tracing.search.chains.PathInteractions`.
        wedge: edges of diffraction, see `wrf_mi.tracing.search.chains.PathInteractions`; empty without diffraction.
        options: the options of the trace.
        rays: number of rays from each source; differs from ``options.rays`` where that is ``"auto"``.
        from_receivers: whether the search went from receivers to transmitters.
        frequency_hz: carrier frequency of the search.
        tx_antenna: antenna of the transmitters.
        carriers_hz: carrier frequency of the gains for each transmitter [n_tx]; None: ``frequency_hz``.
        lost: number of paths that are left out, as their gain is not a number.
    """

    paths: Paths = field(metadata=NOT_STORED)
    tx_pos_m: FloatArray
    receivers: tuple[Receiver, ...]
    primitives: NDArray[np.int32]
    probability: NDArray[np.float32]
    wedge: dict[str, NDArray[Any]]
    options: TraceOptions
    rays: int
    from_receivers: bool
    frequency_hz: float
    tx_antenna: Antenna = ANTENNA
    carriers_hz: FloatArray | None = None
    lost: int = 0

    @property
    def path_carriers_hz(self) -> FloatArray:
        """Carrier of each path's gain [p], Hz: that of its receiver if stated, else that of its transmitter."""
        rows = np.full(self.paths.n_tx, self.frequency_hz) if self.carriers_hz is None else self.carriers_hz
        receiver_hz = np.array([np.nan if rx.frequency_hz is None else rx.frequency_hz for rx in self.receivers])[
            self.paths.rx
        ]
        return np.where(np.isnan(receiver_hz), rows[self.paths.tx], receiver_hz)

    def select(self, which: NDArray[Any]) -> TraceResult:
        """The paths of a mask or of ascending indices ``which`` [p], of the same devices."""
        wedge = {name: values[which] for name, values in self.wedge.items()}
        paths, primitives, probability = self.paths.select(which), self.primitives[which], self.probability[which]
        return replace(self, paths=paths, primitives=primitives, probability=probability, wedge=wedge)

    def with_gains(self, gain: NDArray[np.complex128]) -> TraceResult:
        """The trace with gains [p]; paths whose gain is not a number are left out, counted and logged.

        `InputError`: no path has a gain.
        """
        finite_paths = paths_with_gain(gain)
        result = replace(self, paths=replace(self.paths, gain=gain), lost=self.lost + len(gain) - len(finite_paths))
        return result if len(finite_paths) == len(gain) else result.select(finite_paths)

    def unabsorbed(self, scene: Any) -> TraceResult:
        """The paths without gain zero: no absorber of the ``sionna.rt.Scene``, no mirror where all is scattered."""
        objects = scene.objects  # a copy in each access
        materials = [objects[name].radio_material for name in self.paths.object_names]
        all_scattered = {name for name, share in scattering_coefficients(scene).items() if share == 1}
        absorbing, rough = (
            np.isin(self.paths.objects, [number for number, material in enumerate(materials) if is_one(material)])
            for is_one in (absorbs, lambda material: material.name in all_scattered)
        )
        lost = (absorbing | (rough & (self.paths.interactions == SPECULAR))).any(axis=1)
        return self.select(np.flatnonzero(~lost)) if lost.any() else self

    def of_transmitters(self, which: IntArray) -> TraceResult:
        """The trace of the transmitters of indices ``which`` [n], in their order; an index may repeat."""
        paths = self.paths
        pair = paths.n_tx * paths.rx + paths.tx  # ascending, so that the paths of a pair are a range
        wanted = (paths.n_tx * np.arange(paths.n_rx)[:, None] + which).ravel()
        first, end = (np.searchsorted(pair, wanted, side) for side in ("left", "right"))
        # The paths of all wanted pairs, range after range: a path's number is its range's first plus its place in it.
        count = end - first
        row = np.repeat(np.arange(len(wanted)), count)
        selected = self.select(np.arange(len(row)) + (end - np.cumsum(count))[row])
        carriers = None if self.carriers_hz is None else self.carriers_hz[which]
        paths = replace(selected.paths, tx=row % len(which), n_tx=len(which))
        return replace(selected, paths=paths, tx_pos_m=self.tx_pos_m[which], carriers_hz=carriers)

    def of_receivers(self, which: IntArray) -> TraceResult:
        """The trace of the receivers of ascending indices ``which`` [n]."""
        selected = self.select(np.isin(self.paths.rx, which))
        paths = replace(selected.paths, rx=np.searchsorted(which, selected.paths.rx), n_rx=len(which))
        return replace(selected, paths=paths, receivers=tuple(self.receivers[number] for number in which))

    def legs(self, surfaces: Surfaces) -> PathInteractions:
        """The paths in the direction of the search, for Sionna RT; `InputError` of a scene that lacks an object."""
        paths, first = self.paths, np.zeros(len(self.paths.object_names) + 1, np.int64)
        for index, name in enumerate(paths.object_names):
            met = paths.objects == index
            if not met.any():
                continue
            if name not in surfaces.names:
                raise InputError(f"scene: no object {name!r}, which the saved paths meet; open the scene they are of")
            number = surfaces.names.index(name)
            first[index] = surfaces.first_face[number]
            # A triangle that the object does not have: a scene of the same names, but another one.
            if self.primitives[met].max() >= surfaces.first_face[number + 1] - first[index]:
                raise InputError(f"scene: object {name!r} is not the one that the saved paths meet; trace them anew")
        face = np.where(paths.objects >= 0, first[paths.objects] + self.primitives, -1)
        legs = PathInteractions(
            paths.tx, paths.rx, paths.interactions, face, paths.vertices_m, self.probability, self.wedge
        )
        return legs.reverse() if self.from_receivers else legs

    def ends(self) -> Ends:
        """Sources and targets, in the direction of the search."""
        transmitters, receivers = device_ends(self.tx_pos_m, self.receivers, self.tx_antenna)
        return (receivers, transmitters) if self.from_receivers else (transmitters, receivers)


def device_ends(tx_pos_m: FloatArray, receivers: tuple[Receiver, ...], tx_antenna: Antenna) -> Ends:
    """Transmitters and receivers as Sionna RT's devices."""
    antennas = tuple(receiver.antenna.mounted(receiver.orientation_xyzw) for receiver in receivers)
    rx = np.stack([receiver.position_m for receiver in receivers])
    return Devices(tx_pos_m, (tx_antenna.mounted(),)), Devices(rx, antennas)


def paths_with_gain(gain: NDArray[np.inexact[Any]]) -> IntArray:
    """Numbers [k] of the paths whose gains [p] (or amplitudes) are numbers; others are counted and logged.

    `InputError`: no path has a gain.
    """
    finite_paths = np.flatnonzero(np.isfinite(gain))
    if len(gain) and not len(finite_paths):
        raise InputError("gains that are not numbers: give materials constants that single precision can hold")
    if lost := len(gain) - len(finite_paths):
        logger.warning("%d of %d paths are left out: their gains are not numbers", lost, len(gain))
    return finite_paths


def gains_of_receivers(
    scene: Any,
    surfaces: Surfaces,
    legs: PathInteractions,
    ends: Ends,
    rays: int,
    receivers: Sequence[Receiver],
    receiver: IntArray,
) -> NDArray[np.complex128]:
    """Gains [p] of paths (`path_gains`) at the carrier of each path's receiver, whose number is ``receiver`` [p].

    Receivers without a carrier have that of the scene.
    """
    scene_hz = float(scene.frequency[0])
    carriers_hz = np.array([scene_hz if rx.frequency_hz is None else rx.frequency_hz for rx in receivers])

    def at_carrier(carrier_hz: float, which: IntArray) -> NDArray[np.complex128]:
        with at_frequency(scene, carrier_hz):
            return path_gains(scene, surfaces, legs.select(which), ends, rays)

    if len(receiver) == 0 or (carriers_hz == scene_hz).all():
        return path_gains(scene, surfaces, legs, ends, rays)
    return by_carrier(carriers_hz[receiver], at_carrier)


def recomputed_gains(traced: TraceResult, scene: Any) -> NDArray[np.complex128]:
    """Gains [p] of paths with the scene's present materials and frequency; arguments and errors of `recompute`."""
    surfaces = scene_surfaces(scene)
    with scattering_materials(scene, traced.options):
        legs = traced.legs(surfaces)
        receiver = legs.source if traced.from_receivers else legs.target
        return gains_of_receivers(scene, surfaces, legs, traced.ends(), traced.rays, traced.receivers, receiver)


def recompute(traced: TraceResult, scene: Any) -> TraceResult:
    """Recompute the gains of paths with the scene's present materials and frequency, without tracing again.

    Paths whose gain is not a number are left out (`TraceResult.with_gains`).

    Args:
        traced: from `wrf_mi.tracing.trace_paths` or `load_trace`, perhaps with other antennas.
        scene: a ``sionna.rt.Scene`` of the same geometry; `InputError` where it lacks an object that a path meets.
    """
    changed = replace(traced, frequency_hz=float(scene.frequency[0]), carriers_hz=None)
    return changed.with_gains(recomputed_gains(traced, scene))


def join_traces(parts: Sequence[TraceResult]) -> TraceResult:
    """Join traces of consecutive transmitters with the same receivers, scene and options."""
    first = parts[0]
    starts = np.cumsum([0, *(part.paths.n_tx for part in parts)])
    tx = np.concatenate([part.paths.tx + start for part, start in zip(parts, starts[:-1], strict=True)])

    def joined(name: str) -> NDArray[Any]:
        return np.concatenate([attrgetter(name)(part) for part in parts])

    # Stable: the paths of a pair of devices all come from one part and keep their order.
    order = np.lexsort((tx, joined("paths.rx")))
    arrays: dict[str, Any] = {name: joined(f"paths.{name}")[order] for name in ARRAYS if name != "tx"}
    return replace(
        first,
        paths=replace(first.paths, tx=tx[order], n_tx=int(starts[-1]), **arrays),
        tx_pos_m=joined("tx_pos_m"),
        primitives=joined("primitives")[order],
        probability=joined("probability")[order],
        wedge={name: np.concatenate([part.wedge[name] for part in parts])[order] for name in first.wedge},
        carriers_hz=None if first.carriers_hz is None else joined("carriers_hz"),
        lost=sum(part.lost for part in parts),
    )


def save_trace(file: str | Path, traced: TraceResult) -> Path:
    """Write a trace to an ``.npz`` of plain arrays that `wrf_mi.core.load_paths` reads too."""
    return save_paths(file, traced.paths, to_arrays(traced))


def load_trace(file: str | Path) -> TraceResult:
    """Read a file of `save_trace`; `InputError` of one that is missing, damaged, or holds paths without their trace."""
    paths, arrays = read_paths_file(file)
    try:
        return from_arrays(TraceResult, arrays, paths=paths)
    except ValueError as error:
        raise InputError(f"{file}: holds paths alone, not how they were traced ({error}); trace them anew") from None


def without_faint(tx: IntArray, amplitude: FloatArray, share: float) -> NDArray[np.bool_]:
    """Mask of paths without the weakest of each transmitter, whose amplitudes add up to less than a share of all."""
    # That bounds the error of a sum of the paths, whatever their phases.
    # Cumulative sums of ascending amplitudes, transmitter by transmitter.
    order = np.lexsort((amplitude, tx))
    ordered, upto = tx[order], np.cumsum(amplitude[order])
    first = np.searchsorted(ordered, ordered)
    upto -= (upto - amplitude[order])[first]  # sum of a transmitter's weaker paths and the path itself
    strong = np.empty(len(tx), bool)
    strong[order] = upto >= share * np.bincount(tx, amplitude)[ordered]
    return strong
