"""Synthetic data sets, traced on this machine: the laboratory, a furnished room, channels of two floors."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from ..core import Record
from ..datasets import load
from ..datasets.labelled import record_of
from .floor_channels import PLACES, PREFIX, walked_channels
from .floor_receivers import CHANNELS as FLOOR_CHANNELS
from .floor_receivers import NAME as FLOOR_STRENGTHS
from .floor_receivers import traced_floor_channels, traced_floor_strengths
from .furnished_room import BANDS, traced_room, traced_room_bands
from .furnished_room import NAME as ROOM
from .laboratory import NAME as LABORATORY
from .laboratory import laboratory_record

__all__ = [
    "laboratory_record",
    "load_record",
    "traced_floor_channels",
    "traced_floor_strengths",
    "traced_room",
    "traced_room_bands",
    "walked_channels",
]


def load_record(name_or_folder: str | Path | Any, progress: bool = False) -> Record:
    """Read any data set as `wrf_mi.datasets.load` does, or trace a synthetic data set.

    Synthetic are ``laboratory`` (some seconds), ``traced-room`` (some minutes), ``traced-room-bands``,
    ``traced-csi-flat``, ``traced-csi-office``, ``traced-floor-receivers`` and ``traced-floor-receivers-csi`` (a minute
    or two each).

    Args:
        name_or_folder: a folder, the name of a known data set, or an `xarray.Dataset` or `xarray.DataArray` with the
            dimensions of `wrf_mi.core.Record.to_xarray`.
        progress: show a progress bar on standard error while tracing.

    Raises:
        InputError: as `wrf_mi.datasets.load`.

    >>> record = load_record("laboratory")
    >>> record.task.name, record.observation.shape[2:]
    ('spectrum', (90, 360))
    """
    makers: dict[str, Callable[..., Record]] = {LABORATORY: laboratory_record, ROOM: traced_room}
    makers |= {BANDS: traced_room_bands, FLOOR_STRENGTHS: traced_floor_strengths, FLOOR_CHANNELS: traced_floor_channels}
    makers |= {f"{PREFIX}{place}": partial(walked_channels, place) for place in PLACES}
    if hasattr(name_or_folder, "dims"):
        return record_of(name_or_folder)
    if not Path(name_or_folder).is_dir() and str(name_or_folder) in makers:
        return makers[str(name_or_folder)](progress=progress)
    return load(name_or_folder)
