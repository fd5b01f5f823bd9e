"""Poses in which what a scene shows lies on known walls: a search all around, then robust least squares."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage, optimize, signal
from scipy.spatial import cKDTree

from ..core.angles import FloatArray
from ..core.types import IntArray
from .plan_lines import rotation_2d

NEAR_M = 0.2
"""A point this near to a wall agrees with it: the blur of a robot's map."""
SAMPLE_M = 0.1
"""Walls are compared at points this far apart."""
CELL_M = 0.1
"""Cells of the pictures that are correlated; in large scenes a hundredth of the radius."""
TURNS = 72
"""Turns all around that start the search: every 5 degrees."""
PEAKS = 4
"""Shifts for each turn."""
APART_CELLS, APART_RAD = 5, np.radians(12)
"""Starts that are nearer to one another lead to the same pose."""
STARTS = 12


def sample_walls(walls_m: ArrayLike, step_m: float = SAMPLE_M) -> FloatArray:
    """Points [n, 2] along walls [m, 2, 2], the middles of equal parts no longer than a step."""
    parts = []
    for begin, end in np.asarray(walls_m, float):
        count = max(1, int(np.ceil(np.linalg.norm(end - begin) / step_m)))
        parts.append(begin + (np.arange(count)[:, None] + 0.5) / count * (end - begin))
    return np.concatenate(parts)


def from_walls(points_m: FloatArray, walls_m: FloatArray) -> FloatArray:
    """The vector to each point [n, 2] from the nearest place on walls [m, 2, 2], shape [n, 2]."""
    begin, along = walls_m[:, 0], walls_m[:, 1] - walls_m[:, 0]
    offset = points_m[:, None] - begin
    part = np.clip((offset * along).sum(axis=-1) / np.maximum((along**2).sum(axis=-1), 1e-12), 0, 1)
    away = offset - part[..., None] * along
    nearest = np.argmin((away**2).sum(axis=-1), axis=1)
    return np.asarray(away[np.arange(len(away)), nearest])


def distance_to_walls(points_m: FloatArray, walls_m: FloatArray) -> FloatArray:
    """Distance of each point [n, 2] from the nearest of walls [m, 2, 2], shape [n]."""
    return np.asarray(np.linalg.norm(from_walls(points_m, walls_m), axis=-1))


@dataclass(frozen=True)
class Fit:
    """A pose (x, y, angle) and how well points and walls agree in it, 0 to 1."""

    pose: FloatArray
    score: float


def moved(points: FloatArray, pose: FloatArray) -> FloatArray:
    """Points [n, 2] in a pose (x, y, angle): turned about the origin, then shifted."""
    return points @ rotation_2d(pose[2]).T + pose[:2]


def find_poses(points: FloatArray, walls: FloatArray) -> list[Fit]:
    """Poses that fit best near each start, the best of all first.

    Args:
        points: on the scene's walls, shape [n, 2].
        walls: end points of the known walls [m, 2, 2].
    """
    middle = points.mean(axis=0)
    centred = points - middle
    targets = sample_walls(walls)
    radius = float(np.linalg.norm(centred, axis=1).max())
    cell = max(CELL_M, radius / 100)

    def misfit(pose: FloatArray) -> FloatArray:
        return distance_to_walls(moved(centred, pose), walls)

    def gradient(pose: FloatArray) -> FloatArray:
        # A distance grows along its own direction; a turn moves a point across its radius.
        turned = moved(centred, np.array([0.0, 0.0, pose[2]]))
        away = from_walls(turned + pose[:2], walls)
        unit = away / np.maximum(np.linalg.norm(away, axis=-1, keepdims=True), 1e-12)
        return np.column_stack([unit, unit[:, 1] * turned[:, 0] - unit[:, 0] * turned[:, 1]])

    fits = []
    for pose in _starts(centred, targets, cell):
        # A start is off by half a cell and half a turn's step.
        for width in (cell + radius * np.pi / TURNS, NEAR_M / 2):
            pose = optimize.least_squares(misfit, pose, gradient, loss="cauchy", f_scale=width, max_nfev=30).x
        fits.append(Fit(pose, _score(moved(centred, pose), targets, walls)))
    fits.sort(key=lambda f: -f.score)
    # The pose for the points themselves: R (x - middle) + t = R x + (t - R middle).
    return [Fit(np.append(f.pose[:2] - rotation_2d(f.pose[2]) @ middle, f.pose[2]), f.score) for f in fits]


def _score(placed: FloatArray, targets: FloatArray, walls: FloatArray) -> float:
    """How much of the scene lies at walls and how many of the walls the scene shows, the mean of both."""
    there = np.exp(-0.5 * (distance_to_walls(placed, walls) / (NEAR_M / 2)) ** 2)
    back = np.exp(-0.5 * (cKDTree(placed).query(targets)[0] / (NEAR_M / 2)) ** 2)
    return float((there.mean() + back.mean()) / 2)


def _starts(centred: FloatArray, targets: FloatArray, cell: float) -> list[FloatArray]:
    """Poses where blurred pictures of both plans correlate best, over turns all around; no two of them alike."""
    radius = float(np.linalg.norm(centred, axis=1).max()) + 2 * cell
    low = targets.min(axis=0) - 2 * radius
    shape = np.ceil((targets.max(axis=0) + 2 * radius - low) / cell).astype(int) + 1
    half = int(np.ceil(radius / cell))
    wall_image = ndimage.gaussian_filter(_image((targets - low) / cell, shape), 2.0)
    found: list[tuple[float, FloatArray]] = []
    for angle in np.arange(TURNS) * (2 * np.pi / TURNS):
        kernel = _image(centred @ rotation_2d(angle).T / cell + half, np.array([2 * half + 1] * 2))
        match = signal.fftconvolve(wall_image, kernel[::-1, ::-1], mode="same")
        for _ in range(PEAKS):
            peak = np.array(np.unravel_index(np.argmax(match), match.shape))
            found.append((float(match[tuple(peak)]), np.append(low + peak * cell, angle)))
            match[tuple(slice(max(0, p - APART_CELLS), p + APART_CELLS + 1) for p in peak)] = 0
    found.sort(key=lambda f: -f[0])
    starts: list[FloatArray] = []
    for _, pose in found:
        turn = [abs((pose[2] - s[2] + np.pi) % (2 * np.pi) - np.pi) for s in starts]
        shift = [np.linalg.norm(pose[:2] - s[:2]) for s in starts]
        if not any(t < APART_RAD and d < APART_CELLS * cell for t, d in zip(turn, shift, strict=True)):
            starts.append(pose)
        if len(starts) == STARTS:
            break
    return starts


def _image(cells: FloatArray, shape: IntArray) -> FloatArray:
    """1 in cells (x, y) that hold a point, given in units of cells, 0 elsewhere."""
    image = np.zeros(tuple(shape))
    image[tuple(np.clip(cells.astype(int), 0, shape - 1).T)] = 1.0
    return image


def best_scale(points: FloatArray, best: Fit, walls: FloatArray) -> tuple[float, float]:
    """The factor on lengths, 1/2 to 2, that fits best near a pose, and how well points and walls agree with it."""
    middle = points.mean(axis=0)

    def placed(pose_and_scale: FloatArray) -> FloatArray:
        return moved(pose_and_scale[3] * (points - middle), pose_and_scale[:3])

    def misfit(pose_and_scale: FloatArray) -> FloatArray:
        return distance_to_walls(placed(pose_and_scale), walls)

    fit = optimize.least_squares(
        misfit,
        np.append(moved(middle[None], best.pose)[0], [best.pose[2], 1.0]),
        bounds=([-np.inf] * 3 + [0.5], [np.inf] * 3 + [2.0]),
        loss="cauchy",
        f_scale=NEAR_M / 2,
        max_nfev=100,
    )
    return float(fit.x[3]), _score(placed(fit.x), sample_walls(walls), walls)
