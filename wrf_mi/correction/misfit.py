"""Residuals of traced reports over the rows of a record, and their derivatives by parameters of the scene.

Spectra are compared on a lattice of at most `LATTICE` directions, as an array of few elements has few independent
ones; both sides are scaled to their extremes there. Channels are divided by the root mean square of a row's, as their
score is relative, and of a median row's, as rows in deep fades have errors too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..backend.device import to_tensor, to_uint
from ..backend.recorded import Recorded
from ..core import Record
from ..core.angles import FloatArray
from ..core.carriers import rows_by_carrier
from ..core.types import IntArray
from ..graph.receivers import RECEIVERS, Form
from ..receivers import minmax_scale
from ..receivers.receiver_models import ArrayReceiver
from ..tasks import task_of
from ..tasks.conditions import placed_receivers
from ..tracing.paths.corrected_scene import MovedSearch
from ..tracing.paths.instrument_parameters import instrument_parameters
from ..tracing.paths.material_parameters import PREFIX, QUANTITIES
from ..tracing.paths.plane_parameters import SHIFT, TILT
from ..tracing.paths.solve import Prepared
from ..tracing.paths.traced_field import TracedField, traced_fields
from .frame import rigid_motions, scene_entries
from .options import CorrectionOptions

LATTICE = (12, 40)
"""Most elevations and azimuths of the lattice of directions."""
FLOOR = 0.5
"""Share of a median row's magnitude that is added to each row's own, as squares, in the unit of channels."""


class PathTable(NamedTuple):
    """The n paths of a misfit.

    Attributes:
        entry: place of each path among the entries of its side's `wrf_mi.receivers.device_paths.TracedPaths` [n].
        side: number of its side [n], ascending.
        row: its row of `Misfit.residual` [n], ascending in a side.
        plane, slab: what it meets, by their places in `Misfit.planes` and `Misfit.slabs` [n, depth], -1 for none.
        reflects: whether it is reflected there [n, depth].
    """

    entry: IntArray
    side: IntArray
    row: IntArray
    plane: IntArray
    slab: IntArray
    reflects: NDArray[np.bool_]


class Misfit:
    """Reports of the paths of some rows, as a function of a vector of parameters.

    Args:
        record: measurements of any task.
        rows: rows that are compared.
        prepared: shared state of the scene, at the record's carrier or, of several, at the one at which parameters of
            materials hold.
        options: options of the search, and which parameters of `TracedField.parameters` are entries of the vector.
        searched: where paths are searched; None: in the scene as stated.
        surfaces: numbers of planes and of surfaces of the scene that have parameters though no path meets them; all
            others have none. None: all have parameters.

    Attributes:
        receivers: receivers that have an observation of one of the rows; paths to others are not searched, though their
            parameters are entries of the vector.
        tables: materials and planes of the scene.
        sides: traced side of each of these at each carrier, receiver by receiver.
        models: receiver models of the sides.
        places: entries of ``observed`` of each side.
        planes: numbers of the scene's planes whose shifts and tilts are entries of the vector, in their order.
        slabs: numbers of the scene's surfaces whose materials are.
        start: stated values of the vector [p].
        parts: slice of each parameter in the vector, by name.
        observed: observations [n_rx * rows, values] in the residuals' unit, NaN where nothing was received.
        unit: unit of each row's residuals [n_rx * rows].
    """

    def __init__(
        self,
        record: Record,
        rows: IntArray,
        prepared: Prepared,
        options: CorrectionOptions,
        searched: MovedSearch | None = None,
        surfaces: tuple[IntArray, IntArray] | None = None,
    ) -> None:
        self.record, self.rows, task = record, rows, task_of(record)
        placed = placed_receivers(record, by_uplink=False)
        known = np.isfinite(record.observation[:, rows]).reshape(len(placed), -1).any(axis=1)
        seen = np.flatnonzero(known) if known.any() else np.arange(len(placed))
        self.receivers = [placed[number] for number in seen]
        self._image = task.image
        traced = options.traced
        self.tables = prepared.tables(traced.materials)
        shape = record.observation.shape[2:]
        size, whole_size = (1, 1), (1, 1)
        if task.image:
            whole_size = int(shape[0]), int(shape[1])
            self._strides = [_stride(length, most) for length, most in zip(shape, LATTICE, strict=True)]
            size = whole_size[0] // self._strides[0], whole_size[1] // self._strides[1]
        outputs = tuple(map(int, shape)) if task.is_complex else ()
        floor_db = float(np.nanmin(record.observation[:, rows])) if task.in_decibel else np.nan
        form = Form(task.receiver_with_scene, size, record.frequencies_hz, outputs, floor_db=floor_db)
        sides, self.places = list[TracedField](), list[IntArray]()
        self.models, self._whole = list[Any](), list[Any]()
        heading, carriers = (None if p is None else p[rows] for p in (record.tx_heading_rad, record.carriers_hz))
        for number, receiver in zip(seen, self.receivers, strict=True):
            given = record.tx_pos_m[rows], receiver, traced, prepared, heading, carriers
            sides += traced_fields(prepared.scene, *given, searched=searched)
            for carrier_hz, which in rows_by_carrier(carriers, len(rows)):
                here = form if carrier_hz is None else replace(form, frequencies_hz=np.array([carrier_hz]))
                self.models.append(RECEIVERS[form.receiver].make(here, receiver))
                self._whole.append(RECEIVERS[form.receiver].make(replace(here, size=whole_size), receiver))
                self.places.append(number * len(rows) + which)
        # The same order of entries whichever receivers are seen.
        self._instruments = dict[str, NDArray[np.float32]]()
        for receiver in placed:
            self._instruments |= instrument_parameters(receiver, traced.pattern_degree)
        self.planes, self.slabs = np.arange(len(prepared.surfaces.normal)), np.arange(len(self.tables.slabs.names))
        if surfaces is not None:
            self.planes, self.slabs = _met_surfaces(sides, len(self.planes), len(self.slabs), *surfaces)
            tables = self.tables.select(prepared.surfaces, self.planes, self.slabs)
            sides = [side.select(tables, self.planes, self.slabs) for side in sides]
        self.sides = sides
        every = {name: value for name, value in sides[0].parameters().items() if name.startswith((PREFIX, SHIFT, TILT))}
        values = {name: value for name, value in (every | self._instruments).items() if options.changes(name)}
        self._shapes = {name: value.shape for name, value in values.items()}
        bounds = np.cumsum([0, *(value.size for value in values.values())])
        self.parts = {name: slice(*bounds[i : i + 2]) for i, name in enumerate(values)}
        self.start = np.concatenate([value.ravel() for value in values.values()]).astype(float)
        self.observed, self.unit = self._observations()
        self._reports = [self._recorded(r, tangent=False) for r in range(len(self.sides))]
        self._tangents = [self._recorded(r, tangent=True) for r in range(len(self.sides))]
        self._gains = [_recorded_gain(side) for side in self.sides]

    @cached_property
    def motions(self) -> FloatArray:
        """Derivatives of `plane_entries` by a rigid motion of the scene [3 k, 6] (`rigid_motions`)."""
        every = rigid_motions(self.sides[0].surfaces)
        return every[scene_entries(self.planes, len(every) // 3)]

    def of_scene(self, vector: FloatArray) -> dict[str, FloatArray]:
        """Parameters of a vector [p] by name, for all planes and surfaces of the scene: others are as stated."""
        stated = self.tables.slabs.parameters(QUANTITIES) | self.tables.planes.parameters()
        found = {name: vector[part].reshape(self._shapes[name]) for name, part in self.parts.items()}
        for name in stated.keys() & found.keys():
            every = stated[name].astype(float)
            every[self.slabs if name.startswith(PREFIX) else self.planes] = found[name]
            found[name] = every
        return found

    def vector_of(self, parameters: Mapping[str, FloatArray]) -> FloatArray:
        """The vector [p] of parameters of the whole scene, as of `of_scene` of a misfit of other rows."""
        every = np.zeros(len(self.start))
        for name, part in self.parts.items():
            numbers = self.slabs if name.startswith(PREFIX) else self.planes
            chosen = parameters[name] if name in self._instruments else parameters[name][numbers]
            every[part] = chosen.ravel()
        return every

    def _observations(self) -> tuple[FloatArray, FloatArray]:
        """Observations and their units [n_rx * rows], in which residuals are."""
        seen = self.record.observation[:, self.rows]
        count = seen.shape[0] * seen.shape[1]
        if self._image:
            coarse = minmax_scale(seen[:, :, :: self._strides[0], :: self._strides[1]].astype(float))
            return coarse.reshape(count, -1), np.ones(count)
        if np.iscomplexobj(seen):
            pairs = np.ascontiguousarray(seen, np.complex128).view(float).reshape(count, -1)
            power = np.square(pairs).sum(axis=1)
            unit = np.sqrt(power + FLOOR**2 * np.nanmedian(power))
            return pairs / unit[:, None], unit
        return seen.astype(float).reshape(count, -1), np.ones(count)

    @property
    def several_carriers(self) -> bool:
        """Whether rows of several carriers tell how conductivities depend on the frequency."""
        return len({side.frequency_hz for side in self.sides}) > 1

    def named(self, vector: FloatArray) -> dict[str, NDArray[np.float32]]:
        """Parameters of a vector [p] by name."""
        return {
            name: np.ascontiguousarray(vector[part].reshape(self._shapes[name]), np.float32)
            for name, part in self.parts.items()
        }

    def _device(self, vector: FloatArray) -> dict[str, Any]:
        return {name: to_tensor(value) for name, value in self.named(vector).items()}

    def _recorded(self, number: int, tangent: bool) -> Recorded:
        side, model = self.sides[number], self.models[number]

        def report(params: Mapping[str, Any]) -> Any:
            with dr.suspend_grad():
                found = model(side(params), None)
                dr.eval(found)
            return found

        def derivative(params: Mapping[str, Any], direction: Mapping[str, Any]) -> Any:
            # Gradients of the caller's arrays stay off: all columns share them, and one recording.
            values = {name: dr.copy(value) for name, value in params.items()}
            for name, value in values.items():
                dr.enable_grad(value)
                dr.set_grad(value, direction[name])
            found = model(side(values), None)
            dr.forward_to(found)
            slope = dr.grad(found)
            dr.eval(slope)
            return slope

        # Arrays that are made from NumPy's memory at first use must exist before a recording.
        model.arrays(mi.Float)
        report(self._device(self.start))
        return Recorded(derivative if tangent else report, lambda: [side.arrays, model.arrays(mi.Float)])

    def residual(self, vector: FloatArray) -> FloatArray:
        """Reports minus observations of a vector [p]: [n_rx * rows, values], NaN where nothing was received."""
        params, found = self._device(vector), np.zeros(self.observed.shape)
        for report, places in zip(self._reports, self.places, strict=True):
            found[places] = np.asarray(report(params).numpy(), float).reshape(len(places), -1)
        return found / self.unit[:, None] - self.observed

    def mean_squares(self, vectors: FloatArray) -> FloatArray:
        """Means of each row's squares of `residual` at vectors [v, p], [v, n_rx * rows]."""
        return np.stack([np.square(self.residual(vector)).mean(axis=1) for vector in vectors])

    @cached_property
    def paths(self) -> PathTable:
        """Rows, sides and interactions of all paths, side by side."""
        depth = max(len(side.chains.levels) for side in self.sides)
        entries = [np.flatnonzero(side.exists) for side in self.sides]
        sides = zip(self.sides, self.places, entries, strict=True)
        row = [places[exists // (len(side.exists) // len(places))] for side, places, exists in sides]
        met = zip(*(side.chains.met(depth) for side in self.sides), strict=True)
        number = np.repeat(np.arange(len(entries)), [len(places) for places in entries])
        return PathTable(np.concatenate(entries), number, np.concatenate(row), *map(np.concatenate, met))

    def gains(self, vector: FloatArray, which: IntArray) -> NDArray[np.complex128]:
        """Gains of a vector [p], without exp(-j k length), of the paths ``which`` of `paths`, ascending."""
        params, result, paths = self._device(vector), np.zeros(len(which), complex), self.paths
        for number in np.unique(paths.side[which]):
            of_side = paths.side[which] == number
            real, imaginary = self._gains[number](params, to_uint(paths.entry[which[of_side]]))
            result[of_side] = np.asarray(real) + 1j * np.asarray(imaginary)
        return result

    def unit_signals(self, vector: FloatArray) -> NDArray[np.complex128]:
        """Signals [paths, elements] of all paths of a vector [p] at an array's elements, for gains of one."""
        params, signals = self._device(vector), list[NDArray[np.complex128]]()
        for number, (side, model) in enumerate(zip(self.sides, self.models, strict=True)):
            assert isinstance(model, ArrayReceiver)
            entry = self.paths.entry[self.paths.side == number]
            if not len(entry):
                continue
            with dr.suspend_grad():
                traced = side(params, entries=to_uint(entry))
                one = dr.ones(type(traced.length_m), len(entry))
                alone = replace(traced, gain=(one, dr.zeros(type(one), len(entry))))
                real, imaginary = model.elements(alone, type(one))
            signals.append((np.asarray(real) + 1j * np.asarray(imaginary)).reshape(len(entry), -1))
        return np.concatenate(signals)

    def jacobian(self, vector: FloatArray, columns: IntArray) -> NDArray[np.float32]:
        """Derivatives [columns, n_rx * rows, values] of `residual`, 0 where nothing was received."""
        slopes = np.zeros((len(columns), *self.observed.shape), np.float32)
        params = self._device(vector)
        for place, column in enumerate(columns):
            direction = self._device(np.eye(1, len(vector), column)[0])
            for tangent, places in zip(self._tangents, self.places, strict=True):
                slopes[place, places] = tangent(params, direction).numpy().reshape(len(places), -1)
        slopes /= self.unit[:, None].astype(np.float32)
        slopes[:, ~np.isfinite(self.observed).all(axis=1)] = 0
        return slopes

    def scores(self, vector: FloatArray) -> FloatArray:
        """Scores of the task of whole reports, [n_rx * rows]; NaN where nothing was received."""
        task, params = task_of(self.record), self._device(vector)
        seen = self.record.observation[:, self.rows]
        seen = seen.reshape(-1, *seen.shape[2:])
        found = np.full(len(seen), np.nan)
        for side, model, places in zip(self.sides, self._whole, self.places, strict=True):
            with dr.suspend_grad():
                report = model(side(params), None).numpy()
            truth, pairs = seen[places], np.asarray(report, float)
            values = pairs.view(complex) if np.iscomplexobj(truth) else pairs
            found[places] = task.score(values.reshape(truth.shape), truth)
        return found

    def accept(self, vector: FloatArray) -> None:
        """Nothing, as residuals are exact at all vectors (`wrf_mi.correction.path_sum.PathSum.accept`)."""

    @property
    def plane_entries(self) -> IntArray:
        """Entries of the vector that are the planes' shifts, then their tilts; none where planes are not parameters."""
        parts = [self.parts[name] for name in (SHIFT, TILT) if name in self.parts]
        return np.concatenate([np.zeros(0, np.int64), *(np.arange(part.start, part.stop) for part in parts)])

    def counts(self) -> tuple[IntArray, IntArray]:
        """Number of paths that each plane of ``planes`` reflects, and that meet each slab of ``slabs``, over all
        receivers.
        """
        paths = self.paths
        reflecting, met = paths.plane[paths.reflects], paths.slab[paths.slab >= 0]
        return np.bincount(reflecting, minlength=len(self.planes)), np.bincount(met, minlength=len(self.slabs))


def _met_surfaces(
    sides: Sequence[TracedField], plane_count: int, slab_count: int, planes: IntArray, slabs: IntArray
) -> tuple[IntArray, IntArray]:
    """Numbers of the planes and surfaces of a scene that paths meet, and of further ones, ascending.

    Of furniture of 100,000 facets, the paths of some rows meet hundreds.
    """
    used = np.zeros(plane_count, bool), np.zeros(slab_count, bool)
    for mask, further, column in zip(used, (planes, slabs), (0, 1), strict=True):
        mask[further] = True
        for side in sides:
            numbers = side.chains.met(len(side.chains.levels))[column]
            mask[numbers[numbers >= 0]] = True
        mask[:1] = True  # Dr.Jit gathers from no empty array
    return np.flatnonzero(used[0]), np.flatnonzero(used[1])


def _recorded_gain(side: TracedField) -> Recorded:
    """Function of parameters and of places of paths: real and imaginary parts of their gains."""

    def gain(params: Mapping[str, Any], entries: Any) -> Any:
        with dr.suspend_grad():
            found = side(params, entries=entries).gain
            dr.eval(found)
        return found

    return Recorded(gain, lambda: side.arrays)


def _stride(length: int, most: int) -> int:
    """Smallest divisor of a length that leaves at most ``most`` values; 1 if it leaves less than a third of them."""
    found = next(stride for stride in range(1, length + 1) if length % stride == 0 and length // stride <= most)
    return found if 3 * (length // found) >= most else 1
