"""Traced paths as chains of surfaces on the device."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..backend.device import columns_on_device
from ..core.angles import FloatArray
from ..core.types import IntArray
from .buffer import SPECULAR, TRANSMISSION
from .field_calculator import Chains, Level
from .surfaces import Surfaces

Float64: Any = dr.float64_array_t(mi.Float)


def chains_of(
    surfaces: Surfaces, types: NDArray[np.uint8], face: IntArray, material: IntArray, sources: Sequence[FloatArray]
) -> Chains:
    """Chains of p paths, float64.

    Args:
        surfaces: surfaces of the scene.
        types: interactions [p, depth], from the transmitter.
        face: faces at which they are [p, depth].
        material: indices of the materials there [p, depth].
        sources: five columns [p]: coordinates of each path's transmitter, cosine and sine of its heading.
    """
    depth = types.shape[1] if types.any() else 0
    types, face = types[:, :depth], face[:, :depth]
    plane, used, index = np.append(surfaces.plane, 0)[face], types != 0, material[:, :depth].astype(np.uint32)
    # All columns of a type by one copy: each copy is a kernel of its own.
    normal, offset = surfaces.normal[plane] * used[..., None], surfaces.offset[plane] * used
    columns = [column for k in range(depth) for column in (*normal[:, k].T, offset[:, k])]
    numbers = columns_on_device([*columns, *sources, np.ones(len(types))], Float64)
    kinds = [types[:, k] == kind for k in range(depth) for kind in (SPECULAR, TRANSMISSION)]
    masks = columns_on_device(kinds, mi.Bool)
    indices = columns_on_device([table[:, k] for k in range(depth) for table in (index, plane)], mi.UInt32)
    levels = [
        Level(numbers[4 * k : 4 * k + 3], numbers[4 * k + 3], *masks[2 * k : 2 * k + 2], *indices[2 * k : 2 * k + 2])
        for k in range(depth)
    ]
    *place, exists = numbers[4 * depth :]
    return Chains(place[:3], tuple(place[3:]), exists, levels)
