"""Measurements: layouts of files, public data sets and splits."""

from __future__ import annotations

from typing import TYPE_CHECKING

import lazy_loader

from ..core import Record as Record
from ..core.task import CONVERSIONS
from ..tasks import TASKS as TASKS  # registered by this import: records name them

CONVERSIONS.add_builtin({"xarray": f"{__name__}.labelled:dataset_of"})

if TYPE_CHECKING:
    from .argos import read_argos
    from .ble_folder import read_ble_folder, write_ble_folder
    from .deepmimo import read_deepmimo
    from .download import fetch
    from .nerf2_ble import read_nerf2_ble
    from .nerf2_csi import read_nerf2_csi, write_nerf2_csi
    from .newrf import read_newrf
    from .record_file import read_record_file, write_record_file
    from .registry import DataSet, DataSetStatus, data_home, datasets, load, user_cache
    from .spectrum_folder import read_spectrum_folder, write_spectrum_folder
    from .splits import SPLIT_NAMES, load_split, make_splits, save_split

# Imported when first used: a command needs the readers of one layout.
__getattr__, __dir__, _ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "argos": ["read_argos"],
        "ble_folder": ["read_ble_folder", "write_ble_folder"],
        "deepmimo": ["read_deepmimo"],
        "download": ["fetch"],
        "nerf2_ble": ["read_nerf2_ble"],
        "nerf2_csi": ["read_nerf2_csi", "write_nerf2_csi"],
        "newrf": ["read_newrf"],
        "record_file": ["read_record_file", "write_record_file"],
        "registry": ["DataSet", "DataSetStatus", "data_home", "datasets", "load", "user_cache"],
        "spectrum_folder": ["read_spectrum_folder", "write_spectrum_folder"],
        "splits": ["SPLIT_NAMES", "load_split", "make_splits", "save_split"],
    },
)

__all__ = [
    "SPLIT_NAMES",
    "DataSet",
    "DataSetStatus",
    "data_home",
    "datasets",
    "fetch",
    "load",
    "load_split",
    "make_splits",
    "read_argos",
    "read_ble_folder",
    "read_deepmimo",
    "read_nerf2_ble",
    "read_nerf2_csi",
    "read_newrf",
    "read_record_file",
    "read_spectrum_folder",
    "save_split",
    "user_cache",
    "write_ble_folder",
    "write_nerf2_csi",
    "write_record_file",
    "write_spectrum_folder",
]
