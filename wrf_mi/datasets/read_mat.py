"""Arrays of MAT files, read in a child process: ``python -m wrf_mi.datasets.read_mat OUT.npz KEY=FILE ...``.

SciPy's reader ends the process on some damaged files.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import loadmat

FAULT = "fault/"  # prefix of the key of a message, of a file that cannot be read


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
