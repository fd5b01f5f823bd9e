"""Extents of planes: areas with holes that their points cover, with shadows filled and corners closed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy import ndimage
from shapely import affinity

from ...core.angles import FloatArray
from ...core.types import IntArray
from .planes import LEVEL, STOREY_M, Face, Mask, Plane
from .surfaces import Kind

CELL_RANGE_M = (0.04, 0.25)
POINTS_PER_CELL = 8  # number of points in the cells of the sparse fifth of the area, which sets the cells' size
SHARE = 0.2
"""Least number of points of an occupied cell, relative to those around it: half of the last cell is on the plane."""
EDGE_SHARE = 0.3
"""Share of a cell by which an edge is found too far out: a last cell filled to a share x of `SHARE` to 1 counts, and
the mean of 1 - x times its chance is 0.32."""
AROUND_CELLS = 5
CLOSED_CELLS = 1  # gaps of up to twice this many cells are noise
STRAY_SIZE, STRAY_DENSITY = 0.05, 0.25
"""A stray part of an area is smaller than this share of the whole and sparser than this share."""
SMALL_HOLE_M2 = 0.1
SMALLEST_M2 = 0.04
RECTANGLE_SHARE, GROWN_SHARE = 0.88, 0.96
"""Least share of its tightest rectangle that a rectangular area fills; also of one with places told by beams."""
NOTCH_M = 0.4  # least width of a notch
SCAN_LINES = 31
SHADOW_CELL_M = 0.1
BEFORE_M = {"wall": 1.2, "floor": 2.5, "ceiling": 2.5}
"""Largest distance from a surface of what hides it: cupboards; tables and lamps."""
HIDDEN_SHARE = 0.5  # least share of a gap before which something stands, for the gap to be filled
SMALLEST_GAP_M2 = 0.02
STEEPEST = np.cos(np.radians(20))  # planes that meet at a smaller angle have no reliable line in common
RASTER_M, MOST_CELLS = 0.1, 400_000  # side of the cells in which it is told what was seen, and their largest number
LEAST_ADDED_M2 = 0.2  # least area by which another one grows
LARGEST_BLIND_M2 = 12.0  # a scanner 2 m high that sees down to 45 degrees is blind below it on as much
GRID_M = 1e-5
SEAM_M = 1e-3  # half-width of the slits that rounding leaves between an area and its complement
PASSES = 2  # number of passes over all pairs of planes; the second pass closes the corner of three planes


def outline(plane: Plane, points_m: FloatArray) -> tuple[Any, float]:
    """The area (shapely, in the plane's coordinates) that points [n, 3] of a plane cover, and the edge of its cells."""
    flat = plane.flat(points_m).astype(float)
    coarse = 0.1
    _, number = np.unique(np.floor(flat / coarse).astype(int), axis=0, return_counts=True)
    # Cells with a single point are strays; the sparse fifth, far from the scanner, sets the size of cells.
    sparse = np.quantile(number[number > 1], 0.2) if (number > 1).any() else 1.0
    cell = float(np.clip(coarse * np.sqrt(POINTS_PER_CELL / sparse), *CELL_RANGE_M))
    low = flat.min(axis=0) - (CLOSED_CELLS + 2) * cell
    bins = np.ceil((flat.max(axis=0) - low) / cell).astype(int) + CLOSED_CELLS + 2
    index = ((flat - low) / cell).astype(int)
    count = np.bincount(np.ravel_multi_index(tuple(index.T), tuple(bins)), minlength=bins.prod()).reshape(bins)
    area = boxes(_covered(count, cell), low, cell)
    # A notch of a floor or ceiling is a corner of the building; of a wall, something stands before it.
    is_level = abs(plane.normal[2]) > LEVEL
    parts = [
        (None if is_level and _is_notched(part) else _rectangle(part)) or part.simplify(1.2 * cell)
        for part in polygons(area)
    ]
    # Edges are moved inwards because a cell that the edge crosses counts as a whole.
    return shapely.buffer(shapely.union_all(parts), -EDGE_SHARE * cell, join_style="mitre"), cell


def boxes(mask: Mask, low: FloatArray, cell: float) -> Any:
    """The area of the marked cells: a rectangle for each run of them."""
    steps = np.diff(np.pad(mask, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    row, start = np.nonzero(steps == 1)
    _, stop = np.nonzero(steps == -1)
    x, y0, y1 = low[0] + row * cell, low[1] + start * cell, low[1] + stop * cell
    return shapely.union_all(shapely.box(x, y0, x + cell, y1), grid_size=cell * 1e-3)


@dataclass(frozen=True)
class Raster:
    """Cells over a part of a plane, in its coordinates: lowest corner [2], side, and numbers of cells."""

    low_m: FloatArray
    cell_m: float
    shape: tuple[int, int]

    @classmethod
    def around(cls, flat_m: FloatArray) -> Raster:
        """Cells around points [n, 2], larger ones where there would be more than `MOST_CELLS`."""
        low, size = flat_m.min(axis=0), np.ptp(flat_m, axis=0)
        cell = max(RASTER_M, float(np.sqrt(np.prod(size) / MOST_CELLS)))
        rows, columns = (np.ceil(size / cell).astype(int) + 1).tolist()
        return cls(low, cell, (rows, columns))

    @property
    def centres_m(self) -> FloatArray:
        """Centres of the cells [n, 2]."""
        return self.low_m + (np.indices(self.shape).reshape(2, -1).T + 0.5) * self.cell_m

    def image(self, values: Mask) -> Mask:
        """Values [n] of cells as a picture."""
        return values.reshape(self.shape)

    def covered(self, area: Any) -> Mask:
        """Cells whose centres lie in an area."""
        return self.image(shapely.contains_xy(area, self.centres_m))

    def grown(self, area: Any, mask: Mask) -> Any:
        """An area with the connected parts of a mask that meet it and are broad; others are noise along its edges."""
        inside = self.covered(area)
        parts, count = ndimage.label(mask | inside)
        meets = np.isin(np.arange(count + 1), np.unique(parts[inside])) & (np.arange(count + 1) > 0)
        beyond = ndimage.binary_opening(meets[parts] & ~inside, np.ones((2, 2)))
        added = boxes(large_parts(beyond, LEAST_ADDED_M2 / self.cell_m**2), self.low_m, self.cell_m)
        if added.is_empty:
            return area
        # Cells of the area that the added ones touch would leave a seam.
        cells = boxes(mask | inside, self.low_m, self.cell_m)
        seam = shapely.intersection(shapely.buffer(added, 2 * self.cell_m, join_style="mitre"), cells)
        grown = shapely.union_all([area, added, seam], grid_size=GRID_M)
        grown = shapely.union_all([grown, *(hole for hole in _holes(grown) if hole.area < SMALL_HOLE_M2)])
        parts = [_rectangle(part, GROWN_SHARE) or part.simplify(1.2 * self.cell_m) for part in polygons(grown)]
        return shapely.union_all(parts)


def _holes(area: Any) -> list[Any]:
    return [shapely.polygons(ring) for part in polygons(area) for ring in part.interiors]


def fill_blind(plane: Plane, area: Any, walls: Sequence[Face], points_m: FloatArray, band_m: float) -> Any:
    """The area of a floor with the holes filled below which nothing was seen, and about which no walls stand.

    A scanner does not see the floor below it. Through a hole of the floor it would see what is under it.
    """
    below = plane.distance(points_m) * np.sign(plane.normal[2])
    flat = plane.flat(points_m[(below < -band_m) & (below > -STOREY_M)])
    lines = [shapely.transform(wall.area, lambda uv, wall=wall: plane.flat(wall.plane.lift(uv))) for wall in walls]
    about = shapely.buffer(shapely.union_all([shapely.boundary(line) for line in lines]), 2 * band_m)
    filled = [area]
    for ring in _holes(area):
        walled = shapely.intersection(ring.exterior, about).length > HIDDEN_SHARE * ring.exterior.length
        if ring.area <= LARGEST_BLIND_M2 and not walled and not shapely.contains_xy(ring, flat).any():
            filled.append(ring)
    return area if len(filled) == 1 else shapely.union_all(filled, grid_size=GRID_M)


def fill_shadows(plane: Plane, area: Any, kind: Kind, points_m: FloatArray, noise_m: float) -> Any:
    """The area of a floor, ceiling or wall with its shadows filled: gaps before which things stand.

    A gap with nothing before it (a door, a window, the missing quarter of an L-shaped room) stays. The points [n, 3]
    are those of things alone, since floors, ceilings and walls are seen through a gap and do not hide it.
    """
    if kind == "other":
        return area
    distance = np.abs(plane.distance(points_m))
    before = (distance > max(0.05, 4 * noise_m)) & (distance < BEFORE_M[kind])
    flat = plane.flat(points_m[before])
    filled = [area]
    for gap in polygons(shapely.difference(shapely.envelope(area), area)):
        if gap.area < SMALLEST_GAP_M2:
            continue
        if _is_hidden(gap, flat):
            filled.append(gap)
    return shapely.union_all(filled, grid_size=GRID_M)


def shadows(raster: Raster, plane: Plane, kind: Kind, points_m: FloatArray, noise_m: float) -> Mask:
    """Cells of a floor, ceiling or wall before which points [n, 3] of things lie, along its normal."""
    distance = np.abs(plane.distance(points_m))
    before = (distance > max(0.05, 4 * noise_m)) & (distance < BEFORE_M[kind])
    cell = np.floor((plane.flat(points_m[before]) - raster.low_m) / raster.cell_m).astype(int)
    cell = cell[((cell >= 0) & (cell < raster.shape)).all(axis=1)]
    hidden = np.zeros(raster.shape, bool)
    hidden[tuple(cell.T)] = True
    return np.asarray(ndimage.binary_closing(np.pad(hidden, 1), np.ones((3, 3)))[1:-1, 1:-1])


def levels_completed(
    planes: Sequence[Plane], areas: Sequence[Any], roles: Sequence[Kind], points_m: FloatArray, band_m: float
) -> list[Any]:
    """Areas with floors completed below their ceilings, and ceilings above their floors.

    What stands on a floor hides it, but not the ceiling above. A gap behind which points [n, 3] lie, such as a
    stairwell, is left, and so is one beside no floor or ceiling.
    """
    areas = list(areas)
    levels = [(kind, float(planes[i].lift(_middle(areas[i]))[2]), i) for i, kind in enumerate(roles)]
    floors_m = np.array([height for kind, height, _ in levels if kind == "floor"])
    for kind, other, side in (("floor", "ceiling", 1), ("ceiling", "floor", -1)):
        of_kind = [(height, i) for each, height, i in levels if each == kind]
        for height, number in of_kind:
            plane = planes[number]
            opposite = [
                i
                for each, at, i in levels
                if each == other and side * (at - height) > STOREY_M and not _between(floors_m, height, at).any()
            ]
            covered, visible = (
                shapely.union_all([_seen_on(plane, planes[i], areas[i]) for i in chosen])
                for chosen in ([i for _, i in of_kind], opposite)
            )
            behind = -plane.distance(points_m) * np.sign(plane.normal[2]) * side
            flat = plane.flat(points_m[(behind > band_m) & (behind < STOREY_M)])
            gaps = polygons(opened(shapely.difference(visible, covered), SEAM_M))
            gaps = [gap for gap in gaps if gap.area > SMALLEST_GAP_M2 and not _is_hidden(gap, flat)]
            beside = [gap for gap in gaps if shapely.distance(gap, areas[number]) < RASTER_M]
            if beside:
                areas[number] = merged([areas[number], *beside])
    return areas


def _between(heights: FloatArray, first: float, second: float) -> Mask:
    """Which heights lie between two others, a storey's from both."""
    low, high = min(first, second), max(first, second)
    return (heights > low + STOREY_M) & (heights < high)


def _middle(area: Any) -> FloatArray:
    return np.array(area.centroid.coords[0] if not area.is_empty else (np.nan, np.nan))


def _seen_on(plane: Plane, other: Plane, area: Any) -> Any:
    """The area of another plane in the coordinates of a plane that is not upright, above or below it."""

    def above(uv: FloatArray) -> FloatArray:
        x, y = other.lift(uv)[:, :2].T
        z = (plane.offset_m - plane.normal[0] * x - plane.normal[1] * y) / plane.normal[2]
        return plane.flat(np.stack([x, y, z], axis=1))

    return shapely.make_valid(shapely.transform(area, above))


def _is_hidden(gap: Any, flat_m: FloatArray) -> bool:
    """Whether points [n, 2], those of things before or behind it, cover most of a gap."""
    inside = flat_m[shapely.contains_xy(gap, flat_m)]
    cells = len(np.unique(np.floor(inside / SHADOW_CELL_M), axis=0))
    return bool(cells * SHADOW_CELL_M**2 >= HIDDEN_SHARE * gap.area)


def polygons(area: Any) -> list[Any]:
    """The polygons of an area, the largest first."""
    parts = [part for part in shapely.get_parts(area) if part.geom_type == "Polygon" and not part.is_empty]
    return sorted(parts, key=lambda part: -part.area)


def join(planes: Sequence[Plane], areas: Sequence[Any], reach_m: Sequence[float]) -> list[Any]:
    """Areas (shapely, each in its plane's coordinates) extended or cut to the lines where their planes meet.

    Where two areas come within ``reach_m`` of the common line along the same stretch of it, an area on one side of the
    line is made to end there; an area on both sides stays, and the other ends at it.
    """
    areas = list(areas)
    corners = [_corners(plane, area) for plane, area in zip(planes, areas, strict=True)]
    for i, j in PASSES * list(permutations(range(len(planes)), 2)):
        a, b, reach = planes[i], planes[j], min(reach_m[i], reach_m[j])
        if (
            abs(a.normal @ b.normal) < STEEPEST
            and not _beside(b, corners[i], reach)
            and not _beside(a, corners[j], reach)
        ):
            areas[i] = _end_at(a, areas[i], b, areas[j], reach)
            corners[i] = _corners(a, areas[i])
    return areas


def _corners(plane: Plane, area: Any) -> FloatArray:
    """Corners [4, 3] of a rectangle of a plane around an area; not finite for an empty one."""
    low_u, low_v, high_u, high_v = area.bounds
    return plane.rectangle(np.array([low_u, low_v]), np.array([high_u, high_v]))


def _beside(plane: Plane, corners_m: FloatArray, reach_m: float) -> bool:
    """Whether all of a rectangle lies on one side of a plane and out of reach: no further than a line of the plane."""
    distance = plane.distance(corners_m)
    return bool(distance.min() > reach_m + GRID_M or distance.max() < -reach_m - GRID_M)


def _end_at(a: Plane, area: Any, b: Plane, other: Any, reach: float) -> Any:
    along = np.cross(a.normal, b.normal)
    along /= np.linalg.norm(along)
    point = np.linalg.solve(np.stack([a.normal, b.normal, along]), np.array([a.offset_m, b.offset_m, 0.0]))

    def to_line(plane: Plane) -> tuple[FloatArray, FloatArray]:
        """Transform to coordinates (t, s): t along the line, s away from it."""
        rows = np.stack([along, np.cross(plane.normal, along)])
        return rows @ np.stack([plane.u, plane.v], axis=1), rows @ (plane.normal * plane.offset_m - point)

    matrix, shift = to_line(a)
    turned, other_turned = _transformed(area, matrix, shift), _transformed(other, *to_line(b))
    stretches = shapely.intersection(
        shapely.buffer(_stretches(other_turned, reach), reach, cap_style="square"), _stretches(turned, reach)
    )
    changed = turned
    for stretch in polygons(stretches):
        t0, _, t1, _ = stretch.bounds
        if t1 - t0 < reach:
            continue
        # An area that reaches both sides of the line goes through, one that reaches one side ends there.
        share = [
            shapely.intersection(turned, shapely.box(t0, s, t1, s + reach)).area / (reach * (t1 - t0))
            for s in (reach, -2 * reach)
        ]
        if (share[0] > 0.25) == (share[1] > 0.25):
            continue
        sign = 1 if share[0] > share[1] else -1
        # The parts of the strip beside the line that the area comes near are filled up to the line.
        near = [part.bounds for part in polygons(shapely.intersection(turned, _box(t0, t1, 0, sign * reach)))]
        fill = [_box(max(s[0], t0), min(s[2], t1), 0, sign * max(abs(s[1]), abs(s[3]))) for s in near]
        cut = _box(t0, t1, 0, -2 * sign * reach)
        changed = shapely.difference(shapely.union_all([changed, *fill]), cut)
    return area if changed is turned else _transformed(changed, matrix.T, -matrix.T @ shift)


def _stretches(turned: Any, reach: float) -> Any:
    """Stretches of the line that an area comes near: a union of boxes of unit height."""
    low, _, high, _ = turned.bounds
    strip = shapely.intersection(turned, shapely.box(low, -reach, high, reach))
    return shapely.union_all([_box(part.bounds[0], part.bounds[2], 0, 1) for part in polygons(strip)])


def _box(t0: float, t1: float, s0: float, s1: float) -> Any:
    return shapely.box(t0, min(s0, s1), t1, max(s0, s1))


def _transformed(area: Any, matrix: FloatArray, shift: FloatArray) -> Any:
    """A transformed area on a fine grid: rounding would let edges that touch cross."""
    return shapely.set_precision(shapely.make_valid(affinity.affine_transform(area, [*matrix.ravel(), *shift])), GRID_M)


def opened(area: Any, half_m: float) -> Any:
    """An area (shapely) without parts narrower than twice a half-width."""
    return shapely.buffer(shapely.buffer(area, -half_m, join_style="mitre"), half_m, join_style="mitre")


def merged(areas: Sequence[Any]) -> Any:
    """Union of areas (shapely) that touch, without slits between them."""
    widened = shapely.union_all([shapely.buffer(area, SEAM_M, join_style="mitre") for area in areas])
    return shapely.buffer(widened, -SEAM_M, join_style="mitre")


def triangulated(area: Any) -> tuple[FloatArray, IntArray]:
    """Vertices [v, 2] and faces [f, 3] that fill an area (shapely)."""
    triangles = shapely.get_parts(shapely.constrained_delaunay_triangles(shapely.multipolygons(polygons(area))))
    corners = shapely.get_coordinates(triangles).reshape(-1, 4, 2)[:, :3]  # of a ring, whose last is its first
    vertices, faces = np.unique(corners.reshape(-1, 2), axis=0, return_inverse=True)
    return vertices, faces.reshape(-1, 3)


def large_parts(mask: Mask, cells: float, structure: NDArray[Any] | None = None) -> Mask:
    """The connected parts of a mask that have at least a number of cells."""
    parts, _ = ndimage.label(mask, structure)
    return mask & (np.bincount(parts.ravel()) >= cells)[parts]


def _covered(count: NDArray[Any], cell: float) -> Mask:
    """Cells that a plane covers, from the number of points in each."""
    # Cells about as full as those around them; a stray beside an edge is not.
    # The usual number in the neighbourhood is that of a point's cell, sum n^2 / sum n, which empty cells do not lower.
    full = count.astype(float)
    total = ndimage.uniform_filter(full, AROUND_CELLS, mode="constant")
    squares = ndimage.uniform_filter(full * full, AROUND_CELLS, mode="constant")
    mask: Mask = count >= np.maximum(2, SHARE * squares / np.maximum(total, 1e-9))
    disc = np.hypot(*np.mgrid[-CLOSED_CELLS : CLOSED_CELLS + 1, -CLOSED_CELLS : CLOSED_CELLS + 1]) <= CLOSED_CELLS + 0.5
    mask = ndimage.binary_opening(ndimage.binary_closing(mask, disc), np.ones((2, 2), bool))
    mask = large_parts(mask, SMALLEST_M2 / cell**2)
    mask = ~large_parts(~mask, SMALL_HOLE_M2 / cell**2)
    # Small sparse parts come from surfaces that cross the plane.
    label, parts = ndimage.label(mask)
    if parts < 2:
        return mask
    size = np.bincount(label.ravel())[1:]
    density = np.bincount(label.ravel(), weights=count.ravel())[1:] / size
    stray = (size < STRAY_SIZE * size.sum()) & (density < STRAY_DENSITY * np.median(count[mask]))
    return mask & ~np.concatenate([[False], stray])[label]


def _is_notched(part: Any) -> bool:
    """Whether a broad part of the tightest rectangle about a polygon lies outside."""
    outside = shapely.difference(part.minimum_rotated_rectangle, shapely.polygons(part.exterior))
    return bool(opened(outside, NOTCH_M / 2).area > NOTCH_M**2)


def _rectangle(part: Any, share: float = RECTANGLE_SHARE) -> Any | None:
    """The rectangle of a polygon that is rectangular but for noise, or None; its sides are medians of the polygon's."""
    for tight in (shapely.envelope(part), part.minimum_rotated_rectangle):
        if part.area < share * tight.area:
            continue
        (x, y), (x1, y1) = tight.exterior.coords[:2]
        angle, pivot = np.degrees(np.arctan2(y1 - y, x1 - x)), (x, y)
        level = affinity.rotate(part, -angle, pivot)
        left, low, right, high = level.bounds
        rows, columns = (np.linspace(a, b, SCAN_LINES + 2)[1:-1] for a, b in ((low, high), (left, right)))
        across = shapely.linestrings([[(left, t), (right, t)] for t in rows])
        along = shapely.linestrings([[(t, low), (t, high)] for t in columns])
        left, _, right, _ = np.nanmedian(shapely.bounds(shapely.intersection(level, across)), axis=0)
        _, low, _, high = np.nanmedian(shapely.bounds(shapely.intersection(level, along)), axis=0)
        return affinity.rotate(shapely.box(left, low, right, high), angle, pivot)
    return None
