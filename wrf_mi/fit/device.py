"""From NumPy to Dr.Jit, by copy.

On a CPU, Dr.Jit wraps NumPy's memory and gives it back when one of its own threads drops the last use. That
needs Python's lock, which a function that is being recorded holds: the process then hangs or ends. What is
copied here belongs to Dr.Jit alone.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike


def to_float(values: ArrayLike) -> Any:
    """A flat Dr.Jit float32 array of all values."""
    wrapped = mi.Float(np.ascontiguousarray(values, np.float32).ravel())
    own = dr.gather(mi.Float, wrapped, dr.arange(mi.UInt32, dr.width(wrapped)))
    dr.eval(own)
    dr.sync_thread()
    return own


def to_tensor(values: ArrayLike) -> Any:
    """A Dr.Jit float32 tensor of the same shape."""
    return mi.TensorXf(to_float(values), np.shape(values))
