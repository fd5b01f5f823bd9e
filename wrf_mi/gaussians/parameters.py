"""A set of 3D Gaussians as a receiver needs it: for given transmitters, all attributes as flat arrays."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import drjit as dr
import numpy as np

from ..backend.device import on_device

PER_PAIR = ("scale", "rotation", "opacity", "attenuation")  # transmitters may differ in them


@dataclass
class Gaussians:
    """Gaussians for a batch of transmitters, batch-major: column ``b * n + i`` is Gaussian i for transmitter b.

    Attributes:
        position: three arrays [n], world frame, metres; common to all transmitters.
        scale: three arrays [batch * n], standard deviations along the Gaussian's axes, metres.
        rotation: four arrays [batch * n], quaternion x, y, z, w, Gaussian's axes to world; need not be normalised.
        opacity: array [batch * n], alpha at the footprint's centre, in [0, 1); None under product blending.
        attenuation: complex factor delta (re, im), two arrays [batch * n], |delta| < 1; None under alpha blending.
        signal: complex signal (re, im), two arrays [batch * n]. Signed; nothing clamps it. Of a field with several
            signals per Gaussian all real parts, then all imaginary ones, until `by_component` sorts them.
        batch: number of transmitters.

    Where geometry and blending do not depend on the transmitter, scale, rotation, opacity and attenuation may have
    width n: ``shared`` then, and `spread` repeats them.

    Raises:
        ValueError: neither or both of opacity and attenuation.
    """

    position: list[dr.ArrayBase]
    scale: list[dr.ArrayBase]
    rotation: list[dr.ArrayBase]
    signal: list[dr.ArrayBase]
    opacity: dr.ArrayBase | None
    attenuation: list[dr.ArrayBase] | None
    batch: int

    def __post_init__(self) -> None:
        if (self.opacity is None) == (self.attenuation is None):
            raise ValueError("Gaussians need either an opacity (alpha blending) or an attenuation (product blending)")

    @property
    def count(self) -> int:
        """Number of Gaussians for one transmitter."""
        return dr.width(self.position[0])

    @property
    def blending(self) -> list[Any]:
        """Parameters of the blending rule: [opacity], or real and imaginary part of the attenuation."""
        alpha: Any = self.opacity
        return list(self.attenuation or [alpha])

    @property
    def shared(self) -> bool:
        """Whether several transmitters have one set of geometry, opacity or attenuation."""
        return self.batch > 1 and dr.width(self.scale[0]) == self.count

    def spread(self) -> Gaussians:
        """The Gaussians with all arrays [batch * n]."""
        return self.mapped(lambda a: dr.tile(a, self.batch)) if self.shared else self

    def mapped(self, function: Callable[[Any], Any], **changes: Any) -> Gaussians:
        """A function applied to each array of the attributes `PER_PAIR`, and other attributes replaced."""
        return replace(self, **{name: each(function, getattr(self, name)) for name in PER_PAIR}, **changes)


def each(function: Callable[..., Any], *values: Any) -> Any:
    """A function of arrays applied to arrays, lists of arrays (element by element) or None."""
    if values[0] is None:
        return None
    return [function(*a) for a in zip(*values, strict=True)] if isinstance(values[0], list) else function(*values)


def rows(tensor: dr.ArrayBase) -> list[dr.ArrayBase]:
    """The rows of a tensor [k, n] as ``k`` flat arrays [n]. Differentiable."""
    return [tensor[i, :].array for i in range(tensor.shape[0])]


def scheduled(params: Mapping[str, Any]) -> None:
    """Have the next evaluation store a field's parameters."""
    # Parameters that a plain loop computes from those before, as p - rate * gradient, and never evaluates would carry
    # the operations of all steps so far: each step would compile a longer kernel.
    dr.schedule(dict(params))


def common_geometry(params: Mapping[str, Any]) -> dict[str, list[Any]]:
    """Position, scale and rotation of Gaussians from a field's parameters, common to all transmitters."""
    return {
        "position": rows(params["position"]),
        "scale": [dr.exp(s) for s in rows(params["log_scale"])],
        "rotation": rows(params["rotation"]),
    }


def logistic(logit: Any) -> Any:
    """Logistic function."""
    return dr.rcp(1 + dr.exp(-logit))


def by_component(gaussians: Gaussians, components: int) -> Gaussians:
    """Gaussians with one signal each: those of a transmitter come ``components`` times, a signal at a time.

    Gaussians with 2 * ``components`` signals, real parts, then imaginary ones, become a batch of ``batch *
    components``, components of a transmitter one after the other.
    """
    if components == 1:
        return gaussians
    n, batch = gaussians.count, gaussians.batch
    kind: Any = type(gaussians.signal[0])
    slot = dr.arange(dr.uint32_array_t(kind), batch * components * n)
    pair, component = (slot // (n * components)) * n + slot % n, (slot // n) % components
    # Signals of a half, real or imaginary, one component after the other: [component, transmitter, Gaussian].
    parts = [dr.concat(gaussians.signal[half * components : (half + 1) * components]) for half in (0, 1)]
    signal = [dr.gather(kind, part, component * (batch * n) + pair) for part in parts]
    changes: dict[str, Any] = {"signal": signal, "batch": batch * components}
    if dr.width(gaussians.scale[0]) == n:  # one geometry serves all of them
        return replace(gaussians, **changes)
    return gaussians.mapped(lambda a: dr.gather(kind, a, pair), **changes)


CHUNK_SIZE = 1 << 14  # pairs of Gaussian and transmitter at once: 64 MB of a network of width 256


def gaussians_in_parts(field: Any, params: Mapping[str, Any], tx_pos: Any, at_once: int = CHUNK_SIZE) -> Gaussians:
    """The evaluated result of ``field.gaussians(params, tx_pos)`` in chunks, without gradients, which need all layers.

    A network keeps some numbers of every layer for each Gaussian and transmitter, kilobytes in WRF-GS+: in chunks of
    about ``at_once`` pairs memory grows only with the Gaussians themselves. Of `wrf_mi.gaussians.FIELDS` none has
    Gaussians that depend on another.
    """
    count, batch = params["position"].shape[1], tx_pos.shape[1]
    step = max(at_once // batch, 1)
    # An empty field still needs one call, for the types and shapes of its arrays.
    parts: list[Gaussians] = []
    with dr.suspend_grad():
        for first in range(0, max(count, 1), step):
            chunk = slice(first, min(first + step, count))
            values = {name: value[:, chunk] if name in field.per_gaussian else value for name, value in params.items()}
            parts.append(field.gaussians(values, tx_pos))
            dr.eval(vars(parts[-1]))
        return parts[0] if len(parts) == 1 else _joined(parts, count)


def _joined(parts: Sequence[Gaussians], count: int) -> Gaussians:
    # Concatenated the parts are [part, transmitter, Gaussian]; the result is [transmitter, Gaussian].
    sizes, batch = [part.count for part in parts], parts[0].batch
    begin = batch * np.cumsum([0, *sizes[:-1]])
    slots = [a + np.arange(batch * n).reshape(batch, n) for a, n in zip(begin, sizes, strict=True)]
    order = on_device(np.concatenate(slots, axis=1), dr.uint32_array_t(type(parts[0].position[0])))

    def joined(*arrays: Any) -> Any:
        joint = dr.concat(list(arrays))
        return joint if dr.width(joint) == count else dr.gather(type(joint), joint, order)

    names = [f.name for f in fields(Gaussians) if f.name != "batch"]
    result = Gaussians(**{n: each(joined, *(getattr(part, n) for part in parts)) for n in names}, batch=batch)
    dr.eval(vars(result))
    return result
