"""OptML: R2F2's optimisation, started by a network that sees many paths at once.

Source: Bakshi, Mao, Srinivasan and Parthasarathy, "Fast and efficient cross band channel prediction using machine
learning" (MobiCom 2019), and the code that its readers keep at https://github.com/alex81527/r2f2-optml-mdtrack: a
network that has learned from simulated channels of few paths, 20 to 30 dB above noise, takes an uplink to a blurred map
of its paths over distance and direction; peaks of the map start R2F2's optimisation, which so needs few steps.

Chosen here:

- Theirs is fully connected from the coefficients of 3 or 4 antennas to 20 x 25 cells. For any array, it sees the
  matched filter of the uplink over the cells and is convolutional over directions
  (`wrf_mi.models.uplink.path_network`).
- A room has more paths than one look separates: there are ``rounds`` of looking at what is left of the uplink and
  refining all paths found so far. Simulated channels are therefore noisier at times, 5 to 30 dB.
- After each round a path stays if the Bayesian information criterion would rise without it.
- Wave fronts and what data do not tell: as in R2F2 (`wrf_mi.models.uplink.cross_band`).
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core import Record, Split
from ...core.angles import FloatArray
from ...core.settings import Count, settings_from
from ...gaussians.network import Weights
from ...training.loop_config import AdamConfig
from ...training.session import FitSession
from ..method import Inputs, Method
from ..networks.training import NetworkSettings, keyed, network_adam, under
from .cross_band import PathSettings, bands_arrays, bands_from, choose, downlink
from .csi_bands import Bands, uplink_of
from .path_network import PathNetwork, Simulation, fit_paths
from .uplink_paths import ROWS, Paths, in_parts, refine, refine_paths
from .uplink_waves import Complex, Mask, Waves, waves_of


@dataclass(frozen=True)
class OptMLSettings(PathSettings, NetworkSettings):
    """Settings of OptML, of the loop, and of the search for paths, whose defaults ask for fewer steps than R2F2's.

    Attributes:
        simulation: channels that it learns from.
        width: its channels.
        rounds: looks at what is left.
        at_once: most paths of one look.
        threshold: least height of a peak in the network's map, which ends at 0 and 1.
    """

    steps: int = 1875
    batch: int = 16
    validate_every: int = 300
    optimiser: AdamConfig = field(default_factory=lambda: network_adam(2e-3))
    simulation: Simulation = field(default_factory=Simulation)
    width: Count = 48
    rounds: Count = 5
    at_once: Count = 10
    threshold: float = 0.15
    between: int = 3
    final: int = 5

    def __post_init__(self) -> None:
        """Refuse what is no search.

        Raises:
            InputError: naming the setting.
        """
        PathSettings.__post_init__(self)
        NetworkSettings.__post_init__(self)


class OptML:
    """A fitted network with the bands and the array that it was fitted for."""

    def __init__(self, kind: str, bands: Bands, settings: OptMLSettings, weights: Weights) -> None:
        self.kind, self.bands, self.settings = kind, bands, settings
        self._waves = waves_of(kind, bands, settings.max_distance_m)
        self._network = PathNetwork(self._waves, weights)

    def predict(self, inputs: Inputs, receiver: int) -> NDArray[np.complex64]:
        """Downlink coefficients [m, antennas, subcarriers] of the uplinks of ``inputs``.

        Raises:
            InputError: no uplink, one of another shape, or one that is not finite.
        """
        h = uplink_of(inputs, self.bands)
        return downlink(self._waves, self._paths(h), self.bands).astype(np.complex64)

    def _paths(self, h: Complex) -> Paths:
        own, waves = self.settings, self._waves
        theta: FloatArray = np.zeros((len(h), 0, 1 + waves.cosines.shape[1]))
        present: Mask = np.zeros((len(h), 0), bool)
        left = h
        for _ in range(own.rounds):
            chunks = [left[i : i + ROWS] for i in range(0, len(h), ROWS)]
            proposals = [self._network.propose(chunk, own.at_once, own.threshold) for chunk in chunks]
            fresh, found = (np.concatenate(part) for part in zip(*proposals, strict=True))
            theta = waves.limit(np.concatenate([theta, fresh], axis=1))
            present = np.concatenate([present, found], axis=1)
            work = partial(prune_rows, waves, h, theta, present, own)
            theta, present, left = (np.concatenate(p) for p in zip(*in_parts(work, len(h)), strict=True))
        return refine_paths(waves, h, theta, present, own.final)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """See `wrf_mi.models.method.Fitted`."""
        own = {"settings": np.asarray(json.dumps(asdict(self.settings)))}
        return own | bands_arrays(self.kind, self.bands) | keyed("network", self._network.weights)


def prune(
    waves: Waves, h: Complex, theta: FloatArray, present: Mask, steps: int, most: int
) -> tuple[FloatArray, Mask, Complex]:
    """Refine, then keep up to ``most`` paths that are worth their freedom; with what they leave of the uplink.

    Without path k the residual's energy would rise by |g_k|^2 / (G^-1)_kk, with G the paths' normal matrix (the usual
    test of a regressor: Seber and Lee, "Linear Regression Analysis", 2003, section 3.8).
    """
    theta, solved = refine(waves, h, theta, present, steps)
    count = h.shape[1] * h.shape[2]
    diagonal = np.arange(present.shape[1])
    loaded = solved.gram.copy()
    loaded[:, diagonal, diagonal] += 1e-9 * count
    inverse = np.linalg.inv(loaded)[:, diagonal, diagonal].real
    strength = np.square(np.abs(solved.gains)).reshape(*present.shape, -1).sum(axis=2)
    rise = strength / np.maximum(inverse, np.finfo(float).tiny)
    energy = np.maximum(solved.energy, np.finfo(float).tiny)[:, None]
    worth = present & (2 * count * np.log1p(rise / energy) > waves.freedom * np.log(2 * count))
    order = np.argsort(-np.where(worth, rise, -1), axis=1, kind="stable")[:, :most]
    kept = np.take_along_axis(worth, order, axis=1)
    theta = np.take_along_axis(theta, order[..., None], axis=1)
    return theta, kept, waves.solve(theta, kept, h).residual


def prune_rows(
    waves: Waves, h: Complex, theta: FloatArray, present: Mask, settings: OptMLSettings, rows: slice
) -> tuple[FloatArray, Mask, Complex]:
    """`prune` for some rows."""
    return prune(waves, h[rows], theta[rows], present[rows], settings.between, settings.max_paths)


def fit(record: Record, split: Split, settings: OptMLSettings, seed: int, session: FitSession) -> OptML:
    """Choose what is open on validation rows, then learn from simulated channels.

    Raises:
        InputError: no uplink, shapes that do not fit, coefficients that are not finite, or one training row.
    """
    kind, bands = choose(METHOD, record, split, settings, session.report)
    waves = waves_of(kind, bands, settings.max_distance_m)
    network = fit_paths(waves, bands, settings.simulation, settings.width, settings, seed, session)
    return OptML(kind, bands, settings, network.weights)


def load(arrays: dict[str, NDArray[Any]], record: Record) -> OptML:
    """From `OptML.arrays`."""
    settings = settings_from(OptMLSettings, json.loads(str(arrays["settings"])), "optml")
    return OptML(*bands_from(arrays), settings, under("network", arrays))


METHOD = Method(
    name="optml",
    tasks=("csi",),
    settings=OptMLSettings,
    fit=fit,
    load=load,
    source="Bakshi et al., Fast and efficient cross band channel prediction using machine learning (MobiCom 2019)",
    needs_uplink=True,
)
