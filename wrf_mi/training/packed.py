"""Parameters with 32, 16 or 8 bits a number, as a few plain arrays.

``single`` stores 32 bits a number, ``half`` 16 (IEEE 754 binary16: a relative error of 2^-11 at most), ``8bit`` 8 for
large matrices (of networks and of a factorised field's signals) and 16 for all else. In 8 bits each row of a matrix has
its lowest value and a step, and the error of a number is half a step at most.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import InputError

PACKED = "packed_"
"""Prefix of the arrays' names."""
PRECISIONS = ("single", "half", "8bit")
LEVELS = 255
MOST_ROWS_IN_FULL = 4
"""Largest number of rows that are stored in 16 bits, as of quaternions."""

Arrays = Mapping[str, NDArray[Any]]


def _in_bytes(rows: int, columns: int, precision: str) -> bool:
    """Whether a parameter of this shape is stored in 8 bits."""
    return precision == "8bit" and rows > MOST_ROWS_IN_FULL and columns > 1


def pack_params(params: Arrays, precision: str) -> dict[str, NDArray[Any]]:
    """Flat arrays of parameters [k, n] each: names, shapes and concatenated numbers.

    Raises:
        InputError: an unknown precision, or a number too large for it.
    """
    if precision not in PRECISIONS:
        raise InputError(f"precision {precision!r}: unknown; choose from {', '.join(PRECISIONS)}")
    wide, low, step, codes = [], [], [], []
    for values in params.values():
        if not _in_bytes(values.shape[0], values.shape[1], precision):
            wide.append(values.ravel())
            continue
        first, last = values.min(axis=1), values.max(axis=1)
        # Codes refer to the stored, rounded values.
        first, size = (a.astype(np.float32) for a in (first, (last - first) / LEVELS))
        low.append(first)
        step.append(size)
        safe = np.where(size > 0, size, 1)[:, None]
        codes.append(np.clip(np.round((values - first[:, None]) / safe), 0, LEVELS).astype(np.uint8).ravel())
    kind: Any = np.float32 if precision == "single" else np.float16
    with np.errstate(over="ignore"):
        numbers = np.concatenate([*wide, np.empty(0)]).astype(kind)
    if not np.isfinite(numbers).all():
        raise InputError(f"precision {precision}: a parameter is too large for it; choose single")
    return {
        "packed_precision": np.asarray(precision),
        "packed_name": np.asarray(list(params)),
        "packed_shape": np.asarray([values.shape for values in params.values()], np.int32),
        "packed_number": numbers,
        "packed_low": np.concatenate([*low, np.empty(0)]).astype(np.float32),
        "packed_step": np.concatenate([*step, np.empty(0)]).astype(np.float32),
        "packed_code": np.concatenate([*codes, np.empty(0, np.uint8)]),
    }


def unpack_params(packed: Arrays) -> dict[str, NDArray[np.float32]]:
    """Parameters from the arrays of `pack_params`, in single precision."""
    precision, params = str(packed["packed_precision"]), {}
    number, row, code = 0, 0, 0
    for name, shape in zip(packed["packed_name"], packed["packed_shape"], strict=True):
        rows, columns = map(int, shape)
        size = rows * columns
        if _in_bytes(rows, columns, precision):
            low, step = (packed[key][row : row + rows, None] for key in ("packed_low", "packed_step"))
            codes = packed["packed_code"][code : code + size].reshape(rows, columns)
            values = low + step * codes.astype(np.float32)
            row, code = row + rows, code + size
        else:
            values = packed["packed_number"][number : number + size].reshape(rows, columns)
            number += size
        params[str(name)] = values.astype(np.float32)
    return params
