"""Rooms of known planes from noisy points, with layers before walls, and from scans of one place."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from made_rooms import Mesh, attic, by_kind, closed_box, joined, l_shape, sampled, scene_file, two_rooms
from wrf_mi_scenes.build_laboratory import box, sheet, wall

from wrf_mi.core import InputError
from wrf_mi.scene.mesh.planes import Plane, with_axes
from wrf_mi.scene.mesh.surfaces import Surface
from wrf_mi.scene.scan.cloud import surfaces_from_points
from wrf_mi.scene.scan.sight import BEFORE, BEYOND, LEAST_SEEN, ON, UNSEEN, Sight, sights_of
from wrf_mi.scene.scan.simulated import simulate_scan

PLANE_M = 0.003
"""Offset of a plane: noise of 1 cm over the root of some thousand points is 0.2 mm; the rest is their choice."""
CELL_M = 0.12
"""A free edge: one cell of the raster that finds it, which at some 1000 points per square metre holds 8 to 15."""
EDGE_M = 0.05
"""The same, on average over several edges."""
AREA_SHARE = 0.01
"""Area of a wall whose edges are its neighbours: these are known to `PLANE_M`."""
COUNT = 40_000


def rooms(surfaces: list[Surface]) -> tuple[int, ...]:
    return tuple(len(group) for group in by_kind(surfaces).values())


def bounds(surface: Surface) -> np.ndarray:
    return np.concatenate([surface.vertices_m.min(axis=0), surface.vertices_m.max(axis=0)])


@pytest.mark.parametrize(
    ("noise_m", "count", "seed"),
    [
        *((noise_m, COUNT, 1) for noise_m in (0.0005, 0.002, 0.01, 0.02)),
        (0.02, COUNT, 2),
        (0.02, COUNT, 3),
        (0.01, 12_000, 1),
    ],
)
def test_a_box_is_six_rectangles_with_closed_corners(noise_m, count, seed):
    """And its walls have no layers."""
    surfaces = surfaces_from_points(sampled(closed_box(), count, noise_m, seed=seed))
    assert rooms(surfaces) == (1, 1, 4, 0)
    expected = joined(closed_box()).vertices
    for surface in surfaces:
        assert surface.faces.shape == (2, 3)
        for vertex in surface.vertices_m:
            assert np.linalg.norm(expected - vertex, axis=1).min() < 2 * PLANE_M, surface.name
    # Right angles to rounding, since the box has them and the noise cannot tell otherwise.
    normals = np.abs([np.linalg.svd(s.vertices_m - s.vertices_m.mean(axis=0))[2][2] for s in surfaces])
    assert np.abs(normals - normals.round()).max() < 0.005


def test_planes_of_points_without_noise_at_round_coordinates_are_found():
    faces = [
        np.insert(np.random.default_rng(0).random((8000, 2)), axis, side, 1) for axis in range(3) for side in (0, 1)
    ]
    assert rooms(surfaces_from_points(np.concatenate(faces) * [5, 4, 2.7])) == (1, 1, 4, 0)


def test_an_l_shape_a_sloping_ceiling_and_a_real_slope_are_kept():
    surfaces = by_kind(surfaces_from_points(sampled(l_shape(), COUNT)))
    assert [len(group) for group in surfaces.values()] == [1, 1, 6, 0]
    areas = [flat.mesh.area for flat in (*surfaces["floor"], *surfaces["ceiling"])]
    areas += sorted(wall.mesh.area for wall in surfaces["wall"])
    assert areas == pytest.approx([22.5, 22.5, *(2.7 * side for side in (2.5, 2.5, 3, 3, 5, 6))], rel=AREA_SHARE)
    surfaces = by_kind(surfaces_from_points(sampled(attic(), COUNT)))
    assert [len(group) for group in surfaces.values()] == [1, 1, 4, 0]
    (ceiling,) = surfaces["ceiling"]
    np.testing.assert_allclose(bounds(ceiling), [0, 0, 2.2, 5, 4, 3.4], atol=2 * PLANE_M)
    gables = [wall.mesh.area for wall in surfaces["wall"] if np.ptp(wall.vertices_m[:, 1]) > 3]
    assert gables == pytest.approx([4 * 2.8] * 2, rel=AREA_SHARE)
    points = sampled(closed_box(), COUNT)
    # A wall turned by 2 degrees is 14 cm off over 4 m; the points tell, so it stays.
    points[:, 0] += np.where(points[:, 0] > 4.8, points[:, 1] * np.tan(np.radians(2.0)), 0.0)
    wall = max(by_kind(surfaces_from_points(points))["wall"], key=lambda surface: surface.vertices_m[:, 0].mean())
    run = np.ptp(wall.vertices_m[:, 0]) / np.ptp(wall.vertices_m[:, 1])
    assert np.degrees(np.arctan(run)) == pytest.approx(2.0, abs=0.1)


def test_both_sides_of_a_partition_and_the_doorway_through_it():
    surfaces = by_kind(surfaces_from_points(sampled(two_rooms(), 2 * COUNT)))
    assert [len(group) for group in surfaces.values()] == [1, 1, 6, 0]
    sides = sorted((s for s in surfaces["wall"] if s.mesh.area < 9), key=lambda s: s.vertices_m[0, 0])
    assert len(sides) == 2
    for side, x in zip(sides, (4.0, 4.12), strict=True):
        assert np.abs(side.vertices_m[:, 0] - x).max() < PLANE_M
        # The doorway's free edges: 5.1 m long.
        assert abs(side.mesh.area - (4 * 2.6 - 0.9 * 2.1)) < 5.1 * EDGE_M
        flat = trimesh.Trimesh(side.vertices_m, side.faces, process=False)
        inside = flat.triangles[..., 1:].mean(axis=1)
        assert not ((inside[:, 0] > 1.6) & (inside[:, 0] < 2.3) & (inside[:, 1] < 2.0)).any()


def test_a_column_is_walls_and_a_table_is_not():
    parts = [*closed_box(), box((2.0, 1.5, 0.0), (2.4, 1.9, 2.8)), sheet(2, 0.74, (3.0, 4.4), (2.0, 2.8))]
    surfaces = by_kind(surfaces_from_points(sampled(parts, 2 * COUNT)))
    assert [len(group) for group in surfaces.values()] == [1, 1, 8, 1]
    (table,) = surfaces["other"]
    np.testing.assert_allclose(bounds(table), [3, 2, 0.74, 4.4, 2.8, 0.74], atol=CELL_M)


def test_the_shadow_of_a_cupboard_is_filled_and_a_window_is_not():
    room = closed_box()
    cupboard = box((1.0, 0.3, 0.0), (2.0, 0.7, 1.9))
    points = sampled([*room, cupboard], 2 * COUNT)
    on_wall = np.abs(points[:, 1]) < 0.1
    behind = on_wall & (np.abs(points[:, 0] - 1.5) < 0.5) & (points[:, 2] < 1.9)
    window = on_wall & (np.abs(points[:, 0] - 3.7) < 0.6) & (np.abs(points[:, 2] - 1.5) < 0.5)
    surfaces = surfaces_from_points(points[~behind & ~window])
    wall = min(by_kind(surfaces)["wall"], key=lambda surface: np.abs(surface.vertices_m[:, 1]).max())
    # The window's free edges: 4.4 m long.
    assert abs(wall.mesh.area - (5 * 2.8 - 1.2 * 1.0)) < 4.4 * EDGE_M


@settings(max_examples=3, deadline=None, derandomize=True, phases=[Phase.explicit, Phase.generate])
@given(yaw_deg=st.floats(-180, 180), shift=st.tuples(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6), st.floats(-100, 1000)))
def test_a_turned_and_moved_room_gives_turned_and_moved_surfaces(yaw_deg, shift):
    """National grids have coordinates of a million metres."""
    turn = trimesh.transformations.rotation_matrix(np.radians(yaw_deg), (0, 0, 1))[:3, :3]
    surfaces = surfaces_from_points(sampled(closed_box(), 20_000) @ turn.T + shift)
    assert rooms(surfaces) == (1, 1, 4, 0)
    back = np.concatenate([(s.vertices_m - shift) @ turn for s in surfaces])
    corners = joined(closed_box()).vertices
    assert np.linalg.norm(back[:, None] - corners, axis=-1).min(axis=1).max() < 3 * PLANE_M


def test_clouds_without_planes_are_refused():
    rng = np.random.default_rng(1)
    for count, message in ((5000, "no plane was found"), (12, "give a denser")):
        with pytest.raises(InputError, match=message):
            surfaces_from_points(rng.uniform(0, 5, (count, 3)))


NOISE_M = 0.015
LAYER_COUNT = 105_000
LAYER_M = 0.003
"""Offset of a layer: some thousand points have an error of a third of a millimetre; its rim has others' points."""
RIM_M = 0.2
"""Edges of a layer are those of cells: 1,000 points per square metre have cells of 15 cm."""
BOARD, SHEET, NICHE = (((0.6, 1.8), (0.9, 2.1)), ((2.4, 4.2), (0.2, 2.0)), ((4.8, 5.8), (0.9, 2.1)))
"""Stretches along and up the wall."""


def room() -> list[Mesh]:
    """A room of 1.5 x 7 x 2.8 m; before its wall at x = 0 a board and a sheet, which hide it, and a niche in it."""
    y, up = (0.0, 7.0), (0.0, 2.8)
    flat = [sheet(2, z, (0.0, 1.5), y) for z in up] + [sheet(1, at, (0.0, 1.5), up) for at in y]
    layers = [sheet(0, x, *place) for x, place in ((0.02, BOARD), (0.05, SHEET), (-0.06, NICHE))]
    return [*flat, sheet(0, 1.5, y, up), wall(0, 0.0, y, up, [BOARD, SHEET, NICHE]), *layers]


def across(surfaces: list[Surface]) -> dict[float, Surface]:
    """Surfaces near the wall and parallel to it, by their mean x."""
    flat = [
        surface
        for surface in surfaces
        if np.ptp(surface.vertices_m[:, 0]) < 1e-3 and abs(surface.vertices_m[:, 0].mean()) < 0.2
    ]
    return {float(surface.vertices_m[:, 0].mean()): surface for surface in flat}


def test_layers_of_a_wall_are_surfaces_of_their_own():
    """The wall goes on behind what hides it, and ends at the niche."""
    layers = across(surfaces_from_points(sampled(room(), LAYER_COUNT, NOISE_M)))
    assert len(layers) == 4
    for expected, (along, above) in ((0.02, BOARD), (0.05, SHEET), (-0.06, NICHE)):
        at = min(layers, key=lambda x: abs(x - expected))
        assert at == pytest.approx(expected, abs=LAYER_M)
        bounds = np.array([layers[at].vertices_m.min(axis=0)[1:], layers[at].vertices_m.max(axis=0)[1:]])
        np.testing.assert_allclose(bounds, np.array([along, above]).T, atol=RIM_M)
    at = min(layers, key=abs)
    assert at == pytest.approx(0, abs=LAYER_M)
    niche = np.prod(np.diff(NICHE, axis=1))
    assert layers[at].mesh.area == pytest.approx(7 * 2.8 - niche, rel=0.03)


PLACE = np.array([1.3, 1.7, 1.35])
BLIND_RAD = np.radians(40.0)  # from straight down: a disc of 1.1 m radius on the floor
SEEN_SHARE = 0.03  # edges of a floor that is hidden or sparse there are known to a cell of 10 cm
DOOR_EDGE_M = 0.06  # free edges of a door, which half the distance between beams bounds


def scanned(parts: list[Mesh], folder: Path, rays: int) -> np.ndarray:
    """A scan from one place that is blind below it, in the frame of its scanner."""
    points = simulate_scan(scene_file(folder, parts), [PLACE], rays_per_pose=rays) - PLACE
    below = np.arccos(np.clip(-points[:, 2] / np.linalg.norm(points, axis=1), -1, 1))
    return points[below > BLIND_RAD]


def placed(points: np.ndarray) -> list[Surface]:
    """Surfaces of a scan whose scanner is stated at the origin."""
    return surfaces_from_points(points, np.zeros((1, 3)), np.zeros(len(points), int))


def in_room(surfaces: list[Surface]) -> dict[str, list[np.ndarray]]:
    """Lowest and highest corners of the surfaces of each kind, in the frame of the room."""
    kinds = by_kind(surfaces)
    return {k: [np.stack([s.vertices_m.min(0), s.vertices_m.max(0)]) + PLACE for s in of] for k, of in kinds.items()}


@pytest.fixture(scope="module")
def through_door(tmp_path_factory):
    """A scan of two rooms from one of them, with a thing in it."""
    return scanned([*two_rooms(), box((2.4, 0.6, 0.0), (2.9, 1.1, 0.9))], tmp_path_factory.mktemp("door"), 60_000)


@pytest.mark.parametrize("surfaces_of", [placed, surfaces_from_points])
def test_a_scan_through_a_door_is_the_room_of_its_scanner(surfaces_of, through_door):
    """The floor has no hole below the scanner, and none behind a thing; the next room is not there."""
    surfaces = surfaces_of(through_door)
    boxes = in_room(surfaces)
    areas = [surface.mesh.area for kind in ("floor", "ceiling") for surface in by_kind(surfaces)[kind]]
    assert areas == pytest.approx([16.0, 16.0], rel=SEEN_SHARE)
    assert len(boxes["wall"]) == 4
    for low, high in (ends for of in boxes.values() for ends in of):
        assert low[0] > -0.1
        assert high[0] < 4.1
    partition = max(by_kind(surfaces)["wall"], key=lambda wall: wall.vertices_m[:, 0].mean())
    assert partition.mesh.area == pytest.approx(4 * 2.6 - 0.9 * 2.1, abs=5.1 * DOOR_EDGE_M)


def test_a_far_wall_of_few_points_is_a_wall(tmp_path):
    """Its points are as far apart as strays; floor and ceiling reach it, and cover all between."""
    surfaces = placed(scanned(closed_box(12.0, 4.0, 2.8), tmp_path, 20_000))
    boxes = in_room(surfaces)
    assert [len(boxes[kind]) for kind in ("floor", "ceiling", "wall")] == [1, 1, 4]
    far = max(boxes["wall"], key=lambda ends: ends[:, 0].mean())
    np.testing.assert_allclose(far, [[12.0, 0, 0], [12, 4, 2.8]], atol=0.1)
    areas = [by_kind(surfaces)[kind][0].mesh.area for kind in ("floor", "ceiling")]
    assert areas == pytest.approx([48.0, 48.0], rel=SEEN_SHARE)


def test_a_stairwell_stays_open_and_the_blind_disc_does_not(tmp_path):
    """Through a hole in the floor the floor below it is seen."""
    hole = ((3.2, 4.6), (2.4, 3.6))
    around = ((0, 5), (0, 2.4)), ((0, 5), (3.6, 4)), ((0, 3.2), (2.4, 3.6)), ((4.6, 5), (2.4, 3.6))
    room = [sheet(2, 2.8, (0, 5), (0, 4)), sheet(2, -1.5, (2, 8), (1, 7)), *(sheet(2, 0.0, *at) for at in around)]
    room += [sheet(0, x, (0, 4), (0, 2.8)) for x in (0.0, 5.0)] + [sheet(1, y, (0, 5), (0, 2.8)) for y in (0.0, 4.0)]
    floors = by_kind(placed(scanned(room, tmp_path, 100_000)))["floor"]
    upper = max(floors, key=lambda surface: surface.vertices_m[:, 2].mean())
    assert upper.mesh.area == pytest.approx(20.0 - np.prod(np.diff(hole)), rel=SEEN_SHARE)


def test_the_place_of_a_scanner_fits_its_points_and_others_do_not(through_door):
    rows, none = np.arange(len(through_door)), np.empty((0, 3))
    assert Sight(np.zeros(3), through_door, rows).fits(LEAST_SEEN)
    assert len(sights_of(through_door, none, np.full(len(rows), -1), np.zeros(3))) == 1
    for parts in (closed_box(), two_rooms()):
        corner = sampled(parts, 20_000)  # the origin lies in a corner of the building
        assert not sights_of(corner, none, np.full(len(corner), -1), np.zeros(3))
        assert not sights_of(corner, np.zeros((1, 3)), np.zeros(len(corner), int), np.zeros(3))


def test_what_beams_met_of_a_plane():
    """A plane at x = 2 with a thing before its right half, an opening on top and nothing looked at below."""
    y, z = (axis.ravel() for axis in np.meshgrid(np.arange(-1, 1, 0.02), np.arange(-0.5, 1, 0.02)))
    x = np.where(z > 0.5, 4.0, np.where(y > 0, 1.0, 2.0))
    points = np.stack([x, y * x / 2, z * x / 2], axis=1)
    sight = Sight(np.zeros(3), points, np.arange(len(points)))
    plane = with_axes(Plane(np.array([1.0, 0, 0]), 2.0, np.empty((0, 4, 3)), np.array([2.0, 0, 0]), 0.0))
    targets = np.array([[2, -0.5, 0], [2, 0.5, 0], [2, -0.5, 0.8], [2, 0, -0.9]])
    state, row = sight.on_plane(plane, targets, 0.05)
    assert state.tolist() == [ON, BEFORE, BEYOND, UNSEEN]
    np.testing.assert_allclose(points[row[0]], targets[0], atol=0.02)
