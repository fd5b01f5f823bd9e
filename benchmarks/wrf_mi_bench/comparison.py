"""Rows of the benchmarks' tables, and data that they need."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from wrf_mi.core import InputError
from wrf_mi.core.files import write_atomically
from wrf_mi.datasets.registry import locate

Row = dict[str, str]


def line(what: str, value: str, asked: str = "") -> Row:
    """Row of a check's table."""
    return {"what": what, "value": value, "asked": asked}


def kept(file: Path, measure: Callable[[], Any]) -> Any:
    """Result of a measurement, read from a JSON file where it was made before, else made and written."""
    if not file.exists():
        write_atomically(file, json.dumps(measure(), indent=1))
    return json.loads(file.read_text(encoding="utf-8"))


def data_folder(name: str) -> Path:
    """Folder of a known data set; `InputError` where it is not on this machine."""
    folder = locate(name)
    if folder is None:
        raise InputError(f"{name}: not on this machine; run `wrf-mi data fetch {name}`")
    return folder


def room_file(name: str) -> Path:
    """File ``<room>.npz`` of a NeWRF room; `InputError` where it is not on this machine."""
    return data_folder(f"newrf-{name}") / f"{name}.npz"
