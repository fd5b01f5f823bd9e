"""Functions of a batch of transmitters that Dr.Jit records once and replays for others."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..backend.device import to_float, to_tensor
from ..backend.recorded import Recorded
from ..core.angles import FloatArray
from ..graph.graph import Batch
from .step import Params, Place, evaluated

OfBatch = Callable[[Mapping[str, Any], Batch], tuple[Any, ...]]
"""``function(params, batch)``: arrays with as many numbers for each transmitter of the batch."""


class Recordings:
    """Recorded functions by name, valid for one number of Gaussians.

    The number of transmitters is a constant of the recorded kernels: each size is a recording of its own, and copies of
    the last transmitter fill a batch. Networks are not evaluated in chunks, and lists of tiles, which a recorded
    function cannot count, have room for all: neither is for very many Gaussians.
    """

    def __init__(self) -> None:
        self._recorded: dict[tuple[Any, int], Recorded] = {}

    def __call__(
        self,
        name: Any,
        size: int,
        function: OfBatch,
        params: Params,
        condition: FloatArray,
        place: Place,
        weight: NDArray[Any] | None = None,
        state: Callable[[], Any] | None = None,
    ) -> tuple[Any, ...]:
        """Evaluate the function of a name without gradients, recorded at its first call.

        Args:
            name: name of the function, hashable.
            size: number of transmitters of the recording.
            function: the function.
            params: its parameters.
            condition: positions or features of transmitters [k, m], m at most ``size``.
            place: port.
            weight: `Batch.weight` [m].
            state: returns the arrays that the function reads beside its arguments; None: no arrays.

        Returns:
            Arrays of the m transmitters.
        """
        if (name, size) not in self._recorded:

            def recordable(params: Params, batch: Batch) -> tuple[Any, ...]:
                with dr.suspend_grad():
                    return function(params, batch)

            # Arrays that are made from NumPy's memory at first use must exist before a recording.
            evaluated(function, params, condition[:, :1], place)
            self._recorded[name, size] = Recorded(recordable, state)
        count = condition.shape[1]
        filled = np.minimum(np.arange(size), count - 1)
        tx, slots = to_tensor(np.ascontiguousarray(condition[:, filled])), dr.zeros(mi.UInt32, size)
        dr.make_opaque(slots)
        weights = None if weight is None else to_float(weight[filled])
        arrays: tuple[Any, ...] = self._recorded[name, size](params, place.batch(tx, slots, weights))
        if count == size:
            return arrays
        return tuple(dr.gather(type(one), one, dr.arange(mi.UInt32, count * (dr.width(one) // size))) for one in arrays)
