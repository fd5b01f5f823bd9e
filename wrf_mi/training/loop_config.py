"""Settings of the training loop, which all models that are trained by gradients have under the same keys."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from ..core import InputError
from ..core.settings import flat

Range = tuple[Callable[[float], bool], str]


def at_least(smallest: float) -> Range:
    """Numbers from a smallest one."""
    return lambda x: x >= smallest, f"{smallest} or more"


COUNT: Range = at_least(1)
POSITIVE: Range = (lambda x: x > 0, "more than 0")
INSIDE: Range = (lambda x: 0 < x < 1, "more than 0 and less than 1")
SHARE: Range = (lambda x: 0 <= x <= 1, "0 to 1")
NOT_NEGATIVE: Range = at_least(0)

RANGES: dict[str, Range] = {
    "steps": COUNT,
    "batch": COUNT,
    "holdout_steps_fraction": SHARE,
    "checkpoint_every": COUNT,
    "log_every": COUNT,
    "validate_every": COUNT,
    "optimiser.cosine_start": SHARE,
    "optimiser.final": SHARE,
    "optimiser.ema_decay": (lambda x: 0 <= x < 1, "0 or more and less than 1"),
}
"""What numbers of the loop may be, and words for it."""


@dataclass(frozen=True)
class AdamConfig:
    """Adam (Kingma and Ba 2015): warm-up, then a cosine to ``final`` of each rate.

    Attributes:
        network: rate of all networks.
        warm_up: steps over which rates rise from zero.
        cosine_start: share of the steps after which rates begin to fall.
        final: share of each rate that is left at the last step.
        ema_decay: decay per step of the running mean of the parameters, which is what is evaluated and stored.
    """

    network: float = 1e-3
    warm_up: int = 100
    cosine_start: float = 0.0
    final: float = 0.01
    ema_decay: float = 0.999


@dataclass(frozen=True)
class LoopConfig:
    """Settings of `wrf_mi.training.loop.TrainingLoop`.

    Attributes:
        steps: optimiser steps.
        batch: samples in a step, at most.
        holdout_steps_fraction: share of the steps in which the validation rows are kept out of training. 1 keeps them
            out to the end, as every choice of settings must; less ends with a fit on all training rows.
        patience: scores on the validation rows without a better one after which no more are waited for. From the best
            of them the fit then goes on with all training rows, for a share of the steps that led there. 0: all steps
            are taken, and the last ones count.
        checkpoint_every: steps between two checkpoints.
        log_every: steps between two lines of the log.
        validate_every: steps between two scores on the validation rows.
        optimiser: learning rates and running mean.
    """

    steps: int = 1000
    batch: int = 1
    holdout_steps_fraction: float = 0.7
    patience: int = 0
    checkpoint_every: int = 2000
    log_every: int = 100
    validate_every: int = 1000
    optimiser: AdamConfig = field(default_factory=AdamConfig)
    ranges = RANGES  # what numbers may be; other models have more of them

    def __post_init__(self) -> None:
        """Refuse values that no fit can use.

        Raises:
            InputError: naming the setting.
        """
        checked(self, self.ranges)


@dataclass(frozen=True)
class LoopOptions:
    """Settings of the loop (`LoopConfig`) of a model that may be trained; null: those that it begins with."""

    steps: int | None = None
    batch: int | None = None
    holdout_steps_fraction: float | None = None
    patience: int | None = None
    checkpoint_every: int | None = None
    log_every: int | None = None
    validate_every: int | None = None

    def chosen(self) -> list[str]:
        """Those that are not null, as ``--set`` takes them."""
        values = {one.name: getattr(self, one.name) for one in dataclasses.fields(LoopOptions)}
        return [f"{name}={value}" for name, value in values.items() if value is not None]


def checked(settings: Any, ranges: Mapping[str, Range]) -> dict[str, Any]:
    """All values of settings by their dotted keys.

    Args:
        settings: a dataclass.
        ranges: of its numbers; `NOT_NEGATIVE` for those that are not in it.

    Raises:
        InputError: a number that is not finite or out of its range.
    """
    values = dict(flat(dataclasses.asdict(settings), ""))
    for name, value in values.items():
        if not isinstance(value, int | float):
            continue
        good, words = ranges.get(name, NOT_NEGATIVE)
        if not math.isfinite(value) or not good(value):
            raise InputError(f"setting {name}: {value} is out of range, choose {words}")
    return values
