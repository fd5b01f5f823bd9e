"""Points of a LAZ or E57 file, read in a child process.

``python -m wrf_mi.scene.scan.read_child FILE OUT.npz MOST_BYTES``: readers in other languages end the process where a
damaged file states a size that they cannot allocate.
"""

from __future__ import annotations

import resource
import sys
from pathlib import Path
from typing import Any

import numpy as np

NOISE_CLASSES = (7, 18)
"""Low and high noise in LAS."""


def main(file: str, out: str, most_bytes: str) -> int:
    """Write points, number of points of each scan and viewpoints; 1 with a line on standard error for a bad file."""
    read = {".laz": _laz, ".e57": _e57}[Path(file).suffix.lower()]
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    most = int(most_bytes) if hard == resource.RLIM_INFINITY else min(int(most_bytes), hard)
    resource.setrlimit(resource.RLIMIT_AS, (most, hard))
    try:
        scans = read(file)
        viewpoints = np.array([viewpoint for _, viewpoint in scans], float).reshape(-1, 3)
        points = np.concatenate([points for points, _ in scans], dtype=float)
        np.savez(Path(out), points=points, sizes=[len(points) for points, _ in scans], viewpoints=viewpoints)
    except BaseException as error:  # panics of the decompressor are no Exception
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        return 1
    return 0


def _laz(file: str) -> list[tuple[np.ndarray, list[float]]]:
    import laspy

    # Not in parallel: its threads' errors are none of Python.
    with laspy.open(file, laz_backend=laspy.LazBackend.Lazrs) as source:
        return [(surveyed_points(source.read()), [np.nan] * 3)]


def surveyed_points(las: Any) -> np.ndarray:
    """Points [n, 3] of a LAS file, NaN where it marks them as noise or withheld.

    Source: ASPRS, "LAS specification 1.4 - R15", tables 8, 16 and 17.
    """
    points = np.array(las.xyz)
    points[np.isin(las.classification, NOISE_CLASSES) | (np.asarray(las.withheld) != 0)] = np.nan
    return points


def _e57(file: str) -> list[tuple[np.ndarray, list[float]]]:
    import pye57

    source, scans = pye57.E57(file), []
    for index in range(source.scan_count):
        header = source.get_header(index)
        columns = source.read_scan(
            index, ignore_missing_fields=True
        )  # moved by its pose, points marked invalid left out
        points = np.stack([columns[f"cartesian{axis}"] for axis in "XYZ"], axis=1)
        scans.append((points, list(header.translation) if header.has_pose() else [np.nan] * 3))
    return scans


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
