"""Copies of NumPy arrays in memory that Dr.Jit owns, and functions that it records.

On a CPU, Dr.Jit 1.5 wraps NumPy's memory, with three defects. Kernels read whole packets of 8 or 16 numbers, beyond the
end of an array whose size is not a multiple: on an unmapped page the process ends. A thread of Dr.Jit that drops the
last use frees the memory, which needs Python's lock: while a function is recorded the process hangs or ends. And
kernels depend on the alignment of memory, so that another process compiles them again.
"""

from __future__ import annotations

import gc
import sys
from collections.abc import Callable, Iterable
from operator import and_, mul
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike, NDArray

PACKET = 64  # readable numbers after the end of an array that Dr.Jit wraps: no packet of LLVM is longer
ALIGNED_BYTES = 64  # packets begin at multiples of their size: Dr.Jit copies unaligned columns by other kernels
HOST: dict[Any, type[np.generic]] = {
    dr.VarType.Float32: np.float32,
    dr.VarType.Float64: np.float64,
    dr.VarType.Int32: np.int32,
    dr.VarType.UInt32: np.uint32,
    dr.VarType.Bool: np.bool_,
}


def release_memory() -> None:
    """Give the memory of arrays that nothing uses any more back to the system; Dr.Jit keeps it for further arrays."""
    # After a fit that is most of what the process has, and what follows allocates by NumPy.
    gc.collect()  # recorded functions refer to what records them
    dr.flush_malloc_cache()


def on_device(values: ArrayLike, kind: Any) -> Any:
    """All values as a flat, evaluated array of type ``kind``: floats, integers of 32 bits or a mask."""
    return columns_on_device([np.ravel(values)], kind)[0]


def columns_on_device(columns: Iterable[ArrayLike], kind: Any) -> list[Any]:
    """The arrays of `on_device` of several columns, copied by one kernel if they have the same length."""
    wrapped = [kind(with_room(column, HOST[dr.type_v(kind)])) for column in columns]
    # Dr.Jit removes a gather of all values or a sum with zero, and would return the wrapped array.
    neutral, join = (dr.opaque(kind, True), and_) if dr.is_mask_v(kind) else (dr.opaque(kind, 1), mul)
    copies = [join(array, neutral) if dr.width(array) else array for array in wrapped]
    dr.eval(copies)
    dr.sync_thread()
    return copies


def with_room(values: ArrayLike, kind: type[np.generic]) -> NDArray[Any]:
    """A flat copy of all values, with room for the rest of a packet after its end, at the start of a cache line."""
    source, size = np.asarray(values), np.dtype(kind).itemsize
    memory = np.zeros((source.size + PACKET) * size + ALIGNED_BYTES, np.uint8)
    first = -memory.ctypes.data % ALIGNED_BYTES
    room: NDArray[Any] = memory[first : first + source.size * size].view(kind)
    np.copyto(room.reshape(source.shape), source, casting="unsafe")
    return room


def to_float(values: ArrayLike) -> Any:
    """A flat Dr.Jit float32 array of all values."""
    return on_device(values, mi.Float)


def to_uint(values: ArrayLike) -> Any:
    """A flat Dr.Jit array of all values, integers from 0."""
    return on_device(values, mi.UInt32)


def to_tensor(values: ArrayLike, kind: Any = None) -> Any:
    """A Dr.Jit tensor of the same shape, float32 or of another type of arrays ``kind``."""
    kind = kind or mi.Float
    tensor: Any = dr.tensor_t(kind)
    return tensor(on_device(values, kind), np.shape(values))


def to_vectors(rows: ArrayLike, kind: Any) -> Any:
    """Dr.Jit vectors of type ``kind`` (``mi.Point3f``, ...) of rows [n, dimensions]."""
    return kind(*columns_on_device(np.asarray(rows).T, dr.value_t(kind)))


def quads(float_type: Any) -> Any:
    """The type of four numbers of a float array's type, which gathers and scatters move as one packet."""
    module = sys.modules[float_type.__module__]
    return module.Array4f64 if dr.type_v(float_type) == dr.VarType.Float64 else module.Array4f


class Recorded:
    """A function that Dr.Jit records on its first call and replays from then on (`dr.freeze`).

    Python's garbage collector is off meanwhile: freeing an array while Dr.Jit records, such as one that wraps NumPy's
    memory, ends the process. A recording has room for the sums of the threads at that time, and more threads write
    beyond it (Dr.Jit 1.5): with more threads the function is recorded anew.

    Args:
        function: function to record.
        state: returns arrays that the function reads beside its arguments, called before each call; None: no arrays.
    """

    def __init__(self, function: Callable[..., Any], state: Callable[[], Any] | None = None) -> None:
        self.frozen: Any = dr.freeze(function, state_fn=None if state is None else lambda *_: state())
        self._threads = 0

    def __call__(self, *arguments: Any) -> Any:
        """Call the function."""
        collecting = gc.isenabled()
        gc.disable()
        try:
            threads = dr.thread_count()
            if threads > self._threads:
                self.frozen.clear()
                self._threads = threads
            return self.frozen(*arguments)
        finally:
            if collecting:
                gc.enable()
