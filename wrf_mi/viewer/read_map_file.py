"""Map of a NetCDF or Zarr file, read in a child process: ``python -m wrf_mi.viewer.read_map_file FILE OUT.npz``.

The decompressors of both formats end the process on some damaged files, and read others without end.
"""

from __future__ import annotations

import json
import resource
import sys
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import xarray

from ..core import InputError
from ..core.files import one_line, readable
from ..core.memory import require_memory
from .map_layer import FACTS, VALUES, ZARR, map_content

MEMORY_BYTES, CPU_S, BYTES_PER_S = 2 << 30, 5, 4 << 20
"""Addresses beyond those of the imports and of the values, and processor time: of a file, and for each byte of it."""


def _limit(kind: int, most: int) -> None:
    _, hard = resource.getrlimit(kind)
    resource.setrlimit(kind, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))


def _limit_memory(more_bytes: int) -> None:
    _limit(resource.RLIMIT_AS, psutil.Process().memory_info().vms + MEMORY_BYTES + more_bytes)


def main(file: str, out: str) -> int:
    """Write the map; the exit status, 1 with one line on standard error for a file that is no map."""
    path, used = Path(file), resource.getrusage(resource.RUSAGE_SELF)
    size = sum(file.stat().st_size for file in (path.rglob("*") if path.is_dir() else [path]) if file.is_file())
    _limit(resource.RLIMIT_CPU, round(used.ru_utime + used.ru_stime + CPU_S + size / BYTES_PER_S) + 1)
    _limit_memory(0)
    opened: Any = xarray.open_zarr if path.suffix.lower() == ZARR else xarray.open_dataset
    try:
        with readable(path, f"{path}: no such file", "make the map anew"), opened(path) as dataset:
            require_memory(4 * dataset.nbytes, f"{path}: its content", "make a map of fewer positions")
            _limit_memory(4 * dataset.nbytes)
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
