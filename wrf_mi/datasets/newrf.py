"""The layout of the NeWRF rooms (``docs/data.md`` has the files): channels computed by an image-method ray tracer.

Original: ``data/dataset_<room>_ch1_rt_image_fc.pkl`` of https://github.com/LuHaofan/NeWRF, a pickled pandas table that
their ``simulator/mat2pkl.py`` wrote, one row per receiver. ``TxPos``, ``RxPos`` (m), ``Frequency`` (GHz), ``CSI``,
``LastXPts`` [3, p], ``RxChanPerRay`` [p, 1] and ``LineOfSight`` are used. Receivers without a path have no numbers and
are left out, as their ``loaders.py`` does.

Python's pickle calls whatever a file names. Here it may name the classes of NumPy and pandas that a table of numbers
consists of (`TABLE_NAMES`), and nothing else: "Restricting globals" of Python's documentation of pickle.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import DataFault, InputError, Receiver, Record
from ..core.antenna import UPRIGHT
from ..core.array_files import stored_arrays, write_arrays
from ..core.files import one_line, readable
from ..parallel import run_module
from .faults import refuse, stop_at_faults
from .folder_files import single_file

KEYS = ("tx_pos", "rx_pos", "frequency_hz", "csi", "line_of_sight", "path_offsets", "path_gain", "path_last_point")
"""All arrays of a room's file; a record needs the first four."""
TEST_FRACTION = 0.2
"""Share of the rows, the last ones, that the authors hold out (their ``DatasetLoader.split_train_val``)."""
SCALARS = ("TxID", "RxID", "Frequency", "LineOfSight")
ARRAYS = ("TxPos", "RxPos", "CSI", "LastXPts", "RxChanPerRay")
LARGEST_BYTES = 64 * 2**20  # largest file that is read
CONVERSION_S, REFUSED = 120.0, 2  # time of the process that converts a file, and its exit status where it refuses one
NO_TABLE = "not the pickle of a table of numbers"
TABLE_NAMES = (
    *("DataFrame", "BlockManager", "_unpickle_block", "_new_Index", "Index", "Int64Index", "RangeIndex"),
    *("_reconstruct", "_frombuffer", "ndarray", "dtype"),
)
"""Names in packages of pandas and NumPy that a pickled table of numbers and arrays may contain."""


def read_newrf(path: str | Path, name: str | None = None) -> Record:
    """Read and check one room: ``<room>.npz``, or a folder with such a file, after which the record is named.

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
        refuse(DataFault(file, f"rx_pos has {n} rows; the official split holds out every fifth, so give 5 at least"))
    stop_at_faults()
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
    """Some arrays of a room's file; an `InputError` if the file or an array is missing."""
    with readable(file, DataFault(file, "missing; give a room's .npz file"), "convert or fetch it again"):
        arrays = stored_arrays(file)
    if lacking := [key for key in keys if key not in arrays]:
        raise DataFault(file, f"no array {lacking[0]}; a room needs {', '.join(keys)}")
    return {key: arrays[key] for key in keys}


def _check(file: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    n = len(np.atleast_1d(arrays["rx_pos"]))
    shapes = {"tx_pos": (3,), "rx_pos": (n, 3), "frequency_hz": (), "csi": (n,)}
    for key, values in arrays.items():
        kinds, expected = ("c", "complex numbers") if key == "csi" else ("fiu", "numbers")
        if values.dtype.kind not in kinds:
            refuse(DataFault(file, f"{key} holds {values.dtype}; give {expected}"))
        elif values.shape != shapes[key]:
            refuse(DataFault(file, f"{key} has shape {list(values.shape)}, expected {list(shapes[key])}; correct it"))
        else:
            finite = np.isfinite(np.atleast_1d(values))
            for row in 1 + np.flatnonzero(~finite.all(axis=tuple(range(1, finite.ndim)))):
                place = f"{key}, row {row}"
                refuse(DataFault(file, "not finite; correct or remove the row", row=int(row), place=place))
            if key == "frequency_hz" and values <= 0:
                refuse(DataFault(file, f"frequency_hz is {values}; give the carrier in Hz"))


def convert_newrf(path: Path) -> dict[str, NDArray[Any]]:
    """The arrays of a room's ``.npz`` file from the authors' pickle, read in a child process.

    Damaged content ends a process that unpickles arrays.

    Raises:
        InputError: not their pickle, or pandas is not installed.
    """
    with TemporaryDirectory() as place:
        out = Path(place) / "arrays.npz"
        arguments = [str(path), str(out)]
        status, message = run_module("wrf_mi.datasets.newrf", arguments, quiet=True, most_s=CONVERSION_S)
        if status == 0:
            return stored_arrays(out)
    raise InputError(message if status == REFUSED else f"{path}: {NO_TABLE}; fetch it again")


def main(path: str, out: str) -> int:
    """Write the arrays of a pickle to an ``.npz`` file, or on standard error why it is refused."""
    try:
        columns = read_pickled_table(Path(path))
        if lacking := sorted({*SCALARS, *ARRAYS} - set(columns)):
            raise InputError(f"{path}: no column {lacking[0]}; give a data set of NeWRF for a single frequency")
        write_arrays(Path(out), _convert(columns))
    except InputError as error:
        print(error, file=sys.stderr)
        return REFUSED
    except (ValueError, TypeError, IndexError) as error:
        print(f"{path}: not in the form of NeWRF's data ({one_line(error)}); fetch it again", file=sys.stderr)
        return REFUSED
    return 0


def _convert(columns: dict[str, Any]) -> dict[str, NDArray[Any]]:
    scalars = {key: np.asarray(columns[key], float) for key in SCALARS}
    rows = np.flatnonzero(np.isfinite(np.stack(list(scalars.values()))).all(axis=0))
    tx_pos = np.unique(np.stack(_fields(columns["TxPos"], rows, float, 3)), axis=0)
    frequency_ghz = np.unique(scalars["Frequency"][rows])
    if len(tx_pos) != 1 or len(frequency_ghz) != 1:
        raise ValueError(f"{len(tx_pos)} transmitters and {len(frequency_ghz)} frequencies")
    gains = _fields(columns["RxChanPerRay"], rows, complex, -1)
    points = [np.asarray(columns["LastXPts"][r], float).T.reshape(-1, 3) for r in rows]
    counts = [len(gain) for gain in gains]
    if counts != [len(point) for point in points]:
        raise ValueError("a receiver with another number of gains than of points")
    return {
        "tx_pos": tx_pos[0],
        "rx_pos": np.stack(_fields(columns["RxPos"], rows, float, 3)),
        "frequency_hz": np.asarray(frequency_ghz[0] * 1e9),
        "csi": np.concatenate(_fields(columns["CSI"], rows, complex, 1)),
        "line_of_sight": scalars["LineOfSight"][rows] > 0,
        "path_offsets": np.concatenate([[0], np.cumsum(counts)]),
        "path_gain": np.concatenate(gains),
        "path_last_point": np.concatenate(points),
    }


def _fields(column: Any, rows: NDArray[np.int64], kind: type, length: int) -> list[NDArray[Any]]:
    """Lists of a number of values, or any for -1, in some rows of a column."""
    return [np.asarray(column[row], kind).reshape(length) for row in rows]


def read_pickled_table(path: Path) -> dict[str, NDArray[Any]]:
    """The columns of a pickled ``DataFrame`` of numbers and arrays of numbers.

    Raises:
        InputError: pandas is not installed, or a file that is missing, too large, damaged, or not such a table.
    """
    try:
        from pandas import DataFrame
        from pandas.compat.pickle_compat import Unpickler
    except ImportError:
        raise InputError(f"{path}: reading it needs pandas; install it: pip install '.[tables]'") from None

    class TableUnpickler(Unpickler):
        """Pandas' reader of tables of former versions, which looks up no other names."""

        def find_class(self, module: str, name: str) -> Any:
            if module.partition(".")[0] not in ("pandas", "numpy") or name not in TABLE_NAMES:
                raise ValueError(f"names {module}.{name}")
            return super().find_class(module.replace("numpy.core.", "numpy._core."), name)

    try:
        if (size := path.stat().st_size) > LARGEST_BYTES:
            raise ValueError(f"{size / 2**20:.0f} MiB, where a table has {LARGEST_BYTES // 2**20} at most")
        with path.open("rb") as stream:
            frame = TableUnpickler(stream).load()
        if not isinstance(frame, DataFrame):
            raise ValueError(f"{type(frame).__name__} in place of a table")
        return {str(name): frame[name].to_numpy() for name in frame.columns}
    except Exception as error:  # a damaged or hostile pickle raises nearly every kind
        raise InputError(f"{path}: {NO_TABLE} ({one_line(error)}); fetch it again") from None


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
