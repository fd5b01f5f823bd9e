"""One scan in every format, places of scanners, and files that are damaged or state more than they hold."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import laspy
import numpy as np
import open3d
import pye57
import pytest
import trimesh
from calling import call
from made_rooms import by_kind, closed_box, sampled

from wrf_mi.core import InputError
from wrf_mi.scene.coordinates import Y_UP
from wrf_mi.scene.make import make_scene
from wrf_mi.scene.mesh.surfaces import Surface
from wrf_mi.scene.scan.cloud import surfaces_from_points
from wrf_mi.scene.scan.points import read_scan

STEP_M = 1e-3
"""Coordinates are multiples of a millimetre: the scale of the LAZ, and the digits of the texts."""
ROUNDING_M = 1e-6  # of single precision and of poses
PLACES = np.array([[1.5, 1.25, 1.3], [3.5, 2.75, 1.4]])
TURNS = (0.5, -2.0)
ALIKE_M = 2e-3  # corners of planes fitted to points that are equal but for rounding, in another order


@pytest.fixture(scope="module")
def points() -> np.ndarray:
    return np.round(sampled(closed_box(), 12_000) / STEP_M) * STEP_M


def halves(points: np.ndarray) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Points in the frames of two scanners, and each frame's axes (columns) and place."""
    parts = []
    for part, place, turn in zip(np.array_split(points, 2), PLACES, TURNS, strict=True):
        axes = trimesh.transformations.rotation_matrix(turn, (0, 0, 1))[:3, :3]
        parts.append(((part - place) @ axes, axes, place))
    return parts


def write_pcd(file: Path, points: np.ndarray) -> None:
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    kind = file.stem
    open3d.io.write_point_cloud(str(file), cloud, write_ascii=kind == "ascii", compressed=kind == "compressed")


def write_e57(file: Path, points: np.ndarray) -> None:
    """Two scans with poses; the second has an invalid point."""
    source = pye57.E57(str(file), mode="w")
    for k, (part, axes, place) in enumerate(halves(points)):
        rotation = trimesh.transformations.quaternion_from_matrix(np.block([[axes, np.zeros((3, 1))], [0, 0, 0, 1]]))
        rows = np.concatenate([part, [[99.0, 0, 0]]]) if k else part
        columns = {f"cartesian{axis}": rows[:, i] for i, axis in enumerate("XYZ")}
        invalid = {"cartesianInvalidState": (np.arange(len(rows)) >= len(part)).astype(np.int8)} if k else {}
        source.write_scan_raw({**columns, **invalid}, rotation=rotation, translation=place)
    source.close()


def write_ptx(file: Path, points: np.ndarray) -> None:
    """Two scans; a direction of each has no return."""
    lines = list[str]()
    for part, axes, place in halves(points):
        lines += [str(len(part) + 1), "1", *(" ".join(map(repr, row)) for row in [place.tolist(), *axes.T.tolist()])]
        pose = np.eye(4)
        pose[:3, :3], pose[3, :3] = axes.T, place
        lines += [" ".join(map(repr, row)) for row in pose.tolist()]
        lines += ["0 0 0 0.5", *(f"{x:.7f} {y:.7f} {z:.7f} 0.25 1 2 3" for x, y, z in part)]
    file.write_text("\n".join(lines) + "\n")


def write_pts(file: Path, points: np.ndarray) -> None:
    """Two scans, one after the other."""
    blocks = [
        [str(len(part)), *(f"{x:.3f} {y:.3f} {z:.3f} -1020" for x, y, z in part)] for part in np.array_split(points, 2)
    ]
    file.write_text("\n".join(line for block in blocks for line in block) + "\n")


def write_laz(file: Path, points: np.ndarray) -> None:
    header = laspy.LasHeader(point_format=0, version="1.2")
    header.scales = np.full(3, STEP_M)
    cloud = laspy.LasData(header)
    cloud.xyz = points
    cloud.write(file)


WRITERS: dict[str, Callable[[Path, np.ndarray], object]] = {
    **dict.fromkeys(("ascii.pcd", "binary.pcd", "compressed.pcd"), write_pcd),
    **{"scan.e57": write_e57, "scan.ptx": write_ptx, "scan.pts": write_pts, "scan.laz": write_laz},
    "scan.ply": lambda file, points: trimesh.PointCloud(points).export(file),
    "scan.xyz": lambda file, points: np.savetxt(file, points, fmt="%.3f"),
}
POSED = ("scan.e57", "scan.ptx")


def sorted_rows(points: np.ndarray) -> np.ndarray:
    return points[np.lexsort(np.round(points / STEP_M).T)]


@pytest.mark.parametrize("name", WRITERS)
def test_every_format_has_the_same_points_and_the_places_of_its_scanners(
    name: str, points: np.ndarray, tmp_path: Path
) -> None:
    WRITERS[name](tmp_path / name, points)
    scan = read_scan([tmp_path / name])
    np.testing.assert_allclose(sorted_rows(scan.points_m), sorted_rows(points), atol=ROUNDING_M)
    if name in POSED:
        np.testing.assert_allclose(scan.viewpoints_m, PLACES, atol=ROUNDING_M)
        assert np.bincount(scan.viewpoint).tolist() == [len(part) for part in np.array_split(points, 2)]
        turned = read_scan([tmp_path / name], units="cm", up="y")
        np.testing.assert_allclose(turned.points_m, scan.points_m @ Y_UP[:3, :3] / 100, atol=ROUNDING_M)
        np.testing.assert_allclose(turned.viewpoints_m, PLACES @ Y_UP[:3, :3] / 100, atol=ROUNDING_M)


@pytest.fixture(scope="module")
def expected(points: np.ndarray) -> list[Surface]:
    return surfaces_from_points(points)


@pytest.mark.parametrize("name", ["compressed.pcd", "scan.e57", "scan.ptx", "scan.laz"])
def test_every_format_gives_the_same_scene(
    name: str, points: np.ndarray, expected: list[Surface], tmp_path: Path
) -> None:
    WRITERS[name](tmp_path / name, points)
    scan = read_scan([tmp_path / name])
    surfaces = surfaces_from_points(scan.points_m, scan.viewpoints_m, scan.viewpoint)
    assert [s.kind for s in surfaces] == [s.kind for s in expected] == ["floor", "ceiling", *["wall"] * 4]
    for kind, alike in by_kind(expected).items():
        corners = [np.concatenate([s.vertices_m for s in group]) for group in (alike, by_kind(surfaces)[kind]) if group]
        if corners:
            nearest = np.linalg.norm(corners[0][:, None] - corners[1], axis=-1)
            assert max(nearest.min(axis=0).max(), nearest.min(axis=1).max()) < ALIKE_M, kind


def test_files_of_one_place_make_one_scene(
    points: np.ndarray, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = []
    for k, part in enumerate(np.array_split(points, 2)):
        files.append(tmp_path / f"part_{k}.xyz")
        np.savetxt(files[-1], part, fmt="%.3f")
    status, out, err = call(["mesh", *files, "--out", tmp_path / "scene"], capsys)
    assert (status, err) == (0, "")
    assert out.startswith("1 floor, 1 ceiling, 4 wall, 0 other")
    closed_box()[0].export(tmp_path / "box.stl")
    status, _, err = call(["mesh", *files, tmp_path / "box.stl", "--out", tmp_path / "two"], capsys)
    assert (status, err.count("\n")) == (2, 1)
    assert "box.stl: several files are scans of one place" in err


@pytest.mark.parametrize("name", WRITERS)
def test_files_that_are_cut_off_or_damaged_are_refused_in_one_line(
    name: str, points: np.ndarray, tmp_path: Path
) -> None:
    WRITERS[name](tmp_path / name, points[:500])
    content = (tmp_path / name).read_bytes()
    if name != "scan.xyz":  # whose lines are as good without the others
        (tmp_path / name).write_bytes(content[: len(content) * 2 // 3])
        with pytest.raises(InputError, match=name) as caught:
            read_scan([tmp_path / name])
        assert "\n" not in str(caught.value)
    (tmp_path / name).write_bytes(b"")
    with pytest.raises(InputError, match=name):
        read_scan([tmp_path / name])


@pytest.mark.parametrize("name", ["ascii.pcd", "binary.pcd", "compressed.pcd", "scan.pts", "scan.ptx"])
def test_more_points_than_a_file_can_hold_are_refused_before_they_are_read(
    name: str, points: np.ndarray, tmp_path: Path
) -> None:
    WRITERS[name](tmp_path / name, points[:500])
    head, end, body = (tmp_path / name).read_bytes().partition(b"DATA" if name.endswith("pcd") else b"\n")
    stated = head.replace(b"500", b"1000000000000") if end == b"DATA" else b"1000000000000"
    (tmp_path / name).write_bytes(stated + end + body)
    with pytest.raises(InputError, match=r"states 1000000000000 points, and has \d+ bytes"):
        read_scan([tmp_path / name])


def test_places_without_a_return_in_a_pcd_are_no_points(points: np.ndarray, tmp_path: Path) -> None:
    rows = points[:100].copy()
    rows[::4] = np.nan
    lines = [f"{x} {y} {z}" for x, y, z in rows]
    header = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 10\nHEIGHT 10\n"
    text = f"# .PCD\n{header}VIEWPOINT 1 2 1.5 1 0 0 0\nPOINTS 100\nDATA ascii\n" + "\n".join(lines) + "\n"
    (tmp_path / "grid.pcd").write_text(text)
    scan = read_scan([tmp_path / "grid.pcd"])
    np.testing.assert_allclose(scan.points_m, points[:100][np.arange(100) % 4 > 0], atol=ROUNDING_M)
    np.testing.assert_allclose(scan.viewpoints_m, [[1, 2, 1.5]])


PCD_HEADER = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 0\nHEIGHT 1\nPOINTS 0\nDATA ascii\n"


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("header.pcd", PCD_HEADER, "no points in it"),
        ("comment.xyz", "# x y z\n", "no points in it"),
        ("rows.pts", "1.5 2.5 0.5\n1.5 2.5 0.6\n", "call it .xyz"),
        ("blank.pts", f"1\n{9 * ' '}\n", "states 1 points and ends after 0"),
    ],
)
def test_texts_without_rows_or_their_number_are_refused_without_warnings_of_numpy(
    name: str, text: str, message: str, tmp_path: Path
) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=rf"{name}: .*{message}"):
        read_scan([tmp_path / name])


def test_scan_without_planes_is_refused_by_name(tmp_path: Path) -> None:
    np.savetxt(tmp_path / "noise.xyz", np.random.default_rng(1).uniform(0, 5, (200, 3)))
    with pytest.raises(InputError, match=r"noise\.xyz: no plane was found in 200 points"):
        make_scene(tmp_path / "noise.xyz", tmp_path / "scene")


def test_planes_that_make_no_room_are_warned_of(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    rng = np.random.default_rng(1)
    slope = rng.uniform(0, 3, (6000, 3))
    slope[:, 2] = 0.9 * slope[:, 0] + rng.normal(0, 0.003, len(slope))
    np.savetxt(tmp_path / "slope.xyz", slope)
    make_scene(tmp_path / "slope.xyz", tmp_path / "scene", up="z")
    assert "slope.xyz: no floor, ceiling or wall" in caplog.text


TEXTS = (
    *("//X Y Z\n1 2 3\n", "//X,Y,Z\n1,2,3\n", "# made by, hand\n1 2 3\n", "1;2;3;0,5\n", "x y z i\n1 2 3 9\n"),
    *('"X","Y","Z"\n1,2,3\n', "time;Z;X;Y\n0;3,0;1,0;2,0\n", "\ufeffx\ty\tz\n1\t2\t3\n"),
)


@pytest.mark.parametrize("text", TEXTS)
def test_names_of_columns_are_no_points(text: str, tmp_path: Path) -> None:
    (tmp_path / "scan.xyz").write_text(text)
    assert read_scan([tmp_path / "scan.xyz"]).points_m.tolist() == [[1, 2, 3]]
