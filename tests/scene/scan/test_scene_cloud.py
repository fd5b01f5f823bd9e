"""Rooms of known planes from noisy points."""

from __future__ import annotations

import importlib

import numpy as np
import pytest
import trimesh
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from made_rooms import attic, by_kind, closed_box, l_shape, sampled, two_rooms
from wrf_mi_scenes.build_laboratory import box, sheet

from wrf_mi.core import InputError
from wrf_mi.scene import coordinates
from wrf_mi.scene.mesh.surfaces import Surface
from wrf_mi.scene.scan.cloud import surfaces_from_points

PLANE_M = 0.003
"""Offset of a plane: noise of 1 cm over the root of some thousand points is 0.2 mm; the rest is their choice."""
CELL_M = 0.12
"""A free edge: one cell of the raster that finds it, which at some 1000 points per square metre holds 8 to 15."""
EDGE_M = 0.05
"""The same, on average over several edges."""
AREA_SHARE = 0.01
"""Area of a wall whose edges are its neighbours: these are known to `PLANE_M`."""
COUNT = 40_000


def rooms(surfaces: list[Surface]) -> tuple[int, int, int, int]:
    return tuple(len(group) for group in by_kind(surfaces).values())


def bounds(surface: Surface) -> np.ndarray:
    return np.concatenate([surface.vertices_m.min(axis=0), surface.vertices_m.max(axis=0)])


@pytest.mark.parametrize(
    ("noise_m", "count"), [(0.0005, COUNT), (0.002, COUNT), (0.01, COUNT), (0.02, COUNT), (0.01, 12_000)]
)
def test_a_box_is_six_rectangles_with_closed_corners(noise_m: float, count: int) -> None:
    surfaces = surfaces_from_points(sampled(closed_box(), count, noise_m))
    assert rooms(surfaces) == (1, 1, 4, 0)
    expected = trimesh.util.concatenate(closed_box()).vertices
    for surface in surfaces:
        assert surface.faces.shape == (2, 3)
        for vertex in surface.vertices_m:
            assert np.linalg.norm(expected - vertex, axis=1).min() < 2 * PLANE_M, surface.name
    # Right angles to rounding, since the box has them and the noise cannot tell otherwise.
    normals = [np.linalg.svd(s.vertices_m - s.vertices_m.mean(axis=0))[2][2] for s in surfaces]
    assert np.abs(np.abs(np.stack(normals)) - np.abs(np.stack(normals)).round()).max() < 0.005


def test_an_l_shape_keeps_its_missing_quarter() -> None:
    surfaces = by_kind(surfaces_from_points(sampled(l_shape(), COUNT)))
    assert [len(group) for group in surfaces.values()] == [1, 1, 6, 0]
    for flat in (*surfaces["floor"], *surfaces["ceiling"]):
        assert flat.mesh.area == pytest.approx(22.5, rel=AREA_SHARE)
    areas = sorted(wall.mesh.area for wall in surfaces["wall"])
    np.testing.assert_allclose(areas, 2.7 * np.array([2.5, 2.5, 3, 3, 5, 6]), rtol=AREA_SHARE)


def test_a_sloping_ceiling_keeps_its_slope() -> None:
    surfaces = by_kind(surfaces_from_points(sampled(attic(), COUNT)))
    assert [len(group) for group in surfaces.values()] == [1, 1, 4, 0]
    (ceiling,) = surfaces["ceiling"]
    np.testing.assert_allclose(bounds(ceiling), [0, 0, 2.2, 5, 4, 3.4], atol=2 * PLANE_M)
    gables = [wall for wall in surfaces["wall"] if np.ptp(wall.vertices_m[:, 1]) > 3]
    for gable in gables:
        assert gable.mesh.area == pytest.approx(4 * 2.8, rel=AREA_SHARE)


def test_both_sides_of_a_partition_and_the_doorway_through_it() -> None:
    surfaces = by_kind(surfaces_from_points(sampled(two_rooms(), 2 * COUNT)))
    assert [len(group) for group in surfaces.values()] == [1, 1, 6, 0]
    sides = sorted((wall for wall in surfaces["wall"] if wall.mesh.area < 9), key=lambda wall: wall.vertices_m[0, 0])
    assert len(sides) == 2
    for wall, x in zip(sides, (4.0, 4.12), strict=True):
        assert np.abs(wall.vertices_m[:, 0] - x).max() < PLANE_M
        # The doorway's free edges: 5.1 m long.
        assert abs(wall.mesh.area - (4 * 2.6 - 0.9 * 2.1)) < 5.1 * EDGE_M
        flat = trimesh.Trimesh(wall.vertices_m, wall.faces, process=False)
        inside = flat.triangles[..., 1:].mean(axis=1)
        assert not ((inside[:, 0] > 1.6) & (inside[:, 0] < 2.3) & (inside[:, 1] < 2.0)).any()


def test_a_column_is_walls_and_a_table_is_not() -> None:
    parts = [*closed_box(), box((2.0, 1.5, 0.0), (2.4, 1.9, 2.8)), sheet(2, 0.74, (3.0, 4.4), (2.0, 2.8))]
    surfaces = by_kind(surfaces_from_points(sampled(parts, 2 * COUNT)))
    assert [len(group) for group in surfaces.values()] == [1, 1, 8, 1]
    (table,) = surfaces["other"]
    np.testing.assert_allclose(bounds(table), [3, 2, 0.74, 4.4, 2.8, 0.74], atol=CELL_M)


def test_a_real_slope_is_not_made_square() -> None:
    """A wall turned by 2 degrees is 14 cm off over 4 m; the points tell, so it stays."""
    lean = np.radians(2.0)
    points = sampled(closed_box(), COUNT)
    points[:, 0] += np.where(points[:, 0] > 4.8, points[:, 1] * np.tan(lean), 0.0)
    surfaces = surfaces_from_points(points)
    wall = max(by_kind(surfaces)["wall"], key=lambda one: one.vertices_m[:, 0].mean())
    run = np.ptp(wall.vertices_m[:, 0]) / np.ptp(wall.vertices_m[:, 1])
    assert np.degrees(np.arctan(run)) == pytest.approx(2.0, abs=0.1)


def test_the_shadow_of_a_cupboard_is_filled_and_a_window_is_not() -> None:
    room = closed_box()
    cupboard = box((1.0, 0.3, 0.0), (2.0, 0.7, 1.9))
    points = sampled([*room, cupboard], 2 * COUNT)
    on_wall = np.abs(points[:, 1]) < 0.1
    behind = on_wall & (np.abs(points[:, 0] - 1.5) < 0.5) & (points[:, 2] < 1.9)
    window = on_wall & (np.abs(points[:, 0] - 3.7) < 0.6) & (np.abs(points[:, 2] - 1.5) < 0.5)
    surfaces = surfaces_from_points(points[~behind & ~window])
    wall = min(by_kind(surfaces)["wall"], key=lambda one: np.abs(one.vertices_m[:, 1]).max())
    # The window's free edges: 4.4 m long.
    assert abs(wall.mesh.area - (5 * 2.8 - 1.2 * 1.0)) < 4.4 * EDGE_M


@settings(max_examples=3, deadline=None, derandomize=True, phases=[Phase.explicit, Phase.generate])
@given(
    yaw_deg=st.floats(-180, 180),
    shift=st.tuples(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6), st.floats(-100, 1000)),
)
def test_a_turned_and_moved_room_gives_turned_and_moved_surfaces(
    yaw_deg: float, shift: tuple[float, float, float]
) -> None:
    """National grids have coordinates of a million metres."""
    turn = trimesh.transformations.rotation_matrix(np.radians(yaw_deg), (0, 0, 1))[:3, :3]
    surfaces = surfaces_from_points(sampled(closed_box(), 20_000) @ turn.T + shift)
    assert rooms(surfaces) == (1, 1, 4, 0)
    back = np.concatenate([(s.vertices_m - shift) @ turn for s in surfaces])
    corners = trimesh.util.concatenate(closed_box()).vertices
    assert np.linalg.norm(back[:, None] - corners, axis=-1).min(axis=1).max() < 3 * PLANE_M


def test_clouds_without_planes_are_refused() -> None:
    rng = np.random.default_rng(1)
    with pytest.raises(InputError, match="no plane was found"):
        surfaces_from_points(rng.uniform(0, 5, (5000, 3)))
    with pytest.raises(InputError, match="give a denser"):
        surfaces_from_points(rng.uniform(0, 5, (12, 3)))


def test_missing_open3d_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise ModuleNotFoundError(f"No module named {name!r}")

    assert coordinates.import_module is importlib.import_module
    monkeypatch.setattr(coordinates, "import_module", missing)
    with pytest.raises(InputError, match=r"need open3d: pip install 'wrf-mi\[lidar\]'"):
        surfaces_from_points(np.zeros((100, 3)))
