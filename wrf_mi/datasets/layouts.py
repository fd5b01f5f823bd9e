"""Layouts of data sets: their files and readers.

Other packages add a `Layout` by an entry point of the group ``wrf_mi.layouts``.
"""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ..core import Record
from ..core.array_files import stored_names
from ..core.registry import Registry
from .argos import SUFFIXES, read_argos
from .ble_folder import MEASUREMENTS, RECEIVERS, TEST, TRAINING, read_ble_folder
from .deepmimo import OLD_PARAMS, PARAMS, read_deepmimo
from .folder_files import POSITIONS
from .nerf2_ble import GATEWAYS as BLE_GATEWAYS
from .nerf2_ble import POWERS, read_nerf2_ble
from .nerf2_csi import CHANNELS, STATION, read_nerf2_csi
from .newrf import read_newrf
from .record_file import VERSION, read_record_file
from .spectrum_folder import FOLDS, GATEWAYS, IMAGES, read_spectrum_folder
from .unknown import unknown_data

ENTRY_POINTS = "wrf_mi.layouts"
Read = Callable[[Path, str | None], Record]
"""``read(path, name)``: the record of a folder or file, by default named after it. Errors are `InputError`."""


@dataclass(frozen=True)
class Layout:
    """A layout of data sets.

    Attributes:
        name: name of the layout.
        task: task of its records (`wrf_mi.core.Record`); "": that of each file.
        read: function that reads it.
        files: names of files; a folder with any of them has this layout.
        suffixes: endings of files that are data sets, alone or in a folder without any layout's ``files``.
        array: name of an array that an ``.npz`` file of this layout holds, or "".
        parts: names of further files; a folder with any of them that no layout describes is taken for this one, whose
            reader names what is missing.
    """

    name: str
    task: str
    read: Read
    files: tuple[str, ...] = ()
    suffixes: tuple[str, ...] = ()
    array: str = ""
    parts: tuple[str, ...] = ()

    def reads(self, file: Path) -> bool:
        """Whether a file has the ending and the array of this layout."""
        if file.suffix not in self.suffixes or not self.array:
            return file.suffix in self.suffixes
        try:
            return self.array in stored_names(file)
        except (OSError, zipfile.BadZipFile):  # no archive, which the reader of such files says
            return False


BUILT_IN = (
    Layout("spectra", "spectrum", read_spectrum_folder, (GATEWAYS,), parts=(IMAGES, POSITIONS, FOLDS)),
    Layout("nerf2-ble", "rssi", read_nerf2_ble, (POWERS, BLE_GATEWAYS)),
    Layout("nerf2-csi", "csi", read_nerf2_csi, (CHANNELS, STATION)),
    Layout("ble", "rssi", read_ble_folder, RECEIVERS, parts=(*TRAINING, *TEST, *MEASUREMENTS)),
    Layout("deepmimo", "csi", read_deepmimo, (PARAMS, OLD_PARAMS)),
    Layout("npz", "", read_record_file, suffixes=(".npz",), array=VERSION),
    Layout("newrf", "csi", read_newrf, suffixes=(".npz",)),
    Layout("argos", "csi", read_argos, suffixes=SUFFIXES),
)
LAYOUTS = Registry[Layout]("layout", ENTRY_POINTS, {layout.name: layout for layout in BUILT_IN})
"""All layouts by name."""


def layouts() -> list[Layout]:
    """All layouts in the order in which they are tried: those of other packages first."""
    return sorted(LAYOUTS.values(), key=BUILT_IN.__contains__)


def layout_of(path: Path) -> Layout:
    """The layout of a folder or a file.

    Raises:
        InputError: it has none; the message says what it holds and what is wanted.
    """
    present = [path] if path.is_file() else sorted(path.iterdir())
    by_suffix = [layout for layout in layouts() if any(map(layout.reads, present))]
    candidates = [*_by_names(path, "files"), *by_suffix, *_by_names(path, "parts")]
    if not candidates:
        raise unknown_data(path, [folder for folder in present if folder.is_dir() and _by_names(folder, "files")])
    return candidates[0]


def _by_names(folder: Path, attribute: str) -> list[Layout]:
    """Layouts with an attribute, ``files`` or ``parts``, that names a file in a folder."""
    return [layout for layout in layouts() if any((folder / file).exists() for file in getattr(layout, attribute))]


def is_data(path: Path) -> bool:
    """Whether a path is a folder, or a file that is a data set of a layout."""
    return path.is_dir() or (path.is_file() and any(path.suffix in layout.suffixes for layout in layouts()))
