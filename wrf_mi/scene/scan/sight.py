"""What a scanner saw of a plane (the plane, a thing before it, a place beyond it, nothing), and walls of few points.

A scan from a known place says more than its points: each beam was free up to its return. The returns far from the
scanner, and those at a grazing angle, are too sparse to show by their density where a plane ends, but the picture of
all directions has no gaps. The places where scanners stood come from the files, or from the scan where it is one alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy import ndimage
from scipy.signal import find_peaks
from scipy.spatial import cKDTree

from ...core.angles import FloatArray
from ...core.types import IntArray
from ..mesh.planes import LEVEL, WALL_HEIGHT_M, Face, Mask, Plane, with_axes
from .planes import AROUND, BAND, CELL_RANGE_M, FEWEST_VOXELS, LAYER_CORE, fit, off_planes, repeats

MOST_BEAMS = 400_000  # beams of a scanner that are used: 0.3 degrees apart over the sphere
DIRECTIONS = 4000  # directions by which a scan is judged
NEAREST = 1.5  # a direction farther from every beam than this many spacings of the beams was not looked at
STEP_M, STEP_SHARE = 0.3, 0.1  # least difference of neighbouring ranges that is an edge, metres and share of the range
MOST_EDGES = 0.05  # neighbours with an edge between them: 3 % in a furnished room, many more seen from elsewhere
LEAST_SEEN = 0.6  # least share of the sphere that a scanner saw whose place no file states: a corner sees an eighth
SPARSE_M2, SPARSE_CONTRAST, SPARSE_AROUND_M = 2.0, 2.0, 0.5
"""Least area of the cells with points of a wall of few points, also relative to that of planes within a distance."""
MOST_LEAN, LEAN_RAD = 3, np.radians(1.0)  # steps by which walls are sought that lean, as in scans of a poor scanner
SAME_HEADING_RAD = np.radians(3.0)  # angle up to which walls count as parallel
UNSEEN, ON, BEFORE, BEYOND = range(4)
"""What the beam nearest to a point of a plane met: nothing near, the plane, a place before it, or one beyond it."""


@dataclass(frozen=True, eq=False)
class Sight:
    """Returns of a scanner.

    Attributes:
        place_m: where it stood [3].
        points_m: its returns [n, 3].
        rows: their numbers in the cloud [n].
    """

    place_m: FloatArray
    points_m: FloatArray
    rows: IntArray

    @cached_property
    def _beams(self) -> tuple[cKDTree, IntArray, float]:
        """Unit vectors of the beams, numbers of their returns among `points_m`, and their usual spacing (chord)."""
        beams = np.flatnonzero((self.points_m != self.place_m).any(axis=1))
        if len(beams) > MOST_BEAMS:
            beams = np.random.default_rng(1).choice(beams, MOST_BEAMS, replace=False)
        directions = _directions(self.points_m[beams] - self.place_m)
        tree = cKDTree(directions)
        near, _ = tree.query(directions[:: len(directions) // DIRECTIONS + 1], k=5)  # itself and four beside it
        return tree, beams, float(np.quantile(near[:, -1], 0.9))

    def fits(self, least_seen: float = 0.0) -> bool:
        """Whether neighbouring beams mostly return from one surface, over at least a share of the sphere.

        From another place than the scanner's, surfaces that hide one another lie between each other's points.
        """
        if len(self.points_m) < DIRECTIONS:
            return False
        tree, beams, spacing = self._beams
        random = np.random.default_rng(2).normal(size=(DIRECTIONS, 3))
        away, index = tree.query(_directions(random), k=2)
        looked = away[:, 0] < NEAREST * spacing
        if not looked.any():
            return False
        near, far = np.sort(np.linalg.norm(self.points_m[beams[index[looked]]] - self.place_m, axis=-1), axis=1).T
        edges = np.mean(far - near > STEP_M + STEP_SHARE * near)
        return bool(looked.mean() >= least_seen and edges <= MOST_EDGES)

    def on_plane(self, plane: Plane, targets_m: FloatArray, band_m: float) -> tuple[NDArray[np.int8], IntArray]:
        """`UNSEEN`, `ON`, `BEFORE` or `BEYOND` for points [n, 3] of a plane, and numbers [n] of the returns there."""
        tree, beams, spacing = self._beams
        angle, index = tree.query(_directions(targets_m - self.place_m))
        side = plane.distance(self.points_m[beams[index]]) * np.sign(plane.distance(self.place_m))
        state = np.where(side > band_m, BEFORE, np.where(side < -band_m, BEYOND, ON))
        return np.where(angle < NEAREST * spacing, state, UNSEEN).astype(np.int8), self.rows[beams[index]]

    def behind(self, points_m: FloatArray, walls: Sequence[Face], margin_m: float) -> Mask:
        """Which points [n, 3] lie behind walls, seen through an opening within the rectangle of one of them."""
        hidden = np.zeros(len(points_m), bool)
        for wall in walls:
            plane, start = wall.plane, float(wall.plane.distance(self.place_m))
            end = plane.distance(points_m) * np.sign(start)
            crossing = np.flatnonzero((end < -margin_m) & ~hidden)
            if abs(start) <= margin_m or not len(crossing):
                continue
            share = abs(start) / (abs(start) - end[crossing])
            meeting = self.place_m + share[:, None] * (points_m[crossing] - self.place_m)
            hidden[crossing] = shapely.contains_xy(shapely.envelope(wall.area), plane.flat(meeting))
        return hidden


def _directions(away: FloatArray) -> FloatArray:
    return np.asarray(away / np.maximum(np.linalg.norm(away, axis=-1, keepdims=True), np.finfo(float).tiny))


def sights_of(points_m: FloatArray, viewpoints_m: FloatArray, viewpoint: IntArray, origin_m: FloatArray) -> list[Sight]:
    """Scanners of a cloud whose places fit their points; of one without a stated place, it may be the origin.

    Args:
        points_m: shape [n, 3], metres.
        viewpoints_m: places that files state [k, 3].
        viewpoint: number of each point's place [n], -1 for none.
        origin_m: origin of the file [3]: a single scan in the frame of its scanner has it there, whatever its format.
    """
    if len(viewpoints_m):
        rows = [np.flatnonzero(viewpoint == k) for k in range(len(viewpoints_m))]
        scanners = [Sight(place, points_m[part], part) for place, part in zip(viewpoints_m, rows, strict=True)]
        return [sight for sight in scanners if sight.fits()]
    origin = Sight(origin_m, points_m, np.arange(len(points_m)))
    return [origin] if origin.fits(LEAST_SEEN) else []


def returns_and_shadows(
    sights: Sequence[Sight], plane: Plane, targets_m: FloatArray, walls: Sequence[Face], band_m: float, before: Mask
) -> tuple[IntArray, Mask]:
    """What scanners saw of points [n, 3] of a plane.

    Args:
        sights: the scanners.
        plane: the plane.
        targets_m: points of it, metres.
        walls: points behind them count as not seen.
        band_m: largest distance of returns from the plane.
        before: points of the cloud that hide what is behind them.

    Returns:
        Number of the return [n] from the plane next to each point, -1 for none; and which points are hidden by others,
        or on a floor not looked at: a scanner is blind below itself.
    """
    on, hidden, open_ = np.full(len(targets_m), -1), np.zeros(len(targets_m), bool), np.zeros(len(targets_m), bool)
    for sight in sights:
        state, row = sight.on_plane(plane, targets_m, band_m)
        inside = ~sight.behind(targets_m, walls, band_m)
        is_floor = abs(plane.normal[2]) > LEVEL and targets_m[:, 2].mean() < sight.place_m[2]
        on = np.where((state == ON) & inside, row, on)
        open_ |= (state == BEYOND) & inside
        hidden |= inside & (((state == BEFORE) & before[row]) | (is_floor & (state == UNSEEN)))
    return on, hidden & (on < 0) & ~open_


def sparse_walls(points_m: FloatArray, walls: Sequence[Plane], planes: Sequence[Plane], noise_m: float) -> list[Plane]:
    """Planes parallel or square to walls in the points [n, 3] of no plane, too few for a flat patch.

    A wall far away, or seen through a gap, has few points, but these lie in one plane over a room's height.
    """
    points = points_m[off_planes(planes, points_m, BAND * noise_m)]
    # Of a scanner that is not level, walls are upright in the frame of the floor.
    up = next((plane.normal for plane in planes if abs(plane.normal[2]) > LEVEL), np.array([0.0, 0.0, 1.0]))
    candidates = list[tuple[float, Plane]]()
    for normal, lean in product(_headings(walls, up), np.arange(-MOST_LEAN, MOST_LEAN + 1) * LEAN_RAD):
        candidates += _parallel_planes(points, np.cos(lean) * normal + np.sin(lean) * up, noise_m)
    chosen = list[Plane]()
    for _, plane in sorted(candidates, key=lambda pair: -pair[0]):
        if not repeats(plane, [*planes, *chosen], AROUND * noise_m):
            chosen.append(fit(points, np.ones(len(points)), plane, noise_m))
    return chosen


def _headings(walls: Sequence[Plane], up: FloatArray) -> list[FloatArray]:
    """Distinct normals of walls, and of planes square to them."""
    headings = list[FloatArray]()
    for normal in (side for wall in walls for side in (wall.normal, np.cross(up, wall.normal))):
        if all(abs(normal @ other) < np.cos(SAME_HEADING_RAD) for other in headings):
            headings.append(normal / np.linalg.norm(normal))
    return headings


def _parallel_planes(points: FloatArray, normal: FloatArray, noise_m: float) -> list[tuple[float, Plane]]:
    """Planes of a direction in which points [n, 3] lie over a larger area than beside them, and these areas."""
    if not len(points):
        return []
    across, side = points @ normal, CELL_RANGE_M[1]
    low, step = across.min(), 2 * noise_m
    along = np.floor(np.stack([points @ np.cross((0, 0, 1), normal), points[:, 2]]) / side)
    bins = np.floor((across - low) / step)
    cells = np.unique(np.stack([bins, *along]).astype(int), axis=1)[0]
    covered = np.convolve(np.bincount(cells), np.ones(2)) * side**2  # a plane lies in two neighbouring bins
    usual = ndimage.median_filter(covered, 2 * int(SPARSE_AROUND_M / step) + 1, mode="constant")
    peaks, _ = find_peaks(np.pad(covered, 1), height=SPARSE_M2, distance=AROUND / 2)
    planes = []
    for peak in peaks - 1:
        inside = np.abs(across - low - peak * step) < step
        if covered[peak] < SPARSE_CONTRAST * usual[peak] or np.count_nonzero(inside) < FEWEST_VOXELS:
            continue
        chosen = points[np.abs(across - np.median(across[inside])) < BAND * noise_m]
        centre = chosen.mean(axis=0)
        plane = with_axes(Plane(normal, float(centre @ normal), np.empty((0, 4, 3)), centre, np.inf, sparse=True))
        bounds = np.quantile(plane.flat(chosen), LAYER_CORE, axis=0)
        if np.ptp(bounds, axis=0)[1] >= WALL_HEIGHT_M / 2:
            planes.append((float(covered[peak]), replace(plane, patches_m=plane.rectangle(*bounds)[None])))
    return planes
