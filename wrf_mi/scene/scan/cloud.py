"""Surfaces of a building from a point cloud."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import shapely
from scipy import ndimage

from ...core import InputError
from ...core.angles import FloatArray
from ...core.types import IntArray
from ..mesh.furnishings import BELOW_CEILING_M, furnishings, reached
from ..mesh.outline import Raster, fill_blind, fill_shadows, join, levels_completed, outline, shadows, triangulated
from ..mesh.planes import UPRIGHT, WALL_HEIGHT_M, Face, Mask, Plane, kinds, near, over, storey, with_axes
from ..mesh.surfaces import KINDS, Kind, Surface, number_names
from .planes import BAND, CORE, NARROW_CORE, NARROW_RADIUS_M, NORMAL_RADIUS_M, Thinned, find_planes, fit, layers, thin
from .sight import Sight, returns_and_shadows, sights_of, sparse_walls

logger = logging.getLogger(__name__)

REACH_M = 0.15  # gaps and overlaps up to this are closed where walls, floor and ceiling meet
STRAIGHT_M = 1e-3
SMALLEST_M2 = 0.05  # least area of a surface
FEWEST_POINTS = 20
LEAST_CONTRAST = 2.0
"""Least density of points in a plane relative to the density beside it; chance alignments have less."""
TOLERANCE_RANGE_RAD = np.radians(0.3), np.radians(4.0)
"""Bounds of the angle by which planes are turned: a levelled scanner and its registration leave the lower."""
LEAST_PART, LEAST_FILLED = 0.4, 0.5
"""Least height of a part of a wall whose rest things hide, in that of a wall, and least share of the rectangle about a
wall of few points that it fills."""
LEAST_STRIP_M = 0.2  # least height of the part of a wall above furniture, where no scanner's place is known
DRIFT_M = 0.03
"""Largest distance of sheets of one wall that were seen at other times of a walk, and error of planes at their edges
where depth of many places was fused: corners are rounded by a cell."""
PASSES = 2
MOST_OUTSIDE = 0.1  # share of a scanner's returns behind walls from which they are no strays through openings
UNLIKE = np.array([1.0, np.sqrt(2.0), np.sqrt(3.0)])  # factors for which different points have different sums
ERRORS = 3.0  # angle by which planes are turned, in standard errors of their direction


@dataclass(frozen=True, eq=False)
class _Piece(Face):
    """A face, the distance within which its corners are closed, and areas (shapely) of recesses in it."""

    reach_m: float
    recesses: Sequence[Any] = ()


def surfaces_from_points(
    points_m: FloatArray,
    viewpoints_m: FloatArray | None = None,
    viewpoint: IntArray | None = None,
    *,
    walked: bool = False,
) -> list[Surface]:
    """The planes of a room or building in a levelled point cloud: floor, ceiling, walls, furniture.

    Things that are not flat (chairs, plants) are left out: a rough skin over them would reflect in directions that
    nothing measured supports. So are surfaces of other places that a scanner saw through a door or window.

    Args:
        points_m: shape [n, 3], metres, z upwards; any origin.
        viewpoints_m: places of the scanners where they are known [k, 3].
        viewpoint: number of each point's place [n], -1 for none.
        walked: whether they were seen from many places, as those of a phone: the origin is not tried as the place.

    Returns:
        Surfaces by kind, the largest first; several polygons may make up one. Vertices in the frame of the points.

    Raises:
        InputError: Open3D is missing, or no plane was found.
    """
    # Far from the origin (a national grid) single precision cannot hold millimetres.
    shift = np.floor(np.median(points_m, axis=0))
    # Copies of a point, which some scanners write, would make strays look like surfaces.
    distinct = np.sort(np.unique((points_m - shift) @ UNLIKE, return_index=True)[1])
    points = points_m[distinct] - shift
    numbers = np.full(len(points), -1) if viewpoint is None else viewpoint[distinct]
    places = np.empty((0, 3)) if viewpoints_m is None else viewpoints_m - shift
    cloud = thin(points, NARROW_RADIUS_M if walked else NORMAL_RADIUS_M)
    planes, noise = find_planes(cloud, NARROW_CORE if walked else CORE)
    sights = [] if walked else sights_of(points, places, numbers, -shift)
    scan = _Scan(points.astype(np.float32), cloud, noise, sights, DRIFT_M if walked else 0.0)
    pieces, roles = scan.room(planes, sparse=not walked)
    if not pieces:
        raise InputError(f"no plane was found in {len(points_m)} points; give a denser scan of a room")
    areas = scan.closed(pieces, roles)
    logger.info("%d planes in %d points, noise %.1f mm", len(pieces), len(points), 1e3 * noise)
    names = list[str](roles)
    if not scan.sights:
        cleared = reached([Face(piece.plane, area) for piece, area in zip(pieces, areas, strict=True)], roles)
        if lost := sum(area.area for area in areas) - sum(face.area.area for face in cleared):
            logger.warning("%.1f m2 left out that a mirror or window shows beyond the floor", lost)
        areas, names = [face.area for face in cleared], furnishings(cleared, roles)
        roles = [kind if name == kind else "other" for name, kind in zip(names, roles, strict=True)]
    order = [i for i in range(len(pieces)) if not areas[i].is_empty]
    order.sort(key=lambda i: (KINDS.index(roles[i]), names[i], -areas[i].area))
    surfaces = []
    for name, i in zip(number_names([names[i] for i in order]), order, strict=True):
        vertices, faces = triangulated(areas[i])
        surfaces.append(Surface(name, roles[i], pieces[i].plane.lift(vertices) + shift, faces))
    return surfaces


def _walls(pieces: Sequence[_Piece], roles: Sequence[Kind]) -> list[_Piece]:
    return [piece for piece, role in zip(pieces, roles, strict=True) if role == "wall"]


class _Scan:
    """Points [n, 3] of a scan, those that may belong to surfaces [n], the thinned cloud, noise, scanners, drift."""

    def __init__(
        self, points_m: FloatArray, cloud: Thinned, noise_m: float, sights: Sequence[Sight], drift_m: float
    ) -> None:
        self.points_m, self.cloud, self.noise_m, self.sights = points_m, cloud, noise_m, sights
        self.free, self.drift_m = np.ones(len(points_m), bool), drift_m

    def room(self, planes: Sequence[Plane], sparse: bool) -> tuple[list[_Piece], list[Kind]]:
        """Pieces of planes and their roles, with walls of few points if wanted, without what lies behind walls."""
        pieces, roles = self.roles(self.pieces(planes))
        walls = _walls(pieces, roles)
        wall_planes = [piece.plane for piece in walls]
        few = sparse_walls(self.cloud.all_m, wall_planes, planes, self.noise_m) if sparse else []
        for number in range(PASSES):
            # Walls bound the room, and a wall that is found by few points bounds the others.
            outside = self.outside(walls)
            fresh = bool((outside & self.free).any())
            if not fresh and not (few and number == 0):
                break
            self.free = ~outside
            second = self.roles(self.pieces([*planes, *few], walls))
            few = [piece.plane for piece in second[0] if piece.plane.sparse]
            if not fresh and not few:
                break  # chance alignments alone, which must not move the others
            (pieces, roles), walls = second, _walls(*second)
        if not self.free.all():
            logger.info("%d points behind openings of walls make no surfaces", np.count_nonzero(~self.free))
        return pieces, roles

    def closed(self, pieces: Sequence[_Piece], roles: Sequence[Kind]) -> list[Any]:
        """Areas of pieces with their shadows filled, joined where they meet."""
        planes, walls = [piece.plane for piece in pieces], _walls(pieces, roles)
        reach = [max(p.reach_m, 0 if kind == "other" else REACH_M) for p, kind in zip(pieces, roles, strict=True)]
        areas, band_m = join(planes, [piece.area for piece in pieces], reach), BAND * self.noise_m
        # Shadows are those of things: points of floors, ceilings and walls are seen through a gap and hide nothing.
        things, thinned = self.free.copy(), np.ones(len(self.cloud.points_m), bool)
        for plane, area, kind in zip(planes, areas, roles, strict=True):
            if kind != "other":
                things &= ~over(plane, area, self.points_m, band_m)
                thinned &= ~over(plane, area, self.cloud.points_m, band_m)
        clutter_m = self.cloud.points_m[thinned]
        areas = [
            self._filled(piece, area, kind, walls, things, clutter_m)
            for piece, area, kind in zip(pieces, areas, roles, strict=True)
        ]
        if not self.sights:
            areas = levels_completed(planes, areas, roles, clutter_m, band_m)
        return [shapely.simplify(area, STRAIGHT_M) for area in join(planes, areas, reach)]

    def _filled(
        self, piece: _Piece, area: Any, kind: Kind, walls: Sequence[Face], things: Mask, clutter_m: FloatArray
    ) -> Any:
        """Area of a piece with its shadows filled, but for its recesses."""
        if kind != "other":
            area = self.without_shadows(piece.plane, area, kind, walls, things, clutter_m)
        area = fill_shadows(piece.plane, area, kind, clutter_m, self.noise_m)
        if kind == "floor":
            area = fill_blind(piece.plane, area, walls, self.points_m, BAND * self.noise_m)
        return shapely.difference(area, shapely.union_all(piece.recesses)) if piece.recesses else area

    def pieces(self, planes: Sequence[Plane], walls: Sequence[Face] = ()) -> list[_Piece]:
        """Planes and their parallel layers with the areas that free points cover, those of most points first."""
        pieces = list[_Piece]()
        points, noise_m, free = self.points_m, self.noise_m, self.free.copy()
        for refined in _refined(planes, points, noise_m, self.drift_m):
            plane, parallel = layers(refined, points, free, noise_m)
            # Drift shows one wall as two sheets.
            parallel = [layer for layer in parallel if abs(layer.plane.offset_m - plane.offset_m) > self.drift_m]
            recesses = []
            for layer in parallel:
                area, cell = outline(layer.plane, points[layer.rows])
                if area.area >= SMALLEST_M2:
                    pieces.append(_Piece(layer.plane, area, 3 * noise_m + cell))
                    free[layer.rows] = False
                    recesses += [] if layer.before else [area]
            in_plane = near(plane, points, max(2 * noise_m, self.drift_m)) & free
            for layer in parallel:
                in_plane[layer.rows] = layer.before  # a wall goes on behind a board
            rows = np.flatnonzero(in_plane)
            if len(rows) < FEWEST_POINTS:
                continue
            area, cell = outline(plane, points[rows])
            area = self._completed(plane, area, walls, free)
            # Densities per standard deviation of distance: within 2, and from 3 to 6, on both sides.
            away = np.abs(plane.distance(points[over(plane, area, points, 6 * noise_m)]))
            inside, beside = np.count_nonzero(away < 2 * noise_m) / 2, np.count_nonzero(away > 3 * noise_m) / 3
            if area.area >= SMALLEST_M2 and inside >= LEAST_CONTRAST * max(beside, 1):
                pieces.append(_Piece(plane, area, 3 * noise_m + cell, recesses))
                free &= ~over(plane, area, points, BAND * noise_m)  # or a shelf would grow along the wall behind it
        return pieces

    def _completed(self, plane: Plane, area: Any, walls: Sequence[Face], free: Mask) -> Any:
        """An area with the places about it that beams met, where points are too sparse to show it."""
        band_m = BAND * self.noise_m
        in_plane = np.flatnonzero(free & (np.abs(plane.distance(self.points_m)) < band_m))
        if not self.sights or not len(in_plane):
            return area
        raster = Raster.around(plane.flat(self.points_m[in_plane]).astype(float))
        row, _ = returns_and_shadows(self.sights, plane, plane.lift(raster.centres_m), walls, band_m, free)
        on = raster.image((row >= 0) & free[row])
        # Where another surface crosses the plane, a strip as wide as the band lies in it.
        strip = int(np.ceil(2 * band_m / raster.cell_m)) + 1
        return raster.grown(area, ndimage.binary_opening(on, np.ones((strip, strip))))

    def roles(self, pieces: Sequence[_Piece]) -> tuple[list[_Piece], list[Kind]]:
        """Pieces with their roles, walls with their parts behind things; without sparse planes that are no walls."""
        middle_m = float(np.median(self.cloud.points_m[:, 2]))
        short: dict[Face, Kind] = dict(zip(pieces, kinds(pieces, middle_m), strict=True))
        completed = [self._up_to_levels(piece, short) for piece in pieces]
        chosen, roles = list[_Piece](), kinds(completed, middle_m)
        for piece, longer, role in zip(pieces, completed, roles, strict=True):
            filled = longer.area.area / shapely.envelope(longer.area).area
            if not piece.plane.sparse or (role == "wall" and filled >= LEAST_FILLED):
                chosen.append(longer if role == "wall" else piece)
        return chosen, kinds(chosen, middle_m)

    def _up_to_levels(self, piece: _Piece, roles: Mapping[Face, Kind]) -> _Piece:
        """An upright piece with the places that things hide between the floor and the ceiling."""
        least_m = LEAST_PART * WALL_HEIGHT_M if self.sights else LEAST_STRIP_M
        if piece.slope > UPRIGHT or np.ptp(piece.span_m) < least_m:
            return piece
        levels = {face: role for face, role in roles.items() if role in ("floor", "ceiling")}
        floor, ceiling = storey(piece, levels)
        if not self.sights and piece.span_m[1] < ceiling - BELOW_CEILING_M:
            return piece  # it ends below the ceiling: furniture, which what stands beside it would make a wall
        about, band_m = shapely.envelope(piece.area), BAND * self.noise_m
        off = self.free & ~over(piece.plane, about, self.points_m, band_m)
        clutter_m = self.cloud.points_m[~over(piece.plane, about, self.cloud.points_m, band_m)]
        (left, low, right, high), middle = piece.area.bounds, piece.plane.lift(np.array(piece.area.centroid.coords[0]))
        for height in (floor, ceiling):
            if np.isfinite(height):
                at = piece.area.centroid.y + height - middle[2]
                low, high = min(low, at), max(high, at)
        within = shapely.box(left, low, right, high)
        area = self.without_shadows(piece.plane, piece.area, "wall", (), off, clutter_m, within)
        return replace(piece, area=area)

    def without_shadows(
        self,
        plane: Plane,
        area: Any,
        kind: Kind,
        walls: Sequence[Face],
        things: Mask,
        clutter_m: FloatArray,
        within: Any | None = None,
    ) -> Any:
        """An area with the places that things hide, within its bounds or other ones.

        From the scanners, by the points that are things; where their places are not known, from straight before the
        plane, by things among the thinned points, which have no strays.
        """
        if area.is_empty:
            return area
        within = shapely.envelope(area) if within is None else within
        raster = Raster.around(shapely.get_coordinates(within))
        if self.sights:
            centres, band_m = plane.lift(raster.centres_m), BAND * self.noise_m
            hidden = raster.image(returns_and_shadows(self.sights, plane, centres, walls, band_m, things)[1])
        else:
            hidden = shadows(raster, plane, kind, clutter_m, self.noise_m)
        return raster.grown(area, hidden & raster.covered(within) & ~raster.covered(area))

    def outside(self, walls: Sequence[Face]) -> Mask:
        """Points that scanners saw through openings of walls; none of a scanner that saw much there.

        A door two metres away is 4 % of all directions: a scanner with a tenth of its returns behind walls stands in a
        doorway, or a rectangle about pieces of a wall spans an open plan.
        """
        outside = np.zeros(len(self.points_m), bool)
        for sight in self.sights:
            behind = sight.behind(sight.points_m, walls, max(BAND * self.noise_m, REACH_M))
            if behind.mean() < MOST_OUTSIDE:
                outside[sight.rows[behind]] = True
        return outside


def _refined(planes: Sequence[Plane], points: FloatArray, noise_m: float, drift_m: float) -> list[Plane]:
    """Planes fitted to all points, turned to right angles where these and rounded corners allow it, with their axes."""
    index = [np.flatnonzero(near(plane, points, BAND * noise_m)) for plane in planes]
    claims = np.bincount(np.concatenate([np.empty(0, int), *index]), minlength=len(points))
    chosen = [points[_sole(rows, claims)] for rows in index]
    fitted = [fit(part, np.ones(len(part)), plane, noise_m) for part, plane in zip(chosen, planes, strict=True)]
    fitted = [
        fit(part, np.ones(len(part)), plane, noise_m, normal=plane.normal)
        for part, plane in zip(chosen, _regular(fitted, max(noise_m, drift_m)), strict=True)
    ]
    # The axes follow the most certain upright plane.
    heading = next((plane.normal for plane in fitted if abs(plane.normal[2]) < 1e-6), np.array([1.0, 0.0, 0.0]))
    return [with_axes(plane, heading) for plane in fitted]


def _sole(rows: IntArray, claims: IntArray) -> IntArray:
    """Rows of points that one plane claims, or all where these are few."""
    # Points in the corner of two planes pull both towards the room.
    sole = rows[claims[rows] == 1]
    return sole if len(sole) > 0.2 * len(rows) else rows


def _regular(planes: Sequence[Plane], error_m: float) -> list[Plane]:
    """Planes turned to be level, upright, and parallel or square to earlier planes, each about its centre."""
    up = np.array([0.0, 0.0, 1.0])
    headings: list[FloatArray] = []
    turned = []
    for plane in planes:
        side = np.ptp(plane.flat(plane.patches_m.reshape(-1, 3)), axis=0).min()
        # A plane is turned only within the uncertainty of its points: three standard errors of its direction, or one
        # error of its edges over its shorter side (these and neighbours shift a fit by that much). A real slope stays.
        error = max(ERRORS * plane.angle_error_rad, error_m / max(side, error_m))
        tolerance = float(np.clip(error, *TOLERANCE_RANGE_RAD))
        n = plane.normal
        if np.arccos(min(abs(n @ up), 1.0)) < tolerance:
            n = up * np.sign(n @ up)
        elif np.arcsin(min(abs(n @ up), 1.0)) < tolerance:
            n = n - up * (n @ up)
            n = n / np.linalg.norm(n)
            for heading in headings:
                pair = np.stack([heading, np.cross(up, heading)])
                best = pair[np.argmax(np.abs(pair @ n))]
                if np.arccos(min(abs(best @ n), 1.0)) < tolerance:
                    n = best * np.sign(best @ n)
                    break
            else:
                headings.append(n)
        turned.append(replace(plane, normal=n, offset_m=float(n @ plane.centre_m)))
    return turned
