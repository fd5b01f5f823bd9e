"""Points of a LAZ file, read in a child process: ``python -m wrf_mi.scene.scan.read_laz FILE OUT.npy MOST_BYTES``.

The decompressor ends the process where a damaged file states a size that it cannot allocate.
"""

from __future__ import annotations

import resource
import sys
from pathlib import Path

import laspy
import numpy as np


def main(file: str, out: str, most_bytes: str) -> int:
    """Write the points [m, 3] of a file; the exit status, 1 with one line on standard error for a damaged file."""
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    most = int(most_bytes) if hard == resource.RLIM_INFINITY else min(int(most_bytes), hard)
    resource.setrlimit(resource.RLIMIT_AS, (most, hard))
    # Not in parallel: its threads' errors are none of Python.
    try:
        with laspy.open(file, laz_backend=laspy.LazBackend.Lazrs) as source:
            np.save(Path(out), np.asarray(source.read().xyz, float))
    except BaseException as error:  # panics of the decompressor are no Exception
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
