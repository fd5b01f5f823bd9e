"""A set of 3D Gaussians as a receiver needs it: for given transmitters, all attributes as flat arrays."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

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
        signal: complex signal (re, im), two arrays [batch * n]. Signed; nothing clamps it. Of a field with several
            signals a Gaussian all real parts, then all imaginary ones, until `by_component` sorts them.
        batch: number of transmitters.

    Where geometry and blending are the same for all transmitters, scale, rotation, opacity and attenuation may have
    one number a Gaussian, [n]: ``shared`` then, and `spread` repeats them.
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

    @property
    def shared(self) -> bool:
        """Whether several transmitters have one set of geometry, opacity or attenuation."""
        return self.batch > 1 and dr.width(self.scale[0]) == self.count

    def spread(self) -> Gaussians:
        """The same with all arrays [batch * n]."""
        if not self.shared:
            return self

        def wide(arrays: list[dr.ArrayBase]) -> list[dr.ArrayBase]:
            return [dr.tile(a, self.batch) for a in arrays]

        return replace(
            self,
            scale=wide(self.scale),
            rotation=wide(self.rotation),
            opacity=None if self.opacity is None else dr.tile(self.opacity, self.batch),
            attenuation=None if self.attenuation is None else wide(self.attenuation),
        )


def rows(tensor: dr.ArrayBase) -> list[dr.ArrayBase]:
    """The rows of a tensor [k, n] as ``k`` flat arrays [n]. Differentiable."""
    return [tensor[i, :].array for i in range(tensor.shape[0])]


def by_component(gaussians: Gaussians, components: int) -> Gaussians:
    """Gaussians with one signal each: those of a transmitter come ``components`` times, a signal at a time.

    Args:
        gaussians: with 2 * ``components`` signals: real parts, then imaginary ones.
        components: how many.

    Returns:
        A batch of ``batch * components``, components of a transmitter one after the other.
    """
    if components == 1:
        return gaussians
    n, batch = gaussians.count, gaussians.batch
    kind: Any = type(gaussians.signal[0])
    slot = dr.arange(dr.uint32_array_t(kind), batch * components * n)
    own, component = (slot // (n * components)) * n + slot % n, (slot // n) % components

    def each(arrays: Any) -> Any:
        return None if arrays is None else [dr.gather(kind, one, own) for one in arrays]

    parts = [dr.concat(gaussians.signal[half * components : (half + 1) * components]) for half in (0, 1)]
    signal = [dr.gather(kind, part, component * (batch * n) + own) for part in parts]
    if dr.width(gaussians.scale[0]) == n:  # one geometry serves all of them
        return replace(gaussians, signal=signal, batch=batch * components)
    opacity = each(None if gaussians.opacity is None else [gaussians.opacity])
    return replace(
        gaussians,
        scale=each(gaussians.scale),
        rotation=each(gaussians.rotation),
        signal=signal,
        opacity=None if opacity is None else opacity[0],
        attenuation=each(gaussians.attenuation),
        batch=batch * components,
    )
