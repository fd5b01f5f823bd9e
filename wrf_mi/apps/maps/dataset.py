"""Radio maps as `xarray.Dataset` with coordinates, units and attributes of the CF conventions, and their files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ...core import InputError, Receiver
from ...core.files import atomic_file, atomic_folder, os_failure
from ...runs.results import RECEPTION
from .grid import Grid, SurfaceMesh

if TYPE_CHECKING:
    import xarray

POWER, STD, COVERAGE, BEST = "power_dbm", "power_std_db", "coverage_probability", "best_receiver"
STD_OF_MEAN = "power_std_mean_db"
VARIABLES = {
    POWER: ("dBm", "expected received power"),
    STD: ("dB", "standard deviation of a reading of the received power, its noise included"),
    STD_OF_MEAN: ("dB", "standard deviation of the mean received power, without noise of readings"),
    RECEPTION: ("1", "probability that a transmission is received"),
    COVERAGE: ("1", "probability that the received power exceeds the threshold"),
    "path_gain_db": ("dB", "path gain, gains of both antennas included"),
    "traced_share": ("dBm", "received power that the traced component of the model states alone"),
    "learned_share": ("dBm", "received power that the learned component of the model states alone"),
    "share_difference_db": ("dB", "traced share less learned share"),
    "delay_spread_s": ("s", "root mean square delay spread of the traced paths"),
    "azimuth_spread_deg": ("degree", "circular standard deviation of the azimuth of arrival of the paths"),
    "k_factor_db": ("dB", "power of the strongest traced path over that of all others"),
}
"""Variables of each receiver and position, in the order of a file: unit in the notation of UDUNITS, but for powers in
decibels, which name theirs as CF does, and description. A map has those that its model states.
"""
LEVELS = (POWER, "traced_share", "learned_share")  # variables in the unit of the task's level
NETCDF, ZARR, CSV = ".nc", ".zarr", ".csv"
# h5netcdf is imported without the h5py that it needs to open a file.
PACKAGES = {NETCDF: ("xarray", "h5netcdf", "h5py"), ZARR: ("xarray", "zarr"), CSV: ("xarray", "pandas")}
"""Suffixes of files, and the packages that write each."""
CONVENTIONS = "CF-1.11"
COMPRESSION = {"zlib": True, "complevel": 4, "shuffle": True}


def maps_package(name: str, extra: str = "maps") -> Any:
    """A package that maps need, installed by an extra of this one; `InputError`: it is not installed."""
    try:
        return import_module(name)
    except ModuleNotFoundError:
        raise InputError(f"radio maps need {name}: pip install '.[{extra}]'") from None


def require_packages(path: Path, extra: str = "maps") -> None:
    """Refuse by `InputError` a map file whose packages are missing; any suffix but ``.zarr`` and ``.csv`` is NetCDF."""
    for name in PACKAGES.get(path.suffix.lower(), PACKAGES[NETCDF]):
        maps_package(name, extra)


def check_map_file(out: Path) -> None:
    """Refuse by `InputError` a file name of another format than NetCDF, Zarr and CSV, and a missing package."""
    suffix = out.suffix.lower()
    if suffix not in PACKAGES:
        raise InputError(f"{out}: maps are written as NetCDF ({NETCDF}), Zarr ({ZARR}) or {CSV}; give such a name")
    if out.is_dir() and suffix != ZARR:
        raise InputError(f"{out}: is a folder; give the name of a file")
    if suffix == ZARR and out.exists() and not (out / ".zgroup").is_file():
        raise InputError(f"{out}: exists and is no Zarr store; remove it or give another name")
    require_packages(out)


def map_dataset(
    places: Grid | SurfaceMesh,
    receivers: Sequence[Receiver],
    values: Mapping[str, NDArray[Any]],
    level_unit: str,
    attributes: Mapping[str, Any],
) -> xarray.Dataset:
    """Dataset of arrays [receivers, m] by the names of `VARIABLES`; levels in ``dBm``, or ``dB`` without calibration.

    Variables have dimensions (receiver, y, x) over a grid or (receiver, point) over a surface, ``best_receiver`` is
    without the first. Coordinates: ``receiver`` (names), ``receiver_x``, ``receiver_y``, ``receiver_z``, with
    ``receiver_x_std`` and so on where places are estimated; ``x``, ``y``,
    ``height`` of a grid; ``x``, ``y``, ``z`` of points, whose triangles are ``triangle`` (point, corner, axis). Metres,
    in the frame of the data.
    """
    xr, names = maps_package("xarray"), [receiver.name for receiver in receivers]
    coordinates: dict[str, Any] = {"receiver": ("receiver", names, {"long_name": "name of the receiver"})}
    for axis, values_m in zip("xyz", np.stack([receiver.position_m for receiver in receivers], axis=1), strict=True):
        coordinates[f"receiver_{axis}"] = "receiver", values_m, _metres(f"{axis} of the receiver")
    if any(receiver.position_std_m is not None for receiver in receivers):
        surveyed_std_m = np.zeros(3)
        stds_m = [
            surveyed_std_m if receiver.position_std_m is None else receiver.position_std_m for receiver in receivers
        ]
        for axis, values_m in zip("xyz", np.stack(stds_m, axis=1), strict=True):
            words = f"standard deviation of {axis} of the receiver, 0: stated"
            coordinates[f"receiver_{axis}_std"] = "receiver", values_m, _metres(words)
    data: dict[str, Any] = {}
    if isinstance(places, Grid):
        dims: tuple[str, ...] = ("y", "x")
        shape: tuple[int, ...] = (len(places.y_m), len(places.x_m))
        coordinates["x"] = "x", places.x_m, _metres("x of the transmitter") | {"axis": "X"}
        coordinates["y"] = "y", places.y_m, _metres("y of the transmitter") | {"axis": "Y"}
        height = _metres("z of the transmitter") | {"axis": "Z", "positive": "up"}
        coordinates["height"] = (), places.height_m, height
    else:
        dims, shape = ("point",), (len(places.triangles_m),)
        for k, axis in enumerate("xyz"):
            coordinates[axis] = "point", places.positions_m[:, k], _metres(f"{axis} of the transmitter")
        coordinates["axis"] = "axis", list("xyz")
        corners = places.triangles_m.astype(np.float32)
        data["triangle"] = ("point", "corner", "axis"), corners, _metres("corners of the triangle around each point")
    for name in VARIABLES:
        if name in values:
            data[name] = ("receiver", *dims), values[name].reshape(-1, *shape), _described(name, level_unit)
    power = values[POWER]
    received_power = np.where(np.isfinite(power), power, -np.inf)
    best = np.where(np.isfinite(power).any(axis=0), received_power.argmax(axis=0), -1).astype(np.int32)
    flags: dict[str, Any] = {
        "long_name": "number along the dimension receiver of the receiver of the highest power, -1: none",
        "flag_values": np.arange(-1, len(receivers), dtype=np.int32),
        # Meanings are separated by spaces.
        "flag_meanings": " ".join(["none", *("_".join(name.split()) for name in names)]),
    }
    data[BEST] = dims, best.reshape(shape), flags
    return xr.Dataset(data, coordinates, {"Conventions": CONVENTIONS, **attributes})


def _described(name: str, level_unit: str) -> dict[str, str]:
    units, long_name = VARIABLES[name]
    if name in LEVELS and level_unit != units:
        return {"units": level_unit, "long_name": f"{long_name}, relative to full scale"}
    return {"units": units, "long_name": long_name}


def _metres(long_name: str) -> dict[str, str]:
    return {"units": "m", "long_name": f"{long_name} in the frame of the data"}


def write_map(dataset: xarray.Dataset, out: str | Path) -> Path:
    """Write a map atomically as NetCDF 4, Zarr (format 2) or CSV, by the suffix of the name.

    CSV has a row for each receiver and position, with the name of the best receiver; empty where nothing is known.
    `InputError`: another suffix, a missing package, or a file that cannot be written.
    """
    path = Path(out)
    check_map_file(path)
    try:
        if path.suffix.lower() == ZARR:
            with atomic_folder(path, replace=True) as part:
                dataset.to_zarr(part, mode="w", zarr_format=2, consolidated=True)
            return path
        with atomic_file(path) as part:
            if path.suffix.lower() == CSV:
                _write_csv(dataset, part)
            else:
                packed = dict.fromkeys(dataset.data_vars, COMPRESSION)
                dataset.to_netcdf(part, engine="h5netcdf", format="NETCDF4", encoding=packed)
    except OSError as error:
        raise InputError(os_failure(error, path, "cannot be written")) from None
    return path


def _write_csv(dataset: xarray.Dataset, path: Path) -> None:
    names = np.append(dataset["receiver"].values.astype(object), "")
    best = dataset[BEST].copy(data=names[dataset[BEST].values])
    left_out = ["triangle", "axis", *(f"receiver_{axis}" for axis in "xyz")]
    plain = dataset.drop_vars(left_out, errors="ignore").assign({BEST: best})
    with path.open("w", encoding="utf-8", newline="") as stream:
        for number in range(plain.sizes["receiver"]):
            table = plain.isel(receiver=number).to_dataframe().reset_index()
            first = ["receiver", *(name for name in ("x", "y", "z", "height") if name in table)]
            columns = [*first, *(name for name in (*VARIABLES, BEST) if name in table)]
            table[columns].to_csv(stream, index=False, header=number == 0, lineterminator="\n")
