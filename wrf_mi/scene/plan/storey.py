"""Walls, floor and ceiling from an occupancy grid, LiDAR returns in a plane, wall vertices or outlines of rooms."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import shapely
from shapely.geometry import Polygon
from shapely.geometry.base import BaseGeometry

from ...core import InputError
from ...core.angles import FloatArray
from ..mesh.outline import merged, opened, triangulated
from ..mesh.surfaces import Kind, Surface, number_names
from .buildings import Buildings, building_surfaces
from .faces import DOOR, GLASS, SAG_M, THICKEST_WALL_M, WALL, PlanLines, middle_lines, straight_pieces, without_openings
from .grid import PlanGrid
from .lines import HALF_WIDTH_M
from .walked import NARROWEST_ROOM_M, mapped_part
from .walls import REACH_M, find_walls, joined, met

CLOSING_M = (0.3, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0)
"""Half-widths of openings that are closed to find the floor: doors first, then larger gaps."""
LARGEST_GAP_M = 2.5  # widest entrance in an outer wall, a double door: rooms behind wider gaps are open to the outside
WALLED = 0.75  # least share of a room's outline along walls: the rest are gaps; niches of a facade have less
COVERED = 0.9  # least share of the walls that stand on the floor or at its edge
EDGE_M = 0.1  # a wall this near to the floor's edge stands at it
SMALLEST_FLOOR_M2 = 0.5
SHARED_EDGE_M = 0.01  # grid of the outlines of rooms: common edges differ by millimetres, as each room is drawn alone
LINE_GRID_M = 0.001  # the same grid for drawings, whose lines are exact
SLANT = 0.2  # largest sine of the angle by which a door or window is turned to end at walls
STRAIGHT_M = 0.05  # largest deviation of vertices of such outlines from a straight wall


def layout_walls(vertices_m: FloatArray) -> FloatArray:
    """Straight walls of a path of vertices [n, 2] that may double back and cross: end points [m, 2, 2]."""
    return merged_walls(straight_pieces([vertices_m]))


def merged_walls(pieces_m: FloatArray, grid_m: float | None = None, tolerance_m: float = 1e-6) -> FloatArray:
    """Straight walls [m, 2, 2] of pieces [n, 2, 2] that may repeat each other and cross.

    Args:
        pieces_m: end points of the pieces.
        grid_m: spacing of a grid that the ends are moved to; None: none.
        tolerance_m: largest deviation of a vertex between two pieces that is left out.
    """
    pieces = pieces_m[np.linalg.norm(pieces_m[:, 1] - pieces_m[:, 0], axis=-1) > 0]
    # The union cuts at crossings and keeps doubled stretches once; merging undoes needless cuts.
    lines = shapely.line_merge(shapely.union_all(shapely.linestrings(pieces), grid_size=grid_m))
    paths = [shapely.get_coordinates(shapely.simplify(line, tolerance_m)) for line in shapely.get_parts(lines)]
    return straight_pieces(paths)


def floor_of(walls_m: FloatArray) -> BaseGeometry:
    """The area (shapely) that walls [n, 2, 2] enclose, openings closed, without inner yards; `InputError`: they enclose
    none.

    Rooms that are open to the outside by gaps of at most `LARGEST_GAP_M`, such as a corridor with an entrance, belong
    to it.
    """
    lines = shapely.unary_union(shapely.linestrings(walls_m))
    rooms = shapely.unary_union(shapely.get_parts(shapely.polygonize([lines])))
    areas = [_filled(rooms)]
    # Openings are closed by growing and shrinking, doors first: a wider closing rounds off more of the outline.
    areas += [_closed(lines, half) for half in CLOSING_M]
    for area in areas:
        covered = shapely.length(shapely.intersection(lines, shapely.buffer(area, EDGE_M)))
        if area.area >= SMALLEST_FLOOR_M2 and covered >= COVERED * lines.length:
            return shapely.simplify(_with_open_rooms(area, lines), EDGE_M / 2)
    raise InputError(f"the {len(walls_m)} walls found enclose no floor; give a plan that shows whole rooms")


def _closed(lines: BaseGeometry, half_m: float) -> BaseGeometry:
    """The area within lines after a morphological closing by squares of twice a half-width."""
    grown = shapely.buffer(lines, half_m, cap_style="square", join_style="mitre")
    return shapely.buffer(_filled(grown), -half_m, join_style="mitre")


def _with_open_rooms(area: BaseGeometry, lines: BaseGeometry) -> BaseGeometry:
    """An area with the rooms whose walls are at its edge, so that it covers all walls without them."""
    added = shapely.difference(_closed(lines, LARGEST_GAP_M / 2), area)
    # Opened by the width of a door, without which the space between both faces of a wall counts as a room.
    rooms = shapely.get_parts(opened(added, NARROWEST_ROOM_M / 2))
    near = shapely.buffer(lines, EDGE_M)
    walled = shapely.length(shapely.intersection(shapely.boundary(rooms), near)) >= WALLED * shapely.length(rooms)
    rooms = rooms[walled & (shapely.area(rooms) >= SMALLEST_FLOOR_M2)]
    return _filled(merged([area, *rooms])) if len(rooms) else area


def _filled(area: BaseGeometry) -> BaseGeometry:
    """Polygons without their holes."""
    outlines = [Polygon(part.exterior) for part in shapely.get_parts(area) if isinstance(part, Polygon)]
    return shapely.unary_union(outlines) if outlines else Polygon()


def at_inner_faces(walls_m: FloatArray, grid: PlanGrid) -> FloatArray:
    """Walls [n, 2, 2], the middle lines of those in a grid, with outer walls thicker than the blur of a map moved to
    their inner faces, where reflections happen, and the floor ends.
    """
    result, step = walls_m.copy(), grid.resolution_m
    depth = step * np.arange(1, int(THICKEST_WALL_M / step))
    for i, on_wall, inwards in _outer_walls(walls_m, floor_of(walls_m), step):
        cells, within = grid.cell_indices(on_wall[:, None] + depth[:, None] * inwards)
        occupied = grid.occupied[cells] & within
        # At most places no other wall meets this one.
        half_m = float(np.median(depth[0] * (np.argmin(occupied, axis=1) + 0.5)))
        if HALF_WIDTH_M < half_m <= THICKEST_WALL_M / 2:
            result[i] += half_m * inwards
    return joined(result)


def _outer_walls(
    walls_m: FloatArray, area: BaseGeometry, step_m: float
) -> Iterator[tuple[int, FloatArray, FloatArray]]:
    """Number, points [p, 2] at some distance, and unit normal towards an area of each wall [n, 2, 2] at its edge."""
    for i, (begin, end) in enumerate(walls_m):
        length = np.linalg.norm(end - begin)
        along = (end - begin) / length
        on_wall = begin + np.arange(0, length, step_m)[:, None] * along
        to_left = np.array([-along[1], along[0]])
        inside = [np.mean(shapely.contains_xy(area, on_wall + side * EDGE_M * to_left)) > 0.5 for side in (1, -1)]
        if inside[0] != inside[1]:
            yield i, on_wall, to_left if inside[0] else -to_left


def drawn_walls(lines: PlanLines) -> dict[str, FloatArray]:
    """Walls [n, 2, 2] of a plan drawn as lines, by what they are.

    Walls that are drawn by both faces become their middle lines, outer walls thicker than the blur of a map their inner
    faces, and windows and doors end at the walls beside them.
    """
    if not lines.by_faces:
        return {role: merged_walls(pieces, SHARED_EDGE_M, STRAIGHT_M) for role, pieces in lines.pieces_m.items()}
    walls = {role: merged_walls(pieces, LINE_GRID_M, SAG_M) for role, pieces in lines.pieces_m.items()}
    parts = {
        role: middle_lines(pieces, *[THICKEST_WALL_M] * (role == GLASS))
        for role, pieces in walls.items()
        if role != DOOR
    }
    if GLASS in parts:
        for role in parts.keys() - {GLASS}:
            middles, number = without_openings(parts[role][0], parts[GLASS][0])
            parts[role] = middles, parts[role][1][number]
    roles = [role for role, (middles, _) in parts.items() for _ in middles]
    middles, thick = (np.concatenate(values) for values in zip(*parts.values(), strict=True))
    openings = np.array([role == GLASS for role in roles])
    middles = met(middles)
    # Doors and windows close the outline.
    area = floor_of(np.concatenate([middles, walls.get(DOOR, np.empty((0, 2, 2)))]))
    for i, _, inwards in _outer_walls(middles.copy(), area, EDGE_M / 2):
        if thick[i] > 2 * HALF_WIDTH_M:
            middles[i] += thick[i] / 2 * inwards
    middles = met(middles)
    ends = middles[~openings].reshape(-1, 2)
    middles[openings] = _between_jambs(middles[openings], ends)
    walls = {role: middles[[each == role for each in roles]] for role in parts}
    if DOOR in lines.pieces_m:
        walls[DOOR] = _between_jambs(lines.pieces_m[DOOR], ends)
    return {role: long_parts for role, part in walls.items() if len(long_parts := part[_lengths(part) > EDGE_M])}


def _lengths(lines_m: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(lines_m[:, 1] - lines_m[:, 0], axis=-1))


def _between_jambs(openings_m: FloatArray, ends_m: FloatArray) -> FloatArray:
    """Doors and windows [n, 2, 2] moved to the nearest two ends of walls [m, 2], where both are within `REACH_M`."""
    result = openings_m.copy()
    away = np.linalg.norm(openings_m[:, :, None] - ends_m, axis=-1)
    near = ends_m[away.argmin(axis=-1)] if len(ends_m) else openings_m
    old, new = (lines[:, 1] - lines[:, 0] for lines in (openings_m, near))
    sine = np.abs(old[:, 0] * new[:, 1] - old[:, 1] * new[:, 0]) / (_lengths(openings_m) * _lengths(near)).clip(1e-9)
    fits = (away.min(axis=-1, initial=np.inf) <= REACH_M).all(axis=1) & (sine < SLANT) & (_lengths(near) > EDGE_M)
    result[fits] = near[fits]
    return result


def plan_surfaces(
    source: PlanGrid | PlanLines | Buildings | FloatArray,
    *,
    height_m: float | None,
    floor_m: float = 0.0,
    name: str = "plan",
) -> list[Surface]:
    """Surfaces of a storey: walls extruded from floor to ceiling, and both of these; or buildings on their ground.

    Args:
        source: the plan, as `wrf_mi.scene.plan.sources.read_plan` returns it.
        height_m: height from floor to ceiling, above zero; that of buildings which state none.
        floor_m: z of the floor.
        name: name of the source, for errors.

    Returns:
        Floor, ceiling, and walls from the longest to the shortest; vertices in the frame of the source.

    Raises:
        InputError: bad height, no wall, or walls that enclose nothing.
    """
    if isinstance(source, Buildings):
        return building_surfaces(source, height_m, floor_m, name)
    if height_m is None:
        raise InputError(f"{name}: a plan has no heights; give that of the ceiling in metres (--wall-height)")
    if not (np.isfinite(height_m) and height_m > 0 and np.isfinite(floor_m)):
        raise InputError(f"height {height_m} m above {floor_m} m: give a height above zero (--wall-height, metres)")
    try:
        if isinstance(source, PlanGrid):
            walls_m = find_walls(source)
            # Points show no thickness: the cells of a noisy wall are on both sides of its face.
            walls_m = at_inner_faces(walls_m, source) if source.free.any() else walls_m
            walls, area = {WALL: walls_m}, mapped_part(floor_of(walls_m), source, name)
        else:
            lines = source if isinstance(source, PlanLines) else None
            walls = {WALL: layout_walls(np.asarray(source, float))} if lines is None else drawn_walls(lines)
            area = floor_of(np.concatenate(list(walls.values())))
        flat, faces = triangulated(area)
    except InputError as error:
        raise InputError(f"{name}: {error}") from None
    top_m, halves = floor_m + height_m, np.array([[0, 1, 2], [0, 2, 3]])
    floor = Surface("floor", "floor", _at(flat, floor_m), faces)
    surfaces = [floor, Surface("ceiling", "ceiling", _at(flat, top_m), faces)]
    roles = [role for role, ends in walls.items() for _ in ends]
    names = number_names([DOOR if role == DOOR else "wall" for role in roles])
    for name, role, ends in zip(names, roles, np.concatenate(list(walls.values())), strict=True):
        kind: Kind = "other" if role == DOOR else "wall"
        corners = np.concatenate([_at(ends, floor_m), _at(ends[::-1], top_m)])
        surfaces.append(Surface(name, kind, corners, halves, "" if role in (DOOR, WALL) else role))
    return surfaces


def _at(xy_m: FloatArray, z_m: float) -> FloatArray:
    """Points [n, 2] at a height, [n, 3]."""
    return np.column_stack([xy_m, np.full(len(xy_m), z_m)])
