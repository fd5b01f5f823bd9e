"""Visibility of image sources: outlines are moved, and obstacles and missing parts of mirrors are learned from paths.

The scene's outlines are centimetres off and small objects are missing. So the outlines' edges are moved, and logistic
regression learns from the paths of the training rows which parts of the room obstruct (cells that a path crosses),
which parts of a plane mirror (cells it is mirrored in) and from where each image is visible (cells of the position).
Cells of several sizes with a common ridge penalty are a Gaussian process: the covariance is the number of shared cells.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.optimize import minimize
from scipy.special import expit, log_ndtr, logit

from ...core.angles import FloatArray
from ...core.types import IntArray
from ...tracing.walls import Walls
from .csi_paths import CandidatePaths, Images

ROOM_CELLS_M = (0.6, 0.3, 0.15)
PLANE_CELLS_M = (0.6, 0.3, 0.15)
VIEW_CELLS_M = (1.6, 0.8, 0.4)
SHIFTS = 2
"""Grids of each size with random shifts, which soften the borders of cells."""
SAMPLE_M = 0.05
ROOM, PLANE, VIEW = 1.0, 0.5, 0.5
"""Prior standard deviations of the kinds of cells, relative to each other."""
SOFT_M = 0.01
"""Width of an edge while edges are fitted."""
MARGINS_M = (0.004, 0.012, 0.04, 0.12)
"""Scales of the functions of the margins."""
MOST = 0.995
"""Highest probability that margins alone may give; the lowest is its complement."""
REGRESSION = {"maxiter": 60, "ftol": 1e-6}
"""Options of L-BFGS in one round; the next round starts from its result."""
KEY = 1 << 12
"""Cells along an axis."""


def prior_odds(paths: CandidatePaths, outline_sd_m: float) -> FloatArray:
    """Logarithm of the odds that paths exist, from their margins alone."""
    inside, clear = (log_ndtr(np.minimum(margin / outline_sd_m, 30)) for margin in (paths.inside_m, paths.clear_m))
    return np.asarray(logit(1 - MOST + (2 * MOST - 1) * np.exp(inside + clear)))


@dataclass(frozen=True)
class Visibility:
    """A fitted model of visibility.

    Attributes:
        edge_m: outward displacement of each edge of an outline [e].
        margin: weights of the functions of the margins [1 + 2 * scales].
        key, weight: ascending keys and weights of the cells [c].
        outline_sd_m, seed: standard deviation of the outlines, and seed of the grids' shifts.
    """

    edge_m: FloatArray
    margin: FloatArray
    key: IntArray
    weight: FloatArray
    outline_sd_m: float
    seed: int

    def log_odds(self, walls: Walls, images: Images, paths: CandidatePaths) -> FloatArray:
        """Logarithm of the odds that paths exist."""
        path, cell, value = path_cells(walls, images, paths, self.seed)
        odds = np.zeros(len(paths))
        if len(self.key):
            index = np.minimum(np.searchsorted(self.key, cell), len(self.key) - 1)
            known = self.key[index] == cell
            value = value[known] * self.weight[index[known]]
            odds = np.bincount(path[known], value, minlength=len(paths)).astype(float)
        moved = _with_edges(paths, self.edge_m)
        return prior_odds(moved, self.outline_sd_m) + _margins(moved) @ self.margin + odds


def _with_edges(paths: CandidatePaths, edge_m: FloatArray) -> CandidatePaths:
    """The paths with margins after a displacement of the edges."""
    change = np.append(edge_m, 0.0)  # the last stands for no edge
    inside, clear = paths.inside_m + change[paths.inside_edge], paths.clear_m - change[paths.clear_edge]
    return replace(paths, inside_m=inside, clear_m=clear)


class Learner:
    """Fits `Visibility` repeatedly to the same paths, each time from the last result.

    The settings are those of `wrf_mi.models.physics.csi_fit.CsiSettings`; ``seed`` is that of grids and folds.
    """

    def __init__(
        self, walls: Walls, images: Images, paths: CandidatePaths, sd_m: float, ridge: float, seed: int, folds: int
    ) -> None:
        path, cell, value = path_cells(walls, images, paths, seed)
        self._key, column = np.unique(cell, return_inverse=True)
        shape = len(paths), len(self._key)
        self._matrix = sparse.csr_matrix((value, (path, column.reshape(-1))), shape=shape)
        self._across = self._matrix.T.tocsr()
        self._paths, self._edges = paths, len(walls.edge_m)
        self._outline_sd_m, self._ridge, self._seed = sd_m, ridge, seed
        count = int(paths.row.max(initial=-1)) + 1
        self._fold = np.random.default_rng([seed, 7]).integers(folds, size=count)[paths.row]
        # Weights without each fold, and last those of all paths.
        self._found = [np.zeros(1 + 2 * len(MARGINS_M) + len(self._key)) for _ in range(folds + 1)]

    def fit(self, probability: FloatArray, trust: FloatArray) -> tuple[Visibility, FloatArray]:
        """Fit to probabilities of paths [p] with weights ``trust`` [p].

        Returns:
            The model, and log odds [p] by models that were fitted without the fold of the path's row.
        """
        edge = _fit_edges(self._paths, probability, trust, self._edges, self._outline_sd_m)
        moved = _with_edges(self._paths, edge)
        base, margins = prior_odds(moved, self._outline_sd_m), _margins(moved)
        left_out, last = base.copy(), len(self._found) - 1
        for number in range(len(self._found)):
            out = self._fold == number
            x = self._regress(base, margins, probability, np.where(out, 0.0, trust), self._found[number])
            self._found[number] = x
            if number < last:
                count = margins.shape[1]
                left_out[out] += margins[out] @ x[:count] + (self._matrix @ x[count:])[out]
        margin, weight = np.split(self._found[last], [margins.shape[1]])
        return Visibility(edge, margin, self._key, weight, self._outline_sd_m, self._seed), left_out

    def _regress(
        self, base: FloatArray, margins: FloatArray, probability: FloatArray, trust: FloatArray, start: FloatArray
    ) -> FloatArray:
        """Weights of margins and cells, logistic regression with a ridge penalty."""
        count = margins.shape[1]

        def loss(x: FloatArray) -> tuple[float, FloatArray]:
            z = base + margins @ x[:count] + self._matrix @ x[count:]
            slope = trust * (expit(z) - probability)
            value = (trust * (np.logaddexp(0, z) - probability * z)).sum() + 0.5 * self._ridge * (x @ x)
            return float(value), np.concatenate([margins.T @ slope, self._across @ slope]) + self._ridge * x

        return np.asarray(minimize(loss, start, jac=True, method="L-BFGS-B", options=REGRESSION).x)


def _margins(paths: CandidatePaths) -> FloatArray:
    """Functions of the margins [p, 1 + 2 * scales]."""
    columns = [np.ones(len(paths))]
    for scale in MARGINS_M:
        columns += [np.tanh(np.minimum(paths.inside_m, 10) / scale), np.tanh(paths.clear_m / scale)]
    return np.stack(columns, axis=1)


def _fit_edges(
    paths: CandidatePaths, probability: FloatArray, trust: FloatArray, count: int, sd_m: float
) -> FloatArray:
    """Displacements of the edges, whose prior is normal with standard deviation ``sd_m``."""
    least = 1 - MOST

    def loss(edge: FloatArray) -> tuple[float, FloatArray]:
        moved = _with_edges(paths, edge)
        z = [np.minimum(part / SOFT_M, 30) for part in (moved.inside_m, moved.clear_m)]
        through = (1 - 2 * least) * np.exp(log_ndtr(z[0]) + log_ndtr(z[1]))
        p = least + through
        value = -(trust * (probability * np.log(p) + (1 - probability) * np.log1p(-p))).sum()
        slope = -trust * (probability / p - (1 - probability) / (1 - p)) * through
        density = [np.exp(-0.5 * part**2 - log_ndtr(part)) / np.sqrt(2 * np.pi) / SOFT_M for part in z]
        gradient = np.zeros(count + 1)  # the last stands for no edge
        np.add.at(gradient, paths.inside_edge, slope * density[0])
        np.add.at(gradient, paths.clear_edge, -slope * density[1])
        return float(value + 0.5 * np.square(edge / sd_m).sum()), gradient[:count] + edge / sd_m**2

    found = minimize(loss, np.zeros(count), jac=True, method="L-BFGS-B", options={"maxiter": 80})
    return np.asarray(found.x, float)


def path_cells(walls: Walls, images: Images, paths: CandidatePaths, seed: int) -> tuple[IntArray, IntArray, FloatArray]:
    """Cells of the room, the planes and the views that paths touch: path, key of the cell and value, [k] each."""
    rng, parts = np.random.default_rng([seed, 11]), []
    plane, every = images.plane[paths.chain], np.arange(len(paths))
    path, along, length = _samples(paths.point_m)
    first = np.flatnonzero(plane[:, 0] >= 0) if plane.shape[1] else np.zeros(0, np.int64)
    views = ((every, paths.chain, paths.point_m[:, -1]), (first, paths.chain[first], paths.point_m[first, 1]))
    root, grid = np.sqrt(SHIFTS), 0
    for _ in range(SHIFTS):
        for size in ROOM_CELLS_M:
            key = _key(grid, np.zeros(len(path), np.int64), along / size + rng.random(3))
            parts.append((path, key, length * (ROOM / root / np.sqrt(size))))
            grid += 1
        for size in PLANE_CELLS_M:
            shift = rng.random(2)
            for level in range(plane.shape[1]):
                use = np.flatnonzero(plane[:, level] >= 0)
                flat = walls.flat(plane[use, level], paths.point_m[use, 1 + level])
                parts.append((use, _key(grid, plane[use, level], flat / size + shift), np.full(len(use), PLANE / root)))
            grid += 1
        for size in VIEW_CELLS_M:
            shift = rng.random(3)
            for use, chain, point in views:
                parts.append((use, _key(grid, chain, point / size + shift), np.full(len(use), VIEW / root)))
                grid += 1
    path, key, value = (np.concatenate(column) for column in zip(*parts, strict=True))
    return path, key, value


def _samples(point_m: FloatArray) -> tuple[IntArray, FloatArray, FloatArray]:
    """Points along paths [p, b + 2, 3]: path, position, and length of the sampled segment."""
    parts = []
    for leg in range(point_m.shape[1] - 1):
        start, way = point_m[:, leg], point_m[:, leg + 1] - point_m[:, leg]
        length = np.linalg.norm(way, axis=1)
        count = np.ceil(length / SAMPLE_M).astype(np.int64)
        path = np.repeat(np.arange(len(start)), count)
        number = np.arange(len(path)) - np.repeat(np.cumsum(count) - count, count)
        share = (number + 0.5) / count[path]
        parts.append((path, start[path] + way[path] * share[:, None], length[path] / count[path]))
    path, point, value = (np.concatenate(column) for column in zip(*parts, strict=True))
    return path, point, value


def _key(grid: int, item: IntArray, position: FloatArray) -> IntArray:
    """Key of the cell of a grid and an item at a position in cells; positions beyond the grid count to its border."""
    cell = np.clip(np.floor(position).astype(np.int64) + KEY // 2, 0, KEY - 1)
    key = grid + 64 * item.astype(np.int64)
    for axis in range(cell.shape[1]):
        key = key * KEY + cell[:, axis]
    return key
