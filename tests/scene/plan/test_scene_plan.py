"""Plans with known walls: what is found of them, from maps, points, scans with wrong poses, and layouts."""

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
    scan,
    scans,
    turn,
)

from wrf_mi.core import InputError
from wrf_mi.scene.plan.alignment import grid_from_scans, sensor_of
from wrf_mi.scene.plan.lines import dominant_direction
from wrf_mi.scene.plan.sources import PlanPoints, grid_from_points, grid_from_probability, read_layout
from wrf_mi.scene.plan.storey import floor_of, layout_walls, plan_surfaces, walls_of_plan
from wrf_mi.scene.plan.walls import find_walls, joined

CLOSE_M = 0.1
"""Two cells of the maps made here."""
SHARE = 0.97
"""Of the walls: the rest is corners that a map of 5 cm cells rounds."""
DOOR_MIDDLE_M = np.array([INNER_M, 1.45])
WARDROBE = box(0.05, 2.6, 0.55, 1.2)
TABLE = np.concatenate([box(x, y, 0.06, 0.06) for x in (4.3, 4.9) for y in (2.2, 2.6)])


@pytest.mark.parametrize("degrees", [0, 20, 45, 77])
def test_turned_rooms_with_a_door_are_found(degrees):
    shift = (3.0, -2.0)
    walls = find_walls(grid_of(turn(TWO_ROOMS_M, degrees, shift), turn(POSES_M, degrees, shift)))
    assert len(walls) == len(TWO_ROOMS_M)
    assert min(agreement(walls, turn(TWO_ROOMS_M, degrees, shift), CLOSE_M)) > SHARE
    # The door is 0.9 m wide and stays open.
    assert 0.35 < distance(turn(DOOR_MIDDLE_M, degrees, shift), walls) < 0.5


@pytest.mark.parametrize("degrees", [0, 33])
def test_furniture_is_left_out_and_the_wall_behind_it_goes_on(degrees):
    scene = turn(np.concatenate([TWO_ROOMS_M, WARDROBE, TABLE]), degrees)
    walls = find_walls(grid_of(scene, turn(POSES_M, degrees)))
    assert min(agreement(walls, turn(TWO_ROOMS_M, degrees), CLOSE_M)) > SHARE
    for hidden_or_clutter in ([0.6, 3.2], [4.33, 2.23]):
        assert distance(turn(np.array(hidden_or_clutter), degrees), walls) > 0.4


def test_points_alone_cannot_tell_furniture_from_walls():
    points = np.concatenate(scans(np.concatenate([TWO_ROOMS_M, WARDROBE, TABLE])))
    walls = find_walls(grid_from_points(points))
    found, right = agreement(walls, TWO_ROOMS_M, CLOSE_M)
    assert 0.9 < found < 1  # behind the wardrobe nothing was seen
    assert right > 0.9
    assert distance([0.6, 3.2], walls) < CLOSE_M
    assert distance([4.33, 2.23], walls) > 0.4


def test_walls_are_found_in_spite_of_noise_and_strays():
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
    result = joined(walls)
    assert np.allclose(result[0], [[0, 0], [4, 0]])
    assert np.allclose(result[1], [[0, 0], [0, 3]])
    assert np.allclose(result[2], walls[2])


def test_one_wall_is_found_but_encloses_no_floor():
    wall = np.array([[[0, 0], [5, 0]]], float)
    grid = grid_from_points(scan(wall, np.array([2.0, 1.5])))
    assert agreement(find_walls(grid), wall, CLOSE_M)[1] > SHARE
    with pytest.raises(InputError, match="1 walls found enclose no floor"):
        plan_surfaces(grid, height_m=2.5)


def test_no_straight_wall_is_refused():
    points = np.random.default_rng(0).uniform(0, 20, (40, 2))
    with pytest.raises(InputError, match="no straight wall"):
        find_walls(grid_from_points(points))


# --- scans with poses that are off


def off_poses(walls, poses, seed=5):
    """Scans, each moved by an error of its pose; three of each stop, half a second apart."""
    rng = np.random.default_rng(seed)
    xy, time, clock = [], [], 0.0
    for i, pose in enumerate(poses):
        shift, angle = rng.uniform(-0.4, 0.4, 2), rng.uniform(-8, 8)
        for k in range(3):
            cloud = scan(walls, pose, beams=360, seed=10 * i + k)
            xy.append(pose + turn(cloud - pose, angle, shift) + rng.normal(0, 0.02, 2))
            time.append(np.full(len(cloud), clock + 0.5 * k))
        clock += 20.0
    return np.concatenate(xy), np.concatenate(time)


def test_scans_with_wrong_poses_are_aligned():
    xy, time = off_poses(
        TWO_ROOMS_M, np.array([[1.0, 1.0], [2.5, 3.0], [2.0, 1.5], [4.5, 1.4], [5.0, 3.0], [4.2, 2.5]])
    )
    grid = grid_from_scans(xy, time)
    blurred = grid_from_points(xy)
    assert np.count_nonzero(grid.occupied) < 0.5 * np.count_nonzero(blurred.occupied)
    walls = find_walls(grid)
    # In its own frame, off by the mean error of the poses.
    found, right = agreement(walls, TWO_ROOMS_M, 0.25)
    assert found > 0.95
    assert right > 0.95
    assert grid.free.any()


def test_good_poses_stay():
    clouds = scans(TWO_ROOMS_M)
    time = np.concatenate([np.full(len(c), 30.0 * i) for i, c in enumerate(clouds)])
    walls = walls_of_plan(PlanPoints(np.concatenate(clouds), time))
    assert min(agreement(walls, TWO_ROOMS_M, CLOSE_M)) > 0.95


def test_sensor_is_found_from_what_it_saw():
    scene = np.concatenate([TWO_ROOMS_M, WARDROBE, TABLE])
    errors = [np.linalg.norm(sensor_of(scan(scene, pose)) - pose) for pose in POSES_M]
    assert max(errors) < 0.15
    crowd = np.random.default_rng(0).uniform(0, 5, (2000, 2))
    assert sensor_of(crowd) is None


# --- floors and surfaces


def test_layout_is_extruded_as_it_is(tmp_path):
    doubled = np.array([[0, 0], [4, 0], [4, 3], [2, 3], [2, 1], [2, 3], [0, 3], [0, 0]], float)
    file = tmp_path / "layout.csv"
    file.write_text("x,y\n" + "\n".join(f"{x},{y}" for x, y in doubled) + "\n")
    surfaces = plan_surfaces(read_layout(file), height_m=2.5, floor_m=0.2)
    kinds = [s.kind for s in surfaces]
    assert kinds[:2] == ["floor", "ceiling"]
    assert sum(s.mesh.area for s in surfaces if s.kind == "wall") == pytest.approx(2.5 * (4 + 3 + 4 + 3 + 2))
    assert surfaces[0].mesh.area == pytest.approx(12)
    assert surfaces[1].mesh.area == pytest.approx(12)
    assert set(np.unique(surfaces[0].vertices_m[:, 2])) == {0.2}
    assert set(np.unique(surfaces[1].vertices_m[:, 2])) == {2.7}
    assert len({s.name for s in surfaces}) == len(surfaces)
    for wall in surfaces[2:]:
        assert wall.vertices_m[:, 2].min() == 0.2
        assert wall.vertices_m[:, 2].max() == 2.7
        assert np.linalg.matrix_rank(wall.vertices_m - wall.vertices_m[0], tol=1e-9) == 2


def test_floor_of_rooms_with_a_door_is_their_outline():
    assert floor_of(TWO_ROOMS_M).area == pytest.approx(24, rel=0.01)
    assert floor_of(layout_walls(L_ROOM_M)).area == pytest.approx(16.25)
    # With a gap in the outer wall too, as where a door stood open.
    open_walls = np.concatenate([TWO_ROOMS_M[1:], [[[0, 0], [1, 0]], [[2, 0], [6, 0]]]])
    assert floor_of(open_walls).area == pytest.approx(24, rel=0.02)


@pytest.mark.parametrize("height", [0.0, -1.0, np.nan, np.inf])
def test_height_has_to_be_positive(height):
    with pytest.raises(InputError, match="height above zero"):
        plan_surfaces(L_ROOM_M, height_m=height)


# --- what the sources refuse


def test_grids_without_walls_are_refused():
    for values, line in (
        (np.full((20, 20), np.nan), "every cell is NaN"),
        (np.zeros((20, 20)), "no cell is occupied"),
        (np.zeros((0, 5)), "two axes"),
        (np.zeros(5), "two axes"),
    ):
        with pytest.raises(InputError, match=line):
            grid_from_probability(values, 0.05, "top")
    with pytest.raises(InputError, match="resolution is 0"):
        grid_from_probability(np.ones((3, 3)), 0, "top")


def test_points_that_make_no_grid_are_refused():
    for points, line in (
        (np.zeros((0, 2)), r"n > 0"),
        (np.array([[0, np.nan]]), "point 0 is not finite"),
        (np.array([[0, 0], [9000.0, 9000.0]]), "are the units metres"),
    ):
        with pytest.raises(InputError, match=line):
            grid_from_points(points)
