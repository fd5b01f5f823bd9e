"""OptML: R2F2's optimisation, started by a network that finds many paths at once.

Source: Bakshi, Mao, Srinivasan and Parthasarathy, "Fast and efficient cross band channel prediction using machine
learning" (MobiCom 2019), and the code at https://github.com/alex81527/r2f2-optml-mdtrack: a network trained on
simulated channels of few paths, 20 to 30 dB above noise, takes an uplink to a blurred map of its paths over distance
and direction; peaks of the map start R2F2's optimisation, which then needs few steps. Chosen here:

- The paper's network is fully connected from the coefficients of 3 or 4 antennas to 20 x 25 cells. For any array, the
  network here takes the matched filter of the uplink over the cells and is convolutional over directions
  (`wrf_mi.models.uplink.path_network`).
- A room has more paths than a single map separates: there are ``rounds`` of maps of the uplink's residual, each
  followed by a refinement of all paths found so far. Simulated channels are therefore noisier at times, 5 to 30 dB.
- After each round a path stays if the Bayesian information criterion would rise without it.
- Wave fronts and unknown frequencies: as in R2F2 (`wrf_mi.models.uplink.r2f2`).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ...backend.device import to_tensor, to_uint
from ...core import Split
from ...core.angles import FloatArray
from ...core.settings import Count
from ...core.types import IntArray
from ...training.loop_config import AdamConfig
from ...training.session import FitSession
from ..model import Arrays, Inputs, Model, Problem, keyed, settings_array, stored_settings, under
from ..networks.layers import columns
from ..networks.training import Network, NetworkSettings, network_adam, opaque_rows, train_network
from .csi_bands import Bands
from .path_network import PathMap, Simulation, side_by_side, simulate
from .r2f2 import R2F2, PathSettings, choose
from .uplink_paths import ROWS, Paths, in_parts, refine, refine_paths
from .uplink_waves import Complex, Mask, Waves, waves_of

MAX_VALIDATION = 100
"""Most maps that validate."""


@dataclass(frozen=True)
class OptMLSettings(PathSettings, NetworkSettings):
    """Settings of OptML, of the training loop, and of the search for paths with fewer steps than R2F2's.

    Attributes:
        simulation: simulated channels to learn from.
        width: channels of the network.
        rounds: maps of the residual.
        at_once: most paths of a map.
        threshold: least height of a peak in the network's map, whose range is 0 to 1.
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
    max_paths: Count = 40
    between: int = 3
    final: int = 5


class OptML(R2F2):
    """A fitted network with the bands and the array that it was fitted for."""

    def __init__(self, kind: str, bands: Bands, settings: OptMLSettings, network: PathMap) -> None:
        super().__init__(kind, bands, settings)
        self.settings: OptMLSettings = settings
        self.network = network

    def paths(self, h: Complex, inputs: Inputs) -> Paths:
        """Paths of uplinks [m, antennas, f]."""
        s, waves = self.settings, self.waves
        theta: FloatArray = np.zeros((len(h), 0, 1 + waves.cosines.shape[1]))
        present: Mask = np.zeros((len(h), 0), bool)
        residual = h

        def pruned(rows: slice) -> tuple[FloatArray, Mask, Complex]:
            return prune(waves, h[rows], theta[rows], present[rows], s.between, s.max_paths)

        for _ in range(s.rounds):
            chunks = [residual[i : i + ROWS] for i in range(0, len(h), ROWS)]
            proposals = [self.network.propose(chunk, s.at_once, s.threshold) for chunk in chunks]
            fresh, found = (np.concatenate(part) for part in zip(*proposals, strict=True))
            theta = waves.limit(np.concatenate([theta, fresh], axis=1))
            present = np.concatenate([present, found], axis=1)
            theta, present, residual = (np.concatenate(p) for p in zip(*in_parts(pruned, len(h)), strict=True))
        return refine_paths(waves, h, theta, present, s.final)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Settings, wave model, bands and weights."""
        settings = {"settings": settings_array(self.settings)}
        return settings | self.bands.arrays(self.kind) | keyed("network/", self.network.arrays())


def prune(
    waves: Waves, h: Complex, theta: FloatArray, present: Mask, steps: int, most: int
) -> tuple[FloatArray, Mask, Complex]:
    """Refine, then keep up to ``most`` paths by the information criterion; parameters, presence and residual.

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


def fit(problem: Problem, split: Split, session: FitSession) -> OptML:
    """Choose the wave model on validation rows, then learn maps of the paths of simulated channels."""
    settings: OptMLSettings = problem.settings
    kind, bands = choose(MODEL.name, problem.record, split, settings, session.report)
    waves = waves_of(kind, bands, settings.max_distance_m)
    session.report("simulating channels", 0.0)
    rng = np.random.default_rng(problem.seed)
    seen, truth = simulate(waves, settings.simulation, bands, rng)
    channels, cells = seen.shape[1:]
    judges = int(np.clip(len(seen) // 10, 1, MAX_VALIDATION))
    around = to_uint(waves.around)
    # One column a map, so that a batch is a choice of columns.
    flat = {name: to_tensor(maps.reshape(len(maps), -1).T) for name, maps in (("seen", seen), ("truth", truth))}
    data = flat | {"around": around}
    dr.make_opaque(data)

    def draw(rows: IntArray, receiver: int, rng: np.random.Generator) -> Any:
        return opaque_rows(rows)

    def chosen(maps: Any, rows: Any) -> Any:
        x = dr.moveaxis(dr.reshape(columns(maps, rows), (channels, cells, dr.width(rows))), 1, 2)
        return dr.reshape(x, (channels, dr.width(rows) * cells))

    def loss(network: PathMap, data: Any, rows: Any) -> Any:
        x, y = chosen(data["seen"], rows), chosen(data["truth"], rows)
        return dr.mean(dr.square(network(x, data["around"]) - y), axis=None).array

    asked, wanted = side_by_side(seen[:judges]), side_by_side(truth[:judges]).numpy()

    def score(network: PathMap) -> float:
        return float(np.square(network(asked, around).numpy() - wanted).mean())

    rows = [np.arange(judges, len(seen))], [np.arange(len(seen))]
    maps = Network("paths", PathMap(waves, settings.width, rng), loss, data, draw, *rows, score, "mean squared error")
    network = train_network(maps, settings, (problem.seed,), session)[0]
    return OptML(kind, bands, settings, network)


def load(arrays: Arrays, problem: Problem, folder: Path) -> OptML:
    """The model that `OptML.arrays` described."""
    settings, (kind, bands) = stored_settings(OptMLSettings, arrays, "optml"), Bands.load(arrays)
    waves = waves_of(kind, bands, settings.max_distance_m)
    network = PathMap(waves, settings.width, np.random.default_rng(0)).on_device(under("network/", arrays))
    return OptML(kind, bands, settings, network)


SOURCE = "Bakshi et al., Fast and efficient cross band channel prediction using machine learning (MobiCom 2019)"
MODEL = Model("optml", ("csi",), OptMLSettings, fit, load, SOURCE, uplink="required", headings=True)
