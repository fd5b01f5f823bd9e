"""Gaussians on the surfaces of a scene, whose signal is the traced field there times a learned complex factor.

Where a traced path meets surfaces at points q_i, its gain is multiplied by

    exp( sum_i sum_g w_g(q_i) (a_g + j b_g) ),   w_g(q) = exp(-|q - p_g|^2 / (2 s^2))

over the `NEAREST` Gaussians of the same plane: g at p_g changes what a wave leaves the surface
with, in logarithmic amplitude a_g and phase b_g, as a window in a wall, a cabinet in front of it or a bump of some
millimetres do. Zeros leave the paths as traced. Unlike Gaussians whose signals follow the transmitter's position, these
hold for all transmitters whose paths meet the same places: metres away from the training transmitters.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ...backend.device import on_device
from ...backend.vectors import Complex, Float64, complex_exponential
from ...core.types import FloatArray, IntArray
from ..options import DISC, FACTOR

NEAREST = 6  # Gaussians that change one interaction
SIZE = 0.75  # standard deviation of a Gaussian in the plane, as a share of the spacing
EXTENT = 4.0  # distance in standard deviations beyond which a Gaussian does not count: its weight is below 4e-4
LEAST_POINTS = 4  # fewest interactions of training paths in a cell of the lattice that gets a Gaussian
SAME_PLANE_M, SAME_PLANE_COS = 0.03, 0.99  # most distance, least cosine of a plane that scans find twice


class Interactions(NamedTuple):
    """Interactions of paths with surfaces."""

    position_m: FloatArray  # points [m, 3], world frame, metres
    normal: FloatArray  # unit normals of the planes, either sign, [m, 3]


@dataclass(frozen=True)
class SurfaceGaussians:
    """Flat Gaussians on surfaces."""

    discs: FloatArray  # centres in metres and unit normals (`DISC`), [6, g]
    size_m: float  # standard deviation s in the plane, metres

    def __len__(self) -> int:
        return self.discs.shape[1]

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.discs[:3].T)

    @classmethod
    def covering(cls, met: Interactions, spacing_m: float) -> SurfaceGaussians:
        """Gaussians at the means of interactions in the cells of a lattice of ``spacing_m`` in each plane."""
        # A cell: a square of the plane, and within tolerances its offset and normal.
        offset = (met.position_m * met.normal).sum(axis=1)
        cell = np.round((met.position_m - offset[:, None] * met.normal) / spacing_m)
        rows = np.column_stack([cell, np.round(offset / SAME_PLANE_M), np.round(met.normal / (1 - SAME_PLANE_COS))])
        _, group, count = np.unique(rows.astype(np.int64), axis=0, return_inverse=True, return_counts=True)
        values = np.column_stack([met.position_m, met.normal]).T
        sums = np.stack([np.bincount(group.reshape(-1), row, len(count)) for row in values])
        discs = (sums / count)[:, count >= LEAST_POINTS]
        discs[3:] /= np.linalg.norm(discs[3:], axis=0)
        # As a run stores them: a resumed fit has the same weights.
        return cls(discs.astype(np.float32).astype(float), SIZE * spacing_m)

    def near(self, met: Interactions) -> tuple[IntArray, FloatArray]:
        """Numbers of the nearest Gaussians of each interaction [m, NEAREST], and their weights w_g, 0 for none."""
        index = np.zeros((len(met.position_m), NEAREST), np.int64)
        weight = np.zeros(index.shape)
        if not len(met.position_m) or not len(self):
            return index, weight
        # Twice as many neighbours as needed, as those of other planes do not count.
        count = min(2 * NEAREST, len(self))
        ranks = np.arange(1, count + 1)
        distance, neighbour = self._tree.query(met.position_m, ranks, distance_upper_bound=EXTENT * self.size_m)
        exists = neighbour < len(self)  # SciPy fills up with the number of points
        neighbour = np.where(exists, neighbour, 0)
        normal = self.discs[3:].T[neighbour]
        # Only Gaussians of the interaction's plane count, which scans may have twice.
        away = np.abs(((met.position_m[:, None] - self.discs[:3].T[neighbour]) * normal).sum(axis=-1))
        turned = np.abs((met.normal[:, None] * normal).sum(axis=-1))
        same = exists & (away < SAME_PLANE_M) & (turned > SAME_PLANE_COS)
        weights = np.where(same, np.exp(-0.5 * np.square(np.where(exists, distance, 0) / self.size_m)), 0)
        order = np.argsort(-weights, axis=1, kind="stable")[:, :NEAREST]
        index[:, : order.shape[1]] = np.take_along_axis(neighbour, order, axis=1)
        weight[:, : order.shape[1]] = np.take_along_axis(weights, order, axis=1)
        return index, weight

    def parameters(self) -> dict[str, NDArray[np.float32]]:
        """Parameters of Gaussians that change nothing: `FACTOR` and `DISC`."""
        return {FACTOR: np.zeros((2, len(self)), np.float32), DISC: self.discs.astype(np.float32)}

    @classmethod
    def of(cls, parameters: Mapping[str, NDArray[Any]], spacing_m: float) -> SurfaceGaussians | None:
        """The Gaussians of parameters; None where these have none."""
        return cls(np.asarray(parameters[DISC], float), SIZE * spacing_m) if DISC in parameters else None


@dataclass
class PathWeights:
    """Weights of surface Gaussians for q paths, on the device."""

    index: Any  # numbers of Gaussians, `each` for a path in turn, [q * each]
    weight: Any  # their weights w_g, [q * each]
    each: int  # largest number of Gaussians of a path

    @classmethod
    def of(cls, gaussians: SurfaceGaussians, met: Interactions, path: IntArray, count: int) -> PathWeights:
        """Weights of ``count`` paths, of which ``path`` [m] have the interactions, in ascending order."""
        index, weight = gaussians.near(met)
        place = np.arange(len(path)) - np.searchsorted(path, path)  # number of an interaction along its path
        depth = int(place.max(initial=0)) + 1
        indices, weights = np.zeros((count, depth, NEAREST), np.int64), np.zeros((count, depth, NEAREST))
        indices[path, place], weights[path, place] = index, weight
        return cls(on_device(indices, mi.UInt32), on_device(weights, Float64), depth * NEAREST)

    def factor(self, factors: Any, paths: Any | None = None) -> Complex:
        """Complex factor of the gain of each path, or of the paths ``paths``, for `FACTOR` [2, g]. Differentiable."""
        index, weight = self.index, self.weight
        if paths is not None:
            slot = dr.arange(mi.UInt32, dr.width(paths) * self.each)
            entry = dr.gather(mi.UInt32, paths, slot // self.each) * self.each + slot % self.each
            index, weight = dr.gather(mi.UInt32, index, entry), dr.gather(Float64, weight, entry)
        flat, count = factors.array, factors.shape[1]
        values = (Float64(dr.gather(type(flat), flat, index + part * count)) for part in (0, 1))
        return complex_exponential(*(dr.block_reduce(dr.ReduceOp.Add, weight * x, self.each) for x in values))
