"""Arrays of MAT files, read in a child process: ``python -m wrf_mi.datasets.read_mat OUT.npz KEY=FILE ...``.

SciPy's reader ends the process on some damaged files.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat

from ..core import InputError
from ..core.array_files import stored_arrays
from ..parallel import run_module

FAULT = "fault/"  # prefix of the key of a message, of a file that cannot be read
MAT_S, MAT_BYTES_PER_S = 30.0, 1 << 20  # time that the process which reads MAT files has


def mat_arrays(files: Mapping[str, Path], remedy: str) -> dict[str, NDArray[Any]]:
    """Arrays of those files that are MAT files by their keys, and messages of those that cannot be read.

    Raises:
        InputError: a damaged file, with a remedy.
    """
    files = {key: file for key, file in files.items() if file.suffix == ".mat"}
    if not files:
        return {}
    with tempfile.TemporaryDirectory() as place:
        out = Path(place) / "arrays.npz"
        arguments = [f"{key}={file}" for key, file in files.items()]
        seconds = MAT_S + sum(file.stat().st_size for file in files.values()) / MAT_BYTES_PER_S
        status, _ = run_module("wrf_mi.datasets.read_mat", [str(out), *arguments], quiet=True, most_s=seconds)
        if status != 0:
            first = next(iter(files.values()))
            what = "damaged" if len(files) == 1 else "it, or a matrix beside it, is damaged"
            raise InputError(f"{first}: {what}; {remedy}")
        return stored_arrays(out)


def main(out: str, *stated: str) -> int:
    """Write the array ``KEY`` of each file, if it is there and holds no objects, or a message why it cannot be read."""
    arrays: dict[str, Any] = {}
    for each in stated:
        key, _, file = each.partition("=")
        try:
            values = loadmat(file).get(key)
        except Exception as error:  # a dozen kinds on damaged files
            arrays[f"{FAULT}{key}"] = np.asarray(f"{error}"[:300])
            continue
        if values is not None:
            arrays[key] = np.asarray(values) if not np.asarray(values).dtype.hasobject else np.asarray("objects")
    np.savez(Path(out), **arrays)
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
