"""Plans with known walls: what is found in maps, points and layouts, and their files."""

from typing import Any

import numpy as np
import pytest
from made_plans import (
    INNER_M,
    L_ROOM_M,
    POSES_M,
    TWO_ROOMS_M,
    agreement,
    box,
    distance,
    grid_of,
    read_grid,
    scan,
    scans,
    turn,
)
from PIL import Image

from wrf_mi.core import InputError
from wrf_mi.core.array_files import write_arrays
from wrf_mi.scene.plan.lines import dominant_direction
from wrf_mi.scene.plan.sources import (
    grid_from_points,
    grid_from_probability,
    read_layout,
    read_plan,
)
from wrf_mi.scene.plan.storey import floor_of, layout_walls, plan_surfaces
from wrf_mi.scene.plan.walls import find_walls, joined

CLOSE_M = 0.1
"""Two cells of the maps made here."""
SHARE = 0.97
"""Of the walls: the rest is corners that a map of 5 cm cells rounds."""
WARDROBE = box(0.05, 2.6, 0.55, 1.2)
TABLE = np.concatenate([box(x, y, 0.06, 0.06) for x in (4.3, 4.9) for y in (2.2, 2.6)])


@pytest.mark.parametrize("degrees", [0, 20, 45, 77])
def test_turned_rooms_with_a_door_are_found(degrees):
    rooms, poses, door_middle = (
        turn(np.asarray(points), degrees, (3.0, -2.0)) for points in (TWO_ROOMS_M, POSES_M, [INNER_M, 1.45])
    )
    walls = find_walls(grid_of(rooms, poses))
    assert len(walls) == len(TWO_ROOMS_M)
    assert min(agreement(walls, rooms, CLOSE_M)) > SHARE
    # The door is 0.9 m wide and stays open.
    assert 0.35 < distance(door_middle, walls) < 0.5


@pytest.mark.parametrize("degrees", [0, 33])
def test_furniture_is_left_out_and_the_wall_behind_it_goes_on(degrees):
    scene = turn(np.concatenate([TWO_ROOMS_M, WARDROBE, TABLE]), degrees)
    walls = find_walls(grid_of(scene, turn(POSES_M, degrees)))
    assert min(agreement(walls, turn(TWO_ROOMS_M, degrees), CLOSE_M)) > SHARE
    for hidden_or_clutter in ([0.6, 3.2], [4.33, 2.23]):
        assert distance(turn(np.array(hidden_or_clutter), degrees), walls) > 0.4


def test_furniture_noise_and_strays_of_points():
    points = np.concatenate(scans(np.concatenate([TWO_ROOMS_M, WARDROBE, TABLE])))
    walls = find_walls(grid_from_points(points))
    recall, right = agreement(walls, TWO_ROOMS_M, CLOSE_M)
    assert 0.9 < recall < 1  # behind the wardrobe nothing was seen
    assert right > 0.9
    assert distance([0.6, 3.2], walls) < CLOSE_M
    assert distance([4.33, 2.23], walls) > 0.4
    rng = np.random.default_rng(3)
    clouds = scans(TWO_ROOMS_M, noise_m=0.03)
    points = np.concatenate([*clouds, rng.uniform([0, 0], [6, 4], (60, 2))])
    assert min(agreement(find_walls(grid_from_points(points)), TWO_ROOMS_M, CLOSE_M)) > SHARE


CUT_CORNER = [(0, 0), (5, 0), (6.5, 1.5), (6.5, 5), (0, 5), (0, 0)]
HEXAGON = [(3 + 3 * np.cos(a), 3 + 3 * np.sin(a)) for a in np.radians(np.arange(0, 420, 60))]


@pytest.mark.parametrize("degrees", [0, 17])
@pytest.mark.parametrize(("corners", "share"), [(CUT_CORNER, SHARE), (HEXAGON, 0.9)])
def test_walls_in_other_directions_are_found(corners, share, degrees):
    # 0.9: where two oblique walls meet at 120 degrees their ends are found less well than at right angles.
    true = turn(layout_walls(np.array(corners, float)), degrees)
    walls = find_walls(grid_of(true, turn(np.array([[2.0, 2.0], [4.0, 3.0]]), degrees)))
    assert min(agreement(walls, true, CLOSE_M)) > share


@pytest.mark.parametrize("degrees", [0.0, 12.0, 44.0, 60.0, 89.0])
def test_direction_is_found(degrees):
    grid = grid_from_points(np.concatenate(scans(turn(TWO_ROOMS_M, degrees), turn(POSES_M, degrees))))
    error = (np.degrees(dominant_direction(grid.occupied)) - degrees + 45) % 90 - 45
    assert abs(error) < 0.5


def test_ends_meet_within_reach_and_doors_stay():
    walls = np.array([[[0.2, 0], [4, 0]], [[0, 0.1], [0, 3]], [[2, 0.6], [2, 3]]], float)
    np.testing.assert_allclose(joined(walls), [[[0, 0], [4, 0]], [[0, 0], [0, 3]], walls[2]], atol=1e-8)
    wall = np.array([[[0, 0], [5, 0]]], float)
    grid = grid_from_points(scan(wall, np.array([2.0, 1.5])))
    assert agreement(find_walls(grid), wall, CLOSE_M)[1] > SHARE
    with pytest.raises(InputError, match="1 walls found enclose no floor"):
        plan_surfaces(grid, height_m=2.5)
    assert floor_of(TWO_ROOMS_M).area == pytest.approx(24, rel=0.01)
    assert floor_of(layout_walls(L_ROOM_M)).area == pytest.approx(16.25)
    # With a gap in the outer wall too, as where a door stood open.
    open_walls = np.concatenate([TWO_ROOMS_M[1:], [[[0, 0], [1, 0]], [[2, 0], [6, 0]]]])
    assert floor_of(open_walls).area == pytest.approx(24, rel=0.02)


# --- floors and surfaces


def test_layout_is_extruded_as_it_is(tmp_path):
    doubled = np.array([[0, 0], [4, 0], [4, 3], [2, 3], [2, 1], [2, 3], [0, 3], [0, 0]], float)
    file = tmp_path / "layout.csv"
    np.savetxt(file, doubled, delimiter=",", header="x,y", comments="")
    floor, ceiling, *walls = surfaces = plan_surfaces(read_layout(file), height_m=2.5, floor_m=0.2)
    assert [floor.kind, ceiling.kind, *{s.kind for s in walls}] == ["floor", "ceiling", "wall"]
    assert sum(s.mesh.area for s in walls) == pytest.approx(2.5 * (4 + 3 + 4 + 3 + 2))
    assert [floor.mesh.area, ceiling.mesh.area] == pytest.approx([12, 12])
    assert [set(s.vertices_m[:, 2]) for s in (floor, ceiling)] == [{0.2}, {2.7}]
    assert len({s.name for s in surfaces}) == len(surfaces)
    for wall in walls:
        assert (wall.vertices_m[:, 2].min(), wall.vertices_m[:, 2].max()) == (0.2, 2.7)
        assert np.linalg.matrix_rank(wall.vertices_m - wall.vertices_m[0], tol=1e-9) == 2


# --- what the sources refuse


def grid(values, resolution_m=0.05):
    return lambda: grid_from_probability(values, resolution_m, "top")


def of_points(*points):
    return lambda: find_walls(grid_from_points(np.array(points).reshape(-1, 2)))


@pytest.mark.parametrize(
    ("read", "message"),
    [
        (grid(np.full((20, 20), np.nan)), "every cell is NaN"),
        (grid(np.zeros((20, 20))), "no cell is occupied"),
        (grid(np.zeros((0, 5))), "two axes"),
        (grid(np.zeros(5)), "two axes"),
        (grid(np.ones((3, 3)), 0), "resolution is 0"),
        (of_points(), "n > 0"),
        (of_points([0, np.nan]), "point 0 is not finite"),
        (of_points([0, 0], [9000.0, 9000.0]), "are the units metres"),
        (of_points(*np.random.default_rng(0).uniform(0, 20, (40, 2))), "no straight wall"),
        *((lambda h=h: plan_surfaces(L_ROOM_M, height_m=h), "height above zero") for h in (0.0, -1.0, np.nan, np.inf)),
    ],
)
def test_sources_without_walls_and_heights_that_are_not_positive_are_refused(read, message):
    with pytest.raises(InputError, match=message):
        read()


ODDS = np.array([[-3.0, np.nan, 4.0], [-3.0, -3.0, 4.0]])
"""Free on the left, occupied on the right; the first row is on top."""


def test_grids_of_log_odds_and_probabilities_and_ros_maps_are_read(tmp_path):
    file = tmp_path / "map.npz"
    np.savez(file, log_odds=ODDS, resolution_m=0.5, origin_m=[1.0, 2.0], row_0="top")
    grid = read_grid(file)
    assert [grid.resolution_m, read_grid(file, 0.1).resolution_m] == [0.5, 0.1]
    assert grid.centres_m(grid.occupied).tolist() == [[2.25, 2.25], [2.25, 2.75]]
    np.savez(file, log_odds=np.array([[0.0, 0.5, 1.0]]), resolution_m=0.1, row_0="top")
    grid = read_grid(file)
    assert (grid.occupied.tolist(), grid.free.tolist()) == ([[False, False, True]], [[True, False, False]])
    # 205 is what map_server writes where nothing is known: neither occupied nor free.
    Image.fromarray(np.array([[254, 205, 0]], np.uint8)).save(tmp_path / "flat.pgm")
    (tmp_path / "flat.yaml").write_text("image: flat.pgm\nresolution: 0.05\norigin: [-1.0, 2.0, 0.0]\nnegate: 0\n")
    for name in ("flat.yaml", "flat.pgm"):
        grid = read_grid(tmp_path / name)
        assert (grid.occupied.tolist(), grid.free.tolist()) == ([[False, False, True]], [[True, False, False]])
        assert (grid.resolution_m, grid.origin_m.tolist()) == (0.05, [-1, 2])


def test_row_0_of_the_caller_overrides_that_of_the_file_and_is_refused_where_the_format_fixes_it(tmp_path):
    file = tmp_path / "map.npz"
    occupied, free = [[False, False, True], [False, False, True]], [[True, True, False], [True, False, False]]
    for row_0, asked, from_top in (
        ("top", None, True),
        ("bottom", None, False),
        (b"Bottom", None, False),
        ("bottom", "top", True),
        (None, "bottom", False),
    ):
        side = {} if row_0 is None else {"row_0": row_0}
        write_arrays(file, {"log_odds": ODDS, "resolution_m": 0.5, **side})
        grid = read_grid(file, row_0=asked)
        assert (grid.occupied.tolist(), grid.free.tolist()) == (occupied, free if from_top else free[::-1])
        assert grid.origin_m.tolist() == [0, 0]
    Image.fromarray(np.array([[254, 205, 0]], np.uint8)).save(tmp_path / "flat.png")
    (tmp_path / "layout.csv").write_text("x,y\n0,0\n1,0\n")
    np.savez(tmp_path / "points.npz", xy_m=np.eye(2))
    for name, why in (("flat.png", "is its top"), ("layout.csv", "no rows of cells"), ("points.npz", "no rows")):
        with pytest.raises(InputError, match=rf"{name}: --row-0 is for .*{why}; leave it out"):
            read_plan(tmp_path / name, 0.1, "top")


def test_points_become_cells_and_layouts_vertices(tmp_path):
    np.savez(tmp_path / "a.npz", xy_m=np.array([[1.01, 2.02], [3.03, 4.04]]))
    (tmp_path / "b.xyz").write_text("# a scan\n1.01 2.02\n3.03,4.04  # comment\n\n")
    for name in ("a.npz", "b.xyz"):
        source = read_grid(tmp_path / name, 0.1)
        np.testing.assert_allclose(source.centres_m(source.occupied), [[1.05, 2.05], [3.05, 4.05]])
        assert not source.free.any()
    (tmp_path / "layout.csv").write_text("x,y\n0,0\n2.5,0\n2.5,1\n")
    readers: tuple[Any, ...] = read_layout, read_plan
    for read in readers:
        assert read(tmp_path / "layout.csv").tolist() == [[0, 0], [2.5, 0], [2.5, 1]]


@pytest.mark.parametrize(
    ("arrays", "line"),
    [
        ({"log_odds": ODDS}, r"no resolution_m; give the side of a cell in metres \(--resolution\)"),
        ({"log_odds": ODDS, "resolution_m": 0.1}, r"which side of the plan the first row is; store row_0 .* --row-0"),
        ({"log_odds": ODDS, "resolution_m": 0.1, "row_0": "upper"}, "row_0 is 'upper'; give top .* or bottom"),
        ({"log_odds": ODDS, "resolution_m": 0.1, "row_0": ["top", "top"]}, "row_0 is .*; give top .* or bottom"),
        ({"log_odds": ODDS, "resolution_m": 0.1, "row_0": 0}, "row_0 is '0'; give top .* or bottom"),
        ({"log_odds": ODDS, "resolution_m": 0.1, "origin_m": [1.0]}, "origin_m is .*; give x and y"),
        ({"log_odds": np.full((3, 3), np.nan), "resolution_m": 0.1, "row_0": "top"}, "every cell is NaN"),
        ({"log_odds": np.full((3, 3), -1.0), "resolution_m": 0.1, "row_0": "top"}, "no cell is occupied"),
        ({"log_odds": np.array([["a"]]), "resolution_m": 0.1}, "log_odds holds no numbers"),
        ({"xy_m": np.zeros((3, 3))}, r"points of a plan have shape .* these have \(3, 3\)"),
        ({"xy_m": np.zeros((3, 2)), "time_s": np.zeros(3)}, "time_s: scans .* are not aligned; give the map of a SLAM"),
        ({"xy_m": np.array([[0.0, np.nan]])}, "point 0 is not finite"),
        ({"other": np.zeros(2)}, "neither log_odds nor xy_m but other"),
    ],
)
def test_arrays_without_a_plan_are_refused(tmp_path, arrays, line):
    np.savez(tmp_path / "plan.npz", **arrays)
    with pytest.raises(InputError, match=line) as caught:
        read_plan(tmp_path / "plan.npz")
    assert "plan.npz" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "text", "line"),
    [
        ("a.csv", "a,b\n0,0\n1,1\n", "line 1: header is .a,b.; it must be x,y"),
        ("a.csv", "", "empty; give a header"),
        ("a.csv", "x,y\n0,0\n1\n", "row 2: 1 field, but the header has 2"),
        ("a.csv", "x,y\n0,0\n1,nan\n", "row 2: y is .nan.; give a finite number"),
        ("a.csv", "x,y\n1,1\n1,1\n", "no wall"),
        ("a.csv", "x,y\n1,1\n", "no wall"),
        ("a.xyz", "1 2\n1 2 3\n", "line 2: expected two numbers"),
        ("a.txt", "# nothing\n", "no points"),
        ("a.npz", "no archive", "not an NPZ file"),
        ("a.npz", None, "missing"),
        ("a.png", "no picture", "give the side of a pixel"),
        ("a.yaml", "image: b.pgm\n", "not the YAML of a ROS map"),
        ("a.yaml", "- 1\n", "not the YAML of a ROS map"),
        ("a.yaml", "image: b.pgm\nresolution: 0.1\norigin: [0, 0, 0]\n", "not a picture that can be read"),
        ("a.dwg", "", "unknown ending"),
    ],
)
def test_files_without_a_plan_are_refused(tmp_path, name, text, line):
    if text is not None:
        (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=line) as caught:
        read_plan(tmp_path / name)
    assert "\n" not in str(caught.value)
