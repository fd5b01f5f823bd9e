"""Data sets in the layouts of `wrf_mi.datasets.layouts` that have a writer."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..core import InputError, Record
from ..datasets import write_ble_folder, write_nerf2_csi, write_spectrum_folder
from ..datasets.record_file import write_record_file
from .format import ExportOptions
from .source import Source

BITS = 16  # bits of a pixel: 8 would round spectra that are computed or of 16 bits


def _written(task: str | None, write: Callable[[Path, Record, bool], object]) -> Callable[..., dict[str, Any]]:
    """A `wrf_mi.exports.source.Write` of a layout for data of a task."""

    def write_layout(source: Source, out: Path, options: ExportOptions) -> dict[str, Any]:
        record = source.record(options.progress)
        if task is not None and record.task != task:
            layouts = ", ".join(name for name, of in TASKS_OF.items() if of in (record.task, None))
            raise InputError(f"{source.name}: a data set of {record.task}, the layout holds {task}; choose {layouts}")
        write(out, record, options.replace)
        return {"rows": len(record), "receivers": len(record.receivers)}

    return write_layout


TASKS_OF = {"spectra": "spectrum", "ble": "rssi", "nerf2-csi": "csi", "npz": None}
"""Task of the data of each layout; None: any."""
write_spectra = _written("spectrum", lambda out, record, again: write_spectrum_folder(out, record, BITS, again))
write_strengths = _written("rssi", write_ble_folder)
write_channels = _written("csi", write_nerf2_csi)
write_npz = _written(None, lambda out, record, again: write_record_file(out, record))
