"""Predicted observations of a trained graph's receivers for new transmitters."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..backend.device import to_tensor
from ..core import InputError, Receiver, Record
from ..core.angles import FloatArray
from ..core.carriers import carriers_text, rows_by_carrier
from ..core.counts import count, counting
from ..core.receivers import receiver_index
from ..core.types import IntArray
from ..gaussians.footprint import depth_order, project
from ..gaussians.parameters import Gaussians
from ..gaussians.tiles import build_lists, perception_plane
from ..graph.graph import Component, Graph
from ..receivers.registry import PIXEL
from ..receivers.spreads import PathStatistics, joined
from ..tasks.conditions import known_headings, normalised_uplink
from ..tracing.paths.traced_field import TracedField
from .adam import Params
from .by_distance import Reach
from .evaluator import OperatorObservations, Request, evaluator_of
from .step import device_pose

SEARCHED = 512  # transmitters of a carrier whose paths are searched together: a search has a fixed cost


def _checked_positions(tx_pos_m: ArrayLike) -> FloatArray:
    positions = np.asarray(tx_pos_m, float)
    if positions.ndim != 2 or positions.shape[1] != 3:
        raise InputError(f"transmitter positions: expected shape [m, 3], got {list(positions.shape)}")
    # Finite in single precision, in which they are evaluated.
    bad = np.flatnonzero(~np.isfinite(positions.astype(np.float32)).all(axis=1))
    if len(bad):
        raise InputError(f"transmitter positions, row {bad[0] + 1}: not a finite number")
    return positions


class Predictor:
    """Predicts the observations of transmitters at any receiver of a graph.

    Args:
        graph: Gaussians, receivers and a scene.
        params: parameters of the field and of the traced component, as NumPy arrays.
        operator: where the field's geometry and attenuation do not depend on the transmitter, predict by the linear map
            from signals to pixels (`wrf_mi.gaussians.operator`), built at the first prediction.
        store: folder in which operators are stored; None: in memory only.
        reach: region in which the Gaussians are used; None: everywhere.
        phase_error: see `wrf_mi.graph.graph.Graph.observation`.
    """

    def __init__(
        self,
        graph: Graph,
        params: Mapping[str, NDArray[np.float32]],
        operator: bool = False,
        store: Path | None = None,
        reach: Reach | None = None,
        phase_error: float = 0.0,
    ) -> None:
        self.graph, self.reach, self.phase_error = graph, reach, phase_error
        self.evaluate = evaluator_of(graph, operator, store)
        self._others: dict[float, Predictor] = {}
        self.update({name: to_tensor(values) for name, values in params.items()})

    @property
    def receivers(self) -> tuple[Receiver, ...]:
        """The receivers to predict for."""
        return self.graph.receivers

    def update(self, params: Params) -> None:
        """Replace the parameters (Dr.Jit tensors)."""
        dr.eval(params)
        self.evaluate.update(params)
        for other in self._others.values():
            other.update(params)

    def gaussians(self, tx_pos_m: ArrayLike, log_carrier: float = 0.0) -> Gaussians:
        """The field's Gaussians for transmitter positions [m, 3] (metres), world frame.

        ``log_carrier`` is that of `Graph.log_carrier`, for fields that were trained on several carriers.
        """
        columns = np.ascontiguousarray(np.asarray(tx_pos_m, np.float32).reshape(-1, 3).T)
        # Fields of several carriers have the carrier as a last input.
        if self.graph.form.carriers_hz is not None:
            columns = np.vstack([columns, np.full((1, columns.shape[1]), log_carrier, np.float32)])
        if self.graph.field is None:
            raise ValueError("paths alone: there are no Gaussians")
        return self.graph.field.gaussians(self.evaluate.params, to_tensor(columns)).spread()

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
        index, form = receiver_index(self.receivers, receiver), self.graph.form
        if form.features:
            return self._from_uplink(uplink, index)
        positions = _checked_positions(tx_pos_m)
        headings = known_headings(tx_heading_rad, len(positions), form.headings)
        self.graph.check(positions)
        if form.carriers_hz is not None and carriers_hz is None:
            raise InputError(f"trained with {carriers_text(form.carriers_hz)}; give the carrier of every transmitter")
        carriers = None if form.carriers_hz is None else np.asarray(carriers_hz, float)
        if not len(positions):
            return self._predicted(positions, index * self.graph.carriers)
        if counting() and self.graph.form.receiver == PIXEL and self.graph.field is not None:
            self._count_gaussians(positions, index)
        groups = [
            (rows, predictor._predicted(positions[rows], port, traced_field))
            for rows, predictor, port, traced_field in self._traced_groups(positions, index, headings, carriers)
        ]
        # Groups come in the order of the search, which brings equal positions together.
        order, predicted = (np.concatenate(parts) for parts in zip(*groups, strict=True))
        return predicted[np.argsort(order)]

    def _count_gaussians(self, tx_pos_m: FloatArray, receiver: int) -> None:
        """Count the pairs of a tile of an image and a Gaussian that reaches it, by the first of transmitters [m, 3]."""
        height, width = self.graph.form.size
        plane, gaussians = perception_plane(height, width, mi.Float), self.gaussians(tx_pos_m[:1])
        footprints = project(gaussians, device_pose(self.receivers[receiver]))
        order = depth_order(footprints.depth, gaussians.position)
        reached = len(tx_pos_m) * int(dr.sum(build_lists(footprints, order, plane, 1).length)[0])
        count("tiles of Gaussians", reached, len(tx_pos_m) * plane.tiles * gaussians.count - reached)

    def _from_uplink(self, uplink: NDArray[Any] | None, receiver: int) -> NDArray[Any]:
        # Antennas of an uplink are independent inputs, without positions and paths.
        features, divisor = normalised_uplink(uplink)
        predicted = self._predicted(np.asarray(features, float), receiver).reshape(*divisor.shape, -1)
        channels = predicted * divisor[..., None]
        return (channels if len(self.graph.form.outputs) > 1 else channels[:, 0]).astype(np.complex64)

    def of_rows(self, record: Record, rows: IntArray, receiver: int) -> NDArray[Any]:
        """Predictions [m, ...] for rows of a record at one receiver (`__call__`)."""
        headings = record.tx_heading_rad if self.graph.form.headings else None
        parts = (None if part is None else part[rows] for part in (record.uplink, headings, record.carriers_hz))
        return self(record.tx_pos_m[rows], receiver, *parts)

    def decompose(
        self,
        tx_pos_m: FloatArray,
        receiver: int,
        tx_heading_rad: FloatArray | None = None,
        carriers_hz: FloatArray | None = None,
    ) -> tuple[dict[str, NDArray[Any]], PathStatistics]:
        """Predictions with a scene's paths, by components, and statistics of the paths, from one search (`__call__`).

        Returns:
            ``prediction`` and, with Gaussians, ``traced`` and ``learned`` (`Graph.observation`), [m, ...], NaN where
            Gaussians are out of reach; and statistics of the paths before the instrument's gain.
        """
        headings = known_headings(tx_heading_rad, len(tx_pos_m), self.graph.form.headings)
        self.graph.check(tx_pos_m)
        predicted, statistics, order = list[dict[str, NDArray[Any]]](), list[PathStatistics](), list[IntArray]()
        for rows, predictor, port, traced_field in self._traced_groups(tx_pos_m, receiver, headings, carriers_hz):
            assert traced_field is not None, "a graph without a scene has no traced component"
            positions = tx_pos_m[rows]
            predicted.append({"prediction": predictor._predicted(positions, port, traced_field)})
            if self.graph.field is not None:
                predicted[-1] |= {
                    name: predictor._of_component(positions, port, traced_field, name) for name in get_args(Component)
                }
            statistics.append(traced_field.statistics(self.evaluate.params))
            order.append(rows)
        back = np.argsort(np.concatenate(order))
        joint = {name: np.concatenate([part[name] for part in predicted])[back] for name in predicted[0]}
        return joint, joined(statistics).rows(back)

    def _traced_groups(
        self, tx_pos_m: FloatArray, receiver: int, heading_rad: FloatArray | None, carriers_hz: FloatArray | None
    ) -> Iterator[tuple[IntArray, Predictor, int, TracedField | None]]:
        """Groups of positions: their numbers, predictor and port, and traced field; without a scene one group."""
        order = np.arange(len(tx_pos_m))
        size = SEARCHED if self.graph.scene is not None else max(len(order), 1)
        if self.graph.scene is not None and carriers_hz is not None:
            # One search serves all carriers of a position: they are brought together.
            order, size = np.lexsort(tx_pos_m.T), SEARCHED * len(np.unique(carriers_hz))
        for start in range(0, len(order), size):
            rows = order[start : start + size]
            headings, carriers = (None if part is None else part[rows] for part in (heading_rad, carriers_hz))
            traced_fields = self.graph.trace(tx_pos_m[rows], receiver, headings, carriers, self.evaluate.params)
            for traced_field, (carrier_hz, which) in zip(
                traced_fields, rows_by_carrier(carriers, len(rows)), strict=True
            ):
                yield rows[which], *self._at_carrier(carrier_hz, receiver), traced_field

    def _at_carrier(self, carrier_hz: float | None, receiver: int) -> tuple[Predictor, int]:
        """Predictor and port of a receiver at a carrier, that of training or another one."""
        trained_hz = self.graph.form.carriers_hz
        if trained_hz is None or carrier_hz is None:
            return self, receiver
        if carrier_hz in trained_hz:
            return self, receiver * self.graph.carriers + int(np.searchsorted(trained_hz, carrier_hz))
        # Another carrier has ports of its own, and recordings that hold its wavelength.
        if carrier_hz not in self._others:
            self._others[carrier_hz] = Predictor(self.graph.at_carrier(carrier_hz), {})
            self._others[carrier_hz].update(self.evaluate.params)
        other = self._others[carrier_hz]
        other.reach, other.phase_error = self.reach, self.phase_error
        return other, receiver

    def _predicted(
        self, conditions: FloatArray, port: int, traced_field: TracedField | None = None, slots: IntArray | None = None
    ) -> NDArray[Any]:
        """Predictions for positions [m, 3] or features [m, features], with the paths of rows ``slots`` [m]."""
        slots = np.arange(len(conditions)) if slots is None else slots
        weight = None if self.reach is None else self.reach.weight(conditions, port // self.graph.carriers)
        if weight is not None and not weight.all():
            if weight.any():
                # Gaussians of weight 0 are not evaluated.
                parts = [np.flatnonzero(mask) for mask in (weight > 0, weight == 0)]
                predicted = [self._predicted(conditions[part], port, traced_field, slots[part]) for part in parts]
                return np.concatenate(predicted)[np.argsort(np.concatenate(parts))]
            # Channels are zero without Gaussians, and nothing has to be evaluated.
            if self.graph.scene is None:
                return np.zeros((len(conditions), *self.graph.models[port].shape[:-1]), np.complex64)
        return self.of_request(Request(conditions, port, traced_field, slots, weight))

    def _of_component(
        self, tx_pos_m: FloatArray, port: int, traced_field: TracedField, component: Component
    ) -> NDArray[Any]:
        """Predictions of one component, NaN where Gaussians are out of reach."""
        weight = None if self.reach is None else self.reach.weight(tx_pos_m, port // self.graph.carriers)
        # Far from training rows the Gaussians' component is not defined, while that of the paths always is.
        used = np.arange(len(tx_pos_m))
        if component == "learned" and weight is not None:
            used = np.flatnonzero(weight)
        weight = None if weight is None else weight[used]
        predicted = self.of_request(Request(tx_pos_m[used], port, traced_field, used, weight, component))
        spread = np.full((len(tx_pos_m), *predicted.shape[1:]), np.nan, predicted.dtype)
        spread[used] = predicted
        return spread

    def of_request(self, request: Request) -> NDArray[Any]:
        """Predictions, as of `__call__`, for transmitters whose paths are known, with the phase error of the model."""
        request = replace(request, phase_error=self.phase_error)
        try:
            predicted = self.evaluate(request)
        except MemoryError as error:
            if not isinstance(self.evaluate, OperatorObservations):
                raise
            warnings.warn(f"operator: {error}; spectra are splatted one by one", stacklevel=2)
            # From now on, so that this is said once.
            params, self.evaluate = self.evaluate.params, evaluator_of(self.graph)
            self.evaluate.update(params)
            predicted = self.evaluate(request)
        return predicted.view(np.complex64)[..., 0] if self.graph.kind.complex_valued else predicted
