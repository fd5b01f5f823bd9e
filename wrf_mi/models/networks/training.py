"""How the networks of this package are fitted: by the loop of `wrf_mi.training.loop`, like Gaussians and paths.

First a network learns from the training rows alone, at a constant rate, and the running mean of its parameters is
scored on the validation rows at regular steps; then it goes on from the best of those moments, with a rate that falls
to zero, from all training rows, for a share of the steps that led there. So whatever is open is chosen on validation
rows, and the result has seen every training row.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from drjit.opt import Adam
from numpy.typing import NDArray

from ...backend.recorded import Recorded
from ...core import InputError, Record, Split
from ...core.types import IntArray
from ...gaussians.network import Weights
from ...training.adam import NonFiniteReport, Params, guarded_step, rated_params
from ...training.checkpoint import CHECKPOINT, read_checkpoint, write_checkpoint
from ...training.loop import Progress, TrainingLoop
from ...training.loop_config import AdamConfig, LoopConfig
from ...training.schedule import plan
from ...training.session import FitSession
from ...training.state import FitState

HOLD_OUT = 0.8
"""Share of the steps that choose, at a constant rate; in the rest it falls."""
FINISHED = "finished/"
"""Prefix of the arrays of networks in ``checkpoint.npz`` whose training has ended."""


def network_adam(rate: float = 1e-3) -> AdamConfig:
    """Adam with a rate that is constant while validation rows choose, and then falls to zero."""
    return AdamConfig(rate, cosine_start=HOLD_OUT, final=0.0, ema_decay=0.998)


@dataclass(frozen=True)
class NetworkSettings(LoopConfig):
    """Settings of the loop, see `LoopConfig`, with the defaults of networks."""

    holdout_steps_fraction: float = HOLD_OUT
    patience: int = 8
    optimiser: AdamConfig = field(default_factory=network_adam)

    def __post_init__(self) -> None:
        """Refuse values that no fit can use.

        Raises:
            InputError: naming the setting.
        """
        super().__post_init__()
        if not self.optimiser.network:
            raise InputError("setting optimiser.network: 0.0 is out of range, choose more than 0")


@dataclass(frozen=True)
class Network:
    """A network to be trained.

    Attributes:
        name: for progress and checkpoint.
        weights: starting values.
        loss: ``loss(params, data, given)``, one Dr.Jit float. It must capture no array and read no value (`dr.freeze`).
        data: Dr.Jit arrays that the loss needs in every step.
        draw: ``draw(rows, receiver, rng)``: Dr.Jit arrays of a step, from its batch, the number of its receiver in
            ``train`` and a generator of random numbers.
        train: samples of each receiver that train while others validate.
        everything: all samples of each receiver.
        score: of parameters on the validation rows; None: there are no such rows.
        label: of that score.
        higher_is_better: which way of it is better.
        rates: learning rates of parameters that have not that of all networks.
        momentum: Adam's decay of the first moment.
    """

    name: str
    weights: Weights
    loss: Callable[[Mapping[str, Any], Any, Any], Any]
    data: Any
    draw: Callable[[IntArray, int, np.random.Generator], Any]
    train: Sequence[IntArray]
    everything: Sequence[IntArray]
    score: Callable[[Mapping[str, Any]], float] | None
    label: str
    higher_is_better: bool = False
    rates: Mapping[str, float] = field(default_factory=dict)
    momentum: float = 0.9


class NetworkTrainer(TrainingLoop):
    """The training loop of one network.

    Args:
        network: with its starting values.
        config: settings of the loop.
        seed: of the order of samples and of what else is drawn.
        state: of a training that was stopped, to go on from.

    Raises:
        InputError: no sample that trains.
    """

    def __init__(
        self, network: Network, config: LoopConfig, seed: Sequence[int], state: FitState | None = None
    ) -> None:
        self.network, self.config, self._seed = network, config, tuple(seed)
        self.label, self.higher_is_better = network.label, network.higher_is_better
        self.schedule = plan(config, network.train, network.everything, np.random.default_rng([*seed, 1]))
        self.state = state or FitState(network.weights, network.momentum)
        if self.state.chosen:
            self.schedule, _ = self.schedule.after(self.state.chosen)
        self.record_functions()

    def record_functions(self) -> None:
        """See `TrainingLoop`."""
        rate, own, loss_of = self.config.optimiser.network, self.network.rates, self.network.loss
        rates = {name: own.get(name, rate) for name in self.state.adam}

        def step(
            adam: Adam,
            mean: Params,
            data: Any,
            given: Any,
            factor: Any,
            decay: Any,
            number: Any,
            trouble: NonFiniteReport,
        ) -> tuple[Params, NonFiniteReport, Any]:
            params = rated_params(adam, rates, factor)
            loss = loss_of(params, data, given)
            mean, trouble, _ = guarded_step(adam, params, loss, mean, decay, number, trouble)
            loss = dr.detach(loss)
            dr.eval(adam, mean, trouble, loss)
            return mean, trouble, loss

        self._step = Recorded(step)

    def take_step(self, trouble: NonFiniteReport) -> tuple[Any, NonFiniteReport]:
        """See `TrainingLoop`."""
        state, schedule, t = self.state, self.schedule, self.state.step
        # A generator of its own for each step: a resumed training draws what an uninterrupted one would.
        rng = np.random.default_rng([*self._seed, 2, t])
        state.mean, trouble, loss = self._step(
            state.adam,
            state.mean,
            self.network.data,
            self.network.draw(schedule.rows[t], int(schedule.receiver[t]), rng),
            dr.opaque(mi.Float, float(schedule.factor[t])),
            dr.opaque(mi.Float, float(schedule.decay[t])),
            dr.opaque(mi.UInt32, t + 1),
            trouble,
        )
        return loss, trouble

    def validate(self) -> float:
        """See `TrainingLoop`."""
        return float("nan") if self.network.score is None else self.network.score(self.state.mean)


def train_network(
    network: Network, config: LoopConfig, seed: Sequence[int], session: FitSession
) -> tuple[Weights, float]:
    """Train a network, from its checkpoint in the session's folder if there is one.

    Networks of one fit, which differ in their names, share that file: what has ended stays in it.

    Args:
        network: with its starting values.
        config: settings of the loop.
        seed: of all that is drawn.
        session: folder, progress and stop.

    Returns:
        The running mean of the parameters, and the best score on validation rows, the higher the better.

    Raises:
        InputError: no sample that trains.
        Interrupted: stopped between two steps; the checkpoint is written.
        NumericsError: a value that is not finite.
    """
    folder, own = session.folder, f"{FINISHED}{network.name}"
    stored = read_checkpoint(folder) if folder is not None and (folder / CHECKPOINT).exists() else {}
    if f"{own}/score" in stored:
        return under(f"{own}/mean", stored), float(stored[f"{own}/score"])
    beside = {key: values for key, values in stored.items() if key.startswith(FINISHED)}
    beside["network"] = np.asarray(network.name)
    begun = "network" in stored and str(stored["network"]) == network.name
    state = FitState.from_arrays(stored, network.momentum) if begun else None
    trainer = NetworkTrainer(network, config, seed, state)
    trainer.seconds = float(stored.get("seconds", 0.0))

    def save() -> None:
        if folder is not None:
            write_checkpoint(folder, trainer, beside)

    def heard(progress: Progress) -> None:
        session.tell(network.name, progress.step / config.steps, progress)

    if not trainer.run(heard, save, session.stop):
        raise session.interrupted(f"after step {trainer.state.step} of {config.steps} of {network.name}")
    weights, score = trainer.state.mean_params(), trainer.state.best_score
    beside |= keyed(f"{own}/mean", weights) | {f"{own}/score": np.asarray(score)}
    save()
    return weights, score


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
