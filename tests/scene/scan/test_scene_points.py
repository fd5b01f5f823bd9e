"""Point clouds and bare meshes from files; `test_initial.py` has further formats and damaged files."""

from __future__ import annotations

import logging
from pathlib import Path

import laspy
import numpy as np
import pytest
import trimesh
from made_rooms import closed_box, sampled

from wrf_mi.core import InputError
from wrf_mi.scene import coordinates
from wrf_mi.scene.coordinates import check_extent, extra_package
from wrf_mi.scene.make import is_plan, make_scene
from wrf_mi.scene.mesh.files import read_mesh
from wrf_mi.scene.scan.points import read_points

POINTS = np.array([[0.5, 1.25, -2.0], [3.0, 4.5, 5.0], [6.0, -7.75, 8.0]])
GRID = np.array([500_000.0, 5_400_000.0, 120.0])
FAR = POINTS + GRID
LAS_STEP_M = 1e-3


@pytest.mark.parametrize("name", ["cloud.las", "cloud.laz"])
def test_las_keeps_millimetres_of_a_national_grid(name: str, tmp_path: Path) -> None:
    header = laspy.LasHeader(point_format=0, version="1.2")
    header.scales, header.offsets = np.full(3, LAS_STEP_M), np.floor(FAR.min(axis=0))
    cloud = laspy.LasData(header)
    cloud.xyz = FAR
    cloud.write(tmp_path / name)
    np.testing.assert_allclose(read_points(tmp_path / name), FAR, rtol=0, atol=LAS_STEP_M / 2 + 1e-9)


@pytest.mark.parametrize(
    "text",
    [
        "0.5 1.25 -2\n3 4.5 5\n6 -7.75 8\n",
        "# x y z intensity\n0.5,1.25,-2,17\n3,4.5,5,18\n6,-7.75,8,3\n",
        "\ufeff0.5\t1.25\t-2\t1 2\n3\t4.5\t5\t1 2\n6\t-7.75\t8\t1 2\n",
    ],
)
def test_text_with_spaces_commas_comments_and_further_columns(text: str, tmp_path: Path) -> None:
    (tmp_path / "cloud.txt").write_text(text, encoding="utf-8")
    np.testing.assert_array_equal(read_points(tmp_path / "cloud.txt"), POINTS)
    assert not is_plan(tmp_path / "cloud.txt")


@pytest.mark.parametrize(("units", "factor"), [("m", 1.0), ("cm", 0.01), ("mm", 0.001), ("ft", 0.3048)])
def test_units_scale_the_coordinates(units: str, factor: float, tmp_path: Path) -> None:
    np.savez(tmp_path / "cloud.npz", xyz_m=POINTS)
    np.testing.assert_allclose(read_points(tmp_path / "cloud.npz", units), POINTS * factor, rtol=1e-15)


def test_unknown_units_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"units 'inch': not known; give one of m, cm, mm, ft"):
        read_points(tmp_path / "cloud.npz", "inch")


@pytest.mark.parametrize(
    ("factor", "message"),
    [
        (1000.0, r"extent .* looks like millimetres; give --units mm"),
        (100.0, r"extent .* looks like centimetres; give --units cm"),
        (0.001, r"is too small for a room; give its --units"),
    ],
)
def test_coordinates_that_are_not_metres_are_refused(factor: float, message: str) -> None:
    with pytest.raises(InputError, match=message):
        check_extent(sampled(closed_box(), 1000) * factor, "scan.ply")


def test_metres_far_from_the_origin_pass_with_one_stray_but_not_with_many() -> None:
    points = sampled(closed_box(), 1000) + GRID
    points[0] += 5000.0
    check_extent(points, "scan.ply")
    points[:100] += 5000.0
    with pytest.raises(InputError, match="give --units mm"):
        check_extent(points, "scan.ply")


@pytest.mark.parametrize(
    ("name", "arrays", "plan"),
    [
        ("a.npz", {"xyz_m": POINTS}, False),
        ("a.npz", {"xy_m": POINTS[:, :2]}, True),
        ("a.npz", {"log_odds": POINTS}, True),
        ("a.png", None, True),
        ("a.csv", None, True),
        ("a.las", None, False),
    ],
)
def test_plans_and_scans_are_distinguished(
    name: str, arrays: dict[str, np.ndarray] | None, plan: bool, tmp_path: Path
) -> None:
    if arrays:
        np.savez(tmp_path / name, **arrays)
    assert is_plan(tmp_path / name) is plan


def test_options_that_do_not_fit_the_source(tmp_path: Path) -> None:
    np.savez(tmp_path / "plan.npz", xy_m=POINTS[:, :2])
    np.savez(tmp_path / "scan.npz", points=POINTS)
    out = tmp_path / "out"
    with pytest.raises(InputError, match=r"a plan has no heights; .*--height"):
        make_scene(tmp_path / "plan.npz", out)
    with pytest.raises(InputError, match=r"a plan is in metres"):
        make_scene(tmp_path / "plan.npz", out, height_m=2.5, units="mm")
    with pytest.raises(InputError, match=r"leave out --height, --floor, --resolution and --row-0"):
        make_scene(tmp_path / "scan.npz", out, height_m=2.5)
    with pytest.raises(InputError, match=r"registration: not rigid"):
        make_scene(tmp_path / "scan.npz", out, registration=np.diag([2.0, 2.0, 2.0, 1.0]))
    with pytest.raises(InputError, match=r"registration: give a 4 x 4 matrix"):
        make_scene(tmp_path / "scan.npz", out, registration=np.eye(3))
    (out / "mine").mkdir(parents=True)
    with pytest.raises(InputError, match=r"exists; remove it"):
        make_scene(tmp_path / "scan.npz", out)
    assert [path.name for path in out.iterdir()] == ["mine"]


def test_degenerate_and_doubled_faces_are_dropped(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    box = trimesh.creation.box((2.0, 3.0, 2.5))
    faces = np.concatenate([box.faces[:, ::-1], box.faces[:2], [[0, 0, 1]]])  # inverted, doubled, degenerate
    trimesh.Trimesh(box.vertices, faces, process=False).export(tmp_path / "room.stl")
    with caplog.at_level(logging.WARNING):
        (surface,) = read_mesh(tmp_path / "room.stl")
    assert len(surface.faces) == 12
    assert surface.mesh.area == pytest.approx(box.area, rel=1e-6)
    assert [record.getMessage().split(": ")[1] for record in caplog.records] == [
        "1 degenerate faces of mesh left out",
        "2 doubled faces of mesh left out",
    ]


def test_unusable_meshes_are_refused(tmp_path: Path) -> None:
    box = trimesh.creation.box((2000.0, 3000.0, 2500.0))
    box.export(tmp_path / "mm.stl")
    with pytest.raises(InputError, match=r"mm.stl: .* looks like millimetres; give --units mm"):
        read_mesh(tmp_path / "mm.stl")
    assert read_mesh(tmp_path / "mm.stl", "mm")[0].mesh.area == pytest.approx(box.area * 1e-6, rel=1e-6)
    trimesh.PointCloud(POINTS).export(tmp_path / "points.ply")
    with pytest.raises(InputError, match=r"points.ply: has no faces, so no surface; make a scene of points"):
        read_mesh(tmp_path / "points.ply")
    trimesh.Trimesh(POINTS, [[0, 0, 1]], process=False).export(tmp_path / "line.obj")
    with pytest.raises(InputError, match=r"line.obj: every face is degenerate"):
        read_mesh(tmp_path / "line.obj")
    bad = box.copy()
    bad.vertices[3] = np.nan
    bad.export(tmp_path / "nan.obj")
    with pytest.raises(InputError, match=r"nan.obj: vertex 4 of mesh is not finite"):
        read_mesh(tmp_path / "nan.obj")
    (tmp_path / "junk.glb").write_bytes(b"junk")
    with pytest.raises(InputError, match=r"junk.glb: cannot be read as a mesh"):
        read_mesh(tmp_path / "junk.glb")
    with pytest.raises(InputError, match=r"none.stl: no such file"):
        read_mesh(tmp_path / "none.stl")


def test_missing_package_and_missing_library_have_their_own_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise ModuleNotFoundError(f"No module named {name!r}")

    monkeypatch.setattr(coordinates, "import_module", missing)
    for name, extra in coordinates.EXTRAS.items():
        with pytest.raises(InputError, match=rf"need {name}: pip install 'wrf-mi\[{extra}\]'"):
            extra_package(name)

    def unlinked(name: str) -> None:
        raise ImportError("libusb-1.0.so.0: cannot open shared object file")

    monkeypatch.setattr(coordinates, "import_module", unlinked)
    with pytest.raises(InputError, match=r"open3d cannot be loaded \(libusb.*apt-get install libusb-1.0-0") as caught:
        extra_package("open3d")
    assert "\n" not in str(caught.value)
