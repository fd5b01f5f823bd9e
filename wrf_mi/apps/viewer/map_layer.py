"""Maps of a view, from the files of ``wrf-mi map``, which are read in a child process (`main`)."""

from __future__ import annotations

import json
import resource
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from ...core import InputError
from ...core.array_files import stored_arrays
from ...core.files import listed, one_line, readable
from ...core.memory import require_memory
from ...parallel import run_module
from ..maps.dataset import ZARR, require_packages
from .content import MapContent

SUFFIXES = (".nc", ".nc4", ".netcdf", ZARR)  # endings of maps' names
MAP_NUMBERS = 600_000  # values of all maps of a page, at most: 3 MB
RECEIVER, POINT = "receiver", "point"  # dimensions of receivers and of the points of a surface
FACTS, VALUES = "facts", "value/"
"""Key of all but the arrays of a map that a child process has read, and prefix of the keys of its values."""
MOST_S = 600.0  # time of the child process, which limits its processor time by the size of the file
MEMORY_BYTES, CPU_S, BYTES_PER_S = 2 << 30, 5, 4 << 20
"""Addresses beyond those of the imports and of the values, and processor time: of a file, and for each byte of it."""


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
    if not path.exists():
        raise InputError(f"{path}: no such file; give a map made by wrf-mi map")
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "map.npz"
        status, message = run_module(__name__, [str(path), str(out)], quiet=True, most_s=MOST_S)
        if status != 0:
            raise InputError(message if status == 1 else f"{path}: its content is damaged; make the map anew")
        arrays = stored_arrays(out)
    facts = json.loads(str(arrays[FACTS]))
    axes = arrays["x_m"], arrays["y_m"], arrays.get("z_m")
    values = {name.removeprefix(VALUES): array for name, array in arrays.items() if name.startswith(VALUES)}
    content = MapContent(path.name, facts["height_m"], *axes, tuple(facts["receivers"]), values, facts["labels"])
    return content, facts["notes"]


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


def _limit(kind: int, most: int) -> None:
    _, hard = resource.getrlimit(kind)
    resource.setrlimit(kind, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))


def main(file: str, out: str) -> int:
    """Write the map of a NetCDF or Zarr file as ``.npz``; status 1 with one line on standard error: it is no map.

    Run in a child process: the decompressors of both formats end it on some damaged files, and read others without end.
    """
    path, used = Path(file), resource.getrusage(resource.RUSAGE_SELF)
    size = sum(file.stat().st_size for file in (path.rglob("*") if path.is_dir() else [path]) if file.is_file())
    _limit(resource.RLIMIT_CPU, round(used.ru_utime + used.ru_stime + CPU_S + size / BYTES_PER_S) + 1)
    _limit(resource.RLIMIT_AS, psutil.Process().memory_info().vms + MEMORY_BYTES)
    import xarray

    opened: Any = xarray.open_zarr if path.suffix.lower() == ZARR else xarray.open_dataset
    try:
        with readable(path, f"{path}: no such file", "make the map anew"), opened(path) as dataset:
            require_memory(4 * dataset.nbytes, f"{path}: its content", "make a map of fewer positions")
            _limit(resource.RLIMIT_AS, psutil.Process().memory_info().vms + MEMORY_BYTES + 4 * dataset.nbytes)
            content, notes = map_content(dataset.load(), path.name)
    except InputError as error:
        print(one_line(error), file=sys.stderr)
        return 1
    facts = {"height_m": content.height_m, "receivers": content.receivers, "labels": content.labels, "notes": notes}
    arrays: dict[str, Any] = {FACTS: np.asarray(json.dumps(facts)), "x_m": content.x_m, "y_m": content.y_m}
    arrays |= {} if content.z_m is None else {"z_m": content.z_m}
    arrays |= {f"{VALUES}{name}": values for name, values in content.values.items()}
    np.savez(Path(out), **arrays)
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
