"""OpenStreetMap data: areas, lines and points in longitude and latitude, with their tags.

Source: OpenStreetMap wiki, "OSM XML", "Overpass API/Overpass QL" (JSON) and "Relation:multipolygon".
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import shapely
from defusedxml.ElementTree import parse

Feature = tuple[Any, Mapping[str, str]]
"""Geometry (shapely) in degrees, and tags."""
Element = Mapping[str, Any]
OPEN = ("indoor", "barrier", "highway")  # tags by which a closed way may be a line


def osm_elements(path: Path) -> list[Element]:
    """Elements of OSM XML as those of Overpass JSON: type, id, tags, and lat and lon, nodes or members."""
    elements = list[Element]()
    for part in parse(path, forbid_dtd=True).iterfind("*"):
        tags = {tag.get("k", ""): tag.get("v", "") for tag in part.iter("tag")}
        element: dict[str, Any] = {"type": part.tag, "id": int(part.get("id", 0)), "tags": tags}
        if part.get("action") == "delete" or part.get("visible") == "false":
            continue
        if part.tag == "node":
            elements.append(element | {"lon": float(part.get("lon", "nan")), "lat": float(part.get("lat", "nan"))})
        elif part.tag == "way":
            elements.append(element | {"nodes": [int(node.get("ref", 0)) for node in part.iter("nd")]})
        elif part.tag == "relation":
            members = [dict(member.attrib) | {"ref": int(member.get("ref", 0))} for member in part.iter("member")]
            elements.append(element | {"members": members})
    return elements


def osm_features(elements: list[Element]) -> list[Feature]:
    """Tagged points, lines and areas of elements; parts whose nodes are missing from the file are left out."""
    places = {each["id"]: (each["lon"], each["lat"]) for each in elements if each["type"] == "node"}
    ways = {each["id"]: _line(each, places) for each in elements if each["type"] == "way"}
    ways = {key: line for key, line in ways.items() if line is not None}
    features: list[Feature] = [
        (shapely.Point(places[each["id"]]), each["tags"])
        for each in elements
        if each["type"] == "node" and each.get("tags")
    ]
    for each in elements:
        tags = each.get("tags") or {}
        if each["type"] == "way" and tags and (line := ways.get(each["id"])) is not None:
            is_line = not line.is_closed or tags.get("indoor") == "wall" or "barrier" in tags
            features.append((line if is_line else shapely.Polygon(line.coords), tags))
        elif each["type"] == "relation" and tags.get("type") == "multipolygon":
            area = _area(each, ways)
            if area is not None:
                features.append((area, tags))
    return features


def _line(way: Element, places: Mapping[int, tuple[float, float]]) -> Any:
    """Line of a way, of its ``nodes`` or of its ``geometry`` (``out geom``); None for one that is cut."""
    if way.get("geometry"):
        points = [(point["lon"], point["lat"]) for point in way["geometry"] if point]
        complete = len(points) == len(way["geometry"])
    else:
        points = [places[node] for node in way.get("nodes", ()) if node in places]
        complete = len(points) == len(way.get("nodes", ()))
    return shapely.LineString(points) if complete and len(set(points)) > 1 else None


def _area(relation: Element, ways: Mapping[int, Any]) -> Any:
    """Area of a multipolygon; None where an outer way is missing."""
    parts: dict[bool, list[Any]] = {True: [], False: []}
    for member in relation["members"]:
        if member["type"] == "way":
            line = _line(member, {}) if member.get("geometry") else ways.get(member["ref"])
            if line is None:
                return None
            parts[member.get("role") != "inner"].append(line)
    outer, inner = (shapely.union_all(shapely.get_parts(shapely.polygonize(parts[side]))) for side in (True, False))
    area = shapely.difference(outer, inner)
    return None if area.is_empty else area
