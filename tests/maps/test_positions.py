"""Positions of maps: grids, and the faces of meshes."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from wrf_mi.apps.maps.grid import grid_over, reachable, surface_of
from wrf_mi.core import InputError
from wrf_mi.scene.coordinates import Y_UP
from wrf_mi.scene.make import make_scene
from wrf_mi.tracing import open_scene

ROUNDING_M = 1e-6
"""Rounding of coordinates of at most a hundred metres in float64, with room to spare."""
FLOAT32_M = 1e-5
"""Of coordinates in the float32 of a file."""


@given(st.floats(-50, 50), st.floats(0.05, 20), st.floats(0.1, 3))
def test_centres_lie_in_the_rectangle_and_leave_at_most_half_a_cell(low: float, size: float, step: float) -> None:
    grid = grid_over(np.array([low, -low]), np.array([low + size, -low + 2 * size]), step, 1.3)
    for axis, first, last in ((grid.x_m, low, low + size), (grid.y_m, -low, -low + 2 * size)):
        assert first < axis[0]
        assert axis[-1] < last
        if len(axis) > 1 or last - first > step / 2 + ROUNDING_M:
            assert abs(axis[0] - step / 2 - first) < ROUNDING_M
            assert axis[-1] + step / 2 > last - step / 2 - ROUNDING_M
        else:
            assert abs(axis[0] - (first + last) / 2) < ROUNDING_M
    assert grid.positions_m.shape == (len(grid.x_m) * len(grid.y_m), 3)
    np.testing.assert_array_equal(grid.positions_m[: len(grid.x_m), 0], grid.x_m)


@pytest.mark.parametrize(
    ("size", "step", "count"), [(6.0, 0.1, 60), (2.71, 0.1, 27), (2.76, 0.1, 28), (0.35, 0.1, 3), (0.3, 1.0, 1)]
)
def test_extents_are_rounded_to_the_step_half_down(size: float, step: float, count: int) -> None:
    """0.35 m is 3.5 steps: the centre of a fourth cell would lie on the wall."""
    for start in (0.0, -13.7):
        grid = grid_over(np.array([start, start]), np.array([start + size, start + size]), step, 0.0)
        assert (len(grid.x_m), len(grid.y_m)) == (count, count)


@pytest.mark.parametrize(
    ("size_m", "step", "message"),
    [(1.0, step, "positive") for step in (0.0, -1.0, float("nan"), float("inf"))] + [(1e4, 1e-3, "larger step")],
)
def test_bad_steps_of_a_grid_are_refused(size_m: float, step: float, message: str) -> None:
    with pytest.raises(InputError, match=message):
        grid_over(np.zeros(2), np.full(2, size_m), step, 0.0)


@pytest.mark.parametrize("suffix", ["ply", "stl", "obj", "glb"])
def test_positions_are_the_centres_of_the_faces(suffix: str, tmp_path: Path) -> None:
    mesh = trimesh.creation.box((2.0, 1.0, 0.5))
    mesh.copy().apply_transform(Y_UP if suffix == "glb" else np.eye(4)).export(tmp_path / f"box.{suffix}")
    surface = surface_of(tmp_path / f"box.{suffix}")
    expected = mesh.triangles_center[np.lexsort(mesh.triangles_center.round(4).T)]
    positions = surface.positions_m[np.lexsort(surface.positions_m.round(4).T)]
    np.testing.assert_allclose(positions, expected, atol=FLOAT32_M)


def test_faces_are_halved_to_a_step_and_cover_the_same_area(tmp_path: Path) -> None:
    mesh = trimesh.creation.box((2.0, 1.0, 0.5))
    mesh.export(tmp_path / "box.ply")
    triangles = surface_of(tmp_path / "box.ply", 0.3).triangles_m
    assert np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=-1).max() <= 0.3 + FLOAT32_M
    assert trimesh.triangles.area(triangles).sum() == pytest.approx(mesh.area, rel=FLOAT32_M)


@pytest.mark.parametrize(
    ("file", "step", "message"),
    [
        ("none.ply", None, "no such file"),
        ("empty.ply", None, "cannot be read as a mesh"),
        ("box.ply", 0.0, "positive"),
        ("box.ply", 1e-5, "larger step"),
    ],
)
def test_bad_meshes_and_steps_are_refused(file: str, step: float | None, message: str, tmp_path: Path) -> None:
    trimesh.creation.box((2.0, 1.0, 0.5)).export(tmp_path / "box.ply")
    (tmp_path / "empty.ply").write_text("nothing")
    with pytest.raises(InputError, match=message):
        surface_of(tmp_path / file, step)


@pytest.mark.parametrize("door_m", [0.0, 0.9])
def test_positions_behind_a_wall_without_a_door_are_not_reached(door_m: float, tmp_path: Path) -> None:
    """Two rooms of 4 m x 3 m; the corners double back along the wall between them."""
    corners = [(4, 0), (4, 1), (4, 0), (0, 0), (0, 3), (4, 3), (4, 1 + door_m), (4, 3), (8, 3), (8, 0), (4, 0)]
    np.savetxt(tmp_path / "layout.csv", corners, delimiter=",", header="x,y", comments="")
    scene = open_scene(make_scene(tmp_path / "layout.csv", tmp_path / "rooms", height_m=2.5).folder, 2.4e9)
    x, y = np.meshgrid(np.arange(0.25, 8, 0.5), np.arange(0.6, 2.8, 0.5))
    places = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 1.3)])
    starts = np.array([[1.0, 1.0, 0.8], [np.nan, 1.0, 0.8]])
    reached = reachable(scene, places, starts)
    np.testing.assert_array_equal(reached, (places[:, 0] < 4) | (door_m > 0))
    assert reachable(None, places, starts).all()
