"""Change of an image on removal of one Gaussian, for all of them at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .footprint import Pose
from .operator import pixel_weights
from .parameters import Gaussians
from .recurrence import SMALLEST_FACTOR
from .tiles import Plane


def removal(gaussians: Gaussians, pose: Pose, plane: Plane) -> NDArray[np.float64]:
    """Sum over the plane's pixels of |change of R| on removal of one Gaussian, [n].

    In the terms of `wrf_mi.gaussians.recurrence`: removal of Gaussian i takes away w_i T_i S_i, and scales the sum Q_i
    behind it, which it hides, by 1 / b_i. With the weights B_i = w_i T_i of `pixel_weights`, the transmittance is
    T_i = 1 - sum_{k < i} B_k (alpha blending) or 1 - sum_{k < i} B_k (1 - delta_k) (product blending).

    Args:
        gaussians: Gaussians for one transmitter (batch 1).
        pose: pose of the receiver.
        plane: the receiver's perception plane.
    """
    weights = pixel_weights(gaussians, pose, plane)
    seen, start, length = weights.indices, weights.indptr[:-1], np.diff(weights.indptr)
    delta = [np.array(part, float) for part in gaussians.attenuation or (np.zeros(gaussians.count),) * 2]
    re, im = (np.array(part, float) for part in gaussians.signal)
    sent, hidden = (weights.data * values[seen] for values in (re + 1j * im, 1 - delta[0] - 1j * delta[1]))

    def before(values: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """Sum over the entries before each in its pixel."""
        total = np.concatenate([[0], np.cumsum(values)])
        return total[:-1] - np.repeat(total[start], length)

    transmittance = 1 - before(hidden)
    hides = np.divide(hidden, transmittance, out=np.zeros_like(hidden), where=transmittance != 0)
    factor = 1 - hides
    behind = np.repeat(weights @ (re + 1j * im), length) - before(sent) - sent
    quotient = behind * np.conj(factor) / np.maximum(np.abs(factor), SMALLEST_FACTOR) ** 2
    return np.asarray(np.bincount(seen, np.abs(sent - hides * quotient), gaussians.count), float)
