"""One optimiser step and one prediction, as functions that `dr.freeze` can record.

Arguments that change from step to step are opaque, so that Dr.Jit replays the recorded kernels; a captured array or a
changing Python number would be traced anew each time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from drjit.opt import Adam
from numpy.typing import NDArray

from ..backend.device import on_device, to_float, to_tensor
from ..backend.recorded import Recorded
from ..core import Receiver
from ..gaussians.footprint import Pose
from ..gaussians.tiles import Plane, perception_plane
from ..graph.evaluations import Evaluation
from ..graph.graph import Batch, Graph, Report
from ..tracing.paths.field_calculator import Complex
from .adam import NonFiniteReport, Params, guarded_step, rated_params

Loss = Callable[..., Any]
"""``loss(prediction, truth, batch, *shape)`` of flat arrays in the receiver's unit, a Dr.Jit float of one value."""

CENTRES = "position"
"""Parameter [3, n] of every field with Gaussians."""


def device_pose(receiver: Receiver, float_type: Any = None) -> Pose:
    """A receiver's pose as opaque device arrays of ``float_type``, by default ``mi.Float``."""

    def number(x: float) -> Any:
        return dr.opaque(float_type or mi.Float, float(x))

    return Pose([number(x) for x in receiver.position_m], [[number(x) for x in row] for row in receiver.to_world])


class Place(NamedTuple):
    """What a batch at one port of a graph has beside its transmitters.

    Attributes:
        receiver: number of the receiver.
        pose: its pose.
        plane: directions of the learned signal.
        log_carrier: logarithm of the carrier over the middle one; None: rows have a single carrier.
    """

    receiver: int
    pose: Pose
    plane: Plane
    log_carrier: float | None = None

    def batch(self, condition: Any, slots: Any, weight: Any = None, signal: Complex | None = None) -> Batch:
        """A `Batch` at the port, of arrays on the device."""
        carrier = None if self.log_carrier is None else dr.opaque(mi.Float, self.log_carrier)
        receiver = dr.opaque(mi.UInt32, self.receiver)
        return Batch(condition, slots, receiver, self.pose, self.plane, weight, carrier, signal)


def places_of(graph: Graph) -> list[Place]:
    """The places of a graph's ports."""
    plane, ports = perception_plane(*graph.form.size, mi.Float), range(len(graph.models))
    receivers = [port // graph.carriers for port in ports]
    poses = [device_pose(graph.receivers[receiver]) for receiver in receivers]
    return [Place(receivers[port], poses[port], plane, graph.log_carrier(port)) for port in ports]


@dataclass
class TrainingData:
    """Conditions and observations on the device (`wrf_mi.training.targets.Targets`).

    Attributes:
        condition: conditions of all rows, tensor [3, c] in metres or [features, c].
        truth: observations of all receivers and conditions, flat.
        scale: inverse unit of each receiver, [n_rx].
        weight: factors of the observations' differences in the loss, in the order of ``truth``; None: 1.
    """

    condition: Any
    truth: Any
    scale: Any
    weight: Any = None

    def select(self, rows: Any, receiver: Any, values: int) -> tuple[Any, Any, Any]:
        """Some conditions [3 or features, batch] and their observations [batch * values] at one receiver, and the
        factor of differences in the loss: one value, or [batch * values] with ``weight``.
        """
        k, n = self.condition.shape
        batch, index_type = dr.width(rows), type(rows)
        flat = self.condition.array
        tx = type(self.condition)(dr.concat([dr.gather(type(flat), flat, rows + i * n) for i in range(k)]), (k, batch))
        slot = dr.arange(index_type, batch * values)
        row = dr.gather(index_type, rows, slot // values) + receiver * n
        factor = dr.gather(type(self.truth), self.scale, receiver)
        if self.weight is not None:
            factor *= dr.gather(type(self.truth), self.weight, row)
        return tx, dr.gather(type(self.truth), self.truth, row * values + slot % values), factor


def make_step(
    report: Report,
    rates: Mapping[str, float],
    loss_of: Loss,
    shape: tuple[int, ...],
    state: Callable[[], Any] | None = None,
    evaluation: Evaluation | None = None,
) -> Callable[..., Any]:
    """An optimiser step, recorded where the report can be recorded.

    Args:
        report: report of a receiver (`wrf_mi.graph.graph.Graph.report`).
        rates: learning rate of each parameter.
        loss_of: loss of a batch.
        shape: shape of one observation.
        state: returns arrays that the report reads beside its arguments; None: no arrays.
        evaluation: evaluation of the report's Gaussians; None: one that Dr.Jit can record.

    Returns:
        Function that takes step ``number`` (from 1) of ``adam`` in place, on conditions ``rows`` at the port of
        ``batch``, which has none. It returns the new running mean of the parameters, the report of values that are not
        finite, after which nothing changes any more, the batch's loss before the step, and the norm of the gradient by
        each Gaussian's direction from the receiver, [n].
    """
    values = math.prod(shape)

    def step(
        adam: Adam,
        mean: Params,
        data: TrainingData,
        rows: Any,
        batch: Batch,
        factor: Any,
        decay: Any,
        number: Any,
        trouble: NonFiniteReport,
    ) -> tuple[Params, NonFiniteReport, Any, Any]:
        params = rated_params(adam, rates, factor)
        condition, truth, scale = data.select(rows, batch.receiver, values)
        truth = truth * scale
        # Evaluated with the report's first kernels, so that those of the loss and its reverse pass do not gather again.
        dr.schedule(truth, scale)
        prediction = report(params, replace(batch, condition=condition))
        loss = loss_of(prediction * scale, truth, dr.width(rows), *shape)
        mean, trouble, finite = guarded_step(adam, params, loss, mean, decay, number, trouble)
        view_gradient_norm = mi.Float(0)
        if CENTRES in params:
            offset = [dr.detach(params[CENTRES])[k].array - batch.pose.position[k] for k in range(3)]
            pull = [dr.grad(params[CENTRES])[k].array for k in range(3)]
            distance = dr.sqrt(sum(c * c for c in offset))
            view_gradient_norm = dr.select(finite, dr.sqrt(sum(c * c for c in pull)) * distance, 0)
        loss = dr.detach(loss)
        dr.eval(adam, mean, trouble, loss, view_gradient_norm)
        return mean, trouble, loss, view_gradient_norm

    if evaluation is None or evaluation.recordable:
        return Recorded(step, state)

    def unrecorded(*arguments: Any) -> tuple[Params, NonFiniteReport, Any, Any]:
        # As in a recording: a row that is a constant would compile the kernels anew.
        dr.make_opaque(arguments)
        result = step(*arguments)
        evaluation.release()
        return result

    return unrecorded


def evaluated(
    report: Report,
    params: Mapping[str, Any],
    condition: NDArray[Any],
    place: Place,
    slots: NDArray[Any] | None = None,
    weight: NDArray[Any] | None = None,
    signal: Complex | None = None,
) -> Any:
    """A report of conditions [3 or features, m], evaluated without gradients.

    ``slots`` are rows of the traced side [m], by default the first m; ``weight`` [m] scales the Gaussians' signal.
    """
    with dr.suspend_grad():
        rows = on_device(np.arange(condition.shape[1]) if slots is None else slots, mi.UInt32)
        weights = None if weight is None else to_float(weight)
        tx = to_tensor(np.ascontiguousarray(condition))
        reported = report(params, place.batch(tx, rows, weights, signal))
        dr.eval(reported)
    return reported
