"""Positions on meshes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from wrf_mi.core import InputError
from wrf_mi.maps.grid import surface_of
from wrf_mi.scene.coordinates import Y_UP

ROUNDING_M = 1e-5
"""Of coordinates in the float32 of a file."""


@pytest.mark.parametrize("suffix", ["ply", "stl", "obj", "glb"])
def test_positions_are_the_centres_of_the_faces(suffix: str, tmp_path: Path) -> None:
    mesh = trimesh.creation.box((2.0, 1.0, 0.5))
    mesh.copy().apply_transform(Y_UP if suffix == "glb" else np.eye(4)).export(tmp_path / f"box.{suffix}")
    found = surface_of(tmp_path / f"box.{suffix}")
    expected = mesh.triangles_center[np.lexsort(mesh.triangles_center.round(4).T)]
    positions = found.positions_m[np.lexsort(found.positions_m.round(4).T)]
    np.testing.assert_allclose(positions, expected, atol=ROUNDING_M)


def test_faces_are_halved_to_a_step_and_cover_the_same_area(tmp_path: Path) -> None:
    mesh = trimesh.creation.box((2.0, 1.0, 0.5))
    mesh.export(tmp_path / "box.ply")
    triangles = surface_of(tmp_path / "box.ply", 0.3).triangles_m
    assert np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=-1).max() <= 0.3 + ROUNDING_M
    assert trimesh.triangles.area(triangles).sum() == pytest.approx(mesh.area, rel=ROUNDING_M)


def test_bad_meshes_and_steps_are_refused(tmp_path: Path) -> None:
    trimesh.creation.box((2.0, 1.0, 0.5)).export(tmp_path / "box.ply")
    (tmp_path / "empty.ply").write_text("nothing")
    for file, step, message in (
        ("none.ply", None, "no such file"),
        ("empty.ply", None, "cannot be read as a mesh"),
        ("box.ply", 0.0, "positive"),
        ("box.ply", 1e-5, "larger step"),
    ):
        with pytest.raises(InputError, match=message):
            surface_of(tmp_path / file, step)
