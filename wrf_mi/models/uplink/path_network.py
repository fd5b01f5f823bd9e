"""A network that sees where paths are: from the matched filter of an uplink to a map of paths.

Both maps are over the same cells, distances times directions of a wave model's grid. The network is convolutional
over the directions, where an array looks the same all over, with the distances as channels; without an array, where
there is but one cell of directions, it is fully connected over distances. It learns from simulated channels of
few paths, as many as one likes, for the array and the bands at hand.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from ...backend.device import to_tensor
from ...core.angles import FloatArray
from ...core.settings import Count
from ...core.types import IntArray
from ...gaussians.network import Weights, init_layer, linear
from ...training.loop_config import LoopConfig
from ...training.session import FitSession
from ..networks.tensors import columns
from ..networks.training import Network, opaque_rows, train_network
from .csi_bands import Bands
from .uplink_waves import ArrayWaves, Complex, Waves

FLOOR_DB = 30.0
"""Paths this far below the strongest are dark: maps are decibels above it, as a share of it."""
BLUR = 1.0
"""Width of a path in the map to be learned, in cells."""
HELD = 100
"""Most maps that validate."""
CHUNK_SIZE = 256
"""Maps that are made together: bounds the memory."""


@dataclass(frozen=True)
class Simulation:
    """Channels to learn from.

    Attributes:
        channels: number of them; a tenth validates.
        paths: most paths of one.
        decay_db: range of path powers below the strongest.
        noise_db: least and greatest ratio of signal to noise.
    """

    channels: Annotated[int, Field(ge=2, description="2 or more")] = 3000  # to learn from and to validate
    paths: Count = 12
    decay_db: float = 25.0
    noise_db: tuple[float, float] = (5.0, 30.0)


def maps_of(waves: Waves, h: Complex) -> NDArray[np.float32]:
    """What the network sees of uplinks [n, antennas, f]: [n, distances, cells] in 0..1, logarithmic."""
    out = np.empty((len(h), len(waves.grid), len(waves.cosines)), np.float32)
    for first in range(0, len(h), CHUNK_SIZE):
        power = waves.power(h[first : first + CHUNK_SIZE])
        brightest = np.maximum(power.max(axis=(1, 2), keepdims=True), np.finfo(float).tiny)
        out[first : first + CHUNK_SIZE] = _bright(power / brightest)
    return out


def _bright(power: FloatArray) -> FloatArray:
    return np.asarray((1 + 10 * np.log10(np.maximum(power, 1e-9)) / FLOOR_DB).clip(0, 1))


def simulate(
    waves: Waves, simulation: Simulation, bands: Bands, rng: np.random.Generator
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Maps of simulated channels and of their paths, each [n, distances, cells].

    The number of paths, their directions, phases and powers in decibels are uniform; so are distances, but with
    spherical waves, of which the near ones differ most, their logarithms.
    """
    seen, truth = [], []
    axes = waves.cosines.shape[1]
    near = max(float(waves.grid[0]), 0.0)
    spherical = isinstance(waves, ArrayWaves) and waves.spherical
    for first in range(0, simulation.channels, CHUNK_SIZE):
        n, k = min(CHUNK_SIZE, simulation.channels - first), simulation.paths
        present = np.arange(k) < rng.integers(1, k + 1, (n, 1))
        far = float(waves.grid[-1])
        d = near * (far / near) ** rng.random((n, k)) if spherical else rng.uniform(near, far, (n, k))
        cosines = rng.standard_normal((n, k, axes))
        if axes:
            # Uniform in the ball of directions that an array of so many axes tells apart.
            cosines *= (rng.random((n, k, 1)) ** (1 / axes)) / np.linalg.norm(cosines, axis=2, keepdims=True)
        theta = np.concatenate([d[..., None], cosines], axis=2)
        level = -simulation.decay_db * rng.random((n, k))
        level[:, 0] = 0
        gains = 10 ** (level / 20) * np.exp(2j * np.pi * rng.random((n, k))) * present
        h = np.empty((n, bands.antennas, len(bands.uplink_hz)), complex)
        if not isinstance(waves, ArrayWaves):
            fading = rng.standard_normal((n, k, bands.antennas, 2)) @ np.array([1, 1j]) / np.sqrt(2)
            gains = gains[..., None] * fading
        for row in range(n):
            h[row] = waves.evaluate(theta[row : row + 1], gains[row : row + 1], bands.uplink_hz)[0]
        ratio = rng.uniform(*simulation.noise_db, (n, 1, 1))
        noise = np.sqrt(np.square(np.abs(h)).mean(axis=(1, 2), keepdims=True) * 10 ** (-ratio / 10) / 2)
        h += noise * (rng.standard_normal((*h.shape, 2)) @ np.array([1, 1j]))
        seen.append(maps_of(waves, h))
        truth.append(_target(waves, theta, level, present))
    return np.concatenate(seen), np.concatenate(truth)


def _target(waves: Waves, theta: FloatArray, level_db: FloatArray, present: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Paths as spots whose height is their level over `FLOOR_DB`: the authors blur theirs too."""
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


def neighbours(lattice: IntArray) -> IntArray:
    """Of each cell of directions the cells around it and itself, [3^axes, cells]; where there is none, -1."""
    axes = lattice.shape[1]
    index = {tuple(place): number for number, place in enumerate(lattice)}
    steps = np.stack(np.meshgrid(*[[-1, 0, 1]] * axes, indexing="ij"), axis=-1).reshape(-1, axes) if axes else [()]
    return np.array([[index.get(tuple(place + np.asarray(s, int)), -1) for place in lattice] for s in steps])


def initial_weights(channels: int, around: int, width: int, rng: np.random.Generator) -> Weights:
    """Two convolutions and one layer per cell."""
    weights = init_layer("0", {"hidden": channels * around}, width, rng)
    weights |= init_layer("1", {"hidden": width * around}, width, rng)
    return weights | init_layer("out", {"hidden": width}, channels, rng, gain=0.5)


def look(params: Mapping[str, Any], x: Any, around: Any) -> Any:
    """Map of paths [channels, cells * batch] of maps of the same shape; ``around`` as `neighbours`, flat, for one map.

    Args:
        params: weights.
        x: cells of one map side by side, maps after each other.
        around: ``index`` [neighbours * cells], ``inside`` of the same length, and ``cells``, an array that long.
    """
    for layer in ("0", "1"):
        x = _elu(linear(params, layer, _patches(x, around)))
    return linear(params, "out", x)


def _elu(x: Any) -> Any:
    return dr.select(x > 0, x, dr.exp(dr.minimum(x, 0)) - 1)


def _patches(x: Any, around: Any) -> Any:
    """Values of each cell's neighbours, [neighbours * channels, columns]."""
    channels, total = x.shape
    cells = dr.width(around["cells"])
    count = dr.width(around["index"]) // cells
    slot = dr.arange(mi.UInt32, count * channels * total)
    column, rest = slot % total, slot // total
    channel, neighbour = rest % channels, rest // channels
    place = neighbour * cells + column % cells
    inside = dr.gather(mi.Bool, around["inside"], place)
    source = channel * total + (column // cells) * cells + dr.gather(mi.UInt32, around["index"], place)
    return type(x)(dr.gather(type(x.array), x.array, source, inside), (count * channels, total))


class PathNetwork:
    """A fitted network.

    Args:
        waves: wave model whose grid it looks at.
        weights: as `fit` returns them.
    """

    def __init__(self, waves: Waves, weights: Weights) -> None:
        self.waves, self.weights = waves, weights
        self._around = around_of(waves)
        self._table = neighbours(waves.lattice)
        self._params = {name: to_tensor(values) for name, values in weights.items()}

    def propose(self, h: Complex, count: int, threshold: float) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Up to ``count`` paths of each uplink: parameters [n, count, p] and which of them rise above ``threshold``."""
        n, channels, cells = len(h), len(self.waves.grid), len(self.waves.cosines)
        x = maps_of(self.waves, h).transpose(1, 0, 2).reshape(channels, -1)
        found = look(self._params, to_tensor(x), self._around).numpy().reshape(channels, n, cells).transpose(1, 0, 2)
        padded = np.full((n, channels + 2, cells + 1), -np.inf, np.float32)
        padded[:, 1:-1, :-1] = found
        # The last cell is the outside, to which -1 points.
        highest = padded[:, :, self._table].max(axis=2)
        highest = np.maximum(np.maximum(highest[:, :-2], highest[:, 1:-1]), highest[:, 2:])
        peaks = np.where((found >= highest) & (found > threshold), found, -np.inf).reshape(n, -1)
        count = min(count, peaks.shape[1])
        best = np.argsort(-peaks, axis=1, kind="stable")[:, :count]
        at, direction = np.unravel_index(best, (channels, cells))
        theta = np.concatenate([self.waves.grid[at][..., None], self.waves.cosines[direction]], axis=2)
        return theta, np.isfinite(np.take_along_axis(peaks, best, axis=1))


def around_of(waves: Waves) -> dict[str, Any]:
    """Device arrays that `look` takes."""
    table = neighbours(waves.lattice)
    around = {
        "index": mi.UInt32(np.maximum(table, 0).ravel().tolist()),
        "inside": mi.Bool((table >= 0).ravel().tolist()),
        "cells": dr.zeros(mi.UInt32, len(waves.cosines)),
    }
    dr.make_opaque(around)
    return around


def fit_paths(
    waves: Waves,
    bands: Bands,
    simulation: Simulation,
    width: int,
    config: LoopConfig,
    seed: int,
    session: FitSession,
) -> PathNetwork:
    """Simulate channels and learn to see their paths; squared error of the maps."""
    session.report("simulating channels", 0.0)
    rng = np.random.default_rng(seed)
    seen, truth = simulate(waves, simulation, bands, rng)
    channels, cells = len(waves.grid), len(waves.cosines)
    held = int(np.clip(len(seen) // 10, 1, HELD))
    around = around_of(waves)
    # One column a map, so that a batch is a choice of columns.
    data = {
        "seen": to_tensor(seen.reshape(len(seen), -1).T),
        "truth": to_tensor(truth.reshape(len(seen), -1).T),
        "around": around,
    }
    dr.make_opaque(data)

    def draw(rows: IntArray, receiver: int, rng: np.random.Generator) -> Any:
        return opaque_rows(rows)

    def loss(params: Mapping[str, Any], data: Any, rows: Any) -> Any:
        x, y = (_side_by_side(columns(data[name], rows), channels, cells) for name in ("seen", "truth"))
        return dr.mean(dr.square(look(params, x, data["around"]) - y), axis=None).array

    judged = [to_tensor(part[:held].transpose(1, 0, 2).reshape(channels, -1)) for part in (seen, truth)]

    def score(params: Mapping[str, Any]) -> float:
        return float(np.square(look(params, judged[0], around).numpy() - judged[1].numpy()).mean())

    weights = initial_weights(channels, len(neighbours(waves.lattice)), width, rng)
    rows = [np.arange(held, len(seen))], [np.arange(len(seen))]
    network = Network("paths", weights, loss, data, draw, *rows, score, "mean squared error")
    return PathNetwork(waves, train_network(network, config, (seed,), session)[0])


def _side_by_side(x: Any, channels: int, cells: int) -> Any:
    """Maps as columns [channels * cells, batch] to [channels, batch * cells]."""
    batch = x.shape[1]
    slot = dr.arange(mi.UInt32, channels * cells * batch)
    cell, rest = slot % cells, slot // cells
    source = ((rest // batch) * cells + cell) * batch + rest % batch
    return type(x)(dr.gather(type(x.array), x.array, source), (channels, batch * cells))
