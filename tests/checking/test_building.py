"""Positions against the plan or the mesh beside the data."""

import shutil
from dataclasses import replace
from itertools import product
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from checked_records import channels, strengths
from made_flat import write_flat

from wrf_mi.apps.checking import building as module
from wrf_mi.apps.checking import check_data
from wrf_mi.apps.checking.building import (
    building_file,
    device_findings,
    in_solid,
    in_wall,
    inside_solids,
    read_building,
)
from wrf_mi.apps.checking.scene_geometry import ShapePart
from wrf_mi.core import InputError, Record
from wrf_mi.datasets import load, write_ble_folder

HALL_M = [[0, 0], [12, 0], [12, 8], [7, 8], [7, 4.2], [6.8, 4.2], [6.8, 8], [0, 8], [0, 0]]
"""A hall of 12 x 8 m, and a wall 0.2 m thick that enters it from y = 8 to y = 4.2."""


def walked(rows: int = 200) -> np.ndarray:
    """A walk around the end of the wall."""
    ways = [[1, 7], [1, 1], [6.5, 1], [10.5, 1], [10.5, 7], [8, 7], [8, 3], [4, 3]]
    corners = np.array([*ways, [4, 7], [6.5, 7], [6.5, 6], [4, 6], [4, 5], [6.5, 5]], float)
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    at = np.linspace(0, along[-1], rows)
    xy = [np.interp(at, along, corners[:, axis]) for axis in (0, 1)]
    return np.stack([*xy, np.full(rows, 1.3)], axis=-1)


@pytest.fixture
def hall(tmp_path):
    """A data set in the hall, with `HALL_M` as its layout."""
    record = replace(strengths(rows=200), tx_pos_m=walked(), tx_heading_rad=None)
    folder = write_ble_folder(tmp_path / "hall", record)
    np.savetxt(folder / "layout.csv", HALL_M, delimiter=",", header="x,y", comments="")
    return load(folder)


def suspected(data) -> dict[str, str]:
    """Texts by name of the suspicions about buildings."""
    known = ("walls", "inside-solids", "wall-vertices", "building")
    return {one.name: one.text for one in check_data(data).suspicions if one.name in known}


def with_receiver(record: Record, position_m) -> Record:
    """The record with its first receiver elsewhere."""
    first, *others = record.receivers
    return replace(record, receivers=(replace(first, position_m=np.array(position_m)), *others))


def test_transmitters_and_receivers_inside_walls_and_at_vertices_are_named(hall):
    assert building_file(hall.source) == Path(hall.source, "layout.csv")
    assert suspected(hall) == {}
    assert check_data(Path(hall.source)).suspicions == ()
    inside = "1 of 4 receivers lie inside walls or solids of layout.csv: anchor1;"
    height = hall.receivers[0].position_m[2]
    for place, expected in (
        ([6.9, 6.0, 2.0], {"inside-solids": inside}),  # in the middle of the wall
        ([6.81, 6.0, 2.0], {}),  # at its surface
        ([6.7, 6.0, 2.0], {}),
        ([0.1, 0.1, 2.0], {}),  # in a corner
        ([6.9, 4.1, 2.0], {}),  # before the end of the wall
        (
            [12, 8, height],
            {"wall-vertices": "1 of 4 receivers are at vertices of walls in layout.csv: anchor1 at (12, 8);"},
        ),
        ([11.9, 7.9, height], {}),
    ):
        found = suspected(with_receiver(hall, place))
        assert found.keys() == expected.keys(), place
        assert all(found[name].startswith(text) for name, text in expected.items()), found
    rows = replace(hall, tx_pos_m=hall.tx_pos_m.copy())
    building = read_building(Path(hall.source, "layout.csv"))
    rows.tx_pos_m[5:8] = [6.9, 5.0, 1.3]
    ((_, text),) = inside_solids(rows, building)
    assert text.startswith("3 of 200 transmitters lie inside walls or solids of layout.csv: rows 6, 7, 8;")
    many = replace(rows, tx_pos_m=np.concatenate([rows.tx_pos_m] + 5 * [hall.tx_pos_m]))
    assert list(inside_solids(many, building)) == []


@pytest.mark.parametrize(
    ("change", "remedy"),
    [
        (lambda xyz: [12, 0, 0] + [-1, 1, 1] * xyz, " if x is mirrored; use x = 12.00 - x, y = y"),
        (lambda xyz: [0, 8, 0] + [1, -1, 1] * xyz, " if y is mirrored; use x = x, y = 8.00 - y"),
        (lambda xyz: [1, -1, 1] * xyz, " if y is mirrored; use x = x, y = -y"),
        (lambda xyz: xyz[:, [1, 0, 2]], " if x and y are swapped; use x = y, y = x"),
        (lambda xyz: xyz + np.array([7, 0, 0]), "; give positions and building in one frame"),
    ],
)
def test_positions_in_another_frame_are_suspected(hall, change, remedy):
    moved = check_data(replace(hall, tx_pos_m=change(hall.tx_pos_m)), ignore=["plan", "headings"])
    assert [one.name for one in moved.suspicions] == ["walls"]
    assert moved.suspicions[0].text.endswith(remedy)
    assert "cross walls of layout.csv and " in moved.suspicions[0].text


def test_scene_folders_with_small_surfaces_are_read_whole(tmp_path):
    """A room with a stool: 0.3 m wide, which alone would be no room in metres."""
    room = trimesh.creation.box(bounds=[[0, 0, 0], [5, 4, 2.6]])
    stool = trimesh.creation.box(bounds=[[1, 1, 0], [1.3, 1.3, 0.4]])
    (tmp_path / "meshes").mkdir()
    with pytest.raises(InputError, match="a scene folder without faces"):
        read_building(tmp_path)
    for name, mesh in {"room": room, "stool": stool}.items():
        mesh.export(tmp_path / "meshes" / f"{name}.ply")
    building = read_building(tmp_path)
    assert {surface.kind for surface in building.surfaces} == {"floor", "ceiling", "wall", "other"}
    (solid,) = building.solids
    assert np.ptp(solid.reshape(-1, 3), axis=0) == pytest.approx([0.3, 0.3, 0.4], abs=1e-6)


def test_walls_are_pairs_of_parallel_lines():
    """Lines in any direction, as near as a wall is thick."""
    ends = np.array([[0, 0], [4, 0]], float)
    for angle, (width, expected), step in product((0.0, 0.7, 2.0), ((0.3, True), (0.6, False)), (1, -1)):
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        walls = np.stack([ends, (ends + np.array([0, width]))[::step]]) @ turn.T
        places = np.array([[2, width / 2], [2, -width / 2], [-1, width / 2], [2, 0.01]]) @ turn.T
        assert in_wall(places, walls).tolist() == [expected, False, False, False]
    assert in_wall(np.zeros((2, 2)), np.empty((0, 2, 2))).tolist() == [False, False]


def test_solids_are_those_of_the_solid_angle():
    """A box, and a ring whose middle is air."""
    places = np.random.default_rng(0).uniform(-1, 2, (400, 3))
    box = np.asarray(trimesh.creation.box(bounds=[[0, 0, 0], [1, 0.4, 2]]).triangles)
    deep = module.DEEP_M
    true = ((places >= deep) & (places <= np.array([1, 0.4, 2]) - deep)).all(axis=1)
    assert true.any()
    np.testing.assert_array_equal(in_solid(places, box), true)
    ring = np.asarray(trimesh.creation.annulus(r_min=0.5, r_max=0.8, height=2.0).triangles)
    radius, height = np.hypot(places[:, 0], places[:, 1]), np.abs(places[:, 2])
    edge = deep + 0.02  # sides are flat
    found = in_solid(places, ring)
    within = (radius > 0.5 + edge) & (radius < 0.8 - edge) & (height < 1 - edge)
    assert within.any()
    assert found[within].all()
    assert not found[(radius < 0.5 - edge) | (radius > 0.8) | (height > 1)].any()


def write_room(file: Path) -> None:
    """A room of 9 x 7 x 3 m with a cupboard."""
    room = trimesh.creation.box(bounds=[[0, 0, 0], [9, 7, 3]])
    room.invert()
    cupboard = trimesh.creation.box(bounds=[[4, 0.1, 0], [5, 0.6, 2]])
    trimesh.util.concatenate([room, cupboard]).export(file)


def test_solids_of_a_mesh(tmp_path):
    record, file = channels(), tmp_path / "hall.npz"
    arrays = {"csi": record.observation[0, :, 0], "rx_pos": record.tx_pos_m, "frequency_hz": np.float64(2.4e9)}
    np.savez(file, tx_pos=record.receivers[0].position_m, **arrays)
    assert building_file(file) is None
    write_room(tmp_path / "hall.stl")
    assert building_file(file) == tmp_path / "hall.stl"
    assert suspected(file) == {}
    np.savez(file, tx_pos=np.array([4.5, 0.35, 1.0]), **arrays)
    (text,) = [one.text for one in check_data(file).suspicions]
    assert text.startswith("1 of 1 receivers lie inside walls or solids of hall.stl: access-point; correct")


def test_scene_folders_and_single_meshes_are_found(tmp_path):
    folder = write_flat(tmp_path / "flat")
    assert building_file(folder) == folder / "layout.csv"
    (folder / "layout.csv").unlink()
    assert building_file(folder) is None
    trimesh.PointCloud(np.random.default_rng(0).uniform(size=(50, 3))).export(folder / "scan.ply")
    assert building_file(folder) is None  # a cloud has no surfaces
    write_room(folder / "room.ply")
    assert building_file(folder) == folder / "room.ply"
    write_room(folder / "other.stl")
    assert building_file(folder) is None  # which one is not known
    (folder / "room").mkdir()
    (folder / "room" / "scene.yml").write_text("xml: scene.xml")
    assert building_file(folder) is None
    (folder / "room" / "scene.xml").write_text("<scene/>")
    (folder / "room" / "meshes").mkdir()
    shutil.move(folder / "room.ply", folder / "room" / "meshes")
    assert building_file(folder) == folder / "room"
    assert suspected(folder) == {}


def test_a_plan_that_cannot_be_read_is_suspected(tmp_path):
    folder = write_flat(tmp_path / "flat")
    for text, message in (("x,y\n0,0\nfar,1\n", "row 2: x is 'far'"), ("x,y\n0,0\n1,0\n", "enclose no floor")):
        (folder / "layout.csv").write_text(text)
        report = check_data(folder)
        assert report.ok
        assert [one.name for one in report.suspicions] == ["building"]
        assert message in report.suspicions[0].text


def test_positions_of_a_scene_without_floor_below_are_named():
    """A floor of 4 m x 2 m and a wall along the 8 m of the scene; a third of the positions is beside the floor."""
    floor = [[[0, 0, 0], [4, 0, 0], [4, 2, 0]], [[0, 0, 0], [4, 2, 0], [0, 2, 0]]]
    wall = [[[0, 0, 0], [8, 0, 0], [8, 0, 3]], [[0, 0, 0], [8, 0, 3], [0, 0, 3]]]
    parts = [ShapePart("room", "wood", Path("room.ply"), np.array([*floor, *wall], float))]
    inside, beside = [[1, 1, 1], [3, 0.5, 1], [2, 1, 1], [3.5, 1.5, 2]], [[6, 0, 1], [7, 0, 1]]
    receivers = [SimpleNamespace(position_m=np.array([1.0, 1, 2]))]
    cases = [np.array(rows, float) for rows in (inside + beside, [*inside, [30, 0, 1]], beside)]
    records = [SimpleNamespace(tx_pos_m=rows, receivers=receivers) for rows in cases]
    findings = [list(device_findings(parts, Path("room"), record)) for record in records]
    assert [[finding.kind for finding in each] for each in findings] == [["no-floor"], [], []]
    assert "2 of 6 transmitters inside the scene, first number 5, have no floor" in findings[0][0].text
