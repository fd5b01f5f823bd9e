"""One optimiser step and one prediction, as functions that `dr.freeze` can record.

Everything that changes from step to step comes in as an argument and is opaque, so that Dr.Jit replays the
recorded kernels; a captured array or a changing Python number would be traced anew each time.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import reduce
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from drjit.opt import Adam
from numpy.typing import NDArray

from ..backend.device import on_device, to_tensor
from ..core import Receiver
from ..field.parts import AT_ONCE, gaussians_in_parts
from ..field.recorded import Recorded
from ..graph.evaluations import Evaluation
from ..graph.graph import Batch, Field, Report
from ..graph.settings import TRACED_NAMES
from ..project.footprint import Pose
from ..splat.render import splat
from ..splat.skip import NOTHING, Skip
from ..splat.tiles import Plane

Loss = Callable[..., Any]
"""``loss(prediction, truth, batch, *shape)`` of flat arrays in the receiver's unit, a Dr.Jit float of one value."""
Params = dict[str, Any]

CENTRES = "position"
"""Parameter [3, n] of every field; where it is missing there are no Gaussians."""
DARK = 1e-8
"""Added to |R|^2 under the root, whose slope at zero is infinite: greys below 1e-4 are rounded to it."""


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
    return dr.sqrt(re * re + im * im + DARK)


@dataclass
class TrainingData:
    """Conditions and observations on the device, see `wrf_mi.fit.targets.Targets`.

    Attributes:
        condition: of all rows, tensor [3, c] in metres or [features, c].
        truth: observations of all receivers and conditions, one after the other.
        scale: one over each receiver's unit, [n_rx].
    """

    condition: Any
    truth: Any
    scale: Any

    def select(self, rows: Any, receiver: Any, values: int) -> tuple[Any, Any]:
        """Conditions [3 or features, batch] and observations [batch * values] of some conditions at one receiver."""
        k, n = self.condition.shape
        batch, index_type = dr.width(rows), type(rows)
        flat = self.condition.array
        tx = type(self.condition)(dr.concat([dr.gather(type(flat), flat, rows + i * n) for i in range(k)]), (k, batch))
        slot = dr.arange(index_type, batch * values)
        one = dr.gather(index_type, rows, slot // values) + receiver * n
        return tx, dr.gather(type(self.truth), self.truth, one * values + slot % values)


@dataclass
class StepReport:
    """What a step tells: arrays of one value, but ``urge`` [n].

    Attributes:
        loss: of the batch before the step.
        urge: length of the gradient by each Gaussian's direction from the receiver.
    """

    loss: Any
    urge: Any


@dataclass
class Trouble:
    """The first step whose loss, parameters, gradient or its square were not finite; from then on no step is taken.

    Attributes:
        step: its number from 1; 0: none so far.
        groups: 1 for the loss and for each watched group (`watched_groups`) that was not finite then, else 0.
    """

    step: Any
    groups: Any


def watched_groups(names: Iterable[str]) -> list[str]:
    """The parameters that `Trouble` watches, in its order, after the loss."""
    return [name for name in names if watched(name)]


def no_trouble(names: Iterable[str]) -> Trouble:
    """None so far, for parameters of these names."""
    none = Trouble(mi.UInt32(0), dr.zeros(mi.Float, 1 + len(watched_groups(names))))
    dr.make_opaque(none)  # a constant would be recorded as one
    return none


def watched(name: str) -> bool:
    """Whether a parameter's gradient shows any NaN or infinity of its group.

    Per-Gaussian attributes and what the traced side is made of are watched themselves, a layer through its bias, whose
    gradient is the sum of all that reaches the layer.
    """
    return "." not in name or name.endswith(".bias") or name.startswith(TRACED_NAMES)


def _health(param: Any) -> Any:
    """A number that is finite where a parameter, its gradient and the square of that, which Adam takes, are.

    A Gaussian whose shape or place is NaN is not seen, so that the loss alone would not tell.
    """
    return dr.sum(dr.square(dr.grad(param).array) + dr.abs(dr.detach(param).array))


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
    groups = watched_groups(rates)
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
        trouble: Trouble,
    ) -> tuple[Params, Trouble, StepReport]:
        # A rate of its own for each parameter: Adam multiplies a shared array in place, once a parameter.
        adam.set_learning_rate({name: factor * rates[name] for name in rates})
        params = {name: adam[name] for name in rates}
        condition, truth = data.select(rows, receiver, values)
        batch = dr.width(rows)
        prediction = report(params, Batch(condition, slots, receiver, pose, plane))
        scale = dr.gather(type(truth), data.scale, receiver)
        loss = loss_of(prediction * scale, truth * scale, batch, *shape)
        dr.backward(loss)
        sums = [dr.detach(loss), *(_health(params[name]) for name in groups)]
        fine = [dr.isfinite(s) for s in sums]
        good = reduce(operator.and_, fine)
        untroubled = trouble.step == 0
        finite = good & untroubled
        urge = mi.Float(0)
        if CENTRES in params:
            offset = [dr.detach(params[CENTRES])[k].array - pose.position[k] for k in range(3)]
            pull = [dr.grad(params[CENTRES])[k].array for k in range(3)]
            distance = dr.sqrt(sum(c * c for c in offset))
            urge = dr.select(finite, dr.sqrt(sum(c * c for c in pull)) * distance, 0)
        adam.step(eval=False, active=finite)
        share = dr.select(finite, decay, 1)
        mean = {name: dr.lerp(dr.detach(adam[name]), mean[name], share) for name in mean}
        now = dr.concat([dr.select(f, mi.Float(0), mi.Float(1)) for f in fine])
        trouble = Trouble(
            dr.select(untroubled & ~good, number, trouble.step), dr.select(untroubled, now, trouble.groups)
        )
        told = StepReport(dr.detach(loss), urge)
        dr.eval(adam, mean, trouble, told)
        return mean, trouble, told

    if evaluation is None or evaluation.recordable:
        return Recorded(step, state)

    def unrecorded(*arguments: Any) -> tuple[Params, Trouble, StepReport]:
        # A recording takes its arguments as opaque: a row that is a constant of kernels would compile them anew.
        dr.make_opaque(arguments)
        result = step(*arguments)
        evaluation.release()
        return result

    return unrecorded


def evaluated(
    report: Report, params: Mapping[str, Any], condition: NDArray[Any], receiver: int, pose: Pose, plane: Plane
) -> Any:
    """A report of conditions [3 or features, m], the first m rows of its traced side, evaluated without gradients."""
    with dr.suspend_grad():
        slots = on_device(np.arange(condition.shape[1]), mi.UInt32)
        batch = Batch(to_tensor(np.ascontiguousarray(condition)), slots, dr.opaque(mi.UInt32, receiver), pose, plane)
        found = report(params, batch)
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
        if params["position"].shape[1] * tx_pos.shape[1] <= AT_ONCE:
            return self._recorded(params, tx_pos, pose, plane)
        with dr.suspend_grad():
            re, im = splat(gaussians_in_parts(self._field, params, tx_pos), pose, plane, self._skip)
            return dr.sqrt(re * re + im * im + DARK)

    @property
    def n_recordings(self) -> int:
        """How often it was recorded."""
        return self._recorded.n_recordings
