"""Scans as they come: tilted, with strays far away, as the uneven mesh of a phone; and terraces."""

import numpy as np
import pytest
import trimesh
from calling import refused
from made_rooms import Mesh, attic, by_kind, closed_box, joined, l_shape, sampled, sheet
from wrf_mi_scenes.build_laboratory import box

from wrf_mi.apps.checking import check_scene
from wrf_mi.core.yaml_files import read_yaml
from wrf_mi.scene.edit import read_surfaces
from wrf_mi.scene.make import make_scene
from wrf_mi.scene.mesh.facets import planes_of_mesh
from wrf_mi.scene.mesh.measured import is_measured
from wrf_mi.scene.mesh.surfaces import Surface, box_of
from wrf_mi.scene.scan.level import level_rotation

COUNT, NOISE_M = 40_000, 0.008
CLOSE_M = 0.02  # two standard deviations and a half of the noise
TURN_DEG = 0.15  # error of a direction over 4 m with that noise, and the rotation that is estimated


def tilt(degrees, axis=(1.0, 0.4, 0.0)):
    return trimesh.transformations.rotation_matrix(np.radians(degrees), axis)


def scan_file(file, points):
    np.savetxt(file, points, "%.4f")
    return file


def surfaces_of(file, folder, **options):
    new_scene = make_scene(file, folder / "scene", replace=True, **options)
    return read_surfaces(new_scene.folder)[0]


def as_surfaces(*parts):
    return [
        Surface(f"part_{i}", "other", np.asarray(m.vertices, float), np.asarray(m.faces)) for i, m in enumerate(parts)
    ]


# --- level


@pytest.mark.parametrize("degrees", [3, 10, 14])
def test_tilted_scan_is_levelled_and_its_rotation_stored(tmp_path, caplog, degrees):
    points = trimesh.transform_points(sampled(closed_box(), COUNT, NOISE_M), tilt(degrees))
    surfaces = surfaces_of(scan_file(tmp_path / "scan.xyz", points), tmp_path)
    assert [len(group) for group in by_kind(surfaces).values()] == [1, 1, 4, 0]
    assert np.ptp(box_of([s for s in surfaces if s.kind == "floor"])[:, 2]) < CLOSE_M
    assert sum(s.mesh.area for s in surfaces) == pytest.approx(2 * (20 + 2.8 * 9), rel=0.01)
    assert f"not level by {degrees}.0 degrees" in caplog.text
    rotation = np.array(read_yaml(tmp_path / "scene" / "scene.yml")["registration"], float)
    up = rotation[:3, :3] @ tilt(degrees)[:3, :3] @ [0, 0, 1]
    assert np.degrees(np.arccos(min(up[2], 1.0))) < TURN_DEG


def test_scan_tilted_by_more_than_fifteen_degrees_is_refused(tmp_path, capsys):
    points = trimesh.transform_points(sampled(closed_box(), COUNT, NOISE_M), tilt(20))
    file = scan_file(tmp_path / "scan.xyz", points)
    refused(["mesh", file, "--out", tmp_path / "scene"], "walls lean by 20.0 degrees, more than 15", capsys)


def ramp(rise_m):
    """A room whose floor and ceiling slope and whose walls are upright."""
    room = joined(closed_box())
    room.vertices[:, 2] += rise_m * room.vertices[:, 0] / 5
    return [room]


@pytest.mark.parametrize("parts", [closed_box(), l_shape(), attic(), ramp(0.3), [sheet(2, 0.0, (0, 9), (0, 9))]])
def test_upright_walls_are_level_whatever_slopes(parts):
    assert level_rotation(sampled(parts, COUNT, NOISE_M))[1] == 0


def test_ground_without_walls_keeps_its_slope():
    hill = trimesh.transform_points(sampled([sheet(2, 0.0, (0, 20), (0, 20))], COUNT, NOISE_M), tilt(8))
    assert level_rotation(hill)[1] == 0


def test_registration_of_a_tilted_scan_is_that_of_its_file(tmp_path):
    points = trimesh.transform_points(sampled(closed_box(), COUNT, NOISE_M), tilt(10))
    file = scan_file(tmp_path / "scan.xyz", points)
    surfaces = surfaces_of(file, tmp_path, registration=np.linalg.inv(tilt(10)))
    np.testing.assert_allclose(box_of(surfaces), [[0.0, 0, 0], [5, 4, 2.8]], atol=CLOSE_M)


# --- strays


@pytest.mark.parametrize("far_m", [300.0, 20_000.0, 1e6])
@pytest.mark.parametrize("together", [False, True])
def test_strays_far_away_neither_move_nor_change_a_room(tmp_path, caplog, far_m, together):
    points, rng = sampled(closed_box(), COUNT, NOISE_M, strays=0.0), np.random.default_rng(0)
    directions = rng.normal(size=(12, 3)) if not together else np.array([1.0, 0.2, 0.1]) + rng.normal(0, 1e-3, (12, 3))
    strays = far_m * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    surfaces = surfaces_of(scan_file(tmp_path / "scan.xyz", np.concatenate([points, strays])), tmp_path)
    np.testing.assert_allclose(box_of(surfaces), [[0.0, 0, 0], [5, 4, 2.8]], atol=CLOSE_M)
    assert "12 of 40012 points" in caplog.text
    assert read_yaml(tmp_path / "scene" / "scene.yml")["origin_m"] is None


def test_a_far_surface_is_not_a_stray(tmp_path, caplog):
    front = sampled([sheet(0, 40.0, (0, 8), (0, 6))], 2000, NOISE_M, strays=0.0)
    points = np.concatenate([sampled(closed_box(), COUNT, NOISE_M, strays=0.0), front])
    surfaces_of(scan_file(tmp_path / "scan.xyz", points), tmp_path)
    assert "strays" not in caplog.text


# --- meshes of phones


def uneven(parts, noise_m, halvings=5, seed=0):
    """Faces of about 0.1 m whose vertices are off by noise."""
    mesh = joined(parts)
    mesh.merge_vertices()
    for _ in range(halvings):
        mesh = mesh.subdivide()
    mesh.vertices += np.random.default_rng(seed).normal(0, noise_m, mesh.vertices.shape)
    return mesh


@pytest.mark.parametrize("noise_m", [0.003, 0.008, 0.02])
@pytest.mark.parametrize("flipped", [False, True])
def test_uneven_faces_are_measured_whichever_way_they_point(noise_m, flipped):
    mesh = uneven(closed_box(), noise_m)
    if flipped:
        mesh = Mesh(mesh.vertices, np.where(np.arange(len(mesh.faces))[:, None] % 3, mesh.faces, mesh.faces[:, ::-1]))
    assert is_measured(as_surfaces(mesh))


def hills():
    """Smooth ground in faces of 2 m."""
    x, y = np.meshgrid(np.arange(0, 80, 2.0), np.arange(0, 80, 2.0))
    points = np.stack([x.ravel(), y.ravel(), (6 * np.sin(x / 15) * np.cos(y / 11)).ravel()], axis=-1)
    i = np.arange(len(points)).reshape(x.shape)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, 1:].ravel(), i[1:, :-1].ravel()
    return Mesh(points, np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]))


DESIGNED = {
    "box": closed_box()[0],
    "fine box": uneven(closed_box(), 0.0),
    "cylinder": trimesh.creation.cylinder(1.0, 3.0, sections=24),
    "sphere": trimesh.creation.icosphere(3),
    "torus": trimesh.creation.torus(1.0, 0.3),
    "capsule": trimesh.creation.capsule(1.0, 0.3),
    "hills": hills(),
    "in millimetres": uneven(closed_box(x=5.0173, y=4.0391), 0.0),
}
DESIGNED["in millimetres"].vertices = np.round(DESIGNED["in millimetres"].vertices, 3)


@pytest.mark.parametrize("name", DESIGNED)
def test_designed_faces_are_not_measured(name):
    assert not is_measured(as_surfaces(DESIGNED[name]))


@pytest.mark.parametrize("halvings", [5, 6])
def test_mesh_of_a_phone_becomes_the_planes_of_a_scan(tmp_path, caplog, halvings):
    """Faces with sides of about 0.15 and 0.07 m."""
    uneven(closed_box(z=2.6), 0.008, halvings).apply_transform(
        trimesh.transformations.rotation_matrix(-np.pi / 2, (1, 0, 0))
    ).export(tmp_path / "scan.obj")
    surfaces = surfaces_of(tmp_path / "scan.obj", tmp_path, up="y")
    assert [len(group) for group in by_kind(surfaces).values()] == [1, 1, 4, 0]
    assert sum(s.mesh.area for s in surfaces) == pytest.approx(86.8, rel=0.01)
    assert "uneven as those of a scan" in caplog.text


def test_axes_of_a_phones_scan_are_turned_along_the_walls(tmp_path, caplog):
    turned = trimesh.transformations.rotation_matrix(np.radians(25), (0, 0, 1))
    uneven(closed_box(z=2.6), 0.008).apply_transform(turned).export(tmp_path / "scan.ply")
    surfaces = surfaces_of(tmp_path / "scan.ply", tmp_path, up="z")
    np.testing.assert_allclose(sorted(np.ptp(box_of(surfaces), axis=0)), [2.6, 4, 5], atol=CLOSE_M)
    assert "turned by -25.0 degrees" in caplog.text or "turned by 65.0 degrees" in caplog.text
    motion = np.array(read_yaml(tmp_path / "scene" / "scene.yml")["registration"])
    np.testing.assert_allclose(motion @ turned, np.eye(4), atol=np.radians(TURN_DEG))


def test_check_names_the_command_that_makes_planes_of_a_phones_scan(tmp_path):
    file = tmp_path / "scan.obj"
    uneven(closed_box(z=2.6), 0.008).export(file)
    (finding,) = check_scene(file).of_level("warning")
    assert finding.kind == "uneven"
    assert f"wrf-mi mesh {file} --out SCENE --up y, or --up z" in finding.remedy
    uneven(closed_box(z=2.6), 0.0).export(file)
    assert not check_scene(file).of_level("warning")


# --- terraces


def terraces(step_m, count=2, kiosks=()):
    """Level grounds of 40 m x 60 m, each a cliff above the one before."""
    parts = []
    for i in range(count):
        parts.append(sheet(2, i * step_m, (40 * i, 40 * (i + 1)), (0, 60)))
        if i:
            parts.append(sheet(0, 40 * i, (0, 60), ((i - 1) * step_m, i * step_m)))
    for i in kiosks:
        parts.append(box((40 * i + 10, 10, i * step_m), (40 * i + 14, 14, i * step_m + 3)))
    return as_surfaces(*parts)


@pytest.mark.parametrize("step_m", [3.0, 20.0])
@pytest.mark.parametrize("kiosks", [(), (1,), (0, 1)])
def test_both_grounds_of_a_terrace_are_floor(step_m, kiosks):
    kinds = {round(s.mesh.area): s.kind for s in planes_of_mesh(terraces(step_m, kiosks=kiosks)) if s.mesh.area > 1000}
    floors = [s for s in planes_of_mesh(terraces(step_m, kiosks=kiosks)) if s.kind == "floor" and s.mesh.area > 1000]
    assert kinds[2400] == "floor"
    assert sorted(s.vertices_m[0, 2] for s in floors) == [0, step_m]


def test_each_ground_of_three_terraces_is_floor():
    grounds = [s for s in planes_of_mesh(terraces(6.0, count=3)) if s.mesh.area == pytest.approx(2400)]
    assert [s.kind for s in grounds] == ["floor"] * 3


def test_ceiling_of_a_room_whose_floor_was_not_scanned_is_no_ground():
    rooms = [*closed_box(), *(sheet(0, x, (0, 4), (0, 2.8)) for x in (5.2, 9.0))]
    rooms += [sheet(1, y, (5.2, 9.0), (0, 2.8)) for y in (0, 4)] + [sheet(2, 2.8, (5.2, 9.0), (0, 4))]
    kinds = {s.kind for s in planes_of_mesh(as_surfaces(*rooms)) if s.vertices_m[:, 2].min() > 2.7}
    assert kinds == {"ceiling"}
