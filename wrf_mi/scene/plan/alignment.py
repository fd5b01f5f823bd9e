"""Alignment of scans of a floor, the places of their sensor, and the space that it saw empty.

Poses of a robot's positioning blur a map by decimetres and turn parts of it. Scans taken while standing still are
merged into stops, each stop is matched to the map of those before it (correlative scan matching: Olson 2009, ICRA),
and all are refined against all others. The sensor's place is where no return lies behind another in the same direction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from skimage.draw import line

from ...core.angles import FloatArray
from .lines import rotation_2d
from .sources import POINT_CELL_M, Mask, PlanGrid, grid_from_points

STANDING_S = 1.0  # largest time between successive scans of a stop
SAME_STOP = 0.6  # least match of a scan with the stop before it; two scans from the same place match to 0.8 or more
SAME_PLACE = 0.5  # least match of a stop with the map; with less it keeps its pose
STAYS = 0.2  # least share of a stop's scans that see a cell: moving things and noise are seen once
POSE_DEVIATION_M, POSE_DEVIATION_RAD = 0.4, np.radians(8)
"""Standard deviations of a robot's positioning; they penalise matches with the wrong wall."""
POSE_WEIGHT = 0.05
HIDDEN_SHARE = 0.15  # largest share of a scan's returns that may lie behind others as seen from the sensor
BEHIND_M = 0.15
"""Least distance by which a return lies behind another in the same direction, more than the slope of an edge."""
BEARINGS = 240  # directions in which returns hide one another
SECTORS = 36  # sectors over which returns are spread evenly
SEARCH_M = 0.1  # step of the search for the sensor
ROUNDS = 3

Step = tuple[float, float, float, float]
"""Half-width and step of a search over shifts (metres) and over turns (degrees)."""
Steps = tuple[Step, ...]
WITHIN_STOP: Steps = ((0.2, 0.05, 3, 1), (0.04, 0.01, 0.6, 0.2))
COARSE: Step = (0.6, 0.15, 12, 3)
FINE: Steps = ((0.15, 0.05, 3, 1), (0.05, 0.0125, 0.75, 0.25))
REFINING: Steps = ((0.1, 0.05, 2, 1), (0.05, 0.0125, 0.5, 0.25))
COARSE_POINTS = 120


@dataclass(eq=False)
class _Stop:
    """Returns seen from a place in a common frame; the pose (x, y, angle) moves them about their middle."""

    points: FloatArray
    sensor: FloatArray | None
    pose: FloatArray

    def moved(self, points: FloatArray) -> FloatArray:
        return _moved(points, self.pose, self.points.mean(axis=0))


def _moved(points: FloatArray, pose: FloatArray, middle: FloatArray) -> FloatArray:
    return (points - middle) @ rotation_2d(pose[2]).T + middle + pose[:2]


class _Canvas:
    """Pictures of points in cells of one grid; axes x, y."""

    def __init__(self, xy_m: FloatArray) -> None:
        self.low = xy_m.min(axis=0) - 2 * COARSE[0]
        self.shape = tuple(np.ceil((xy_m.max(axis=0) + 2 * COARSE[0] - self.low) / POINT_CELL_M).astype(int) + 1)

    def cells(self, points: FloatArray) -> NDArray[np.intp]:
        """Indices [n, 2], clipped to the picture."""
        return np.clip(np.floor((points - self.low) / POINT_CELL_M).astype(int), 0, np.array(self.shape) - 1)

    def image(self, points: FloatArray) -> Mask:
        """Cells that hold a point."""
        image = np.zeros(self.shape, bool)
        image[tuple(self.cells(points).T)] = True
        return image

    def closeness(self, image: Mask, deviation_m: float) -> FloatArray:
        """1 in cells of the image, falling with the distance from them as a Gaussian."""
        away = ndimage.distance_transform_edt(~image) * POINT_CELL_M
        return np.exp(-0.5 * (away / deviation_m) ** 2)

    def match(
        self, field: FloatArray, points: FloatArray, middle: FloatArray, pose: FloatArray, steps: Steps, weight: float
    ) -> tuple[FloatArray, float]:
        """The pose near a first one that lays points best on a field, and the mean of the field there."""
        mean = 0.0
        for reach, pitch, turn, turn_pitch in steps:
            start, best = pose, -np.inf
            shifts = np.arange(-reach, reach + 1e-9, pitch)
            shift = np.stack(np.meshgrid(shifts, shifts, indexing="ij"), axis=-1).reshape(-1, 2)
            for angle in start[2] + np.radians(np.arange(-turn, turn + 1e-9, turn_pitch)):
                turned = _moved(points, np.array([start[0], start[1], angle]), middle)
                at = (turned[None] + shift[:, None] - self.low) / POINT_CELL_M - 0.5
                values = ndimage.map_coordinates(field, at.reshape(-1, 2).T, order=1)
                value = values.reshape(len(shift), -1).mean(axis=1)
                # The log of a normal prior about the stated pose: a wrong wall matches as well a metre away.
                off = ((start[:2] + shift) ** 2).sum(axis=1) / POSE_DEVIATION_M**2 + (angle / POSE_DEVIATION_RAD) ** 2
                score = value - weight * off
                i = int(np.argmax(score))
                if score[i] > best:
                    best, mean = float(score[i]), float(value[i])
                    pose = np.array([*(start[:2] + shift[i]), angle])
        return pose, mean


def grid_from_scans(xy_m: FloatArray, time_s: FloatArray) -> PlanGrid:
    """A map in cells of `POINT_CELL_M`: cells that were hit, and cells that beams went through.

    Of returns [n, 2] in a common frame, each scan moved by its pose, which may be off by some decimetres, and the time
    of each return's scan [n]. Errors are those of `wrf_mi.scene.plan.sources.grid_from_points`.
    """
    grid_from_points(xy_m)  # raises before the search
    canvas = _Canvas(xy_m)
    stops = _stops(xy_m, time_s, canvas)
    _place(stops, canvas)
    for _ in range(ROUNDS):
        _refine(stops, canvas)
    return _voted(stops)


def _stops(xy_m: FloatArray, time_s: FloatArray, canvas: _Canvas) -> list[_Stop]:
    """Stops: successive scans aligned with the first of them, then moved to their mean pose."""
    times, number = np.unique(time_s, return_inverse=True)
    groups: list[list[tuple[FloatArray, FloatArray]]] = []
    field, pose = np.zeros(canvas.shape), np.zeros(3)
    for i in range(len(times)):
        raw = xy_m[number == i]
        if i and times[i] - times[i - 1] <= STANDING_S:
            middle = raw.mean(axis=0)
            matched, mean = canvas.match(field, raw, middle, pose, WITHIN_STOP, 0.0)
            if mean >= SAME_STOP:
                pose = matched
                groups[-1].append((raw, _moved(raw, pose, middle)))
                continue
        pose = np.zeros(3)
        groups.append([(raw, raw)])
        field = canvas.closeness(canvas.image(raw), 0.07)
    stops = []
    for group in groups:
        back = np.median([(raw - moved).mean(axis=0) for raw, moved in group], axis=0)
        scans = [moved + back for _, moved in group]
        # A return of each cell that enough of the scans hit.
        count, points = np.sum([canvas.image(scan) for scan in scans], axis=0), np.concatenate(scans)
        cells = canvas.cells(points)
        _, first = np.unique(cells, axis=0, return_index=True)
        lasting = first[count[tuple(cells[first].T)] >= max(1, STAYS * len(scans))]
        stops.append(_Stop(points[lasting], sensor_of(max(scans, key=len)), np.zeros(3)))
    return stops


def sensor_of(scan_m: FloatArray) -> FloatArray | None:
    """Place [2] of the sensor of a scan [n, 2]: the fewest returns lie behind others; None where too many do
    everywhere.
    """
    # Most returns surround the sensor, few come from far away.
    low, high = np.percentile(scan_m, (2, 98), axis=0)
    axes = [np.linspace(a, b, min(100, max(2, int((b - a) / SEARCH_M)))) for a, b in zip(low, high, strict=True)]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    hidden, uneven = np.array([_seen_from(scan_m, place) for place in places]).T
    if hidden.min() > HIDDEN_SHARE * len(scan_m):
        return None
    # In a convex room all places see all returns: among those that hide as few, returns are spread most evenly about
    # the sensor, because it turns at a constant rate.
    possible = hidden <= hidden.min() + 0.01 * len(scan_m)
    return np.asarray(places[possible][np.argmin(uneven[possible])])


def _seen_from(scan_m: FloatArray, place: FloatArray) -> tuple[int, int]:
    """Number of returns behind another return, or at the place, and unevenness of their directions."""
    away = scan_m - place
    distance = np.hypot(away[:, 0], away[:, 1])
    turn = np.arctan2(away[:, 1], away[:, 0]) / (2 * np.pi) + 0.5
    bearing = (turn * BEARINGS).astype(int) % BEARINGS
    nearest = np.full(BEARINGS, np.inf)
    np.minimum.at(nearest, bearing, distance)
    hidden = np.count_nonzero((distance > nearest[bearing] + BEHIND_M) | (distance < BEHIND_M))
    sectors = np.bincount((turn * SECTORS).astype(int) % SECTORS, minlength=SECTORS)
    return int(hidden), int((sectors**2).sum())


def _place(stops: list[_Stop], canvas: _Canvas) -> None:
    """Match each stop to the map of those placed, the largest stop first, then the stop with the most overlap."""
    unplaced = sorted(stops, key=lambda stop: -len(stop.points))
    image = canvas.image(unplaced.pop(0).points)
    while unplaced:
        rough = canvas.closeness(image, 0.12)
        stop = max(unplaced, key=lambda stop: float(rough[tuple(canvas.cells(stop.points).T)].mean()))
        unplaced.remove(stop)
        middle = stop.points.mean(axis=0)
        sparse = stop.points[:: max(1, len(stop.points) // COARSE_POINTS)]
        pose, _ = canvas.match(rough, sparse, middle, stop.pose, (COARSE,), POSE_WEIGHT)
        pose, mean = canvas.match(canvas.closeness(image, 0.08), stop.points, middle, pose, FINE, POSE_WEIGHT)
        if mean >= SAME_PLACE:
            stop.pose = pose
        image |= canvas.image(stop.moved(stop.points))


def _refine(stops: list[_Stop], canvas: _Canvas) -> None:
    """Match each stop to the map of all other stops."""
    count = np.sum([canvas.image(stop.moved(stop.points)) for stop in stops], axis=0)
    for stop in stops:
        count = count - canvas.image(stop.moved(stop.points))
        if count.any():
            field, middle = canvas.closeness(count > 0, 0.07), stop.points.mean(axis=0)
            pose, mean = canvas.match(field, stop.points, middle, stop.pose, REFINING, POSE_WEIGHT)
            if mean >= SAME_PLACE:
                stop.pose = pose
        count = count + canvas.image(stop.moved(stop.points))


def _voted(stops: list[_Stop]) -> PlanGrid:
    """A cell is occupied if at least half as many stops hit it as look through it, else free if any looks through."""
    clouds = [stop.moved(stop.points) for stop in stops]
    grid = grid_from_points(np.concatenate(clouds))
    hits, passes = np.zeros(grid.occupied.shape, int), np.zeros(grid.occupied.shape, int)
    for stop, cloud in zip(stops, clouds, strict=True):
        column, row = ((cloud - grid.origin_m) / grid.resolution_m).astype(int).T
        hit = np.zeros(grid.occupied.shape, bool)
        hit[row, column] = True
        hits += hit
        if stop.sensor is None:
            continue
        begin = ((stop.moved(stop.sensor[None])[0] - grid.origin_m) / grid.resolution_m).astype(int)
        through = np.zeros_like(hit)
        for end_row, end_column in zip(row, column, strict=True):
            rows, columns = line(begin[1], begin[0], end_row, end_column)
            through[rows[:-2], columns[:-2]] = True
        passes += through & ~hit
    occupied = (hits > 0) & (2 * hits >= passes)
    return PlanGrid(occupied, (passes > 0) & ~occupied, grid.resolution_m, grid.origin_m)
