"""Small operations on Dr.Jit tensors that the networks of this package share."""

from __future__ import annotations

from typing import Any

import drjit as dr


def columns(x: Any, picked: Any) -> Any:
    """Columns of a tensor [size, n] by index, [size, batch]."""
    size, n = x.shape
    batch = dr.width(picked)
    index_type = type(picked)
    slot = dr.arange(index_type, size * batch)
    index = (slot // batch) * n + dr.gather(index_type, picked, slot % batch)
    return type(x)(dr.gather(type(x.array), x.array, index), (size, batch))
