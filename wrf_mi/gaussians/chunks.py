"""Gaussians of a field in chunks: a network keeps some numbers of every layer for each Gaussian and transmitter.

Those of WRF-GS+ are some kilobytes per pair. In chunks, memory grows only with the Gaussians themselves. Without
gradients, which need all layers of all chunks.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import drjit as dr
import numpy as np

from ..backend.device import on_device
from .parameters import Gaussians, each

CHUNK_SIZE = 1 << 14
"""Pairs of Gaussian and transmitter at once: 64 MB of a network of width 256."""


def gaussians_in_parts(field: Any, params: Mapping[str, Any], tx_pos: Any, at_once: int = CHUNK_SIZE) -> Gaussians:
    """The evaluated result of ``field.gaussians(params, tx_pos)``, without gradients.

    Args:
        field: any of `wrf_mi.gaussians.FIELDS`: no Gaussian depends on another.
        params: parameters of the field.
        tx_pos: transmitter positions [3, batch], metres.
        at_once: approximate number of pairs of Gaussian and transmitter at once.
    """
    count, batch = params["position"].shape[1], tx_pos.shape[1]
    step = max(at_once // batch, 1)
    parts: list[Gaussians] = []
    with dr.suspend_grad():
        for first in range(0, max(count, 1), step):
            chunk = slice(first, min(first + step, count))
            values = {name: value[:, chunk] if name in field.per_gaussian else value for name, value in params.items()}
            parts.append(field.gaussians(values, tx_pos))
            dr.eval(vars(parts[-1]))
        if len(parts) == 1:
            return parts[0]
        # Concatenated the parts are [part, transmitter, Gaussian]; the result is [transmitter, Gaussian].
        sizes = [part.count for part in parts]
        begin = batch * np.cumsum([0, *sizes[:-1]])
        slots = [a + np.arange(batch * n).reshape(batch, n) for a, n in zip(begin, sizes, strict=True)]
        order = on_device(np.concatenate(slots, axis=1), dr.uint32_array_t(type(parts[0].position[0])))

        def joined(*arrays: Any) -> Any:
            whole = dr.concat(list(arrays))
            return whole if dr.width(whole) == count else dr.gather(type(whole), whole, order)

        names = [f.name for f in fields(Gaussians) if f.name != "batch"]
        result = Gaussians(**{n: each(joined, *(getattr(part, n) for part in parts)) for n in names}, batch=batch)
        dr.eval(vars(result))
    return result
