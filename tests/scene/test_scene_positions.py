"""Measured positions tell a plan from its mirror image."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import shapely
import trimesh
from calling import call
from changed_folders import DATA, needs
from made_plans import TWO_ROOMS_M, grid_of

from wrf_mi.core import InputError
from wrf_mi.scene.make import make_scene
from wrf_mi.scene.mesh.surfaces import Surface
from wrf_mi.scene.plan.sources import read_layout
from wrf_mi.scene.positions import conflicts, read_positions

OFFICE_M = np.array([[0, 0], [9, 0], [9, 3], [5, 3], [5, 7], [0, 7], [0, 0]], float)
"""An office whose wings have different widths; with `PARTITIONS_M`."""
PARTITIONS_M = (np.array([[0, 3], [1, 3]]), np.array([[2, 3], [5, 3]]), np.array([[6.5, 0], [6.5, 1.5]]))
ROUTE_M = np.array(
    [[0.7, 0.6], [1.5, 1.5], [1.5, 5], [4, 6], [1.5, 5], [1.5, 1.5], [5, 2.2], [8, 2.2], [8, 0.8]], float
)


def walk(corners_m: np.ndarray, step_m: float = 0.2) -> np.ndarray:
    line = shapely.linestrings(corners_m)
    return shapely.get_coordinates(shapely.line_interpolate_point(line, np.arange(0, line.length, step_m)))


def office() -> np.ndarray:
    sides = np.stack([OFFICE_M[:-1], OFFICE_M[1:]], axis=1)
    return np.concatenate([sides, np.stack(PARTITIONS_M)])


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
def test_a_map_with_the_wrong_row_0_is_refused(
    moved: tuple[float, float], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Another building than the flat, wherever its origin is; the true map passes."""
    walls, places = office() + moved, walk(ROUTE_M) + moved
    positions = write_positions(tmp_path / "places.csv", places)
    made = ["--height", "2.5", "--positions", positions]
    true = write_grid(tmp_path / "map.npz", "top", walls, places[::8])
    status, _, err = call(["mesh", true, *made, "--out", tmp_path / "true"], capsys)
    assert status == 0, err
    wrong = write_grid(tmp_path / "wrong.npz", "bottom", walls, places[::8])
    status, out, err = call(["mesh", wrong, *made, "--out", tmp_path / "scene"], capsys)
    assert (status, out, err.count("\n")) == (2, "", 1), err
    assert "cross walls" in err
    assert "mirrored it is 0 and 0: give the other row_0" in err
    assert not (tmp_path / "scene").exists()


@pytest.mark.parametrize(
    ("axis", "about", "remedy"),
    [(1, 0.0, "change the sign of its y"), (1, 3.5, "replace its y by 7 - y"), (0, 4.5, "replace its x by 9 - x")],
)
def test_a_mirrored_layout_is_refused(axis: int, about: float, remedy: str, tmp_path: Path) -> None:
    outline = np.array(OFFICE_M)
    positions = write_positions(tmp_path / "places.csv", walk(ROUTE_M[3:]))
    layout = write_positions(tmp_path / "layout.csv", outline)
    make_scene(layout, tmp_path / "scene", height_m=2.5, positions=positions)
    outline[:, axis] = 2 * about - outline[:, axis]
    write_positions(layout, outline)
    with pytest.raises(InputError, match=rf"mirrored it is 0 and 0: {remedy}$"):
        make_scene(layout, tmp_path / "mirrored", height_m=2.5, positions=positions)


def test_positions_in_another_frame_are_refused(tmp_path: Path) -> None:
    layout = write_positions(tmp_path / "layout.csv", OFFICE_M)
    positions = write_positions(tmp_path / "places.csv", walk(ROUTE_M) + 50.0)
    with pytest.raises(InputError, match="check the registration and the frame of the positions"):
        make_scene(layout, tmp_path / "scene", height_m=2.5, positions=positions)


def test_a_door_lets_pass_at_its_height_and_the_wall_above_it_does_not() -> None:
    """A wall of three dimensions across a walk, open below 2 m between y = 1 and y = 2."""
    parts = [trimesh.creation.box(bounds=[[3, *low], [3.1, *high]]) for low, high in DOOR_PARTS]
    mesh = trimesh.util.concatenate(parts)
    wall = Surface("wall", "wall", np.asarray(mesh.vertices), np.asarray(mesh.faces))
    x = np.arange(0.2, 6, 0.25)
    for y, z, expected in ((1.5, np.nan, 0), (1.5, 1.2, 0), (1.5, 2.2, 1), (3.0, np.nan, 1)):
        places = np.column_stack([x, np.full(len(x), y), np.full(len(x), z)])
        assert conflicts(places, [wall])[0] == expected
    with pytest.raises(InputError, match="no wall"):
        conflicts(places, [])


DOOR_PARTS = [((0, 0), (1, 2.5)), ((2, 0), (4, 2.5)), ((1, 2), (2, 2.5))]


def test_positions_from_a_file(tmp_path: Path) -> None:
    file = write_positions(tmp_path / "a.csv", np.array([[1.0, 7.0, 2.0, 3.0]]), " X ,rssi,y,z")
    np.testing.assert_array_equal(read_positions(file), [[1, 2, 3]])
    file.write_text(",x,heading,y\n0,1,9,2\n")
    np.testing.assert_array_equal(read_positions(file), [[1, 2, np.nan]])
    for text, line in (("a,y\n1,2\n", "no column x"), ("x,y\n1,2\n1,\n", "row 2: y is ''"), ("x,y\n", "no rows")):
        file.write_text(text)
        with pytest.raises(InputError, match=line):
            read_positions(file)
    with pytest.raises(InputError, match=r"none.csv: no such file; give measured positions"):
        read_positions(tmp_path / "none.csv")


@needs("flat-ble")
def test_the_mirrored_flat_is_refused(tmp_path: Path) -> None:
    flat = DATA / "flat-ble"
    vertices = read_layout(flat / "layout.csv")
    for name in ("calibration_df.csv", "test_robot_df.csv"):
        make_scene(flat / "layout.csv", tmp_path / name, height_m=2.7, positions=flat / name)
        for sign in ([1, -1], [-1, 1]):
            mirrored = write_positions(tmp_path / "mirrored.csv", vertices * sign)
            with pytest.raises(InputError, match=r"cross walls .* change the sign of its [xy]"):
                make_scene(mirrored, tmp_path / "scene", height_m=2.7, positions=flat / name)


def test_positions_pass_through_the_door_between_two_rooms_and_not_through_walls(tmp_path: Path) -> None:
    """Positions in any order, as many as fill both rooms."""
    rng = np.random.default_rng(3)
    xy = rng.uniform([0.3, 0.3], [5.7, 3.7], (500, 2))
    xy = xy[np.abs(xy[:, 0] - 3.5) > 0.3]
    grid = write_grid(tmp_path / "map.npz", "top", TWO_ROOMS_M, np.array([[1.0, 1.0], [2.5, 3.0], [4.5, 1.4]]))
    positions = write_positions(tmp_path / "places.csv", xy)
    made = make_scene(grid, tmp_path / "scene", height_m=2.5, positions=positions)
    assert made.counts["surfaces"] == len(TWO_ROOMS_M) + 2  # floor and ceiling
    shifted = write_positions(tmp_path / "shifted.csv", xy + np.array([0.0, 1.5]))
    with pytest.raises(InputError, match="cross walls"):
        make_scene(grid, tmp_path / "refused", height_m=2.5, positions=shifted)
