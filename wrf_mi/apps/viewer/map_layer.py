"""Maps of a view, from the files of ``wrf-mi map``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ...core import InputError
from ...core.files import listed, readable
from ...core.memory import require_memory
from ..maps.dataset import ZARR, require_packages
from .content import MapContent

SUFFIXES = (".nc", ".nc4", ".netcdf", ZARR)  # endings of maps' names
MAP_NUMBERS = 600_000  # values of all maps of a page, at most: 3 MB
RECEIVER, POINT = "receiver", "point"  # dimensions of receivers and of the points of a surface


def read_map(source: str | Path | Any) -> tuple[MapContent, list[str]]:
    """A map, and notes on variables that are not shown.

    Args:
        source: NetCDF file or Zarr folder of ``wrf-mi map``, or an ``xarray.Dataset`` of the same form: variables over
            (receiver, y, x) or (y, x) with coordinates ``x`` and ``y`` in metres and a scalar ``height``, or over
            (receiver, point) or (point) with ``x``, ``y`` and ``z``.

    Raises:
        InputError: a file that cannot be read or is no such map, or xarray is not installed.
    """
    if not isinstance(source, str | Path):
        return map_content(source, "map")
    path = Path(source)
    require_packages(path, "view")
    import xarray

    opened: Any = xarray.open_zarr if path.suffix.lower() == ZARR else xarray.open_dataset
    with (
        readable(path, f"{path}: no such file; give a map made by wrf-mi map", "make the map anew"),
        opened(path) as dataset,
    ):
        require_memory(4 * dataset.nbytes, f"{path}: its content", "make a map of fewer positions")
        return map_content(dataset.load(), path.name)


def map_content(dataset: Any, name: str) -> tuple[MapContent, list[str]]:
    """A map of an ``xarray.Dataset``, see `read_map`."""
    plane, needed = ((POINT,), ("x", "y", "z")) if POINT in dataset.dims else (("y", "x"), ("x", "y", "height"))
    if lacking := sorted(set(needed) - set(dataset.coords), key=needed.index):
        raise InputError(f"{name}: no coordinate {', '.join(lacking)}, so no map of wrf-mi map; give one")
    values, labels, skipped = _variables(dataset, plane)
    if not values:
        raise InputError(f"{name}: no numbers over {' and '.join(plane)} in it; give a map made by wrf-mi map")
    receivers = tuple(map(str, dataset[RECEIVER].values)) if RECEIVER in dataset.coords else ()
    x_m, y_m, third = (np.asarray(dataset[axis], float) for axis in needed)
    z_m, height_m = (None, float(third)) if "height" in needed else (third, None)
    notes = [f"Map {name}: {listed(skipped)} not shown, no numbers over {' and '.join(plane)}."] if skipped else []
    return MapContent(name, height_m, x_m, y_m, z_m, receivers, values, labels), notes


def _variables(dataset: Any, plane: tuple[str, ...]) -> tuple[dict[str, Any], dict[str, str], list[str]]:
    """Values with an axis of receivers before the plane's, labels, and the names of variables that are no maps."""
    values, labels, skipped = {}, {}, []
    for key, variable in dataset.data_vars.items():
        if variable.dtype.kind not in "fiub" or set(variable.dims) not in (set(plane), {RECEIVER, *plane}):
            skipped.append(str(key))
            continue
        by_receiver = variable if RECEIVER in variable.dims else variable.expand_dims(RECEIVER)
        values[str(key)] = np.asarray(by_receiver.transpose(RECEIVER, *plane), np.float32)
        units = str(variable.attrs.get("units", ""))
        words = str(variable.attrs.get("long_name", key)).replace("_", " ")
        labels[str(key)] = f"{words} ({units})" if units not in ("", "1") else words
    return values, labels, skipped


def thinned(maps: Sequence[MapContent], most: int = MAP_NUMBERS) -> tuple[list[MapContent], list[str]]:
    """Maps with at most ``most`` values in all, of every k-th position along each axis, and a note where k > 1."""
    step, thin = 1, list(maps)
    while sum(values.size for content in thin for values in content.values.values()) > most:
        step += 1
        thin = [_every(content, step) for content in maps]
    if step == 1:
        return thin, []
    return thin, [f"Maps: every {step}th position along each axis (every {step * step}th point of a surface)."]


def _every(content: MapContent, step: int) -> MapContent:
    # Of a surface, whose points have no axes, as small a share is left.
    part = slice(None, None, step if content.z_m is None else step * step)
    index = (..., part, part) if content.z_m is None else (..., part)
    values = {name: array[index] for name, array in content.values.items()}
    z_m = None if content.z_m is None else content.z_m[part]
    return replace(content, x_m=content.x_m[part], y_m=content.y_m[part], z_m=z_m, values=values)
