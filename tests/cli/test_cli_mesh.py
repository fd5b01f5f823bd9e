"""The command ``wrf-mi mesh``: from points, plans and meshes to a folder that the other commands open."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from commands import Command


def test_a_plan_becomes_a_scene_that_can_be_traced(flat_folder: Path, tmp_path: Path, command: Command) -> None:
    scene, run = tmp_path / "scene", tmp_path / "run"
    words = ["mesh", flat_folder / "layout.csv", "--wall-height", "2.5", "--out", scene]
    head, floor, *files, following = command.done(words).splitlines()
    assert head == f"1 floor, 1 ceiling, 4 wall, 0 other: {scene}"
    assert floor == "floor: 20.0 m2"
    for line, name in zip(files, ("materials.yml", "preview.png"), strict=True):
        assert line.endswith(str(scene / name))
        assert (scene / name).is_file()
    assert following == f"next: wrf-mi train DATASET --scene {scene} --out RUN"
    command.done(["trace", flat_folder, "--scene", scene, "--out", run, "--depth", "1", "--rays", "1000"])
    assert json.loads((run / "metrics.json").read_text())["scene"] == str(scene)


def test_registration_moves_the_scene(tmp_path: Path, command: Command) -> None:
    """A quarter turn and a shift, by pairs; then back onto the walls of the layout, which tell it up to symmetry."""
    (tmp_path / "layout.csv").write_text("x,y\n0,0\n6,0\n6,4\n2,4\n2,3\n0,3\n0,0\n")
    (tmp_path / "pairs.csv").write_text("x,y,to_x,to_y\n0,0,1,2\n6,0,1,8\n6,4,-3,8\n")
    pairs = ["--register-pairs", tmp_path / "pairs.csv"]
    moved = command.json(["mesh", tmp_path / "layout.csv", "--wall-height", "2.5", "--out", tmp_path / "moved", *pairs])
    assert moved["surfaces"] == {"floor": 1, "ceiling": 1, "wall": 6, "other": 0}
    walls = (tmp_path / "moved" / "meshes").glob("wall*.ply")
    corners = np.concatenate([trimesh.load_mesh(path).vertices for path in walls])
    assert corners.min(axis=0) == pytest.approx([-3, 2, 0], abs=1e-5)
    assert corners.max(axis=0) == pytest.approx([1, 8, 2.5], abs=1e-5)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("missing.ply --out scene", "missing.ply"),
        ("plan.csv --out scene", "--wall-height"),
        ("plan.csv --out scene --wall-height -1", "height above zero"),
        ("plan.csv --out plan.csv --wall-height 2.5", "exists"),
        ("plan.csv --out scene --wall-height 2.5 --materials materials.yml", "itu_cheese"),
        ("plan.csv --out scene --wall-height 2.5 --register-pairs plan.csv", "plan.csv"),
        ("empty.xyz --out scene", "empty.xyz"),
        ("millimetres.xyz --out scene", "--units mm"),
    ],
)
def test_bad_input_is_one_line_and_nothing_is_written(words, message, tmp_path, monkeypatch, command):
    monkeypatch.chdir(tmp_path)
    Path("plan.csv").write_text("x,y\n0,0\n5,0\n5,4\n0,4\n0,0\n")
    Path("materials.yml").write_text("rules: {wall: itu_cheese}\n")
    Path("empty.xyz").write_text("")
    np.savetxt("millimetres.xyz", np.random.default_rng(1).uniform(0, [5000, 4000, 2500], (2000, 3)))
    command.refused(["mesh", *words.split()], message)
    assert not Path("scene").exists()


def test_mesh_reports_faults_of_the_scene_that_it_writes(tmp_path: Path, command: Command) -> None:
    room = trimesh.creation.box(bounds=[[0.0, 0, 0], [4, 3, 2.5]])
    room.invert()
    corners = [[0.001, y, z] for y, z in ((0.5, 0), (2.5, 0), (2.5, 2.5), (0.5, 2.5))]
    sheet = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)
    trimesh.util.concatenate([room, sheet]).export(tmp_path / "room.obj")
    facts = command.json(["mesh", tmp_path / "room.obj", "--out", tmp_path / "scene"])
    assert [finding["kind"] for finding in facts["check"]["findings"]] == ["double-sheet"]
