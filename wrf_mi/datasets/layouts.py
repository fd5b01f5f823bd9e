"""Layouts of data sets: which files tell a layout, and what reads it.

A layout of another package is a `Layout` that an entry point of the group ``wrf_mi.layouts`` names.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path

from ..core import InputError, Record
from ..core.registry import resolve
from .argos import SUFFIXES
from .ble_folder import ANCHORS
from .nerf2_ble import GATEWAYS as BLE_GATEWAYS
from .nerf2_ble import POWERS
from .nerf2_csi import CHANNELS, STATION
from .spectrum_folder import GATEWAYS

ENTRY_POINTS = "wrf_mi.layouts"
"""Group of the entry points by which other packages add layouts."""
Read = Callable[[Path, str | None], Record]
"""``read(path, name)``: the record of a folder or file; None: named after it. Errors are `InputError`."""


@dataclass(frozen=True)
class Layout:
    """One layout of data sets.

    Attributes:
        name: of the layout.
        task: of its records, see `wrf_mi.core.Record`.
        reader: ``module:function`` of type `Read`, or the function.
        files: a folder that holds one of these is of this layout: what else is missing, its reader names.
        suffixes: so end files that are read by themselves, and for which a folder without any layout's ``files`` is
            looked through.
    """

    name: str
    task: str
    reader: str | Read
    files: tuple[str, ...] = ()
    suffixes: tuple[str, ...] = ()

    @property
    def read(self) -> Read:
        """The function that reads it."""
        if not isinstance(self.reader, str):
            return self.reader
        read: Read = resolve(self.reader)
        return read


SPECTRA = Layout("spectra", "spectrum", "wrf_mi.datasets.spectrum_folder:read_spectrum_folder", (GATEWAYS,))
"""What a folder that shows no layout is taken for, so that its reader says what is missing."""
OWN = (
    SPECTRA,
    Layout("nerf2-ble", "rssi", "wrf_mi.datasets.nerf2_ble:read_nerf2_ble", (POWERS, BLE_GATEWAYS)),
    Layout("nerf2-csi", "csi", "wrf_mi.datasets.nerf2_csi:read_nerf2_csi", (CHANNELS, STATION)),
    Layout("ble", "rssi", "wrf_mi.datasets.ble_folder:read_ble_folder", (ANCHORS,)),
    Layout("newrf", "csi", "wrf_mi.datasets.newrf:read_newrf", suffixes=(".npz",)),
    Layout("argos", "csi", "wrf_mi.datasets.argos:read_argos", suffixes=SUFFIXES),
)


@cache
def layouts() -> tuple[Layout, ...]:
    """All layouts in the order in which they are tried: those of other packages first.

    Raises:
        InputError: two of one name.
    """
    others = tuple(point.load() for point in entry_points(group=ENTRY_POINTS))
    names = [layout.name for layout in (*others, *OWN)]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"layout {name!r}: there are {names.count(name)} of that name; remove a package")
    return (*others, *OWN)


def layout_of(path: Path) -> Layout:
    """The layout of a folder or a file."""
    return next(_found(path), SPECTRA)


def is_data(path: Path) -> bool:
    """Whether a path is a folder, or a file that a layout reads by itself."""
    return path.is_dir() or (path.is_file() and any(path.suffix in layout.suffixes for layout in layouts()))


def _found(path: Path) -> Iterator[Layout]:
    if path.is_file():
        yield from (layout for layout in layouts() if path.suffix in layout.suffixes)
        return
    yield from (layout for layout in layouts() if any((path / file).exists() for file in layout.files))
    present = {one.suffix for one in path.iterdir()}
    yield from (layout for layout in layouts() if present & set(layout.suffixes))
