"""Formats of map files, and the optional packages that read and write them."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

from ..core import InputError

NETCDF, ZARR, CSV = ".nc", ".zarr", ".csv"
# h5netcdf is imported without the h5py that it needs to open a file.
PACKAGES = {NETCDF: ("xarray", "h5netcdf", "h5py"), ZARR: ("xarray", "zarr"), CSV: ("xarray", "pandas")}
"""Suffixes of files, and the packages that write each."""


def maps_package(name: str, extra: str = "maps") -> Any:
    """A package that maps need, installed by an extra of this one.

    Raises:
        InputError: it is not installed.
    """
    try:
        return import_module(name)
    except ModuleNotFoundError:
        raise InputError(f"radio maps need {name}: pip install 'wrf-mi[{extra}]'") from None


def require_packages(path: Path, extra: str = "maps") -> None:
    """Refuse a map file whose packages are not installed; any suffix but ``.zarr`` and ``.csv`` is NetCDF.

    Raises:
        InputError: naming the first package that is missing.
    """
    for name in PACKAGES.get(path.suffix.lower(), PACKAGES[NETCDF]):
        maps_package(name, extra)
