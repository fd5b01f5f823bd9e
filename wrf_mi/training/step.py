"""One optimiser step and one prediction, as functions that `dr.freeze` can record.

Everything that changes from step to step comes in as an argument and is opaque, so that Dr.Jit replays the
recorded kernels; a captured array or a changing Python number would be traced anew each time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from drjit.opt import Adam
from numpy.typing import NDArray

from ..backend.device import on_device, to_float, to_tensor
from ..backend.recorded import Recorded
from ..core import Receiver
from ..core.types import SQUARED_MAGNITUDE_EPS
from ..gaussians.chunks import CHUNK_SIZE, gaussians_in_parts
from ..gaussians.footprint import Pose
from ..gaussians.render import splat
from ..gaussians.skip import NOTHING, Skip
from ..gaussians.tiles import Plane
from ..graph.evaluations import Evaluation
from ..graph.graph import Batch, Field, Report
from .adam import NonFiniteReport, Params, guarded_step, rated_params

Loss = Callable[..., Any]
"""``loss(prediction, truth, batch, *shape)`` of flat arrays in the receiver's unit, a Dr.Jit float of one value."""

CENTRES = "position"
"""Parameter [3, n] of every field; where it is missing there are no Gaussians."""


def device_pose(receiver: Receiver) -> Pose:
    """A receiver's pose as opaque device arrays."""

    def number(x: float) -> Any:
        return dr.opaque(mi.Float, float(x))

    return Pose([number(x) for x in receiver.position_m], [[number(x) for x in row] for row in receiver.to_world])


def grey(field: Field, params: Mapping[str, Any], tx_pos: Any, pose: Pose, plane: Plane, skip: Skip = NOTHING) -> Any:
    """The pixel receiver's spectrum |R| per direction, [batch * height * width], row-major.

    Args:
        field: the model.
        params: its parameters.
        tx_pos: transmitter positions [3, batch], metres.
        pose: of the receiver.
        plane: its perception plane.
        skip: what is not evaluated.
    """
    re, im = splat(field.gaussians(params, tx_pos), pose, plane, skip)
    return dr.sqrt(re * re + im * im + SQUARED_MAGNITUDE_EPS)


@dataclass
class TrainingData:
    """Conditions and observations on the device, see `wrf_mi.training.targets.Targets`.

    Attributes:
        condition: of all rows, tensor [3, c] in metres or [features, c].
        truth: observations of all receivers and conditions, one after the other.
        scale: one over each receiver's unit, [n_rx].
        weight: factors of the observations' differences in the loss, in the order of ``truth``; None: 1 throughout.
    """

    condition: Any
    truth: Any
    scale: Any
    weight: Any = None

    def select(self, rows: Any, receiver: Any, values: int) -> tuple[Any, Any]:
        """Conditions [3 or features, batch] and observations [batch * values] of some conditions at one receiver."""
        k, n = self.condition.shape
        batch, index_type = dr.width(rows), type(rows)
        flat = self.condition.array
        tx = type(self.condition)(dr.concat([dr.gather(type(flat), flat, rows + i * n) for i in range(k)]), (k, batch))
        slot = dr.arange(index_type, batch * values)
        one = dr.gather(index_type, rows, slot // values) + receiver * n
        return tx, dr.gather(type(self.truth), self.truth, one * values + slot % values)

    def factor(self, rows: Any, receiver: Any, values: int) -> Any:
        """What differences are multiplied by in the loss: of one value, or [batch * values] with ``weight``."""
        scale = dr.gather(type(self.truth), self.scale, receiver)
        if self.weight is None:
            return scale
        slot = dr.arange(type(rows), dr.width(rows) * values)
        one = dr.gather(type(rows), rows, slot // values) + receiver * self.condition.shape[1]
        return scale * dr.gather(type(self.truth), self.weight, one)


@dataclass
class StepReport:
    """What a step tells: arrays of one value, but ``view_gradient_norm`` [n].

    Attributes:
        loss: of the batch before the step.
        view_gradient_norm: length of the gradient by each Gaussian's direction from the receiver.
    """

    loss: Any
    view_gradient_norm: Any


def make_step(
    report: Report,
    rates: Mapping[str, float],
    loss_of: Loss,
    shape: tuple[int, ...],
    state: Callable[[], Any] | None = None,
    evaluation: Evaluation | None = None,
) -> Callable[..., Any]:
    """An optimiser step, recorded where the report can be.

    Args:
        report: what a receiver reports of the graph, see `wrf_mi.graph.Graph.report`.
        rates: learning rate of each parameter.
        loss_of: loss of a batch.
        shape: of one observation.
        state: arrays that the report reads beside its arguments; None: none.
        evaluation: of the report's Gaussians; None: one that Dr.Jit can record.

    Returns:
        ``step(adam, mean, data, rows, slots, receiver, pose, plane, factor, decay, number, trouble) -> (mean, trouble,
        StepReport)``. It takes one step of ``adam`` in place, that of this number from 1, and returns the new running
        mean of the parameters. After trouble nothing changes any more.
    """
    values = math.prod(shape)

    def step(
        adam: Adam,
        mean: Params,
        data: TrainingData,
        rows: Any,
        slots: Any,
        receiver: Any,
        pose: Pose,
        plane: Plane,
        factor: Any,
        decay: Any,
        number: Any,
        trouble: NonFiniteReport,
    ) -> tuple[Params, NonFiniteReport, StepReport]:
        params = rated_params(adam, rates, factor)
        condition, truth = data.select(rows, receiver, values)
        batch = dr.width(rows)
        prediction = report(params, Batch(condition, slots, receiver, pose, plane))
        scale = data.factor(rows, receiver, values)
        loss = loss_of(prediction * scale, truth * scale, batch, *shape)
        mean, trouble, finite = guarded_step(adam, params, loss, mean, decay, number, trouble)
        view_gradient_norm = mi.Float(0)
        if CENTRES in params:
            offset = [dr.detach(params[CENTRES])[k].array - pose.position[k] for k in range(3)]
            pull = [dr.grad(params[CENTRES])[k].array for k in range(3)]
            distance = dr.sqrt(sum(c * c for c in offset))
            view_gradient_norm = dr.select(finite, dr.sqrt(sum(c * c for c in pull)) * distance, 0)
        told = StepReport(dr.detach(loss), view_gradient_norm)
        dr.eval(adam, mean, trouble, told)
        return mean, trouble, told

    if evaluation is None or evaluation.recordable:
        return Recorded(step, state)

    def unrecorded(*arguments: Any) -> tuple[Params, NonFiniteReport, StepReport]:
        # A recording takes its arguments as opaque: a row that is a constant of kernels would compile them anew.
        dr.make_opaque(arguments)
        result = step(*arguments)
        evaluation.release()
        return result

    return unrecorded


def evaluated(
    report: Report,
    params: Mapping[str, Any],
    condition: NDArray[Any],
    receiver: int,
    pose: Pose,
    plane: Plane,
    slots: NDArray[Any] | None = None,
    weight: NDArray[Any] | None = None,
) -> Any:
    """A report of conditions [3 or features, m], evaluated without gradients.

    Args:
        report: see `wrf_mi.graph.Graph.report`.
        params: its parameters.
        condition: positions, metres, or features.
        receiver: its number.
        pose: of the receiver.
        plane: its directions.
        slots: rows of the traced side [m]; None: the first m.
        weight: of the Gaussians' signal [m]; None: 1.
    """
    with dr.suspend_grad():
        rows = on_device(np.arange(condition.shape[1]) if slots is None else slots, mi.UInt32)
        own = None if weight is None else to_float(weight)
        tx = to_tensor(np.ascontiguousarray(condition))
        found = report(params, Batch(tx, rows, dr.opaque(mi.UInt32, receiver), pose, plane, own))
        dr.eval(found)
    return found


class CompiledPredictor:
    """A prediction ``predict(params, tx_pos, pose, plane) -> greys``, without gradients.

    It is recorded, but for fields of so many Gaussians that networks see them in parts (`gaussians_in_parts`): there,
    recording saves nothing, and lists of tiles, which a recorded function cannot count, have room for all.

    Args:
        field: the model.
        skip: what is not evaluated.
    """

    def __init__(self, field: Field, skip: Skip = NOTHING) -> None:
        self._field, self._skip = field, skip

        @Recorded
        def recorded(params: Params, tx_pos: Any, pose: Pose, plane: Plane) -> Any:
            with dr.suspend_grad():
                return grey(field, params, tx_pos, pose, plane, skip)

        self._recorded = recorded

    def __call__(self, params: Params, tx_pos: Any, pose: Pose, plane: Plane) -> Any:
        """Greys [batch * height * width]."""
        if params["position"].shape[1] * tx_pos.shape[1] <= CHUNK_SIZE:
            return self._recorded(params, tx_pos, pose, plane)
        with dr.suspend_grad():
            re, im = splat(gaussians_in_parts(self._field, params, tx_pos), pose, plane, self._skip)
            return dr.sqrt(re * re + im * im + SQUARED_MAGNITUDE_EPS)

    @property
    def n_recordings(self) -> int:
        """How often it was recorded."""
        return self._recorded.n_recordings
