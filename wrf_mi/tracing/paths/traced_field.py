"""Traced paths with derivatives: gains, lengths and directions of Sionna RT's paths follow parameters.

The search for the surfaces that a wave meets (`wrf_mi.tracing.trace_paths`) has no derivative; its result is kept. The
image method and the field along each path are evaluated in each call (`wrf_mi.tracing.paths.field_calculator`) with the
present parameters, in float64: phases k d are exact to 1e-12 rad for the scene as stated (the float32 corners of its
files are exact to 5e-7 m at 10 m).

Paths appear and vanish as a receiver moves, without a derivative: the set of paths is kept until the receiver is
further than a quarter of a wavelength from the position of the search; `TracedField.refresh` then searches again.
Planes that move keep their paths (`wrf_mi.tracing.paths.scene_parameters`).
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, field, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.constants import speed_of_light

from ...backend.device import columns_on_device, on_device
from ...backend.vectors import Float64, times
from ...core import Antenna, InputError, Receiver
from ...core.antenna import ANTENNA
from ...core.carriers import rows_by_carrier
from ...core.counts import count
from ...core.types import FloatArray, IntArray
from ...receivers.device_paths import TracedPaths
from ...receivers.spreads import PathStatistics
from ..options import FACTOR, TraceOptions
from ..search.chains import SPECULAR, TRANSMISSION
from ..search.surfaces import Surfaces
from .corrected_scene import MovedSearch
from .field_calculator import Chains, EvaluatedPaths, Level, chains_of, evaluate_paths, pattern_tables
from .instrument_parameters import gain_name, instrument_parameters, moved_m, receiver_pose, spread_pose, with_antennas
from .result import TraceResult, paths_with_gain, without_faint
from .scene_parameters import TRAINED, MaterialGrouping, SceneTables, renumbered
from .solve import Prepared, trace_paths
from .surface_gaussians import Interactions, PathWeights, SurfaceGaussians

SINGLE = 16  # numbers of paths of a field's only transmitter are multiples of this, so that few recordings serve all


@dataclass(frozen=True)
class TracedOptions:
    """Options of a traced field."""

    # Options of the search, without diffraction and scattering, whose fields have no derivative here.
    trace: TraceOptions = field(default_factory=TraceOptions)
    pattern_degree: int = 0  # degree of the trainable factors of both antennas' patterns, 0 for none
    tx_antenna: Antenna = ANTENNA  # antenna of the transmitters, which turns with their heading
    materials: MaterialGrouping = "named"  # whether named materials have parameters, or surfaces, started from those
    planes: bool = False  # whether shifts and tilts of planes are parameters (`wrf_mi.tracing.paths.scene_parameters`)
    # The weakest paths of a transmitter are dropped while their amplitudes, with the materials of the search, add up to
    # less than this share of the amplitudes of all; 0: none.
    faint: float = 0.0
    constants: tuple[str, ...] = TRAINED  # constants of materials that are parameters, of `QUANTITIES`

    def __post_init__(self) -> None:
        """Check the options of the search; `InputError` with diffraction or scattering."""
        if self.trace.diffraction or self.trace.scattering:
            raise InputError("traced component: diffraction and scattering have no derivative here; switch both off")


class TracedField:
    """Traced field of transmitters at a receiver.

    Args:
        scene: from `wrf_mi.tracing.open_scene`; not changed.
        tx_pos_m: transmitters [n, 3], world frame, metres.
        receiver: stated pose.
        options: see `TracedOptions`.
        tx_heading_rad: yaw of each transmitter's frame about +z, rad, shape [n]; None: 0.
        traced: known paths from these transmitters to this receiver; None: paths are searched.
        prepared: shared state of the scene for several fields in it: rays of a receiver are then shot once, and the
            caller checks the antennas (`wrf_mi.tracing.paths.solve.Prepared.check`).
        frequency_hz: carrier of the paths; None: that of the receiver, or else of the scene, at which parameters of
            materials hold.
        searched_at_m: position [3] of the receiver in the search for the paths, metres; None: as stated.
        present: parameter values used to prune weak paths, Dr.Jit tensors by name; None: as stated.

    Raises:
        ValueError: headings of another shape or not finite.
        InputError: paths through a material that is not a slab.
    """

    def __init__(
        self,
        scene: Any,
        tx_pos_m: ArrayLike,
        receiver: Receiver,
        options: TracedOptions = TracedOptions(),
        tx_heading_rad: ArrayLike | None = None,
        *,
        traced: TraceResult | None = None,
        prepared: Prepared | None = None,
        frequency_hz: float | None = None,
        searched_at_m: FloatArray | None = None,
        present: Mapping[str, Any] | None = None,
    ) -> None:
        self.tx_pos_m: FloatArray = np.atleast_2d(np.asarray(tx_pos_m, float))
        heading = np.zeros(len(self.tx_pos_m)) if tx_heading_rad is None else np.asarray(tx_heading_rad, float)
        if heading.shape != (len(self.tx_pos_m),) or not np.isfinite(heading).all():
            raise ValueError(f"TracedField: tx_heading_rad has shape {heading.shape}; give finite [n]")
        self.scene, self.receiver, self.options, self.heading_rad = scene, receiver, options, heading
        self._shared, self._checks, self._present = prepared or Prepared(scene), prepared is None, present or {}
        self._gaussians: SurfaceGaussians | None = None
        self._weights: PathWeights | None = None
        antennas = receiver.antenna, options.tx_antenna
        self._patterns = pattern_tables(antennas[0], Float64), pattern_tables(antennas[1], Float64)
        self._stated_hz = float(scene.frequency[0])
        self.frequency_hz = float(frequency_hz or receiver.frequency_hz or self._stated_hz)
        self.searches = 0  # without that of ``traced``
        self.surfaces: Surfaces = self._shared.surfaces  # with the planes of the parameters
        position_m = receiver.position_m if searched_at_m is None else searched_at_m
        self._set_tables(self._shared.tables(options.materials))
        if traced is None:
            self.search(position_m)
        else:
            self._set_paths(traced, position_m)

    def __len__(self) -> int:
        """Number of transmitters."""
        return len(self.tx_pos_m)

    @property
    def exists(self) -> NDArray[np.bool_]:
        """Mask [n * each] of the entries of `TracedPaths` that are paths, not place holders."""
        return self.chains.exists.numpy() > 0

    @property
    def arrays(self) -> list[Any]:
        """Device arrays that a call reads beside its arguments, the inputs of a recording."""
        return [self.chains, self._constants, self._planes, self.bounces, self._weights, self._patterns]

    @property
    def form(self) -> tuple[int, int, int]:
        """Sizes that a recording has as constants: fields of equal forms differ in `arrays` alone."""
        return self._each, len(self.chains.levels), 0 if self._weights is None else self._weights.each

    @property
    def gain_name(self) -> str:
        """Name of the parameter of the instrument's gain."""
        return gain_name(self.receiver)

    def parameters(self) -> dict[str, NDArray[np.float32]]:
        """Initial values by name: the scene's materials, the stated pose, antenna patterns of factor one.

        ``material.<name>.permittivity`` and ``.conductivity`` [1], or of n surfaces ``material.surface.*`` [n]; with
        planes ``plane.shift`` [q] in m and ``plane.tilt`` [q, 2] in rad (`wrf_mi.tracing.paths.scene_parameters`);
        ``receiver.<name>.gain`` [2], ``.position`` [3] in m, ``.turn`` [3] in rad; with a degree of patterns,
        ``receiver.<name>.pattern`` and ``pattern.transmitter`` [2, c].
        """
        values = self.slabs.parameters(self.options.constants)
        values |= instrument_parameters(self.receiver, self.options.pattern_degree)
        if self.options.planes:
            values |= self._planes.parameters()
        return values

    def refresh(self, parameters: Mapping[str, Any]) -> bool:
        """Search for paths again if the receiver is too far from the position of the last search; whether it was."""
        position_m = moved_m(self.receiver, parameters)
        if not _needs_search(position_m, self.searched_at_m, self.frequency_hz):
            return False
        self.search(position_m)
        return True

    def __call__(self, parameters: Mapping[str, Any], rows: Any = None, entries: Any = None) -> TracedPaths:
        """Paths of some transmitters with the given parameters. Differentiable in all parameters.

        Of the transmitters ``rows`` (None: all), or in their place the paths ``entries`` by their places in `exists`,
        each as a transmitter's only path; both are unsigned integer arrays. Missing parameters keep their initial
        values.
        """
        # Which paths: those of the rows of a batch, single ones, or all.
        chains, batch, each, chosen = self.chains, len(self), self._each, entries
        if rows is not None:
            batch, chosen = dr.width(rows), self._entries_of(rows)
        if entries is not None:
            batch, each = dr.width(entries), 1
        if chosen is not None:
            chains = chains.select(chosen)
        paths = self._evaluated(chains, parameters)
        # Evaluated here so that the kernels of the reverse pass do not recompute it.
        dr.eval(paths)
        gain, length_m, departure, arrival = paths
        # Factors of the gain that no geometry depends on: instrument, patterns, Gaussians on surfaces.
        gain = with_antennas(gain, self.receiver, parameters, arrival, departure)
        if self._weights is not None and FACTOR in parameters:
            gain = times(gain, self._weights.factor(parameters[FACTOR], chosen))
        return TracedPaths(gain, length_m, arrival, batch, each)

    def _entries_of(self, rows: Any) -> Any:
        """Places of the paths of some transmitters, place holders included, [rows * each]."""
        slot = dr.arange(mi.UInt32, dr.width(rows) * self._each)
        return dr.gather(mi.UInt32, rows, slot // self._each) * self._each + slot % self._each

    def bounces_of(self, rows: Any) -> Any:
        """Square roots of the numbers of reflections of paths of some transmitters, or with None of all."""
        return self.bounces if rows is None else dr.gather(Float64, self.bounces, self._entries_of(rows))

    def _evaluated(self, chains: Chains, parameters: Mapping[str, Any]) -> EvaluatedPaths:
        """Paths with the given parameters but those of antennas and gain."""
        chains = replace(chains, levels=self._planes.move(chains.levels, parameters))
        tables = self.slabs.tables(parameters, self._constants, self.frequency_hz / self._stated_hz)
        pose = spread_pose(receiver_pose(self.receiver, parameters, Float64), dr.width(chains.exists))
        antennas = self.receiver.antenna, self.options.tx_antenna
        return evaluate_paths(chains, pose, tables, self.frequency_hz, *antennas, self._patterns)

    def statistics(self, parameters: Mapping[str, Any]) -> PathStatistics:
        """Statistics of each transmitter's paths with the given parameters but the instrument's gain."""
        with dr.suspend_grad():
            paths = self({name: values for name, values in parameters.items() if name != self.gain_name})
            gain, length_m, arrival = dr.detach((paths.gain, paths.length_m, paths.arrival))
        power = np.square(gain[0].numpy()) + np.square(gain[1].numpy())
        world = np.stack([part.numpy() for part in arrival], axis=-1) @ self.receiver.to_world.T
        transmitter = np.repeat(np.arange(len(self)), self._each)
        return PathStatistics.of_paths(transmitter, len(self), power, length_m.numpy(), world)

    def select(self, tables: SceneTables, planes: IntArray, slabs: IntArray) -> TracedField:
        """The same paths with parameters of some planes and materials alone, all those that paths meet among them."""
        # The result is not searched again: ``tables`` (`SceneTables.select`) have no other surfaces.
        result = copy(self)
        result._set_tables(tables)
        result.chains = replace(self.chains, levels=renumbered(self.chains.levels, planes, slabs))
        return result

    def _set_tables(self, tables: SceneTables) -> None:
        self.slabs, self._slab_of_face = tables.slabs, tables.slab_of_face
        self._constants, self._planes = tables.constants, tables.planes

    def attach(self, gaussians: SurfaceGaussians) -> None:
        """Let Gaussians on the surfaces change paths, by the parameter `wrf_mi.tracing.options.FACTOR`."""
        self._gaussians = gaussians
        count = len(self) * self._each
        self._weights = PathWeights.of(gaussians, self.interactions, self._path_of_met, count)

    def search(self, position_m: FloatArray) -> None:
        """Search for paths with the receiver at a position [3], world frame, metres."""
        receiver = replace(self.receiver, position_m=position_m)
        traced = _search(self.tx_pos_m, receiver, self.options, self._shared, self._checks)
        self._set_paths(traced, position_m)
        self.searches += 1

    def _set_paths(self, traced: TraceResult, position_m: FloatArray) -> None:
        """Lay out paths on the device, with as many entries for each transmitter as the largest number of paths."""
        surfaces, types, tx = self.surfaces, traced.paths.interactions, traced.paths.tx
        legs = traced.legs(surfaces)
        face = (legs.reverse() if traced.from_receivers else legs).face  # in the order from the transmitter
        if not np.isin(types, (0, SPECULAR, TRANSMISSION)).all():
            raise InputError("paths with diffraction or scattering have no derivative here; trace without them")
        chains = chains_of(surfaces, types, face, self._slab(face), self._source_columns(tx))
        # A gain that is not a number would make sums over all paths none. Weak paths cost as much as strong ones: those
        # that hardly count are dropped before they are laid out, too.
        amplitude = self._amplitudes(chains)
        strong = paths_with_gain(amplitude)
        strong = strong[without_faint(tx[strong], amplitude[strong], self.options.faint)]
        count("paths", len(strong), len(types) - len(strong))
        tx, types, face, vertices_m = tx[strong], types[strong], face[strong], traced.paths.vertices_m[strong]
        met_planes = np.unique(surfaces.plane[face[types != 0]]) if len(surfaces.plane) else face[:0, 0]
        count("planes", len(met_planes), len(surfaces.normal) - len(met_planes))
        # A rectangle of transmitters by paths, filled up with place holders: sums are then reductions of equal blocks.
        each = max(1, int(np.bincount(tx, minlength=1).max(initial=0)))
        if len(self) == 1:
            each = -(-each // SINGLE) * SINGLE
        entry = tx * each + np.arange(len(tx)) - np.searchsorted(tx, tx)  # paths are sorted by transmitter
        place, present = np.zeros(len(self) * each, np.uint32), np.zeros(len(self) * each, bool)
        place[entry], present[entry] = strong, True
        self._each, self.searched_at_m = each, np.array(position_m, float)
        # Points of interaction, which Gaussians on surfaces are near to; in the order of the entries.
        met = types != 0
        normal = surfaces.normal[np.append(surfaces.plane, 0)[face[met]]]
        self.interactions = Interactions(vertices_m[met], normal)
        self._path_of_met = np.broadcast_to(entry[:, None], types.shape)[met]
        if self._gaussians is not None:
            self.attach(self._gaussians)
        # Place holders have a transmitter, too: its heading is a rotation.
        sources = columns_on_device(self._source_columns(np.repeat(np.arange(len(self)), each)), Float64)
        # Uncertain phases of n reflections add as squares: their root is a factor (`TracedField.bounces_of`).
        bounces = np.zeros(len(place))
        bounces[entry] = np.sqrt((types == SPECULAR).sum(axis=1))
        self.bounces = on_device(bounces, Float64)
        self.chains = Chains(sources[:3], tuple(sources[3:]), dr.zeros(Float64, len(place)), [])
        if len(strong):
            index, mask = on_device(place, mi.UInt32), on_device(present, mi.Bool)
            self.chains.exists = dr.gather(Float64, chains.exists, index, mask)
            self.chains.levels = [dr.gather(Level, level, index, mask) for level in chains.levels]
        dr.eval(self.chains)

    def _source_columns(self, tx: IntArray) -> list[FloatArray]:
        """Coordinates of transmitters, and cosines and sines of their headings."""
        heading = self.heading_rad[tx]
        return [*self.tx_pos_m[tx].T, np.cos(heading), np.sin(heading)]

    def _amplitudes(self, chains: Chains) -> FloatArray:
        if not dr.width(chains.exists):
            return np.zeros(0)
        with dr.suspend_grad():
            real, imaginary = self._evaluated(chains, self._present)[0]
            power = real * real + imaginary * imaginary
        return np.asarray(np.sqrt(power.numpy()))

    def _slab(self, face: IntArray) -> IntArray:
        """Index of the material at each interaction, 0 for none (face -1)."""
        number = np.append(self._slab_of_face, 0)[face]  # the last one stands for face -1
        if (number < 0).any():
            index = self.surfaces.object_of(face[number < 0][:1])[0]
            name = self.surfaces.names[index]
            kind = self.scene.objects[name].radio_material.name
            raise InputError(f"object {name}: material {kind} is not a slab; give it one of ITU-R P.2040")
        return number


def _search(
    tx_pos_m: FloatArray, receiver: Receiver, options: TracedOptions, prepared: Prepared, check: bool
) -> TraceResult:
    """Paths without gains, which follow from the parameters."""
    how: dict[str, Any] = {"prepared": prepared, "tx_antenna": options.tx_antenna, "check": check, "gains": False}
    return trace_paths(prepared.scene, tx_pos_m, receiver, options.trace, **how)


def _needs_search(position_m: FloatArray, searched_at_m: FloatArray, frequency_hz: float) -> bool:
    """Whether a receiver is further than a quarter of a wavelength from where paths were searched, both [3], metres."""
    return bool(np.linalg.norm(position_m - searched_at_m) > speed_of_light / frequency_hz / 4)


def trace_fields(
    tx_pos_m: ArrayLike,
    receiver: Receiver,
    options: TracedOptions,
    prepared: Prepared,
    tx_heading_rad: ArrayLike | None = None,
    carriers_hz: FloatArray | None = None,
    *,
    parameters: Mapping[str, Any] | None = None,
    searched: MovedSearch | None = None,
) -> list[TracedField]:
    """Traced fields of the transmitters of each carrier at a receiver, in ascending order of the carriers.

    Paths are searched once for all carriers, and once at positions that repeat; wavelength and materials of a field are
    those of its carrier. Arguments and errors are those of `TracedField`, and ``carriers_hz``: carrier of each
    transmitter [n], Hz (None: that of the scene); ``parameters``: Dr.Jit tensors by the names of
    `TracedField.parameters`, where they move the receiver further than `TracedField.refresh` allows at a carrier, paths
    are searched from there (None: the stated pose); ``searched``: where paths are searched (None: in the stated scene).
    """
    positions = np.atleast_2d(np.asarray(tx_pos_m, float))
    heading = None if tx_heading_rad is None else np.asarray(tx_heading_rad, float)
    distinct, number = np.unique(positions, axis=0, return_inverse=True)
    number = number.reshape(-1)
    stated_m, moved_to_m = receiver.position_m, moved_m(receiver, parameters or {})
    place, present = (searched.prepared, searched.parameters) if searched else (prepared, None)
    traces, fields = dict[bool, TraceResult](), list[TracedField]()
    for carrier_hz, rows in rows_by_carrier(carriers_hz, len(positions)):
        # The stated position serves the carriers for which the receiver has not moved by a quarter of a wavelength.
        at_hz = carrier_hz or receiver.frequency_hz or float(prepared.scene.frequency[0])
        moved = _needs_search(moved_to_m, stated_m, at_hz)
        position_m = moved_to_m if moved else stated_m
        if moved not in traces:
            at = replace(receiver, position_m=position_m)
            traces[moved] = _search(distinct, at, options, place, check=False)
        traced, yaw = traces[moved].of_transmitters(number[rows]), None if heading is None else heading[rows]
        of_carrier = prepared.scene, positions[rows], receiver, options, yaw
        how: dict[str, Any] = {"traced": traced, "prepared": prepared, "frequency_hz": carrier_hz}
        fields.append(TracedField(*of_carrier, **how, searched_at_m=position_m, present=present))
    return fields
