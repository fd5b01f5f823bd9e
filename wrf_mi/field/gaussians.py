"""A set of 3D Gaussians as a receiver needs it: for given transmitters, all attributes as flat arrays."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr


@dataclass
class Gaussians:
    """Gaussians for a batch of transmitters, batch-major: column ``b * n + i`` is Gaussian i for transmitter b.

    Attributes:
        position: three arrays [n], world frame, metres; the same for all transmitters.
        scale: three arrays [batch * n], standard deviations along the Gaussian's own axes, metres.
        rotation: four arrays [batch * n], quaternion x, y, z, w, own axes to world; need not be normalised.
        opacity: array [batch * n], alpha at the footprint's centre, in [0, 1); None under product blending.
        attenuation: complex factor delta (re, im), two arrays [batch * n], |delta| < 1; None under alpha blending.
        signal: complex signal (re, im), two arrays [batch * n]. Signed; nothing clamps it.
        batch: number of transmitters.
    """

    position: list[dr.ArrayBase]
    scale: list[dr.ArrayBase]
    rotation: list[dr.ArrayBase]
    signal: list[dr.ArrayBase]
    opacity: dr.ArrayBase | None
    attenuation: list[dr.ArrayBase] | None
    batch: int

    def __post_init__(self) -> None:
        """One of opacity and attenuation says how the Gaussians are blended."""
        if (self.opacity is None) == (self.attenuation is None):
            raise ValueError("Gaussians need either an opacity (alpha blending) or an attenuation (product blending)")

    @property
    def count(self) -> int:
        """Number of Gaussians for one transmitter."""
        return dr.width(self.position[0])


def rows(tensor: dr.ArrayBase) -> list[dr.ArrayBase]:
    """The rows of a tensor [k, n] as ``k`` flat arrays [n]. Differentiable."""
    return [tensor[i, :].array for i in range(tensor.shape[0])]
