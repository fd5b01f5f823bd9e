"""The rigid motion between a scan and the measurements, as shifts and tilts of all planes."""

from __future__ import annotations

import numpy as np

from ..core.angles import FloatArray
from ..core.types import IntArray
from ..tracing.search.surfaces import Surfaces


def rigid_motions(surfaces: Surfaces) -> FloatArray:
    """Derivatives of the planes' shifts [q], then tilts [q, 2] row by row, by a rigid motion of the scene: [3 q, 6].

    The motion x -> x + w x (x - c) + t, with c the mean of the planes' centres, has t in metres in the first three
    columns and the rotation vector w in rad in the last. A plane n . x = d with the centre p and the axes a, b is
    shifted by n . (t + w x (p - c)) and tilted by a . (w x n), b . (w x n), to first order in w.
    """
    centre = surfaces.plane_centres_m
    middle = centre.mean(axis=0) if len(centre) else np.zeros(3)
    normal, axes = surfaces.normal, surfaces.axes
    # n . (w x r) = w . (r x n), a . (w x n) = w . (n x a)
    shift = np.concatenate([normal, np.cross(centre - middle, normal)], axis=1)
    turn = np.cross(normal[:, None], axes)
    tilt = np.concatenate([np.zeros_like(turn), turn], axis=2).reshape(-1, 6)
    return np.concatenate([shift, tilt])


def scene_entries(planes: IntArray, count: int) -> IntArray:
    """Rows of `rigid_motions` of some of ``count`` planes, by their numbers [k]: shifts, then tilts, [3 k]."""
    return np.concatenate([planes, count + (2 * planes[:, None] + np.arange(2)).ravel()])


def rigid_motion(surfaces: Surfaces, change: FloatArray, precision: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The rigid motion that is nearest to shifts and tilts of planes, and its standard deviations, [6] each.

    Args:
        surfaces: surfaces with q planes.
        change: shifts [q] in metres, then tilts [q, 2] in rad row by row.
        precision: inverse variance of each entry [3 q].

    Motions that no plane fixes, such as along a corridor, are 0 with an infinite standard deviation.
    """
    motions = rigid_motions(surfaces)
    information = motions.T @ (precision[:, None] * motions)
    inverse = np.linalg.pinv(information, rcond=1e-9, hermitian=True)
    known = np.diag(information) > 0
    return inverse @ motions.T @ (precision * change), np.where(known, np.sqrt(np.diag(inverse)), np.inf)
