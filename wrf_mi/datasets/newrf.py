"""The layout of the NeWRF rooms: channels computed by an image-method ray tracer, one ``.npz`` file per room.

Format of ``<room>.npz`` (ours, from the pickles of https://github.com/LuHaofan/NeWRF, see `newrf_original`), with the
room's mesh beside it as ``<room>.stl``, metres:

- ``tx_pos`` [3] and ``rx_pos`` [n, 3], metres; ``frequency_hz``, a number;
- ``csi`` [n] complex: sum over the paths to each receiver; ``line_of_sight`` [n], whether one of them is direct;
- for each path ``path_gain`` [p] complex and ``path_last_point`` [p, 3], its last interaction point (the
  transmitter's position for the line of sight); receiver i has paths ``path_offsets[i]:path_offsets[i + 1]``.

Here the *receiver* moves. By reciprocity the record's transmitter is that moving end, and its one receiver stands at
the file's ``tx_pos``.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import InputError, Receiver, Record
from ..core.files import one_line

KEYS = ("tx_pos", "rx_pos", "frequency_hz", "csi", "line_of_sight", "path_offsets", "path_gain", "path_last_point")
"""All arrays of a room's file; a record needs the first four."""
TEST_FRACTION = 0.2
"""Share of the rows, the last ones, that the authors hold out (their ``DatasetLoader.split_train_val``)."""


def read_newrf(path: str | Path, name: str | None = None) -> Record:
    """Read and check one room.

    Args:
        path: ``<room>.npz``, or a folder that holds one such file.
        name: the record's name; the file's own without its ending by default.

    Returns:
        A record with ``task="csi"``: ``observation`` [1, n, 1] complex64, ``tx_pos_m`` the file's ``rx_pos``.

    Raises:
        InputError: anything missing, unreadable or inconsistent; one line with the file, the array and the row.
    """
    file = room_file(Path(path))
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
        receivers=(Receiver("access-point", arrays["tx_pos"].astype(float), np.array([0.0, 0.0, 0.0, 1.0])),),
        observation=arrays["csi"].astype(np.complex64)[None, :, None],
        official=(np.arange(n - n_test), np.arange(n - n_test, n)),
        frequencies_hz=np.array([float(arrays["frequency_hz"])]),
        source=str(file),
    )


def room_file(path: Path) -> Path:
    """The one ``.npz`` file of a folder, or the file itself.

    Raises:
        InputError: none, or several.
    """
    if not path.is_dir():
        return path
    rooms = sorted(path.glob("*.npz"))
    if len(rooms) != 1:
        found = ", ".join(room.name for room in rooms) or "none"
        raise InputError(f"{path}: one room in .npz is read at a time, found {found}; give the file itself")
    return rooms[0]


def arrays_sha256(arrays: Mapping[str, NDArray[Any]]) -> str:
    """SHA-256 (hex) over the arrays of a room: their names, types, shapes and bytes, whatever file holds them."""
    digest = hashlib.sha256()
    for key in KEYS:
        values = np.asarray(arrays[key])
        little = np.ascontiguousarray(values, values.dtype.newbyteorder("<"))
        digest.update(f"{key} {little.dtype.str} {values.shape}\n".encode())
        digest.update(little.tobytes())
    return digest.hexdigest()


def read_arrays(file: Path, keys: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Arrays of a room's file as they are there.

    Raises:
        InputError: missing or damaged, or one of the arrays is missing.
    """
    try:
        with file.open("rb") as stream, np.load(stream, allow_pickle=False) as stored:
            return {key: stored[key] for key in keys}
    except FileNotFoundError:
        raise InputError(f"{file}: missing; give a room's .npz file") from None
    except KeyError as error:
        raise InputError(f"{file}: no array ({one_line(error)}); a room needs {', '.join(keys)}") from None
    except Exception as error:  # numpy and zipfile raise a dozen kinds on damaged files
        raise InputError(f"{file}: not readable as .npz ({one_line(error)}); convert or fetch it again") from None


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
