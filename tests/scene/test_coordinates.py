"""Axes, origins and steps of the coordinates of meshes and scans."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
import trimesh
import yaml
from calling import call
from made_rooms import closed_box, sampled

from wrf_mi.core import InputError
from wrf_mi.maps.grid import surface_of
from wrf_mi.scene.coordinates import Y_UP, looks_y_up, require_fine, require_near, require_precise
from wrf_mi.scene.make import make_scene
from wrf_mi.scene.mesh.files import mesh_parts
from wrf_mi.scene.mesh.surfaces import sampled as points_on
from wrf_mi.scene.scan.points import read_points
from wrf_mi.tracing import open_scene
from wrf_mi.viewer.layers import read_scene

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
    parts = [part for file in sorted((folder / "meshes").glob("*.ply")) for part in mesh_parts(file)]
    return np.array([trimesh.util.concatenate(parts).bounds])[0]


@pytest.mark.parametrize("ending", ["obj", "ply", "stl", "glb"])
def test_rooms_with_y_up_become_rooms_with_z_up(
    ending: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """GLB has y up by its specification, other files by the option."""
    file = tmp_path / f"room.{ending}"
    y_up(box()).export(file)
    option = [] if ending == "glb" else ["--up", "y"]
    status, out, err = call(["mesh", file, "--out", tmp_path / "scene", *option], capsys)
    assert (status, err) == (0, "")
    assert out.startswith("1 floor, 1 ceiling, 4 wall, 0 other")
    np.testing.assert_allclose(extent(tmp_path / "scene"), [[0, 0, 0], ROOM], atol=ROUNDING_M)


def test_bare_meshes_turn_in_every_entry(tmp_path: Path) -> None:
    y_up(box()).export(tmp_path / "room.glb")
    bounds = open_scene(tmp_path / "room.glb", 2.4e9, material="concrete").mi_scene.bbox()
    np.testing.assert_allclose([bounds.min, bounds.max], [[0, 0, 0], ROOM], atol=ROUNDING_M)
    surfaces, _ = read_scene(tmp_path / "room.glb")
    assert np.ptp(surfaces[0].vertices_m, axis=0) == pytest.approx(ROOM)
    assert np.ptp(surface_of(tmp_path / "room.glb").triangles_m.reshape(-1, 3), axis=0) == pytest.approx(ROOM)


def test_a_glb_with_z_up_is_stated(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    box().export(tmp_path / "room.glb")
    made = make_scene(tmp_path / "room.glb", tmp_path / "scene", up="z")
    np.testing.assert_allclose(extent(made.folder), [[0, 0, 0], ROOM], atol=ROUNDING_M)
    assert not caplog.records
    make_scene(tmp_path / "room.glb", tmp_path / "turned")
    assert "looks as if z were up" in caplog.text
    assert "--up z" in caplog.text


def test_scans_with_y_up_are_turned_or_warned_of(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    points = sampled(closed_box(), 20_000)
    np.savez(tmp_path / "scan.npz", points=points @ Y_UP[:3, :3].T)
    np.testing.assert_allclose(read_points(tmp_path / "scan.npz", up="y"), points)
    made = make_scene(tmp_path / "scan.npz", tmp_path / "scene", up="y")
    assert sorted(made.materials.surfaces.values()) == ["ceiling", "floor", *["wall"] * 4]
    assert not caplog.records
    assert looks_y_up(read_points(tmp_path / "scan.npz"))
    assert not looks_y_up(points)


def test_files_that_look_y_up_make_no_scene_until_it_is_stated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    """Their floors would become walls; a bare mesh that is only opened is warned of."""
    y_up(box()).export(tmp_path / "room.obj")
    np.savez(tmp_path / "scan.npz", points=sampled(closed_box(), 20_000) @ Y_UP[:3, :3].T)
    text = "looks as if y were up (2.5 m along y, 5 m along z of the file), and is read with z up"
    remedy = "state it by wrf-mi mesh --up y, or --up z"
    for name in ("room.obj", "scan.npz"):
        status, out, err = call(["mesh", tmp_path / name, "--out", tmp_path / "a"], capsys)
        assert (status, out, err.count("\n")) == (2, "", 1)
        assert err.endswith(f"and is read with z up; {remedy} if it is right\n")
        assert not (tmp_path / "a").exists()
    status, _, _ = call(["mesh", tmp_path / "room.obj", "--up", "z", "--out", tmp_path / "b"], capsys)
    assert status == 0
    assert not caplog.records
    open_scene(tmp_path / "room.obj", 2.4e9, material="concrete")
    (record,) = caplog.records
    assert record.getMessage().endswith(f"room.obj: {text}; {remedy}")


def test_a_room_whose_floor_would_be_missing_is_refused(tmp_path: Path) -> None:
    """Two upright sides and nothing across them, until y is up: its size tells nothing."""
    room = box((6.0, 4.0, 5.0), (1.0, 1.0, 0.5))
    open_side = room.submesh([np.abs(room.face_normals[:, 1]) < 0.5], append=True)
    y_up(open_side).export(tmp_path / "room.ply")
    with pytest.raises(InputError, match=r"has no floor with z up, and one with y up; .*--up y, or --up z"):
        make_scene(tmp_path / "room.ply", tmp_path / "scene")
    made = make_scene(tmp_path / "room.ply", tmp_path / "scene", up="y")
    assert sorted(made.materials.surfaces.values()) == ["ceiling", "floor", "wall", "wall"]


HALL = (30.0, 20.0, 16.42)


@pytest.mark.parametrize(
    ("mesh", "expected"),
    [
        (y_up(box((6, 4, 2.5))), True),
        (y_up(box((6, 4, 2.5), (-3, -2, -1.4))), True),  # origin at eye level, as telephones have it
        (y_up(box((4, 3.6, 2.5))), True),
        (y_up(box(HALL)), True),  # floor at zero along y
        (box((6, 4, 2.5)), False),
        (box(HALL), False),
        (box((2, 20, 2.6)), False),  # corridors
        (box((20, 2, 2.6)), False),
        (box((20, 2, 3.2)), False),
        (box((20, 2.5, 3.6)), False),
        (box((5, 4, 8)), False),  # tall rooms
        (box((5, 3, 12)), False),  # stairwells
        (box((3, 5, 12)), False),
        (box((6, 5, 2.5), (0, 0, -2.5)), False),  # a cellar
        (box((20, 20, 60)), False),
        (trimesh.util.concatenate([box((30, 3, 3)), box((3, 3, 9))]), False),  # a corridor with a tall end
    ],
)
def test_corridors_and_tall_rooms_do_not_look_y_up(mesh: trimesh.Trimesh, expected: bool) -> None:
    assert looks_y_up(points_on(np.asarray(mesh.triangles))) is expected


def test_options_are_checked(tmp_path: Path) -> None:
    (tmp_path / "plan.csv").write_text("x,y\n0,0\n5,0\n5,4\n0,0\n")
    with pytest.raises(InputError, match=r"a plan; leave out --up, which is for scans and meshes"):
        make_scene(tmp_path / "plan.csv", tmp_path / "out", height_m=2.5, up="z")
    box().export(tmp_path / "room.ply")
    options: list[dict[str, Any]] = [{"up": "x"}, {"origin_m": (1, 2)}, {"origin_m": (1, 2, np.nan)}]
    for option, message in zip(options, ("give y or z", "give three finite numbers", "three finite"), strict=True):
        with pytest.raises(InputError, match=message):
            make_scene(tmp_path / "room.ply", tmp_path / "out", **option)
    assert not (tmp_path / "out").exists()


def test_a_national_grid_gets_an_origin_that_keeps_millimetres(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Stored and printed by the command; whatever else opens the file refuses it."""
    file = write_obj(tmp_path / "utm.obj", box(ROOM, GRID))
    origin, low = ",".join(f"{value:.0f}" for value in LOCAL), GRID - LOCAL
    for name, options in (("scene", []), ("stated", ["--origin", origin])):
        status, out, err = call(["mesh", file, "--out", tmp_path / name, *options], capsys)
        assert (status, err) == (0, "")
        assert "origin: 701300, 4485500, 1600; subtract it from the positions of the measurements, too" in out
        np.testing.assert_allclose(extent(tmp_path / name), [low, low + ROOM], atol=ROUNDING_M)
        facts = yaml.safe_load((tmp_path / name / "scene.yml").read_text())
        assert facts["origin_m"] == list(LOCAL)
        assert facts["frame"].endswith("less the origin 701300, 4485500, 1600")
    for entry in (
        lambda: open_scene(file, 2.4e9, material="concrete"),
        lambda: read_scene(file),
        lambda: surface_of(file),
    ):
        with pytest.raises(
            InputError, match=r"coordinates up to 448551[89] m.* are 0.5 m apart.*--origin 701300,4485500"
        ):
            entry()


def test_a_scan_in_a_national_grid_keeps_its_walls(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    points = sampled(closed_box(), 20_000) + GRID
    file = write_las(tmp_path / "scan.las", points, 0.001)
    made = make_scene(file, tmp_path / "scene")
    low = GRID - LOCAL
    assert made.origin_m == LOCAL
    np.testing.assert_allclose(extent(made.folder), [low, low + np.array([5.0, 4.0, 2.8])], atol=WALLS_M)
    # Positions are in the scene's frame, which they do not tell; without a search for planes, which takes minutes.
    monkeypatch.delattr("wrf_mi.scene.scan.cloud.find_planes")
    (tmp_path / "positions.csv").write_text("x,y\n1,1\n2,1\n")
    with pytest.raises(InputError, match=r"scan.las: coordinates up to 4485518 m.*--origin 701300,4485500,1600"):
        make_scene(file, tmp_path / "refused", positions=tmp_path / "positions.csv")


def test_a_scene_folder_far_away_is_refused(tmp_path: Path) -> None:
    """One that was written by other programs."""
    folder = make_scene(write_obj(tmp_path / "room.obj", box()), tmp_path / "scene").folder
    for file in (folder / "meshes").glob("*.ply"):
        (part,) = mesh_parts(file)
        part.apply_translation([20_000, 0, 0]).export(file, vertex_normal=False)
    with pytest.raises(
        InputError, match=r"scene: coordinates up to 20006 m, .* are 0.002 m apart; .*--origin 20000,0,0"
    ):
        open_scene(folder, 2.4e9)


def test_a_plan_in_a_national_grid_is_moved_with_its_positions(tmp_path: Path) -> None:
    """Positions are in the scene's frame, and a plan that fits them better when mirrored is refused as ever."""
    outline = np.array([(0, 0), (6, 0), (6, 4), (2, 4), (2, 3), (0, 3), (0, 0)]) + GRID[:2]
    (tmp_path / "layout.csv").write_text("x,y\n" + "\n".join(f"{x:.2f},{y:.2f}" for x, y in outline) + "\n")
    assert make_scene(tmp_path / "layout.csv", tmp_path / "far", height_m=2.5).origin_m == (701_300, 4_485_500, 0)
    places = np.array([(0.5, y) for y in np.arange(0.5, 3, 0.5)] + [(x, 3.8) for x in np.arange(2.5, 6, 0.5)])
    places += GRID[:2] - LOCAL[:2]
    for name, xy in (("right.csv", places), ("mirrored.csv", places * (1, -1) + (0, 2 * 15.72))):
        (tmp_path / name).write_text("x,y\n" + "\n".join(f"{x:.2f},{y:.2f}" for x, y in xy) + "\n")
    options: dict[str, Any] = {"height_m": 2.5, "origin_m": LOCAL, "floor_m": LOCAL[2]}
    made = make_scene(tmp_path / "layout.csv", tmp_path / "scene", positions=tmp_path / "right.csv", **options)
    low = np.append(GRID[:2] - LOCAL[:2], 0)
    np.testing.assert_allclose(extent(made.folder), [low, low + np.array([6, 4, 2.5])], atol=ROUNDING_M)
    with pytest.raises(InputError, match="positions"):
        make_scene(tmp_path / "layout.csv", tmp_path / "no", positions=tmp_path / "mirrored.csv", **options)


def test_a_registration_may_bring_a_national_grid_near(tmp_path: Path) -> None:
    motion = np.eye(4)
    motion[:3, 3] = -np.array(LOCAL)
    file = write_obj(tmp_path / "utm.obj", box(ROOM, GRID))
    made = make_scene(file, tmp_path / "scene", registration=motion)
    np.testing.assert_allclose(extent(made.folder)[0], GRID - LOCAL, atol=ROUNDING_M)


@pytest.mark.parametrize("far", [0.0, 1000.0, 16_000.0])
def test_buildings_near_the_origin_pass(far: float) -> None:
    points = np.array([[far, 0, 0], [far + 300, 0, 10]])
    require_near(points, "room")
    require_precise(points.astype(np.float32).astype(float), 1.0, "room")
    require_precise(1000 * points, 0.001, "room")


def test_files_that_were_rounded_far_away_are_refused(tmp_path: Path) -> None:
    """As an origin does not bring back what they have lost."""
    points = sampled(closed_box(), 5000) + GRID
    trimesh.PointCloud(points).export(tmp_path / "scan.ply")
    np.savez(tmp_path / "scan.npz", points=points.astype(np.float32))
    np.savetxt(tmp_path / "scan.xyz", points.astype(np.float32), fmt="%.3f")
    box(ROOM, GRID).export(tmp_path / "room.stl")
    for name in ("scan.ply", "scan.npz", "scan.xyz", "room.stl"):
        with pytest.raises(InputError, match=rf"{name}: y has been rounded to steps of 0.5 m, by single precision"):
            make_scene(tmp_path / name, tmp_path / "out", origin_m=LOCAL)
    whole = np.array([[701_362.0, 4_485_513.0, 1650], [701_368.0, 4_485_518.0, 1652]])
    require_precise(whole, 1.0, "whole metres")
    require_precise(whole + 0.5, 1.0, "half metres")
    require_precise(GRID[None] * 1000, 0.001, "millimetres")
    with pytest.raises(InputError, match=r"y has been rounded to steps of 0\.51 m"):
        require_precise((GRID[None] * 1000).astype(np.float32).astype(float), 0.001, "millimetres")


def write_las(file: Path, points: np.ndarray, scale: float) -> Path:
    header = laspy.LasHeader(point_format=0, version="1.2")
    header.scales, header.offsets = np.full(3, scale), np.floor(points.min(axis=0))
    cloud = laspy.LasData(header)
    cloud.xyz = points
    cloud.write(file)
    return file


def test_coarse_steps_of_a_scan_are_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    points = sampled(closed_box(), 5000)
    with pytest.raises(
        InputError, match=r"s.las: coordinates are in steps of 0.1 m \(the scale of a LAS.*1 cm or less"
    ):
        make_scene(write_las(tmp_path / "s.las", points, 0.1), tmp_path / "out")
    np.savetxt(tmp_path / "s.xyz", points, fmt="%.1f")
    with pytest.raises(InputError, match=r"s.xyz: coordinates are in steps of 0.1 m"):
        make_scene(tmp_path / "s.xyz", tmp_path / "out")
    assert not caplog.records
    with caplog.at_level(logging.WARNING):
        require_fine(np.round(points / 0.04) * 0.04, "scan")
    assert "steps of 0.04 m" in caplog.text
    caplog.clear()
    for fine in (points, np.round(points, 2), points.astype(np.float32), points[:5]):
        require_fine(np.asarray(fine, float), "scan")
    flat = points.copy()
    flat[:, 2] = np.where(flat[:, 2] > 1, 2.5, 0)
    require_fine(flat, "floor and ceiling")
    assert not caplog.records


def test_a_table_of_points_is_told_from_a_plan(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, first in (("names.csv", "x,y,z"), ("numbers.csv", "0,0,1"), ("semicolons.csv", "X; Y; Z")):
        (tmp_path / name).write_text(f"{first}\n1,2,3\n4,5,6\n")
        status, _, err = call(["mesh", tmp_path / name, "--out", tmp_path / "scene"], capsys)
        assert status == 2
        assert f"{name}: has a column z or three numbers in a row, and a CSV is a plan of wall corners, x,y" in err
        assert "call it .xyz" in err
        assert err.count("\n") == 1


def test_meshes_without_faces_name_what_is_read_as_points(tmp_path: Path) -> None:
    (tmp_path / "points.obj").write_text("v 0 0 0\nv 1 0 0\n")
    with pytest.raises(
        InputError, match=r"points.obj: has no faces, so no surface; complete it, or give its points as"
    ):
        make_scene(tmp_path / "points.obj", tmp_path / "out")
