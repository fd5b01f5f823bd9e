"""The command ``wrf-mi mesh``: from points, plans and meshes to a folder that the other commands open."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from calling import call

LAYOUT = "x,y\n0,0\n5,0\n5,4\n0,4\n0,0\n"


def test_a_plan_becomes_a_scene_that_can_be_traced(
    flat_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plan, scene = flat_folder / "layout.csv", tmp_path / "scene"
    status, out, err = call(["mesh", plan, "--height", "2.5", "--out", scene], capsys)
    assert status == 0, err
    assert out.splitlines()[0] == f"1 floor, 1 ceiling, 4 wall, 0 other: {scene}"
    for line, name in zip(out.splitlines()[1:], ("materials.yml", "preview.png"), strict=True):
        assert line.endswith(str(scene / name))
        assert (scene / name).is_file()
    run = tmp_path / "run"
    status, _, err = call(["trace", scene, flat_folder, "--out", run, "--depth", "1", "--rays", "1000"], capsys)
    assert status == 0, err
    assert json.loads((run / "metrics.json").read_text())["scene"] == str(scene)


def test_registration_moves_the_scene(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A quarter turn and a shift, by pairs; then back onto the walls of the layout, which tell it up to symmetry."""
    (tmp_path / "layout.csv").write_text("x,y\n0,0\n6,0\n6,4\n2,4\n2,3\n0,3\n0,0\n")
    turned = [(0, 0, 1, 2), (6, 0, 1, 8), (6, 4, -3, 8)]
    lines = [",".join(map(str, pair)) for pair in turned]
    (tmp_path / "pairs.csv").write_text("\n".join(["x,y,to_x,to_y", *lines]) + "\n")
    made = ["mesh", tmp_path / "layout.csv", "--height", "2.5", "--json", "--out"]
    status, out, err = call([*made, tmp_path / "moved", "--register-pairs", tmp_path / "pairs.csv"], capsys)
    assert status == 0, err
    assert json.loads(out)["surfaces"] == {"floor": 1, "ceiling": 1, "wall": 6, "other": 0}
    corners = np.concatenate([read_ply(path) for path in (tmp_path / "moved" / "meshes").glob("wall*.ply")])
    assert corners.min(axis=0) == pytest.approx([-3, 2, 0], abs=1e-5)
    assert corners.max(axis=0) == pytest.approx([1, 8, 2.5], abs=1e-5)


def read_ply(path: Path) -> np.ndarray:
    import trimesh

    return np.asarray(trimesh.load_mesh(path).vertices)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["missing.ply", "--out", "scene"], "missing.ply"),
        (["plan.csv", "--out", "scene"], "--height"),
        (["plan.csv", "--out", "scene", "--height", "-1"], "height above zero"),
        (["plan.csv", "--out", "plan.csv", "--height", "2.5"], "exists"),
        (["plan.csv", "--out", "scene", "--height", "2.5", "--materials", "materials.yml"], "itu_cheese"),
        (["plan.csv", "--out", "scene", "--height", "2.5", "--register-pairs", "plan.csv"], "plan.csv"),
        (["empty.xyz", "--out", "scene"], "empty.xyz"),
        (["millimetres.xyz", "--out", "scene"], "--units mm"),
    ],
)
def test_bad_input_is_one_line_and_nothing_is_written(
    arguments: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("plan.csv").write_text(LAYOUT)
    Path("materials.yml").write_text("rules: {wall: itu_cheese}\n")
    Path("empty.xyz").write_text("")
    room = np.random.default_rng(1).uniform(0, [5000, 4000, 2500], (2000, 3))
    np.savetxt("millimetres.xyz", room)
    status, out, err = call(["mesh", *arguments], capsys)
    assert (status, out) == (2, ""), err
    assert message in err
    assert err.count("\n") == 1
    assert not Path("scene").exists()
