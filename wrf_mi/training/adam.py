"""Schedule of a fit, known before its first step, and guarded steps of Adam that `dr.freeze` can record."""

from __future__ import annotations

import operator
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from drjit.opt import Adam
from numpy.typing import NDArray

from ..core import InputError
from ..core.types import IntArray
from ..graph.settings import TRACED_NAMES
from .config import AdamConfig, DensityConfig, LoopConfig


@dataclass(frozen=True)
class Schedule:
    """Rows and learning rates of each step of a fit."""

    rows: IntArray  # rows of each step's batch, [steps, batch]
    receiver: IntArray  # receiver of each step, [steps]
    factor: NDArray[np.float64]  # factor of the learning rates at each step, [steps]
    decay: NDArray[np.float64]  # decay of the running mean of the parameters at each step, [steps]
    density: frozenset[int]  # steps after which a round of density control follows
    joined: int  # first step that may train on the validation rows; ``steps`` if never

    def after(self, best: int) -> tuple[Schedule, int]:
        """The schedule that continues from the best state, of step ``best``, before the validation rows join.

        Returns:
            Schedule whose learning rates fall in fewer steps, in proportion to ``best``, and the first of these steps.
        """
        last = len(self.rows) - self.joined
        left = min(last, max(1, round(last * best / self.joined))) if last else 0
        start = len(self.rows) - left
        factor = self.factor.copy()
        if left:
            # The remaining rates in fewer steps: they still fall to their last value.
            factor[start:] = self.factor[self.joined + np.arange(left) * last // left]
        return replace(self, factor=factor), start


def schedule_of(
    config: LoopConfig,
    train: Sequence[IntArray],
    all_train: Sequence[IntArray],
    rng: np.random.Generator,
    density: frozenset[int] = frozenset(),
    falls_by_choice: bool = False,
) -> Schedule:
    """The schedule of a fit, a function of settings, rows and seed only: a resumed run gets the same.

    Each epoch visits every row once at every receiver that observed it, in random order; a batch belongs to one
    receiver and is no larger than the rows of any. An epoch omits random rows that do not fill a batch. ``train`` are
    rows (conditions) of each receiver that train while validation rows are held out, ``all_train`` all of them;
    ``density`` as in `Schedule`; ``falls_by_choice``: learning rates fall before validation rows join, and once more.

    Raises:
        InputError: a receiver without rows that train.
    """
    steps = config.steps
    joined = steps if config.holdout_steps_fraction >= 1 else round(config.holdout_steps_fraction * steps)
    # Batches have one size, as recorded kernels do.
    batch = min(config.batch, *(len(rows) for rows in (train if joined else all_train)))
    if not batch:
        beside = f" beside {max(map(len, all_train))} validation rows" if joined else ""
        raise InputError(f"no training row at one receiver{beside}: use more rows")
    epochs = _epochs(train, joined, batch, rng), _epochs(all_train, steps - joined, batch, rng)
    rows, receiver = (np.concatenate(parts) for parts in zip(*epochs, strict=True))
    t, o = np.arange(steps), config.optimiser
    factor = _falling(steps, o)
    if falls_by_choice:
        factor[:joined] = _falling(joined, o)
    # Shorten the window of the running mean early in training, or it would be mostly the starting values.
    decay = np.minimum(o.ema_decay, (t + 1) / (t + 10))
    return Schedule(rows, receiver, factor, decay, density, joined)


def _falling(steps: int, optimiser: AdamConfig) -> NDArray[np.float64]:
    # A linear warm-up, and half a cosine. Adam's moments are sums of few gradients at first, and full rates would
    # follow their noise: hence the warm-up.
    t, final = np.arange(steps), optimiser.final
    flat = round(optimiser.cosine_start * steps)
    cosine = final + (1 - final) * 0.5 * (1 + np.cos(np.pi * np.maximum(t - flat, 0) / max(1, steps - flat)))
    return np.asarray(cosine * np.minimum(1.0, (t + 1) / max(1, optimiser.warm_up)))


def density_rounds(config: DensityConfig, steps: int) -> frozenset[int]:
    """Steps after which a round of density control follows."""
    first, last = int(config.start * steps), int(config.stop * steps)
    rounds = range(config.every, steps, config.every) if config.every else ()
    return frozenset(s for s in rounds if first <= s <= last)


def _epochs(rows: Sequence[IntArray], steps: int, batch: int, rng: np.random.Generator) -> tuple[IntArray, IntArray]:
    if steps == 0:
        return np.empty((0, batch), np.int64), np.empty(0, np.int64)
    counts = [len(receiver_rows) // batch for receiver_rows in rows]
    batches, receivers = [], []
    for _ in range(-(-steps // sum(counts))):
        permuted = map(rng.permutation, rows)
        epoch = [each[: n * batch].reshape(n, batch) for each, n in zip(permuted, counts, strict=True)]
        # Batches of all receivers in turn: a receiver at a time would be forgotten while the others train.
        order = rng.permutation(sum(counts))
        batches.append(np.concatenate(epoch)[order])
        receivers.append(np.repeat(np.arange(len(rows)), counts)[order])
    return np.concatenate(batches)[:steps], np.concatenate(receivers)[:steps]


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
    """Names of the parameters that `NonFiniteReport` watches, in its order, after the loss."""
    # A layer is watched through its bias, whose gradient is the sum of all gradients that reach the layer.
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
    non_finite: NonFiniteReport  # report of the steps before

    @classmethod
    def of(cls, schedule: Schedule, t: int, non_finite: NonFiniteReport) -> ScheduledStep:
        """The step after ``t`` steps of a schedule."""
        factor, decay = (dr.opaque(mi.Float, float(values[t])) for values in (schedule.factor, schedule.decay))
        return cls(factor, decay, dr.opaque(mi.UInt32, t + 1), non_finite)


def guarded_step(
    adam: Adam, params: Params, loss: Any, mean: Params, step: ScheduledStep
) -> tuple[Params, NonFiniteReport, Any]:
    """Differentiate a loss of ``params`` (`rated_params`) and step in place, unless a value is or was not finite.

    Returns:
        Running mean, report, and whether the step was taken; all unevaluated.
    """
    dr.backward(loss)
    sums = [dr.detach(loss), *(_health(params[name]) for name in watched_groups(params))]
    fine = [dr.isfinite(s) for s in sums]
    good, non_finite = reduce(operator.and_, fine), step.non_finite
    was_finite = non_finite.step == 0
    # A masked step instead of a branch: whether values are finite is known on the device alone, and reading it here
    # would end the recording.
    finite = good & was_finite
    adam.step(eval=False, active=finite)
    share = dr.select(finite, step.decay, 1)
    mean = {name: dr.lerp(dr.detach(adam[name]), mean[name], share) for name in mean}
    now = dr.concat([dr.select(f, mi.Float(0), mi.Float(1)) for f in fine])
    # The first non_finite is reported: what follows it has other causes.
    report = NonFiniteReport(
        dr.select(was_finite & ~good, step.number, non_finite.step), dr.select(was_finite, now, non_finite.groups)
    )
    return mean, report, finite
