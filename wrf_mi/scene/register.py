"""Rigid registration of a scene to another frame: by pairs of points, or by fitting its walls to known walls."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import ArrayLike
from scipy import ndimage, optimize
from scipy.spatial import cKDTree
from skimage.transform import EuclideanTransform, estimate_transform
from trimesh.transformations import planar_matrix_to_3D

from ..core import InputError
from ..core.angles import FloatArray
from ..core.types import IntArray
from ..datasets.folder_files import read_columns
from .mesh.surfaces import Surface
from .plan.lines import rotation_2d

LEAST_AGREEMENT = 0.5
"""Least agreement of a fit. Furnished flats seen by a robot reach 0.53 to 0.58, rooms of a wrong size 0.4 to 0.5."""
CLEAR_LEAD = 0.03  # least difference in agreement between the best pose and any other; with less, the pose is ambiguous
LARGEST_RMS_M = 0.3  # largest rms residual of pairs
SPREAD = 0.05  # least ratio of the second to the first extent of pairs; with less they lie on a line
SMALLEST_EXTENT_M = 0.1  # least extent of pairs; with less they determine no rotation
SAME_M = 0.3  # largest rms distance between the points in two poses that count as equal
MOST_POINTS = 1500  # points on walls are thinned to their number
NEAR_M = 0.2  # largest distance of a point that agrees with a wall: the blur of a robot's map
SAMPLE_M = 0.1  # distance of the points at which walls are compared
CELL_M = 0.1  # cells of the correlated pictures; in large scenes a hundredth of the radius
TURNS, PEAKS, STARTS = 72, 4, 12
"""Turns all around that are searched (every 5 degrees), shifts for each turn, and starts that are refined."""
APART_CELLS, APART_RAD = 5, np.radians(12)  # least difference between two starts; nearer starts lead to the same pose


def read_pairs(path: str | Path) -> tuple[FloatArray, FloatArray]:
    """Pairs of points, [n, 2] or [n, 3] in the scene's frame and in the target's, metres, from a CSV file.

    Its header is ``x,y,z,to_x,to_y,to_z`` or ``x,y,to_x,to_y``; `InputError` for another one, or a row without as many
    numbers.
    """
    table = read_columns(Path(path), "x,y,z,to_x,to_y,to_z", "x,y,to_x,to_y")
    n = table.shape[1] // 2
    return table[:, :n], table[:, n:]


def register_pairs(source_m: ArrayLike, target_m: ArrayLike, name: str = "pairs") -> FloatArray:
    """The rotation and shift [4, 4] that bring points to their partners with the least squared error (Umeyama 1991).

    Args:
        source_m: shape [n, 2] (turned about z alone) or [n, 3].
        target_m: same shape.
        name: name of the pairs, for errors.

    Raises:
        InputError: too few pairs, pairs that lie on a point or (in 3D) a line, or a bad fit.
    """
    source, target = np.asarray(source_m, float), np.asarray(target_m, float)
    if source.shape != target.shape or source.shape[1:] not in ((2,), (3,)):
        text = f"points of shapes {source.shape} and {target.shape} are no pairs"
        raise InputError(f"{name}: {text}; give [n, 2] or [n, 3] each")
    n, dimension = source.shape
    if n < dimension:
        raise InputError(f"{name}: {n} pairs; give at least {dimension}, well apart")
    if where := _open_rotation(source, target):
        raise InputError(f"{name}: all pairs lie {where}, so the rotation is open; add a pair away from it")
    rigid, similar = (estimate_transform(kind, source, target) for kind in ("euclidean", "similarity"))
    error = rigid.residuals(source, target)
    rms = float(np.sqrt(np.mean(error**2)))
    if rms > LARGEST_RMS_M:
        text = f"{name}: the pairs disagree by {rms:.2f} m rms (at most {LARGEST_RMS_M} m), "
        text += f"pair {int(np.argmax(error)) + 1} by {error.max():.2f} m"
        scaled = float(np.sqrt(np.mean(similar.residuals(source, target) ** 2)))
        if scaled < rms / 2:
            better = f"lengths times {similar.scale:.3f} would fit better ({scaled:.2f} m rms)"
            raise InputError(f"{text}; {better}: check units and resolution")
        raise InputError(f"{text}: check this pair and the axes")
    return np.asarray(rigid.params if dimension == 3 else planar_matrix_to_3D(rigid.params))


def similar_pixels(source: ArrayLike, target_m: ArrayLike, name: str = "pairs") -> FloatArray:
    """Matrix [2, 3] that makes metres of pixels of a picture, whose y runs down, from pairs [n, 2] (Umeyama 1991).

    Raises:
        InputError: fewer than two pairs, pairs at one place, or a bad fit.
    """
    pixels, target = np.asarray(source, float) * [1, -1], np.asarray(target_m, float)
    if len(pixels) < 2 or _open_rotation(pixels, target):
        raise InputError(f"{name}: {len(pixels)} pairs at one place tell no scale; give two pairs, well apart")
    similar = estimate_transform("similarity", pixels, target)
    error = similar.residuals(pixels, target)
    if (rms := float(np.sqrt(np.mean(error**2)))) > LARGEST_RMS_M:
        text = f"the pairs disagree by {rms:.2f} m rms (at most {LARGEST_RMS_M} m), pair {int(np.argmax(error)) + 1} by"
        raise InputError(f"{name}: {text} {error.max():.2f} m: check this pair; x, y are pixels from the upper left")
    return np.asarray(similar.params[:2] * [1, -1, 1])


def _open_rotation(source: FloatArray, target: FloatArray) -> str:
    """Where pairs lie if that leaves their rotation open: at one place, or in 3D on one line; else empty."""
    spread = [np.linalg.svd(points - points.mean(axis=0), compute_uv=False) for points in (source, target)]
    extent = min(spread, key=lambda s: s[0])
    if extent[0] < SMALLEST_EXTENT_M:
        return "at one place"
    return "on one line" if len(extent) == 3 and extent[1] < SPREAD * extent[0] else ""


def _motion(pose: FloatArray) -> FloatArray:
    """Matrix [4, 4] of a pose (x, y, angle)."""
    return np.asarray(planar_matrix_to_3D(EuclideanTransform(rotation=pose[2], translation=pose[:2]).params))


def wall_points(surfaces: Sequence[Surface]) -> FloatArray:
    """Points [n, 2] along the walls of surfaces seen from above, in equal steps; `InputError`: there is no wall."""
    walls = []
    for surface in surfaces:
        if surface.kind == "wall":
            xy = surface.vertices_m[:, :2]
            middle = xy.mean(axis=0)
            along = np.linalg.svd(xy - middle, full_matrices=False)[2][0]
            reach = (xy - middle) @ along
            walls.append(middle + np.array([[reach.min()], [reach.max()]]) * along)
    if not walls:
        raise InputError("registration to walls: the scene has no wall; register by pairs of points")
    return sample_walls(np.array(walls))


def best_motion(points_m: FloatArray, walls_m: FloatArray) -> FloatArray:
    """The turn about z and shift [4, 4] in which points [n, 2] fit walls [m, 2, 2] best, however badly."""
    pose, _ = _find_poses(points_m, walls_m)[0]
    return _motion(pose)


def register_walls(points_m: ArrayLike, walls_m: ArrayLike, name: str = "scene") -> FloatArray:
    """The turn about z and shift [4, 4] that lay a scene's walls on known walls.

    Turns all around, each with the shifts where both plans correlate best, are refined by robust least squares over the
    points' distances from the walls (point-to-line ICP with a Cauchy loss: Fitzgibbon 2003); the pose where most points
    and walls agree is taken.

    Args:
        points_m: points on the scene's walls [n, 2] or [n, 3] (z is ignored), evenly spread: `wall_points`.
        walls_m: end points of known walls [m, 2, 2] in the target's frame; the scene may miss some and show others.
        name: name of the scene, for errors.

    Raises:
        InputError: too few points agree, another pose fits as well, or the mirror image fits better.
    """
    points, walls = np.asarray(points_m, float)[:, :2], np.asarray(walls_m, float)
    if len(points) < 3 or not len(walls):
        raise InputError(f"{name}: registration to walls needs points and walls, got {len(points)} and {len(walls)}")
    points = points[:: -(-len(points) // MOST_POINTS)]
    (pose, score), *others = _find_poses(points, walls)
    _, mirrored = _find_poses(points * [-1, 1], walls)[0]
    if mirrored > max(score + CLEAR_LEAD, LEAST_AGREEMENT):
        text = f"{name}: its mirror image fits the walls better (agreement {mirrored:.2f}, not {score:.2f})"
        remedy = (
            "flip a picture upside down, give the other row_0 of an NPZ grid (--row-0), or change the sign of one axis"
        )
        raise InputError(f"{text}; {remedy}")
    if score < LEAST_AGREEMENT:
        scale, agreement = best_scale(points, pose, walls)
        share = np.mean(distance_to_walls(_moved(points, pose), walls) <= NEAR_M)
        text = f"{name}: it does not fit the walls: agreement {score:.2f} (at least {LEAST_AGREEMENT}), "
        text += f"{share:.0%} within {NEAR_M} m"
        if agreement > score + CLEAR_LEAD:
            better = f"lengths times {scale:.2f} would fit better (agreement {agreement:.2f})"
            raise InputError(f"{text}; {better}: check resolution and units, or give pairs")
        remedy = "check that the walls are of this place, and its units, or give pairs"
        raise InputError(f"{text}, and slightly other lengths fit no better: {remedy}")
    # Square rooms fit after quarter turns, too; poses a few centimetres apart are refined from two starts, and equal.
    for other, other_score in others:
        apart = np.linalg.norm(_moved(points, pose) - _moved(points, other), axis=1)
        if np.sqrt(np.mean(apart**2)) > SAME_M and other_score > score - CLEAR_LEAD:
            turn = np.degrees(other[2] - pose[2]) % 360
            text = f"two poses fit the walls alike, {turn:.0f} degrees apart"
            raise InputError(f"{name}: {text}; give pairs of points instead")
    return _motion(pose)


def sample_walls(walls_m: ArrayLike, step_m: float = SAMPLE_M) -> FloatArray:
    """Points [n, 2] along walls [m, 2, 2]: the middles of equal parts no longer than a step."""
    ends = [shapely.get_coordinates(wall) for wall in shapely.segmentize(shapely.linestrings(walls_m), step_m)]
    return np.concatenate([(xy[:-1] + xy[1:]) / 2 for xy in ends])


def distance_to_walls(points_m: FloatArray, walls_m: FloatArray) -> FloatArray:
    """Distance of each point [n, 2] from the nearest of walls [m, 2, 2], shape [n]."""
    return np.asarray(shapely.distance(shapely.points(points_m), shapely.multilinestrings(list(walls_m))))


def _moved(points: FloatArray, pose: FloatArray) -> FloatArray:
    """Points [n, 2] turned about the origin and shifted by a pose (x, y, angle)."""
    return points @ rotation_2d(pose[2]).T + pose[:2]


def _find_poses(points: FloatArray, walls: FloatArray) -> list[tuple[FloatArray, float]]:
    """Poses (x, y, angle) of points [n, 2] that fit walls [m, 2, 2], and their agreement 0 to 1, the best first."""
    points = points[:: -(-len(points) // MOST_POINTS)]
    # About their middle, so that an error of the angle moves no point farther than the radius times it.
    middle = points.mean(axis=0)
    centred = points - middle
    targets = sample_walls(walls)
    radius = float(np.linalg.norm(centred, axis=1).max())
    cell = max(CELL_M, radius / 100)

    def misfit(pose: FloatArray) -> FloatArray:
        return distance_to_walls(_moved(centred, pose), walls)

    fits = []
    for pose in _starts(centred, targets, cell):
        # A start is off by half a cell and half a turn's step.
        for width in (cell + radius * np.pi / TURNS, NEAR_M / 2):
            pose = optimize.least_squares(misfit, pose, loss="cauchy", f_scale=width, max_nfev=30).x
        # The pose for the points themselves: R (x - middle) + t = R x + (t - R middle).
        about_origin = np.append(pose[:2] - rotation_2d(pose[2]) @ middle, pose[2])
        fits.append((about_origin, _agreement(_moved(centred, pose), targets, walls)))
    return sorted(fits, key=lambda fit: -fit[1])


def _agreement(placed: FloatArray, targets: FloatArray, walls: FloatArray) -> float:
    """Mean of the shares of the scene at walls, and of the walls in the scene, where distances d count exp(-(d / 0.1
    m)^2 / 2).
    """
    # Both ways: points of one wall alone agree with any plan, and a plan of many walls with any points.
    to_walls, to_points = distance_to_walls(placed, walls), cKDTree(placed).query(targets)[0]
    near, shown = (np.exp(-0.5 * (away / (NEAR_M / 2)) ** 2) for away in (to_walls, to_points))
    return float((near.mean() + shown.mean()) / 2)


def _starts(centred: FloatArray, targets: FloatArray, cell: float) -> list[FloatArray]:
    """Distinct poses where blurred pictures of both plans correlate best, over turns all around."""
    from scipy.signal import fftconvolve  # slow to import, and few scenes are registered

    radius = float(np.linalg.norm(centred, axis=1).max()) + 2 * cell
    low = targets.min(axis=0) - 2 * radius
    shape = np.ceil((targets.max(axis=0) + 2 * radius - low) / cell).astype(int) + 1
    half = int(np.ceil(radius / cell))
    # Blurred by two cells: between two turns that are searched, the farthest points move by as much.
    wall_image = ndimage.gaussian_filter(_image((targets - low) / cell, shape), 2.0)
    peaks: list[tuple[float, FloatArray]] = []
    for angle in np.arange(TURNS) * (2 * np.pi / TURNS):
        kernel = _image(centred @ rotation_2d(angle).T / cell + half, np.array([2 * half + 1] * 2))
        # A convolution with the reversed picture is the correlation with it.
        match = fftconvolve(wall_image, kernel[::-1, ::-1], mode="same")
        # The best match of a turn may be a wrong wall: its next best shifts are refined, too.
        for _ in range(PEAKS):
            peak = np.array(np.unravel_index(np.argmax(match), match.shape))
            peaks.append((float(match[tuple(peak)]), np.append(low + peak * cell, angle)))
            match[tuple(slice(max(0, p - APART_CELLS), p + APART_CELLS + 1) for p in peak)] = 0
    starts: list[FloatArray] = []
    for _, pose in sorted(peaks, key=lambda peak: -peak[0]):
        away = pose - np.reshape(starts, (-1, 3))
        turn = np.abs((away[:, 2] + np.pi) % (2 * np.pi) - np.pi)
        near = (turn < APART_RAD) & (np.linalg.norm(away[:, :2], axis=1) < APART_CELLS * cell)
        if not near.any():
            starts.append(pose)
    return starts[:STARTS]


def _image(cells: FloatArray, shape: IntArray) -> FloatArray:
    """Image with 1 in cells (x, y) that hold a point; points are in units of cells."""
    image = np.zeros(tuple(shape))
    image[tuple(np.clip(cells.astype(int), 0, shape - 1).T)] = 1.0
    return image


def best_scale(points: FloatArray, pose: FloatArray, walls: FloatArray) -> tuple[float, float]:
    """The factor on lengths, 1/2 to 2, with which points [n, 2] fit walls [m, 2, 2] best near a pose (x, y, angle), and
    the agreement with it; far from 1, units or resolution are wrong.
    """
    middle = points.mean(axis=0)

    def placed(pose_and_scale: FloatArray) -> FloatArray:
        return _moved(pose_and_scale[3] * (points - middle), pose_and_scale[:3])

    fit = optimize.least_squares(
        lambda pose_and_scale: distance_to_walls(placed(pose_and_scale), walls),
        np.append(_moved(middle[None], pose)[0], [pose[2], 1.0]),
        bounds=([-np.inf] * 3 + [0.5], [np.inf] * 3 + [2.0]),
        loss="cauchy",
        f_scale=NEAR_M / 2,
        max_nfev=100,
    )
    return float(fit.x[3]), _agreement(placed(fit.x), sample_walls(walls), walls)
