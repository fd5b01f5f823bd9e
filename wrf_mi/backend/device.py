"""From NumPy to memory of Dr.Jit's own: the one way in.

On a CPU, Dr.Jit 1.5 wraps NumPy's memory as it is. Three things are wrong with that. Kernels read whole packets of 8 or
16 numbers, and so beyond the end of an array whose size is no multiple of them: where the next page is nobody's, the
process ends. The memory is given back when one of Dr.Jit's own threads drops the last use, which needs Python's lock;
a function that is being recorded holds it, and the process then hangs or ends. And kernels say how memory is aligned:
what lies elsewhere in the next process would be compiled again. What is copied here belongs to Dr.Jit alone.
"""

from __future__ import annotations

import sys
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike, NDArray

PACKET = 64
"""Numbers after the end of what Dr.Jit wraps, whatever they are: no packet of LLVM's is longer."""
HOST: dict[Any, type[np.generic]] = {
    dr.VarType.Float32: np.float32,
    dr.VarType.Float64: np.float64,
    dr.VarType.Int32: np.int32,
    dr.VarType.UInt32: np.uint32,
    dr.VarType.Bool: np.bool_,
}


def on_device(values: ArrayLike, kind: Any) -> Any:
    """All values in a row as an evaluated array of type ``kind``: floats, integers of 32 bits or a mask."""
    wrapped = kind(with_room(values, HOST[dr.type_v(kind)]))
    if not dr.width(wrapped):
        return wrapped
    # A gather of all or a sum with zero would be seen through: Dr.Jit then hands out the wrapped array itself.
    own = wrapped & dr.opaque(kind, True) if dr.is_mask_v(kind) else wrapped * dr.opaque(kind, 1)
    dr.eval(own)
    dr.sync_thread()
    return own


def with_room(values: ArrayLike, kind: type[np.generic]) -> NDArray[Any]:
    """A flat copy of all values with room behind it for the rest of a packet."""
    given = np.asarray(values)
    room: NDArray[Any] = np.zeros(given.size + PACKET, kind)[: given.size]
    np.copyto(room.reshape(given.shape), given, casting="unsafe")
    return room


def to_float(values: ArrayLike) -> Any:
    """A flat Dr.Jit float32 array of all values."""
    return on_device(values, mi.Float)


def to_uint(values: ArrayLike) -> Any:
    """A flat Dr.Jit array of all values, integers from 0."""
    return on_device(values, mi.UInt32)


def to_tensor(values: ArrayLike, kind: Any = None) -> Any:
    """A Dr.Jit tensor of the same shape, float32 or of another type of arrays ``kind``."""
    own = mi.Float if kind is None else kind
    tensor: Any = dr.tensor_t(own)
    return tensor(on_device(values, own), np.shape(values))


def to_vectors(rows: ArrayLike, kind: Any) -> Any:
    """Dr.Jit vectors of type ``kind`` (``mi.Point3f``, ...) of rows [n, dimensions]."""
    return kind(*(on_device(column, dr.value_t(kind)) for column in np.asarray(rows).T))


def quads(float_type: Any) -> Any:
    """The type of four numbers of a float array's type, which gathers and scatters move as one packet."""
    module = sys.modules[float_type.__module__]
    return module.Array4f64 if dr.type_v(float_type) == dr.VarType.Float64 else module.Array4f
