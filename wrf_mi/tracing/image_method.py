"""Image method in float64: sources mirrored at planes, and where the straight line to an image meets its plane.

Planes are n . x = d with unit normals n. `wrf_mi.tracing.field_calculator` evaluates chains of planes with derivatives
in Dr.Jit.

Source: Balanis, "Advanced Engineering Electromagnetics" (2012), section 7.4.
"""

from __future__ import annotations

import numpy as np

from ..core.angles import FloatArray
from ..core.types import IntArray


def mirrored(vectors: FloatArray, normal: FloatArray, offset_m: FloatArray | float = 0.0) -> FloatArray:
    """Points [n, 3] mirrored in planes of normals [n, 3] or [3] and offsets [n]; directions with an offset of 0."""
    height = (vectors * normal).sum(axis=-1) - offset_m
    return vectors - 2 * height[:, None] * normal


def image_sources(normal: FloatArray, offset_m: FloatArray, plane: IntArray, source_m: FloatArray) -> FloatArray:
    """Images of a source after 0, 1, ... reflections, [c, b + 1, 3], metres.

    Args:
        normal: of the scene's planes [q, 3].
        offset_m: of these [q].
        plane: planes of each chain in their order from the source [c, b], -1 where nothing reflects.
        source_m: shape [3], or one of each chain [c, 3].
    """
    image = np.repeat(np.broadcast_to(source_m, (len(plane), 3))[:, None], plane.shape[1] + 1, axis=1)
    for level in range(plane.shape[1]):
        image[:, level + 1] = image[:, level]
        row = np.flatnonzero(plane[:, level] >= 0)
        own = plane[row, level]
        image[row, level + 1] = mirrored(image[row, level], normal[own], offset_m[own])
    return image


def meeting_point(
    start_m: FloatArray, end_m: FloatArray, normal: FloatArray, offset_m: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Where lines through two points meet planes, [n, 3], and the points' heights above these, [n] each.

    The first point stands where a line is parallel to its plane. Arguments: [n, 3] each, offsets [n].
    """
    near, far = ((point * normal).sum(axis=1) - offset_m for point in (start_m, end_m))
    share = np.divide(near, near - far, out=np.zeros_like(near), where=near != far)
    return start_m + (end_m - start_m) * share[:, None], near, far
