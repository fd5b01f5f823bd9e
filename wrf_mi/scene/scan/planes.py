"""Planes of a building in a noisy point cloud: flat patches, split into layers, merged, and fitted to all their points.

Patches are those of Open3D (Araujo and Oliveira 2020, Pattern Recognit. 107). Parallel layers of a plane that the noise
blurs (boards on walls, recesses) are found by cells: two layers three standard deviations of the noise apart are one to
single points, but the error of a cell's median falls with the root of the number of its points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import compress
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy import ndimage, stats
from scipy.signal import find_peaks
from scipy.spatial import cKDTree
from skimage.filters import apply_hysteresis_threshold

from ...core import InputError
from ...core.angles import FloatArray
from ...core.types import IntArray
from ..coordinates import extra_package
from ..mesh.planes import THICKEST_M, Mask, Plane, near, with_axes

VOXEL_M = 0.03  # edge of the cells: a desk's side still has several
MOST_VOXELS = 600_000  # the cells of a large building grow until there are no more: bounds time and memory
NORMAL_RADIUS_M, NORMAL_NEIGHBOURS, FEWEST_NEIGHBOURS = 0.15, 50, 16
"""Radius of the points that tell a normal, and the most and fewest of them; the fewest reach farther where need be."""
NARROW_RADIUS_M = 0.08
"""The same of a scan that is as dense everywhere: a wider one reaches the other side of a partition of 10 cm."""
FEW_SHARE = 0.1  # least share of means with fewer neighbours of a scan that becomes sparse far from its scanner
STRAY_NEIGHBOURS, STRAY_RATIO = 20, 2.0
"""A mean farther from its neighbours than usual by this many standard deviations is a stray."""
NORMAL_SPREADS_DEG = (30, 60, 60, 60, 60)
"""Spread of the normals in a patch, for each of successive searches among the points that belong to no plane yet. 60
joins the walls of a sparse room around its corners, but finds narrow faces."""
SEARCH_M = 0.10  # half thickness of a patch in which parallel layers, such as both sides of a partition, are separated
BAND = 3.0  # points within this many standard deviations belong to a plane
REPEAT = 5.0  # a later plane nearer than this to a parallel plane, in standard deviations, consists of its strays
PLANAR_SHARE = 0.6  # a patch with fewer of its points in its layers is bent: a chair, a curtain
CORE, NARROW_CORE = 0.95, 0.5
"""Share of the points about a patch by which the noise is told. The tails count: noise along the ray is smaller across
a surface seen at a grazing angle, so the sum over all angles has wide tails. The vertices of a mesh have none, and half
of them are no points of the other side of a partition."""
NOISE_RANGE_M = (0.002, 0.04)  # range of the noise: scanner on a tripod to phone
LAYER_SHARE = 0.2  # least density of a layer relative to the densest layer of its patch
LAYER_CORE = (0.02, 0.98)  # quantiles of a layer's points that bound it along each axis; the rest may be strays
MERGE_GAP_M = 1.0  # coplanar pieces nearer than this are one plane: wall on both sides of a door
MERGE_ANGLE_RAD = float(np.radians(1.0))
SHORTEST_EDGE_M = 0.2
FEWEST_VOXELS = 60
POINTS_PER_CELL, FEWEST_PER_CELL = 24, 8  # mean and least number of points of a cell
CELL_RANGE_M = (0.1, 0.4)
AROUND = 6.0  # half thickness of the slab about a plane in which layers are sought, in standard deviations of the noise
LAYER_ERRORS, LEAST_STEP = 4.0, 0.6
"""Least distance of a layer from its plane, in standard errors of a cell's median and in deviations of the noise."""
GROWN_ERRORS = 2.0  # the same of cells beside
LAYER_M2, LAYER_CELLS = 0.3, 8  # least size of a layer
FLATNESS = 2.0
"""Largest spread of the medians of a layer, in their standard errors: what is bent or tilted is not a layer."""
MEDIAN_ERROR = 1.25  # standard error of a median, in that of a mean
OFF_ROUND_M = np.array([0.0137, 0.0071, 0.0113])
"""Displacement while normals are estimated: Open3D's are wrong where the covariance of points without noise is exactly
singular, as at the floor z = 0 of points that were drawn on a mesh."""
TUKEY = 4.685  # constant of the biweight
NORMAL_MAD = 1.4826  # standard deviation of a normal distribution in its median absolute deviations


@dataclass(frozen=True)
class Thinned:
    """A thinned point cloud.

    Attributes:
        points_m: mean of the points in each cell, without strays [m, 3].
        count: their number [m].
        normals: unit normals [m, 3].
        all_m: all means [k, 3]: far from a scanner surfaces are as sparse as strays.
    """

    points_m: FloatArray
    count: FloatArray
    normals: FloatArray
    all_m: FloatArray


def thin(points_m: FloatArray, radius_m: float = NORMAL_RADIUS_M) -> Thinned:
    """Thin a cloud [n, 3] in metres to at most `MOST_VOXELS` means, drop strays and estimate normals in a radius."""
    o3d = extra_package("open3d")
    voxel = VOXEL_M
    mean, count = _cells(points_m, voxel)
    while len(mean) > MOST_VOXELS:
        voxel *= 1.25
        mean, count = _cells(points_m, voxel)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(mean))
    cloud, rows = cloud.remove_statistical_outlier(STRAY_NEIGHBOURS, STRAY_RATIO)
    if len(rows) < STRAY_NEIGHBOURS:
        raise InputError(f"only {len(rows)} points have neighbours; give a denser point cloud")
    radius, points = radius_m * voxel / VOXEL_M, np.array(cloud.points)
    cloud.translate(OFF_ROUND_M)
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius, NORMAL_NEIGHBOURS))
    normals = np.array(cloud.normals)
    # Far from the scanner a radius holds a few points, whose noise tilts the normal; in a dense scan they are clutter.
    few = cKDTree(points).query_ball_point(points, radius, return_length=True) < FEWEST_NEIGHBOURS
    if few.mean() > FEW_SHARE:
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(FEWEST_NEIGHBOURS))
        normals[few] = np.asarray(cloud.normals)[few]
    return Thinned(points, count[rows], normals, mean)


def _cells(points_m: FloatArray, voxel_m: float) -> tuple[FloatArray, FloatArray]:
    """Mean [m, 3] and number [m] of the points in each cell."""
    cell = ((points_m - points_m.min(axis=0)) / voxel_m).astype(np.int64)
    key = np.ravel_multi_index(tuple(cell.T), tuple(cell.max(axis=0) + 1))
    _, inverse = np.unique(key, return_inverse=True)
    count = np.bincount(inverse).astype(float)
    return np.stack([np.bincount(inverse, points_m[:, axis]) / count for axis in range(3)], axis=1), count


def find_planes(cloud: Thinned, core: float = CORE) -> tuple[list[Plane], float]:
    """The planes of a thinned cloud, those of most points first, and the standard deviation of points from them,
    metres: that of a normal distribution with their distances in a share of the points.
    """
    planes: list[Plane] = []
    free = np.ones(len(cloud.points_m), bool)
    noise = 0.0
    for spread_deg in NORMAL_SPREADS_DEG:
        boxes = _patches(cloud, free, spread_deg)
        noise = noise or _noise(cloud, boxes, core)
        layers_of_boxes = (layer for box in boxes for layer in _patch_layers(cloud, free, box, noise))
        candidates = [layer for layer in layers_of_boxes if not repeats(layer, planes, REPEAT * noise)]
        if not candidates:
            break
        merged, planes = _merge(cloud, [*planes, *candidates], noise), []
        for plane in merged:
            if not repeats(plane, planes, 2 * noise):
                planes.append(plane)
        free &= off_planes(planes, cloud.points_m, BAND * noise)
    return planes, noise


def off_planes(planes: Sequence[Plane], points_m: FloatArray, band_m: float) -> Mask:
    """Points [n, 3] that lie near no patch of planes."""
    free = np.ones(len(points_m), bool)
    for plane in planes:
        free &= ~near(plane, points_m, band_m)
    return free


def fit(
    points_m: FloatArray, weight: FloatArray, start: Plane, noise_m: float, *, normal: FloatArray | None = None
) -> Plane:
    """Least squares on the points [n, 3] within 2 standard deviations of a plane, in three iterations.

    A given ``normal`` is kept; only the offset is fitted then. ``weight`` [n] are those of the points.
    """
    plane = start if normal is None else replace(start, normal=normal, offset_m=float(normal @ start.centre_m))
    for _ in range(3):
        inside = np.abs(plane.distance(points_m)) < 2 * noise_m
        w = weight[inside].astype(float)
        total = w.sum()
        if np.count_nonzero(inside) < 10:
            return plane
        chosen = points_m[inside].astype(float)
        centre = w @ chosen / total
        values, vectors = np.linalg.eigh((chosen - centre).T * w @ (chosen - centre) / total)
        n = vectors[:, 0] if normal is None else normal
        # Standard error of a slope: noise over the spread of the points along the shorter axis.
        error = noise_m / np.sqrt(values[1] * total)
        offset = float(n @ centre)
        plane = replace(plane, normal=n, offset_m=offset, centre_m=centre, angle_error_rad=float(error))
    return with_axes(plane)


def _fit_near(cloud: Thinned, chosen: Mask, start: Plane, noise_m: float) -> Plane:
    return fit(cloud.points_m[chosen], cloud.count[chosen], start, noise_m)


def _merge(cloud: Thinned, planes: Sequence[Plane], noise_m: float) -> list[Plane]:
    """Coplanar neighbours merged and fitted anew, the plane with the most points first."""
    weight = [cloud.count[near(plane, cloud.points_m, 2 * noise_m)].sum() for plane in planes]
    remaining = [planes[i] for i in np.argsort(weight)[::-1]]
    merged: list[Plane] = []
    while remaining:
        plane = remaining.pop(0)
        is_same = [_coplanar(plane, other, noise_m) for other in remaining]
        if not any(is_same):
            merged.append(plane)
            continue
        patches = [other.patches_m for other in compress(remaining, is_same)]
        remaining = [other for other, same in zip(remaining, is_same, strict=True) if not same]
        plane = replace(plane, patches_m=np.concatenate([plane.patches_m, *patches]))
        # The grown plane goes back to the front: it may meet further pieces.
        remaining.insert(0, _fit_near(cloud, near(plane, cloud.points_m, BAND * noise_m), plane, noise_m))
    return merged


def _coplanar(a: Plane, b: Plane, noise_m: float) -> bool:
    # Within three standard errors of both directions, but a degree at least (registration) and five at most.
    error = 3 * float(np.hypot(a.angle_error_rad, b.angle_error_rad))
    angle = float(np.arccos(min(abs(float(a.normal @ b.normal)), 1.0)))
    if angle > min(max(error, MERGE_ANGLE_RAD), 5 * MERGE_ANGLE_RAD):
        return False
    away = np.abs(a.distance(b.patches_m.mean(axis=1))).max()
    if away > 1.5 * noise_m + 0.005:
        return False
    flat = shapely.union_all(shapely.convex_hull(shapely.multipoints(a.flat(b.patches_m))))
    return bool(shapely.distance(flat, a.region(0)) < MERGE_GAP_M)


def repeats(plane: Plane, others: Sequence[Plane], least_m: float) -> bool:
    """Whether a plane consists of strays of another plane: nearly parallel and nearer than ``least_m``."""
    parallel = [other for other in others if abs(plane.normal @ other.normal) >= np.cos(np.radians(10))]
    near_planes = [other for other in parallel if abs(other.distance(plane.centre_m)) <= least_m]
    return any(shapely.contains_xy(other.region(), *other.flat(plane.centre_m)) for other in near_planes)


def _patches(cloud: Thinned, free: Mask, spread_deg: float) -> list[Any]:
    """Boxes around the flat patches of a part of a cloud."""
    if np.count_nonzero(free) < FEWEST_VOXELS:
        return []
    o3d = extra_package("open3d")
    part = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(cloud.points_m[free]))
    part.normals = o3d.utility.Vector3dVector(cloud.normals[free])
    boxes = part.detect_planar_patches(
        normal_variance_threshold_deg=spread_deg,
        coplanarity_deg=75,
        outlier_ratio=0.75,
        min_plane_edge_length=SHORTEST_EDGE_M,
        min_num_points=FEWEST_VOXELS,
        search_param=o3d.geometry.KDTreeSearchParamKNN(30),
    )
    return [box for box in boxes if min(box.extent) < THICKEST_M]


def _box_plane(box: Any) -> tuple[Plane, float]:
    """The middle plane of a patch's box, and its area."""
    thin, *wide = np.argsort(box.extent)
    rotation, centre = np.asarray(box.R), np.asarray(box.center)
    half = [rotation[:, axis] * box.extent[axis] / 2 for axis in wide]
    corners = np.stack([centre + a * half[0] + b * half[1] for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
    normal = rotation[:, thin] / np.linalg.norm(rotation[:, thin])
    plane = Plane(normal, float(normal @ centre), corners[None], centre, np.inf)
    return with_axes(plane), float(np.prod(box.extent[wide]))


def _inner(plane: Plane, cloud: Thinned, free: Mask) -> tuple[FloatArray, FloatArray]:
    """Offsets and counts of the points about a patch, without its rim, where neighbours begin."""
    size = np.linalg.norm(np.diff(plane.patches_m[0, [0, 1, 2]], axis=0), axis=1).min()
    inside = free & near(plane, cloud.points_m, SEARCH_M, -min(0.1 * size, 0.1))
    return plane.distance(cloud.points_m[inside]), cloud.count[inside]


def _noise(cloud: Thinned, boxes: Sequence[Any], core: float) -> float:
    """Standard deviation of points from the planes, metres: over the ten largest patches, weighted by area."""
    sized = sorted((_box_plane(box) for box in boxes), key=lambda pair: -pair[1])[:10]
    widths, areas = [], []
    everywhere = np.ones(len(cloud.points_m), bool)
    for plane, area in sized:
        around = near(plane, cloud.points_m, SEARCH_M, 0.0)
        if np.count_nonzero(around) < FEWEST_VOXELS:
            continue
        offsets, count = _inner(_fit_near(cloud, around, plane, NOISE_RANGE_M[1] / 2), cloud, everywhere)
        width = np.quantile(np.abs(offsets), core, weights=count, method="inverted_cdf")
        widths.append(width / stats.norm.ppf((1 + core) / 2))
        areas.append(area)
    if not widths:
        return NOISE_RANGE_M[0]
    return float(np.clip(np.quantile(widths, 0.5, weights=areas, method="inverted_cdf"), *NOISE_RANGE_M))


def _patch_layers(cloud: Thinned, free: Mask, box: Any, noise_m: float) -> list[Plane]:
    """The parallel planes within a patch, none where it is bent."""
    # The middle plane of a box may be turned by a degree, which smears a large wall into two layers; a plane fitted to
    # all points about it may run across two real layers. The sharper of both is used.
    middle, _ = _box_plane(box)
    fitted = _fit_near(cloud, free & near(middle, cloud.points_m, SEARCH_M, 0.0), middle, SEARCH_M / 2)
    step = max(noise_m / 4, 0.002)
    bins = np.arange(-SEARCH_M, SEARCH_M + step, step)
    sharpest, best = 0.0, None
    for plane in (middle, fitted):
        offsets, count = _inner(plane, cloud, free)
        if len(offsets) >= FEWEST_VOXELS / 2:
            density = ndimage.gaussian_filter1d(np.histogram(offsets, bins, weights=count)[0], 0.7 * noise_m / step)
            # 1 over the number of bins that a level distribution with this sum of squares would fill.
            sharpness = float((density**2).sum() / density.sum() ** 2)
            if sharpness > sharpest:
                sharpest, best = sharpness, (plane, offsets, count, density)
    if best is None:
        return []
    middle, offsets, count, density = best
    density = np.pad(density, 1)
    least = LAYER_SHARE * density.max()
    peaks, _ = find_peaks(density, height=least, prominence=least / 2, distance=max(2.5 * noise_m / step, 1))
    at = (bins[:-1] + step / 2)[peaks - 1]
    inside = (np.abs(offsets[:, None] - at).min(axis=1, initial=np.inf)) < BAND * noise_m
    if count[inside].sum() < PLANAR_SHARE * count.sum():
        return []
    planes = []
    for offset in at:
        layer = middle.shifted(offset)
        inside = free & near(layer, cloud.points_m, BAND * noise_m, 0.0)
        if np.count_nonzero(inside) >= FEWEST_VOXELS / 2:
            if len(at) > 1:
                bounds = np.quantile(layer.flat(cloud.points_m[inside]), LAYER_CORE, axis=0)
                layer = replace(layer, patches_m=layer.rectangle(*bounds)[None])
            planes.append(_fit_near(cloud, inside, layer, noise_m))
    return planes


@dataclass(frozen=True)
class Layer:
    """A part of the points about a plane that lies in a parallel one.

    Attributes:
        plane: the parallel plane.
        rows: numbers of its points.
        before: whether it lies on the side of the plane where most points are: the plane goes on behind it.
    """

    plane: Plane
    rows: IntArray
    before: bool


def layers(plane: Plane, points_m: FloatArray, free: Mask, noise_m: float) -> tuple[Plane, list[Layer]]:
    """The plane of most cells, and the layers of others.

    Of a plane with its axes, points of the scan [n, 3], metres, those that belong to no other plane [n], and their
    noise.
    """
    reach = min(AROUND * noise_m, SEARCH_M)
    rows = np.flatnonzero(free & near(plane, points_m, reach))
    if len(rows) < LAYER_CELLS * POINTS_PER_CELL:
        return plane, []
    away, flat = plane.distance(points_m[rows]).astype(float), plane.flat(points_m[rows]).astype(float)
    low = flat.min(axis=0)
    # Density where there are points: the rectangle around them may be mostly empty.
    occupied = len(np.unique(np.floor((flat - low) / CELL_RANGE_M[0]), axis=0))
    density = len(rows) / (occupied * CELL_RANGE_M[0] ** 2)
    side = float(np.clip(np.sqrt(POINTS_PER_CELL / density), *CELL_RANGE_M))
    cell = np.floor((flat - low) / side).astype(int)
    shape = tuple(cell.max(axis=0) + 1)
    number = np.ravel_multi_index(tuple(cell.T), shape)
    count = np.bincount(number, minlength=int(np.prod(shape)))
    median = np.full(len(count), np.nan)
    counted = np.flatnonzero(count >= FEWEST_PER_CELL)
    median[counted] = ndimage.median(away, number, counted)
    error = MEDIAN_ERROR * noise_m / np.sqrt(np.maximum(count, 1))
    level = _location(median[counted], error[counted])
    step = median - level
    parallels = list[tuple[Plane, IntArray, int]]()
    for sign in (1, -1):
        ratio = np.nan_to_num(sign * step / np.maximum(error, LEAST_STEP / LAYER_ERRORS * noise_m)).reshape(shape)
        mask = apply_hysteresis_threshold(ratio, GROWN_ERRORS, LAYER_ERRORS)
        parts, most = ndimage.label(ndimage.binary_opening(mask, np.ones((2, 2))))  # strips are rims of neighbours
        for part in range(1, most + 1):
            inside = np.flatnonzero((parts == part).ravel())
            if len(inside) < LAYER_CELLS or len(inside) * side**2 < LAYER_M2:
                continue
            depth = float(np.median(step[inside]))
            spread = NORMAL_MAD * float(np.median(np.abs(step[inside] - depth)))
            # Medians of a layer differ by their own errors alone.
            if spread > FLATNESS * float(np.median(error[inside])):
                continue
            chosen = np.isin(number, inside) & (np.abs(away - level - depth) < 2 * noise_m)
            corners = np.stack(np.unravel_index(inside, shape), axis=1)
            parallel = plane.shifted(level).shifted(depth)
            patch = parallel.rectangle(low + side * corners.min(axis=0), low + side * (corners.max(axis=0) + 1))
            parallel = replace(parallel, patches_m=patch[None], centre_m=patch.mean(axis=0))
            parallels.append((parallel, rows[chosen], sign))
    if not parallels:
        return plane, []
    room_side = np.sign(np.median(plane.distance(points_m)) - level)
    return plane.shifted(level), [Layer(layer, which, bool(sign == room_side)) for layer, which, sign in parallels]


def _location(values: NDArray[np.float64], error: FloatArray) -> float:
    """Weighted location of values by Tukey's biweight, from their median."""
    if not len(values):
        return 0.0
    at, weight = float(np.median(values)), np.ones(len(values))
    for _ in range(10):
        scale = np.maximum(error, NORMAL_MAD * np.median(np.abs(values - at)[weight > 0]))
        weight = np.clip(1 - ((values - at) / (TUKEY * scale)) ** 2, 0, None) ** 2 / error**2
        if weight.sum() <= 0:
            break
        at = float((weight * values).sum() / weight.sum())
    return at
