"""Floor plans in GeoJSON: outlines of rooms and shops in longitude and latitude, as pieces of walls in metres."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from ...core import InputError
from ...core.angles import FloatArray
from ...core.files import readable
from ..coordinates import LARGEST_M, LATITUDE, LONGITUDE, extra_package, local_projection

logger = logging.getLogger(__name__)

Extent = tuple[float, float]
"""Width and height of a plan, metres."""
GEOJSON_SUFFIXES = (".geojson", ".json")
EXTENT_FILE = "floor_info.json"  # of the Indoor Location Competition 2.0, beside geojson_map.json
SMALLEST_FEATURE_M2 = 1.0  # smaller outlines are pillars, signs and machines
SCALE_TOLERANCE = 0.03  # largest deviation of a stated extent from metres on the ground
REMEDY = "give GeoJSON with polygons of rooms in longitude and latitude"


def read_geojson(path: Path, extent_m: Extent | None = None) -> FloatArray:
    """Straight pieces [n, 2, 2] of the outlines of all polygons, metres east and north of their lower left corner.

    The metres are those on the ground (`wrf_mi.scene.coordinates.local_projection`), or such that all outlines together
    are as wide and as high as stated: by ``extent_m``, or else by `EXTENT_FILE` in the same folder. Polygons smaller
    than `SMALLEST_FEATURE_M2` are left out; their number is logged.

    Source: RFC 7946, "The GeoJSON Format" (2016).

    Raises:
        InputError: not GeoJSON, without polygons, coordinates that are no degrees of a building, or a bad extent.
    """
    with readable(path, f"{path}: missing; {REMEDY}", REMEDY):
        content = json.loads(path.read_text(encoding="utf-8-sig"))
        if content["type"] == "FeatureCollection":  # a feature without a place has no geometry (RFC 7946, 3.2)
            content["features"] = [feature for feature in content["features"] if feature["geometry"] is not None]
        geometry = shapely.force_2d(shapely.from_geojson(json.dumps(content)))
    parts = shapely.get_parts(shapely.get_parts(shapely.get_parts(geometry)))
    outlines = parts[(shapely.get_type_id(parts) == shapely.GeometryType.POLYGON) & ~shapely.is_empty(parts)]
    if not len(outlines):
        raise InputError(f"{path}: no polygons; {REMEDY}")
    return _pieces(_in_metres(path, outlines, extent_m), path)


def _in_metres(path: Path, outlines: Any, extent_m: Extent | None) -> Any:
    """Polygons in degrees as polygons in metres."""
    west, south, east, north = shapely.total_bounds(outlines)
    if max(-west, east) > LONGITUDE or max(-south, north) > LATITUDE:
        raise InputError(f"{path}: coordinates up to {max(east, north):.6g} are no degrees; {REMEDY}")
    pyproj = extra_package("pyproj")
    projection = pyproj.Transformer.from_crs("EPSG:4326", local_projection(west, south), always_xy=True)
    outlines = shapely.transform(outlines, lambda xy: np.column_stack(projection.transform(*xy.T)))
    bounds = shapely.total_bounds(outlines)
    corner, size = bounds[:2], bounds[2:] - bounds[:2]
    if not 0 < size.min() <= size.max() <= LARGEST_M:
        text = f"{size[0] / 1000:.4g} km x {size[1] / 1000:.4g} km as degrees are no building"
        raise InputError(f"{path}: {text}; {REMEDY}, of one building")
    stated = _stated_extent(path, extent_m, size)
    if stated is None:
        text = (
            "%s: metres east and north of longitude %.8g, latitude %.8g; give --extent for the frame of a stated extent"
        )
        logger.warning(text, path, west, south)
    scale = 1 if stated is None else stated / size
    return shapely.transform(outlines, lambda xy: (xy - corner) * scale)


def _stated_extent(path: Path, extent_m: Extent | None, size_m: FloatArray) -> FloatArray | None:
    """Width and height of the plan, None where not stated; a log of those that differ from its size on the ground."""
    source, beside = "--extent", path.with_name(EXTENT_FILE)
    if extent_m is None and beside.is_file():
        with readable(beside, "", 'give {"map_info": {"width": METRES, "height": METRES}}, or --extent'):
            stated = json.loads(beside.read_text(encoding="utf-8-sig"))["map_info"]
            source, extent_m = EXTENT_FILE, (float(stated["width"]), float(stated["height"]))
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
    rings = shapely.get_rings(outlines[large])
    corners = [shapely.get_coordinates(ring) for ring in rings]
    return np.concatenate([np.stack([xy[:-1], xy[1:]], axis=1) for xy in corners])
