"""Axes, origins and steps of the coordinates of meshes and scans."""

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
import yaml
from calling import call, refused
from made_rooms import closed_box, sampled, write_las

from wrf_mi.apps.maps.grid import surface_of
from wrf_mi.apps.viewer.layers import read_scene
from wrf_mi.core import InputError
from wrf_mi.scene.coordinates import Y_UP, looks_y_up, require_fine, require_near, require_precise
from wrf_mi.scene.make import make_scene
from wrf_mi.scene.mesh.files import mesh_parts
from wrf_mi.scene.mesh.surfaces import sampled as points_on
from wrf_mi.scene.scan.points import read_points
from wrf_mi.tracing import open_scene

ROOM = (6.0, 5.0, 2.5)
GRID = np.array([701_362.56, 4_485_513.72, 1650.1])
LOCAL = (701_300.0, 4_485_500.0, 1600.0)
WALLS_M = 0.01
"""Of walls fitted to a scan with a noise of 1 cm."""
ROUNDING_M = 5e-6
"""Of coordinates up to 64 m in single precision."""


def box(size: tuple[float, float, float] = ROOM, low: Any = (0.0, 0.0, 0.0)) -> trimesh.Trimesh:
    return trimesh.creation.box(bounds=[np.asarray(low), np.asarray(low) + size])


def y_up(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    return mesh.copy().apply_transform(Y_UP)


def write_obj(file: Path, mesh: trimesh.Trimesh) -> Path:
    """With all digits, which trimesh does not write."""
    lines = ["v " + " ".join(repr(float(value)) for value in vertex) for vertex in mesh.vertices]
    file.write_text("\n".join([*lines, *("f " + " ".join(str(k + 1) for k in face) for face in mesh.faces)]))
    return file


def extent(folder: Path) -> np.ndarray:
    parts = [part.vertices for file in (folder / "meshes").glob("*.ply") for part in mesh_parts(file)]
    return np.array([np.concatenate(parts).min(axis=0), np.concatenate(parts).max(axis=0)])


@pytest.mark.parametrize("ending", ["obj", "ply", "stl", "glb"])
def test_rooms_with_y_up_become_rooms_with_z_up(ending, tmp_path, capsys):
    """GLB has y up by its specification, other files by the option."""
    file = tmp_path / f"room.{ending}"
    y_up(box()).export(file)
    option = [] if ending == "glb" else ["--up", "y"]
    status, out, err = call(["mesh", file, "--out", tmp_path / "scene", *option], capsys)
    assert (status, err) == (0, "")
    assert out.startswith("1 floor, 1 ceiling, 4 wall, 0 other")
    np.testing.assert_allclose(extent(tmp_path / "scene"), [[0, 0, 0], ROOM], atol=ROUNDING_M)


def test_bare_meshes_turn_in_every_entry(tmp_path):
    y_up(box()).export(tmp_path / "room.glb")
    bounds = open_scene(tmp_path / "room.glb", 2.4e9, material="concrete").mi_scene.bbox()
    np.testing.assert_allclose([bounds.min, bounds.max], [[0, 0, 0], ROOM], atol=ROUNDING_M)
    surfaces, _ = read_scene(tmp_path / "room.glb")
    assert np.ptp(surfaces[0].vertices_m, axis=0) == pytest.approx(ROOM)
    assert np.ptp(surface_of(tmp_path / "room.glb").triangles_m.reshape(-1, 3), axis=0) == pytest.approx(ROOM)


def test_rooms_and_scans_that_look_turned_are_named(tmp_path, caplog):
    box().export(tmp_path / "room.glb")
    new_scene = make_scene(tmp_path / "room.glb", tmp_path / "scene", up="z")
    np.testing.assert_allclose(extent(new_scene.folder), [[0, 0, 0], ROOM], atol=ROUNDING_M)
    assert not caplog.records
    make_scene(tmp_path / "room.glb", tmp_path / "turned")
    assert "looks as if z were up" in caplog.text
    assert "--up z" in caplog.text
    points = sampled(closed_box(), 20_000)
    np.savez(tmp_path / "scan.npz", points=points @ Y_UP[:3, :3].T)
    np.testing.assert_allclose(read_points(tmp_path / "scan.npz", up="y"), points)
    caplog.clear()
    new_scene = make_scene(tmp_path / "scan.npz", tmp_path / "of_scan", up="y")
    assert sorted(new_scene.materials.surfaces.values()) == ["ceiling", "floor", *["wall"] * 4]
    assert not caplog.records
    assert looks_y_up(read_points(tmp_path / "scan.npz"))
    assert not looks_y_up(points)


def test_files_that_look_y_up_make_no_scene_until_it_is_stated(tmp_path, capsys, caplog):
    """Their floors would become walls; a bare mesh that is only opened is warned of."""
    y_up(box()).export(tmp_path / "room.obj")
    np.savez(tmp_path / "scan.npz", points=sampled(closed_box(), 20_000) @ Y_UP[:3, :3].T)
    text = "looks as if y were up (2.5 m along y, 5 m along z of the file), and is read with z up"
    remedy = "state it by wrf-mi mesh --up y, or --up z"
    for name in ("room.obj", "scan.npz"):
        message = f"and is read with z up; {remedy} if it is right\n$"
        refused(["mesh", tmp_path / name, "--out", tmp_path / "a"], message, capsys)
        assert not (tmp_path / "a").exists()
    assert call(["mesh", tmp_path / "room.obj", "--up", "z", "--out", tmp_path / "b"], capsys)[0] == 0
    assert not caplog.records
    open_scene(tmp_path / "room.obj", 2.4e9, material="concrete")
    (record,) = caplog.records
    assert record.getMessage().endswith(f"room.obj: {text}; {remedy}")


def test_a_room_whose_floor_would_be_missing_is_refused(tmp_path):
    """Two upright sides and nothing across them, until y is up: its size tells nothing."""
    room = box((6.0, 4.0, 5.0), (1.0, 1.0, 0.5))
    room.update_faces(np.abs(room.face_normals[:, 1]) < 0.5)
    y_up(room).export(tmp_path / "room.ply")
    with pytest.raises(InputError, match=r"has no floor with z up, and one with y up; .*--up y, or --up z"):
        make_scene(tmp_path / "room.ply", tmp_path / "scene")
    new_scene = make_scene(tmp_path / "room.ply", tmp_path / "scene", up="y")
    assert sorted(new_scene.materials.surfaces.values()) == ["ceiling", "floor", "wall", "wall"]


LIVING, HALL = (6, 4, 2.5), (30.0, 20.0, 16.42)
EYE_LEVEL = (-3, -2, -1.4)
"""Origin of scans of telephones."""
CORRIDORS = [(2, 20, 2.6), (20, 2, 2.6), (20, 2, 3.2), (20, 2.5, 3.6)]
TALL = [(5, 4, 8), (5, 3, 12), (3, 5, 12), (20, 20, 60)]
"""Rooms and stairwells."""


@pytest.mark.parametrize(
    ("mesh", "expected"),
    [
        *((y_up(box(*at)), True) for at in ((LIVING,), (LIVING, EYE_LEVEL), ((4, 3.6, 2.5),), (HALL,))),
        *((box(size), False) for size in (LIVING, HALL, *CORRIDORS, *TALL)),
        (box((6, 5, 2.5), (0, 0, -2.5)), False),  # a cellar
        (trimesh.util.concatenate([box((30, 3, 3)), box((3, 3, 9))]), False),  # a corridor with a tall end
    ],
)
def test_corridors_and_tall_rooms_do_not_look_y_up(mesh, expected):
    assert looks_y_up(points_on(np.asarray(mesh.triangles))) is expected


def test_options_are_checked(tmp_path):
    (tmp_path / "plan.csv").write_text("x,y\n0,0\n5,0\n5,4\n0,0\n")
    box().export(tmp_path / "room.ply")
    for name, options, message in (
        ("plan.csv", {"height_m": 2.5, "up": "z"}, "a plan; leave out --up, which is for scans and meshes"),
        ("room.ply", {"up": "x"}, "give y or z"),
        ("room.ply", {"origin_m": (1, 2)}, "give three finite numbers"),
        ("room.ply", {"origin_m": (1, 2, np.nan)}, "three finite"),
    ):
        with pytest.raises(InputError, match=message):
            make_scene(tmp_path / name, tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


def test_a_national_grid_gets_an_origin_that_keeps_millimetres(tmp_path, capsys):
    """Stored and printed by the command; whatever else opens the file refuses it."""
    file = write_obj(tmp_path / "utm.obj", box(ROOM, GRID))
    origin, low = ",".join(f"{value:.0f}" for value in LOCAL), GRID - LOCAL
    for name, options in (("scene", []), ("stated", ["--origin", origin])):
        status, out, err = call(["mesh", file, "--out", tmp_path / name, *options], capsys)
        assert (status, err) == (0, "")
        assert "origin: 701300, 4485500, 1600 of the source; positions of measurements must be relative to it" in out
        np.testing.assert_allclose(extent(tmp_path / name), [low, low + ROOM], atol=ROUNDING_M)
        facts = yaml.safe_load((tmp_path / name / "scene.yml").read_text())
        assert facts["origin_m"] == list(LOCAL)
        assert facts["frame"].endswith("less the origin 701300, 4485500, 1600")
    message = r"coordinates up to 448551[89] m.* are 0.5 m apart.*--origin 701300,4485500"
    for entry in (lambda far: open_scene(far, 2.4e9, material="concrete"), read_scene, surface_of):
        with pytest.raises(InputError, match=message):
            entry(file)


def test_a_scan_in_a_national_grid_keeps_its_walls(tmp_path, monkeypatch):
    points = sampled(closed_box(), 20_000) + GRID
    file = write_las(tmp_path / "scan.las", points, 0.001)
    new_scene = make_scene(file, tmp_path / "scene")
    low = GRID - LOCAL
    assert new_scene.origin_m == LOCAL
    np.testing.assert_allclose(extent(new_scene.folder), [low, low + np.array([5.0, 4.0, 2.8])], atol=WALLS_M)
    # Positions are in the scene's frame, which they do not tell; without a search for planes, which takes minutes.
    monkeypatch.delattr("wrf_mi.scene.scan.cloud.find_planes")
    (tmp_path / "positions.csv").write_text("x,y\n1,1\n2,1\n")
    with pytest.raises(InputError, match=r"scan.las: coordinates up to 4485518 m.*--origin 701300,4485500,1600"):
        make_scene(file, tmp_path / "refused", positions=tmp_path / "positions.csv")


def test_scenes_of_a_national_grid_are_brought_near_or_refused(tmp_path):
    """By a registration; a folder far away may be of other programs."""
    folder = make_scene(write_obj(tmp_path / "room.obj", box()), tmp_path / "scene").folder
    for file in (folder / "meshes").glob("*.ply"):
        (part,) = mesh_parts(file)
        part.apply_translation([20_000, 0, 0]).export(file, vertex_normal=False)
    message = r"scene: coordinates up to 20006 m, .* are 0.002 m apart; .*--origin 20000,0,0"
    with pytest.raises(InputError, match=message):
        open_scene(folder, 2.4e9)
    motion = np.eye(4)
    motion[:3, 3] = -np.array(LOCAL)
    file = write_obj(tmp_path / "utm.obj", box(ROOM, GRID))
    new_scene = make_scene(file, tmp_path / "near", registration=motion)
    np.testing.assert_allclose(extent(new_scene.folder)[0], GRID - LOCAL, atol=ROUNDING_M)


def test_a_plan_in_a_national_grid_is_moved_with_its_positions(tmp_path):
    """Positions are in the scene's frame, and a plan that fits them better when mirrored is refused as ever."""
    outline = np.array([(0, 0), (6, 0), (6, 4), (2, 4), (2, 3), (0, 3), (0, 0)]) + GRID[:2]
    (tmp_path / "layout.csv").write_text("x,y\n" + "\n".join(f"{x:.2f},{y:.2f}" for x, y in outline) + "\n")
    assert make_scene(tmp_path / "layout.csv", tmp_path / "far", height_m=2.5).origin_m == (701_300, 4_485_500, 0)
    places = np.array([(0.5, y) for y in np.arange(0.5, 3, 0.5)] + [(x, 3.8) for x in np.arange(2.5, 6, 0.5)])
    places += GRID[:2] - LOCAL[:2]
    for name, xy in (("right.csv", places), ("mirrored.csv", places * (1, -1) + (0, 2 * 15.72))):
        (tmp_path / name).write_text("x,y\n" + "\n".join(f"{x:.2f},{y:.2f}" for x, y in xy) + "\n")
    options: dict[str, Any] = {"height_m": 2.5, "origin_m": LOCAL, "floor_m": LOCAL[2]}
    new_scene = make_scene(tmp_path / "layout.csv", tmp_path / "scene", positions=tmp_path / "right.csv", **options)
    low = np.append(GRID[:2] - LOCAL[:2], 0)
    np.testing.assert_allclose(extent(new_scene.folder), [low, low + np.array([6, 4, 2.5])], atol=ROUNDING_M)
    with pytest.raises(InputError, match="positions"):
        make_scene(tmp_path / "layout.csv", tmp_path / "no", positions=tmp_path / "mirrored.csv", **options)


def test_files_that_were_rounded_far_away_are_refused(tmp_path):
    """As an origin does not bring back what they have lost."""
    points = sampled(closed_box(), 5000) + GRID
    trimesh.PointCloud(points).export(tmp_path / "scan.ply")
    np.savez(tmp_path / "scan.npz", points=points.astype(np.float32))
    np.savetxt(tmp_path / "scan.xyz", points.astype(np.float32), fmt="%.3f")
    box(ROOM, GRID).export(tmp_path / "room.stl")
    for name in ("scan.ply", "scan.npz", "scan.xyz", "room.stl"):
        with pytest.raises(InputError, match=rf"{name}: y has been rounded to steps of 0.5 m, by single precision"):
            make_scene(tmp_path / name, tmp_path / "out", origin_m=LOCAL)
    for far in (0.0, 1000.0, 16_000.0):
        near = np.array([[far, 0, 0], [far + 300, 0, 10]])
        require_near(near, "room")
        require_precise(near.astype(np.float32).astype(float), 1.0, "room")
        require_precise(1000 * near, 0.001, "room")
    whole_metres = np.array([[701_362.0, 4_485_513.0, 1650], [701_368.0, 4_485_518.0, 1652]])
    require_precise(whole_metres, 1.0, "whole metres")
    require_precise(whole_metres + 0.5, 1.0, "half metres")
    require_precise(GRID[None] * 1000, 0.001, "millimetres")
    with pytest.raises(InputError, match=r"y has been rounded to steps of 0\.51 m"):
        require_precise((GRID[None] * 1000).astype(np.float32).astype(float), 0.001, "millimetres")


def test_coarse_steps_of_a_scan_are_named(tmp_path, caplog):
    points = sampled(closed_box(), 5000)
    write_las(tmp_path / "s.las", points, 0.1)
    np.savetxt(tmp_path / "s.xyz", points, fmt="%.1f")
    for name, remedy in (("s.las", r" \(the scale of a LAS.*1 cm or less"), ("s.xyz", "")):
        with pytest.raises(InputError, match=rf"{name}: coordinates are in steps of 0.1 m{remedy}"):
            make_scene(tmp_path / name, tmp_path / "out")
    assert not caplog.records
    with caplog.at_level(logging.WARNING):
        require_fine(np.round(points / 0.04) * 0.04, "scan")
    assert "steps of 0.04 m" in caplog.text
    caplog.clear()
    flat = points * [1, 1, 0] + np.where(points[:, 2:] > 1, 2.5, 0) * [0, 0, 1]  # floor and ceiling
    for fine in (points, np.round(points, 2), points.astype(np.float32), points[:5], flat):
        require_fine(np.asarray(fine, float), "scan")
    assert not caplog.records


def test_points_are_told_from_plans_and_meshes(tmp_path, capsys):
    message = "has a column z or three numbers in a row, and a CSV is a plan of wall corners, x,y.*call it .xyz"
    for name, first in (("names.csv", "x,y,z"), ("numbers.csv", "0,0,1"), ("semicolons.csv", "X; Y; Z")):
        (tmp_path / name).write_text(f"{first}\n1,2,3\n4,5,6\n")
        refused(["mesh", tmp_path / name, "--out", tmp_path / "scene"], f"{name}: {message}", capsys)
    (tmp_path / "points.obj").write_text("v 0 0 0\nv 1 0 0\n")
    with pytest.raises(InputError, match=r"points.obj: has no faces, so no surface; complete it, or give its points"):
        make_scene(tmp_path / "points.obj", tmp_path / "out")
