"""Image method in float64: images of sources at planes, and points of reflection.

Planes are n . x = d with unit normals n. `wrf_mi.tracing.field_calculator` is the differentiable version in Dr.Jit.

Source: Balanis, "Advanced Engineering Electromagnetics" (2012), section 7.4.
"""

from __future__ import annotations

import numpy as np

from ..core.angles import FloatArray
from ..core.types import IntArray


def mirrored(vectors: FloatArray, normal: FloatArray, offset_m: FloatArray | float = 0.0) -> FloatArray:
    """Mirror points [n, 3] in planes of normals [n, 3] or [3] and offsets [n]; directions with an offset of 0."""
    height = (vectors * normal).sum(axis=-1) - offset_m
    return vectors - 2 * height[:, None] * normal


def image_sources(normal: FloatArray, offset_m: FloatArray, plane: IntArray, source_m: FloatArray) -> FloatArray:
    """Images of a source after 0, 1, ... reflections, [c, b + 1, 3], metres.

    Args:
        normal: unit normals of the scene's planes [q, 3].
        offset_m: offsets of the planes [q], metres.
        plane: planes of each chain in their order from the source [c, b], -1 for none.
        source_m: source [3], or the source of each chain [c, 3], metres.
    """
    image = np.repeat(np.broadcast_to(source_m, (len(plane), 3))[:, None], plane.shape[1] + 1, axis=1)
    for level in range(plane.shape[1]):
        image[:, level + 1] = image[:, level]
        row = np.flatnonzero(plane[:, level] >= 0)
        mirror = plane[row, level]
        image[row, level + 1] = mirrored(image[row, level], normal[mirror], offset_m[mirror])
    return image


def meeting_point(
    start_m: FloatArray, end_m: FloatArray, normal: FloatArray, offset_m: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Points where lines through two points meet planes.

    Args:
        start_m: first points [n, 3], metres.
        end_m: second points [n, 3], metres.
        normal: unit normals of the planes [n, 3].
        offset_m: offsets of the planes [n], metres.

    Returns:
        The points [n, 3], which are the first points where a line is parallel to its plane; heights of the first and
        of the second points above the planes [n], metres.
    """
    near, far = ((point * normal).sum(axis=1) - offset_m for point in (start_m, end_m))
    share = np.divide(near, near - far, out=np.zeros_like(near), where=near != far)
    return start_m + (end_m - start_m) * share[:, None], near, far
