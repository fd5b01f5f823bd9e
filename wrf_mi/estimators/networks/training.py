"""Training of networks by the loop of `wrf_mi.training.loop`.

A network first learns from the rows that train, at a constant rate, and the running mean of its parameters is scored on
the validation rows at regular steps. Training then continues from the best of those steps on all training rows, with a
rate that falls to zero, for a share of the steps that led there.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from drjit.opt import Adam

from ...backend.device import Recorded
from ...core import InputError
from ...core.array_files import keyed, under
from ...core.types import IntArray
from ...training.adam import NonFiniteReport, Params, ScheduledStep, guarded_step, rated_params, schedule_of
from ...training.checkpoint import CHECKPOINT, read_checkpoint, write_checkpoint
from ...training.config import AdamConfig, LoopConfig
from ...training.loop import FitState, Progress, TrainingLoop
from ...training.session import FitSession
from .layers import Module

HOLD_OUT = 0.8  # share of the steps with a constant rate and validation rows kept out of training
FINISHED = "finished/"  # prefix in ``checkpoint.npz`` of the arrays of networks whose training has ended


def network_adam(rate: float = 1e-3) -> AdamConfig:
    """Adam with a rate that is constant while validation rows choose, and then falls to zero."""
    return AdamConfig(rate, cosine_start=HOLD_OUT, final=0.0, ema_decay=0.998)


@dataclass(frozen=True)
class NetworkSettings(LoopConfig):
    """Settings of the training loop (`LoopConfig`) with the defaults of networks."""

    holdout_steps_fraction: float = HOLD_OUT
    patience: int = 8
    optimiser: AdamConfig = field(default_factory=network_adam)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.optimiser.network:
            raise InputError("setting optimiser.network: 0.0 is out of range, choose more than 0")


@dataclass(frozen=True)
class Network:
    """A network with its loss, data and score."""

    name: str  # name for progress and checkpoint
    module: Module  # network with its initial weights
    # ``loss(module, data, drawn)``, one Dr.Jit float. It must capture no array and read no value (`dr.freeze`)
    loss: Callable[[Any, Any, Any], Any]
    data: Any  # Dr.Jit arrays that the loss needs in every step
    # ``draw(rows, receiver, rng)``: Dr.Jit arrays of a step, from its batch, the number of its receiver in ``train``
    # and a generator of random numbers
    draw: Callable[[IntArray, int, np.random.Generator], Any]
    train: Sequence[IntArray]  # samples of each receiver that train while others validate
    everything: Sequence[IntArray]  # all samples of each receiver
    score: Callable[[Any], float] | None  # score of a module on the validation rows; None: there are no such rows
    label: str
    higher_is_better: bool = False
    # Learning rates by path of a weight; `AdamConfig.network` for all others
    rates: Mapping[str, float] = field(default_factory=dict)
    momentum: float = 0.9  # Adam's decay of the first moment


class NetworkTrainer(TrainingLoop):
    """Training loop of a network, from its initial weights or from the ``state`` of an interrupted training."""

    def __init__(
        self, network: Network, config: LoopConfig, seed: Sequence[int], state: FitState | None = None
    ) -> None:
        self.network, self.config, self._seed = network, config, tuple(seed)
        self.label, self.higher_is_better = network.label, network.higher_is_better
        self.schedule = schedule_of(config, network.train, network.everything, np.random.default_rng([*seed, 1]))
        self.state = state or FitState(network.module.state(), network.momentum)
        if self.state.chosen:
            self.schedule, _ = self.schedule.after(self.state.chosen)
        self.record_functions()

    def record_functions(self) -> None:
        """Record the training step."""
        rate, special, loss_of = self.config.optimiser.network, self.network.rates, self.network.loss
        rates, module = {name: special.get(name, rate) for name in self.state.adam}, self.network.module

        def step(
            adam: Adam, mean: Params, data: Any, drawn: Any, at: ScheduledStep
        ) -> tuple[Params, NonFiniteReport, Any]:
            params = rated_params(adam, rates, at.factor)
            loss = loss_of(module.with_state(params), data, drawn)
            mean, report, _ = guarded_step(adam, params, loss, mean, at)
            loss = dr.detach(loss)  # the graph behind it would keep the step's arrays alive
            dr.eval(adam, mean, report, loss)
            return mean, report, loss

        self._step = Recorded(step)

    def take_step(self, non_finite: NonFiniteReport) -> tuple[Any, NonFiniteReport]:
        """Take the next step of the schedule; returns the loss."""
        state, schedule, t = self.state, self.schedule, self.state.step
        # A new generator for each step: a resumed training draws the same numbers as an uninterrupted training.
        rng = np.random.default_rng([*self._seed, 2, t])
        drawn = self.network.draw(schedule.rows[t], int(schedule.receiver[t]), rng)
        at = ScheduledStep.of(schedule, t, non_finite)
        state.mean, non_finite, loss = self._step(state.adam, state.mean, self.network.data, drawn, at)
        return loss, non_finite

    def validate(self) -> float:
        """Score of the running mean of the weights on the validation rows; NaN without such rows."""
        network = self.network
        return float("nan") if network.score is None else network.score(network.module.with_state(self.state.mean))


def train_network(network: Network, config: LoopConfig, seed: Sequence[int], session: FitSession) -> tuple[Any, float]:
    """Train a network, from its checkpoint in the session's folder if it exists.

    Networks of one fit differ in their names and share that file, in which finished ones stay.

    Returns:
        The module with the running mean of its weights on the device, and the best score on validation rows, the higher
        the better.

    Raises:
        InputError: no sample that trains.
        Interrupted: stopped between two steps; the checkpoint is written.
        NumericsError: a value that is not finite.
    """
    folder, finished = session.folder, f"{FINISHED}{network.name}"
    stored = read_checkpoint(folder) if folder is not None and (folder / CHECKPOINT).exists() else {}
    if f"{finished}/score" in stored:
        return network.module.on_device(under(f"{finished}/mean/", stored)), float(stored[f"{finished}/score"])
    beside = keyed(FINISHED, under(FINISHED, stored))
    beside["network"] = np.asarray(network.name)
    # A checkpoint of another network of this fit says which have finished, and nothing of this one.
    begun = "network" in stored and str(stored["network"]) == network.name
    if begun:
        network.module.check(under("param/", stored))
    state = FitState.from_arrays(stored, network.momentum) if begun else None
    trainer = NetworkTrainer(network, config, seed, state)
    trainer.seconds = float(stored.get("seconds", 0.0))

    def save() -> None:
        if folder is not None:
            write_checkpoint(folder, trainer, beside)

    def on_progress(progress: Progress) -> None:
        session.on_progress(network.name, progress.step / config.steps, progress)

    if not trainer.run(on_progress, save, session.stop):
        raise session.interrupted(f"after step {trainer.state.step} of {config.steps} of {network.name}")
    weights, score = trainer.state.mean_params(), trainer.state.best_score
    beside |= keyed(f"{finished}/mean/", weights) | {f"{finished}/score": np.asarray(score)}
    save()
    return network.module.on_device(weights), score


def opaque_rows(rows: IntArray) -> Any:
    """Indices as an evaluated Dr.Jit array."""
    return mi.UInt32(np.asarray(rows).tolist())  # of a list: an array that wraps NumPy's memory is read beyond its end
