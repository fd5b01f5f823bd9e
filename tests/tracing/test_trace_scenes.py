"""Scenes of every kind, one clear line for each unusable one, positions of antennas, planes of surfaces, absorbers."""

import json
import logging
import re
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from correction_rooms import TRUE_MATERIALS, channels, stated_scene
from traced_rooms import FREQUENCY_HZ, SHOEBOX, receiver, write_xml
from wrf_mi_scenes.build_laboratory import box, sheet
from wrf_mi_scenes.divided import cluttered_room
from wrf_mi_scenes.mitsuba_xml import ABSORBER

from wrf_mi.apps.commands.main import main
from wrf_mi.core import InputError
from wrf_mi.correction import default_options
from wrf_mi.correction.page import write_page
from wrf_mi.datasets.splits import make_splits
from wrf_mi.receivers.instruments import Instrument
from wrf_mi.scene.coordinates import Y_UP
from wrf_mi.scene.edit import Move, edit_scene
from wrf_mi.scene.folder import write_scene
from wrf_mi.scene.materials import read_materials
from wrf_mi.scene.mesh.surfaces import Kind, Surface
from wrf_mi.stages.correct import correct_scene
from wrf_mi.tracing import RayTracer, TraceOptions, open_scene, trace_paths
from wrf_mi.tracing.search import surfaces as surfaces_module
from wrf_mi.tracing.search.devices import before_surfaces, check_devices, clear_m
from wrf_mi.tracing.search.surfaces import find_planes, scene_surfaces


def refused(words, source, frequency_hz=FREQUENCY_HZ, **how):
    with pytest.raises(InputError, match=words) as error:
        open_scene(source, frequency_hz, **how)
    assert "\n" not in str(error.value)


def test_name_opens_an_embedded_scene():
    for thickness_option, thickness_m in ((None, 0.2), ({"itu_brick": 0.05}, 0.05)):
        scene = open_scene("laboratory", 920e6, thickness_option)
        assert "wall_north" in scene.objects
        assert float(scene.radio_materials["itu_brick"].thickness[0]) == pytest.approx(thickness_m)


def test_scene_folder_has_the_materials_of_its_file(tmp_path):
    kinds: dict[str, Kind] = {"floor": "floor", "west": "wall"}
    meshes = {name: mesh for name, (_, mesh) in SHOEBOX.items()}
    parts = [Surface(n, k, np.asarray(meshes[n].vertices), np.asarray(meshes[n].faces)) for n, k in kinds.items()]
    folder = write_scene(tmp_path / "scene", parts, frame="a room", source="made here")
    assert open_scene(folder, FREQUENCY_HZ).objects["west"].radio_material.name == "itu_plasterboard"
    text = (folder / "materials.yml").read_text()
    (folder / "materials.yml").write_text(text.replace("wall: itu_plasterboard", "wall: itu_brick"))
    assert open_scene(folder, FREQUENCY_HZ).objects["west"].radio_material.name == "itu_brick"


@pytest.mark.parametrize("ending", ["stl", "ply", "obj", "glb"])
def test_bare_mesh_needs_a_material(tmp_path, ending):
    file, mesh = tmp_path / f"room.{ending}", box((0, 0, 0), (6, 5, 3))
    mesh.apply_transform(Y_UP if ending == "glb" else np.eye(4))
    mesh.export(file)
    scene = open_scene(file, FREQUENCY_HZ, material="concrete")
    assert [o.radio_material.name for o in scene.objects.values()] == ["itu_concrete"]
    low, high = scene.mi_scene.bbox().min, scene.mi_scene.bbox().max
    np.testing.assert_allclose([low, high], [[0, 0, 0], [6, 5, 3]], atol=1e-6)
    assert next(iter(open_scene(file, FREQUENCY_HZ, material="itu_brick").radio_materials)) == "itu_brick"
    mirrors = open_scene(file, FREQUENCY_HZ, material="perfect")
    assert len(trace_paths(mirrors, [[1.0, 2, 1]], receiver([4, 3, 1]), TraceOptions(depth=1)).paths) == 7
    mesh.export(tmp_path / f"room.v2.{ending}")  # Mitsuba's names have no dots
    assert list(open_scene(tmp_path / f"room.v2.{ending}", FREQUENCY_HZ, material="wood").objects) == ["room_v2"]
    refused("a mesh has no radio material", file)
    refused("material 'cheese': unknown", file, material="cheese")


def test_wrong_scenes_are_refused(tmp_path):
    for words, name in (("no such scene file; give a name", tmp_path / "none.xml"), ("no such scene file", "no-room")):
        refused(words, name)
    (tmp_path / "empty").mkdir()
    refused("so not a scene folder", tmp_path / "empty")
    (tmp_path / "empty" / "scene.yml").write_text("xml: 3: 4")
    refused("not YAML", tmp_path / "empty")
    xml = write_xml(tmp_path / "room", SHOEBOX)
    refused("leave out the material", xml, material="concrete")
    refused("not known at 0.1 GHz", xml, 1e8)
    (tmp_path / "cut.xml").write_text("<scene")
    refused("cannot be opened", tmp_path / "cut.xml")
    (tmp_path / "bare.xml").write_text('<scene version="3.0.0"></scene>')
    refused("holds no surface", tmp_path / "bare.xml")
    (tmp_path / "points.ply").write_bytes(trimesh.PointCloud([[0, 0, 0], [1, 1, 1.0]]).export(file_type="ply"))
    (tmp_path / "bad.glb").write_bytes(b"no")
    box((0, 0, 0), (6000, 5000, 2700)).export(tmp_path / "mm.stl")
    meshes = {"points.ply": "holds no surface", "bad.glb": "cannot be read as a mesh", "mm.stl": "as if in millimetres"}
    for name, words in meshes.items():
        refused(words, tmp_path / name, material="concrete")
    mesh = sheet(2, 0.0, (0.0, 1.0), (0.0, 1.0))
    mesh.vertices[0] = np.nan
    refused("vertex 1 of mesh is not finite", write_xml(tmp_path / "nan", {"floor": ("itu_concrete", mesh)}))


def test_faces_without_their_vertices_are_refused_before_mitsuba_reads_them(tmp_path):
    """Mitsuba follows such a face beyond its vertices, which ends the process."""
    mesh = sheet(2, 0.0, (0.0, 1.0), (0.0, 1.0))
    xml, file = write_xml(tmp_path, {"floor": ("itu_concrete", mesh)}), tmp_path / "floor.ply"
    mesh.faces[-1, -1] = 1 << 28
    mesh.export(file)
    refused(r"floor\.ply: cannot be read as a mesh \(a face names a vertex", xml)
    file.unlink()
    refused(r"floor\.ply: cannot be read as a mesh", xml)


def test_remedy_for_a_frequency_out_of_range_opens_the_scene(tmp_path):
    """Brick ends at 40 GHz; the file gets the constants that the message asks for."""
    xml = write_xml(tmp_path, {name: ("itu_brick", part) for name, (_, part) in SHOEBOX.items()})
    with pytest.raises(InputError, match="itu_brick: not known at 47 GHz") as caught:
        open_scene(xml, 47e9)
    (bsdf,) = re.findall("<bsdf.*</bsdf>", str(caught.value))
    bsdf = bsdf.replace("...", "3.9", 1).replace("...", "0.7", 1)
    text = xml.read_text().replace("mat-itu_brick", "mat-my_brick")
    xml.write_text(text.replace('<bsdf type="diffuse" id="mat-my_brick"/>', bsdf))
    (material,) = {id(m): m for m in (o.radio_material for o in open_scene(xml, 47e9).objects.values())}.values()
    assert float(material.relative_permittivity[0]) == pytest.approx(3.9)
    assert float(material.conductivity[0]) == pytest.approx(0.7)


def in_a_room(tmp_path, *parts):
    named = {f"part{k}": ("itu_wood", part) for k, part in enumerate(parts)}
    return scene_surfaces(open_scene(write_xml(tmp_path, {**SHOEBOX, **named}), FREQUENCY_HZ))


def test_antenna_behind_its_wall_is_traced_from_before_it(tmp_path, caplog):
    """Mounted on a wall that the mesh has too far inside."""
    surfaces = in_a_room(tmp_path, sheet(2, 0.7, (2.0, 3.0), (2.0, 3.0)))
    scene, options = open_scene(tmp_path / "scene.xml", FREQUENCY_HZ), TraceOptions(transmission=False, depth=2)
    on, behind, far = (
        np.sort(trace_paths(scene, [[1.0, 2, 1]], receiver([x, 2.5, 1.3]), options).paths.length_m)
        for x in (0.0, -2e-3, -0.02)
    )
    assert len(behind) == len(on) >= 6 > len(far) == 0
    np.testing.assert_allclose(behind, on, atol=2e-4)
    assert "1 of 1 antennas lie up to 1 cm behind a surface (first: receiver rx)" in caplog.text
    assert "1 of 1 receivers have no path (first: receiver rx at (-0.02, 2.50, 1.30) m)" in caplog.text
    # Sheets inside a room have no right side, but an antenna on one has a side; beyond a wall's edges nothing is moved.
    places = np.array([[2.5, 2.5, 0.695], [2.5, 2.5, 0.705], [2.5, 2.5, 0.7], [0.0, 2.5, 1.3], [-2e-3, 9.0, 1.3]])
    clear = clear_m(surfaces)
    assert clear < 2e-4
    moved = [[0.0, 0, 0], [0, 0, 0], [0, 0, clear], [clear, 0, 0], [0, 0, 0]]
    np.testing.assert_allclose(before_surfaces(surfaces, places), places + moved, atol=1e-12)


def test_antenna_on_a_cabinet_is_traced_from_before_it(tmp_path):
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


def test_number_of_rays_for_an_antenna_behind_its_wall_converges_before_it(tmp_path):
    """From behind the wall no ray finds a path, and the smallest number would converge."""
    write_xml(tmp_path, SHOEBOX)
    tx, options = np.array([[1.0, 2, 1], [3.0, 4, 2]]), TraceOptions(depth=2, rays="auto")
    carrier_hz = np.array([FREQUENCY_HZ])
    before, behind = (Instrument("power", (receiver([x, 2.5, 1.3]),), carrier_hz) for x in (1e-4, -2e-3))
    wanted, rays_behind = (RayTracer(tmp_path / "scene.xml", side, options).rays(tx) for side in (before, behind))
    assert rays_behind == wanted


def test_antennas_outside_the_scene_are_named(tmp_path, caplog):
    surfaces = in_a_room(tmp_path, box((-0.2, -0.2, -0.2), (6.2, 5.2, 3.2)))
    caplog.set_level(logging.WARNING)
    check_devices(surfaces, np.array([[1.0, 1, 1], [6.1, 1, 1]]), ["a", "b"])  # within the walls
    check_devices(surfaces, np.zeros((0, 3)), [])  # every position was checked before
    assert not caplog.text
    check_devices(surfaces, np.array([[1.0, 1, 1], [1, -40, 1], [1000, 1, 1]]), ["a", "b", "c"])
    assert "2 of 3 antennas lie outside the scene (first: b, by 39.80 m): check its frame and the unit" in caplog.text


def test_antenna_in_a_solid_object_is_refused(tmp_path):
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


def test_solid_is_named_by_its_mesh_file_where_its_id_is_another(tmp_path):
    """Exporters number shapes, so the id alone does not identify the object."""
    column = box((2, 2, 0), (2.5, 2.5, 2.8))
    xml = write_xml(tmp_path, {**SHOEBOX, "column": ("itu_concrete", column)})
    text = xml.read_text()

    def refused_inside(scene, called):
        with pytest.raises(InputError, match=f"^transmitter 1 at .* is inside the solid {called}; move one of them"):
            trace_paths(scene, [[2.2, 2.3, 1.0]], receiver([1, 1, 2]))

    for id_attribute, called in (('id="mesh-elm__3"', "'elm__3'"), ("", r"'no-name-\d+'")):
        xml.write_text(text.replace('id="column"', id_attribute))
        refused_inside(open_scene(xml, FREQUENCY_HZ), called + r" \(column.ply\)")
    column.export(tmp_path / "pillar.stl")
    refused_inside(open_scene(tmp_path / "pillar.stl", FREQUENCY_HZ, material="wood"), "'pillar'")


def test_coplanar_faces_share_a_plane():
    """Of either orientation, slivers with inexact normals included; parallel and tilted faces do not."""
    wall = np.array([[0.0, 0, 0], [4, 0, 0], [4, 0, 3], [0, 0, 3]])[[[0, 1, 2], [3, 2, 0]]]
    sliver = np.array([[[1, 1e-6, 0], [1.001, 0, 0], [1, 0, 3]]])  # its own normal is 1e-3 rad off
    tilted = np.array([[[0, 0, 0], [4, 0, 0], [4, 0.01, 3]]])
    faces = np.concatenate([wall, sliver, np.add(wall, [0, 0.01, 0]), tilted])
    surfaces = find_planes(("a",), np.array([7], np.uint32), np.array([0, len(faces)]), faces)
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


def test_fine_and_coarse_walls_give_the_same_paths(shoebox_xml, tmp_path):
    parts, traced_paths = (
        {name: (material, mesh.subdivide().subdivide()) for name, (material, mesh) in SHOEBOX.items()},
        [],
    )
    for xml in (shoebox_xml, write_xml(tmp_path, parts)):
        scene = open_scene(xml, FREQUENCY_HZ)
        assert len(scene_surfaces(scene).normal) == 6
        traced_paths.append(trace_paths(scene, [[1.3, 2, 1]], receiver([4.4, 3.1, 1.7]), TraceOptions()).paths)
    np.testing.assert_allclose(traced_paths[1].length_m, traced_paths[0].length_m, atol=1e-9)
    np.testing.assert_allclose(
        traced_paths[1].gain, traced_paths[0].gain, atol=1e-5 * np.abs(traced_paths[0].gain).max()
    )


def test_planes_are_found_once_until_an_object_moves(shoebox_xml):
    scene = open_scene(shoebox_xml, FREQUENCY_HZ)
    before = scene_surfaces(scene)
    assert scene_surfaces(scene) is before
    name = before.names[0]
    scene.objects[name].position = np.asarray(scene.objects[name].position).ravel() + np.array([0, 0, 0.5])
    after, of_object = scene_surfaces(scene), before.object_of(np.arange(len(before.triangles))) == 0
    np.testing.assert_allclose(
        after.triangles[of_object] - before.triangles[of_object],
        np.broadcast_to([0, 0, 0.5], (of_object.sum(), 3, 3)),
        atol=1e-6,
    )
    np.testing.assert_array_equal(after.triangles[~of_object], before.triangles[~of_object])


def test_planes_near_points_are_those_within_a_margin(monkeypatch):
    rng, mesh = np.random.default_rng(0), cluttered_room(3000, np.zeros((1, 3)))
    surfaces = find_planes(
        ("room",), np.zeros(1, np.uint32), np.array([0, len(mesh.faces)]), np.asarray(mesh.triangles)
    )
    points_m = np.concatenate(
        [mesh.triangles_center[::7] + 0.004, rng.uniform(mesh.bounds[0], mesh.bounds[1], (200, 3))]
    )
    pairs = [set(zip(*map(np.ndarray.tolist, surfaces.near(points_m, 0.01)), strict=True))]
    monkeypatch.setattr(surfaces_module, "FEW_PLANES", 10**6)
    pairs.append(set(zip(*map(np.ndarray.tolist, surfaces.near(points_m, 0.01)), strict=True)))
    assert pairs[0] == pairs[1]
    # Those whose own rectangle is near are all among them.
    away = np.einsum("nc,qc->nq", points_m, surfaces.normal) - surfaces.offset
    along = np.einsum("nc,qac->nqa", points_m, surfaces.axes)
    inside = (np.abs(away) < 0.01) & ((along > surfaces.low) & (along < surfaces.high)).all(axis=2)
    near = np.zeros_like(inside)
    near[tuple(np.array(sorted(pairs[0])).T)] = True
    assert inside.any(axis=1).mean() > 0.5
    assert (near | ~inside).all()
    assert (np.abs(away[near]) < 0.01).all()


BRICK = '<bsdf type="diffuse" id="mat-itu_brick"/>'
SOAK = '<bsdf type="absorber-radio-material" id="mat-soak"><rgb name="color" value="0.1 0.2 0.3"/></bsdf>'
OPTIONS = TraceOptions(depth=2, transmission=True)


def absorbing(path):
    """The scene file with an absorber in the place of brick."""
    path.write_text(path.read_text().replace(BRICK, SOAK).replace("mat-itu_brick", "mat-soak"))
    return path


def paths_in(xml, **how):
    scene = open_scene(xml, FREQUENCY_HZ)
    return trace_paths(scene, [[1.3, 2, 1]], receiver([4.4, 3.1, 1.7]), OPTIONS, **how).paths


def test_absorbers_neither_reflect_nor_transmit(tmp_path):
    """West and east walls alone are of brick, so that the room without them has the other paths."""
    room = absorbing(write_xml(tmp_path / "absorbing", SHOEBOX))
    walls = {name: part for name, part in SHOEBOX.items() if part[0] != "itu_brick"}
    paths, open_paths = paths_in(room), paths_in(write_xml(tmp_path / "open", walls))
    assert len(paths) > 8
    np.testing.assert_allclose(paths.gain, open_paths.gain, rtol=1e-6)
    without_gains = paths_in(room, gains=False)
    assert len(without_gains) == len(paths)
    assert not np.isin(np.array([*without_gains.object_names, ""])[without_gains.objects], ["west", "east"]).any()
    screen = {"screen": ("itu_brick", SHOEBOX["west"][1].copy().apply_translation([3, 0, 0]))}
    assert not len(paths_in(absorbing(write_xml(tmp_path / "screen", {**SHOEBOX, **screen}))))


def test_absorbers_stay_in_exported_and_edited_scenes(tmp_path):
    room, exported = absorbing(write_xml(tmp_path / "room", SHOEBOX)), tmp_path / "exported"
    facts = ["--frequency", str(FREQUENCY_HZ), "--out", str(exported)]
    assert main(["export", str(room), "--format", "sionna", *facts]) == 0
    assert json.loads((exported / "materials.json").read_text())["materials"][ABSORBER] == {"absorbs": True}
    np.testing.assert_allclose(paths_in(exported / "scene.xml").gain, paths_in(room).gain, rtol=1e-6)

    folder = stated_scene(tmp_path / "folder", {"board": ABSORBER})
    edited = edit_scene(folder, tmp_path / "edited", [Move(("board",), (0.1, 0.0, 0.0))])
    assert read_materials(edited).surfaces["board"] == ABSORBER
    for place in (folder, edited):
        assert open_scene(place, FREQUENCY_HZ).objects["board"].radio_material.name == ABSORBER


def test_correction_leaves_absorbers_alone(tmp_path):
    true = stated_scene(tmp_path / "true", {**TRUE_MATERIALS, "wall_02": ABSORBER})
    uncorrected_scene = stated_scene(tmp_path / "stated", {"wall_02": ABSORBER})
    csi = channels(true, 70)
    power_db = 10 * np.log10(np.square(np.abs(csi.observation)).mean(axis=2)).astype(np.float32)
    record = replace(csi, task="rssi", observation=power_db, frequencies_hz=csi.frequencies_hz[:1])
    options = replace(default_options(record), rows=40, rays=4096, depth=2)
    correction = correct_scene(uncorrected_scene, record, make_splits(record, "official")[0], options)
    assert correction.kept == "materials+gain"
    fitted = {name.partition("/")[0] for name in correction.misfit.traced_fields[0].slabs.names}
    assert fitted == set(TRUE_MATERIALS) - {"wall_02"}
    write_page(correction, tmp_path / "page")
    assert read_materials(tmp_path / "page").surfaces["wall_02"] == ABSORBER
    assert open_scene(tmp_path / "page", FREQUENCY_HZ).objects["wall_02"].radio_material.name == ABSORBER
