"""Reading a pickled pandas table without running what the pickle names.

Python's pickle calls whatever a file names. Here every name becomes an inert record of what it would have been given
(`_Named`): nothing is looked up, imported or called, whatever the file says. From these records the columns are
rebuilt, out of NumPy arrays of plain numbers alone.

Format: pickle as of Python's ``pickletools``; a ``DataFrame`` as pandas 1.4 and later write it (blocks of columns with
their places), arrays as NumPy writes them (``_reconstruct`` up to protocol 4, ``_frombuffer`` from protocol 5).
"""

from __future__ import annotations

import math
import pickle
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import InputError
from ..core.files import one_line

LARGEST_BYTES = 64 * 2**20
"""A larger file is refused unread."""
NUMBERS = frozenset("?bBhHiIlLqQefdFD")
"""Type characters of arrays of plain numbers."""


class _Named:
    """An object that a pickle names, as it was described there: arguments and state."""

    name = ""
    args: tuple[Any, ...]
    state: Any

    def __new__(cls, *args: Any, **_: Any) -> _Named:
        made = super().__new__(cls)
        made.args, made.state = args, None
        return made

    def __setstate__(self, state: Any) -> None:
        self.state = state


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> type[_Named]:
        return type("_Named", (_Named,), {"name": f"{module}.{name}"})


def read_pickled_table(path: Path) -> dict[str, list[Any] | NDArray[Any]]:
    """The columns of a pickled ``DataFrame``: NumPy arrays of numbers, or lists where fields hold arrays.

    Raises:
        InputError: missing, too large, damaged, or not a table of numbers and arrays of numbers.
    """
    try:
        size = path.stat().st_size
        if size > LARGEST_BYTES:
            raise ValueError(f"{size / 2**20:.0f} MiB, where a table has {LARGEST_BYTES // 2**20} at most")
        with path.open("rb") as stream:
            return _columns(_Unpickler(stream).load())
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({one_line(error)}); fetch it again") from None
    except Exception as error:  # a damaged or hostile pickle raises nearly every kind
        raise InputError(f"{path}: not the pickle of a table of numbers ({one_line(error)}); fetch it again") from None


def _columns(frame: Any) -> dict[str, list[Any] | NDArray[Any]]:
    state = _named(frame, "DataFrame").state
    manager = _named(state.get("_mgr") if isinstance(state, dict) else None, "BlockManager")
    blocks, axes = _arguments(manager, 2)
    names = _index(axes[0])
    columns: dict[str, list[Any] | NDArray[Any]] = {}
    for block in blocks:
        values, places, _ = _arguments(_named(block, "_unpickle_block"), 3)
        rows = _array(values)
        for place, row in zip(_places(places, len(rows)), rows, strict=True):
            columns[names[place]] = row if row.dtype != object else [_value(field) for field in row]
    return columns


def _index(index: Any) -> list[str]:
    _, described = _arguments(_named(index, "_new_Index"), 2)
    names = _array(described.get("data")) if isinstance(described, dict) else np.zeros(0)
    if not all(isinstance(name, str) for name in names):
        raise ValueError("columns without names")
    return list(names)


def _places(places: Any, count: int) -> list[int]:
    if _is(places, "slice"):
        start, stop, step = _arguments(places, 3)
        found = range(start, stop, step)[: count + 1]
    else:
        found = _array(places).tolist()
    if len(found) != count:
        raise ValueError(f"{count} columns at {len(found)} places")
    return list(found)


def _value(field: Any) -> Any:
    """An array, or a number, in a field of a column of objects."""
    if isinstance(field, int | float | complex) or field is None:
        return field
    return _array(field)


def _array(described: Any) -> NDArray[Any]:
    """The NumPy array that was described: by its bytes, or by a list where it holds objects."""
    if _is(described, "_frombuffer"):
        data, dtype, shape, order = _arguments(described, 4)
    elif _is(described, "_reconstruct"):
        if not isinstance(described.state, tuple) or len(described.state) != 5:
            raise ValueError("an array without content")
        _, shape, dtype, fortran, data = described.state
        order = "F" if fortran else "C"
    else:
        raise ValueError(f"{getattr(described, 'name', type(described).__name__)} where an array belongs")
    kind = _dtype(dtype)
    if kind.hasobject:
        if not isinstance(data, list):
            raise ValueError("an array of objects without a list")
        flat = np.empty(len(data), object)
        flat[:] = data
    else:
        if not isinstance(data, bytes | bytearray):
            raise ValueError("an array of numbers without bytes")
        flat = np.frombuffer(data, kind).copy()
    if math.prod(shape) != len(flat):
        raise ValueError(f"{len(flat)} values for the shape {shape}")
    return flat.reshape(shape, order=order)


def _dtype(described: Any) -> np.dtype[Any]:
    code, *_ = _named(described, "dtype").args
    if code == "O8":
        return np.dtype(object)
    order = described.state[1] if isinstance(described.state, tuple) else "|"
    if order not in ("<", ">", "|") or np.dtype(str(code)).char not in NUMBERS:
        raise ValueError(f"an array of type {code}")
    return np.dtype(f"{order}{code}")


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
