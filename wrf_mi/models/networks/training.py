"""Networks that hold their weights, on Dr.Jit tensors whose columns are samples, and their training.

A network first learns from the rows that train, at a constant rate, and the running mean of its parameters is scored on
the validation rows at regular steps. Training then continues from the best of those steps on all training rows, with a
rate that falls to zero, for a share of the steps that led there.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field
from typing import Any, Self

import drjit as dr
import mitsuba as mi
import numpy as np
from drjit import nn
from drjit.opt import Adam
from numpy.typing import ArrayLike, NDArray

from ...backend.device import to_tensor
from ...backend.recorded import Recorded
from ...core import InputError
from ...core.angles import FloatArray
from ...core.types import IntArray
from ...gaussians.encoding import encode, encoded_size
from ...training.adam import NonFiniteReport, Params, ScheduledStep, guarded_step, plan, rated_params
from ...training.checkpoint import CHECKPOINT, read_checkpoint, write_checkpoint
from ...training.config import AdamConfig, LoopConfig
from ...training.loop import FitState, Progress, TrainingLoop
from ...training.session import FitSession
from ..model import keyed

GAIN = float(np.sqrt(2.0))
"""Deviation of initial weights times the root of a layer's inputs, where a rectifier follows (He et al. 2015)."""
LEAST_M = 1e-3  # smallest extent that coordinates are divided by: all rows may lie at one height
relu = nn.ReLU()


class Module:
    """A network or a part of a network: every array among its attributes is a weight.

    Weights have dotted paths of attribute names: ``q.out.bias`` is the bias of the layer ``out`` of the module ``q``.
    Modules of a list ``norm`` are ``norm0``, ``norm1``, ...; those of a list ``layers`` are ``0``, ``1``, ... A
    trailing underscore is no part of a path.
    """

    def state(self) -> dict[str, Any]:
        """All weights by path."""
        weights: dict[str, Any] = {}
        _mapped(self, "", lambda path, weight: weights.setdefault(path, weight))
        return weights

    def with_state(self, weights: Mapping[str, Any]) -> Self:
        """The same network with other weights, by path."""
        changed: Self = _mapped(self, "", lambda path, _: weights[path])
        return changed

    def arrays(self, prefix: str = "") -> dict[str, NDArray[Any]]:
        """All weights by prefix and path, as NumPy arrays."""
        return {f"{prefix}{path}": np.asarray(weight) for path, weight in self.state().items()}

    def on_device(self, arrays: Mapping[str, NDArray[Any]], prefix: str = "") -> Self:
        """The same network with the weights of `arrays`, as single-precision tensors; errors as `check`."""
        self.check(arrays, prefix)
        return self.with_state({path: to_tensor(arrays[f"{prefix}{path}"]) for path in self.state()})

    def check(self, arrays: Mapping[str, NDArray[Any]], prefix: str = "") -> None:
        """Refuse weights that are missing, of another shape, or not finite: the backend would end the process."""
        for path, like in self.state().items():
            weight = arrays.get(f"{prefix}{path}")
            if weight is None or weight.shape != tuple(like.shape) or not np.isfinite(weight).all():
                text = "missing" if weight is None else f"of shape {weight.shape}, or not finite"
                raise InputError(f"weight {path} is {text}, where the settings need {tuple(like.shape)}")


def _mapped(value: Any, path: str, change: Callable[[str, Any], Any]) -> Any:
    """A module, list of modules or weight at a path, with each weight replaced by ``change(path, weight)``."""
    if isinstance(value, Module):
        changed, start = copy(value), f"{path}." if path else ""
        for name, inner in vars(value).items():
            # An attribute such as ``in_`` has the underscore because Python keeps the word.
            setattr(changed, name, _mapped(inner, start + name.removesuffix("_"), change))
        return changed
    if isinstance(value, list):
        stem = path.removesuffix("layers")
        return [_mapped(inner, f"{stem}{number}", change) for number, inner in enumerate(value)]
    return change(path, value) if isinstance(value, np.ndarray | dr.ArrayBase) else value


class Linear(Module):
    """Affine map of one input, or of the concatenation of named inputs with a matrix each.

    Weights are normal with deviation gain / sqrt(inputs) (He et al. 2015), the bias [outputs, 1] is zero. ``inputs`` is
    the number of inputs, or numbers by name; the matrix of a single input is ``hidden``. ``gain`` is `GAIN` before a
    rectifier, 1 before no activation.
    """

    bias: Any

    def __init__(
        self, inputs: int | Mapping[str, int], outputs: int, rng: np.random.Generator, gain: float = GAIN
    ) -> None:
        sizes = {"hidden": inputs} if isinstance(inputs, int) else inputs
        deviation = gain / np.sqrt(sum(sizes.values()))
        for name, size in sizes.items():
            setattr(self, name, (rng.standard_normal((outputs, size)) * deviation).astype(np.float32))
        self.bias = np.zeros((outputs, 1), np.float32)

    def __getattr__(self, name: str) -> Any:
        """The matrix of a named input."""
        raise AttributeError(f"layer without an input {name}")

    def __call__(self, *hidden: Any, **parts: Any) -> Any:
        """Outputs [outputs, n] of the inputs [size, n] by name."""
        # Matrices of named inputs spare joining them: W [a; b] = W_a a + W_b b.
        products = [getattr(self, name) @ x for name, x in [*(("hidden", x) for x in hidden), *parts.items()]]
        return sum(products[1:], products[0] + self.bias)


class Mlp(Module):
    """Hidden layers with an activation after each, and an output layer without; None: the last hidden layer is it."""

    def __init__(self, layers: list[Linear], out: Linear | None, activation: Callable[[Any], Any] = relu) -> None:
        self.layers, self.out, self.activation = layers, out, activation

    def __call__(self, *hidden: Any, **parts: Any) -> Any:
        """Outputs of the inputs of the first layer."""
        first, *others = self.layers
        x = self.activation(first(*hidden, **parts))
        for layer in others:
            x = self.activation(layer(x))
        return x if self.out is None else self.out(x)


def columns(x: Any, picked: Any) -> Any:
    """Columns of a tensor [size, n] by index, [size, batch]."""
    # `dr.take` drops the axis for a single index.
    return dr.reshape(dr.take(x, picked, axis=1), (x.shape[0], dr.width(picked)))


@dataclass(frozen=True)
class Coordinates:
    """A frame of positions, fitted on training rows."""

    centre_m: FloatArray  # mean of the training positions [3]
    extent_m: float  # largest distance from it along an axis, metres

    @classmethod
    def of(cls, positions_m: ArrayLike) -> Coordinates:
        """The frame of training positions [n, 3]."""
        p = np.asarray(positions_m, float)
        centre = p.mean(axis=0)
        return cls(centre, max(float(np.abs(p - centre).max()), LEAST_M))

    def features(self, positions_m: ArrayLike, octaves: int, scale_m: float) -> Any:
        """Features of positions [n, 3]: a Dr.Jit tensor [3 + 6 octaves, n], see `with_encoding`."""
        points = to_tensor((np.asarray(positions_m, float) - self.centre_m).T)
        return with_encoding(points, octaves, scale_m, 1 / self.extent_m)


def with_encoding(points: Any, octaves: int, scale_m: float, factor: Any) -> Any:
    """Points [3, n] times a factor, and their positional encoding, [3 + 6 octaves, n].

    NeRF's code gives its network both. ``scale_m`` is the unit of the encoding (`wrf_mi.gaussians.encoding`).
    """
    return dr.concat([points * factor, encode(points, octaves, scale_m)], axis=0)


def feature_count(octaves: int) -> int:
    """Rows of the result of `with_encoding`."""
    return 3 + encoded_size(octaves)


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
        self.schedule = plan(config, network.train, network.everything, np.random.default_rng([*seed, 1]))
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

    def take_step(self, trouble: NonFiniteReport) -> tuple[Any, NonFiniteReport]:
        """Take the next step of the schedule; returns the loss."""
        state, schedule, t = self.state, self.schedule, self.state.step
        # A new generator for each step: a resumed training draws the same numbers as an uninterrupted training.
        rng = np.random.default_rng([*self._seed, 2, t])
        state.mean, trouble, loss = self._step(
            state.adam,
            state.mean,
            self.network.data,
            self.network.draw(schedule.rows[t], int(schedule.receiver[t]), rng),
            ScheduledStep.of(schedule, t, trouble),
        )
        return loss, trouble

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
        return network.module.on_device(stored, f"{finished}/mean/"), float(stored[f"{finished}/score"])
    beside = {key: values for key, values in stored.items() if key.startswith(FINISHED)}
    beside["network"] = np.asarray(network.name)
    # A checkpoint of another network of this fit says which have finished, and nothing of this one.
    begun = "network" in stored and str(stored["network"]) == network.name
    if begun:
        network.module.check(stored, "param/")
    state = FitState.from_arrays(stored, network.momentum) if begun else None
    trainer = NetworkTrainer(network, config, seed, state)
    trainer.seconds = float(stored.get("seconds", 0.0))

    def save() -> None:
        if folder is not None:
            write_checkpoint(folder, trainer, beside)

    def on_progress(progress: Progress) -> None:
        session.tell(network.name, progress.step / config.steps, progress)

    if not trainer.run(on_progress, save, session.stop):
        raise session.interrupted(f"after step {trainer.state.step} of {config.steps} of {network.name}")
    weights, score = trainer.state.mean_params(), trainer.state.best_score
    beside |= keyed(f"{finished}/mean/", weights) | {f"{finished}/score": np.asarray(score)}
    save()
    return network.module.on_device(weights), score


def opaque_rows(rows: IntArray) -> Any:
    """Indices as an evaluated Dr.Jit array."""
    return mi.UInt32(np.asarray(rows).tolist())  # of a list: an array that wraps NumPy's memory is read beyond its end
