"""Tasks: form of observations, score and instrument."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from ..core import InputError, Record
from ..core.registry import Registry
from ..receivers.instruments import Instrument
from .task import CARRIER, LAW, UPLINK, Csi, Rssi, Spectrum, Task

ENTRY_POINTS = "wrf_mi.tasks"  # Group of the entry points by which other packages add tasks


TASKS: Mapping[str, Task] = Registry("task", ENTRY_POINTS, {task.name: task for task in (Spectrum(), Rssi(), Csi())})
"""Every task by its name in `wrf_mi.core.Record.task`."""


Loss = Callable[..., Any]
"""``loss(prediction, truth, batch, *shape)``: arguments and result of `Task.loss`, a Dr.Jit float of one value."""
LOSS_ENTRY_POINTS = "wrf_mi.losses"  # Group of the entry points by which other packages add losses
LOSSES: Registry[Loss] = Registry(
    "loss",
    LOSS_ENTRY_POINTS,
    {name: f"wrf_mi.tasks.losses:{name.replace('-', '_')}" for name in ("absolute-error", "squared-error")},
)
"""Losses by name beside those of the tasks, as in ``wrf-mi train --set loss.name=squared-error``."""


def known_loss(name: str) -> Loss:
    """The loss of a name (InputError: there is none)."""
    if name not in LOSSES:
        known = ", ".join(LOSSES)
        raise InputError(f"loss {name!r}: no such loss; choose from {known}, or add yours (docs/howto/extend.md)")
    return LOSSES[name]


def task_of(record: Record) -> Task:
    """The task of a record (InputError: an unknown task)."""
    if record.task not in TASKS:
        raise InputError(f"{record.source or record.name}: task {record.task!r}; known are {', '.join(TASKS)}")
    return TASKS[record.task]


def instrument_of(record: Record) -> Instrument:
    """The instrument of a record (InputError: an unknown task, position, carrier or array)."""
    return task_of(record).instrument(record)


def require(record: Record, *names: str, why: str) -> None:
    """Refuse a record of another task than those named (InputError: the message ends with ``why``)."""
    if record.task not in names:
        raise InputError(f"{record.name}: holds {record.task}; {why}")


__all__ = [
    "CARRIER",
    "ENTRY_POINTS",
    "LAW",
    "LOSSES",
    "LOSS_ENTRY_POINTS",
    "TASKS",
    "UPLINK",
    "Loss",
    "Task",
    "instrument_of",
    "known_loss",
    "require",
    "task_of",
]
