"""Inputs of predictions, rows of fits, and arrays of run files."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..core import InputError, Record, Split
from ..core.angles import FloatArray
from ..core.settings import settings_from
from ..core.types import IntArray

Settings = TypeVar("Settings")
PER_ROW = ("tx_pos_m", "tx_heading_rad", "uplink", "carriers_hz")
"""Attributes that `Inputs` and `wrf_mi.core.Record` share."""


@dataclass(frozen=True)
class Inputs:
    """Known quantities of m rows to predict; never their observations.

    Attributes:
        tx_pos_m: positions of the transmitter [m, 3], metres; NaN where unknown.
        tx_heading_rad: headings of the transmitter [m], or None.
        uplink: uplink channel coefficients [m, antennas, subcarriers], complex64, or None.
        first_row: number of the first row, for messages.
        carriers_hz: carrier of each row [m], Hz, or None where the data have a single carrier.
    """

    tx_pos_m: FloatArray
    tx_heading_rad: FloatArray | None = None
    uplink: NDArray[Any] | None = None
    first_row: int = 0
    carriers_hz: FloatArray | None = None

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.tx_pos_m)

    def rows(self, chosen: slice) -> Inputs:
        """Inputs of some rows."""
        return Inputs(**_chosen(self, chosen), first_row=self.first_row + (chosen.start or 0))


def inputs_of(record: Record, rows: IntArray) -> Inputs:
    """Inputs of some rows of a record."""
    return Inputs(**_chosen(record, rows))


def _chosen(source: Inputs | Record, rows: slice | IntArray) -> dict[str, Any]:
    every = {name: getattr(source, name) for name in PER_ROW}
    return {name: None if values is None else values[rows] for name, values in every.items()}


def received_rows(record: Record, split: Split, receiver: int, name: str) -> tuple[IntArray, IntArray]:
    """Rows that a receiver received: those that train at first, and those that choose settings.

    Without the former, the latter train.

    Raises:
        InputError: fewer than two rows.
    """
    received = np.isfinite(record.observation[receiver]).reshape(len(record), -1).all(axis=1)
    train, validation = (rows[received[rows]] for rows in (split.train, split.validation))
    count = len(train) + len(validation)
    if count < 2:
        who = record.receivers[receiver].name
        raise InputError(f"{record.name}: receiver {who} received {count} training row; {name} needs two at least")
    return (train, validation) if len(train) else (validation, train)


def known_positions(record: Record, rows: IntArray, name: str) -> FloatArray:
    """Positions of the transmitter in some rows [n, 3], metres.

    Raises:
        InputError: unknown positions.
    """
    unknown = rows[~np.isfinite(record.tx_pos_m[rows]).all(axis=1)]
    if len(unknown):
        text = f"no position in row {unknown[0]}: positions are not known, from which {name} predicts"
        raise InputError(f"{record.name} has {text}; choose another model")
    return record.tx_pos_m[rows]


def keyed(prefix: str, arrays: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Arrays with a prefix before their names."""
    return {f"{prefix}{name}": values for name, values in arrays.items()}


def under(prefix: str, arrays: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Arrays whose names have a prefix, without it: the inverse of `keyed`."""
    return {name.removeprefix(prefix): values for name, values in arrays.items() if name.startswith(prefix)}


def field_arrays(value: Any, prefix: str = "") -> dict[str, NDArray[Any]]:
    """Fields of a dataclass instance that are not None, as arrays by ``prefix`` and name."""
    named = ((one.name, getattr(value, one.name)) for one in fields(value))
    return {f"{prefix}{name}": np.asarray(held) for name, held in named if held is not None}


def from_field_arrays(kind: type, arrays: Mapping[str, NDArray[Any]], prefix: str = "") -> Any:
    """Instance of the dataclass ``kind`` from `field_arrays`; arrays without axes become numbers."""
    names = (one.name for one in fields(kind) if f"{prefix}{one.name}" in arrays)
    stored = {name: arrays[f"{prefix}{name}"] for name in names}
    return kind(**{name: value if value.ndim else value.item() for name, value in stored.items()})


def settings_array(settings: Any) -> NDArray[Any]:
    """Settings as an array of a run file."""
    return np.asarray(json.dumps(asdict(settings)))


def stored_settings(kind: type[Settings], arrays: Mapping[str, NDArray[Any]], name: str) -> Settings:
    """Settings of a run file, from `settings_array`."""
    return settings_from(kind, json.loads(str(arrays["settings"])), name)
