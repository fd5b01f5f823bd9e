"""From NumPy to Dr.Jit, by copy.

On a CPU, Dr.Jit wraps NumPy's memory and gives it back when one of its own threads drops the last use. That
needs Python's lock, which a function that is being recorded holds: the process then hangs or ends. What is
copied here belongs to Dr.Jit alone.
"""

from __future__ import annotations

import gc
from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike


def to_float(values: ArrayLike) -> Any:
    """A flat Dr.Jit float32 array of all values."""
    wrapped = mi.Float(np.ascontiguousarray(values, np.float32).ravel())
    # A gather of all or a sum with zero would be seen through: Dr.Jit then hands out the wrapped array itself.
    own = wrapped * dr.opaque(mi.Float, 1)
    dr.eval(own)
    dr.sync_thread()
    return own


def to_tensor(values: ArrayLike) -> Any:
    """A Dr.Jit float32 tensor of the same shape."""
    return mi.TensorXf(to_float(values), np.shape(values))


class Recorded:
    """A function that Dr.Jit records on its first call and replays from then on (`dr.freeze`).

    Python's garbage collector waits meanwhile: an array that it frees while Dr.Jit records, one that wraps
    NumPy's memory for instance, ends the process.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self._frozen: Any = dr.freeze(function)

    def __call__(self, *arguments: Any) -> Any:
        """Call the function."""
        collecting = gc.isenabled()
        gc.disable()
        try:
            return self._frozen(*arguments)
        finally:
            if collecting:
                gc.enable()

    @property
    def n_recordings(self) -> int:
        """How often the function was recorded."""
        return self._frozen.n_recordings
