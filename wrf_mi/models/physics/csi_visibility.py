"""Where image sources are seen from: outlines moved, and what hides or mirrors learned from paths that are known.

The scene tells how far each path is from being cut off. Its outlines are centimetres off and small things are missing,
so the outlines' edges are moved, and logistic regression learns from the paths of the training rows which parts of the
room are in the way (cells that a path crosses), which parts of a plane mirror (cells it is mirrored in) and from where
each image is seen (cells of the position). Cells of several sizes with a common ridge penalty are a Gaussian process
whose covariance is the number of shared cells.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.optimize import minimize
from scipy.special import expit, log_ndtr, logit

from ...core.angles import FloatArray
from ...core.types import IntArray
from ...tracing.walls import Walls
from .csi_paths import Images, Seen

ROOM_CELLS_M = (0.6, 0.3, 0.15)
PLANE_CELLS_M = (0.6, 0.3, 0.15)
VIEW_CELLS_M = (1.6, 0.8, 0.4)
SHIFTS = 2
"""Grids of each size, shifted at random: borders of cells show less."""
SAMPLE_M = 0.05
ROOM, PLANE, VIEW = 1.0, 0.5, 0.5
"""What each kind of cell may contribute, relative to each other."""
SOFT_M = 0.01
"""Width of an edge once it is where it is."""
MARGINS_M = (0.004, 0.012, 0.04, 0.12)
"""Scales on which the margins count."""
MOST = 0.995
"""Highest probability that margins alone may give, and its counterpart the lowest."""
REGRESSION = {"maxiter": 60, "ftol": 1e-6}
"""Of one round; the next one goes on."""
KEY = 1 << 12
"""Cells along an axis."""


def prior_odds(seen: Seen, outline_sd_m: float) -> FloatArray:
    """Logarithm of the odds that paths are there, from their margins alone."""
    log = log_ndtr(np.minimum(seen.inside_m / outline_sd_m, 30)) + log_ndtr(np.minimum(seen.clear_m / outline_sd_m, 30))
    return np.asarray(logit(1 - MOST + (2 * MOST - 1) * np.exp(log)))


@dataclass(frozen=True)
class Cells:
    """Cells that paths touch: path, cell and how much."""

    path: IntArray
    key: IntArray
    value: FloatArray


@dataclass(frozen=True)
class Visibility:
    """A fitted model of visibility.

    Attributes:
        edge_m: how far each edge of an outline moves outwards [e].
        margin: weights of the functions of the margins [1 + 2 * scales].
        key: of the cells, ascending [c].
        weight: of each cell [c].
        outline_sd_m: see `prior_odds`.
        seed: of the grids' shifts.
    """

    edge_m: FloatArray
    margin: FloatArray
    key: IntArray
    weight: FloatArray
    outline_sd_m: float
    seed: int

    @classmethod
    def of_scene(cls, edges: int, outline_sd_m: float, seed: int) -> Visibility:
        """What the scene alone tells."""
        margin, key = np.zeros(1 + 2 * len(MARGINS_M)), np.zeros(0, np.int64)
        return cls(np.zeros(edges), margin, key, np.zeros(0), outline_sd_m, seed)

    def log_odds(self, walls: Walls, images: Images, seen: Seen) -> FloatArray:
        """Logarithm of the odds that paths are there."""
        cells = path_cells(walls, images, seen, self.seed)
        value = np.zeros(len(seen))
        if len(self.key):
            place = np.minimum(np.searchsorted(self.key, cells.key), len(self.key) - 1)
            known = self.key[place] == cells.key
            own, share = cells.path[known], cells.value[known] * self.weight[place[known]]
            value = np.asarray(np.bincount(own, share, minlength=len(seen)), float)
        moved = with_edges(seen, self.edge_m)
        return prior_odds(moved, self.outline_sd_m) + _margins(moved) @ self.margin + value


def with_edges(seen: Seen, edge_m: FloatArray) -> Seen:
    """Margins once the edges have moved."""
    change = np.append(edge_m, 0.0)
    return replace(
        seen,
        inside_m=seen.inside_m + change[seen.inside_edge],
        clear_m=seen.clear_m - change[seen.clear_edge],
    )


class Learner:
    """Fits `Visibility` to the same paths again and again, each time from where it was.

    Args:
        walls: the planes.
        images: image sources.
        seen: paths [p].
        outline_sd_m: by how much the scene's outlines are off.
        ridge: penalty of the cells' weights.
        seed: of the grids' shifts and of the folds.
        folds: of the rows, 2 at least.
    """

    def __init__(
        self, walls: Walls, images: Images, seen: Seen, *, outline_sd_m: float, ridge: float, seed: int, folds: int
    ) -> None:
        cells = path_cells(walls, images, seen, seed)
        self._key, column = np.unique(cells.key, return_inverse=True)
        shape = len(seen), len(self._key)
        self._matrix = sparse.csr_matrix((cells.value, (cells.path, column.reshape(-1))), shape=shape)
        self._across = self._matrix.T.tocsr()
        self._seen, self._edges = seen, len(walls.edge_m)
        self._outline_sd_m, self._ridge, self._seed = outline_sd_m, ridge, seed
        count = int(seen.row.max(initial=-1)) + 1
        self._fold = np.random.default_rng([seed, 7]).integers(folds, size=count)[seen.row]
        # One for each fold, and the last for all paths.
        self._found = [np.zeros(1 + 2 * len(MARGINS_M) + len(self._key)) for _ in range(folds + 1)]

    def fit(self, there: FloatArray, trust: FloatArray) -> tuple[Visibility, FloatArray]:
        """Fit to probabilities of paths [p], each of a weight [p].

        Returns:
            The model, and log odds [p] by models that were fitted without the fold that the path's row is in.
        """
        edge = _fit_edges(self._seen, there, trust, self._edges, self._outline_sd_m)
        moved = with_edges(self._seen, edge)
        base, margins = prior_odds(moved, self._outline_sd_m), _margins(moved)
        left_out, last = base.copy(), len(self._found) - 1
        for number in range(len(self._found)):
            own = self._fold == number
            x = self._regress(base, margins, there, np.where(own, 0.0, trust), self._found[number])
            self._found[number] = x
            if number < last:
                count = margins.shape[1]
                left_out[own] += margins[own] @ x[:count] + (self._matrix @ x[count:])[own]
        margin, weight = np.split(self._found[last], [margins.shape[1]])
        return Visibility(edge, margin, self._key, weight, self._outline_sd_m, self._seed), left_out

    def _regress(
        self, base: FloatArray, margins: FloatArray, there: FloatArray, trust: FloatArray, start: FloatArray
    ) -> FloatArray:
        """Weights of margins and cells, logistic regression with a ridge penalty."""
        count = margins.shape[1]

        def loss(x: FloatArray) -> tuple[float, FloatArray]:
            z = base + margins @ x[:count] + self._matrix @ x[count:]
            slope = trust * (expit(z) - there)
            value = (trust * (np.logaddexp(0, z) - there * z)).sum() + 0.5 * self._ridge * (x @ x)
            return float(value), np.concatenate([margins.T @ slope, self._across @ slope]) + self._ridge * x

        return np.asarray(minimize(loss, start, jac=True, method="L-BFGS-B", options=REGRESSION).x)


def _margins(seen: Seen) -> FloatArray:
    """Functions of the margins [p, 1 + 2 * scales]."""
    parts = [np.ones(len(seen))]
    for scale in MARGINS_M:
        parts += [np.tanh(np.minimum(seen.inside_m, 10) / scale), np.tanh(seen.clear_m / scale)]
    return np.stack(parts, axis=1)


def _fit_edges(seen: Seen, there: FloatArray, trust: FloatArray, count: int, sd_m: float) -> FloatArray:
    """How far edges move, a normal distribution of ``sd_m`` beforehand."""
    least = 1 - MOST

    def loss(edge: FloatArray) -> tuple[float, FloatArray]:
        moved = with_edges(seen, edge)
        z = [np.minimum(part / SOFT_M, 30) for part in (moved.inside_m, moved.clear_m)]
        through = (1 - 2 * least) * np.exp(log_ndtr(z[0]) + log_ndtr(z[1]))
        p = least + through
        value = -(trust * (there * np.log(p) + (1 - there) * np.log1p(-p))).sum()
        slope = -trust * (there / p - (1 - there) / (1 - p)) * through
        density = [np.exp(-0.5 * part**2 - log_ndtr(part)) / np.sqrt(2 * np.pi) / SOFT_M for part in z]
        gradient = np.zeros(count + 1)  # the last one stands for no edge
        np.add.at(gradient, seen.inside_edge, slope * density[0])
        np.add.at(gradient, seen.clear_edge, -slope * density[1])
        return float(value + 0.5 * np.square(edge / sd_m).sum()), gradient[:count] + edge / sd_m**2

    found = minimize(loss, np.zeros(count), jac=True, method="L-BFGS-B", options={"maxiter": 80})
    edge: FloatArray = np.asarray(found.x, float)
    return edge


def path_cells(walls: Walls, images: Images, seen: Seen, seed: int) -> Cells:
    """Cells of the room, of the planes and of the views that paths touch."""
    parts = list(_cells(walls, images, seen, np.random.default_rng([seed, 11])))
    path, key, value = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Cells(path, key, value)


def _cells(
    walls: Walls, images: Images, seen: Seen, rng: np.random.Generator
) -> Iterator[tuple[IntArray, IntArray, FloatArray]]:
    plane = images.plane[seen.chain]
    path, along, length = _samples(seen.point_m)
    last = np.arange(len(seen)), seen.chain, seen.point_m[:, -1]
    first = np.flatnonzero(plane[:, 0] >= 0) if plane.shape[1] else np.zeros(0, np.int64)
    root, grid = np.sqrt(SHIFTS), 0
    for _ in range(SHIFTS):
        for size in ROOM_CELLS_M:
            key = _key(grid, np.zeros(len(path), np.int64), along / size + rng.random(3))
            yield path, key, length * (ROOM / root / np.sqrt(size))
            grid += 1
        for size in PLANE_CELLS_M:
            shift = rng.random(2)
            for level in range(plane.shape[1]):
                use = np.flatnonzero(plane[:, level] >= 0)
                flat = walls.flat(plane[use, level], seen.point_m[use, 1 + level])
                yield use, _key(grid, plane[use, level], flat / size + shift), np.full(len(use), PLANE / root)
            grid += 1
        for size in VIEW_CELLS_M:
            shift = rng.random(3)
            for use, chain, point in (last, (first, seen.chain[first], seen.point_m[first, 1])):
                yield use, _key(grid, chain, point / size + shift), np.full(len(use), VIEW / root)
                grid += 1


def _samples(point_m: FloatArray) -> tuple[IntArray, FloatArray, FloatArray]:
    """Points along paths [p, b + 2, 3]: path of each, place, and the length that it stands for."""
    parts = []
    for leg in range(point_m.shape[1] - 1):
        start, way = point_m[:, leg], point_m[:, leg + 1] - point_m[:, leg]
        length = np.linalg.norm(way, axis=1)
        count = np.ceil(length / SAMPLE_M).astype(np.int64)
        path = np.repeat(np.arange(len(start)), count)
        number = np.arange(len(path)) - np.repeat(np.cumsum(count) - count, count)
        share = (number + 0.5) / count[path]
        parts.append((path, start[path] + way[path] * share[:, None], length[path] / count[path]))
    path, place, value = (np.concatenate(column) for column in zip(*parts, strict=True))
    return path, place, value


def _key(grid: int, thing: IntArray, place: FloatArray) -> IntArray:
    """One number for a cell of a grid and of a thing; places beyond the grid fall together at its border."""
    cell = np.clip(np.floor(place).astype(np.int64) + KEY // 2, 0, KEY - 1)
    key = grid + 64 * thing.astype(np.int64)
    for axis in range(cell.shape[1]):
        key = key * KEY + cell[:, axis]
    return key
