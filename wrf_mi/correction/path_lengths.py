"""Lengths of paths and their derivatives by shifts and tilts of the planes that reflect them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import coo_array, csr_array

from ..core.types import FloatArray, IntArray
from ..tracing.paths.scene_parameters import SHIFT, TILT
from ..tracing.search.images import mirrored

if TYPE_CHECKING:
    from .misfit import Misfit


def lengths_and_slopes(misfit: Misfit, mirrors: IntArray, vector: FloatArray) -> tuple[FloatArray, csr_array]:
    """Lengths [n] of paths that planes ``mirrors`` [n, depth] reflect (-1: none), and slopes by planes [n, 3 q]."""
    surfaces, chosen, count = misfit.traced_fields[0].surfaces, misfit.planes, len(misfit.planes)
    axes, centre = surfaces.axes[chosen], surfaces.plane_centres_m[chosen]
    shift, tilt = (vector[misfit.slices[name]] for name in (SHIFT, TILT))
    normal, offset = surfaces.moved_planes(shift, tilt.reshape(count, 2), chosen)
    sources = [np.stack([np.asarray(c) for c in field.chains.source_m], axis=-1) for field in misfit.traced_fields]
    first = np.cumsum([0, *map(len, sources[:-1])])
    point = np.concatenate(sources)[first[misfit.paths.port] + misfit.paths.entry]
    image = np.array([field.receiver.position_m for field in misfit.traced_fields], float)[misfit.paths.port]
    # Image method (Balanis 2012, section 7.4): the receiver mirrored in the planes, from its end of the chain.
    for at in mirrors.T[::-1]:
        row = np.flatnonzero(at >= 0)
        image[row] = mirrored(image[row], normal[at[row]], offset[at[row]])
    length = np.linalg.norm(image - point, axis=1)
    # Along the path, point by point: a displacement e of the plane along its normal lengthens it by 2 e (u . n).
    way, none = (image - point) / length[:, None], np.zeros(0, np.int64)
    slopes = [(none, none, np.zeros(0))]  # sparse: a path meets few planes
    for at in mirrors.T:
        row = np.flatnonzero(at >= 0)
        q, n = at[row], normal[at[row]]
        along = (way[row] * n).sum(axis=1)
        point[row] += way[row] * ((offset[q] - (point[row] * n).sum(axis=1)) / along)[:, None]
        flat = np.einsum("nad,nd->na", axes[q], point[row] - centre[q])
        slopes.append((row, q, 2 * along))
        slopes += [(row, count + 2 * q + axis, -2 * along * flat[:, axis]) for axis in range(2)]
        way[row] = mirrored(way[row], n)
    rows, columns, values = (np.concatenate(each) for each in zip(*slopes, strict=True))
    # Slopes of a plane that reflects a path twice are added.
    return length, coo_array((values, (rows, columns)), (len(point), 3 * count)).tocsr()
