"""The layout of the NeWRF rooms (``docs/data.md`` has the files): channels computed by an image-method ray tracer.

Original: ``data/dataset_<room>_ch1_rt_image_fc.pkl`` of https://github.com/LuHaofan/NeWRF, a pickled pandas table that
their ``simulator/mat2pkl.py`` wrote, one row per receiver. ``TxPos``, ``RxPos`` (m), ``Frequency`` (GHz), ``CSI``,
``LastXPts`` [3, p], ``RxChanPerRay`` [p, 1] and ``LineOfSight`` are used. Receivers without a path have no numbers and
are left out, as their ``loaders.py`` does.

Python's pickle calls whatever a file names. Here every name becomes an inert object (`_Named`) that holds its
arguments: nothing is looked up, imported or called. The columns are rebuilt from these objects, out of NumPy arrays
of plain numbers. Format: pickle as of Python's ``pickletools``; a ``DataFrame`` as pandas 1.4 to 3 write it
(blocks of columns with their indices), arrays as NumPy writes them (``_reconstruct`` up to protocol 4,
``_frombuffer`` from protocol 5).
"""

from __future__ import annotations

import hashlib
import itertools
import math
import pickle
import pickletools
from collections.abc import Iterator, Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import DataFault, InputError, Receiver, Record
from ..core.antenna import UPRIGHT
from ..core.array_files import stored_arrays
from ..core.files import one_line, readable
from ..tasks import CSI
from .faults import refuse, stop_at_faults
from .folder_files import single_file

KEYS = ("tx_pos", "rx_pos", "frequency_hz", "csi", "line_of_sight", "path_offsets", "path_gain", "path_last_point")
"""All arrays of a room's file; a record needs the first four."""
TEST_FRACTION = 0.2
"""Share of the rows, the last ones, that the authors hold out (their ``DatasetLoader.split_train_val``)."""
SCALARS = ("TxID", "RxID", "Frequency", "LineOfSight")
ARRAYS = ("TxPos", "RxPos", "CSI", "LastXPts", "RxChanPerRay")
LARGEST_BYTES = 64 * 2**20  # largest file that is read
NUMBERS = frozenset("?bBhHiIlLqQefdFD")  # type characters of arrays of plain numbers
PLAIN = (int, float, complex, type(None))  # types of fields beside arrays in a column of objects


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
        task=CSI,
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
    """The arrays of a room's ``.npz`` file from the authors' pickle, of which nothing is run.

    Raises:
        InputError: not their pickle.
    """
    columns = read_pickled_table(path)
    lacking = sorted(set(SCALARS + ARRAYS) - set(columns))
    if lacking:
        raise InputError(f"{path}: no column {lacking[0]}; give a data set of NeWRF for a single frequency")
    try:
        return _convert(columns)
    except (ValueError, TypeError, IndexError) as error:
        raise InputError(f"{path}: not in the form of NeWRF's data ({one_line(error)}); fetch it again") from None


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


class _Named:
    """An object named in a pickle, with its arguments and state."""

    name = ""
    args: tuple[Any, ...]
    state: Any

    def __new__(cls, *args: Any, **_: Any) -> _Named:
        inert = super().__new__(cls)
        inert.args, inert.state = args, None
        return inert

    def __setstate__(self, state: Any) -> None:
        self.state = state


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> type[_Named]:
        return type("_Named", (_Named,), {"name": f"{module}.{name}"})


def _check_pickle(content: bytes) -> None:
    """Refuse a pickle that would take more memory than its size allows: Python makes room for what it states."""
    for code, argument, _ in pickletools.genops(content):
        if code.name in ("PUT", "BINPUT", "LONG_BINPUT") and int(argument or 0) > len(content):
            raise ValueError(f"place {argument} in a list of at most {len(content)} objects")


def read_pickled_table(path: Path) -> dict[str, list[Any] | NDArray[Any]]:
    """The columns of a pickled ``DataFrame``: NumPy arrays of numbers, or lists of fields that are arrays.

    Raises:
        InputError: missing, too large, damaged, or not a table of numbers and arrays of numbers.
    """
    try:
        size = path.stat().st_size
        if size > LARGEST_BYTES:
            raise ValueError(f"{size / 2**20:.0f} MiB, where a table has {LARGEST_BYTES // 2**20} at most")
        content = path.read_bytes()
        _check_pickle(content)
        return _columns(_Unpickler(BytesIO(content)).load())
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({one_line(error)}); fetch it again") from None
    except Exception as error:  # a damaged or hostile pickle raises nearly every kind
        raise InputError(f"{path}: not the pickle of a table of numbers ({one_line(error)}); fetch it again") from None


def _columns(frame: Any) -> dict[str, list[Any] | NDArray[Any]]:
    state = _named(frame, "DataFrame").state
    manager = _named(state.get("_mgr") if isinstance(state, dict) else None, "BlockManager")
    blocks, axes = _arguments(manager, 2)
    _, index = _arguments(_named(axes[0], "_new_Index"), 2)
    names = _names(index.get("data")) if isinstance(index, dict) else []
    if not names or not all(isinstance(name, str) for name in names):
        raise ValueError("columns without names")
    numbered = itertools.chain.from_iterable(map(_numbered_columns, blocks))
    return {names[number]: column for number, column in numbered}


def _numbered_columns(block: Any) -> Iterator[tuple[int, list[Any] | NDArray[Any]]]:
    """Numbers of a block's columns, and their numbers or fields."""
    values, places, _ = _arguments(_named(block, "_unpickle_block"), 3)
    rows = _array(values)
    in_steps = _is(places, "slice")
    numbers = range(*_arguments(places, 3))[: len(rows) + 1] if in_steps else _array(places).tolist()
    if len(numbers) != len(rows):
        raise ValueError(f"{len(rows)} columns with {len(numbers)} numbers")
    for number, row in zip(numbers, rows, strict=True):
        plain = row.dtype != object
        yield number, row if plain else [field if isinstance(field, PLAIN) else _array(field) for field in row]


def _names(described: Any) -> list[Any]:
    """Names of columns: an array of objects, or as of pandas 3 an array of texts, by NumPy or by Arrow."""
    if _is(described, "__pyx_unpickle_NDArrayBacked"):
        described = described.state[1]
    if not _is(described, "ArrowStringArray"):
        return list(_array(described))
    kind, count, _, first, buffers, *_ = _named(described.state["_pa_array"], "_restore_array").args[0]
    (alias,) = _arguments(_named(kind, "type_for_alias"), 1)
    contents = (_arguments(_named(buffer, "py_buffer"), 1)[0] for buffer in buffers[1:3])
    bounds, text = (content.args[0] if _is(content, "bytearray") else content for content in contents)
    at = np.frombuffer(bounds, {"string": "<i4", "large_string": "<i8"}[alias])[first : first + count + 1].tolist()
    if len(at) != count + 1:
        raise ValueError(f"{count} names with {len(at)} bounds")
    return [bytes(text[a:b]).decode() for a, b in itertools.pairwise(at)]


def _array(described: Any) -> NDArray[Any]:
    """The NumPy array of a description: by its bytes, or by a list where it holds objects."""
    if _is(described, "_frombuffer"):
        data, dtype, shape, order = _arguments(described, 4)
    else:
        state = _named(described, "_reconstruct").state
        if not isinstance(state, tuple) or len(state) != 5:
            raise ValueError("an array without content")
        _, shape, dtype, fortran, data = state
        order = "F" if fortran else "C"
    flat = _flat_array(data, dtype)
    if math.prod(shape) != len(flat):
        raise ValueError(f"{len(flat)} values for the shape {shape}")
    return flat.reshape(shape, order=order)


def _flat_array(data: Any, dtype: Any) -> NDArray[Any]:
    """Values of an array in the order of its description, a copy."""
    code, *_ = _named(dtype, "dtype").args
    if code == "O8":
        if not isinstance(data, list):
            raise ValueError("an array of objects without a list")
        objects = np.empty(len(data), object)
        objects[:] = data
        return objects
    endian = dtype.state[1] if isinstance(dtype.state, tuple) else "|"
    if endian not in ("<", ">", "|") or np.dtype(str(code)).char not in NUMBERS:
        raise ValueError(f"an array of type {code}")
    if not isinstance(data, bytes | bytearray):
        raise ValueError("an array of numbers without bytes")
    return np.frombuffer(data, f"{endian}{code}").copy()


def _is(value: Any, name: str) -> bool:
    return isinstance(value, _Named) and value.name.rpartition(".")[2] == name


def _named(value: Any, name: str) -> _Named:
    if not _is(value, name):
        raise ValueError(f"{getattr(value, 'name', type(value).__name__)} where {name} belongs")
    return value


def _arguments(value: _Named, count: int) -> tuple[Any, ...]:
    if len(value.args) != count:
        raise ValueError(f"{value.name} of {len(value.args)} arguments")
    return value.args
