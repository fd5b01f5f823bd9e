"""Reports of a trained graph's receivers for new transmitters."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..backend.device import to_float, to_tensor
from ..backend.recorded import Recorded
from ..core import InputError, Receiver, Record
from ..core.angles import FloatArray
from ..core.carriers import carriers_text, rows_by_carrier
from ..core.receivers import receiver_index
from ..core.types import IntArray
from ..gaussians.parameters import CHUNK_SIZE, Gaussians
from ..graph.graph import Alone, Batch, Field, Graph
from ..graph.receivers import PIXEL, Form
from ..receivers.spreads import PathStatistics, joined
from ..tasks.conditions import known_headings, known_uplink, normalised_uplink
from .reach import Reach
from .static_operator import StaticOperator
from .step import Params, evaluated, places_of

if TYPE_CHECKING:
    from ..tracing.paths.traced_field import TracedField

TOGETHER = 16
"""Transmitters whose Gaussians, or paths and Gaussians, are evaluated in one batch."""
TRACED_NUMBERS = 512
"""With paths, numbers in a batch of small observations."""
SEARCHED = 512
"""Transmitters of a carrier whose paths are searched together: a search has a fixed cost."""


class Predictor:
    """Evaluates one field for any receiver and image size.

    Args:
        field: the model.
        params: parameters of the field and of the traced side, as NumPy arrays.
        receivers: the receivers to predict for.
        height: rows of a spectrum.
        width: columns of a spectrum.
        operator: where the field's geometry and attenuation do not depend on the transmitter, predict by the linear map
            from signals to pixels (`wrf_mi.gaussians.operator`), built at the first prediction.
        store: folder in which operators are stored; None: in memory only.
        graph: graph of the field, these receivers and a scene; None: the field alone, with pixel receivers.
        reach: region in which the Gaussians are used; None: everywhere.
        phase_error: see `wrf_mi.graph.graph.Graph.report`.
    """

    def __init__(
        self,
        field: Field | None,
        params: Mapping[str, NDArray[np.float32]],
        receivers: Sequence[Receiver],
        height: int,
        width: int,
        operator: bool = False,
        store: Path | None = None,
        graph: Graph | None = None,
        reach: Reach | None = None,
        phase_error: float = 0.0,
    ) -> None:
        self.receivers, self.reach, self.phase_error = tuple(receivers), reach, phase_error
        self.graph = graph or Graph(field, receivers, Form(PIXEL, (height, width)))
        # Operator and recorded prediction give the splatted magnitude at each direction.
        self._recordable = self.graph.scene is None and self.graph.evaluation.recordable
        self._pixels = field is not None and self._recordable and self.graph.form.receiver == PIXEL
        self._places = places_of(self.graph)
        self._others: dict[float, Predictor] = {}
        self._field, self._count = field, -1
        single = self._pixels and self.graph.form.carriers_hz is None
        self._by_operator, self._store = operator and single and getattr(field, "static_geometry", False), store
        self._recordings: dict[tuple[Hashable, int], Recorded] = {}
        self._traced: dict[Hashable, TracedField] = {}
        self._together = 1 if self._pixels else TOGETHER
        self._still: StaticOperator | None = None
        self.update({name: to_tensor(values) for name, values in params.items()})

    def update(self, params: Params) -> None:
        """Replace the parameters (Dr.Jit tensors)."""
        count = params["position"].shape[1] if "position" in params else 0
        if count != self._count:
            # A recording is valid for one number of Gaussians.
            self._count, self._recordings = count, {}
        self._params, self._still = params, None
        dr.eval(self._params)
        for other in self._others.values():
            other.update(params)

    def gaussians(self, tx_pos_m: ArrayLike, log_carrier: float = 0.0) -> Gaussians:
        """The field's Gaussians for transmitter positions [m, 3] (metres), world frame.

        ``log_carrier`` is the logarithm of the carrier over the middle one of training (`Graph.log_carrier`), for
        fields that were trained on several carriers; others ignore it.
        """
        columns = np.ascontiguousarray(np.asarray(tx_pos_m, np.float32).reshape(-1, 3).T)
        if self.graph.form.carriers_hz is not None:
            columns = np.vstack([columns, np.full((1, columns.shape[1]), log_carrier, np.float32)])
        if self._field is None:
            raise ValueError("paths alone: there are no Gaussians")
        return self._field.gaussians(self._params, to_tensor(columns)).spread()

    def static_geometry(self) -> StaticOperator:
        """The field as operators; rebuilt when parameters change."""
        if self._still is None:
            params = {name: dr.detach(values).numpy() for name, values in self._params.items()}
            assert self._field is not None, "an operator needs Gaussians"
            self._still = StaticOperator(self._field, params, self.receivers, *self.graph.form.size, self._store)
        return self._still

    def of_rows(self, record: Record, rows: IntArray, receiver: int) -> NDArray[Any]:
        """Predictions [m, ...] for rows of a record at one receiver (`__call__`)."""
        turned = record.tx_heading_rad if self.graph.form.headings else None
        parts = (None if part is None else part[rows] for part in (record.uplink, turned, record.carriers_hz))
        return self(record.tx_pos_m[rows], receiver, *parts)

    def _at_carrier(self, carrier_hz: float | None, receiver: int) -> tuple[Predictor, int]:
        """Predictor and port of a receiver's reports at a carrier, that of training or another one."""
        known = self.graph.form.carriers_hz
        if known is None or carrier_hz is None:
            return self, receiver
        if carrier_hz in known:
            return self, receiver * self.graph.carriers + int(np.searchsorted(known, carrier_hz))
        if carrier_hz not in self._others:
            graph, size = self.graph.at_carrier(carrier_hz), self.graph.form.size
            self._others[carrier_hz] = Predictor(self._field, {}, self.receivers, *size, graph=graph)
            self._others[carrier_hz].update(self._params)
        self._others[carrier_hz].reach, self._others[carrier_hz].phase_error = self.reach, self.phase_error
        return self._others[carrier_hz], receiver

    def _of_positions(
        self, tx_pos_m: FloatArray, receiver: int, heading_rad: FloatArray | None, carriers_hz: FloatArray | None
    ) -> NDArray[Any]:
        """Reports for positions [m, 3] at their carriers [m], Hz, each with paths of one search for all carriers."""
        if not len(tx_pos_m):
            return self._reported(tx_pos_m, receiver * self.graph.carriers)
        groups = [
            (rows, predictor._reported(tx_pos_m[rows], port, side))
            for rows, predictor, port, side in self._sides(tx_pos_m, receiver, heading_rad, carriers_hz)
        ]
        order, reports = (np.concatenate(parts) for parts in zip(*groups, strict=True))
        return reports[np.argsort(order)]

    def _sides(
        self, tx_pos_m: FloatArray, receiver: int, heading_rad: FloatArray | None, carriers_hz: FloatArray | None
    ) -> Iterator[tuple[IntArray, Predictor, int, TracedField | None]]:
        """Groups of positions: their numbers, predictor and port, and traced side.

        Positions at several carriers are in the same group, as are all without a scene.
        """
        order = np.arange(len(tx_pos_m))
        size = SEARCHED if self.graph.scene is not None else max(len(order), 1)
        if self.graph.scene is not None and carriers_hz is not None:
            order, size = np.lexsort(tx_pos_m.T), SEARCHED * len(np.unique(carriers_hz))
        for start in range(0, len(order), size):
            rows = order[start : start + size]
            turned, carriers = (None if part is None else part[rows] for part in (heading_rad, carriers_hz))
            sides = self.graph.trace(tx_pos_m[rows], receiver, turned, carriers, self._params)
            for side, (carrier_hz, which) in zip(sides, rows_by_carrier(carriers, len(rows)), strict=True):
                yield rows[which], *self._at_carrier(carrier_hz, receiver), side

    def decompose(
        self,
        tx_pos_m: FloatArray,
        receiver: int,
        tx_heading_rad: FloatArray | None = None,
        carriers_hz: FloatArray | None = None,
    ) -> tuple[dict[str, NDArray[Any]], PathStatistics]:
        """Reports with a scene's paths, by sides, and statistics of the paths, from one search.

        Arguments as those of a call with finite positions.

        Returns:
            ``whole`` and, with Gaussians, ``traced`` and ``learned`` (`Graph.report`), [m, ...], NaN where Gaussians
            are out of reach; and statistics of the paths before the instrument's gain.
        """
        turned = known_headings(tx_heading_rad, len(tx_pos_m), self.graph.form.headings)
        self.graph.check(tx_pos_m)
        reports, statistics, order = list[dict[str, NDArray[Any]]](), list[PathStatistics](), list[IntArray]()
        for rows, predictor, port, side in self._sides(tx_pos_m, receiver, turned, carriers_hz):
            assert side is not None, "a graph without a scene has one side"
            positions = tx_pos_m[rows]
            reports.append({"whole": predictor._reported(positions, port, side)})
            if self._field is not None:
                reports[-1] |= {one: predictor._of_one_side(positions, port, side, one) for one in get_args(Alone)}
            statistics.append(side.statistics(self._params))
            order.append(rows)
        back = np.argsort(np.concatenate(order))
        whole = {name: np.concatenate([part[name] for part in reports])[back] for name in reports[0]}
        return whole, joined(statistics).rows(back)

    def _of_one_side(self, tx_pos_m: FloatArray, port: int, side: TracedField, alone: Alone) -> NDArray[Any]:
        """Reports of one side alone, NaN where Gaussians are out of reach."""
        weight = None if self.reach is None else self.reach.weight(tx_pos_m, port // self.graph.carriers)
        used = np.arange(len(tx_pos_m))
        if alone == "learned" and weight is not None:
            used = np.flatnonzero(weight)
        found = self.of_side(tx_pos_m[used], port, side, used, None if weight is None else weight[used], alone)
        whole = np.full((len(tx_pos_m), *found.shape[1:]), np.nan, found.dtype)
        whole[used] = found
        return whole

    def of_side(
        self,
        conditions: FloatArray,
        port: int,
        side: TracedField | None,
        slots: IntArray,
        weight: NDArray[Any] | None,
        alone: Alone | None = None,
    ) -> NDArray[Any]:
        """Predictions for transmitters whose paths are known.

        Args:
            conditions: positions [m, 3], metres, or features [m, features].
            port: number of the port.
            side: its traced side, or None.
            slots: rows of the traced side [m].
            weight: weight of the Gaussians' signal [m], 0 to 1; None: 1.
            alone: component reported alone (`Graph.report`); None: both together.

        Returns:
            Predictions as of `__call__`.
        """
        shape, count = self.graph.models[port].shape, len(conditions)
        if self.graph.form.features:  # of one antenna of the array
            shape = shape[-2:]
        out = np.empty((count, *shape), np.float32)
        together = self._together if self._recordable else max(TOGETHER, TRACED_NUMBERS // math.prod(shape))
        for start in range(0, count, together):
            part = slice(start, min(start + together, count))
            weights = None if weight is None else weight[part]
            flat = self._evaluated(conditions[part].T, port, side, slots[part], weights, alone)
            out[part] = flat.numpy().reshape(part.stop - part.start, *shape)
        return out.view(np.complex64)[..., 0] if self.graph.kind.complex_valued else out

    def _evaluated(
        self,
        condition: FloatArray,
        port: int,
        side: TracedField | None,
        slots: IntArray,
        weight: NDArray[Any] | None,
        alone: Alone | None,
    ) -> Any:
        """Report for conditions [3 or features, m], flat, recorded where it can be; paths alone at weights 0."""
        place = self._places[port]
        if self._recordable:
            if not self._may_record(self._together):
                report = self.graph.report(port, None, chunked=True)
                return evaluated(report, self._params, condition, place, weight=weight)
            # One recording serves the pixels of all ports.
            name, arrays = ("report", None if self._pixels else port), partial(self.graph.arrays, port, None)
            return self._recorded(name, self._together, self.graph.report(port, None), condition, port, weight, arrays)
        learned = self._field is not None and alone != "traced"
        learned &= side is None or weight is None or bool(np.any(weight))
        if side is not None and len(side) == 1 and self._may_record(1):
            # Recordings of one transmitter serve others, whose traced side is an input.
            how: dict[str, Any] = {"alone": alone, "phase_error": self.phase_error}
            of_one = "both", port, learned, *how.values(), side.form
            self._traced[of_one] = side

            def reported(params: Mapping[str, Any], batch: Batch) -> Any:
                return self.graph.report(port, self._traced[of_one], learned, **how)(params, batch)

            def read() -> list[Any]:
                return self.graph.arrays(port, self._traced[of_one])

            return self._recorded(of_one, 1, reported, condition, port, weight, read)
        signal = None
        # Batches of `TOGETHER` are recorded; copies that filled others would cost more than they save.
        if learned and TOGETHER // 2 < condition.shape[1] <= TOGETHER and self._may_record(TOGETHER):
            # One recording serves the poses of all receivers unless they are trained.
            of_signal = "signal", port if self.graph.moves else None
            signal = self._recorded(of_signal, TOGETHER, partial(self.graph.learned, port), condition, port)
        report = self.graph.report(port, side, learned, alone=alone, phase_error=self.phase_error)
        return evaluated(report, self._params, condition, place, slots, weight, signal)

    def _may_record(self, size: int) -> bool:
        """Whether functions of Gaussians are recorded for batches of a size: see `_recorded`."""
        return self.graph.evaluation.recordable and self._count * size <= CHUNK_SIZE

    def _recorded(
        self,
        name: Hashable,
        size: int,
        function: Callable[[Mapping[str, Any], Batch], Any],
        condition: FloatArray,
        port: int,
        weight: NDArray[Any] | None = None,
        state: Callable[[], Any] | None = None,
    ) -> Any:
        """Evaluate a function of at most ``size`` conditions, which Dr.Jit records at its first call by a name.

        The number of transmitters is a constant of the recorded kernels: each size is a recording of its own, and
        copies of the last transmitter fill a batch. Networks are not evaluated in chunks, and lists of tiles, which a
        recorded function cannot count, have room for all: neither is for very many Gaussians. ``state`` returns the
        arrays that the function reads beside its arguments.
        """
        count, place = condition.shape[1], self._places[port]
        if (name, size) not in self._recordings:

            def recordable(params: Params, batch: Batch) -> Any:
                with dr.suspend_grad():
                    return function(params, batch)

            # Arrays that are made from NumPy's memory at first use must exist before a recording.
            evaluated(function, self._params, condition[:, :1], place)
            self._recordings[name, size] = Recorded(recordable, state)
        filled = np.minimum(np.arange(size), count - 1)
        tx, slots = to_tensor(np.ascontiguousarray(condition[:, filled])), dr.zeros(mi.UInt32, size)
        dr.make_opaque(slots)
        weights = None if weight is None else to_float(weight[filled])
        arrays = self._recordings[name, size](self._params, place.batch(tx, slots, weights))

        def leading(values: Any) -> Any:
            return dr.gather(type(values), values, dr.arange(mi.UInt32, count * (dr.width(values) // size)))

        if count == size:
            return arrays
        return tuple(map(leading, arrays)) if isinstance(arrays, tuple) else leading(arrays)

    def _reported(
        self, conditions: FloatArray, port: int, side: TracedField | None = None, slots: IntArray | None = None
    ) -> NDArray[Any]:
        """Reports for positions [m, 3] or features [m, features], complex numbers as such.

        ``side`` has the paths of the positions in its rows ``slots`` [m]; None: in its rows in order.
        """
        slots = np.arange(len(conditions)) if slots is None else slots
        weight = None if self.reach is None else self.reach.weight(conditions, port // self.graph.carriers)
        if weight is not None and not weight.all():
            if weight.any():
                # Gaussians of weight 0 are not evaluated.
                parts = [np.flatnonzero(mask) for mask in (weight > 0, weight == 0)]
                reports = [self._reported(conditions[part], port, side, slots[part]) for part in parts]
                return np.concatenate(reports)[np.argsort(np.concatenate(parts))]
            if self.graph.scene is None:
                return np.zeros((len(conditions), *self.graph.models[port].shape[:-1]), np.complex64)
        return self.of_side(conditions, port, side, slots, weight)

    def _by_uplink(self, uplink: NDArray[Any] | None, receiver: int) -> NDArray[Any]:
        """Channels [m, antennas, k] of uplink channels, or [m, k] of a single antenna."""
        features, divisor = normalised_uplink(known_uplink(uplink))
        reports = self._reported(np.asarray(features, float), receiver)
        channels = reports.reshape(*divisor.shape, -1) * divisor[..., None]
        return (channels if len(self.graph.form.outputs) > 1 else channels[:, 0]).astype(np.complex64)

    def __call__(
        self,
        tx_pos_m: ArrayLike,
        receiver: int | str = 0,
        uplink: NDArray[Any] | None = None,
        tx_heading_rad: ArrayLike | None = None,
        carriers_hz: ArrayLike | None = None,
    ) -> NDArray[Any]:
        """Predict the observations of transmitters at one receiver.

        Args:
            tx_pos_m: positions [m, 3], world frame, metres.
            receiver: name, or number from 0, of one of ``receivers``.
            uplink: uplink channels [m, antennas, subcarriers], where the field was trained on them instead of
                positions.
            tx_heading_rad: yaw of each transmitter [m], radians, if and only if the form has ``headings``.
            carriers_hz: carrier of each transmitter [m], Hz, if and only if the form has carriers.

        Returns:
            Greys [m, height, width], powers [m] in dBm, or channels [m, k] or [m, antennas, k].

        Raises:
            InputError: positions of another shape or not finite, missing uplink or headings, headings that are not
                used, or no such receiver.
        """
        index = receiver_index(self.receivers, receiver)
        if self.graph.form.features:
            return self._by_uplink(uplink, index)
        positions = np.asarray(tx_pos_m, np.float32)
        if positions.ndim != 2 or positions.shape[1] != 3:
            raise InputError(f"transmitter positions: expected shape [m, 3], got {list(positions.shape)}")
        bad = np.flatnonzero(~np.isfinite(positions).all(axis=1))
        if len(bad):
            raise InputError(f"transmitter positions, row {bad[0] + 1}: not a finite number")
        if self._by_operator:
            try:
                return self.static_geometry()(positions, index)
            except MemoryError as error:
                warnings.warn(f"operator: {error}; spectra are splatted one by one", stacklevel=2)
                self._by_operator = False
        exact, trained_hz = np.asarray(tx_pos_m, float), self.graph.form.carriers_hz
        turned = known_headings(tx_heading_rad, len(exact), self.graph.form.headings)
        self.graph.check(exact)
        if trained_hz is not None and carriers_hz is None:
            raise InputError(f"trained with {carriers_text(trained_hz)}; give the carrier of every transmitter")
        return self._of_positions(exact, index, turned, None if trained_hz is None else np.asarray(carriers_hz, float))
