"""Scans from one place: blind below the scanner, sparse far away, with shadows, and strays through a door."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from made_rooms import Mesh, by_kind, closed_box, sampled, scene_file, two_rooms
from wrf_mi_scenes.build_laboratory import box, sheet

from wrf_mi.scene.mesh.planes import Plane, with_axes
from wrf_mi.scene.mesh.surfaces import Surface
from wrf_mi.scene.scan.cloud import surfaces_from_points
from wrf_mi.scene.scan.sight import BEFORE, BEYOND, LEAST_SEEN, ON, UNSEEN, Sight, sights_of
from wrf_mi.scene.scan.simulated import simulate_scan

PLACE = np.array([1.3, 1.7, 1.35])
BLIND_RAD = np.radians(40.0)  # from straight down: a disc of 1.1 m radius on the floor
AREA_SHARE = 0.03  # edges of a floor that is hidden or sparse there are known to a cell of 10 cm
EDGE_M = 0.06  # free edges of a door, which half the distance between beams bounds


def scanned(parts: list[Mesh], folder: Path, rays: int, place: np.ndarray = PLACE) -> np.ndarray:
    """A scan from one place that is blind below it, in the frame of its scanner."""
    points = simulate_scan(scene_file(folder, parts), [place], rays_per_pose=rays) - place
    below = np.arccos(np.clip(-points[:, 2] / np.linalg.norm(points, axis=1), -1, 1))
    return points[below > BLIND_RAD]


def in_room(surfaces: list[Surface], place: np.ndarray = PLACE) -> dict[str, list[np.ndarray]]:
    """Lowest and highest corners of the surfaces of each kind, in the frame of the room."""
    kinds = by_kind(surfaces)
    return {k: [np.stack([s.vertices_m.min(0), s.vertices_m.max(0)]) + place for s in of] for k, of in kinds.items()}


@pytest.mark.parametrize("stated", [True, False])
def test_a_scan_through_a_door_is_the_room_of_its_scanner(stated: bool, tmp_path: Path) -> None:
    """The floor has no hole below the scanner, and none behind a thing; the next room is not there."""
    points = scanned([*two_rooms(), box((2.4, 0.6, 0.0), (2.9, 1.1, 0.9))], tmp_path, 60_000)
    known = (np.zeros((1, 3)), np.zeros(len(points), int)) if stated else (None, None)
    surfaces = surfaces_from_points(points, *known)
    boxes = in_room(surfaces)
    (floor,), (ceiling,) = (by_kind(surfaces)[kind] for kind in ("floor", "ceiling"))
    assert floor.mesh.area == pytest.approx(16.0, rel=AREA_SHARE)
    assert ceiling.mesh.area == pytest.approx(16.0, rel=AREA_SHARE)
    assert len(boxes["wall"]) == 4
    for low, high in (ends for of in boxes.values() for ends in of):
        assert low[0] > -0.1
        assert high[0] < 4.1
    partition = max(by_kind(surfaces)["wall"], key=lambda wall: wall.vertices_m[:, 0].mean())
    assert partition.mesh.area == pytest.approx(4 * 2.6 - 0.9 * 2.1, abs=5.1 * EDGE_M)


def test_a_far_wall_of_few_points_is_a_wall(tmp_path: Path) -> None:
    """Its points are as far apart as strays; floor and ceiling reach it, and cover all between."""
    size = np.array([12.0, 4.0, 2.8])
    points = scanned(closed_box(*size), tmp_path, 20_000)
    surfaces = surfaces_from_points(points, np.zeros((1, 3)), np.zeros(len(points), int))
    boxes = in_room(surfaces)
    assert [len(boxes[kind]) for kind in ("floor", "ceiling", "wall")] == [1, 1, 4]
    far = max(boxes["wall"], key=lambda ends: ends[:, 0].mean())
    np.testing.assert_allclose(far, [[12, 0, 0], [12, 4, 2.8]], atol=0.1)
    for kind in ("floor", "ceiling"):
        assert by_kind(surfaces)[kind][0].mesh.area == pytest.approx(48.0, rel=AREA_SHARE)


def test_a_stairwell_stays_open_and_the_blind_disc_does_not(tmp_path: Path) -> None:
    """Through a hole in the floor the floor below it is seen."""
    hole = ((3.2, 4.6), (2.4, 3.6))
    floor = [
        sheet(2, 0.0, x, y)
        for x, y in (((0, 5), (0, 2.4)), ((0, 5), (3.6, 4)), ((0, 3.2), (2.4, 3.6)), ((4.6, 5), (2.4, 3.6)))
    ]
    room = [sheet(2, 2.8, (0, 5), (0, 4)), sheet(2, -1.5, (2, 8), (1, 7)), *floor]
    room += [sheet(0, x, (0, 4), (0, 2.8)) for x in (0.0, 5.0)] + [sheet(1, y, (0, 5), (0, 2.8)) for y in (0.0, 4.0)]
    points = scanned(room, tmp_path, 100_000)
    floors = by_kind(surfaces_from_points(points, np.zeros((1, 3)), np.zeros(len(points), int)))["floor"]
    upper = max(floors, key=lambda surface: surface.vertices_m[:, 2].mean())
    assert upper.mesh.area == pytest.approx(20.0 - np.prod(np.diff(hole)), rel=AREA_SHARE)


def test_the_place_of_a_scanner_fits_its_points_and_others_do_not(tmp_path: Path) -> None:
    points = scanned([*two_rooms(), box((2.4, 0.6, 0.0), (2.9, 1.1, 0.9))], tmp_path, 60_000)
    rows, none = np.arange(len(points)), np.empty((0, 3))
    assert Sight(np.zeros(3), points, rows).fits(LEAST_SEEN)
    assert len(sights_of(points, none, np.full(len(points), -1), np.zeros(3))) == 1
    for parts in (closed_box(), two_rooms()):
        corner = sampled(parts, 20_000)  # the origin lies in a corner of the building
        assert not sights_of(corner, none, np.full(len(corner), -1), np.zeros(3))
        assert not sights_of(corner, np.zeros((1, 3)), np.zeros(len(corner), int), np.zeros(3))


def test_what_beams_met_of_a_plane() -> None:
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
