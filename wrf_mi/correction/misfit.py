"""Residuals of traced observations over the rows of a record, and their derivatives by parameters of the scene.

Spectra are compared on a lattice of at most `LATTICE` directions, as an array of few elements has few independent
ones; traced and measured spectra are scaled to their extremes there. Channels are divided by the root mean square of a
row's, as their score is relative, and of a median row's, as rows in deep fades have errors too.
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
from scipy.sparse import coo_array

from ..backend.device import Recorded, to_tensor, to_uint
from ..core import Record
from ..core.carriers import rows_by_carrier
from ..core.types import FloatArray, IntArray
from ..receivers import minmax_scale
from ..receivers.registry import RECEIVERS, ObservationSpec
from ..tasks.conditions import placed_receivers
from ..tracing.paths.corrected_scene import MovedSearch
from ..tracing.paths.instrument_parameters import instrument_parameters
from ..tracing.paths.scene_parameters import PREFIX, QUANTITIES, SHIFT, TILT
from ..tracing.paths.solve import Prepared
from ..tracing.paths.traced_field import TracedField, trace_fields
from .least_squares import Derivatives, Jacobian, Residuals
from .options import CorrectionOptions

LATTICE = (12, 40)  # most elevations and azimuths of the lattice of directions
FLOOR = 0.5  # share of a median row's magnitude that is added to each row's own, as squares, in the unit of channels


class PathTable(NamedTuple):
    """The n paths of a misfit, and what they meet [n, depth]."""

    entry: IntArray  # place among the entries of the port's `wrf_mi.receivers.device_paths.TracedPaths` [n]
    port: IntArray  # number of the port [n], ascending
    row: IntArray  # row of `Misfit.residual` [n], ascending in a port
    plane: IntArray  # place in `Misfit.planes`, -1 for none
    slab: IntArray  # place in `Misfit.slabs`, -1 for none
    reflects: NDArray[np.bool_]  # whether the path is reflected there


class _Port:
    """A receiver at a carrier: its traced field, receiver models of what is compared and of complete images (which are
    scored), its rows' places in ``Misfit.observed``, and recorded functions of parameters by name.
    """

    def __init__(self, traced_field: TracedField, model: Any, complete: Any, places: IntArray) -> None:
        self.traced_field, self.model, self.complete, self.places = traced_field, model, complete, places

    def record(self, start: Mapping[str, Any]) -> None:
        """Make the functions; arrays made from NumPy's memory at first use must exist before they are recorded."""
        traced_field, model = self.traced_field, self.model

        def predict(params: Mapping[str, Any]) -> Any:  # flat observations of all rows
            with dr.suspend_grad():
                predicted = model(traced_field(params), None)
                dr.eval(predicted)
            return predicted

        # Derivatives of observations in one direction: forward mode, as rows outnumber the columns of a Jacobian.
        def tangent(params: Mapping[str, Any], direction: Mapping[str, Any]) -> Any:
            # Gradients of the caller's arrays stay off: all columns share them, and one recording.
            values = {name: dr.copy(value) for name, value in params.items()}
            for name, value in values.items():
                dr.enable_grad(value)
                dr.set_grad(value, direction[name])
            predicted = model(traced_field(values), None)
            dr.forward_to(predicted)
            slope = dr.grad(predicted)
            dr.eval(slope)
            return slope

        def gain(params: Mapping[str, Any], entries: Any) -> Any:  # of paths by their places in the field
            with dr.suspend_grad():
                gains = traced_field(params, entries=entries).gain
                dr.eval(gains)
            return gains

        model.arrays(mi.Float)
        predict(start)
        self.predict, self.tangent = (
            Recorded(function, lambda: [traced_field.arrays, model.arrays(mi.Float)]) for function in (predict, tangent)
        )
        self.gain = Recorded(gain, lambda: traced_field.arrays)


class Misfit:
    """Observations of the paths of some rows of a record, as a function of a vector of parameters.

    ``prepared`` is the shared state of the scene, at the record's carrier or, of several, at the one at which
    parameters of materials hold; ``options`` say which parameters of `TracedField.parameters` are entries of the
    vector. Paths are ``searched`` in another scene than the stated one, if there is one. ``surfaces``: numbers of
    planes and of surfaces that have parameters though no path meets them, all others have none; None: all have.
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
        self.record, self.rows, self._task = record, rows, record.task
        self._traced = replace(options.traced, tx_antenna=record.tx_antenna)
        self.tables = prepared.tables(self._traced.materials)  # materials and planes of the scene
        placed = placed_receivers(record, by_uplink=False)
        # Receivers without any observation are not traced, though their parameters are entries of the vector: some
        # hundred others may have heard these rows.
        observed = np.isfinite(record.observation[:, rows]).reshape(len(placed), -1).any(axis=1)
        numbers = np.flatnonzero(observed) if observed.any() else np.arange(len(placed))
        self.receivers = [placed[number] for number in numbers]
        self._size = self._task.image_size(record.observation.shape[2:])
        self._strides = [_stride(n, most) for n, most in zip(self._size, LATTICE, strict=False)]  # none of no image
        self.ports = self._traced_ports(numbers, prepared, searched)  # receiver by receiver, at each carrier
        # Numbers of the scene's planes and of its surfaces whose parameters are entries of the vector, in their order.
        self.planes, self.slabs = np.arange(len(prepared.surfaces.normal)), np.arange(len(self.tables.slabs.names))
        if surfaces is not None:
            self.planes, self.slabs = _met_surfaces(self.traced_fields, len(self.planes), len(self.slabs), *surfaces)
            tables = self.tables.select(prepared.surfaces, self.planes, self.slabs)
            for port in self.ports:
                port.traced_field = port.traced_field.select(tables, self.planes, self.slabs)
        self._instruments = dict[str, NDArray[np.float32]]()
        for receiver in placed:
            self._instruments |= instrument_parameters(receiver, self._traced.pattern_degree)
        self._lay_out(options)
        self.observed, self.unit = self._observations()  # [n_rx * rows, values], NaN for none, and [n_rx * rows]
        for port in self.ports:
            port.record(self._device(self.start))

    def _lay_out(self, options: CorrectionOptions) -> None:
        """Positions of parameters in the vector, one after the other, and their stated values ``start`` [p]."""
        # Materials, planes and devices in an order that is the same whichever receivers have rows.
        of_scene = self.traced_fields[0].parameters().items()
        values = {name: value for name, value in of_scene if name.startswith((PREFIX, SHIFT, TILT))} | self._instruments
        values = {name: value for name, value in values.items() if options.changes(name)}
        self._shapes = {name: value.shape for name, value in values.items()}
        bounds = np.cumsum([0, *map(np.size, values.values())])
        self.slices = {name: slice(*bounds[i : i + 2]) for i, name in enumerate(values)}
        self.start = np.concatenate([*map(np.ravel, values.values())]).astype(float)

    @property
    def traced_fields(self) -> list[TracedField]:
        """Traced fields of the ports."""
        return [port.traced_field for port in self.ports]

    def _traced_ports(self, numbers: IntArray, prepared: Prepared, searched: MovedSearch | None) -> list[_Port]:
        """Ports of the receivers, which have these numbers in the record."""
        record, rows, task = self.record, self.rows, self._task
        height, width = self._size or (1, 1)
        size = tuple(n // stride for n, stride in zip((height, width), self._strides or (1, 1), strict=True))
        floor_db, outputs = task.floor_db(record.observation[:, rows]), task.outputs(record.observation.shape[2:])
        form = ObservationSpec(
            task.receiver_with_scene, (size[0], size[1]), record.frequencies_hz, outputs, floor_db=floor_db
        )
        heading, carriers = (None if p is None else p[rows] for p in (record.tx_heading_rad, record.carriers_hz))
        ports, make = list[_Port](), RECEIVERS[form.receiver].of
        for number, receiver in zip(numbers, self.receivers, strict=True):
            of_receiver = record.tx_pos_m[rows], receiver, self._traced, prepared, heading, carriers
            traced_fields = trace_fields(*of_receiver, searched=searched)
            for traced_field, (carrier_hz, which) in zip(
                traced_fields, rows_by_carrier(carriers, len(rows)), strict=True
            ):
                at = form if carrier_hz is None else replace(form, frequencies_hz=np.array([carrier_hz]))
                models = make(at, receiver), make(replace(at, size=(height, width)), receiver)
                ports.append(_Port(traced_field, *models, number * len(rows) + which))
        return ports

    def of_scene(self, vector: FloatArray) -> dict[str, FloatArray]:
        """Parameters of a vector [p] by name, for all planes and surfaces of the scene: others are as stated."""
        # Of planes and surfaces that have no entry, the stated values.
        stated_parameters = self.tables.slabs.parameters(QUANTITIES) | self.tables.planes.parameters()
        parameters = {name: vector[span].reshape(self._shapes[name]) for name, span in self.slices.items()}
        for name in stated_parameters.keys() & parameters.keys():
            every = stated_parameters[name].astype(float)
            every[self.slabs if name.startswith(PREFIX) else self.planes] = parameters[name]
            parameters[name] = every
        return parameters

    def vector_of(self, parameters: Mapping[str, FloatArray]) -> FloatArray:
        """The vector [p] of parameters of the whole scene, as of `of_scene` of a misfit of other rows."""
        vector = np.zeros(len(self.start))
        for name, span in self.slices.items():
            numbers = self.slabs if name.startswith(PREFIX) else self.planes
            chosen = parameters[name] if name in self._instruments else parameters[name][numbers]
            vector[span] = chosen.ravel()
        return vector

    def _observations(self) -> tuple[FloatArray, FloatArray]:
        """Observations and their units [n_rx * rows], in which residuals are."""
        stored = self.record.observation[:, self.rows]
        count = stored.shape[0] * stored.shape[1]
        if self._strides:
            # A model's coarse image has its extremes on the lattice, not between, so the observed one is scaled there.
            coarse = minmax_scale(stored[:, :, :: self._strides[0], :: self._strides[1]].astype(float))
            return coarse.reshape(count, -1), np.ones(count)
        if np.iscomplexobj(stored):
            # Real and imaginary parts in turn, as receiver models observe channels.
            pairs = np.ascontiguousarray(stored, np.complex128).view(float).reshape(count, -1)
            power = np.square(pairs).sum(axis=1)
            # The score is relative to a row's own power, but rows in deep fades have the errors of all others.
            unit = np.sqrt(power + FLOOR**2 * np.nanmedian(power))
            return pairs / unit[:, None], unit
        return stored.astype(float).reshape(count, -1), np.ones(count)

    @property
    def several_carriers(self) -> bool:
        """Whether rows of several carriers tell how conductivities depend on the frequency."""
        return len({port.traced_field.frequency_hz for port in self.ports}) > 1

    def named(self, vector: FloatArray) -> dict[str, NDArray[np.float32]]:
        """Parameters of a vector [p] by name."""
        shaped = ((name, vector[span].reshape(self._shapes[name])) for name, span in self.slices.items())
        return {name: np.ascontiguousarray(values, np.float32) for name, values in shaped}

    def _device(self, vector: FloatArray) -> dict[str, Any]:
        return {name: to_tensor(value) for name, value in self.named(vector).items()}

    def residual(self, vector: FloatArray) -> FloatArray:
        """Predictions of a vector [p] less observations: [n_rx * rows, values], NaN where nothing was received."""
        params, predicted = self._device(vector), np.zeros(self.observed.shape)
        for port in self.ports:
            predicted[port.places] = np.asarray(port.predict(params).numpy(), float).reshape(len(port.places), -1)
        return predicted / self.unit[:, None] - self.observed

    def mean_squares(self, vectors: FloatArray) -> FloatArray:
        """Means of each row's squares of `residual` at vectors [v, p], [v, n_rx * rows]."""
        return np.stack([np.square(self.residual(vector)).mean(axis=1) for vector in vectors])

    def missing_gains(self, vector: FloatArray) -> dict[str, float]:
        """Logarithm of the amplitude that each receiver's predictions lack, over its carriers, by name of its gain."""
        # Least squares of a phase start from equal mean magnitudes, else the smallest predictions would fit best.
        missing = dict[str, list[float]]()
        if not any(port.traced_field.gain_name in self.slices for port in self.ports):
            return {}
        predicted = self.residual(vector) + self.observed
        for port in self.ports:
            rows = port.places[np.isfinite(self.observed[port.places]).all(axis=1)]
            if len(rows):
                pair = (values[rows].reshape(-1, *port.model.shape) for values in (predicted, self.observed))
                missing.setdefault(port.traced_field.gain_name, []).append(port.model.missing_gain(*pair))
        return {name: float(np.mean(values)) for name, values in missing.items()}

    @cached_property
    def paths(self) -> PathTable:
        """Rows, ports and interactions of all paths, one after the other."""
        depth = max(len(field.chains.levels) for field in self.traced_fields)
        entries = [np.flatnonzero(field.exists) for field in self.traced_fields]
        ports = zip(self.ports, entries, strict=True)
        # Entries lie transmitter by transmitter, an equal number of each.
        row = [port.places[exists // (len(port.traced_field.exists) // len(port.places))] for port, exists in ports]
        met = zip(*(field.chains.met(depth) for field in self.traced_fields), strict=True)
        number = np.repeat(np.arange(len(entries)), [len(places) for places in entries])
        return PathTable(np.concatenate(entries), number, np.concatenate(row), *map(np.concatenate, met))

    @cached_property
    def apart(self) -> list[IntArray]:
        """Groups of places in `slabs`, no two of which are met by the same path."""
        met = [(np.flatnonzero(at >= 0), at[at >= 0]) for at in self.paths.slab.T]
        path, slab = (np.concatenate(each) for each in zip(*met, strict=True))
        meets = coo_array((np.ones(len(path)), (path, slab)), (len(self.paths.row), len(self.slabs))).tocsr()
        together, groups = (meets.T @ meets).astype(bool), list[list[int]]()
        # Greedy colouring, those that share paths with most others first (Welsh and Powell, 1967).
        for place in np.argsort(-together.sum(axis=1), kind="stable").tolist():
            others = set(together.indices[together.indptr[place] : together.indptr[place + 1]].tolist())
            free = next((group for group in groups if others.isdisjoint(group)), None)
            if free is None:
                groups.append(free := [])
            free.append(place)
        return [np.array(group) for group in groups]

    def gains(self, vector: FloatArray, which: IntArray) -> NDArray[np.complex128]:
        """Gains of a vector [p], without exp(-j k length), of the paths ``which`` of `paths`, ascending."""
        params, result, paths = self._device(vector), np.zeros(len(which), complex), self.paths
        for number in np.unique(paths.port[which]):
            of_port = paths.port[which] == number
            real, imaginary = self.ports[number].gain(params, to_uint(paths.entry[which[of_port]]))
            result[of_port] = np.asarray(real) + 1j * np.asarray(imaginary)
        return result

    def unit_signals(self, vector: FloatArray) -> NDArray[np.complex128]:
        """Signals [paths, elements] of all paths of a vector [p] at an array's elements, for gains of one."""
        params, signals = self._device(vector), list[NDArray[np.complex128]]()
        for number, port in enumerate(self.ports):
            entry = self.paths.entry[self.paths.port == number]
            if not len(entry):
                continue
            with dr.suspend_grad():
                traced = port.traced_field(params, entries=to_uint(entry))
                unit_gain = dr.ones(type(traced.length_m), len(entry))
                # Each path as a transmitter's only one, so that the sum at the elements is its wave.
                alone = replace(traced, gain=(unit_gain, dr.zeros(type(unit_gain), len(entry))))
                real, imaginary = port.model.elements(alone, type(unit_gain))
            signals.append((np.asarray(real) + 1j * np.asarray(imaginary)).reshape(len(entry), -1))
        return np.concatenate(signals)

    def within(self, start: FloatArray, places: IntArray) -> tuple[Residuals, Derivatives]:
        """`residual`, and `jacobian` by the entries ``places``, as of `PathSum.within`: of all rows."""
        return self.residual, lambda vector: self.jacobian(vector, places)

    def jacobian(self, vector: FloatArray, columns: IntArray) -> Jacobian:
        """Derivatives of `residual` by some entries."""
        slopes = np.zeros((len(columns), *self.observed.shape), np.float32)
        params = self._device(vector)
        for place, column in enumerate(columns):
            direction = self._device(np.eye(1, len(vector), column)[0])  # a unit vector, column by column
            for port in self.ports:
                slopes[place, port.places] = port.tangent(params, direction).numpy().reshape(len(port.places), -1)
        slopes /= self.unit[:, None].astype(np.float32)
        slopes[:, ~np.isfinite(self.observed).all(axis=1)] = 0
        return Jacobian(slopes)

    def predicted(self, vector: FloatArray) -> NDArray[Any]:
        """Complete observations predicted by a vector [p], [n_rx, rows, ...]; NaN of receivers that have none."""
        params, stored = self._device(vector), self.record.observation[:, self.rows]
        kind = complex if np.iscomplexobj(stored) else float
        predicted = np.full((len(self.observed), *stored.shape[2:]), np.nan, kind)
        for port in self.ports:
            with dr.suspend_grad():
                values = np.asarray(port.complete(port.traced_field(params), None).numpy(), float)
            predicted[port.places] = values.view(kind).reshape(-1, *stored.shape[2:])
        return predicted.reshape(stored.shape)

    def scores(self, vector: FloatArray) -> FloatArray:
        """Scores of the task of complete observations, [n_rx * rows]; NaN where nothing was received."""
        pairs = zip(self.predicted(vector), self.record.observation[:, self.rows], strict=True)
        return np.concatenate([self._task.of_rows(predicted[None], truth[None])[0] for predicted, truth in pairs])

    def accept(self, vector: FloatArray) -> None:
        """Nothing, as residuals are exact at all vectors (`wrf_mi.correction.path_sum.PathSum.accept`)."""

    @property
    def plane_entries(self) -> IntArray:
        """Entries of the vector that are the planes' shifts, then their tilts; none where planes are not parameters."""
        spans = [self.slices[name] for name in (SHIFT, TILT) if name in self.slices]
        return np.concatenate([np.zeros(0, np.int64), *(np.arange(span.start, span.stop) for span in spans)])

    def counts(self) -> tuple[IntArray, IntArray]:
        """Number of paths that each of `planes` reflects, and that meet each of `slabs`, over all receivers."""
        paths = self.paths
        reflecting, met = paths.plane[paths.reflects], paths.slab[paths.slab >= 0]
        return np.bincount(reflecting, minlength=len(self.planes)), np.bincount(met, minlength=len(self.slabs))


def _met_surfaces(
    traced_fields: Sequence[TracedField], plane_count: int, slab_count: int, planes: IntArray, slabs: IntArray
) -> tuple[IntArray, IntArray]:
    """Numbers of the planes and surfaces of a scene that paths meet, and of further ones, ascending."""
    # Of furniture of 100,000 facets, the paths of some rows meet hundreds: parameters of all would take gigabytes.
    used = np.zeros(plane_count, bool), np.zeros(slab_count, bool)
    for mask, further, column in zip(used, (planes, slabs), (0, 1), strict=True):
        mask[further] = True
        for traced_field in traced_fields:
            numbers = traced_field.chains.met(len(traced_field.chains.levels))[column]
            mask[numbers[numbers >= 0]] = True
        mask[:1] = True  # Dr.Jit gathers from no empty array
    return np.flatnonzero(used[0]), np.flatnonzero(used[1])


def _stride(length: int, most: int) -> int:
    """Smallest divisor of a length that leaves at most ``most`` values; 1 if it leaves less than a third of them."""
    smallest = next(stride for stride in range(1, length + 1) if length % stride == 0 and length // stride <= most)
    return smallest if 3 * (length // smallest) >= most else 1
