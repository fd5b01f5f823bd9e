"""The paper's fields with several complex signals a Gaussian, and with any features in the transmitter's place.

Both are what its second case study asks for: the uplink channel takes the place of the transmitter's position, and
what comes out is a complex number for each subcarrier.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import numpy as np

from ..field import Encoding, Gaussians, InitialGaussians, WrfGs, WrfGsPlus
from ..field.network import Weights, init_layer


@dataclass(frozen=True)
class FeatureEncoding(Encoding):
    """Features that are given take the place of the encoded transmitter.

    Attributes:
        features: how many.
    """

    features: int = 1

    def transmitter(self, points: dr.ArrayBase) -> dr.ArrayBase:
        """The features [features, batch] themselves."""
        return points

    @property
    def sizes(self) -> dict[str, int]:
        """Number of features of each part."""
        return super().sizes | {"transmitter": self.features}


@dataclass(frozen=True)
class BandWrfGs(WrfGs):
    """WRF-GS whose Gaussians have ``components`` complex signals each: real parts, then imaginary ones."""

    components: int = 1

    def init(self, initial: InitialGaussians, rng: np.random.Generator) -> Weights:
        """See `WrfGs.init`."""
        weights = super().init(initial, rng)
        inputs = {"hidden": self.signal_widths[1]}
        return weights | init_layer("signal.out", inputs, 2 * self.components, rng, gain=initial.signal)


@dataclass(frozen=True)
class BandWrfGsPlus(WrfGsPlus):
    """WRF-GS+ whose Gaussians have ``components`` complex signals each: real parts, then imaginary ones."""

    components: int = 1

    @property
    def heads(self) -> tuple[tuple[str, int, float], ...]:
        """Name, size and starting gain of each head."""
        return tuple((name, size * self.components if name == "signal" else size, g) for name, size, g in super().heads)

    def init(self, initial: InitialGaussians, rng: np.random.Generator) -> Weights:
        """See `WrfGsPlus.init`."""
        weights = super().init(initial, rng)
        weights["signal"] = np.concatenate([initial.static_signal(rng) for _ in range(self.components)])
        return weights


BAND_FIELDS: dict[str, Any] = {"wrf-gs": BandWrfGs, "wrf-gs+": BandWrfGsPlus}
"""By the name of the paper's model."""


def spread(gaussians: Gaussians, components: int) -> Gaussians:
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
