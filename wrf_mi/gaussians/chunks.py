"""A field's Gaussians part by part: a network keeps some numbers of every layer for each Gaussian and transmitter.

Those of WRF-GS+ are 4 kB for each pair. In parts, memory grows with the Gaussians themselves alone. Without gradients,
which need all layers of all parts.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import drjit as dr
import numpy as np

from ..backend.device import on_device
from .parameters import Gaussians

CHUNK_SIZE = 1 << 14
"""Pairs of Gaussian and transmitter at once: 64 MB of a network of width 256."""


class _Field(Protocol):
    @property
    def per_gaussian(self) -> tuple[str, ...]:
        """Names of the parameters that each Gaussian has of its own."""
        ...

    def gaussians(self, params: Mapping[str, Any], tx_pos: Any) -> Gaussians:
        """Gaussians for transmitter positions [3, batch] in metres."""
        ...


def gaussians_in_parts(field: _Field, params: Mapping[str, Any], tx_pos: Any, at_once: int = CHUNK_SIZE) -> Gaussians:
    """What ``field.gaussians(params, tx_pos)`` gives, evaluated, without gradients.

    Args:
        field: any of `wrf_mi.gaussians.FIELDS`: what a Gaussian is depends on no other.
        params: its parameters.
        tx_pos: transmitter positions [3, batch], metres.
        at_once: pairs of Gaussian and transmitter at once, about.
    """
    count, batch = params["position"].shape[1], tx_pos.shape[1]
    step = max(at_once // batch, 1)
    parts, sizes = [], []
    with dr.suspend_grad():
        for first in range(0, max(count, 1), step):
            last = min(first + step, count)
            own = {name: params[name][:, first:last] if name in field.per_gaussian else params[name] for name in params}
            part = field.gaussians(own, tx_pos)
            dr.eval(vars(part))
            parts.append(part)
            sizes.append(last - first)
        if len(parts) == 1:
            return parts[0]
        index_type: Any = dr.uint32_array_t(type(parts[0].position[0]))
        # Behind each other the parts are [part, transmitter, Gaussian]; wanted is [transmitter, Gaussian].
        begin = np.cumsum([0, *sizes[:-1]])
        place = np.concatenate(
            [batch * a + np.arange(batch * n).reshape(batch, n) for a, n in zip(begin, sizes, strict=True)], axis=1
        )
        order = on_device(place, index_type)

        def joined(*arrays: Any) -> Any:
            whole = dr.concat(list(arrays))
            return whole if dr.width(whole) == count else dr.gather(type(whole), whole, order)

        def of(name: str) -> Any:
            values = [getattr(part, name) for part in parts]
            if values[0] is None:
                return None
            if isinstance(values[0], list):
                return [joined(*column) for column in zip(*values, strict=True)]
            return joined(*values)

        names = ("position", "scale", "rotation", "signal", "opacity", "attenuation")
        result = Gaussians(**{name: of(name) for name in names}, batch=batch)
        dr.eval(vars(result))
    return result
