"""Settings of the training loop, with the same keys for all models that are trained by gradients."""

from __future__ import annotations

from dataclasses import dataclass, field, make_dataclass
from typing import Any, get_type_hints

from ..core.settings import CheckedSettings, Count, Share, ShareBelow1


@dataclass(frozen=True)
class AdamConfig:
    """Adam (Kingma and Ba 2015): warm-up, then a cosine to ``final`` of each rate.

    Attributes:
        network: rate of all networks.
        warm_up: steps over which rates rise from zero.
        cosine_start: share of the steps after which rates begin to fall.
        final: final factor of each rate.
        ema_decay: decay per step of the running mean of the parameters, which is evaluated and stored.
    """

    network: float = 1e-3
    warm_up: int = 100
    cosine_start: Share = 0.0
    final: Share = 0.01
    ema_decay: ShareBelow1 = 0.999


@dataclass(frozen=True)
class LoopConfig(CheckedSettings):
    """Settings of `wrf_mi.training.loop.TrainingLoop`.

    Attributes:
        steps: optimiser steps.
        batch: largest number of samples in a step.
        holdout_steps_fraction: share of the steps in which the validation rows are kept out of training. 1 keeps them
            out to the end, as every choice of settings must; less ends with a fit on all training rows.
        patience: number of scores on the validation rows without improvement after which the fit goes on from the best
            state with all training rows, for a share of the steps that led to it. 0: all steps are taken, and the last
            state counts.
        checkpoint_every: steps between two checkpoints.
        log_every: steps between two lines of the log.
        validate_every: steps between two scores on the validation rows.
        optimiser: learning rates and running mean.
    """

    steps: Count = 1000
    batch: Count = 1
    holdout_steps_fraction: Share = 0.7
    patience: int = 0
    checkpoint_every: Count = 2000
    log_every: Count = 100
    validate_every: Count = 1000
    optimiser: AdamConfig = field(default_factory=AdamConfig)


_OPTIONAL = {name: kind for name, kind in get_type_hints(LoopConfig).items() if name != "optimiser"}


def _chosen(options: Any) -> list[str]:
    """Settings that are not null, as ``--set`` takes them."""
    values = {name: getattr(options, name) for name in _OPTIONAL}
    return [f"{name}={value}" for name, value in values.items() if value is not None]


LoopOptions: Any = make_dataclass(
    "LoopOptions",
    [(name, kind | None, None) for name, kind in _OPTIONAL.items()],
    namespace={"chosen": _chosen},
    frozen=True,
)
"""Base of settings of a model that may be trained: those of `LoopConfig`; null: the default of the training."""
