"""Rows of the benchmarks' tables, and data that they need."""

from __future__ import annotations

from pathlib import Path

from wrf_mi.core import InputError
from wrf_mi.datasets.registry import locate

Row = dict[str, str]


def line(what: str, value: str, asked: str = "") -> Row:
    """Row of a check's table."""
    return {"what": what, "value": value, "asked": asked}


def data_folder(name: str) -> Path:
    """Folder of a known data set; `InputError` where it is not on this machine."""
    folder = locate(name)
    if folder is None:
        raise InputError(f"{name}: not on this machine; run `wrf-mi data fetch {name}`")
    return folder


def room_file(name: str) -> Path:
    """File ``<room>.npz`` of a NeWRF room; `InputError` where it is not on this machine."""
    return data_folder(f"newrf-{name}") / f"{name}.npz"
