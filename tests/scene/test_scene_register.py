"""Measured positions tell a plan from its mirror image; registration recovers motions, and refuses ambiguous data."""

from pathlib import Path

import numpy as np
import pytest
import shapely
import trimesh
from calling import call, refused
from changed_folders import DATA, needs
from hypothesis import given, settings
from hypothesis import strategies as st
from made_plans import L_ROOM_M, TWO_ROOMS_M, box, grid_of, turn
from made_rooms import joined
from scipy.spatial.transform import Rotation

from wrf_mi.core import InputError
from wrf_mi.scene.make import make_scene
from wrf_mi.scene.mesh.surfaces import Surface
from wrf_mi.scene.plan.sources import read_layout
from wrf_mi.scene.plan.storey import layout_walls, plan_surfaces
from wrf_mi.scene.positions import conflicts, read_positions
from wrf_mi.scene.register import (
    best_scale,
    distance_to_walls,
    read_pairs,
    register_pairs,
    register_walls,
    sample_walls,
    wall_points,
)

OFFICE_M = np.array([[0, 0], [9, 0], [9, 3], [5, 3], [5, 7], [0, 7], [0, 0]], float)
"""An office whose wings have different widths; with `PARTITIONS_M`."""
PARTITIONS_M = np.array([[[0, 3], [1, 3]], [[2, 3], [5, 3]], [[6.5, 0], [6.5, 1.5]]])
ROUTE_M = np.array(
    [[0.7, 0.6], [1.5, 1.5], [1.5, 5], [4, 6], [1.5, 5], [1.5, 1.5], [5, 2.2], [8, 2.2], [8, 0.8]], float
)


def walk(corners_m: np.ndarray, step_m: float = 0.2) -> np.ndarray:
    line = shapely.linestrings(corners_m)
    return shapely.get_coordinates(shapely.line_interpolate_point(line, np.arange(0, line.length, step_m)))


def write_positions(path: Path, xy_m: np.ndarray, header: str = "x,y") -> Path:
    np.savetxt(path, xy_m, delimiter=",", header=header, comments="")
    return path


def write_grid(path: Path, row_0: str, walls_m: np.ndarray, poses_m: np.ndarray) -> Path:
    """A robot's map whose rows run from the top and whose file says ``row_0``; wider above than the building."""
    grid = grid_of(walls_m, poses_m)
    odds = np.where(grid.occupied, 4.0, np.where(grid.free, -4.0, np.nan))
    odds = np.concatenate([odds, np.full((20, odds.shape[1]), np.nan)])
    np.savez(path, log_odds=odds[::-1], resolution_m=grid.resolution_m, origin_m=grid.origin_m, row_0=row_0)
    return path


@pytest.mark.parametrize("moved", [(0.0, 0.0), (40.0, -3.0)])
def test_a_map_with_the_wrong_row_0_is_refused(moved, tmp_path, capsys):
    """Another building than the flat, wherever its origin is; the true map passes."""
    walls = np.concatenate([np.stack([OFFICE_M[:-1], OFFICE_M[1:]], axis=1), PARTITIONS_M]) + moved
    places = walk(ROUTE_M) + moved
    options = ["--wall-height", "2.5", "--positions", write_positions(tmp_path / "places.csv", places)]
    true, wrong = (write_grid(tmp_path / f"{row_0}.npz", row_0, walls, places[::8]) for row_0 in ("top", "bottom"))
    status, _, err = call(["mesh", true, *options, "--out", tmp_path / "true"], capsys)
    assert status == 0, err
    message = "cross walls.*mirrored it is 0 and 0: give the other row_0"
    refused(["mesh", wrong, *options, "--out", tmp_path / "scene"], message, capsys)
    assert not (tmp_path / "scene").exists()


def test_a_map_whose_origin_is_elsewhere_is_told_with_a_shift(tmp_path, caplog):
    """Doors of a metre stop the positions that are half a metre off; the shift that is told makes them pass."""
    walls, places = np.concatenate([np.stack([OFFICE_M[:-1], OFFICE_M[1:]], axis=1), PARTITIONS_M]), walk(ROUTE_M)
    plan = write_grid(tmp_path / "plan.npz", "top", walls, places[::8])
    for shift, told in (((0.0, 0.0), False), ((-0.6, -0.75), True)):
        caplog.clear()
        at = write_positions(tmp_path / "places.csv", places + shift)
        make_scene(plan, tmp_path / "scene", height_m=2.5, positions=at, replace=True)
        assert ("positions moved by" in caplog.text) == told
    assert "moved by 0.25 m in x and 0.25 m in y fit: check the origin of the source (--origin)" in caplog.text


@pytest.mark.parametrize(
    ("axis", "about", "remedy"),
    [(1, 0.0, "change the sign of its y"), (1, 3.5, "replace its y by 7 - y"), (0, 4.5, "replace its x by 9 - x")],
)
def test_layouts_that_are_mirrored_or_in_another_frame_are_refused(axis, about, remedy, tmp_path):
    layout = write_positions(tmp_path / "layout.csv", OFFICE_M)
    positions = write_positions(tmp_path / "places.csv", walk(ROUTE_M[3:]))
    make_scene(layout, tmp_path / "scene", height_m=2.5, positions=positions)
    elsewhere = write_positions(tmp_path / "elsewhere.csv", walk(ROUTE_M) + 50.0)
    mirrored_m = OFFICE_M.copy()
    mirrored_m[:, axis] = 2 * about - mirrored_m[:, axis]
    mirrored = write_positions(tmp_path / "mirrored.csv", mirrored_m)
    for plan, places, message in (
        (mirrored, positions, rf"mirrored it is 0 and 0: {remedy}$"),
        (layout, elsewhere, "check the registration and the frame of the positions"),
    ):
        with pytest.raises(InputError, match=message):
            make_scene(plan, tmp_path / "refused", height_m=2.5, positions=places)


def test_a_door_lets_pass_at_its_height_and_the_wall_above_it_does_not():
    """A wall of three dimensions across a walk, open below 2 m between y = 1 and y = 2."""
    door = ((0, 0), (1, 2.5)), ((2, 0), (4, 2.5)), ((1, 2), (2, 2.5))
    parts = [trimesh.creation.box(bounds=[[3.0, *low], [3.1, *high]]) for low, high in door]
    mesh = joined(parts)
    wall = Surface("wall", "wall", np.asarray(mesh.vertices), np.asarray(mesh.faces))
    x = np.arange(0.2, 6, 0.25)
    for y, z, expected in ((1.5, np.nan, 0), (1.5, 1.2, 0), (1.5, 2.2, 1), (3.0, np.nan, 1)):
        places = np.column_stack([x, np.full(len(x), y), np.full(len(x), z)])
        assert conflicts(places, [wall])[0] == expected
    with pytest.raises(InputError, match="no wall"):
        conflicts(places, [])


def test_positions_from_a_file(tmp_path):
    file = write_positions(tmp_path / "a.csv", np.array([[1.0, 7.0, 2.0, 3.0]]), " X ,rssi,y,z")
    np.testing.assert_array_equal(read_positions(file), [[1, 2, 3]])
    file.write_text(",x,heading,y\n0,1,9,2\n")
    np.testing.assert_array_equal(read_positions(file), [[1, 2, np.nan]])
    for text, message in (
        (
            "X (px),Y (px),AP\n1,2,-40\n",
            r"no columns x and y in metres: x \(px\), y \(px\), ap; .* --units px, by wrf-mi data import",
        ),
        ("x,y\n1,2\n1,\n", "row 2: y is ''"),
        ("x,y\n", "no rows"),
        (None, "a.csv: no such file; give measured positions"),
    ):
        file.unlink() if text is None else file.write_text(text)
        with pytest.raises(InputError, match=message):
            read_positions(file)


def test_positions_of_a_data_folder(tmp_path):
    (tmp_path / "receivers.csv").write_text("id,x,y,z\n1,0,0,2\n")
    (tmp_path / "measurements.csv").write_text("x,y,z,rssi_1\n1,2,3,-50\n4,5,6,-60\n")
    np.testing.assert_array_equal(read_positions(tmp_path), [[1, 2, 3], [4, 5, 6]])


@needs("flat-ble")
def test_the_mirrored_flat_is_refused(tmp_path):
    flat = DATA / "flat-ble"
    vertices = read_layout(flat / "layout.csv")
    for name in ("calibration_df.csv", "test_robot_df.csv"):
        make_scene(flat / "layout.csv", tmp_path / name, height_m=2.7, positions=flat / name)
        for sign in ([1, -1], [-1, 1]):
            mirrored = write_positions(tmp_path / "mirrored.csv", vertices * sign)
            with pytest.raises(InputError, match=r"cross walls .* change the sign of its [xy]"):
                make_scene(mirrored, tmp_path / "scene", height_m=2.7, positions=flat / name)


def test_positions_pass_through_the_door_between_two_rooms_and_not_through_walls(tmp_path):
    """Positions in any order, as many as fill both rooms."""
    rng = np.random.default_rng(3)
    xy = rng.uniform([0.3, 0.3], [5.7, 3.7], (500, 2))
    xy = xy[np.abs(xy[:, 0] - 3.5) > 0.3]
    grid = write_grid(tmp_path / "map.npz", "top", TWO_ROOMS_M, np.array([[1.0, 1.0], [2.5, 3.0], [4.5, 1.4]]))
    positions = write_positions(tmp_path / "places.csv", xy)
    new_scene = make_scene(grid, tmp_path / "scene", height_m=2.5, positions=positions)
    assert new_scene.counts["surfaces"] == len(TWO_ROOMS_M) + 2  # floor and ceiling
    shifted = write_positions(tmp_path / "shifted.csv", xy + np.array([0.0, 1.5]))
    with pytest.raises(InputError, match="cross walls"):
        make_scene(grid, tmp_path / "refused", height_m=2.5, positions=shifted)


L_WALLS = layout_walls(L_ROOM_M)
EXACT_M = 1e-9
"""Closed form in float64 over some metres."""
FITTED_M = 5e-3
"""Robust fit of points that lie on the walls exactly; it stops when the cost changes by 1e-8."""

shifts = st.floats(-50, 50)
angles = st.floats(-180, 180)


def moved(matrix, points):
    """Points [..., 2] or [..., 3] moved by a matrix [4, 4]."""
    n = points.shape[-1]
    return points @ matrix[:n, :n].T + matrix[:n, 3]


@given(st.lists(st.tuples(shifts, shifts, shifts), min_size=3, max_size=3), st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_pairs_give_back_any_rigid_motion(rows, seed):
    rng = np.random.default_rng(seed)
    source = rng.uniform(-5, 5, (6, 3))
    rotation, shift = Rotation.random(rng=rng).as_matrix(), np.array(rows[0])
    motion = register_pairs(source, source @ rotation.T + shift)
    assert np.allclose(motion[:3, :3], rotation, atol=EXACT_M)
    assert np.allclose(motion[:3, 3], shift, atol=1e-8)
    assert np.allclose(moved(motion, source), source @ rotation.T + shift, atol=1e-8)


@given(angles, shifts, shifts)
@settings(max_examples=40, deadline=None)
def test_pairs_in_a_plane_turn_about_z(degrees, x, y):
    source = np.array([[0, 0], [4, 0], [1, 3]], float)
    target = turn(source, degrees, (x, y))
    for pairs in (3, 2):  # two points are enough in a plane
        motion = register_pairs(source[:pairs], target[:pairs])
        assert np.allclose(moved(motion, source), target, atol=1e-8), pairs
        assert motion[2].tolist() == [0, 0, 1, 0]


@pytest.mark.parametrize(
    ("source", "target", "line"),
    [
        (np.zeros((1, 2)), np.zeros((1, 2)), "1 pairs; give at least 2"),
        (np.eye(3)[:2], np.eye(3)[:2], "2 pairs; give at least 3"),
        (np.ones((4, 2)), np.ones((4, 2)), "at one place"),
        (np.arange(12.0).reshape(4, 3), np.arange(12.0).reshape(4, 3), "on one line"),
        (np.eye(3) * 5, np.eye(3) * 6, r"disagree by .* lengths times 1.200 would fit better \(0.00 m rms\)"),
        (np.array([[0, 0], [5, 0], [0, 5.0]]), np.array([[0, 0], [0, 5.0], [5, 0]]), "pair 1 by 4.71 m: check this"),
        (np.zeros((3, 2)), np.zeros((3, 3)), "are no pairs"),
    ],
)
def test_unsuitable_pairs_are_refused(source, target, line):
    with pytest.raises(InputError, match=rf"^pairs.csv: .*{line}"):
        register_pairs(source, target, name="pairs.csv")


def test_pairs_from_a_file_and_with_errors(tmp_path):
    file = tmp_path / "pairs.csv"
    file.write_text("x,y,to_x,to_y\n0,0,1,1\n2,0,1,3\n")
    source, target = read_pairs(file)
    assert (source.tolist(), target.tolist()) == ([[0, 0], [2, 0]], [[1, 1], [1, 3]])
    for text, message in (
        ("x,y,z,to_x,to_y,to_z\n0,0,0,1,1\n", "pairs.csv: row 1: 5 fields, but the header has 6"),
        ("a,b\n1,2\n", r"line 1: header is .a,b.; it must be x,y,z,to_x,to_y,to_z or x,y,to_x,to_y"),
    ):
        file.write_text(text)
        with pytest.raises(InputError, match=message):
            read_pairs(file)
    source = np.array([[0, 0, 0], [4, 0, 0], [0, 4, 0], [0, 0, 2]], float)
    noise = np.random.default_rng(0).normal(0, 0.02, source.shape)
    motion = register_pairs(source, source + np.array([1, 2, 3]) + noise)
    assert np.abs(moved(motion, source) - source - [1, 2, 3]).max() < 0.05


@given(angles, shifts, shifts)
@settings(max_examples=3, deadline=None)
def test_walls_give_back_any_turn_and_shift(degrees, x, y):
    points = turn(sample_walls(L_WALLS), degrees, (x, y))
    motion = register_walls(points, L_WALLS)
    corners = turn(L_ROOM_M, degrees, (x, y))
    assert np.abs(moved(motion, corners) - L_ROOM_M).max() < FITTED_M
    assert best_scale(moved(motion, points), np.zeros(3), L_WALLS)[0] == pytest.approx(1, abs=1e-3)


def test_walls_fit_in_spite_of_noise_furniture_and_what_is_missing():
    rng = np.random.default_rng(1)
    visible_walls = np.concatenate([TWO_ROOMS_M[1:], box(0.5, 0.5, 1.0, 0.6)])
    points = sample_walls(visible_walls) + rng.normal(0, 0.03, (len(sample_walls(visible_walls)), 2))
    motion = register_walls(turn(points, 140, (2, -3)), TWO_ROOMS_M)
    corners = turn(TWO_ROOMS_M.reshape(-1, 2), 140, (2, -3))
    # 3 cm of noise on some 200 points.
    assert np.abs(moved(motion, corners) - TWO_ROOMS_M.reshape(-1, 2)).max() < 0.02
    surfaces = plan_surfaces(L_ROOM_M, height_m=2.5)
    points = wall_points(surfaces)
    assert distance_to_walls(points, L_WALLS).max() < EXACT_M
    assert len(points) == pytest.approx(19 / 0.1, abs=7)
    with pytest.raises(InputError, match="no wall"):
        wall_points(surfaces[:2])


@pytest.mark.parametrize(
    ("points", "walls", "line"),
    [
        (sample_walls(box(0, 0, 4, 4)), box(0, 0, 4, 4), "two poses fit the walls alike, .* degrees apart"),
        (sample_walls(box(0, 0, 6, 4)), box(0, 0, 6, 4), "two poses fit the walls alike, 180 degrees"),
        (sample_walls(L_WALLS) * [-1, 1], L_WALLS, "mirror image fits the walls better"),
        (sample_walls(L_WALLS) * 1.4, L_WALLS, r"agreement .* lengths times 0.71 would fit better \(agreement 1.00\)"),
        (sample_walls(L_WALLS) * 0.5, L_WALLS, "does not fit the walls: agreement"),
        (np.random.default_rng(0).uniform(0, 5, (300, 2)), L_WALLS, "other lengths fit no better"),
        (np.zeros((2, 2)), L_WALLS, "needs points and walls"),
        (np.zeros((9, 2)), np.zeros((0, 2, 2)), "needs points and walls"),
    ],
)
def test_ambiguous_and_poor_fits_are_refused(points, walls, line):
    with pytest.raises(InputError, match=rf"^map.npz: .*{line}") as caught:
        register_walls(points, walls, name="map.npz")
    assert "\n" not in str(caught.value)
