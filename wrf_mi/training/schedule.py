"""Schedule of a fit, known before its first step: rows, learning rates, rounds of density control."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..core import InputError
from ..core.types import IntArray
from .config import AdamConfig, DensityConfig, LoopConfig


@dataclass(frozen=True)
class Schedule:
    """Schedule of a fit."""

    rows: IntArray  # rows of each step's batch, [steps, batch]
    receiver: IntArray  # receiver of each step, [steps]
    factor: NDArray[np.float64]  # factor of the learning rates at each step, [steps]
    decay: NDArray[np.float64]  # decay of the running mean of the parameters at each step, [steps]
    density: frozenset[int]  # steps after which a round of density control follows
    joined: int  # first step that may train on the validation rows; ``steps`` if never
    # first steps of the stages after the first, in ascending order; learning rates fall anew in each, and no state of
    # the first stage is chosen before its end
    stages: tuple[int, ...] = ()

    def stage(self, step: int) -> int:
        """Number of the stage of a step, from 0."""
        return sum(step >= start for start in self.stages)

    def after(self, best: int) -> tuple[Schedule, int]:
        """The schedule that continues from the best state before the validation rows join.

        Args:
            best: step of that state.

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


def plan(
    config: LoopConfig,
    train: Sequence[IntArray],
    everything: Sequence[IntArray],
    rng: np.random.Generator,
    density: frozenset[int] = frozenset(),
    stages: tuple[int, ...] = (),
) -> Schedule:
    """The schedule of a fit, a function of settings, rows and seed only: a resumed run gets the same.

    Each epoch visits every row once at every receiver that observed it, in random order; a batch belongs to one
    receiver and is no larger than the rows of any. An epoch omits random rows that do not fill a batch.

    Args:
        config: settings.
        train: rows (conditions) of each receiver that train while validation rows are held out.
        everything: rows of each receiver with the validation rows.
        rng: generator of the order of rows.
        density: steps after which a round of density control follows.
        stages: first steps of the stages after the first.

    Raises:
        InputError: a receiver without rows that train.
    """
    steps = config.steps
    joined = steps if config.holdout_steps_fraction >= 1 else round(config.holdout_steps_fraction * steps)
    # Batches have one size, as recorded kernels do.
    batch = min(config.batch, *(len(rows) for rows in (train if joined else everything)))
    if not batch:
        beside = f" beside {max(map(len, everything))} validation rows" if joined else ""
        raise InputError(f"no training row at one receiver{beside}: use more rows")
    plans = [_epochs(train, joined, batch, rng), _epochs(everything, steps - joined, batch, rng)]
    t, o = np.arange(steps), config.optimiser
    return Schedule(
        rows=np.concatenate([rows for rows, _ in plans]),
        receiver=np.concatenate([receiver for _, receiver in plans]),
        factor=np.concatenate([_falling(int(part), o) for part in np.diff([0, *stages, steps])]),
        # A young mean forgets faster, or it would be mostly the starting values.
        decay=np.minimum(o.ema_decay, (t + 1) / (t + 10)),
        density=density,
        joined=joined,
        stages=stages,
    )


def _falling(steps: int, optimiser: AdamConfig) -> NDArray[np.float64]:
    """Factor of the learning rates: a linear warm-up, and half a cosine."""
    # Adam's moments are sums of few gradients at first, and full rates would follow their noise: hence the warm-up.
    t, final = np.arange(steps), optimiser.final
    flat = round(optimiser.cosine_start * steps)
    cosine = final + (1 - final) * 0.5 * (1 + np.cos(np.pi * np.maximum(t - flat, 0) / max(1, steps - flat)))
    return np.asarray(cosine * np.minimum(1.0, (t + 1) / max(1, optimiser.warm_up)))


def density_rounds(config: DensityConfig, steps: int, before: int = 0) -> frozenset[int]:
    """Steps after which a round of density control follows; before the last stage there are no Gaussians."""
    left = steps - before
    first, last = int(config.start * left), int(config.stop * left)
    rounds = range(config.every, left, config.every) if config.every else ()
    return frozenset(before + s for s in rounds if first <= s <= last)


def _epochs(rows: Sequence[IntArray], steps: int, batch: int, rng: np.random.Generator) -> tuple[IntArray, IntArray]:
    if steps == 0:
        return np.empty((0, batch), np.int64), np.empty(0, np.int64)
    counts = [len(of_receiver) // batch for of_receiver in rows]
    epochs = -(-steps // sum(counts))
    batches, owners = [], []
    for _ in range(epochs):
        chosen = np.concatenate(
            [rng.permutation(r)[: n * batch].reshape(n, batch) for r, n in zip(rows, counts, strict=True)]
        )
        # Batches of all receivers in turn: a receiver at a time would be forgotten while the others train.
        order = rng.permutation(len(chosen))
        batches.append(chosen[order])
        owners.append(np.repeat(np.arange(len(rows)), counts)[order])
    return np.concatenate(batches)[:steps], np.concatenate(owners)[:steps]
