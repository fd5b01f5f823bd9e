"""How the networks of this package are fitted: Adam on a recorded step, steps chosen on validation rows.

One rule for all. First the network learns from the training rows alone and the running mean of its parameters is
scored on the validation rows at regular steps; then it goes on from the best of those moments, with a learning rate
that falls to zero (half a cosine), from all training rows, for a stated share of the steps that led there. So whatever
is open is chosen on validation rows, and the result has seen every training row.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import reduce
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np
from drjit.opt import Adam
from numpy.typing import NDArray

from ..backend.device import to_tensor
from ..core import InputError, Record, Split
from ..core.types import IntArray
from ..field.network import Weights
from ..fit.adam import NumericsError, watched_groups
from ..fit.recorded import Recorded
from .method import Listen

LOG_EVERY = 50
"""Steps between two reports of progress."""


@dataclass(frozen=True)
class Training:
    """How long and how fast a network learns.

    Attributes:
        steps: largest number of steps before the validation rows join.
        batch: samples of a step.
        rate: Adam's learning rate.
        warm_up: steps over which the rate rises from zero.
        averaging: decay of the running mean of the parameters, which is what predicts.
        rounds: how often within ``steps`` the validation rows are scored.
        refit: steps on all training rows after the best round, as a share of the steps that led there.
    """

    steps: int = 2000
    batch: int = 16
    rate: float = 1e-3
    warm_up: int = 100
    averaging: float = 0.998
    rounds: int = 8
    refit: float = 0.25

    def __post_init__(self) -> None:
        """Refuse what is no training.

        Raises:
            InputError: naming the setting.
        """
        if min(self.steps, self.batch, self.rounds) < 1 or self.warm_up < 0:
            raise InputError(
                f"training: {self.steps} steps of {self.batch} samples, {self.rounds} rounds; all at least 1"
            )
        if not (self.rate > 0 and 0 <= self.averaging < 1 and self.refit > 0):
            raise InputError(
                f"training: rate {self.rate}, averaging {self.averaging}, refit {self.refit}; choose "
                "a positive rate and share and an averaging in [0, 1)"
            )


Loss = Callable[[Mapping[str, Any], Any, Any], Any]
"""``loss(params, data, given)``: one Dr.Jit float; ``data`` stays, ``given`` is another for each step."""


class Descent:
    """Parameters that go down a loss by Adam; the step is recorded at its first call.

    Args:
        weights: starting values.
        loss: to be made small. It must capture no array and read no value (`dr.freeze`).
        averaging: decay of the running mean.
        momentum: Adam's decay of the first moment.
        shares: learning rates of parameters in units of that of a step, where it is not one.
    """

    def __init__(
        self,
        weights: Weights,
        loss: Loss,
        averaging: float,
        momentum: float = 0.9,
        shares: Mapping[str, float] | None = None,
    ) -> None:
        self._averaging, self._momentum = averaging, momentum
        self.taken = 0
        self._start({name: to_tensor(values) for name, values in weights.items()}, None)
        names, own = list(weights), dict(shares or {})

        @Recorded
        def step(adam: Adam, mean: dict[str, Any], data: Any, given: Any, rate: Any, decay: Any, fine: Any) -> Any:
            # A rate of its own for each parameter: Adam multiplies a shared array in place, once a parameter.
            adam.set_learning_rate({name: rate * own.get(name, 1.0) for name in names})
            params = {name: adam[name] for name in names}
            value = loss(params, data, given)
            dr.backward(value)
            sums = [dr.sum(dr.abs(dr.grad(params[n]).array)) for n in watched_groups(names)]
            fine = fine & reduce(operator.and_, [dr.isfinite(s) for s in [dr.detach(value), *sums]])
            adam.step(eval=False, active=fine)
            share = dr.select(fine, decay, 1)
            mean = {name: dr.lerp(dr.detach(adam[name]), mean[name], share) for name in names}
            value = dr.detach(value)
            dr.eval(adam, mean, value, fine)
            return mean, value, fine

        self._step = step

    def _start(self, params: Mapping[str, Any], mean: Mapping[str, Any] | None) -> None:
        self.adam = Adam(lr=0.0, beta_1=self._momentum)
        self.adam.update(dict(params))
        self.mean = dict(mean or {name: values + 0 for name, values in params.items()})
        self._fine = dr.opaque(mi.Bool, True)
        dr.make_opaque(self.mean)

    @property
    def params(self) -> dict[str, Any]:
        """Current parameters, without gradients."""
        return {name: dr.detach(self.adam[name]) for name in self.adam}

    def step(self, data: Any, given: Any, rate: float) -> Any:
        """Take one step; the loss before it, a Dr.Jit float. After one that was not finite nothing changes any more."""
        # A young mean forgets faster, or it would be mostly the starting values.
        decay = min(self._averaging, (self.taken + 1) / (self.taken + 10))
        self.mean, value, self._fine = self._step(
            self.adam, self.mean, data, given, dr.opaque(mi.Float, rate), dr.opaque(mi.Float, decay), self._fine
        )
        self.taken += 1
        return value

    def require_finite(self) -> None:
        """Look at what happened since.

        Raises:
            NumericsError: a loss or a gradient was not finite.
        """
        if not self._fine[0]:
            raise NumericsError(f"a loss or gradient within the first {self.taken} steps is not finite; lower the rate")

    def arrays(self) -> Weights:
        """The running mean, as NumPy arrays."""
        return {name: self.mean[name].numpy().copy() for name in self.mean}

    def state(self) -> tuple[Weights, Weights]:
        """Parameters and running mean, to go back to."""
        return {name: values.numpy().copy() for name, values in self.params.items()}, self.arrays()

    def restore(self, state: tuple[Weights, Weights]) -> None:
        """Go back, with Adam's moments forgotten."""
        params, mean = ({name: to_tensor(values) for name, values in part.items()} for part in state)
        self._start(params, mean)


def warm(step: int, training: Training) -> float:
    """Learning rate of a step from 0 while steps are being chosen."""
    return training.rate * min(1.0, (step + 1) / max(1, training.warm_up))


def falling(step: int, steps: int, training: Training) -> float:
    """Learning rate of a step from 0 of the last part: Adam starts without moments, so it warms up again."""
    return warm(step, training) * 0.5 * (1 + float(np.cos(np.pi * step / steps)))


class Learner(Protocol):
    """What `fit_network` fits: `Descent`, or several that learn together."""

    @property
    def taken(self) -> int:
        """Steps taken."""
        ...

    @property
    def mean(self) -> dict[str, Any]:
        """Running mean of the parameters."""
        ...

    def step(self, data: Any, given: Any, rate: float) -> Any:
        """Take a step."""
        ...

    def require_finite(self) -> None:
        """Raise `NumericsError` where something was not finite."""
        ...

    def arrays(self) -> Weights:
        """The running mean, as NumPy arrays."""
        ...

    def state(self) -> Any:
        """To go back to."""
        ...

    def restore(self, state: Any) -> None:
        """Go back."""
        ...


def fit_network(
    learner: Learner,
    data: Any,
    draw: Callable[[bool], Iterator[Any]],
    score: Callable[[Mapping[str, Any]], float] | None,
    training: Training,
    listen: Listen,
    what: str = "network",
) -> tuple[Weights, int]:
    """Fit one network by the rule of this module.

    Args:
        learner: with its starting values.
        data: what its loss needs in every step.
        draw: ``draw(everything)`` draws batches without end, from all training rows or from those that do not validate.
        score: of parameters on the validation rows, less is better; None: no such rows, so that all steps are taken
            and all training rows are learned from throughout.
        training: settings.
        listen: hears of progress.
        what: is being fitted, for the listener.

    Returns:
        The running mean of the parameters, and the number of steps that was chosen.

    Raises:
        NumericsError: a loss or gradient that is not finite.
    """
    most = training.steps + max(1, round(training.refit * training.steps))

    def walk(batches: Iterator[Any], first: int, last: int, rate: Callable[[int], float]) -> None:
        for step in range(first, last):
            learner.step(data, next(batches), rate(step))
            if (step + 1) % LOG_EVERY == 0 or step + 1 == last:
                learner.require_finite()
                # The same words until something is known: a log has a line for each round, not for each step.
                listen(said, min(1.0, learner.taken / most))

    chosen, said = training.steps, f"{what}: {training.steps} steps"
    batches = draw(score is None)
    if score is None:
        walk(batches, 0, training.steps, lambda step: warm(step, training))
    else:
        best, kept, before = np.inf, None, 0
        for moment in np.unique(np.linspace(0, training.steps, training.rounds + 1).round().astype(int)[1:]):
            walk(batches, before, int(moment), lambda step: warm(step, training))
            before, value = int(moment), score(learner.mean)
            said = f"{what}: validation {value:.4g} after {before} of {training.steps} steps"
            if value < best:
                best, kept, chosen = value, learner.state(), before
        if kept is None:
            raise NumericsError("validation scores are not finite; lower the rate")
        learner.restore(kept)
    last = max(1, round(training.refit * chosen))
    said = f"{what}: {last} steps on all rows after {chosen}"
    walk(draw(True), 0, last, lambda step: falling(step, last, training))
    listen(f"{what}: {chosen} steps chosen", 1.0)
    return learner.arrays(), chosen


def epochs(rows: IntArray, batch: int, rng: np.random.Generator) -> Iterator[IntArray]:
    """Batches of a constant size without end: every row once in each pass, in random order."""
    waiting = np.empty(0, np.int64)
    while True:
        while len(waiting) < batch:
            waiting = np.concatenate([waiting, rng.permutation(rows)])
        yield waiting[:batch]
        waiting = waiting[batch:]


def usable_rows(record: Record, split: Split, receiver: int, what: str) -> tuple[IntArray, IntArray]:
    """Rows to train on while choosing, and rows to choose by, of one receiver: those that it received.

    Raises:
        InputError: it received no training row, or one.
    """
    seen = np.isfinite(record.observation[receiver]).reshape(len(record), -1).all(axis=1)
    train, validation = (rows[seen[rows]] for rows in (split.train, split.validation))
    if len(train) == 0:
        train, validation = validation, train
    if len(train) == 0:
        name = record.receivers[receiver].name
        raise InputError(f"{what}: receiver {name} received no training row of {record.name}; use another split")
    if len(train) + len(validation) == 1:
        name = record.receivers[receiver].name
        raise InputError(f"{what}: receiver {name} has one training row of {record.name}; nothing varies, use more")
    return train, validation


def positions(record: Record, what: str) -> NDArray[np.float64]:
    """Positions of the moving end [n, 3].

    Raises:
        InputError: the data do not tell them.
    """
    if not np.isfinite(record.tx_pos_m).all():
        row = int(np.flatnonzero(~np.isfinite(record.tx_pos_m).all(axis=1))[0])
        raise InputError(f"{what}: {record.name} has no position in row {row}; choose a method that needs none")
    return record.tx_pos_m


def opaque_rows(rows: IntArray) -> Any:
    """Indices as an evaluated Dr.Jit array."""
    return mi.UInt32(np.asarray(rows).tolist())


def keyed(prefix: str, weights: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Arrays under ``prefix/``."""
    return {f"{prefix}/{name}": values for name, values in weights.items()}


def under(prefix: str, arrays: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """What `keyed` put under ``prefix/``."""
    return {k.removeprefix(f"{prefix}/"): v for k, v in arrays.items() if k.startswith(f"{prefix}/")}
