"""Floor of an occupancy grid: none where nothing was mapped, and some where measured places prove it."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import shapely
from scipy import ndimage

from ...core import InputError
from ...core.angles import FloatArray
from ...core.types import IntArray
from ..mesh.outline import boxes, large_parts, merged, opened, polygons, triangulated
from ..mesh.surfaces import Surface, level_area
from .grid import PlanGrid
from .lines import SMALLEST_ROOM_M2
from .walls import FURNITURE_DEPTH_M

logger = logging.getLogger(__name__)

NARROWEST_ROOM_M = 0.6  # as wide as the narrowest door
BLUR_M = 0.2  # largest distance of a place from free cells that the blur of a robot's map explains
NAMED_ROWS = 3
FREE, UNMAPPED, WALL, OUTSIDE = range(4)


def mapped_part(area: Any, grid: PlanGrid, name: str) -> Any:
    """The part of an area (shapely) within walls that a grid maps; how much is left out is logged.

    Things hide cells up to the depth of furniture, and the floor goes on below them: only broader parts are unmapped.
    """
    if not grid.free.any() or not grid.unmapped.any():
        return area
    # A wall before unmapped cells belongs to them up to its middle, where it becomes a sheet.
    to_free, to_unmapped = (ndimage.distance_transform_edt(~cells) for cells in (grid.free, grid.unmapped))
    blind = boxes((to_unmapped < to_free).T, grid.origin_m, grid.resolution_m)
    blind = [
        part
        for part in polygons(opened(shapely.intersection(area, blind), FURNITURE_DEPTH_M / 2))
        if part.area >= SMALLEST_ROOM_M2
    ]
    if not blind:
        return area
    blind_area = shapely.simplify(shapely.union_all(blind), grid.resolution_m)
    text = "%s: %.1f m2 within the walls are unmapped, and are no floor"
    logger.warning(text, name, shapely.intersection(area, blind_area).area)
    mapped = opened(shapely.difference(area, blind_area), grid.resolution_m)  # slits of a cell remain along walls
    if mapped.is_empty:
        raise InputError("no cell within its walls is known to be free; give a map with free cells, or its thresholds")
    return mapped


def with_walked_floor(
    surfaces: Sequence[Surface], grid: PlanGrid, places_m: FloatArray, *, unmapped: bool = False
) -> list[Surface]:
    """Surfaces of a grid whose floor and ceiling contain the free space about places [n, 2], all in its frame.

    Someone who walked there proves that the free cells about it, which no wall encloses, are floor and no view through
    a window. With ``unmapped`` the places in unmapped cells get a floor as wide as a door, too.
    """
    floor = level_area([surface for surface in surfaces if surface.kind == "floor"])
    beyond = places_m[~shapely.contains_xy(floor, places_m)]
    cells = cells_at(grid, beyond)
    added = list(_free_space(grid, floor, beyond[cells == FREE])) if (cells == FREE).any() else []
    if unmapped:
        added += list(
            shapely.buffer(shapely.points(beyond[cells == UNMAPPED]), NARROWEST_ROOM_M / 2, cap_style="square")
        )
    if not added:
        return list(surfaces)
    flat, faces = triangulated(merged([floor, *added]))
    return [
        replace(surface, vertices_m=np.insert(flat, 2, surface.vertices_m[0, 2], axis=1), faces=faces)
        if surface.kind in ("floor", "ceiling")
        else surface
        for surface in surfaces
    ]


def _free_space(grid: PlanGrid, floor: Any, places_m: FloatArray) -> list[Any]:
    """Free areas beyond a floor that hold places [n, 2], as far as one can walk from there."""
    # Things that stand in the free space are holes of it, and the floor goes on below them.
    solid = large_parts(~grid.free, SMALLEST_ROOM_M2 / grid.resolution_m**2)
    free = boxes(~solid.T, grid.origin_m, grid.resolution_m)
    points = shapely.points(places_m)
    about = shapely.buffer(points, NARROWEST_ROOM_M / 2, cap_style="square")
    walkable = opened(shapely.difference(free, floor), NARROWEST_ROOM_M / 2)
    # Free cells up to the edge of a drawing are paper, into which a room is open.
    rows, columns = grid.free.shape
    inner = shapely.box(*grid.origin_m, *(grid.origin_m + grid.resolution_m * np.array([columns, rows])))
    inner = shapely.buffer(inner, -2 * grid.resolution_m)
    walked = [part for part in polygons(walkable) if shapely.intersects(part, shapely.multipoints(points))]
    spaces = [part for part in walked if shapely.covers(inner, part)]
    return [*shapely.intersection(about, free), *(shapely.simplify(part, grid.resolution_m) for part in spaces)]


def cells_at(grid: PlanGrid, places_m: FloatArray) -> IntArray:
    """What a grid shows at places [n, 2] in its frame: `FREE`, `UNMAPPED`, `WALL` or `OUTSIDE` of it [n].

    Places within `BLUR_M` of free cells count as free where a wall is drawn, within a cell where nothing was mapped.
    """
    at, inside = grid.cell_indices(places_m)
    away_m = ndimage.distance_transform_edt(~grid.free)[at] * grid.resolution_m
    wall = grid.occupied[at]
    free = away_m <= np.where(wall, BLUR_M, np.sqrt(2) * grid.resolution_m)
    return np.where(~inside, OUTSIDE, np.where(free, FREE, np.where(wall, WALL, UNMAPPED)))


def warn_of_places(grid: PlanGrid, places_m: FloatArray, name: str) -> None:
    """Log which rows of places [n, 2] in a grid's frame lie in cells that it does not show as free."""
    cells, texts = cells_at(grid, places_m), []
    for kind, text in ((UNMAPPED, "in unmapped cells"), (WALL, "in walls"), (OUTSIDE, "outside of the picture")):
        rows = np.flatnonzero(cells == kind) + 1
        if len(rows):
            more = ", ..." if len(rows) > NAMED_ROWS else ""
            texts.append(f"{len(rows)} {text} (rows {', '.join(map(str, rows[:NAMED_ROWS]))}{more})")
    if texts:
        count = np.count_nonzero(cells != FREE)
        remedy = "check --origin and --resolution"
        if (cells == UNMAPPED).any():
            remedy += "; if they are right, those in unmapped cells prove floor and get it"
        logger.warning("%s: %d of %d positions: %s; %s", name, count, len(cells), ", ".join(texts), remedy)
