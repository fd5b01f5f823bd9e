"""Scenes of every kind, one clear line for each unusable one, positions of antennas, planes of surfaces."""

import logging
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from traced_rooms import FREQUENCY_HZ, SHOEBOX, receiver, write_xml
from wrf_mi_scenes.build_laboratory import box, sheet

from wrf_mi.core import InputError
from wrf_mi.receivers.instruments import PowerInstrument
from wrf_mi.scene.coordinates import Y_UP
from wrf_mi.scene.folder import write_scene
from wrf_mi.scene.mesh.surfaces import Surface
from wrf_mi.tracing import TraceOptions, open_scene, trace_paths
from wrf_mi.tracing.search.devices import before_surfaces, check_devices, clear_m, winding_number
from wrf_mi.tracing.search.surfaces import find_planes, scene_surfaces
from wrf_mi.tracing.tracer import RayTracer


def refused(words: str, source: Any, frequency_hz: float = FREQUENCY_HZ, **how: Any) -> None:
    with pytest.raises(InputError, match=words) as error:
        open_scene(source, frequency_hz, **how)
    assert "\n" not in str(error.value)


def test_name_opens_an_embedded_scene():
    scene = open_scene("laboratory", 920e6)
    assert "wall_north" in scene.objects
    assert float(scene.radio_materials["itu_brick"].thickness[0]) == pytest.approx(0.2)
    thinner = open_scene("laboratory", 920e6, {"itu_brick": 0.05})
    assert float(thinner.radio_materials["itu_brick"].thickness[0]) == pytest.approx(0.05)


def test_scene_folder_has_the_materials_of_its_file(tmp_path: Path):
    surfaces = []
    for name, kind in (("floor", "floor"), ("west", "wall")):
        mesh = SHOEBOX[name][1]
        surfaces.append(Surface(name, kind, np.asarray(mesh.vertices), np.asarray(mesh.faces)))
    folder = write_scene(tmp_path / "scene", surfaces, frame="a room", source="made here")
    scene = open_scene(folder, FREQUENCY_HZ)
    assert scene.objects["west"].radio_material.name == "itu_plasterboard"
    text = (folder / "materials.yml").read_text()
    text = text.replace("wall: itu_plasterboard", "wall: itu_brick")
    (folder / "materials.yml").write_text(text + "\n")
    assert open_scene(folder, FREQUENCY_HZ).objects["west"].radio_material.name == "itu_brick"


@pytest.mark.parametrize("ending", ["stl", "ply", "obj", "glb"])
def test_bare_mesh_needs_a_material(tmp_path: Path, ending: str):
    file = tmp_path / f"room.{ending}"
    mesh = box((0, 0, 0), (6, 5, 3))
    mesh.apply_transform(Y_UP if ending == "glb" else np.eye(4))
    mesh.export(file)
    scene = open_scene(file, FREQUENCY_HZ, material="concrete")
    assert [o.radio_material.name for o in scene.objects.values()] == ["itu_concrete"]
    low, high = scene.mi_scene.bbox().min, scene.mi_scene.bbox().max
    np.testing.assert_allclose([low, high], [[0, 0, 0], [6, 5, 3]], atol=1e-6)
    assert next(iter(open_scene(file, FREQUENCY_HZ, material="itu_brick").radio_materials)) == "itu_brick"
    paths = trace_paths(
        open_scene(file, FREQUENCY_HZ, material="perfect"),
        [[1.0, 2, 1]],
        receiver([4, 3, 1]),
        TraceOptions(depth=1),
    ).paths
    assert len(paths) == 7
    refused("a mesh has no radio material", file)
    refused("material 'cheese': unknown", file, material="cheese")


def test_wrong_scenes_are_refused(tmp_path: Path):
    refused("no such scene file; give a name", tmp_path / "none.xml")
    refused("no such scene file", "no-such-room")
    (tmp_path / "empty").mkdir()
    refused("so not a scene folder", tmp_path / "empty")
    (tmp_path / "empty" / "scene.yml").write_text("xml: 3: 4")
    refused("not YAML", tmp_path / "empty")
    xml = write_xml(tmp_path / "room", SHOEBOX)
    refused("leave out the material", xml, material="concrete")
    refused("not known at 0.1 GHz", xml, 1e8)
    (tmp_path / "bare.xml").write_text('<scene version="3.0.0"></scene>')
    refused("holds no surface", tmp_path / "bare.xml")
    (tmp_path / "points.ply").write_bytes(trimesh.PointCloud([[0, 0, 0], [1, 1, 1.0]]).export(file_type="ply"))
    refused("holds no surface", tmp_path / "points.ply", material="concrete")
    (tmp_path / "bad.glb").write_bytes(b"no")
    refused("cannot be read as a mesh", tmp_path / "bad.glb", material="concrete")
    box((0, 0, 0), (6000, 5000, 2700)).export(tmp_path / "mm.stl")
    refused("as if in millimetres", tmp_path / "mm.stl", material="concrete")
    mesh = sheet(2, 0.0, (0.0, 1.0), (0.0, 1.0))
    mesh.vertices[0] = np.nan
    refused("vertex 1 of mesh is not finite", write_xml(tmp_path / "nan", {"floor": ("itu_concrete", mesh)}))


def test_faces_without_their_vertices_are_refused_before_mitsuba_reads_them(tmp_path: Path):
    """Mitsuba follows such a face beyond its vertices, which ends the process."""
    mesh = sheet(2, 0.0, (0.0, 1.0), (0.0, 1.0))
    xml = write_xml(tmp_path, {"floor": ("itu_concrete", mesh)})
    (file,) = tmp_path.rglob("*.ply")
    mesh.faces[-1, -1] = 1 << 28
    mesh.export(file)
    refused(r"floor\.ply: cannot be read as a mesh \(a face names a vertex", xml)
    file.unlink()
    refused(r"floor\.ply: cannot be read as a mesh", xml)


def test_remedy_for_a_frequency_out_of_range_opens_the_scene(tmp_path: Path):
    """Brick ends at 40 GHz; the file gets the constants that the message asks for."""
    xml = write_xml(tmp_path, {name: ("itu_brick", part) for name, (_, part) in SHOEBOX.items()})
    with pytest.raises(InputError, match="itu_brick: not known at 47 GHz") as caught:
        open_scene(xml, 47e9)
    (bsdf,) = re.findall("<bsdf.*</bsdf>", str(caught.value))
    for value in ("3.9", "0.7"):
        bsdf = bsdf.replace("...", value, 1)
    text = xml.read_text().replace("mat-itu_brick", "mat-my_brick")
    xml.write_text(text.replace('<bsdf type="diffuse" id="mat-my_brick"/>', bsdf))
    scene = open_scene(xml, 47e9)
    (material,) = {one.radio_material.name: one.radio_material for one in scene.objects.values()}.values()
    assert float(material.relative_permittivity[0]) == pytest.approx(3.9)
    assert float(material.conductivity[0]) == pytest.approx(0.7)


def in_a_room(tmp_path: Path, *parts: trimesh.Trimesh) -> Any:
    named = {f"part{k}": ("itu_wood", part) for k, part in enumerate(parts)}
    return scene_surfaces(open_scene(write_xml(tmp_path, {**SHOEBOX, **named}), FREQUENCY_HZ))


def test_antenna_behind_its_wall_is_traced_from_before_it(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    """Mounted on a wall that the mesh has too far inside."""
    surfaces = in_a_room(tmp_path, sheet(2, 0.7, (2.0, 3.0), (2.0, 3.0)))
    scene = open_scene(tmp_path / "scene.xml", FREQUENCY_HZ)
    tx, options = [[1.0, 2, 1]], TraceOptions(transmission=False, depth=2)
    on, behind, far = (
        trace_paths(scene, tx, receiver([x, 2.5, 1.3]), options).paths.length_m.tolist() for x in (0.0, -2e-3, -0.02)
    )
    assert len(behind) == len(on) >= 6
    np.testing.assert_allclose(np.sort(behind), np.sort(on), atol=2e-4)
    assert not far
    assert "1 of 1 antennas lie up to 1 cm behind a surface (first: receiver rx)" in caplog.text
    assert "1 of 1 receivers have no path (first: receiver rx at (-0.02, 2.50, 1.30) m)" in caplog.text
    # Sheets inside a room have no right side, but an antenna on one has a side; beyond a wall's edges nothing is moved.
    places = np.array([[2.5, 2.5, 0.695], [2.5, 2.5, 0.705], [2.5, 2.5, 0.7], [0.0, 2.5, 1.3], [-2e-3, 9.0, 1.3]])
    clear = clear_m(surfaces)
    assert clear < 2e-4
    expected = places + np.array([[0.0, 0, 0], [0, 0, 0], [0, 0, clear], [clear, 0, 0], [0, 0, 0]])
    np.testing.assert_allclose(before_surfaces(surfaces, places), expected, atol=1e-12)


def test_antenna_on_a_cabinet_is_traced_from_before_it(tmp_path: Path):
    """On its top, on an edge of it, and up to 1 cm inside; deeper ones stay inside and are refused."""
    surfaces = in_a_room(tmp_path, box((2, 2, 0), (3, 2.5, 1.2)))
    clear = clear_m(surfaces)
    places = np.array([[2.5, 2.2, 1.2], [2.5, 2.2, 1.195], [2.5, 2.2, 1.2 + 5e-5], [2.004, 2.2, 0.6], [2.5, 2.2, 1.3]])
    expected = [[2.5, 2.2, 1.2 + clear]] * 3 + [[2 - clear, 2.2, 0.6], [2.5, 2.2, 1.3]]
    np.testing.assert_allclose(before_surfaces(surfaces, places), expected, atol=1e-9)
    check_devices(surfaces, before_surfaces(surfaces, np.array([[3.0, 2.5, 1.2]])), ["corner"])
    deeper = np.array([[2.5, 2.2, 1.185]])
    np.testing.assert_array_equal(before_surfaces(surfaces, deeper), deeper)
    with pytest.raises(InputError, match="inside the solid"):
        check_devices(surfaces, deeper, ["deeper"])


def test_number_of_rays_for_an_antenna_behind_its_wall_converges_before_it(tmp_path: Path):
    """From behind the wall no ray finds a path, and the smallest number would converge."""
    write_xml(tmp_path, SHOEBOX)
    tx, options = np.array([[1.0, 2, 1], [3.0, 4, 2]]), TraceOptions(depth=2, rays="auto")
    carrier_hz = np.array([FREQUENCY_HZ])
    before, behind = (PowerInstrument((receiver([x, 2.5, 1.3]),), carrier_hz) for x in (1e-4, -2e-3))
    wanted, found = (RayTracer(tmp_path / "scene.xml", side, options).rays(tx) for side in (before, behind))
    assert found == wanted


def test_antennas_outside_the_scene_are_named(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    surfaces = in_a_room(tmp_path, box((-0.2, -0.2, -0.2), (6.2, 5.2, 3.2)))
    with caplog.at_level(logging.WARNING):
        check_devices(surfaces, np.array([[1.0, 1, 1], [6.1, 1, 1]]), ["a", "b"])  # within the walls
    assert not caplog.text
    with caplog.at_level(logging.WARNING):
        check_devices(surfaces, np.array([[1.0, 1, 1], [1, -40, 1], [1000, 1, 1]]), ["a", "b", "c"])
    assert "2 of 3 antennas lie outside the scene (first: b, by 39.80 m): check its frame and the unit" in caplog.text
    check_devices(surfaces, np.zeros((0, 3)), [])  # every position was checked before


def test_antenna_in_a_solid_object_is_refused(tmp_path: Path):
    """A room is closed, too, but not solid."""
    shell = in_a_room(tmp_path / "a", box((-0.2, -0.2, -0.2), (6.2, 5.2, 3.2)))
    check_devices(shell, np.array([[1.0, 1, 1]]), ["transmitter 1"])
    surfaces = in_a_room(tmp_path / "b", box((2, 2, 0), (3, 2.5, 1.2)), box((4, 1, 0), (4.15, 4, 3)))
    assert len(surfaces.solids) == 2
    places = np.array([[1.0, 1, 1], [4.07, 2, 1.5], [2.5, 2.2, 0.6]])
    with pytest.raises(InputError, match=r"receiver b at \(4.07, 2.00, 1.50\) m is inside the solid 'part1'") as error:
        check_devices(surfaces, places, ["receiver a", "receiver b", "receiver c"])
    assert "\n" not in str(error.value)
    scene = open_scene(tmp_path / "b" / "scene.xml", FREQUENCY_HZ)
    with pytest.raises(InputError, match="transmitter 2"):
        trace_paths(scene, places[[0, 2]], receiver([1, 1, 2]))


def test_solid_is_named_by_its_mesh_file_where_its_id_is_another(tmp_path: Path):
    """Exporters number shapes, so the id alone does not identify the object."""
    column = {"column": ("itu_concrete", box((2, 2, 0), (2.5, 2.5, 2.8)))}
    xml = write_xml(tmp_path, {**SHOEBOX, **column})
    text = xml.read_text()
    inside_it = np.array([[2.2, 2.3, 1.0]])
    for number, stated in enumerate(('id="mesh-elm__3"', "")):
        xml.write_text(text.replace('id="column"', stated))
        scene = open_scene(xml, FREQUENCY_HZ)
        called = ("'elm__3' ", r"'no-name-\d+' ")[number] + r"\(column.ply\); move one of them"
        with pytest.raises(InputError, match=f"^transmitter 1 at .* is inside the solid {called}"):
            trace_paths(scene, inside_it, receiver([1, 1, 2]))
    column["column"][1].export(tmp_path / "pillar.stl")
    with pytest.raises(InputError, match="is inside the solid 'pillar'; move one of them"):
        trace_paths(open_scene(tmp_path / "pillar.stl", FREQUENCY_HZ, material="wood"), inside_it, receiver([1, 1, 2]))


def test_winding_number_is_one_inside_and_zero_outside():
    sphere = trimesh.creation.icosphere(subdivisions=2)
    inside = np.random.default_rng(0).normal(size=(50, 3))
    inside *= 0.9 * np.random.default_rng(1).uniform(size=(50, 1)) / np.linalg.norm(inside, axis=1, keepdims=True)
    places = np.concatenate([inside, [[0.99, 0.99, 0], [3, 0, 0]]])
    np.testing.assert_allclose(winding_number(sphere.triangles, places), [1] * 50 + [0, 0], atol=1e-9)


def test_coplanar_faces_share_a_plane():
    """Of either orientation, slivers with inexact normals included; parallel and tilted faces do not."""
    wall = trimesh.Trimesh([[0, 0, 0], [4, 0, 0], [4, 0, 3], [0, 0, 3]], [[0, 1, 2], [3, 2, 0]], process=False)
    sliver = np.array([[[1, 1e-6, 0], [1.001, 0, 0], [1, 0, 3]]])  # its own normal is 1e-3 rad off
    parallel = wall.triangles + np.array([0, 0.01, 0])
    tilted = np.array([[[0, 0, 0], [4, 0, 0], [4, 0.01, 3]]])
    faces = np.concatenate([wall.triangles, sliver, parallel, tilted])
    first = np.array([0, len(faces)])
    surfaces = find_planes(("a",), np.array([7], np.uint32), first, faces)
    assert len(np.unique(surfaces.plane[:3])) == 1
    assert len(surfaces.normal) == 3
    assert surfaces.plane[3] == surfaces.plane[4] != surfaces.plane[0]
    assert surfaces.face[surfaces.plane[0]] in (0, 1)
    for k in range(3):
        corners = surfaces.triangles[surfaces.plane == k].reshape(-1, 3)
        np.testing.assert_allclose(corners @ surfaces.normal[k], surfaces.offset[k], atol=2e-5)
        along = corners @ surfaces.axes[k].T
        np.testing.assert_allclose([along.min(axis=0), along.max(axis=0)], [surfaces.low[k], surfaces.high[k]])
    assert surfaces.object_of(np.array([0, 5])).tolist() == [0, 0]


def test_fine_and_coarse_walls_give_the_same_paths(tmp_path: Path):
    fine = {name: (material, mesh.subdivide().subdivide()) for name, (material, mesh) in SHOEBOX.items()}
    found = []
    for name, parts in (("coarse", SHOEBOX), ("fine", fine)):
        scene = open_scene(write_xml(tmp_path / name, parts), FREQUENCY_HZ)
        assert len(scene_surfaces(scene).normal) == 6
        found.append(trace_paths(scene, [[1.3, 2, 1]], receiver([4.4, 3.1, 1.7]), TraceOptions()).paths)
    np.testing.assert_allclose(found[1].length_m, found[0].length_m, atol=1e-9)
    np.testing.assert_allclose(found[1].gain, found[0].gain, atol=1e-5 * np.abs(found[0].gain).max())
    assert sheet(2, 0.0, (0.0, 1.0), (0.0, 1.0)).area == pytest.approx(1)


def test_a_mesh_with_dots_in_its_name_opens(tmp_path: Path):
    """Mitsuba's names have none."""
    box((0, 0, 0), (6, 5, 3)).export(tmp_path / "room.v2.stl")
    scene = open_scene(tmp_path / "room.v2.stl", FREQUENCY_HZ, material="wood")
    assert list(scene.objects) == ["room_v2"]
