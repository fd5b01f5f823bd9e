"""Optimiser steps and evaluations of a graph, as functions that `dr.freeze` can record.

Arguments that change from step to step are opaque, so that Dr.Jit replays the recorded kernels; a captured array or a
changing Python number would be traced anew each time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from drjit.opt import Adam
from numpy.typing import NDArray

from ..backend.device import Recorded, on_device, to_float, to_tensor
from ..backend.vectors import Complex, Pose
from ..core import InputError, Receiver
from ..gaussians.attributes import attributes_of
from ..gaussians.tiles import perception_plane
from ..graph.graph import LEVEL, Batch, Graph, ObservationFunction
from ..graph.settings import TRACED_NAMES
from ..tasks import Loss
from .adam import NonFiniteReport, Params, Schedule, ScheduledStep, guarded_step, rated_params
from .fit_plan import FIELD, FitPlan
from .loop import FitState
from .targets import Targets

StepFunction = Callable[..., tuple[Params, NonFiniteReport, Any, Any]]
"""Takes a step of an optimiser in place, by `Steps._recorded`; returns running mean, report, loss of the batch before
the step, and norm of the gradient by each Gaussian's direction from the receiver, [n]."""
CENTRES = "position"  # parameter [3, n] of every field with Gaussians


def device_pose(receiver: Receiver, float_type: Any = None) -> Pose:
    """A receiver's pose as opaque device arrays of ``float_type``, by default ``mi.Float``."""
    parts = receiver.position_m, *receiver.to_world
    position, *rows = ([dr.opaque(float_type or mi.Float, float(x)) for x in part] for part in parts)
    return Pose(position, rows)


def port_batches(graph: Graph) -> list[Batch]:
    """A batch without transmitters at each port of a graph."""
    plane, batches = perception_plane(*graph.form.size, mi.Float), list[Batch]()
    for port in range(len(graph.models)):
        receiver, log_carrier = port // graph.carriers, graph.log_carrier(port)
        carrier = None if log_carrier is None else dr.opaque(mi.Float, log_carrier)
        pose = device_pose(graph.receivers[receiver])
        batches.append(Batch(None, None, dr.opaque(mi.UInt32, receiver), pose, plane, carrier=carrier))
    return batches


@dataclass
class TrainingData:
    """Conditions and observations on the device (`Targets`)."""

    condition: Any  # conditions of all rows, tensor [3, c] in metres or [features, c]
    observed: Any  # observations of all receivers and conditions, flat
    scale: Any  # inverse unit of each receiver, [n_rx]
    weight: Any = None  # factors of the observations' differences in the loss, in the order of ``observed``; None: 1

    @classmethod
    def of(cls, targets: Targets) -> TrainingData:
        """The targets of a fit on the device."""
        weight = None if targets.weight is None else to_float(targets.weight)
        return cls(to_tensor(targets.condition), to_float(targets.observed), to_float(1 / targets.unit), weight)

    def select(self, conditions: Any, receiver: Any, values: int) -> tuple[Any, Any, Any]:
        """Some conditions [3 or features, batch] and their observations [batch * values] at one receiver, and the
        factor of differences in the loss: one value, or [batch * values] with ``weight``.
        """
        features, count = self.condition.shape
        batch, index_type = dr.width(conditions), type(conditions)
        flat, observed_type = self.condition.array, type(self.observed)
        columns = [dr.gather(type(flat), flat, conditions + i * count) for i in range(features)]
        # Observations are [receiver, condition, value], flat.
        value = dr.arange(index_type, batch * values)
        pair = dr.gather(index_type, conditions, value // values) + receiver * count
        factor = dr.gather(observed_type, self.scale, receiver)
        if self.weight is not None:
            factor *= dr.gather(observed_type, self.weight, pair)
        observed = dr.gather(observed_type, self.observed, pair * values + value % values)
        return type(self.condition)(dr.concat(columns), (features, batch)), observed, factor


class Steps:
    """Optimiser steps of a fit, recorded by port where the evaluation of the Gaussians allows it.

    Attributes:
        loss: loss of a batch.
        recorded: functions that take a step, by what they depend on beside their arguments.
    """

    def __init__(self, plan: FitPlan, loss: Loss) -> None:
        self._plan, self.loss = plan, loss
        self._data, self._batches = TrainingData.of(plan.targets), port_batches(plan.graph)
        self.recorded: dict[Any, StepFunction] = {}

    def take(self, state: FitState, schedule: Schedule, non_finite: NonFiniteReport) -> tuple[Any, NonFiniteReport]:
        """Take the step of a schedule that follows the steps of a state; returns its loss and report."""
        t = state.step
        port, conditions = int(schedule.receiver[t]), schedule.rows[t]
        function = self._function(port, state)
        batch = replace(self._batches[port], slots=mi.UInt32(self._plan.slots(port, conditions).tolist()))
        step = ScheduledStep.of(schedule, t, non_finite)
        state.mean, non_finite, loss, view_gradient_norm = function(
            state.adam, state.mean, self._data, mi.UInt32(conditions.tolist()), batch, step
        )
        state.view_gradient_norm += view_gradient_norm
        state.view_gradient_steps += 1
        dr.schedule(state.view_gradient_norm)  # evaluated together with the loop's sum of losses
        return loss, non_finite

    def _function(self, port: int, state: FitState) -> StepFunction:
        """Recorded step of a port; without paths one serves all, else each search for paths needs another."""
        plan, traced_field = self._plan, self._plan.traced_fields[port]
        graph, params = plan.graph, dict(state.adam.items())
        if traced_field is not None and traced_field.refresh(params):
            state.searched_m[port] = traced_field.searched_at_m
        # A chosen reach of 0 is that of no Gaussians.
        learned = traced_field is None or (plan.trains == FIELD and not (state.chosen and state.reach_m == 0))
        arrays, surface = graph.arrays(port, traced_field), plan.trains_surfaces
        key = (
            (None,) if traced_field is None and not arrays else (port, traced_field and traced_field.searches, learned)
        )
        if key not in self.recorded:
            # Recordings of an earlier search hold its paths: they are dropped with them.
            self.recorded = {k: v for k, v in self.recorded.items() if k[0] != port}
            observe, read = graph.observation(port, traced_field, learned, surface=surface), None
            if key != (None,):
                # Arrays that are made from NumPy's memory at first use must exist before a recording.
                condition = plan.targets.condition[:, plan.port_rows[port][:1] * plan.targets.per_row]
                evaluated(observe, params, batch_on_device(self._batches[port], condition))
                read = partial(graph.arrays, port, traced_field)
            self.recorded[key] = self._recorded(observe, self._rates(params), read)
        return self.recorded[key]

    def _rates(self, names: Mapping[str, Any]) -> dict[str, float]:
        o, traced = self._plan.config.optimiser, self._plan.graph.traced
        rates = {name: getattr(o, name) for name in ("position", "rotation", "opacity", "signal")}
        rates |= {"log_scale": o.scale, LEVEL: o.level}
        rates |= {attribute.name: attribute.rate for attribute in attributes_of(self._plan.graph.field)}
        # Parameters of networks have a dot in their names (`wrf_mi.gaussians.network.init_layer`).
        unknown = [name for name in names if "." not in name and name not in rates]
        if unknown:
            text = f"no learning rate for parameter {', '.join(unknown[:6])} of the field; known are {', '.join(rates)}"
            raise InputError(f"{text}, and parameters of networks, named layer.part")
        return {
            name: traced.rate(name) if name.startswith(TRACED_NAMES) else rates.get(name, o.network) for name in names
        }

    def _recorded(
        self, observe: ObservationFunction, rates: Mapping[str, float], read: Callable[[], Any] | None
    ) -> StepFunction:
        """A step by an observation; ``read`` returns arrays that ``observe`` reads beside its arguments."""
        evaluation, loss_of = self._plan.graph.evaluation, self.loss
        shape = self._plan.targets.observed.shape[2:]

        # ``conditions`` are numbers of those of the batch, which are drawn from ``data``.
        def step(adam: Adam, mean: Params, data: TrainingData, conditions: Any, batch: Batch, at: ScheduledStep) -> Any:
            params = rated_params(adam, rates, at.factor)
            condition, observed, scale = data.select(conditions, batch.receiver, math.prod(shape))
            observed = observed * scale
            # Evaluated with the observation's first kernels, so that those of the loss and its reverse pass do not
            # gather again.
            dr.schedule(observed, scale)
            # In the receiver's unit, so that learning rates suit observations of any scale.
            prediction = observe(params, replace(batch, condition=condition))
            loss = loss_of(prediction * scale, observed, dr.width(conditions), *shape)
            mean, non_finite, finite = guarded_step(adam, params, loss, mean, at)
            result = mean, non_finite, dr.detach(loss), _view_gradient_norm(params, batch.pose, finite)
            dr.eval(adam, result)
            return result

        if evaluation.recordable:
            return Recorded(step, read)

        def unrecorded(*arguments: Any) -> Any:
            # As in a recording: a row that is a constant would compile the kernels anew.
            dr.make_opaque(*arguments)
            result = step(*arguments)
            evaluation.release()
            return result

        return unrecorded


def _view_gradient_norm(params: Params, pose: Pose, finite: Any) -> Any:
    # Norm of the gradient by a Gaussian's centre, times its distance; 0 of a step that is not taken.
    if CENTRES not in params:
        return mi.Float(0)
    offset = [dr.detach(params[CENTRES])[k].array - pose.position[k] for k in range(3)]
    pull = [dr.grad(params[CENTRES])[k].array for k in range(3)]
    distance = dr.sqrt(sum(c * c for c in offset))
    return dr.select(finite, dr.sqrt(sum(c * c for c in pull)) * distance, 0)


def batch_on_device(
    port_batch: Batch,
    condition: NDArray[Any],
    slots: NDArray[Any] | None = None,
    weight: NDArray[Any] | None = None,
    signal: Complex | None = None,
) -> Batch:
    """The batch of a port (`port_batches`) with conditions [3 or features, m].

    ``slots`` are rows of the traced field [m], by default the first m; ``weight`` [m] scales the Gaussians' signal.
    """
    slots = on_device(np.arange(condition.shape[1]) if slots is None else slots, mi.UInt32)
    weight = None if weight is None else to_float(weight)
    tensor = to_tensor(np.ascontiguousarray(condition))
    return replace(port_batch, condition=tensor, slots=slots, weight=weight, signal=signal)


def evaluated(observe: ObservationFunction, params: Mapping[str, Any], batch: Batch) -> Any:
    """Observations of a batch, evaluated without gradients."""
    with dr.suspend_grad():
        predicted = observe(params, batch)
        dr.eval(predicted)
    return predicted
