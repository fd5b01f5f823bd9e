"""Tasks of this package: spectra, signal strengths and channels, their losses and the instrument of a record."""

from __future__ import annotations

import numpy as np

from ..core import InputError, Record
from ..core import Task as Task
from ..core.angles import FloatArray
from ..core.task import CARRIER, LAW, LOSSES, TASKS, UPLINK, Loss
from ..receivers.instruments import SIZE, Instrument
from .csi import Csi
from .rssi import Rssi
from .spectrum import Spectrum

SPECTRUM, RSSI, CSI = Spectrum(), Rssi(), Csi()
TASKS.add_builtin({task.name: task for task in (SPECTRUM, RSSI, CSI)})
LOSSES.add_builtin(
    {name: f"wrf_mi.tasks.losses:{name.replace('-', '_')}" for name in ("absolute-error", "squared-error")}
)


def known_loss(name: str) -> Loss:
    """The loss of a name (InputError: there is none)."""
    if name not in LOSSES:
        choices = ", ".join(LOSSES)
        raise InputError(f"loss {name!r}: no such loss; choose from {choices}, or add yours (docs/howto/extend.md)")
    return LOSSES[name]


def instrument_of(record: Record) -> Instrument:
    """The instrument of a record, for ray tracing (InputError: an unknown task, position, carrier or array)."""
    task = record.task
    if not task.receiver_with_scene:
        raise InputError(f"{record.name}: no receiver model observes {task.name} from paths; choose another model")
    frequencies_hz, record = _carrier_hz(record, task.carrier_stated_in), task.with_arrays(record)
    size = task.image_size(record.observation.shape) or SIZE
    return Instrument(task.receiver_with_scene, record.receivers, frequencies_hz, record.tx_antenna, size)


def _carrier_hz(record: Record, stated_in: str) -> FloatArray:
    """Frequencies of a record, `InputError` if these or positions are unknown; ``stated_in`` names key and file."""
    positions = [record.tx_pos_m, *(receiver.position_m for receiver in record.receivers)]
    if not all(np.isfinite(position_m).all() for position_m in positions):
        raise InputError(f"{record.name}: positions unknown, so there is nothing to trace between; use another method")
    if record.frequencies_hz is None:
        raise InputError(f"{record.name}: carrier frequency unknown; state {stated_in}")
    return record.frequencies_hz


def require(record: Record, *names: str, why: str) -> None:
    """Refuse a record of another task than those named (InputError: the message ends with ``why``)."""
    if record.task.name not in names:
        raise InputError(f"{record.name}: holds {record.task.name}; {why}")


__all__ = [
    "CARRIER",
    "CSI",
    "LAW",
    "LOSSES",
    "RSSI",
    "SPECTRUM",
    "TASKS",
    "UPLINK",
    "Loss",
    "instrument_of",
    "known_loss",
    "require",
]
