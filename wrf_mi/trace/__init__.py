"""Ray tracing by Sionna RT: scenes, paths, spectra, and the embedded default data set."""

from __future__ import annotations

from pathlib import Path

from ..core import Record
from ..measure import load
from .furnished import NAME as ROOM
from .furnished import traced_room
from .laboratory import NAME as LABORATORY
from .laboratory import laboratory_record
from .materials import set_frequency
from .options import TraceOptions
from .result import TraceResult, load_trace, recompute, save_trace
from .scenes import open_scene
from .solve import trace_paths
from .spectra import trace_spectra
from .walked import PLACES, PREFIX, walked_channels

__all__ = [
    "TraceOptions",
    "TraceResult",
    "laboratory_record",
    "load_record",
    "load_trace",
    "open_scene",
    "recompute",
    "save_trace",
    "set_frequency",
    "trace_paths",
    "trace_spectra",
    "traced_room",
    "walked_channels",
]


def load_record(name_or_folder: str | Path, progress: bool = False) -> Record:
    """Read any data set as `wrf_mi.measure.load` does, and trace what is made on this machine where it is asked for.

    These are the embedded ``laboratory`` (some seconds), ``traced-room`` (some minutes), ``traced-csi-flat`` and
    ``traced-csi-office`` (a minute or two each).

    Args:
        name_or_folder: a folder, or a known data set's name.
        progress: show a progress bar on standard error where tracing takes time.

    Raises:
        InputError: as `wrf_mi.measure.load`.
    """
    if not Path(name_or_folder).is_dir():
        if name_or_folder == LABORATORY:
            return laboratory_record(progress=progress)
        if name_or_folder == ROOM:
            return traced_room(progress=progress)[0]
        place = str(name_or_folder).removeprefix(PREFIX)
        if place in PLACES and place != str(name_or_folder):
            return walked_channels(place, progress=progress)
    return load(name_or_folder)
