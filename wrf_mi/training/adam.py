"""A guarded step of Adam, as part of a function that `dr.freeze` can record."""

from __future__ import annotations

import operator
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import reduce
from typing import Any

import drjit as dr
import mitsuba as mi
from drjit.opt import Adam

from ..graph.settings import TRACED_NAMES
from .schedule import Schedule

Params = dict[str, Any]


class NumericsError(RuntimeError):
    """A loss, gradient, parameter or moment is not finite; the message names step and quantity."""

    exit_status = 1


@dataclass
class NonFiniteReport:
    """First step whose loss, parameters, gradient or squared gradient were not finite; no step is taken after it."""

    step: Any  # number of the step from 1; 0: all finite so far
    groups: Any  # 1 for the loss and for each watched group (`watched_groups`) that was not finite then, else 0

    @classmethod
    def none(cls, names: Iterable[str]) -> NonFiniteReport:
        """An empty report for parameters of these names."""
        none = cls(mi.UInt32(0), dr.zeros(mi.Float, 1 + len(watched_groups(names))))
        dr.make_opaque(none)  # a constant would be recorded as one
        return none


def watched_groups(names: Iterable[str]) -> list[str]:
    """Names of the parameters that `NonFiniteReport` watches, in its order, after the loss.

    Parameters of Gaussians and of the traced side are watched directly, a layer through its bias, whose gradient is the
    sum of all gradients that reach the layer.
    """
    return [n for n in names if "." not in n or n.endswith(".bias") or n.startswith(TRACED_NAMES)]


def _health(param: Any) -> Any:
    """A number that is finite where a parameter, its gradient and the squared gradient, which Adam uses, are finite."""
    return dr.sum(dr.square(dr.grad(param).array) + dr.abs(dr.detach(param).array))


def rated_params(adam: Adam, rates: Mapping[str, float], factor: Any) -> Params:
    """Parameters of the next step, whose learning rates are set to ``factor`` times ``rates``."""
    # A separate array for each parameter: Adam multiplies a shared array in place, once a parameter.
    adam.set_learning_rate({name: factor * rates[name] for name in rates})
    return {name: adam[name] for name in rates}


@dataclass
class ScheduledStep:
    """Numbers of one step, opaque to a recording: as Python numbers they would be recorded as constants."""

    factor: Any  # factor of the learning rates
    decay: Any  # decay of the running mean of the parameters
    number: Any  # number of the step, from 1
    trouble: NonFiniteReport  # report of the steps before

    @classmethod
    def of(cls, schedule: Schedule, t: int, trouble: NonFiniteReport) -> ScheduledStep:
        """The step after ``t`` steps of a schedule."""
        factor, decay = (dr.opaque(mi.Float, float(values[t])) for values in (schedule.factor, schedule.decay))
        return cls(factor, decay, dr.opaque(mi.UInt32, t + 1), trouble)


def guarded_step(
    adam: Adam, params: Params, loss: Any, mean: Params, step: ScheduledStep
) -> tuple[Params, NonFiniteReport, Any]:
    """Differentiate a loss of ``params`` (`rated_params`) and take a step of Adam in place, unless a value is or was
    not finite.

    Args:
        adam: optimiser that owns the parameters.
        params: parameters, which hold gradients afterwards.
        loss: loss, one value.
        mean: running mean of the parameters.
        step: numbers of the step, and the report so far.

    Returns:
        Running mean, report, and whether the step was taken; all unevaluated.
    """
    dr.backward(loss)
    sums = [dr.detach(loss), *(_health(params[name]) for name in watched_groups(params))]
    fine = [dr.isfinite(s) for s in sums]
    good, trouble = reduce(operator.and_, fine), step.trouble
    untroubled = trouble.step == 0
    # A masked step instead of a branch: whether values are finite is known on the device alone, and reading it here
    # would end the recording.
    finite = good & untroubled
    adam.step(eval=False, active=finite)
    share = dr.select(finite, step.decay, 1)
    mean = {name: dr.lerp(dr.detach(adam[name]), mean[name], share) for name in mean}
    now = dr.concat([dr.select(f, mi.Float(0), mi.Float(1)) for f in fine])
    # The first trouble is reported: what follows it has other causes.
    report = NonFiniteReport(
        dr.select(untroubled & ~good, step.number, trouble.step), dr.select(untroubled, now, trouble.groups)
    )
    return mean, report, finite
