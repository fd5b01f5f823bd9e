"""A network that locates paths: from the matched filter of an uplink to a map of paths.

Both maps are over the same cells, distances times directions of a wave model's grid. The network is convolutional
over the directions, with the distances as channels; without an array there is a single cell of directions, and it is
fully connected over distances. It learns from simulated channels of few paths for the given array and bands.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from ...backend.device import to_tensor, to_uint
from ...core.angles import FloatArray
from ...core.settings import Count
from ..networks.layers import Linear, Module
from .csi_bands import Bands
from .uplink_waves import ArrayWaves, Complex, Waves

FLOOR_DB = 30.0
"""Range of maps, dB: 0 is this far below the strongest path, 1 the strongest path."""
BLUR = 1.0
"""Width of a path in the map to be learned, in cells."""
CHUNK_SIZE = 256
"""Maps that are made together: bounds the memory."""


@dataclass(frozen=True)
class Simulation:
    """Simulated channels.

    Attributes:
        channels: number of channels; a tenth validates.
        paths: most paths of a channel.
        decay_db: range of path powers below the strongest, dB.
        noise_db: least and greatest ratio of signal to noise, dB.
    """

    channels: Annotated[int, Field(ge=2, description="2 or more")] = 3000  # to learn from and to validate
    paths: Count = 12
    decay_db: float = 25.0
    noise_db: tuple[float, float] = (5.0, 30.0)


def maps_of(waves: Waves, h: Complex) -> NDArray[np.float32]:
    """Matched filters of uplinks [n, antennas, f]: [n, distances, cells] in 0..1, logarithmic."""
    out = np.empty((len(h), len(waves.grid), len(waves.cosines)), np.float32)
    for first in range(0, len(h), CHUNK_SIZE):
        power = waves.power(h[first : first + CHUNK_SIZE])
        brightest = np.maximum(power.max(axis=(1, 2), keepdims=True), np.finfo(float).tiny)
        decibels = 10 * np.log10(np.maximum(power / brightest, 1e-9))
        out[first : first + CHUNK_SIZE] = (1 + decibels / FLOOR_DB).clip(0, 1)
    return out


def simulate(
    waves: Waves, simulation: Simulation, bands: Bands, rng: np.random.Generator
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Maps of simulated channels and of their paths, each [n, distances, cells].

    The number of paths, their directions, phases and powers in decibels are uniform; so are distances, or with
    spherical waves their logarithms.
    """
    seen, truth = [], []
    axes = waves.cosines.shape[1]
    near = max(float(waves.grid[0]), 0.0)
    for first in range(0, simulation.channels, CHUNK_SIZE):
        n, k = min(CHUNK_SIZE, simulation.channels - first), simulation.paths
        present = np.arange(k) < rng.integers(1, k + 1, (n, 1))
        far = float(waves.grid[-1])
        d = near * (far / near) ** rng.random((n, k)) if waves.spherical else rng.uniform(near, far, (n, k))
        cosines = rng.standard_normal((n, k, axes))
        if axes:
            # Uniform in the ball of directions that an array of so many axes resolves.
            cosines *= (rng.random((n, k, 1)) ** (1 / axes)) / np.linalg.norm(cosines, axis=2, keepdims=True)
        theta = np.concatenate([d[..., None], cosines], axis=2)
        level = -simulation.decay_db * rng.random((n, k))
        level[:, 0] = 0
        gains = 10 ** (level / 20) * np.exp(2j * np.pi * rng.random((n, k))) * present
        h = np.empty((n, bands.antennas, len(bands.uplink_hz)), complex)
        gains = gains[..., None]
        if not isinstance(waves, ArrayWaves):
            gains = gains * (rng.standard_normal((n, k, bands.antennas, 2)) @ np.array([1, 1j]) / np.sqrt(2))
        for row in range(n):
            h[row] = waves.evaluate(theta[row : row + 1], gains[row : row + 1], bands.uplink_hz)[0]
        ratio = rng.uniform(*simulation.noise_db, (n, 1, 1))
        noise = np.sqrt(np.square(np.abs(h)).mean(axis=(1, 2), keepdims=True) * 10 ** (-ratio / 10) / 2)
        h += noise * (rng.standard_normal((*h.shape, 2)) @ np.array([1, 1j]))
        seen.append(maps_of(waves, h))
        truth.append(_target(waves, theta, level, present))
    return np.concatenate(seen), np.concatenate(truth)


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
            x = _elu(layer(_patches(x, around, len(self.waves.cosines))))
        return self.out(x)

    def propose(self, h: Complex, count: int, threshold: float) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Up to ``count`` paths of each uplink: parameters [n, count, p] and which of them rise above ``threshold``."""
        waves = self.waves
        n, channels, cells = len(h), len(waves.grid), len(waves.cosines)
        found = self(side_by_side(maps_of(waves, h)), to_uint(waves.around)).numpy()
        found = found.reshape(channels, n, cells).transpose(1, 0, 2)
        padded = np.full((n, channels + 2, cells + 1), -np.inf, np.float32)
        padded[:, 1:-1, :-1] = found
        highest = padded[:, :, waves.around].max(axis=2)
        highest = np.maximum(np.maximum(highest[:, :-2], highest[:, 1:-1]), highest[:, 2:])
        peaks = np.where((found >= highest) & (found > threshold), found, -np.inf).reshape(n, -1)
        count = min(count, peaks.shape[1])
        best = np.argsort(-peaks, axis=1, kind="stable")[:, :count]
        at, direction = np.unravel_index(best, (channels, cells))
        theta = np.concatenate([waves.grid[at][..., None], waves.cosines[direction]], axis=2)
        return theta, np.isfinite(np.take_along_axis(peaks, best, axis=1))


def _elu(x: Any) -> Any:
    return dr.select(x > 0, x, dr.exp(dr.minimum(x, 0)) - 1)


def _patches(x: Any, around: Any, cells: int) -> Any:
    """Values of each cell's neighbours, [neighbours * channels, columns]; zero outside the lattice."""
    channels, total = x.shape
    count = dr.width(around) // cells
    slot = dr.arange(mi.UInt32, count * channels * total)
    column, rest = slot % total, slot // total
    channel, number = rest % channels, rest // channels
    neighbour = dr.gather(mi.UInt32, around, number * cells + column % cells)
    source = channel * total + (column // cells) * cells + neighbour
    return type(x)(dr.gather(type(x.array), x.array, source, neighbour < cells), (count * channels, total))


def side_by_side(maps: NDArray[np.float32]) -> Any:
    """Maps [n, channels, cells] as a tensor [channels, n * cells]."""
    return to_tensor(maps.transpose(1, 0, 2).reshape(maps.shape[1], -1))
