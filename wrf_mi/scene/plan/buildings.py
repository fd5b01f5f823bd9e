"""Buildings of a map, as walls and roofs at stated heights on level ground.

Source: OpenStreetMap wiki, "Simple 3D Buildings": ``height`` and ``min_height`` in metres, else ``building:levels``.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely

from ...core import InputError
from ..material_names import meant
from ..mesh.outline import triangulated
from ..mesh.surfaces import Surface, number_names
from .faces import straight_pieces

logger = logging.getLogger(__name__)

LEVEL_M = 3.0  # height of a storey where only the number of storeys is stated
UNITS = {"": 1.0, "m": 1.0, "ft": 0.3048, "feet": 0.3048, "'": 0.3048}
GROUND_M = 20.0  # width of the ground around all buildings
PARTS_SHARE = 0.9  # least share of a building that its parts cover, which then take its place
EDGE_M = 0.02  # distance within which an edge belongs to a building
MATERIAL = "itu_concrete"  # of walls and roofs for which none is stated


@dataclass(frozen=True)
class Buildings:
    """Outlines of buildings.

    Attributes:
        outlines: polygons (shapely) in metres.
        tags: tags of each.
    """

    outlines: Sequence[Any]
    tags: Sequence[Mapping[str, str]]


def stated_height(tags: Mapping[str, str]) -> tuple[float, float]:
    """Heights of the lower and the upper end of a building above the ground, metres; NaN where it is not stated.

    >>> stated_height({"height": "12.5 m"}), stated_height({"building:levels": "4", "building:min_level": "1"})
    ((0.0, 12.5), (3.0, 12.0))
    """
    low = _metres(tags.get("min_height")), LEVEL_M * _metres(tags.get("building:min_level"))
    high = _metres(tags.get("height")), LEVEL_M * _metres(tags.get("building:levels"))
    base, top = (next((value for value in pair if np.isfinite(value)), np.nan) for pair in (low, high))
    return 0.0 if np.isnan(base) else base, top


def _metres(text: object) -> float:
    match = re.fullmatch(r"\s*(\d+(?:[.,]\d+)?)\s*(m|ft|feet|'|)\s*", str(text))
    return float(match[1].replace(",", ".")) * UNITS[match[2]] if match else np.nan


def building_surfaces(buildings: Buildings, height_m: float | None, floor_m: float, name: str) -> list[Surface]:
    """Ground, and roof and walls of each building; a wall that two share is as high as the higher one.

    Args:
        buildings: outlines and their tags.
        height_m: height of buildings that state none.
        floor_m: z of the ground.
        name: the source in messages.

    Raises:
        InputError: a building without a height.
    """
    outlines, tags = _without_whole(buildings)
    base, top = np.array([stated_height(each) for each in tags]).T
    if unknown := np.count_nonzero(np.isnan(top)):
        if height_m is None:
            text = f"{name}: {unknown} of {len(top)} buildings state neither height nor building:levels"
            raise InputError(f"{text}; give a height for them in metres (--wall-height)")
        logger.warning("%s: %d of %d buildings without a height are %g m high", name, unknown, len(top), height_m)
    top = np.where(np.isnan(top), height_m, top)
    if levels := sum("height" not in each and "building:levels" in each for each in tags):
        logger.warning("%s: %d buildings are %g m high for each of building:levels", name, levels, LEVEL_M)
    if (wrong := np.flatnonzero(top <= base)).size:
        raise InputError(f"{name}: a building from {base[wrong[0]]:g} m up to {top[wrong[0]]:g} m; correct its height")
    # Common edges once: a wall on each side would be two.
    rings = shapely.union_all(shapely.boundary(outlines), grid_size=EDGE_M / 2)
    edges = straight_pieces(shapely.get_coordinates(line) for line in shapely.get_parts(rings))
    middles = shapely.points(edges.mean(axis=1))
    edge, owner = shapely.STRtree(shapely.boundary(outlines)).query(middles, predicate="dwithin", distance=EDGE_M)
    edge_top, edge_base = np.full(len(edges), -np.inf), np.full(len(edges), np.inf)
    np.maximum.at(edge_top, edge, top[owner])
    np.minimum.at(edge_base, edge, base[owner])
    highest = np.full(len(edges), -1)
    rising = np.argsort(top[owner], kind="stable")
    highest[edge[rising]] = owner[rising]
    area = shapely.box(*shapely.total_bounds(outlines)).buffer(GROUND_M, join_style="mitre")
    ground, faces = triangulated(area)
    surfaces = [Surface("floor", "floor", np.insert(ground, 2, floor_m, axis=1), faces)]
    numbers = number_names(["wall"] * len(outlines)), number_names(["ceiling"] * len(outlines))
    for number, (outline, wall, roof) in enumerate(zip(outlines, *numbers, strict=True)):
        material_tags = [tags[number].get(f"{part}:material", "") for part in ("building", "roof")]
        of_wall, of_roof = (f"itu_{meant(text)}" if meant(text) else MATERIAL for text in material_tags)
        flat_roof, faces = triangulated(outline)
        surfaces.append(
            Surface(roof, "ceiling", np.insert(flat_roof, 2, floor_m + top[number], axis=1), faces, of_roof)
        )
        if len(rows := np.flatnonzero(highest == number)):
            ends = np.repeat(edges[rows], 2, axis=1)[:, [0, 2, 3, 1]]
            z = np.stack([edge_base[rows], edge_base[rows], edge_top[rows], edge_top[rows]], axis=1) + floor_m
            corners = np.concatenate([ends, z[..., None]], axis=-1).reshape(-1, 3)
            halves = (4 * np.arange(len(rows))[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
            surfaces.append(Surface(wall, "wall", corners, halves, of_wall))
    return surfaces


def _without_whole(buildings: Buildings) -> tuple[Any, list[Mapping[str, str]]]:
    """Outlines and tags without buildings in whose place their parts are stated."""
    outlines = np.array(buildings.outlines)
    is_part = np.array(["building:part" in tags for tags in buildings.tags])
    parts = shapely.union_all(outlines[is_part])
    covered = shapely.area(shapely.intersection(outlines, parts)) >= PARTS_SHARE * shapely.area(outlines)
    numbers = np.flatnonzero(is_part | ~covered).tolist()
    return outlines[numbers], [buildings.tags[number] for number in numbers]
