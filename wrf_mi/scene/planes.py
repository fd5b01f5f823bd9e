"""Planes of a building in a noisy point cloud.

A reconstruction that follows every point (Poisson, alpha shape) ripples by the scanner's noise, and a wall tilted by
1 degree sends a specular path elsewhere. So patches are found in a thinned cloud (Open3D; Araujo and Oliveira 2020,
Pattern Recognit. 107), told apart into layers, merged, and fitted to all their points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.signal import find_peaks

from ..core.angles import FloatArray
from .packages import lidar_package
from .thin import Thinned

NORMAL_SPREADS_DEG = (30, 60, 60, 60, 60)
"""Searches for planes, each in what the last one left (a board before a wall shows once the wall is taken), and by how
much the normals in a patch may differ. Open3D's default of 60 joins the walls of a sparse room around its corners, but
finds narrow faces, where normals turn at the edges."""
SEARCH_M = 0.10
"""Half thickness of a patch in which parallel layers (both sides of a partition) are told apart."""
MARGIN_M = 0.15
"""A plane may reach this far beyond the patch it was found as."""
BAND = 3.0
"""Points within this many standard deviations belong to a plane."""
REPEAT = 5.0
"""A later plane nearer than this to a parallel one, in standard deviations, is made of its strays."""
PLANAR_SHARE = 0.6
"""A patch with fewer of its points in its layers is bent: a chair, a curtain."""
NOISE_RANGE_M = (0.002, 0.04)
"""Noise that planes are looked for with: scanner on a tripod to phone."""
LAYER_SHARE = 0.2
"""A layer has at least this share of the density of the strongest one in its patch."""
LAYER_CORE = (0.02, 0.98)
"""Share of a layer's points between which it reaches along each axis; the rest may be strays."""
MERGE_GAP_M = 1.0
"""Coplanar pieces nearer than this are one plane: wall on both sides of a door."""
MERGE_ANGLE_RAD = float(np.radians(1.0))
THICKEST_M = 0.3
"""A thicker box holds more than a plane."""
SHORTEST_EDGE_M = 0.2
FEWEST_VOXELS = 60

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Plane:
    """A plane n . x = d and the patches that it was found as.

    Attributes:
        normal: unit vector n, shape [3]; its sign has no meaning.
        offset_m: d, metres.
        patches_m: corners of the rectangles that it was found as, shape [k, 4, 3], metres.
        centre_m: weighted mean of its points, shape [3].
        angle_error_rad: standard error of the normal's direction.
        u: unit vector in the plane, shape [3]; the second one is v = n x u.
    """

    normal: FloatArray
    offset_m: float
    patches_m: FloatArray
    centre_m: FloatArray
    angle_error_rad: float
    u: FloatArray = field(default_factory=lambda: np.zeros(3))

    @property
    def v(self) -> FloatArray:
        """The second unit vector in the plane."""
        return np.cross(self.normal, self.u)

    def flat(self, points_m: FloatArray) -> FloatArray:
        """Coordinates [..., 2] along u and v of the points' feet, metres."""
        return points_m @ np.stack([self.u, self.v], axis=1).astype(points_m.dtype)

    def lift(self, flat_m: FloatArray) -> FloatArray:
        """Points [..., 3] of the plane from coordinates [..., 2] in it."""
        return flat_m @ np.stack([self.u, self.v]) + self.normal * self.offset_m

    def distance(self, points_m: FloatArray) -> FloatArray:
        """Signed distance [...] of points from the plane, metres."""
        return points_m @ self.normal.astype(points_m.dtype) - points_m.dtype.type(self.offset_m)

    def region(self, margin_m: float = MARGIN_M) -> Any:
        """The area (shapely) in its own coordinates where its points may lie: its patches and a margin."""
        hulls = shapely.convex_hull(shapely.multipoints(self.flat(self.patches_m)))
        return shapely.buffer(shapely.union_all(hulls), margin_m, join_style="mitre")


def with_axes(plane: Plane, along: ArrayLike = (1.0, 0.0, 0.0)) -> Plane:
    """The plane with its axes set: u horizontal where it is upright, else the direction ``along`` put into it."""
    n = plane.normal
    level = np.array([-n[1], n[0], 0.0])
    u = level if np.linalg.norm(level) > 0.5 else np.asarray(along) - n * (n @ np.asarray(along))
    return replace(plane, u=u / np.linalg.norm(u))


def find_planes(cloud: Thinned) -> tuple[list[Plane], float]:
    """The planes of a thinned cloud and its noise.

    Returns:
        Planes, the one with the most points first, and the standard deviation of the points from them in metres.
    """
    planes: list[Plane] = []
    rest = np.ones(len(cloud.points_m), bool)
    noise = 0.0
    for spread_deg in NORMAL_SPREADS_DEG:
        boxes = _patches(cloud, rest, spread_deg)
        noise = noise or _noise(cloud, boxes)
        found = [plane for box in boxes for plane in _layers(cloud, rest, box, noise)]
        found = [plane for plane in found if not any(_repeats(plane, other, REPEAT * noise) for other in planes)]
        if not found:
            break
        once: list[Plane] = []
        for plane in merge(cloud, [*planes, *found], noise):
            if not any(_repeats(plane, other, 2 * noise) for other in once):
                once.append(plane)
        planes = once
        for plane in planes:
            rest &= ~near(plane, cloud.points_m, BAND * noise)
    return planes, noise


def near(plane: Plane, points_m: FloatArray, band_m: float, margin_m: float = MARGIN_M) -> Mask:
    """Which points [n] lie within a distance of the plane and over its patches."""
    return over(plane, plane.region(margin_m), points_m, band_m)


def over(plane: Plane, area: Any, points_m: FloatArray, band_m: float) -> Mask:
    """Which points [n] lie within a distance of an area (shapely) of the plane."""
    mask: Mask = np.abs(plane.distance(points_m)) < band_m
    index = np.flatnonzero(mask)
    mask[index] = shapely.contains_xy(area, plane.flat(points_m[index]))
    return mask


def fit(
    points_m: FloatArray, weight: FloatArray, start: Plane, noise_m: float, *, normal: FloatArray | None = None
) -> Plane:
    """Least squares on the points within 2 standard deviations of the plane, three times over.

    Args:
        points_m: shape [n, 3].
        weight: of each point, shape [n].
        start: a plane near the one to be found.
        noise_m: standard deviation of the points from the plane.
        normal: unit vector to be kept; only the offset is fitted then.
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


def merge(cloud: Thinned, planes: Sequence[Plane], noise_m: float) -> list[Plane]:
    """Coplanar neighbours as one plane, fitted anew; the one with the most points comes first."""
    weight = [cloud.count[near(p, cloud.points_m, 2 * noise_m)].sum() for p in planes]
    left = [planes[i] for i in np.argsort(weight)[::-1]]
    merged: list[Plane] = []
    while left:
        plane = left.pop(0)
        same = [other for other in left if _coplanar(plane, other, noise_m)]
        if not same:
            merged.append(plane)
            continue
        left = [other for other in left if not any(other is one for one in same)]
        plane = replace(plane, patches_m=np.concatenate([plane.patches_m, *(one.patches_m for one in same)]))
        own = near(plane, cloud.points_m, BAND * noise_m)
        # Once more from the start: what it has grown to may meet further pieces.
        left.insert(0, fit(cloud.points_m[own], cloud.count[own], plane, noise_m))
    return merged


def _coplanar(a: Plane, b: Plane, noise_m: float) -> bool:
    error = 3 * float(np.hypot(a.angle_error_rad, b.angle_error_rad))
    angle = float(np.arccos(min(abs(float(a.normal @ b.normal)), 1.0)))
    if angle > min(max(error, MERGE_ANGLE_RAD), 5 * MERGE_ANGLE_RAD):
        return False
    away = np.abs(a.distance(b.patches_m.mean(axis=1))).max()
    if away > 1.5 * noise_m + 0.005:
        return False
    flat = shapely.union_all(shapely.convex_hull(shapely.multipoints(a.flat(b.patches_m))))
    return bool(shapely.distance(flat, a.region(0)) < MERGE_GAP_M)


def _repeats(plane: Plane, other: Plane, least_m: float) -> bool:
    """Whether a plane is what the noise left over of another one, nearly parallel and nearer than ``least_m``."""
    if abs(plane.normal @ other.normal) < np.cos(np.radians(10)):
        return False
    if abs(other.distance(plane.centre_m)) > least_m:
        return False
    return bool(shapely.contains_xy(other.region(), *other.flat(plane.centre_m)))


def _patches(cloud: Thinned, rest: Mask, spread_deg: float) -> list[Any]:
    """Boxes around the flat patches of what is left of a cloud."""
    if np.count_nonzero(rest) < FEWEST_VOXELS:
        return []
    o3d = lidar_package("open3d")
    part = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(cloud.points_m[rest]))
    part.normals = o3d.utility.Vector3dVector(cloud.normals[rest])
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


def _inner(plane: Plane, cloud: Thinned, rest: Mask) -> tuple[FloatArray, FloatArray]:
    """Offsets and counts of the points about a patch, its rim left out because neighbours begin there."""
    size = np.linalg.norm(np.diff(plane.patches_m[0, [0, 1, 2]], axis=0), axis=1).min()
    index = np.flatnonzero(rest)
    own = index[near(plane, cloud.points_m[index], SEARCH_M, -min(0.1 * size, 0.1))]
    return plane.distance(cloud.points_m[own]), cloud.count[own]


def _noise(cloud: Thinned, boxes: Sequence[Any]) -> float:
    """Standard deviation of points from the planes, metres: over the ten largest patches, weighted by area."""
    sized = sorted((_box_plane(box) for box in boxes), key=lambda pair: -pair[1])[:10]
    widths, areas = [], []
    rest = np.ones(len(cloud.points_m), bool)
    for plane, area in sized:
        own = near(plane, cloud.points_m, SEARCH_M, 0.0)
        if np.count_nonzero(own) < FEWEST_VOXELS:
            continue
        plane = fit(cloud.points_m[own], cloud.count[own], plane, NOISE_RANGE_M[1] / 2)
        offsets, count = _inner(plane, cloud, rest)
        order = np.argsort(np.abs(offsets))
        share = np.cumsum(count[order]) / count.sum()
        # Of a normal distribution 95 % lies within 1.96 standard deviations. The tails count: noise along the ray
        # is smaller across a surface that is seen at a grazing angle, so the sum over all angles has wide ones.
        widths.append(np.abs(offsets[order])[np.searchsorted(share, 0.95)] / 1.96)
        areas.append(area)
    if not widths:
        return NOISE_RANGE_M[0]
    order = np.argsort(widths)
    middle = np.searchsorted(np.cumsum(np.asarray(areas)[order]) / sum(areas), 0.5)
    return float(np.clip(np.asarray(widths)[order][middle], *NOISE_RANGE_M))


def _bounds(plane: Plane, points_m: FloatArray) -> FloatArray:
    """Corners [1, 4, 3] of the rectangle along the plane's axes that holds all but a few of the points."""
    (left, low), (right, high) = np.quantile(plane.flat(points_m), LAYER_CORE, axis=0)
    return plane.lift(np.array([[(left, low), (right, low), (right, high), (left, high)]]))


def _ways(cloud: Thinned, rest: Mask, box: Any) -> list[Plane]:
    """The middle plane of a box, and the one fitted to all points about it.

    A box may be turned by a degree, which smears a large wall into two layers; a fit may run across two real ones.
    """
    middle, _ = _box_plane(box)
    index = np.flatnonzero(rest)
    own = index[near(middle, cloud.points_m[index], SEARCH_M, 0.0)]
    return [middle, fit(cloud.points_m[own], cloud.count[own], middle, SEARCH_M / 2)]


def _layers(cloud: Thinned, rest: Mask, box: Any, noise_m: float) -> list[Plane]:
    """The parallel planes within a patch, none where it is bent."""
    step = max(noise_m / 4, 0.002)
    bins = np.arange(-SEARCH_M, SEARCH_M + step, step)
    sharpest, best = 0.0, None
    for middle in _ways(cloud, rest, box):
        offsets, count = _inner(middle, cloud, rest)
        if len(offsets) >= FEWEST_VOXELS / 2:
            density = gaussian_filter1d(np.histogram(offsets, bins, weights=count)[0], 0.7 * noise_m / step)
            sharpness = float((density**2).sum() / density.sum() ** 2)
            if sharpness > sharpest:
                sharpest, best = sharpness, (middle, offsets, count, density)
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
        moved = middle.normal * offset
        start = replace(
            middle,
            offset_m=middle.offset_m + offset,
            patches_m=middle.patches_m + moved,
            centre_m=middle.centre_m + moved,
        )
        index = np.flatnonzero(rest)
        own = index[near(start, cloud.points_m[index], BAND * noise_m, 0.0)]
        if len(own) >= FEWEST_VOXELS / 2:
            if len(at) > 1:
                start = replace(start, patches_m=_bounds(start, cloud.points_m[own]))
            planes.append(fit(cloud.points_m[own], cloud.count[own], start, noise_m))
    return planes
