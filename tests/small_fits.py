"""Short fits of few Gaussians to the spectra of `made_spectra`."""

from collections.abc import Callable
from typing import Any

from wrf_mi.core import Record, Split
from wrf_mi.core.settings import with_settings
from wrf_mi.datasets import make_splits
from wrf_mi.training.config import TrainConfig

QUICK = (
    "initial.gaussians=8",
    "initial.size_deg=15",
    "network.width=16",
    "network.layers=2",
    "optimiser.warm_up=5",
    "optimiser.ema_decay=0.9",
    "density.every=0",
    "log_every=5",
    "validate_every=20",
)
"""Eight Gaussians and one network in all tests, so that most find their kernels compiled."""


def settings(*own: str, model: str = "wrf-gs+") -> TrainConfig:
    return with_settings(TrainConfig(model=model), [*QUICK, *own])


def network_settings(kind: Any, steps: int, batch: int, rate: float = 1e-3, every: int = 0, **own: Any) -> Any:
    """Settings of a network that is trained for few steps; its last fifth sees the validation rows."""
    ends = (f"steps={steps}", f"batch={batch}", f"optimiser.network={rate}", f"validate_every={every or steps}")
    return with_settings(kind(**own), [*ends, "optimiser.warm_up=20", "optimiser.ema_decay=0.98"])


def official(record: Record) -> Split:
    return make_splits(record, "official")[0]


def stop_after(steps: int) -> Callable[[], bool]:
    """A ``stop``, which is asked after each step but a run's last, that says yes when asked so often."""
    asked = iter(range(1, steps + 1))
    return lambda: next(asked) >= steps
