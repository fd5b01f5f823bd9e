"""OptML: R2F2's optimisation, started by a network that finds many paths at once.

Source: Bakshi, Mao, Srinivasan and Parthasarathy, "Fast and efficient cross band channel prediction using machine
learning" (MobiCom 2019), and the code at https://github.com/alex81527/r2f2-optml-mdtrack: a network trained on
simulated channels of few paths, 20 to 30 dB above noise, takes an uplink to a blurred map of its paths over distance
and direction; peaks of the map start R2F2's optimisation, which then needs few steps. Chosen here:

- The paper's network is fully connected from the coefficients of 3 or 4 antennas to 20 x 25 cells. For any array, the
  network here takes the matched filter of the uplink over the cells, distances times directions of a wave model's
  grid, to a map over the same cells. It is convolutional over directions, with distances as channels; without an array
  there is a single cell of directions.
- A room has more paths than a single map separates: there are ``rounds`` of maps of the uplink's residual, each
  followed by a refinement of all paths found so far. Simulated channels are therefore noisier at times, 5 to 30 dB.
- After each round a path stays if the Bayesian information criterion would rise without it.
- Wave fronts and unknown frequencies: as in R2F2 (`wrf_mi.estimators.uplink.r2f2`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from ...backend.device import to_tensor, to_uint
from ...core import Split
from ...core.angles import FloatArray
from ...core.settings import Count
from ...training.config import AdamConfig, unused_of_loop
from ...training.session import FitSession
from ..model import Arrays, Inputs, Problem, slices
from ..networks.layers import Linear, Module, columns
from ..networks.training import Network, NetworkSettings, network_adam, opaque_rows, train_network
from .r2f2 import R2F2, PathSettings, R2F2Model, choose
from .uplink_paths import ROWS, UplinkPaths, in_parts, refine, refine_paths
from .uplink_waves import ArrayWaves, Bands, Complex, Mask, Waves, waves_of

FLOOR_DB = 30.0  # range of maps, dB: 0 is this far below the strongest path, 1 the strongest path
BLUR = 1.0  # width of a path in the map to be learned, in cells
CHUNK_SIZE = 256  # maps that are made together: bounds the memory


@dataclass(frozen=True)
class Simulation:
    """Simulated channels."""

    channels: Annotated[int, Field(ge=2, description="2 or more")] = 3000  #: number of channels; a tenth validates
    paths: Count = 12  #: most paths of a channel
    decay_db: float = 25.0  #: range of path powers below the strongest, dB
    noise_db: tuple[float, float] = (5.0, 30.0)  #: least and greatest ratio of signal to noise, dB


def maps_of(waves: Waves, h: Complex) -> NDArray[np.float32]:
    """Matched filters of uplinks [n, antennas, f]: [n, distances, cells] in 0..1, logarithmic."""
    out = np.empty((len(h), len(waves.grid), len(waves.cosines)), np.float32)
    for chunk in slices(len(h), CHUNK_SIZE):
        power = waves.power(h[chunk])
        brightest = np.maximum(power.max(axis=(1, 2), keepdims=True), np.finfo(float).tiny)
        decibels = 10 * np.log10(np.maximum(power / brightest, 1e-9))
        out[chunk] = (1 + decibels / FLOOR_DB).clip(0, 1)
    return out


def simulate(
    waves: Waves, simulation: Simulation, bands: Bands, rng: np.random.Generator
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Maps of simulated channels and of their paths, each [n, distances, cells]."""
    # The number of paths, their directions, phases and powers in decibels are uniform; so are distances, or with
    # spherical waves their logarithms.
    filtered, truth = [], []
    axes, k = waves.cosines.shape[1], simulation.paths
    near, far = max(float(waves.grid[0]), 0.0), float(waves.grid[-1])
    for chunk in slices(simulation.channels, CHUNK_SIZE):
        n = chunk.stop - chunk.start
        present = np.arange(k) < rng.integers(1, k + 1, (n, 1))
        d = near * (far / near) ** rng.random((n, k)) if waves.spherical else rng.uniform(near, far, (n, k))
        cosines = rng.standard_normal((n, k, axes))
        if axes:
            # Uniform in the ball of directions that an array of so many axes resolves.
            cosines *= (rng.random((n, k, 1)) ** (1 / axes)) / np.linalg.norm(cosines, axis=2, keepdims=True)
        theta = np.concatenate([d[..., None], cosines], axis=2)
        level = -simulation.decay_db * rng.random((n, k))
        level[:, 0] = 0
        gains = (10 ** (level / 20) * np.exp(2j * np.pi * rng.random((n, k))) * present)[..., None]
        h = np.empty((n, bands.antennas, len(bands.uplink_hz)), complex)
        if not isinstance(waves, ArrayWaves):
            gains = gains * (rng.standard_normal((n, k, bands.antennas, 2)) @ np.array([1, 1j]) / np.sqrt(2))
        for row in range(n):
            h[row] = waves.evaluate(theta[row : row + 1], gains[row : row + 1], bands.uplink_hz)[0]
        ratio = rng.uniform(*simulation.noise_db, (n, 1, 1))
        noise = np.sqrt(np.square(np.abs(h)).mean(axis=(1, 2), keepdims=True) * 10 ** (-ratio / 10) / 2)
        h += noise * (rng.standard_normal((*h.shape, 2)) @ np.array([1, 1j]))
        filtered.append(maps_of(waves, h))
        truth.append(_target(waves, theta, level, present))
    return np.concatenate(filtered), np.concatenate(truth)


def _target(waves: Waves, theta: FloatArray, level_db: FloatArray, present: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Paths as blurred spots whose height is their level over `FLOOR_DB`."""
    n, k, _ = theta.shape
    at = np.interp(theta[..., 0], waves.grid, np.arange(len(waves.grid)))
    out = np.zeros((n, len(waves.grid), len(waves.cosines)), np.float32)
    spans = np.ptp(waves.lattice, axis=0)
    cell = np.divide(np.ptp(waves.cosines, axis=0), spans, out=np.ones(len(spans)), where=spans > 0)
    for path in range(k):
        along = np.exp(-np.square(np.arange(len(waves.grid)) - at[:, path, None]) / (2 * BLUR**2))
        off = (waves.cosines - theta[:, path, None, 1:]) / cell
        across = np.exp(-np.square(off).sum(axis=2) / (2 * BLUR**2))
        height = (1 + level_db[:, path] / FLOOR_DB) * present[:, path]
        np.maximum(out, (height[:, None, None] * along[:, :, None] * across[:, None]).astype(np.float32), out=out)
    return out


class PathMap(Module):
    """Two convolutions over directions and a layer for each cell: maps [channels, cells * batch] to such maps.

    Columns are the cells of a map side by side, maps after each other; channels are distances.
    """

    def __init__(self, waves: Waves, width: int, rng: np.random.Generator) -> None:
        self.waves, channels = waves, len(waves.grid)
        self.layers = [Linear(inputs * len(waves.around), width, rng) for inputs in (channels, width)]
        self.out = Linear(width, channels, rng, gain=0.5)

    def __call__(self, x: Any, around: Any) -> Any:
        """Maps of paths; ``around`` is `Waves.around` on the device."""
        for layer in self.layers:
            x = layer(_patches(x, around, len(self.waves.cosines)))
            x = dr.select(x > 0, x, dr.exp(dr.minimum(x, 0)) - 1)  # exponential linear unit
        return self.out(x)

    def propose(self, h: Complex, count: int, threshold: float) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Up to ``count`` paths of each uplink: parameters [n, count, p] and which of them rise above ``threshold``."""
        waves = self.waves
        n, channels, cells = len(h), len(waves.grid), len(waves.cosines)
        maps = self(side_by_side(maps_of(waves, h)), to_uint(waves.around)).numpy()
        maps = maps.reshape(channels, n, cells).transpose(1, 0, 2)
        # A peak is as high as all its neighbours in distance and direction; beyond the map there is nothing.
        padded = np.full((n, channels + 2, cells + 1), -np.inf, np.float32)
        padded[:, 1:-1, :-1] = maps
        highest = padded[:, :, waves.around].max(axis=2)
        highest = np.maximum(np.maximum(highest[:, :-2], highest[:, 1:-1]), highest[:, 2:])
        peaks = np.where((maps >= highest) & (maps > threshold), maps, -np.inf).reshape(n, -1)
        count = min(count, peaks.shape[1])
        best = np.argsort(-peaks, axis=1, kind="stable")[:, :count]
        at, direction = np.unravel_index(best, (channels, cells))
        theta = np.concatenate([waves.grid[at][..., None], waves.cosines[direction]], axis=2)
        return theta, np.isfinite(np.take_along_axis(peaks, best, axis=1))


def _patches(x: Any, around: Any, cells: int) -> Any:
    """Values of each cell's neighbours, [neighbours * channels, columns]; zero outside the lattice."""
    channels, total = x.shape
    count = dr.width(around) // cells
    slot = dr.arange(mi.UInt32, count * channels * total)
    column, line = slot % total, slot // total
    channel, number = line % channels, line // channels
    neighbour = dr.gather(mi.UInt32, around, number * cells + column % cells)
    source = channel * total + (column // cells) * cells + neighbour
    return type(x)(dr.gather(type(x.array), x.array, source, neighbour < cells), (count * channels, total))


def side_by_side(maps: NDArray[np.float32]) -> Any:
    """Maps [n, channels, cells] as a tensor [channels, n * cells]."""
    return to_tensor(maps.transpose(1, 0, 2).reshape(maps.shape[1], -1))


AT_ONCE = 10  # most paths of a map
THRESHOLD = 0.15  # least height of a peak in the network's map, whose range is 0 to 1: 4.5 dB above its floor
MAX_VALIDATION = 100  # most maps that validate


@dataclass(frozen=True)
class OptMLSettings(PathSettings, NetworkSettings):
    """Settings of OptML, of the training loop, and of the search for paths with fewer steps than R2F2's."""

    steps: int = 1875
    batch: int = 16
    validate_every: int = 300
    optimiser: AdamConfig = field(default_factory=lambda: network_adam(2e-3))
    simulation: Simulation = field(default_factory=Simulation)  #: simulated channels to learn from
    width: Count = 48  #: channels of the network
    rounds: Count = 5  #: maps of the residual
    FIXED: ClassVar[Mapping[str, float]] = {"at_once": AT_ONCE, "threshold": THRESHOLD}
    max_paths: Count = 40
    between: int = 3
    final: int = 5


@dataclass(eq=False)
class OptML(R2F2):
    """A fitted network with the bands and the array that it was fitted for."""

    settings: OptMLSettings
    weights: Arrays

    def __post_init__(self) -> None:
        super().__post_init__()
        initial = PathMap(self.waves, self.settings.width, np.random.default_rng(0))
        self.network = initial.on_device(self.weights)

    def paths(self, h: Complex, inputs: Inputs) -> UplinkPaths:
        """Paths of uplinks [m, antennas, f]."""
        s, waves, residual = self.settings, self.waves, h
        theta: FloatArray = np.zeros((len(h), 0, 1 + waves.cosines.shape[1]))
        present: Mask = np.zeros((len(h), 0), bool)

        def pruned(rows: slice) -> tuple[FloatArray, Mask, Complex]:
            return prune(waves, h[rows], theta[rows], present[rows], s.between, s.max_paths)

        for _ in range(s.rounds):
            chunks = [residual[rows] for rows in slices(len(h), ROWS)]
            proposals = [self.network.propose(chunk, AT_ONCE, THRESHOLD) for chunk in chunks]
            fresh, is_peak = (np.concatenate(part) for part in zip(*proposals, strict=True))
            theta = waves.limit(np.concatenate([theta, fresh], axis=1))
            present = np.concatenate([present, is_peak], axis=1)
            theta, present, residual = (np.concatenate(p) for p in zip(*in_parts(pruned, len(h)), strict=True))
        return refine_paths(waves, h, theta, present, s.final)


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
    load = 1e-9 * count * np.eye(len(diagonal))  # two equal paths: either is worth nothing beside the other
    inverse = np.linalg.inv(solved.gram + load)[:, diagonal, diagonal].real
    strength = np.square(np.abs(solved.gains)).reshape(*present.shape, -1).sum(axis=2)
    rise = strength / np.maximum(inverse, np.finfo(float).tiny)
    energy = np.maximum(solved.energy, np.finfo(float).tiny)[:, None]
    # 2 N log of the energy's ratio against freedom log(2 N), as in the search of `find_paths`.
    worth = present & (2 * count * np.log1p(rise / energy) > waves.freedom * np.log(2 * count))
    order = np.argsort(-np.where(worth, rise, -1), axis=1, kind="stable")[:, :most]
    present = np.take_along_axis(worth, order, axis=1)
    theta = np.take_along_axis(theta, order[..., None], axis=1)
    return theta, present, waves.solve(theta, present, h).residual


class OptMLModel(R2F2Model):
    """OptML."""

    name, settings, fitted = "optml", OptMLSettings, OptML
    source = "Bakshi et al., Fast and efficient cross band channel prediction using machine learning (MobiCom 2019)"
    summary = "paths fitted to the uplink, started by a network"
    scene = "none"

    def unused_settings(self, problem: Problem, splits: Sequence[Split]) -> Mapping[str, str]:
        """As of R2F2, and ``patience`` where no simulated channels choose."""
        return {**super().unused_settings(problem, splits), **unused_of_loop(problem.settings, has_validation=True)}

    def fit(self, problem: Problem, split: Split, session: FitSession) -> OptML:
        """Choose the wave model on validation rows, then learn maps of the paths of simulated channels."""
        settings: OptMLSettings = problem.settings
        kind, bands = choose(self.known_rows(problem.record, split), problem.record, settings, session.progress)
        waves = waves_of(kind, bands, settings.max_distance_m)
        session.progress("simulating channels", 0.0)
        rng = np.random.default_rng(problem.seed)
        filtered, truth = simulate(waves, settings.simulation, bands, rng)
        channels, cells = filtered.shape[1:]
        judges = int(np.clip(len(filtered) // 10, 1, MAX_VALIDATION))
        around = to_uint(waves.around)
        # One column a map, so that a batch is a choice of columns.
        columns_of = (to_tensor(maps.reshape(len(maps), -1).T) for maps in (filtered, truth))
        data = dict(zip(("filtered", "truth", "around"), (*columns_of, around), strict=True))
        dr.make_opaque(data)

        def chosen(maps: Any, rows: Any) -> Any:
            x = dr.moveaxis(dr.reshape(columns(maps, rows), (channels, cells, dr.width(rows))), 1, 2)
            return dr.reshape(x, (channels, dr.width(rows) * cells))

        def loss(network: PathMap, data: Any, rows: Any) -> Any:
            x, y = chosen(data["filtered"], rows), chosen(data["truth"], rows)
            return dr.mean(dr.square(network(x, data["around"]) - y), axis=None).array

        asked, wanted = side_by_side(filtered[:judges]), side_by_side(truth[:judges]).numpy()

        def score(network: PathMap) -> float:
            return float(np.square(network(asked, around).numpy() - wanted).mean())

        rows = [np.arange(judges, len(filtered))], [np.arange(len(filtered))]
        initial = PathMap(waves, settings.width, rng)
        maps = Network(
            "paths", initial, loss, data, lambda rows, *_: opaque_rows(rows), *rows, score, "mean squared error"
        )
        network: PathMap = train_network(maps, settings, (problem.seed,), session)[0]
        return OptML(problem, kind, bands, settings, network.arrays())


MODEL = OptMLModel()
