"""Point clouds and bare meshes from files, units in LAS, damage; `test_initial.py` has other formats."""

import importlib
import logging
from pathlib import Path

import numpy as np
import open3d
import pye57
import pytest
import trimesh
from calling import call, refused
from laspy.vlrs.known import GeoKeyDirectoryVlr, GeoKeyEntryStruct, WktCoordinateSystemVlr
from made_rooms import by_kind, closed_box, sampled, write_las

from wrf_mi.apps.checking import check_scene
from wrf_mi.core import InputError
from wrf_mi.core.array_files import write_arrays
from wrf_mi.scene import coordinates
from wrf_mi.scene.coordinates import Y_UP, check_extent, extra_package
from wrf_mi.scene.make import is_plan, make_scene
from wrf_mi.scene.mesh.files import read_mesh
from wrf_mi.scene.scan.cloud import surfaces_from_points
from wrf_mi.scene.scan.las_units import stated_units
from wrf_mi.scene.scan.points import read_points, read_scan

POINTS = np.array([[0.5, 1.25, -2.0], [3.0, 4.5, 5.0], [6.0, -7.75, 8.0]])
GRID = np.array([500_000.0, 5_400_000.0, 120.0])
FAR = POINTS + GRID


@pytest.mark.parametrize(
    "text",
    [
        "0.5 1.25 -2\n3 4.5 5\n6 -7.75 8\n",
        "# x y z intensity\n0.5,1.25,-2,17\n3,4.5,5,18\n6,-7.75,8,3\n",
        "\ufeff0.5\t1.25\t-2\t1 2\n3\t4.5\t5\t1 2\n6\t-7.75\t8\t1 2\n",
    ],
)
def test_text_with_spaces_commas_comments_and_further_columns(text, tmp_path):
    (tmp_path / "cloud.txt").write_text(text, encoding="utf-8")
    np.testing.assert_array_equal(read_points(tmp_path / "cloud.txt"), POINTS)
    assert not is_plan(tmp_path / "cloud.txt")


NAMED_COLUMNS = (
    *("//X Y Z\n1 2 3\n", "//X,Y,Z\n1,2,3\n", "# made by, hand\n1 2 3\n", "1;2;3;0,5\n", "x y z i\n1 2 3 9\n"),
    *("# class x y z\n11 1 2 3\n", "//R G B X Y Z\n9 8 7 1 2 3\n", "# fields: i, X[m], Y[m], Z[m]\n7,1,2,3\n"),
    *("# x, y and z in metres\n1 2 3\n", "#t;Z(m);X(m);Y(m)\n0;3,0;1,0;2,0\n", "# class x y z in metres\n5 1 2 3\n"),
    *('"X","Y","Z"\n1,2,3\n', "time;Z;X;Y\n0;3,0;1,0;2,0\n", "\ufeffx\ty\tz\n1\t2\t3\n"),
)


@pytest.mark.parametrize("text", NAMED_COLUMNS)
def test_names_of_columns_are_no_points(text, tmp_path):
    (tmp_path / "scan.xyz").write_text(text)
    assert read_scan([tmp_path / "scan.xyz"]).points_m.tolist() == [[1, 2, 3]]


def test_units_scale_the_coordinates_and_las_keeps_millimetres_of_a_national_grid(tmp_path):
    np.savez(tmp_path / "cloud.npz", xyz_m=POINTS)
    for units, factor in (("m", 1.0), ("cm", 0.01), ("mm", 0.001), ("ft", 0.3048)):
        np.testing.assert_allclose(read_points(tmp_path / "cloud.npz", units), POINTS * factor, rtol=1e-15)
    with pytest.raises(InputError, match=r"units 'inch': not known; give one of m, dm, cm, mm, ft, in"):
        read_points(tmp_path / "cloud.npz", "inch")
    for name in ("cloud.las", "cloud.laz"):
        write_las(tmp_path / name, FAR, 1e-3)
        np.testing.assert_allclose(read_points(tmp_path / name), FAR, rtol=0, atol=0.5e-3 + 1e-9)


def test_coordinates_that_are_not_metres_are_refused():
    """Metres far from the origin pass with one stray, but not with many."""
    points = sampled(closed_box(), 1000)
    stray, many = (points + GRID + 5000.0 * (np.arange(len(points)) < count)[:, None] for count in (1, 100))
    check_extent(stray, "scan.ply")
    for wrong, message in (
        (1000.0 * points, r"extent .* looks like millimetres; give --units mm"),
        (100.0 * points, r"extent .* looks like centimetres; give --units cm"),
        (0.001 * points, r"is too small for a room; give its --units"),
        (many, "give --units mm"),
    ):
        with pytest.raises(InputError, match=message):
            check_extent(wrong, "scan.ply")


def test_plans_and_scans_are_distinguished(tmp_path):
    for arrays, plan in (({"xyz_m": POINTS}, False), ({"xy_m": POINTS[:, :2]}, True), ({"log_odds": POINTS}, True)):
        write_arrays(tmp_path / "a.npz", arrays)
        assert is_plan(tmp_path / "a.npz") is plan
    assert [is_plan(tmp_path / name) for name in ("a.png", "a.csv", "a.las")] == [True, True, False]


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("plan.csv", {}, "a plan has no heights; .*--wall-height"),
        ("plan.csv", {"height_m": 2.5, "units": "mm"}, "other plans are in metres"),
        ("plan.csv", {"height_m": 2.5, "up": "z"}, "a plan; leave out --up, which is for scans and meshes"),
        ("plan.csv", {"height_m": 2.5, "extent_m": (6, 5)}, "--extent is for plans in longitude and latitude"),
        ("scan.npz", {"height_m": 2.5}, "leave out the options of plans, from --wall-height to --level"),
        ("scan.npz", {"registration": np.diag([2.0, 2.0, 2.0, 1.0])}, "registration: not rigid"),
        ("scan.npz", {"registration": np.eye(3)}, "registration: give a 4 x 4 matrix"),
        ("scan.npz", {"up": "x"}, "give y or z"),
        ("scan.npz", {"origin_m": (1, 2)}, "give three finite numbers"),
        ("scan.npz", {"origin_m": (1, 2, np.nan)}, "three finite"),
    ],
)
def test_options_that_do_not_fit_the_source_are_refused(name, options, message, tmp_path):
    (tmp_path / "plan.csv").write_text("x,y\n0,0\n5,0\n5,4\n0,0\n")
    np.savez(tmp_path / "scan.npz", points=POINTS)
    with pytest.raises(InputError, match=message):
        make_scene(tmp_path / name, tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


def test_an_existing_folder_stays(tmp_path):
    (tmp_path / "out" / "mine").mkdir(parents=True)
    with pytest.raises(InputError, match=r"exists; remove it"):
        make_scene(tmp_path / "scan.npz", tmp_path / "out")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["mine"]


def test_degenerate_and_doubled_faces_are_dropped(tmp_path, caplog):
    box = trimesh.creation.box((2.0, 3.0, 2.5))
    faces = np.concatenate([box.faces[:, ::-1], box.faces[:2], [[0, 0, 1]]])  # inverted, doubled, degenerate
    trimesh.Trimesh(box.vertices, faces, process=False).export(tmp_path / "room.stl")
    with caplog.at_level(logging.WARNING):
        (surface,) = read_mesh(tmp_path / "room.stl")
    assert len(surface.faces) == 12
    assert surface.mesh.area == pytest.approx(box.area, rel=1e-6)
    messages = [record.getMessage().split(": ")[1] for record in caplog.records]
    assert messages == ["1 degenerate faces of mesh left out", "2 doubled faces of mesh left out"]


def test_unusable_meshes_are_refused(tmp_path):
    box = trimesh.creation.box((2000.0, 3000.0, 2500.0))
    box.export(tmp_path / "mm.stl")
    assert read_mesh(tmp_path / "mm.stl", "mm")[0].mesh.area == pytest.approx(box.area * 1e-6, rel=1e-6)
    trimesh.PointCloud(POINTS).export(tmp_path / "points.ply")
    trimesh.Trimesh(POINTS, [[0, 0, 1]], process=False).export(tmp_path / "line.obj")
    box.vertices[3] = np.nan
    box.export(tmp_path / "nan.obj")
    (tmp_path / "junk.glb").write_bytes(b"junk")
    for message in (
        "mm.stl: .* looks like millimetres; give --units mm",
        "points.ply: has no faces, so no surface; make a scene of points",
        "line.obj: every face is degenerate",
        "nan.obj: vertex 4 of mesh is not finite",
        "junk.glb: cannot be read as a mesh",
        "none.stl: no such file",
    ):
        with pytest.raises(InputError, match=message):
            read_mesh(tmp_path / message.partition(":")[0])


def test_missing_package_and_missing_library_have_their_own_remedy(monkeypatch):
    def failing(error):
        def import_module(name):
            raise error

        monkeypatch.setattr(coordinates, "import_module", import_module)

    assert coordinates.import_module is importlib.import_module
    failing(ModuleNotFoundError("No module named 'any'"))
    for name, extra in coordinates.EXTRAS.items():
        with pytest.raises(InputError, match=rf"need {name}: pip install '\.\[{extra}\]'"):
            extra_package(name)
    with pytest.raises(InputError, match=r"need open3d: pip install '\.\[lidar\]'"):
        surfaces_from_points(np.zeros((100, 3)))
    failing(ImportError("libusb-1.0.so.0: cannot open shared object file"))
    with pytest.raises(InputError, match=r"open3d cannot be loaded \(libusb.*apt-get install libusb-1.0-0") as caught:
        extra_package("open3d")
    assert "\n" not in str(caught.value)


FOOT_M = 0.3048
GEOGRAPHIC = 'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.25]],UNIT["degree",0.0174532925]]'
METRES = f'PROJCS["UTM",{GEOGRAPHIC},PROJECTION["Transverse_Mercator"],UNIT["metre",1]]'
FEET = METRES.replace('UNIT["metre",1]', 'UNIT["US survey foot",0.3048006096]')
HEIGHTS = 'VERT_CS["NAVD88",VERT_DATUM["NAVD88",2005],UNIT["US survey foot",0.3048006096]]'
METRES_2 = (
    'PROJCRS["UTM",BASEGEOGCRS["WGS 84",DATUM["WGS 84",ELLIPSOID["WGS 84",6378137,298.25,LENGTHUNIT["metre",1]]]],'
    'CONVERSION["UTM",METHOD["Transverse Mercator"],PARAMETER["False easting",0,LENGTHUNIT["metre",1]]],'
    'CS[Cartesian,2],AXIS["x",east],AXIS["y",north],LENGTHUNIT["metre",1]]'
)


def write_las_in(file, points, system):
    """Points with a coordinate system in well-known text, or in codes by number of the key."""
    records = [WktCoordinateSystemVlr(system)] if isinstance(system, str) else []
    if isinstance(system, dict):
        keys = GeoKeyDirectoryVlr()
        keys.geo_keys = [GeoKeyEntryStruct(key, 0, 1, code) for key, code in system.items()]
        keys.geo_keys_header.number_of_keys = len(system)
        records.append(keys)
    return write_las(file, points, 1e-4, records, point_format=6, version="1.4")


@pytest.mark.parametrize(
    ("system", "units"),
    [
        (None, []),
        (METRES, ["m"]),
        (METRES_2, ["m"]),
        (METRES_2.replace("metre", "US survey foot"), ["ft"]),
        (FEET, ["ft"]),
        (f'COMPD_CS["both",{FEET},{HEIGHTS}]', ["ft"]),
        (f'COMPD_CS["both",{METRES},{HEIGHTS}]', ["m", "ft"]),
        (GEOGRAPHIC, ["degrees"]),
        (f'COMPD_CS["both",{GEOGRAPHIC},{HEIGHTS}]', ["degrees", "ft"]),
        ({1024: 1, 3076: 9001}, ["m"]),
        ({1024: 1, 3076: 9002, 4099: 9003}, ["ft"]),
        ({1024: 2, 4099: 9001}, ["degrees", "m"]),
        ({1024: 1, 3072: 25832}, ["m"]),
        ({1024: 1, 3072: 2263}, ["ft"]),
        ("PROJCS[", []),
    ],
)
def test_units_are_those_of_easting_and_of_height(system, units, tmp_path):
    assert stated_units(write_las_in(tmp_path / "scan.las", np.eye(3), system)) == units


def test_scan_in_feet_is_refused_until_its_unit_is_given_and_one_of_two_units_is(tmp_path):
    points = sampled(closed_box(), 12_000)
    file = write_las_in(tmp_path / "feet.laz", points / FOOT_M, FEET)
    both = write_las_in(tmp_path / "both.las", points[:2000], f'COMPD_CS["both",{METRES},{HEIGHTS}]')
    for scan, message in (
        (file, r"feet\.laz: its coordinate system is in ft; state --units ft"),
        (both, "is in m and heights in ft; export it in a projected"),
    ):
        with pytest.raises(InputError, match=message):
            make_scene(scan, tmp_path / "scene")
    text = [finding.text for finding in check_scene(both).findings if finding.kind == "stated-units"]
    assert text == ["its coordinate system is in m and heights in ft, and is read in m"]
    assert "stated-units" in {finding.kind for finding in check_scene(file).of_level("warning")}
    assert "stated-units" not in {finding.kind for finding in check_scene(file, units="ft").findings}
    new_scene = make_scene(file, tmp_path / "scene", units="ft")
    vertices_m = [trimesh.load_mesh(mesh).vertices for mesh in (new_scene.folder / "meshes").iterdir()]
    size = np.ptp(np.concatenate(vertices_m), axis=0)
    np.testing.assert_allclose(size, trimesh.util.concatenate(closed_box()).extents, atol=0.02)


STEP_M = 1e-3
"""Coordinates are multiples of a millimetre: the scale of the LAZ, and the digits of the texts."""
ROUNDING_M = 1e-6  # of single precision and of poses
PLACES = np.array([[1.5, 1.25, 1.3], [3.5, 2.75, 1.4]])
TURNS = (0.5, -2.0)


@pytest.fixture(scope="module")
def points():
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
    open3d.io.write_point_cloud(file, cloud, write_ascii=kind == "ascii", compressed=kind == "compressed")


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


def write_ptx(file, points):
    """Two scans; a direction of each has no return."""
    lines = []
    for part, axes, place in halves(points):
        pose = np.eye(4)
        pose[:3, :3], pose[3, :3] = axes.T, place
        lines += [str(len(part) + 1), "1"]
        lines += [" ".join(map(repr, row)) for row in [place.tolist(), *axes.T.tolist(), *pose.tolist()]]
        lines += ["0 0 0 0.5", *(f"{x:.7f} {y:.7f} {z:.7f} 0.25 1 2 3" for x, y, z in part)]
    file.write_text("\n".join(lines) + "\n")


def write_pts(file, points):
    """Two scans, one after the other."""
    lines = []
    for part in np.array_split(points, 2):
        lines += [str(len(part)), *(f"{x:.3f} {y:.3f} {z:.3f} -1020" for x, y, z in part)]
    file.write_text("\n".join(lines) + "\n")


WRITERS = {
    **dict.fromkeys(("ascii.pcd", "binary.pcd", "compressed.pcd"), write_pcd),
    **{"scan.e57": write_e57, "scan.ptx": write_ptx, "scan.pts": write_pts},
    "scan.laz": lambda file, points: write_las(file, points, STEP_M),
    "scan.ply": lambda file, points: trimesh.PointCloud(points).export(file),
    "scan.xyz": lambda file, points: np.savetxt(file, points, fmt="%.3f"),
}


@pytest.mark.parametrize("name", WRITERS)
def test_every_format_has_the_same_points_and_the_places_of_its_scanners(name, points, tmp_path):
    WRITERS[name](tmp_path / name, points)
    scan = read_scan([tmp_path / name])
    read, written = (rows[np.lexsort(np.round(rows / STEP_M).T)] for rows in (scan.points_m, points))
    np.testing.assert_allclose(read, written, atol=ROUNDING_M)
    if name in ("scan.e57", "scan.ptx"):
        np.testing.assert_allclose(scan.viewpoints_m, PLACES, atol=ROUNDING_M)
        assert np.bincount(scan.viewpoint).tolist() == [len(part) for part in np.array_split(points, 2)]
        turned = read_scan([tmp_path / name], units="cm", up="y")
        np.testing.assert_allclose(turned.points_m, scan.points_m @ Y_UP[:3, :3] / 100, atol=ROUNDING_M)
        np.testing.assert_allclose(turned.viewpoints_m, PLACES @ Y_UP[:3, :3] / 100, atol=ROUNDING_M)


def test_files_of_one_place_make_one_scene(points, tmp_path, capsys):
    files = [tmp_path / f"part_{k}.xyz" for k in range(2)]
    for file, part in zip(files, np.array_split(points, 2), strict=True):
        np.savetxt(file, part, fmt="%.3f")
    status, out, err = call(["mesh", *files, "--out", tmp_path / "scene"], capsys)
    assert (status, err) == (0, "")
    assert out.startswith("1 floor, 1 ceiling, 4 wall, 0 other")
    closed_box()[0].export(tmp_path / "box.stl")
    both = ["mesh", *files, tmp_path / "box.stl", "--out", tmp_path / "two"]
    refused(both, "box.stl: several files are scans of one place", capsys)


@pytest.mark.parametrize("name", WRITERS)
def test_files_that_are_cut_off_or_damaged_are_refused_in_one_line(name, points, tmp_path):
    WRITERS[name](tmp_path / name, points[:500])
    content = (tmp_path / name).read_bytes()
    cut = len(content) * 2 // 3 if name != "scan.xyz" else 0  # whose lines are as good without the others
    for length in {cut, 0}:
        (tmp_path / name).write_bytes(content[:length])
        with pytest.raises(InputError, match=name) as caught:
            read_scan([tmp_path / name])
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["ascii.pcd", "binary.pcd", "compressed.pcd", "scan.pts", "scan.ptx"])
def test_more_points_than_a_file_can_hold_are_refused_before_they_are_read(name, points, tmp_path):
    WRITERS[name](tmp_path / name, points[:500])
    head, end, body = (tmp_path / name).read_bytes().partition(b"DATA" if name.endswith("pcd") else b"\n")
    false_count = head.replace(b"500", b"1000000000000") if end == b"DATA" else b"1000000000000"
    (tmp_path / name).write_bytes(false_count + end + body)
    with pytest.raises(InputError, match=r"states 1000000000000 points, and has \d+ bytes"):
        read_scan([tmp_path / name])


def test_places_without_a_return_in_a_pcd_are_no_points(points, tmp_path):
    rows = points[:100].copy()
    rows[::4] = np.nan
    lines = [f"{x} {y} {z}" for x, y, z in rows]
    header = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 10\nHEIGHT 10\n"
    text = f"# .PCD\n{header}VIEWPOINT 1 2 1.5 1 0 0 0\nPOINTS 100\nDATA ascii\n" + "\n".join(lines) + "\n"
    (tmp_path / "grid.pcd").write_text(text)
    scan = read_scan([tmp_path / "grid.pcd"])
    np.testing.assert_allclose(scan.points_m, points[:100][np.arange(100) % 4 > 0], atol=ROUNDING_M)
    np.testing.assert_allclose(scan.viewpoints_m, [[1, 2, 1.5]])


def test_texts_without_rows_or_their_number_are_refused_without_warnings_of_numpy(tmp_path):
    header = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 0\nHEIGHT 1\nPOINTS 0\nDATA ascii\n"
    for name, text, message in (
        ("header.pcd", header, "no points in it"),
        ("comment.xyz", "# x y z\n", "no points in it"),
        ("rows.pts", "1.5 2.5 0.5\n1.5 2.5 0.6\n", "call it .xyz"),
        ("blank.pts", f"1\n{9 * ' '}\n", "states 1 points and ends after 0"),
    ):
        (tmp_path / name).write_text(text)
        with pytest.raises(InputError, match=rf"{name}: .*{message}"):
            read_scan([tmp_path / name])


def test_scans_without_planes_are_refused_and_those_of_no_room_warned_of(tmp_path, caplog):
    np.savetxt(tmp_path / "noise.xyz", np.random.default_rng(1).uniform(0, 5, (200, 3)))
    with pytest.raises(InputError, match=r"noise\.xyz: no plane was found in 200 points"):
        make_scene(tmp_path / "noise.xyz", tmp_path / "scene")
    rng = np.random.default_rng(1)
    slope = rng.uniform(0, 3, (6000, 3))
    slope[:, 2] = 0.9 * slope[:, 0] + rng.normal(0, 0.003, len(slope))
    np.savetxt(tmp_path / "slope.xyz", slope)
    make_scene(tmp_path / "slope.xyz", tmp_path / "scene", up="z")
    assert "slope.xyz: no floor, ceiling or wall" in caplog.text


ALIKE_M = 2e-3  # corners of planes fitted to points that are equal but for rounding, in another order


def test_scans_with_and_without_places_of_scanners_give_the_same_scene(points, tmp_path):
    """Of equal points in another order, see the test above for the other formats."""
    write_e57(tmp_path / "scan.e57", points)
    scan = read_scan([tmp_path / "scan.e57"])
    placed = surfaces_from_points(scan.points_m, scan.viewpoints_m, scan.viewpoint)
    bare = surfaces_from_points(points)
    assert [s.kind for s in placed] == [s.kind for s in bare] == ["floor", "ceiling", *["wall"] * 4]
    for kind in ("floor", "ceiling", "wall"):
        corners = [np.concatenate([s.vertices_m for s in by_kind(group)[kind]]) for group in (placed, bare)]
        nearest = np.linalg.norm(corners[0][:, None] - corners[1], axis=-1)
        assert max(nearest.min(axis=0).max(), nearest.min(axis=1).max()) < ALIKE_M, kind
