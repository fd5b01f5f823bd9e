"""Arrays in 16 bits as text, for pages that hold their data."""

from __future__ import annotations

import base64
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

LARGEST = 65534  # number of steps of a range
MISSING = 65535  # code of a value that is not finite
SMALLEST_RANGE = 1e-300
"""Range below which numbers are packed as equal: the steps of a smaller one have few digits or underflow."""


def plain(value: Any) -> Any:
    """Values for JSON: dataclasses as dictionaries of their fields, arrays as of `packed`."""
    if is_dataclass(value):
        return {field.name: plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, dict):
        return {key: plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [plain(one) for one in value]
    return packed(value) if isinstance(value, np.ndarray) else value


def packed(values: ArrayLike) -> dict[str, Any]:
    """Numbers as 16-bit codes of equal steps over their range, for ``unpack`` of ``tools.js``.

    Args:
        values: real numbers of any shape; integers over a range of at most `LARGEST` are exact, other numbers are
            rounded to a 65534th of their range, and values that are not finite become NaN.

    Returns:
        ``shape``, ``low``, ``step`` and ``codes``: base64 of little-endian unsigned 16-bit integers c in the order of
        the last axis, of values low + c * step.
    """
    array = np.asarray(values)
    numbers = array.astype(float)
    finite = np.isfinite(numbers)
    known = numbers[finite]
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 0.0)
    exact = array.dtype.kind in "iub" and high - low <= LARGEST
    step = 1.0 if exact or high - low < SMALLEST_RANGE else (high - low) / LARGEST
    codes = np.full(array.shape, MISSING, "<u2")
    codes[finite] = np.round((known - low) / step)
    return {
        "shape": list(array.shape),
        "low": low,
        "step": step,
        "codes": base64.b64encode(codes.tobytes()).decode("ascii"),
    }
