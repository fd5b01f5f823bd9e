"""OpenStreetMap: buildings at stated heights, and rooms of a level by Simple Indoor Tagging."""

import json
from xml.sax.saxutils import quoteattr

import numpy as np
import pytest

from wrf_mi.scene.coordinates import local_projection
from wrf_mi.scene.make import make_scene
from wrf_mi.scene.mesh.surfaces import level_area
from wrf_mi.scene.plan.buildings import stated_height
from wrf_mi.scene.plan.sources import read_plan
from wrf_mi.scene.plan.storey import plan_surfaces

pyproj = pytest.importorskip("pyproj", reason="needs wrf-mi[cad]")
TO_DEGREES = pyproj.Transformer.from_crs(local_projection(13, 52), "EPSG:4326", always_xy=True)


def square(x, y, wide, deep):
    return [(x, y), (x + wide, y), (x + wide, y + deep), (x, y + deep), (x, y)]


def written(file, ways, relations=(), doors=()):
    """OSM XML, or the JSON of Overpass by the file's name, of ways (corners in metres, tags)."""
    places = dict.fromkeys([tuple(xy) for corners, _ in ways for xy in corners])
    number = {xy: i for i, xy in enumerate(places, 1)}
    tagged = {number[xy]: tags for xy, tags in doors}
    elements = []
    for (x, y), i in number.items():
        lon, lat = TO_DEGREES.transform(x, y)
        elements.append({"type": "node", "id": i, "lon": lon, "lat": lat, "tags": tagged.get(i, {})})
    for i, (corners, tags) in enumerate(ways, 1):
        elements.append({"type": "way", "id": i, "nodes": [number[tuple(xy)] for xy in corners], "tags": tags})
    for i, (members, tags) in enumerate(relations, 1):
        parts = [{"type": "way", "ref": ref, "role": role} for ref, role in members]
        elements.append({"type": "relation", "id": i, "members": parts, "tags": {"type": "multipolygon"} | tags})
    file.write_text(json.dumps({"elements": elements}) if file.suffix == ".json" else xml(elements))
    return file


def xml(elements):
    parts = []
    for element in elements:
        inner = "".join(f'<nd ref="{node}"/>' for node in element.get("nodes", ()))
        for member in element.get("members", ()):
            inner += "<member " + " ".join(f"{key}={quoteattr(str(value))}" for key, value in member.items()) + "/>"
        inner += "".join(f"<tag k={quoteattr(key)} v={quoteattr(value)}/>" for key, value in element["tags"].items())
        place = f' lon="{element["lon"]}" lat="{element["lat"]}"' if "lon" in element else ""
        parts.append(f'<{element["type"]} id="{element["id"]}"{place}>{inner}</{element["type"]}>')
    return f'<?xml version="1.0"?><osm version="0.6">{"".join(parts)}</osm>'


TOWN = [
    (square(0, 0, 20, 10), {"building": "yes", "height": "12 m"}),
    (square(20, 0, 10, 10), {"building": "house", "building:levels": "2", "building:material": "brick"}),
    (square(50, 0, 30, 30), {}),
    (square(60, 10, 10, 10), {}),
    ([(0, 20), (40, 20)], {"highway": "residential"}),
]
YARD = ([(3, "outer"), (4, "inner")], {"building": "yes", "height": "15"})


@pytest.mark.parametrize("name", ["town.osm", "town.json"])
def test_buildings_have_roofs_and_walls_at_their_heights(tmp_path, name):
    new_scene = make_scene(written(tmp_path / name, TOWN, [YARD]), tmp_path / "scene")
    surfaces = plan_surfaces(read_plan(tmp_path / name), height_m=None)
    roofs = {round(float(each.vertices_m[0, 2]), 2): each.mesh.area for each in surfaces if each.kind == "ceiling"}
    assert roofs == {12: pytest.approx(200, abs=0.5), 6: pytest.approx(100, abs=0.5), 15: pytest.approx(800, abs=1)}
    walls = {each.material: each.mesh.area for each in surfaces if each.kind == "wall" and each.material == "itu_brick"}
    # The common wall is that of the higher building.
    assert walls == {"itu_brick": pytest.approx(3 * 10 * 6, abs=0.5)}
    assert sum(each.mesh.area for each in surfaces if each.kind == "wall") == pytest.approx(
        60 * 12 + 30 * 6 + 160 * 15, abs=3
    )
    assert level_area([surfaces[0]]).area == pytest.approx(120 * 70, abs=5)
    assert new_scene.materials.of("wall_01", "wall") == "itu_concrete"


def test_parts_of_a_building_take_its_place_and_begin_at_their_lower_ends(tmp_path):
    ways = [
        (square(0, 0, 20, 10), {"building": "yes", "height": "30"}),
        (square(0, 0, 10, 10), {"building:part": "yes", "height": "30"}),
        (square(10, 0, 10, 10), {"building:part": "yes", "height": "20", "min_height": "5"}),
    ]
    surfaces = plan_surfaces(read_plan(written(tmp_path / "a.osm", ways)), height_m=None, floor_m=1.0)
    roofs = sorted(float(each.vertices_m[0, 2]) for each in surfaces if each.kind == "ceiling")
    assert roofs == pytest.approx([21, 31])
    low = {each.name: each.vertices_m[:, 2].min() for each in surfaces if each.kind == "wall"}
    assert sorted(low.values()) == pytest.approx([1, 6])


def test_heights_are_read_in_metres_and_feet():
    assert stated_height({"height": "40 ft"})[1] == pytest.approx(12.192)
    assert stated_height({"height": "12,5"}) == (0, 12.5)
    assert np.isnan(stated_height({"height": "high"})[1])


def test_a_height_that_no_tag_states_is_asked_for(tmp_path, command):
    file = written(tmp_path / "a.osm", [*TOWN, (square(0, 40, 5, 5), {"building": "shed"})], [YARD])
    words = ["mesh", file, "--out", tmp_path / "out"]
    command.refused(words, r"1 of 4 buildings state neither height nor building:levels; .*\(--wall-height\)")
    assert "1 floor, 4 ceiling, 4 wall" in command.done([*words, "--wall-height", 3])


def rooms(level):
    tags = {"level": level}
    return [
        (square(0, 0, 6, 3), {"indoor": "room"} | tags),
        (square(6, 0, 6, 3), {"indoor": "room", "material": "glass"} | tags),
        ([(0, 3), (3, 3), (6, 3), (12, 3), (12, 5), (8, 5), (0, 5), (0, 3)], {"indoor": "corridor"} | tags),
        ([(0, 5), (8, 5), (8, 8), (0, 8), (0, 5)], {"indoor": "room"} | tags),
        (square(8, 5, 4, 3), {"indoor": "area"} | tags),
    ]


def test_rooms_of_a_level_have_walls_materials_and_doors(tmp_path):
    house = (square(0, 0, 12, 8), {"building": "yes", "building:levels": "2"})
    file = written(
        tmp_path / "a.osm", [house, *rooms("0"), *rooms("1")], doors=[((3, 3), {"door": "yes", "level": "0"})]
    )
    floor, _, *walls = plan_surfaces(read_plan(file, level="0"), height_m=3)
    assert floor.mesh.area == pytest.approx(96, abs=0.2)
    sides = {each.name: np.round(each.vertices_m[:2, :2], 2) for each in walls}
    np.testing.assert_allclose(np.sort(sides["door"], axis=0), [[2.55, 3], [3.45, 3]], atol=0.01)
    lengths: dict[str, float] = {}
    for each in walls:
        length = float(np.linalg.norm(np.diff(each.vertices_m[:2, :2], axis=0)))
        lengths[each.material] = lengths.get(each.material, 0) + length * (each.kind == "wall")
    # Neither the door nor the edge between corridor and area is a wall.
    assert lengths == {"itu_glass": pytest.approx(18, abs=0.1), "": pytest.approx(40 - 9 + 6 - 0.9 + 8 + 3, abs=0.2)}


def test_the_level_is_asked_for_where_it_is_unclear(tmp_path, command):
    file = written(tmp_path / "a.osm", [(square(0, 0, 12, 8), {"building": "yes"}), *rooms("0"), *rooms("1-2")])
    words = ["mesh", file, "--wall-height", 3, "--out", tmp_path / "out"]
    command.refused(words, r"rooms of 3 levels and 1 buildings; .*--level \(0, 1, 2, buildings\)")
    command.refused([*words, "--level", "7"], r"--level 7: not in the file, which has 0, 1, 2, buildings")
    assert "1 floor, 1 ceiling, 1 wall" in command.done([*words, "--level", "buildings"])
    assert "1 floor, 1 ceiling" in command.done([*words, "--level", "2", "--replace"])


@pytest.mark.parametrize("content", ["<osm", "<osm></osm>", '<!DOCTYPE a [<!ENTITY b "c">]><osm>&b;</osm>'])
def test_damaged_files_are_refused_in_one_line(tmp_path, command, content):
    (tmp_path / "a.osm").write_text(content)
    command.refused(["mesh", tmp_path / "a.osm", "--wall-height", 3, "--out", tmp_path / "out"], "a.osm: .*; give Geo")
