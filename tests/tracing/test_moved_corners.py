"""Corners of a scene's faces after its planes have moved."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from wrf_mi.scene.folder import write_scene
from wrf_mi.scene.mesh.surfaces import Surface
from wrf_mi.tracing import open_scene
from wrf_mi.tracing.paths.corrected_scene import moved_triangles
from wrf_mi.tracing.paths.scene_parameters import SHIFT
from wrf_mi.tracing.search.surfaces import scene_surfaces

SHIFT_M = 0.03
ROUNDED_M = 1e-5
"""Meshes are stored in single precision."""
QUAD = np.array([[0, 1, 2], [0, 2, 3]])


def upright(begin: tuple[float, float], end: tuple[float, float]) -> np.ndarray:
    """Corners [4, 3] of a wall 2.7 m high over a line in plan."""
    return np.array([[*begin, 0], [*end, 0], [*end, 2.7], [*begin, 2.7]], float)


def walls(folder: Path, angle_deg: float) -> tuple[np.ndarray, np.ndarray]:
    """A wall of 4 m whose plane moves, and one of 0.2 m that goes on at an angle: their corners, moved, [2, 3, 3]."""
    turn = np.radians(angle_deg)
    far = 4 + 0.2 * np.cos(turn), 0.2 * np.sin(turn)
    parts = [upright((0, 0), (4, 0)), upright((4, 0), far)]
    surfaces = [Surface(f"wall_0{k}", "wall", part, QUAD) for k, part in enumerate(parts, 1)]
    scene = open_scene(write_scene(folder, surfaces, frame="made up", source="made up"), 2.4e9)
    planes = scene_surfaces(scene)
    shift = np.zeros(len(planes.normal))
    large = int(np.argmax(np.abs(planes.normal[:, 1]) > 0.999))
    shift[large] = SHIFT_M * np.sign(planes.normal[large, 1])
    moved = moved_triangles(planes, {SHIFT: shift})
    return moved[planes.plane == large], moved[planes.plane != large]


def test_a_wall_stays_flat_at_a_small_face_almost_parallel_to_it(tmp_path: Path) -> None:
    """The common corners follow the wall, the larger of the two."""
    wall, face = walls(tmp_path / "scene", 8)
    np.testing.assert_allclose(wall[..., 1], SHIFT_M, atol=ROUNDED_M)
    common = np.isclose(face[..., 0], 4, atol=ROUNDED_M)
    assert common.sum() == 3  # of the corners of two triangles
    np.testing.assert_allclose(face[common][:, 1], SHIFT_M, atol=ROUNDED_M)


def test_corners_of_walls_at_an_angle_move_to_the_new_intersection(tmp_path: Path) -> None:
    wall, _ = walls(tmp_path / "scene", 30)
    np.testing.assert_allclose(wall[..., 1], SHIFT_M, atol=ROUNDED_M)
    assert np.isclose(wall[..., 0].max(), 4 + SHIFT_M / np.tan(np.radians(30)), atol=ROUNDED_M)
