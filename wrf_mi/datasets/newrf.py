"""The layout of the NeWRF rooms: channels computed by an image-method ray tracer, one ``.npz`` file per room.

Format of ``<room>.npz`` (ours, from the pickles of https://github.com/LuHaofan/NeWRF, see `newrf_original`), with the
room's mesh beside it as ``<room>.stl``, metres:

- ``tx_pos`` [3] and ``rx_pos`` [n, 3], metres; ``frequency_hz``, a number;
- ``csi`` [n] complex: sum over the paths to each receiver; ``line_of_sight`` [n], whether one of them is direct;
- for each path ``path_gain`` [p] complex and ``path_last_point`` [p, 3], its last interaction point (the
  transmitter's position for the line of sight); receiver i has paths ``path_offsets[i]:path_offsets[i + 1]``.

The *receiver* of these data moves. By reciprocity the record's transmitter is the moving end, and its receiver stands
at the file's ``tx_pos``.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import InputError, Receiver, Record
from ..core.antenna import UPRIGHT
from ..core.files import readable, stored_arrays
from .folder_files import single_file

KEYS = ("tx_pos", "rx_pos", "frequency_hz", "csi", "line_of_sight", "path_offsets", "path_gain", "path_last_point")
"""All arrays of a room's file; a record needs the first four."""
TEST_FRACTION = 0.2
"""Share of the rows, the last ones, that the authors hold out (their ``DatasetLoader.split_train_val``)."""


def read_newrf(path: str | Path, name: str | None = None) -> Record:
    """Read and check one room.

    Args:
        path: path of ``<room>.npz``, or of a folder with such a file.
        name: name of the record; by default that of the file without its ending.

    Returns:
        A record with ``task="csi"``: ``observation`` [1, n, 1] complex64, ``tx_pos_m`` the file's ``rx_pos``.

    Raises:
        InputError: anything missing, unreadable or inconsistent; one line with the file, the array and the row.
    """
    file = single_file(Path(path), (".npz",), "one room in .npz")
    arrays = read_arrays(file, KEYS[:4])
    _check(file, arrays)
    n = len(arrays["rx_pos"])
    n_test = int(TEST_FRACTION * n)
    if n_test == 0:
        raise InputError(f"{file}: rx_pos has {n} rows; the official split holds out every fifth, so give 5 at least")
    return Record(
        name=name or file.stem,
        task="csi",
        tx_pos_m=arrays["rx_pos"].astype(float),
        receivers=(Receiver("access-point", arrays["tx_pos"].astype(float), np.array(UPRIGHT)),),
        observation=arrays["csi"].astype(np.complex64)[None, :, None],
        official=(np.arange(n - n_test), np.arange(n - n_test, n)),
        frequencies_hz=np.array([float(arrays["frequency_hz"])]),
        source=str(file),
    )


def arrays_sha256(arrays: Mapping[str, NDArray[Any]]) -> str:
    """SHA-256 (hex) over the names, types, shapes and bytes of a room's arrays."""
    digest = hashlib.sha256()
    for key in KEYS:
        values = np.asarray(arrays[key])
        little = np.ascontiguousarray(values, values.dtype.newbyteorder("<"))
        digest.update(f"{key} {little.dtype.str} {values.shape}\n".encode())
        digest.update(little.tobytes())
    return digest.hexdigest()


def read_arrays(file: Path, keys: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Some arrays of a room's file.

    Raises:
        InputError: the file is missing or damaged, or an array is missing.
    """
    with readable(file, f"{file}: missing; give a room's .npz file", "convert or fetch it again"):
        arrays = stored_arrays(file)
    if lacking := [key for key in keys if key not in arrays]:
        raise InputError(f"{file}: no array {lacking[0]}; a room needs {', '.join(keys)}")
    return {key: arrays[key] for key in keys}


def _check(file: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    n = len(np.atleast_1d(arrays["rx_pos"]))
    shapes = {"tx_pos": (3,), "rx_pos": (n, 3), "frequency_hz": (), "csi": (n,)}
    for key, values in arrays.items():
        kinds, expected = ("c", "complex numbers") if key == "csi" else ("fiu", "numbers")
        if values.dtype.kind not in kinds:
            raise InputError(f"{file}: {key} holds {values.dtype}; give {expected}")
        if values.shape != shapes[key]:
            raise InputError(f"{file}: {key} has shape {list(values.shape)}, expected {list(shapes[key])}; correct it")
        bad = np.flatnonzero(~np.isfinite(values).reshape(max(len(np.atleast_1d(values)), 1), -1).all(axis=1))
        if len(bad):
            raise InputError(f"{file}: {key}, row {bad[0] + 1}: not finite; correct or remove the row")
    if not arrays["frequency_hz"] > 0:
        raise InputError(f"{file}: frequency_hz is {arrays['frequency_hz']}; give the carrier in Hz")
