"""Plans in GeoJSON and OpenStreetMap: outlines of rooms or buildings in longitude and latitude, in metres."""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from ...core import InputError
from ...core.angles import FloatArray
from ...core.files import readable
from ..coordinates import LARGEST_M, LATITUDE, LONGITUDE, extra_package, local_projection
from ..material_names import meant
from .buildings import Buildings, stated_height
from .faces import DOOR, WALL, PlanLines, straight_pieces
from .osm import Feature, osm_elements, osm_features

logger = logging.getLogger(__name__)

Extent = tuple[float, float]
"""Width and height of a plan, metres."""
OSM_SUFFIXES = (".osm",)
GEOJSON_SUFFIXES = (".geojson", ".json", *OSM_SUFFIXES)
EXTENT_FILE = "floor_info.json"  # of the Indoor Location Competition 2.0, beside geojson_map.json
SMALLEST_FEATURE_M2 = 1.0  # smaller outlines are pillars, signs and machines
SCALE_TOLERANCE = 0.03  # largest deviation of a stated extent from metres on the ground
WALLED = ("room", "corridor", "area")  # values of indoor that are areas
BUILDINGS = "buildings"
DOOR_M = 0.9  # width of a door for which none is stated
SAME_M = 0.01  # grid of the outlines of rooms of OpenStreetMap, whose common edges share their nodes
LARGEST_TOWN_M = 5000.0  # largest extent of a map of buildings
REMEDY = "give GeoJSON with polygons of rooms in longitude and latitude"


def read_geojson(path: Path, extent_m: Extent | None = None, level: str | None = None) -> PlanLines | Buildings:
    """Walls of the outlines of all polygons, or buildings, metres east and north of their lower left corner.

    Features are outlines of rooms unless their properties or tags are those of OpenStreetMap: ``indoor`` (a floor plan,
    see `_rooms`) or ``building`` (`Buildings`). The metres are those on the ground
    (`wrf_mi.scene.coordinates.local_projection`), or such that all outlines together are as wide and as high as stated:
    by ``extent_m``, or else by `EXTENT_FILE` in the same folder. Polygons of rooms smaller than `SMALLEST_FEATURE_M2`
    are left out; their number is logged.

    Args:
        path: GeoJSON (RFC 7946, "The GeoJSON Format", 2016), OSM XML, or the JSON of Overpass.
        extent_m: width and height in metres of all outlines together.
        level: level of the rooms of a file of OpenStreetMap, or `BUILDINGS`.

    Raises:
        InputError: another file, without polygons, coordinates that are no degrees of a building, a bad extent, or
            a level that is unclear or not there.
    """
    extra_package("pyproj")  # a missing package is named before the file is read
    features = _features(path)
    outlines = [part for geometry, tags in features if "indoor" not in tags for part in _polygons(geometry)]
    built = [(part, tags) for geometry, tags in features if _is_building(tags) for part in _polygons(geometry)]
    levels = sorted({each for _, tags in features if tags.get("indoor") in WALLED for each in _levels(tags)}, key=float)
    choices = [*levels, *([BUILDINGS] if built else [])]
    if level is None and levels and (len(levels) > 1 or len(built) > 1):
        text = f"{path}: has rooms of {len(levels)} levels and {len(built)} buildings"
        raise InputError(f"{text}; give the one to take by --level ({', '.join(choices)})")
    if level is not None and level not in choices:
        raise InputError(f"{path}: --level {level}: not in the file, which has {', '.join(choices) or 'no levels'}")
    chosen = level or next(iter(choices), None)
    if chosen == BUILDINGS:
        flat = _in_metres(path, np.array([part for part, _ in built]), extent_m, LARGEST_TOWN_M)
        return Buildings(list(flat), [tags for _, tags in built])
    if chosen is not None:
        return _rooms(path, [each for each in features if chosen in _levels(each[1])], extent_m)
    if not outlines:
        raise InputError(f"{path}: no polygons; {REMEDY}")
    return PlanLines({WALL: _pieces(_in_metres(path, np.array(outlines), extent_m), path)})


def _features(path: Path) -> list[Feature]:
    """Geometry in degrees, and properties or tags, of each feature that has a place."""
    with readable(path, f"{path}: missing; {REMEDY}", REMEDY):
        if path.suffix.lower() in OSM_SUFFIXES:
            return osm_features(osm_elements(path))
        content = json.loads(path.read_text(encoding="utf-8-sig"))
        if "elements" in content:
            return osm_features(content["elements"])
        features = content["features"] if content["type"] == "FeatureCollection" else [content]
        places = [each["geometry"] if each["type"] == "Feature" else each for each in features]
        tags = [{key: str(value) for key, value in (each.get("properties") or {}).items()} for each in features]
        # A feature without a place has no geometry (RFC 7946, 3.2).
        return [
            (shapely.force_2d(shapely.from_geojson(json.dumps(place))), facts)
            for place, facts in zip(places, tags, strict=True)
            if place is not None
        ]


def _polygons(geometry: Any) -> list[Any]:
    parts = shapely.get_parts(shapely.get_parts(geometry))
    return [part for part in parts if isinstance(part, shapely.Polygon) and not part.is_empty]


def _is_building(tags: Mapping[str, str]) -> bool:
    values = [tags.get(key, "no") for key in ("building", "building:part")]
    return "indoor" not in tags and any(value not in ("no", "None") for value in values)


def _levels(tags: Mapping[str, str]) -> list[str]:
    """Levels of a feature: numbers separated by semicolons, or a range such as 0-2."""
    text = tags.get("level", "0").replace(" ", "")
    if match := re.fullmatch(r"(-?\d+)-(-?\d+)", text):
        return [str(number) for number in range(int(match[1]), int(match[2]) + 1)]
    return [f"{float(each):g}" for each in text.split(";") if re.fullmatch(r"-?\d+(\.\d+)?", each)]


def _rooms(path: Path, features: list[Feature], extent_m: Extent | None) -> PlanLines:
    """Walls and doors of a level, by the scheme "Simple Indoor Tagging".

    Rooms have walls all round; corridors and areas, which have none where they meet, together. A wall of a stated
    material has it. Doors are closed, `DOOR_M` wide if no width is stated.
    """
    areas = [
        (part, tags) for geometry, tags in features if tags.get("indoor") in WALLED for part in _polygons(geometry)
    ]
    lines = [(each, tags) for each, tags in features if tags.get("indoor") == "wall" and each.geom_type == "LineString"]
    nodes = [(each, tags) for each, tags in features if each.geom_type == "Point" and tags.get("door", "no") != "no"]
    flat = _in_metres(path, np.array([each for each, _ in (*areas, *lines, *nodes)]), extent_m)
    count, rings = len(areas), dict[str, list[Any]]()
    open_areas = [each for each, (_, tags) in zip(flat[:count], areas, strict=True) if tags["indoor"] != "room"]
    joined: list[Feature] = [(each, {}) for each in shapely.get_parts(shapely.union_all(open_areas, grid_size=SAME_M))]
    rooms = [(each, tags) for each, (_, tags) in zip(flat[:count], areas, strict=True) if tags["indoor"] == "room"]
    walls = [(each, tags) for each, (_, tags) in zip(flat[count : count + len(lines)], lines, strict=True)]
    for each, tags in (*walls, *((shapely.boundary(area), tags) for area, tags in (*rooms, *joined))):
        material = meant(tags.get("material", ""))
        rings.setdefault(f"itu_{material}" if material else WALL, []).append(each)
    # A stretch belongs to the first role that has it, doors before all.
    drawn = {role: shapely.union_all(parts, grid_size=SAME_M) for role, parts in sorted(rings.items())}
    every = shapely.union_all(list(drawn.values()))
    width = [stated_height({"height": tags.get("width", "")})[1] for _, tags in nodes]
    discs = [
        shapely.buffer(each, (DOOR_M if np.isnan(wide) else wide) / 2)
        for each, wide in zip(flat[count + len(lines) :], width, strict=True)
        if shapely.distance(each, every) <= SAME_M
    ]
    openings = shapely.union_all(discs)
    pieces, covered = {DOOR: _straight(shapely.intersection(every, openings))}, shapely.GeometryCollection()
    for role, line in drawn.items():
        pieces[role] = _straight(shapely.difference(shapely.difference(line, covered, grid_size=SAME_M), openings))
        covered = shapely.union(covered, line, grid_size=SAME_M)
    return PlanLines({role: part for role, part in pieces.items() if len(part)})


def _straight(lines: Any) -> FloatArray:
    """Straight pieces [n, 2, 2] of lines."""
    parts = shapely.get_parts(shapely.get_parts(lines))
    corners = [shapely.get_coordinates(part) for part in parts if part.geom_type in ("LineString", "LinearRing")]
    return straight_pieces(corners)


def _in_metres(path: Path, outlines: Any, extent_m: Extent | None, largest_m: float = LARGEST_M) -> Any:
    """Geometries in degrees as geometries in metres."""
    west, south, east, north = shapely.total_bounds(outlines)
    if max(-west, east) > LONGITUDE or max(-south, north) > LATITUDE:
        raise InputError(f"{path}: coordinates up to {max(east, north):.6g} are no degrees; {REMEDY}")
    pyproj = extra_package("pyproj")
    projection = pyproj.Transformer.from_crs("EPSG:4326", local_projection(west, south), always_xy=True)
    outlines = shapely.transform(outlines, lambda xy: np.column_stack(projection.transform(*xy.T)))
    bounds = shapely.total_bounds(outlines)
    corner, size = bounds[:2], bounds[2:] - bounds[:2]
    if not 0 < size.min() <= size.max() <= largest_m:
        text = f"{size[0] / 1000:.4g} km x {size[1] / 1000:.4g} km as degrees are no building"
        raise InputError(f"{path}: {text}; {REMEDY}, of one building")
    stated_size_m = _stated_extent(path, extent_m, size)
    if stated_size_m is None:
        text = (
            "%s: metres east and north of longitude %.8g, latitude %.8g; give --extent for the frame of a stated extent"
        )
        logger.warning(text, path, west, south)
    scale = 1 if stated_size_m is None else stated_size_m / size
    return shapely.transform(outlines, lambda xy: (xy - corner) * scale)


def _stated_extent(path: Path, extent_m: Extent | None, size_m: FloatArray) -> FloatArray | None:
    """Width and height of the plan, None where not stated; a log of those that differ from its size on the ground."""
    source, beside = "--extent", path.with_name(EXTENT_FILE)
    if extent_m is None and beside.is_file():
        with readable(beside, "", 'give {"map_info": {"width": METRES, "height": METRES}}, or --extent'):
            map_info = json.loads(beside.read_text(encoding="utf-8-sig"))["map_info"]
            source, extent_m = EXTENT_FILE, (float(map_info["width"]), float(map_info["height"]))
    if extent_m is None:
        return None
    extent = np.asarray(extent_m, float)
    if extent.shape != (2,) or not (np.isfinite(extent).all() and extent.min() > 0):
        raise InputError(f"{path}: {source}: {tuple(extent.tolist())}; give width and height in metres, above zero")
    if np.abs(extent / size_m - 1).max() > SCALE_TOLERANCE:
        text = "%s: %.1f m x %.1f m on the ground, and %.1f m x %.1f m by %s; check width and height"
        logger.warning(text, path, *size_m, *extent, source)
    return extent


def _pieces(outlines: Any, path: Path) -> FloatArray:
    """Straight pieces [n, 2, 2] of polygons in metres that are no small things."""
    large = shapely.area(outlines) >= SMALLEST_FEATURE_M2
    if not large.any():
        raise InputError(f"{path}: no polygon of {SMALLEST_FEATURE_M2:g} m2 or more; {REMEDY}")
    if not large.all():
        text = "%s: %d of %d polygons are smaller than %g m2, and are left out"
        logger.warning(text, path, np.count_nonzero(~large), len(large), SMALLEST_FEATURE_M2)
    return _straight(shapely.get_rings(outlines[large]))
