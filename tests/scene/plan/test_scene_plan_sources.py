"""Files that show a plan: what is read from them, and the line that refuses them."""

import numpy as np
import pytest
from PIL import Image

from wrf_mi.core import InputError
from wrf_mi.scene.plan.sources import PlanGrid, PlanPoints, read_layout, read_plan

ODDS = np.array([[-3.0, np.nan, 4.0], [-3.0, -3.0, 4.0]])
"""Free on the left, occupied on the right; the first row is on top."""


def test_grid_of_log_odds(tmp_path):
    file = tmp_path / "map.npz"
    np.savez(file, log_odds=ODDS, resolution_m=0.5, origin_m=[1.0, 2.0], row_0="top")
    grid = read_plan(file)
    assert isinstance(grid, PlanGrid)
    assert grid.resolution_m == 0.5
    # Rows run upwards now.
    assert grid.occupied.tolist() == [[False, False, True], [False, False, True]]
    assert grid.free.tolist() == [[True, True, False], [True, False, False]]
    assert grid.centres_m(grid.occupied).tolist() == [[2.25, 2.25], [2.25, 2.75]]
    assert read_plan(file, 0.1).resolution_m == 0.1


def test_row_0_of_the_caller_overrides_that_of_the_file(tmp_path):
    file = tmp_path / "map.npz"
    upwards = [[False, False, True], [False, False, True]], [[True, True, False], [True, False, False]]
    as_stored = upwards[0], upwards[1][::-1]
    for stated, given, expected in (
        ("top", None, upwards),
        ("bottom", None, as_stored),
        (b"Bottom", None, as_stored),
        ("bottom", "top", upwards),
        (None, "bottom", as_stored),
    ):
        arrays = {} if stated is None else {"row_0": stated}
        np.savez(file, log_odds=ODDS, resolution_m=0.5, **arrays)
        grid = read_plan(file, row_0=given)
        assert (grid.occupied.tolist(), grid.free.tolist()) == expected
        assert grid.origin_m.tolist() == [0, 0]


def test_row_0_is_refused_where_the_format_fixes_it(tmp_path):
    Image.fromarray(np.array([[254, 205, 0]], np.uint8)).save(tmp_path / "flat.png")
    (tmp_path / "layout.csv").write_text("x,y\n0,0\n1,0\n")
    np.savez(tmp_path / "points.npz", xy_m=np.eye(2))
    for name, why in (("flat.png", "is its top"), ("layout.csv", "no rows of cells"), ("points.npz", "no rows")):
        with pytest.raises(InputError, match=rf"{name}: --row-0 is for .*{why}; leave it out"):
            read_plan(tmp_path / name, 0.1, "top")


def test_probabilities_and_log_odds_are_distinguished(tmp_path):
    file = tmp_path / "map.npz"
    np.savez(file, log_odds=np.array([[0.0, 0.5, 1.0]]), resolution_m=0.1, row_0="top")
    grid = read_plan(file)
    assert grid.occupied.tolist() == [[False, False, True]]
    assert grid.free.tolist() == [[True, False, False]]


def test_points_with_and_without_times(tmp_path):
    np.savez(tmp_path / "a.npz", xy_m=np.eye(2), time_s=[0.0, 1.0])
    source = read_plan(tmp_path / "a.npz")
    assert isinstance(source, PlanPoints)
    assert source.time_s.tolist() == [0, 1]
    (tmp_path / "b.xyz").write_text("# a scan\n1 2\n3,4  # comment\n\n")
    source = read_plan(tmp_path / "b.xyz")
    assert source.xy_m.tolist() == [[1, 2], [3, 4]]
    assert source.time_s is None


def test_ros_map_is_read(tmp_path):
    # 205 is what map_server writes where nothing is known: neither occupied nor free.
    Image.fromarray(np.array([[254, 205, 0]], np.uint8)).save(tmp_path / "flat.pgm")
    (tmp_path / "flat.yaml").write_text("image: flat.pgm\nresolution: 0.05\norigin: [-1.0, 2.0, 0.0]\nnegate: 0\n")
    for name in ("flat.yaml", "flat.pgm"):
        grid = read_plan(tmp_path / name)
        assert grid.occupied.tolist() == [[False, False, True]]
        assert grid.free.tolist() == [[True, False, False]]
        assert grid.resolution_m == 0.05
        assert grid.origin_m.tolist() == [-1, 2]


def test_layout_vertices_are_read(tmp_path):
    file = tmp_path / "layout.csv"
    file.write_text("x,y\n0,0\n2.5,0\n2.5,1\n")
    assert read_layout(file).tolist() == [[0, 0], [2.5, 0], [2.5, 1]]
    assert np.array_equal(read_plan(file), read_layout(file))


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
        ({"xy_m": np.zeros((3, 3))}, r"xy_m has shape \(3, 3\)"),
        ({"xy_m": np.zeros((3, 2)), "time_s": np.zeros(2)}, r"time_s has shape \(2,\); expected \[3\]"),
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
        ("a.png", "no picture", "give the side of a pixel"),
        ("a.yaml", "image: b.pgm\n", "not the YAML of a ROS map"),
        ("a.yaml", "- 1\n", "not the YAML of a ROS map"),
        ("a.yaml", "image: b.pgm\nresolution: 0.1\norigin: [0, 0, 1.5]\n", "turned by 1.5 rad"),
        ("a.yaml", "image: b.pgm\nresolution: 0.1\norigin: [0, 0, 0]\n", "not a picture that can be read"),
        ("a.dwg", "", "unknown ending"),
    ],
)
def test_files_without_a_plan_are_refused(tmp_path, name, text, line):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=line) as caught:
        read_plan(tmp_path / name)
    assert "\n" not in str(caught.value)


def test_missing_file(tmp_path):
    with pytest.raises(InputError, match="missing"):
        read_plan(tmp_path / "none.npz")
