"""Floor plans in GeoJSON: longitude and latitude become metres, common edges single walls."""

import json

import numpy as np
import pytest
import shapely
from changed_folders import DATA, needs

from wrf_mi.core import InputError
from wrf_mi.scene.make import make_scene
from wrf_mi.scene.plan.sources import read_plan
from wrf_mi.scene.plan.storey import plan_surfaces

pyproj = pytest.importorskip("pyproj")

WEST, SOUTH = 120.13, 30.301
# Two shops of 10 m x 8 m side by side, and a corridor of 3 m along both, roughly, in degrees.
X, Y = WEST + np.array([0, 1e-4, 2e-4]), SOUTH + np.array([0, 3e-5, 1e-4])
SHOPS = [(0, 1, 1, 2), (1, 1, 2, 2)]
CORRIDOR = (0, 0, 2, 1)
PILLAR = [[X[0] + 4e-5, Y[0] + 1e-5], [X[0] + 4.5e-5, Y[0] + 1e-5], [X[0] + 4.5e-5, Y[0] + 1.5e-5]]


def ring(west, south, east, north):
    x, y = X[[west, east, east, west, west]], Y[[south, south, north, north, south]]
    return np.stack([x, y], axis=1).tolist()


def written(file, rings, **more):
    """A collection of a feature for each ring, and one without a place."""
    geometries = [None, *({"type": "Polygon", "coordinates": [corners]} for corners in rings)]
    features = [{"type": "Feature", "properties": {}, "geometry": geometry} for geometry in geometries]
    file.write_text(json.dumps({"type": "FeatureCollection", "features": features, **more}))
    return file


def walls_of(file, **options):
    floor, _, *walls = plan_surfaces(read_plan(file, **options), height_m=3)
    return floor.mesh.area, np.stack([wall.vertices_m[:2, :2] for wall in walls])


@pytest.fixture
def plan(tmp_path):
    return written(tmp_path / "plan.geojson", [*(ring(*shop) for shop in SHOPS), ring(*CORRIDOR)])


def test_walls_have_the_lengths_of_geodesics_and_common_edges_are_single_walls(plan):
    geod = pyproj.Geod(ellps="WGS84")

    def metres(begin, end):
        return geod.inv(X[begin[0]], Y[begin[1]], X[end[0]], Y[end[1]])[2]

    area, walls = walls_of(plan)
    outer = metres((0, 0), (2, 0)), metres((0, 2), (2, 2)), metres((0, 0), (0, 2)), metres((2, 0), (2, 2))
    total = sum(outer) + metres((0, 1), (2, 1)) + metres((1, 1), (1, 2))
    lengths = np.linalg.norm(walls[:, 1] - walls[:, 0], axis=-1)
    assert lengths.sum() == pytest.approx(total, rel=1e-3)
    partition = walls[np.abs(walls[:, :, 0] - metres((0, 0), (1, 0))).max(axis=1) < 0.1]
    assert len(partition) == 1
    assert np.linalg.norm(np.diff(partition[0], axis=0)) == pytest.approx(metres((1, 1), (1, 2)), rel=1e-3)
    outline = ring(0, 0, 2, 2)
    assert area == pytest.approx(abs(geod.polygon_area_perimeter(*np.transpose(outline))[0]), rel=1e-3)
    np.testing.assert_allclose(walls.min(axis=(0, 1)), 0, atol=1e-2)


def test_edges_that_differ_by_millimetres_are_one_wall(tmp_path, plan):
    second = np.add(ring(*SHOPS[1]), [2e-8, 1e-8])
    shaken = written(tmp_path / "b.json", [ring(*SHOPS[0]), second.tolist(), ring(*CORRIDOR)])
    assert len(walls_of(shaken)[1]) == len(walls_of(plan)[1])


@pytest.mark.parametrize("beside", [False, True])
def test_a_stated_extent_scales_the_plan_and_is_compared_with_the_ground(plan, caplog, beside):
    _, walls = walls_of(plan)
    ground = walls.max(axis=(0, 1))
    for factor, warned in ((1.01, False), (1.1, True)):
        caplog.clear()
        extent = tuple((ground * [factor, 1]).tolist())
        info = {"map_info": {"width": extent[0], "height": extent[1]}}
        if beside:
            plan.with_name("floor_info.json").write_text(json.dumps(info))
        _, walls = walls_of(plan, **({} if beside else {"extent_m": extent}))
        np.testing.assert_allclose(walls.max(axis=(0, 1)), extent, atol=1e-2)
        assert ("on the ground" in caplog.text) == warned


def test_small_polygons_are_left_out_and_counted(tmp_path, plan, caplog):
    more = written(tmp_path / "b.json", [ring(*shop) for shop in (*SHOPS, CORRIDOR)] + [[*PILLAR, PILLAR[0]]])
    assert len(walls_of(more)[1]) == len(walls_of(plan)[1])
    assert "1 of 4 polygons are smaller than 1 m2" in caplog.text


METRES = [[0, 0], [6, 0], [6, 5], [0, 5], [0, 0]]
WEB_MERCATOR = [[13373088.5, 3542417.9], [13373098.5, 3542417.9], [13373098.5, 3542427.9], [13373088.5, 3542417.9]]


@pytest.mark.parametrize(
    ("content", "options", "message"),
    [
        ("{", [], r"not readable \(.*\); give GeoJSON with polygons"),
        ("[]", [], r"not readable \(.*\); give GeoJSON"),
        ('{"type": "Topology"}', [], r"not readable \(.*\); give GeoJSON"),
        ('{"type": "Point", "coordinates": [0, 0]}', [], "no polygons; give GeoJSON"),
        (WEB_MERCATOR, [], r"coordinates up to 1.33731e\+07 are no degrees; give"),
        (METRES, [], r"667.9 km x 553.9 km as degrees are no building; give"),
        ([*PILLAR, PILLAR[0]], [], "no polygon of 1 m2 or more; give"),
        (ring(*CORRIDOR), ["--extent", "0,5"], r"--extent: \(0.0, 5.0\); give width and height in metres"),
    ],
)
def test_files_that_are_no_plan_in_degrees_are_refused_in_one_line(tmp_path, command, content, options, message):
    file = tmp_path / "plan.json"
    if isinstance(content, str):
        file.write_text(content)
    else:
        written(file, [content])
    command.refused(["mesh", file, "--wall-height", 3, *options, "--out", tmp_path / "out"], message)


def test_an_extent_of_a_plan_in_metres_is_refused(tmp_path):
    file = tmp_path / "layout.csv"
    file.write_text("x,y\n0,0\n6,0\n6,5\n0,5\n0,0\n")
    with pytest.raises(InputError, match="--extent is for plans in longitude and latitude"):
        make_scene(file, tmp_path / "out", height_m=3, extent_m=(6, 5))


@needs("mall-f3")
def test_measured_positions_lie_within_the_outline_of_a_shopping_centre(caplog):
    folder = DATA / "mall-f3"
    area, walls = walls_of(folder / "geojson_map.json")
    assert "on the ground" not in caplog.text
    assert 500 < len(walls) < 1200
    rooms = shapely.polygonize([shapely.union_all(shapely.linestrings(walls))])
    floor = shapely.union_all(shapely.buffer(shapely.get_parts(rooms), 0.05))
    places = np.loadtxt(folder / "test.csv", delimiter=",", skiprows=1, usecols=(2, 3))
    assert shapely.contains_xy(floor, places).all()
    assert area == pytest.approx(24003, abs=50)
