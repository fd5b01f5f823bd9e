"""What happens at which step: rows, learning rates, rounds of density control. All of it known before the first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core import InputError, Split
from ..core.types import IntArray
from .config import TrainConfig


@dataclass(frozen=True)
class Schedule:
    """The plan of a fit.

    Attributes:
        rows: rows of each step's batch, [steps, batch].
        receiver: the receiver of each step, [steps].
        factor: share of the learning rates at each step, [steps].
        decay: decay of the running mean of the parameters at each step, [steps].
        density: steps after which density control takes a round.
        joined: first step at which the validation rows may be trained on; ``steps`` if never.
    """

    rows: IntArray
    receiver: IntArray
    factor: NDArray[np.float64]
    decay: NDArray[np.float64]
    density: frozenset[int]
    joined: int


def plan(config: TrainConfig, split: Split, receivers: int) -> Schedule:
    """The plan of a fit, a function of settings, split and seed alone: a resumed run goes on with the same.

    Each epoch visits every row at every receiver once, in random order; a batch belongs to one receiver.
    Where the batch does not divide the rows, each epoch leaves out others at random.

    Raises:
        InputError: fewer training rows than a batch needs.
    """
    steps, batch = config.steps, config.batch
    joined = steps if config.hold_out >= 1 else round(config.hold_out * steps)
    rows = split.train if joined else split.all_train
    if len(rows) < batch:
        beside = f" beside {len(split.validation)} validation rows" if joined else ""
        raise InputError(f"{len(rows)} training rows{beside}, batches need {batch}: use more rows or a smaller batch")
    rng = np.random.default_rng([config.seed, 1])
    plans = [_epochs(split.train, joined, batch, receivers, rng)]
    plans.append(_epochs(split.all_train, steps - joined, batch, receivers, rng))
    t = np.arange(steps)
    o = config.optimiser
    cosine = o.final + (1 - o.final) * 0.5 * (1 + np.cos(np.pi * t / steps))
    d = config.density
    first, last = int(d.start * steps), int(d.stop * steps)
    rounds = [s for s in range(d.every, steps, d.every) if first <= s <= last] if d.every else []
    return Schedule(
        rows=np.concatenate([rows for rows, _ in plans]),
        receiver=np.concatenate([receiver for _, receiver in plans]),
        factor=cosine * np.minimum(1.0, (t + 1) / max(1, o.warm_up)),
        # A young mean forgets faster, or it would be mostly the starting values.
        decay=np.minimum(o.averaging, (t + 1) / (t + 10)),
        density=frozenset(rounds),
        joined=joined,
    )


def _epochs(
    rows: IntArray, steps: int, batch: int, receivers: int, rng: np.random.Generator
) -> tuple[IntArray, IntArray]:
    if steps == 0:
        return np.empty((0, batch), np.int64), np.empty(0, np.int64)
    per_receiver = len(rows) // batch
    epochs = -(-steps // (per_receiver * receivers))
    batches, owners = [], []
    for _ in range(epochs):
        chosen = np.concatenate(
            [rng.permutation(rows)[: per_receiver * batch].reshape(per_receiver, batch) for _ in range(receivers)]
        )
        order = rng.permutation(len(chosen))
        batches.append(chosen[order])
        owners.append(np.repeat(np.arange(receivers), per_receiver)[order])
    return np.concatenate(batches)[:steps], np.concatenate(owners)[:steps]
