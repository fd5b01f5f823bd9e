"""R2F2: the downlink from path parameters that an optimisation finds in the uplink.

Source: Vasisht, Kumar, Rahul and Katabi, "Eliminating channel feedback in next-generation cellular networks" (SIGCOMM
2016), sections 4 and 5: a channel is a sum over few paths, each of a length, a direction and a complex gain; the paths
that fit the uplink best over all antennas and subcarriers, added one by one from peaks of a matched filter and refined
by non-linear least squares, are evaluated at the downlink's frequencies. Differences from the paper:

- Paths are fitted to antennas and subcarriers themselves, for any array; the paper's transform of a uniform line of
  antennas to angles is unitary, so that the least squares are the same.
- Wave fronts: see `wrf_mi.models.uplink.cross_band`.
- The Bayesian information criterion chooses the number of paths up to ``max_paths``; the paper sets a threshold of the
  residual.
- The solver is Levenberg and Marquardt's with exact derivatives (`wrf_mi.models.uplink.uplink_paths`).

Training rows choose the kind of wave front alone. The method is exact on noise-free channels of few, well separated
paths. Where paths are many or closer than the resolution of array and band, the error grows with the distance of the
bands.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core import Record, Split
from ...training.session import FitSession
from ..method import Inputs, Method, keyed, under
from .cross_band import PathSettings, choose
from .csi_bands import Bands, uplink_of
from .uplink_paths import find_paths
from .uplink_waves import Waves, waves_of


@dataclass(frozen=True)
class R2F2Settings(PathSettings):
    """Settings of R2F2: those of the search for paths."""


@dataclass(frozen=True)
class R2F2:
    """R2F2 with the chosen wave model ``kind`` and bands."""

    kind: str
    bands: Bands
    settings: R2F2Settings

    @cached_property
    def _waves(self) -> Waves:
        return waves_of(self.kind, self.bands, self.settings.max_distance_m)

    def predict(self, inputs: Inputs, receiver: int) -> NDArray[np.complex64]:
        """Downlink coefficients [m, antennas, subcarriers] of the uplinks of ``inputs``."""
        s = self.settings
        paths = find_paths(self._waves, uplink_of(inputs), s.max_paths, s.between, s.final)
        return self._waves.evaluate(paths.theta, paths.gains, self.bands.downlink_hz).astype(np.complex64)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Wave model, bands and settings."""
        settings = {name: np.array(value) for name, value in asdict(self.settings).items()}
        return self.bands.arrays(self.kind) | keyed("settings/", settings)


def fit(record: Record, split: Split, settings: R2F2Settings, seed: int, session: FitSession) -> R2F2:
    """Choose the wave model and, where frequencies are unknown, the bands."""
    return R2F2(*choose(METHOD.name, record, split, settings, session.report), settings)


def load(arrays: dict[str, NDArray[Any]], record: Record) -> R2F2:
    """The model that `R2F2.arrays` described."""
    settings = {name: value.item() for name, value in under("settings/", arrays).items()}
    return R2F2(*Bands.load(arrays), R2F2Settings(**settings))


SOURCE = "Vasisht et al., Eliminating channel feedback in next-generation cellular networks (SIGCOMM 2016)"
METHOD = Method("r2f2", ("csi",), R2F2Settings, fit, load, SOURCE, needs_uplink=True)
