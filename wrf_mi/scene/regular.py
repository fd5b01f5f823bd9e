"""Right angles, verticals and level planes, where the points allow them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..core.angles import FloatArray
from .planes import Plane

LEAST_TOLERANCE_RAD = np.radians(0.3)
"""What a levelled scanner and its registration leave."""
MOST_TOLERANCE_RAD = np.radians(4.0)
ERRORS = 3.0
"""Standard errors that a right angle may be off."""


def regular(planes: Sequence[Plane], noise_m: float) -> list[Plane]:
    """Planes turned to be level, upright, and parallel or square to larger ones, each about its centre.

    A plane is turned only within what its points cannot tell: three standard errors of its direction, or one
    standard deviation of the noise over its shorter side (edges and neighbours shift a fit by that much). A real
    slope stays.

    Args:
        planes: the most certain first; later ones follow earlier ones.
        noise_m: standard deviation of the points.
    """
    up = np.array([0.0, 0.0, 1.0])
    headings: list[FloatArray] = []
    turned = []
    for plane in planes:
        tolerance = _tolerance(plane, noise_m)
        n = plane.normal
        if np.arccos(min(abs(n @ up), 1.0)) < tolerance:
            n = up * np.sign(n @ up)
        elif np.arcsin(min(abs(n @ up), 1.0)) < tolerance:
            n = _unit(n - up * (n @ up))
            for heading in headings:
                pair = np.stack([heading, np.cross(up, heading)])
                best = pair[np.argmax(np.abs(pair @ n))]
                if np.arccos(min(abs(best @ n), 1.0)) < tolerance:
                    n = best * np.sign(best @ n)
                    break
            else:
                headings.append(n)
        turned.append(replace(plane, normal=n, offset_m=float(n @ plane.centre_m)))
    return turned


def main_heading(planes: Sequence[Plane]) -> FloatArray:
    """Horizontal unit vector [3] across the most certain upright plane, x where there is none."""
    for plane in planes:
        if abs(plane.normal[2]) < 1e-6:
            return plane.normal
    return np.array([1.0, 0.0, 0.0])


def _tolerance(plane: Plane, noise_m: float) -> float:
    flat = plane.flat(plane.patches_m.reshape(-1, 3))
    side = np.ptp(flat, axis=0).min()
    error = max(ERRORS * plane.angle_error_rad, noise_m / max(side, noise_m), LEAST_TOLERANCE_RAD)
    return float(min(error, MOST_TOLERANCE_RAD))


def _unit(vector: FloatArray) -> FloatArray:
    return vector / np.linalg.norm(vector)
