"""Walls, floor and ceiling from an occupancy grid, LiDAR returns in a plane, wall vertices or outlines of rooms."""

from __future__ import annotations

import numpy as np
import shapely
from shapely.geometry import Polygon
from shapely.geometry.base import BaseGeometry

from ...core import InputError
from ...core.angles import FloatArray
from ..mesh.outline import merged, opened, triangulated
from ..mesh.surfaces import Surface, number_names
from .lines import HALF_WIDTH_M, THICKEST_WALL_M
from .sources import PlanGrid
from .walked import NARROWEST_ROOM_M, mapped_part
from .walls import find_walls, joined

CLOSING_M = (0.3, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0)
"""Half-widths of openings that are closed to find the floor: doors first, then larger gaps."""
LARGEST_GAP_M = 2.5  # widest entrance in an outer wall, a double door: rooms behind wider gaps are open to the outside
WALLED = 0.75  # least share of a room's outline along walls: the rest are gaps; niches of a facade have less
COVERED = 0.9  # least share of the walls that stand on the floor or at its edge
EDGE_M = 0.1  # a wall this near to the floor's edge stands at it
SMALLEST_FLOOR_M2 = 0.5
SHARED_EDGE_M = 0.01  # grid of the outlines of rooms: common edges differ by millimetres, as each room is drawn alone
STRAIGHT_M = 0.05  # largest deviation of vertices of such outlines from a straight wall


def layout_walls(vertices_m: FloatArray) -> FloatArray:
    """Straight walls of a path of vertices [n, 2] that may double back and cross: end points [m, 2, 2]."""
    pieces = np.stack([vertices_m[:-1], vertices_m[1:]], axis=1)
    return merged_walls(pieces)


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
    return np.concatenate([np.stack([xy[:-1], xy[1:]], axis=1) for xy in paths])


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
    area, result, step = floor_of(walls_m), walls_m.copy(), grid.resolution_m
    depth = step * np.arange(1, int(THICKEST_WALL_M / step))
    for i, (begin, end) in enumerate(walls_m):
        length = np.linalg.norm(end - begin)
        along = (end - begin) / length
        on_wall = begin + np.arange(0, length, step)[:, None] * along
        to_left = np.array([-along[1], along[0]])
        inside = [np.mean(shapely.contains_xy(area, on_wall + side * EDGE_M * to_left)) > 0.5 for side in (1, -1)]
        if inside[0] == inside[1]:
            continue
        inwards = to_left if inside[0] else -to_left
        cells, within = grid.cell_indices(on_wall[:, None] + depth[:, None] * inwards)
        occupied = grid.occupied[cells] & within
        # At most places no other wall meets this one.
        half_m = float(np.median(depth[0] * (np.argmin(occupied, axis=1) + 0.5)))
        if HALF_WIDTH_M < half_m <= THICKEST_WALL_M / 2:
            result[i] += half_m * inwards
    return joined(result)


def plan_surfaces(
    source: PlanGrid | FloatArray,
    *,
    height_m: float,
    floor_m: float = 0.0,
    name: str = "plan",
) -> list[Surface]:
    """Surfaces of a storey: walls extruded from floor to ceiling, and both of these.

    Args:
        source: the plan, as `wrf_mi.scene.plan.sources.read_plan` returns it.
        height_m: height from floor to ceiling, above zero.
        floor_m: z of the floor.
        name: name of the source, for errors.

    Returns:
        Floor, ceiling, and walls from the longest to the shortest; vertices in the frame of the source.

    Raises:
        InputError: bad height, no wall, or walls that enclose nothing.
    """
    if not (np.isfinite(height_m) and height_m > 0 and np.isfinite(floor_m)):
        raise InputError(f"height {height_m} m above {floor_m} m: give a height above zero (--wall-height, metres)")
    try:
        if isinstance(source, PlanGrid):
            walls_m = find_walls(source)
            # Points show no thickness: the cells of a noisy wall are on both sides of its face.
            walls_m = at_inner_faces(walls_m, source) if source.free.any() else walls_m
            area = mapped_part(floor_of(walls_m), source, name)
        else:
            xy = np.asarray(source, float)
            walls_m = layout_walls(xy) if xy.ndim == 2 else merged_walls(xy, SHARED_EDGE_M, STRAIGHT_M)
            area = floor_of(walls_m)
        flat, faces = triangulated(area)
    except InputError as error:
        raise InputError(f"{name}: {error}") from None
    top_m, halves = floor_m + height_m, np.array([[0, 1, 2], [0, 2, 3]])
    floor = Surface("floor", "floor", _at(flat, floor_m), faces)
    surfaces = [floor, Surface("ceiling", "ceiling", _at(flat, top_m), faces)]
    for name, ends in zip(number_names(["wall"] * len(walls_m)), walls_m, strict=True):
        surfaces.append(Surface(name, "wall", np.concatenate([_at(ends, floor_m), _at(ends[::-1], top_m)]), halves))
    return surfaces


def _at(xy_m: FloatArray, z_m: float) -> FloatArray:
    """Points [n, 2] at a height, [n, 3]."""
    return np.column_stack([xy_m, np.full(len(xy_m), z_m)])
