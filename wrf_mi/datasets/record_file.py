"""Any data set in one ``.npz`` file of plain arrays, without loss.

Keys: ``record_format``, ``name``, ``task`` and the attributes of `wrf_mi.core.Record` that the data have, by their
names; ``train`` and ``test`` are the official rows, ``tx_antenna`` the attributes of the transmitter's antenna, and
``receiver_*`` the arrays of `wrf_mi.core.receivers.receiver_arrays`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import astuple, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import Antenna, DataFault, Record, receiver_arrays, stored_receivers
from ..core.array_files import stored_arrays, write_arrays
from ..core.files import readable
from ..core.task import task_named
from .folder_files import single_file

VERSION, FORMAT = "record_format", 1
OPTIONAL = tuple(field.name for field in fields(Record) if field.default is None and field.name != "official")
"""Attributes of a record that may be None."""


def record_arrays(record: Record) -> dict[str, Any]:
    """Arrays of a record by name, of which `record_from_arrays` makes an equal record."""
    optional = {name: getattr(record, name) for name in OPTIONAL if getattr(record, name) is not None}
    parts = {} if record.official is None else dict(zip(("train", "test"), record.official, strict=True))
    return {
        "tx_pos_m": record.tx_pos_m,
        "observation": record.observation,
        "tx_antenna": np.array(astuple(record.tx_antenna)),
        **receiver_arrays(record.receivers),
        **parts,
        **optional,
    }


def record_from_arrays(arrays: Mapping[str, NDArray[Any]], name: str, task: str, source: str = "") -> Record:
    """Record of arrays as those of `record_arrays`.

    `KeyError`: an array is missing, `InputError`: an invalid antenna.
    """
    optional: dict[str, Any] = {key: arrays[key] for key in OPTIONAL if key in arrays}
    return Record(
        name=name,
        task=task_named(task, source or name),
        tx_pos_m=arrays["tx_pos_m"],
        receivers=stored_receivers(arrays),
        observation=arrays["observation"],
        official=(arrays["train"], arrays["test"]) if "train" in arrays else None,
        tx_antenna=Antenna(*map(str, arrays["tx_antenna"])),
        source=source,
        **optional,
    )


def write_record_file(path: str | Path, record: Record) -> Path:
    """Write a record to an ``.npz`` file atomically; `read_record_file` gives an equal record."""
    arrays = {VERSION: FORMAT, "name": record.name, "task": record.task.name, **record_arrays(record)}
    return write_arrays(Path(path), arrays, compressed=True)


def read_record_file(path: str | Path, name: str | None = None) -> Record:
    """Read a file of `write_record_file`, or a folder that holds it alone, with another name if one is given.

    Raises:
        InputError: a file that is missing or damaged, or of another format version.
    """
    file = single_file(Path(path), (".npz",), "one data set in .npz")
    with readable(file, DataFault(file, "missing; give a data set in .npz"), "export it again"):
        arrays = stored_arrays(file)
        if (version := int(arrays[VERSION])) != FORMAT:
            raise DataFault(file, f"format {version}, this version reads {FORMAT}; use the version that wrote it")
        record = record_from_arrays(arrays, name or str(arrays["name"]), str(arrays["task"]), str(file))
        rows = {len(record.tx_pos_m), record.observation.shape[1]}
    if len(rows) > 1 or len(record.receivers) != len(record.observation):
        raise DataFault(file, "numbers of receivers or rows do not fit together; export it again")
    return record
