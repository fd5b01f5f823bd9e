"""R2F2: the downlink from path parameters that an optimisation finds in the uplink.

Source: Vasisht, Kumar, Rahul and Katabi, "Eliminating channel feedback in next-generation cellular networks" (SIGCOMM
2016), sections 4 and 5: a channel is a sum over few paths, each of a length, a direction and a complex gain; the paths
that fit the uplink best over all antennas and subcarriers, added one by one from peaks of a matched filter and refined
by non-linear least squares, are evaluated at the downlink's frequencies.

Left open or other than there:

- They move to the domain of angles by a windowed Fourier transform over a uniform line of antennas, where a path is a
  sinc. Here the paths are fitted to antennas and subcarriers themselves: the same least squares (that transform is
  unitary), but for any array.
- Wave fronts: see `wrf_mi.models.uplink.cross_band`.
- Number of paths: theirs ends at a threshold of the residual set by hand; here the Bayesian information criterion
  decides, so that any noise level will do, up to ``max_paths``.
- The solver: theirs is an interior-point method with numeric derivatives; here Levenberg and Marquardt's with
  exact ones (`wrf_mi.models.uplink.uplink_paths`).

It learns nothing from training rows but the kind of wave front where that is open. A correct version is exact on
noise-free channels of few, well separated paths; one whose paths are many or closer than the array and the band
resolve finds stand-ins, which drift from the truth with the distance of the bands.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core import Record, Split
from ...training.session import FitSession
from ..method import Inputs, Method
from .cross_band import PathSettings, bands_arrays, bands_from, choose, downlink
from .csi_bands import Bands, uplink_of
from .uplink_paths import find_paths
from .uplink_waves import waves_of


@dataclass(frozen=True)
class R2F2Settings(PathSettings):
    """Settings of R2F2: those of the search for paths."""


class R2F2:
    """R2F2 with everything chosen."""

    def __init__(self, kind: str, bands: Bands, settings: R2F2Settings) -> None:
        self.kind, self.bands, self.settings = kind, bands, settings
        self._waves = waves_of(kind, bands, settings.max_distance_m)

    def predict(self, inputs: Inputs, receiver: int) -> NDArray[np.complex64]:
        """Downlink coefficients [m, antennas, subcarriers] of the uplinks of ``inputs``.

        Raises:
            InputError: no uplink, one of another shape, or one that is not finite.
        """
        own = self.settings
        paths = find_paths(self._waves, uplink_of(inputs, self.bands), own.max_paths, own.between, own.final)
        return downlink(self._waves, paths, self.bands).astype(np.complex64)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """See `wrf_mi.models.method.Fitted`."""
        settings = {f"settings/{name}": np.array(value) for name, value in asdict(self.settings).items()}
        return bands_arrays(self.kind, self.bands) | settings


def fit(record: Record, split: Split, settings: R2F2Settings, seed: int, session: FitSession) -> R2F2:
    """Choose what is open; the rest is each row's own.

    Raises:
        InputError: no uplink, shapes that do not fit, coefficients that are not finite, or one training row.
    """
    return R2F2(*choose(METHOD, record, split, settings, session.report), settings)


def load(arrays: dict[str, NDArray[Any]], record: Record) -> R2F2:
    """From `R2F2.arrays`."""
    settings = {k.removeprefix("settings/"): v.item() for k, v in arrays.items() if k.startswith("settings/")}
    return R2F2(*bands_from(arrays), R2F2Settings(**settings))


METHOD = Method(
    name="r2f2",
    tasks=("csi",),
    settings=R2F2Settings,
    fit=fit,
    load=load,
    source="Vasisht et al., Eliminating channel feedback in next-generation cellular networks (SIGCOMM 2016)",
    needs_uplink=True,
)
