"""From NumPy to memory of Dr.Jit's own.

On a CPU, Dr.Jit wraps NumPy's memory as it is and gives it back when one of its own threads drops the last use. That
needs Python's lock, which a function that is being recorded holds: the process then hangs or ends. And its kernels say
how memory is aligned: what lies elsewhere in the next process would be compiled again. What is copied here belongs to
Dr.Jit alone.
"""

from __future__ import annotations

import sys
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike


def on_device(values: ArrayLike, kind: Any) -> Any:
    """All values in a row as an evaluated array of type ``kind``: floats, unsigned integers or a mask."""
    host: Any = np.float32 if kind is mi.Float else np.float64
    if not dr.is_float_v(kind):
        host = np.bool_ if dr.is_mask_v(kind) else np.uint32
    wrapped = kind(np.ascontiguousarray(values, host).ravel())
    if not dr.width(wrapped):
        return wrapped
    # A gather of all or a sum with zero would be seen through: Dr.Jit then hands out the wrapped array itself.
    own = wrapped & dr.opaque(kind, True) if dr.is_mask_v(kind) else wrapped * dr.opaque(kind, 1)
    dr.eval(own)
    dr.sync_thread()
    return own


def to_float(values: ArrayLike) -> Any:
    """A flat Dr.Jit float32 array of all values."""
    return on_device(values, mi.Float)


def to_tensor(values: ArrayLike) -> Any:
    """A Dr.Jit float32 tensor of the same shape."""
    return mi.TensorXf(to_float(values), np.shape(values))


def quads(float_type: Any) -> Any:
    """The type of four numbers of a float array's type, which gathers and scatters move as one packet."""
    module = sys.modules[float_type.__module__]
    return module.Array4f64 if dr.type_v(float_type) == dr.VarType.Float64 else module.Array4f
