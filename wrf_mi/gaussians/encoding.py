"""Positional encoding of coordinates (WRF-GS+ paper, section V-A, after NeRF).

    gamma(t) = (sin(2^0 pi t), cos(2^0 pi t), ..., sin(2^L pi t), cos(2^L pi t)),   L + 1 octaves

The paper sets L = 9, ten octaves, and does not say on what scale of coordinates. Here ``t`` is the
coordinate in metres divided by ``scale_m``, so the shortest period is ``2 * scale_m / 2^L``: 4 mm for L = 9
and one metre. A field changes over about half a wavelength, which for 915 MHz is 0.16 m: shorter periods
let a network memorise its training positions, which is why fewer octaves predict better (see `docs/model.md`).
The longest period is ``2 * scale_m``: transmitters at that distance along an axis have equal features.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike


def unambiguous_scale(points_m: ArrayLike, least_m: float) -> float:
    """Scale in metres, ``least_m`` or more, at which points [n, 3] have different encodings: none is a period apart."""
    extent = float(np.ptp(np.asarray(points_m, float), axis=0).max(initial=0.0))
    scale = least_m
    while 2 * scale <= extent < np.inf:
        scale *= 2
    return scale


def encoded_size(octaves: int) -> int:
    """Number of features that `encode` makes of one 3D point."""
    return 6 * octaves


def encode(points: Any, octaves: int, scale_m: float) -> Any:
    """Positional encoding of points [3, n] in metres, NumPy's or tensors. Differentiable.

    Returns [6 * octaves, n]: all sines, then all cosines; octave by octave, x, y, z in each.
    """
    host = isinstance(points, np.ndarray)
    if octaves == 0:
        return points[:0] if host else dr.zeros(type(points), (0, points.shape[1]))
    # Whole periods are subtracted in each octave before the sine: exact, because the factors are
    # powers of two, and sin() in float32 loses digits of large arguments.
    octave = [points * (2.0**k / (2.0 * scale_m)) for k in range(octaves)]
    if host:
        phase = np.concatenate([t - np.rint(t) for t in octave]) * np.float32(2 * np.pi)
        return np.concatenate([np.sin(phase), np.cos(phase)])
    turns = dr.concat([t - dr.round(dr.detach(t)) for t in octave], axis=0)
    sine, cosine = dr.sincos(2 * dr.pi * turns)
    return dr.concat([sine, cosine], axis=0)
