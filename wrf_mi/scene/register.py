"""Rigid registration of a scene to another frame: by pairs of points, or by fitting what it shows to known walls."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from ..core import InputError
from ..core.angles import FloatArray
from ..core.files import text_lines
from .plan_lines import rotation_2d
from .register_search import NEAR_M, SAMPLE_M, best_scale, distance_to_walls, find_poses, moved, sample_walls
from .surfaces import Surface

LEAST_AGREEMENT = 0.5
"""A fit is refused below it. Furnished flats seen by a robot reach 0.53 to 0.58, rooms of a wrong size 0.4 to 0.5."""
CLEAR_LEAD = 0.03
"""The best fit has to agree by this share more than any other, or the walls do not tell which is right."""
LARGEST_RMS_M = 0.3
"""Pairs that disagree by more are no pairs."""
SPREAD = 0.05
"""Pairs whose second extent is below this share of the first lie on a line."""
SMALLEST_EXTENT_M = 0.1
"""Pairs that lie closer together tell no rotation."""
SAME_M = 0.3
"""Poses that bring the scene's points to places this near, rms, are one."""
MOST_POINTS = 1500
"""More points on walls are thinned: they would only cost time."""


@dataclass(frozen=True)
class Registration:
    """A rigid motion to another frame and how well it fits.

    Attributes:
        matrix: shape [4, 4], applied to columns (x, y, z, 1) in metres.
        rms_m: of the residuals; of a fit to walls, of the points that agree.
        median_m: of all residuals.
        share: of the points within `NEAR_M` of a wall; 1 for pairs.
        agreement: how much of the scene lies at walls and how many of the walls it shows, mean of both, each point
            weighted by exp(-(d / 0.1 m)^2 / 2); 1 for pairs.
        count: pairs, or points.
        scale: what the source's lengths would have to be multiplied by to fit best; far from 1, the units or the
            resolution are wrong. It is not in the matrix.
    """

    matrix: FloatArray
    rms_m: float
    median_m: float
    share: float
    agreement: float
    count: int
    scale: float

    def apply(self, points_m: ArrayLike) -> FloatArray:
        """Points [..., 2] or [..., 3] in the target's frame; two coordinates are taken at z = 0 and stay two."""
        points = np.asarray(points_m, float)
        n = points.shape[-1]
        return np.asarray(points @ self.matrix[:n, :n].T + self.matrix[:n, 3])


def _motion(rotation: FloatArray, shift: FloatArray) -> FloatArray:
    """Matrix [4, 4] of a rotation [n, n] and a shift [n], n = 2 or 3."""
    n = len(shift)
    matrix = np.eye(4)
    matrix[:n, :n], matrix[:n, 3] = rotation, shift
    return matrix


def read_pairs(path: str | Path) -> tuple[FloatArray, FloatArray]:
    """Pairs of points from a CSV file: ``x,y,z,to_x,to_y,to_z`` or ``x,y,to_x,to_y`` in metres.

    Returns:
        Points in the scene's frame and the same in the target's, shapes [n, 2] or [n, 3].

    Raises:
        InputError: wrong header or a row without as many numbers.
    """
    path = Path(path)
    rows = list(csv.reader(text_lines(path)))
    header = [word.strip().lower() for word in rows[0]] if rows else []
    n = len(header) // 2
    if header not in (["x", "y", "to_x", "to_y"], ["x", "y", "z", "to_x", "to_y", "to_z"]):
        raise InputError(f"{path}: line 1: the header is neither x,y,z,to_x,to_y,to_z nor x,y,to_x,to_y")
    values = []
    for number, row in enumerate(rows[1:], 2):
        try:
            values.append([float(word) for word in row])
            if len(row) != 2 * n or not np.isfinite(values[-1]).all():
                raise ValueError
        except ValueError:
            raise InputError(f"{path}: line {number}: expected {2 * n} numbers, found {','.join(row)!r}") from None
    table = np.array(values, float).reshape(-1, 2 * n)
    return table[:, :n], table[:, n:]


def register_pairs(
    source_m: ArrayLike, target_m: ArrayLike, largest_rms_m: float = LARGEST_RMS_M, name: str = "pairs"
) -> Registration:
    """The rotation and shift that bring points to their partners with the least squared error (Kabsch 1976).

    Args:
        source_m: shape [n, 2] (turned about z alone) or [n, 3].
        target_m: same shape.
        largest_rms_m: pairs that fit worse are refused.
        name: of the pairs, for errors.

    Raises:
        InputError: too few pairs, pairs that lie on a point or (in 3D) a line, or a bad fit.
    """
    source, target = np.asarray(source_m, float), np.asarray(target_m, float)
    if source.shape != target.shape or source.ndim != 2 or source.shape[1] not in (2, 3):
        raise InputError(
            f"{name}: points of shapes {source.shape} and {target.shape} are no pairs; give [n, 2] or [n, 3] each"
        )
    n, dimension = source.shape
    if n < dimension:
        raise InputError(f"{name}: {n} pairs; give at least {dimension}, well apart")
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    extent = min((np.linalg.svd(v, compute_uv=False) for v in (a, b)), key=lambda s: s[0])
    if extent[0] < SMALLEST_EXTENT_M or (dimension == 3 and extent[1] < SPREAD * extent[0]):
        where = "at one place" if extent[0] < SMALLEST_EXTENT_M else "on one line"
        raise InputError(f"{name}: all pairs lie {where}, so the rotation is open; add a pair away from it")
    if dimension == 3:
        rotation = Rotation.align_vectors(b, a)[0].as_matrix()
    else:
        rotation = rotation_2d(np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum()))
    shift = target.mean(axis=0) - rotation @ source.mean(axis=0)
    error = np.linalg.norm(source @ rotation.T + shift - target, axis=1)
    scale = float((b * (a @ rotation.T)).sum() / (a * a).sum())
    rms = float(np.sqrt(np.mean(error**2)))
    if rms > largest_rms_m:
        text = f"{name}: the pairs disagree by {rms:.2f} m rms (at most {largest_rms_m} m), "
        text += f"pair {int(np.argmax(error)) + 1} by {error.max():.2f} m"
        scaled = float(np.sqrt(np.mean(((scale * a @ rotation.T - b) ** 2).sum(axis=1))))
        if scaled < rms / 2:
            better = f"lengths times {scale:.3f} would fit better ({scaled:.2f} m rms)"
            raise InputError(f"{text}; {better}: check units and resolution")
        raise InputError(f"{text}: check this pair and the axes")
    return Registration(_motion(rotation, shift), rms, float(np.median(error)), 1.0, 1.0, n, scale)


def wall_points(surfaces: Sequence[Surface], step_m: float = SAMPLE_M) -> FloatArray:
    """Points [n, 2] along the walls of surfaces as seen from above, the same number for each metre of wall."""
    pieces: list[FloatArray] = []
    for surface in surfaces:
        if surface.kind != "wall":
            continue
        xy = surface.vertices_m[:, :2]
        middle = xy.mean(axis=0)
        along = np.linalg.svd(xy - middle, full_matrices=False)[2][0]
        reach = (xy - middle) @ along
        pieces.append(np.stack([middle + reach.min() * along, middle + reach.max() * along]))
    if not pieces:
        raise InputError("registration to walls: the scene has no wall; register by pairs of points")
    return sample_walls(np.array(pieces), step_m)


def best_motion(points_m: FloatArray, walls_m: FloatArray) -> FloatArray:
    """The turn about z and shift [4, 4] in which points [n, 2] fit walls [m, 2, 2] best, however badly."""
    pose = find_poses(_thinned(points_m), walls_m)[0].pose
    return _motion(rotation_2d(pose[2]), pose[:2])


def _thinned(points_m: FloatArray) -> FloatArray:
    return points_m[:: -(-len(points_m) // MOST_POINTS)]


def register_walls(points_m: ArrayLike, walls_m: ArrayLike, name: str = "scene") -> Registration:
    """The turn about z and shift that lay a scene's walls on known walls.

    Turns all around start it, each with the shifts where both plans correlate best; every start is refined by robust
    least squares over the points' distances from the walls (point-to-line ICP with a Cauchy loss: Fitzgibbon 2003), and
    the one where most points and walls agree is taken.

    Args:
        points_m: points on the scene's walls [n, 2] or [n, 3] (z is ignored), evenly spread: `wall_points`.
        walls_m: end points of known walls [m, 2, 2] in the target's frame; `wall_points` may miss some and show others.
        name: of the scene, for errors.

    Raises:
        InputError: too few points agree, another pose fits as well, or the mirror image fits better.
    """
    points, walls = np.asarray(points_m, float)[:, :2], np.asarray(walls_m, float)
    if len(points) < 3 or not len(walls):
        raise InputError(f"{name}: registration to walls needs points and walls, got {len(points)} and {len(walls)}")
    points = _thinned(points)
    fits = find_poses(points, walls)
    best = fits[0]
    residual = distance_to_walls(moved(points, best.pose), walls)
    near = residual[residual <= NEAR_M]
    share = len(near) / len(residual)
    mirrored = find_poses(points * [-1, 1], walls)[0]
    if mirrored.score > max(best.score + CLEAR_LEAD, LEAST_AGREEMENT):
        raise InputError(
            f"{name}: its mirror image fits the walls better (agreement {mirrored.score:.2f}, not {best.score:.2f}); "
            "flip a picture upside down, give the other row_0 of an NPZ grid (--row-0), or change the sign of one axis"
        )
    if best.score < LEAST_AGREEMENT:
        scale, agreement = best_scale(points, best, walls)
        text = f"{name}: it does not fit the walls: agreement {best.score:.2f} (at least {LEAST_AGREEMENT}), "
        text += f"{share:.0%} within {NEAR_M} m"
        if agreement > best.score + CLEAR_LEAD:
            better = f"lengths times {scale:.2f} would fit better (agreement {agreement:.2f})"
            raise InputError(f"{text}; {better}: check resolution and units, or give pairs")
        remedy = "check that the walls are of this place, and its units, or give pairs"
        raise InputError(f"{text}, and slightly other lengths fit no better: {remedy}")
    for other in fits[1:]:
        apart = np.linalg.norm(moved(points, best.pose) - moved(points, other.pose), axis=1)
        if np.sqrt(np.mean(apart**2)) > SAME_M and other.score > best.score - CLEAR_LEAD:
            turn = np.degrees(other.pose[2] - best.pose[2]) % 360
            raise InputError(
                f"{name}: two poses fit the walls alike, {turn:.0f} degrees apart; give pairs of points instead"
            )
    return Registration(
        _motion(rotation_2d(best.pose[2]), best.pose[:2]),
        float(np.sqrt(np.mean(near**2))),
        float(np.median(residual)),
        share,
        best.score,
        len(points),
        best_scale(points, best, walls)[0],
    )
