"""A fit is used again only where settings, rows, seed, data, files and versions are those that it was made with."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from wrf_mi.core import InputError
from wrf_mi.core.digest import content_digest
from wrf_mi.runs.sweep import scene_files


def test_digest_tells_values_apart() -> None:
    values: list[Any] = [
        "a", "b", 1, 1.0, True, None, (), ("a",), ("a", "b"), "a\n'b'", {"a": 1}, {"a": 2}, {"b": 1}, [("a", 1)],
        np.zeros(2), np.zeros(2, np.float32), np.zeros((1, 2)), np.zeros((2, 1)), np.array([0, 1.0]),
    ]  # fmt: skip
    assert len({content_digest(value) for value in values}) == len(values)
    assert content_digest({"a": 1, "b": 2}) == content_digest({"b": 2, "a": 1})
    assert content_digest(np.arange(6).reshape(2, 3).T) == content_digest(np.arange(6).reshape(2, 3).T.copy())
    with pytest.raises(TypeError, match="object has no digest"):
        content_digest(object())


def test_digest_of_a_folder_is_that_of_names_and_contents(tmp_path: Path) -> None:
    (tmp_path / "scene" / "meshes").mkdir(parents=True)
    named = '<scene><shape type="ply"><string name="filename" value="{}"/></shape></scene>'
    (tmp_path / "scene" / "scene.xml").write_text(named.format("meshes/wall.ply"))
    (tmp_path / "scene" / "meshes" / "wall.ply").write_text("ply")
    copy = shutil.copytree(tmp_path / "scene", tmp_path / "copy")
    assert content_digest(copy) == content_digest(tmp_path / "scene")
    before = content_digest(scene_files(copy / "scene.xml"))
    (copy / "meshes" / "wall.ply").write_text("ply2")
    assert content_digest(copy) != content_digest(tmp_path / "scene")
    assert content_digest(scene_files(copy / "scene.xml")) != before
    (copy / "beside.xml").write_text(named.format("floor.ply"))
    (copy / "floor.ply").write_text("ply")
    before = content_digest(scene_files(copy / "beside.xml"))
    (copy / "floor.ply").write_text("ply2")
    assert content_digest(scene_files(copy / "beside.xml")) != before
    for name in ("beside.xml", "floor.ply"):
        (copy / name).unlink()
    (copy / "meshes" / "wall.ply").write_text("ply")
    (tmp_path / "linked").mkdir()
    (tmp_path / "linked" / "meshes").symlink_to(copy / "meshes")
    before = content_digest(tmp_path / "linked")
    (copy / "meshes" / "wall.ply").write_text("ply3")
    assert content_digest(tmp_path / "linked") != before
    (copy / "meshes" / "wall.ply").write_text("ply")
    (copy / "meshes" / "wall.ply").rename(copy / "meshes" / "door.ply")
    assert content_digest(copy) != content_digest(tmp_path / "scene")
    assert scene_files("laboratory") == []
    with pytest.raises(InputError, match="no such file or folder"):
        content_digest(tmp_path / "none")
