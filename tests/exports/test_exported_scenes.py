"""Exported scenes: opened by plain Sionna RT, Mitsuba and trimesh."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from changed_folders import error_line
from commands import Command
from traced_rooms import SHOEBOX, write_xml
from trimesh.visual import ColorVisuals

from wrf_mi import backend
from wrf_mi.apps.exports import ExportOptions, export
from wrf_mi.runs.api import train
from wrf_mi.scene.folder import write_scene
from wrf_mi.scene.make import make_scene
from wrf_mi.scene.materials import Materials
from wrf_mi.scene.mesh.surfaces import Surface
from wrf_mi.tracing import open_scene
from wrf_mi.tracing.paths.corrected_scene import write_corrected_scene
from wrf_mi.tracing.paths.scene_parameters import name_of
from wrf_mi.tracing.search.surfaces import scene_surfaces

SINGLE = 1e-6
"""Constants of materials are in single precision."""
OWN = {"relative_permittivity": 2.9, "conductivity": 0.01, "thickness": 0.08}
LAW = {"conductivity_exponent": 0.8, "carrier_hz": 2.4e9}


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A shoebox with a thickness of its own, a material of its own with a law, and a perfect conductor."""
    parts = [Surface(name, "other", np.asarray(mesh.vertices), mesh.faces) for name, (_, mesh) in SHOEBOX.items()]
    surfaces = {name: material for name, (material, _) in SHOEBOX.items()} | {"east": "panel", "west": "perfect"}
    materials = Materials(surfaces=surfaces, thickness_m={"itu_concrete": 0.37}, constants={"panel": OWN | LAW})
    return write_scene(tmp_path_factory.mktemp("scene") / "s", parts, frame="made", source="test", materials=materials)


def constants(scene: Any) -> dict[str, list[float]]:
    """Permittivity, conductivity and thickness of each object's material."""
    return {
        name: [
            float(np.ravel(getattr(thing.radio_material, constant))[0])
            for constant in ("relative_permittivity", "conductivity", "thickness")
        ]
        for name, thing in scene.objects.items()
    }


def triangles(scene: Any) -> np.ndarray:
    """Triangles [f, 3, 3] of an opened scene or of a mesh in an order that does not depend on the file's."""
    corners = scene if isinstance(scene, np.ndarray) else scene_surfaces(scene).triangles
    flat = np.round(np.sort(corners.reshape(len(corners), 9), axis=1), 5)
    return flat[np.lexsort(flat.T)]


@pytest.mark.parametrize("frequency_hz", [915e6, 2.4e9, 5.8e9])
def test_plain_sionna_has_the_same_materials_and_mesh(scene: Path, tmp_path: Path, frequency_hz: float) -> None:
    backend.init()
    from sionna import rt

    export(scene, "sionna", tmp_path / "out", ExportOptions(frequency_hz=frequency_hz))
    plain = rt.load_scene(str(tmp_path / "out" / "scene.xml"), merge_shapes=False)
    plain.frequency = frequency_hz
    ours = open_scene(scene, frequency_hz)
    expected = constants(ours)
    assert expected["floor"][2] == pytest.approx(0.37)
    assert expected["east"][1] == pytest.approx(0.01 * (frequency_hz / 2.4e9) ** 0.8, rel=SINGLE)
    for name, values in constants(plain).items():
        assert values == pytest.approx(expected.pop(name), rel=SINGLE), name
    assert not expected
    theirs, our_surfaces = scene_surfaces(plain), scene_surfaces(ours)
    assert theirs.names == our_surfaces.names
    for index in range(len(our_surfaces.names)):
        faces = slice(our_surfaces.first_face[index], our_surfaces.first_face[index + 1])
        np.testing.assert_array_equal(theirs.triangles[faces], our_surfaces.triangles[faces])
    facts = json.loads((tmp_path / "out" / "materials.json").read_text())["materials"]
    assert facts["panel"]["conductivity_exponent"] == 0.8
    assert facts["panel"]["follows_frequency"] is False
    if frequency_hz > 1e9:  # within their range materials of ITU-R P.2040 follow a new frequency
        plain.frequency = 10e9
        again = constants(open_scene(scene, 10e9))
        for name in ("floor", "ceiling"):
            assert constants(plain)[name] == pytest.approx(again[name], rel=SINGLE)


def test_sionna_merging_shapes_and_mitsuba_without_sionna_open_it(scene: Path, tmp_path: Path) -> None:
    import mitsuba as mi
    from sionna import rt

    export(scene, "sionna", tmp_path / "out", ExportOptions(frequency_hz=2.4e9))
    assert rt.load_scene(str(tmp_path / "out" / "scene.xml")).objects
    assert "radio-material" not in (tmp_path / "out" / "mitsuba.xml").read_text()
    box = mi.load_file(str(tmp_path / "out" / "mitsuba.xml")).bbox()
    np.testing.assert_allclose([np.array(box.min), np.array(box.max)], [[0, 0, 0], [6, 5, 3]])
    # After the import of Sionna RT, the scene file, too.
    shapes = mi.load_file(str(tmp_path / "out" / "scene.xml")).shapes()
    assert sum(shape.face_count() for shape in shapes) == 2 * len(SHOEBOX)


def test_glb_has_named_surfaces_and_materials_and_is_the_scene_again(scene: Path, tmp_path: Path) -> None:
    """In its place and upright, as a bare mesh and as a scene folder."""
    export(scene, "glb", tmp_path / "scene.glb")
    read, opened_scene = trimesh.load_scene(tmp_path / "scene.glb"), open_scene(scene, 2.4e9)
    assert set(read.geometry) == set(opened_scene.objects)
    surfaces = scene_surfaces(opened_scene)
    for index, name in enumerate(surfaces.names):
        mesh = read.geometry[name]
        assert mesh.visual.material.name == opened_scene.objects[name].radio_material.name
        x, y, z = mesh.vertices.T
        theirs = np.stack([x, -z, y], axis=-1)[mesh.faces]  # from glTF's y up to z up
        ours = surfaces.triangles[surfaces.first_face[index] : surfaces.first_face[index + 1]]
        np.testing.assert_array_equal(triangles(theirs), triangles(ours))
    bare = open_scene(tmp_path / "scene.glb", 2.4e9, material="concrete")
    again = open_scene(make_scene(tmp_path / "scene.glb", tmp_path / "again").folder, 2.4e9)
    np.testing.assert_array_equal(triangles(bare), triangles(opened_scene))
    np.testing.assert_array_equal(triangles(again), triangles(opened_scene))


def test_ply_has_colours_materials_and_is_a_scene_again(scene: Path, tmp_path: Path) -> None:
    facts = export(scene, "ply", tmp_path / "scene.ply")
    assert facts == {"surfaces": 6, "faces": 12, "materials": 4}
    mesh = trimesh.load_mesh(tmp_path / "scene.ply", process=False)
    head = (tmp_path / "scene.ply").read_bytes().partition(b"end_header")[0].decode()
    names = {
        kind: [line.split()[3] for line in head.splitlines() if f"comment {kind}" in line]
        for kind in ("material", "surface")
    }
    stored = mesh.metadata["_ply_raw"]["face"]["data"]
    opened_scene = open_scene(scene, 2.4e9)
    for surface, material in zip(stored["surface"].ravel(), stored["material"].ravel(), strict=True):
        assert names["material"][material] == opened_scene.objects[names["surface"][surface]].radio_material.name
    assert isinstance(mesh.visual, ColorVisuals)
    assert mesh.visual.face_colors[0][:3].tolist() == [115, 115, 115]  # concrete
    np.testing.assert_array_equal(triangles(np.array(mesh.triangles)), triangles(opened_scene))
    again = open_scene(make_scene(tmp_path / "scene.ply", tmp_path / "again").folder, 2.4e9)
    np.testing.assert_array_equal(triangles(again), triangles(opened_scene))


def test_corrected_scene_of_a_run_is_exported(flat_folder: Path, room: Path, tmp_path: Path) -> None:
    run = train(flat_folder, "ray-tracing", out=tmp_path / "run", scene=room, settings=["depth=0"]).folder
    assert export(run, "ply", tmp_path / "room.ply")["surfaces"] == 6
    # What a calibration of materials leaves in the run folder.
    fitted = {name_of("itu_concrete", "permittivity"): np.log([3.0])}
    write_corrected_scene(run / "corrected", open_scene(room, 2.44e9), fitted)
    facts = export(run, "sionna", tmp_path / "out")
    assert facts["constants at 2.44 GHz"] == "fitted_itu_concrete"
    from sionna import rt

    plain = rt.load_scene(str(tmp_path / "out" / "scene.xml"), merge_shapes=False)
    plain.frequency = 2.44e9
    expected = constants(open_scene(run / "corrected", 2.44e9))
    assert expected["floor"][0] == pytest.approx(4.0)
    for name, values in constants(plain).items():
        assert values == pytest.approx(expected[name], rel=SINGLE)


def test_bare_mesh_needs_a_material_and_a_scene_a_carrier(tmp_path: Path, command: Command) -> None:
    mesh = tmp_path / "box.stl"
    trimesh.creation.box((4, 3, 2.5)).export(mesh)
    out = tmp_path / "x"
    for source, layout, message in (
        (mesh, "glb", "a mesh has no radio material"),
        (write_xml(tmp_path, SHOEBOX), "sionna", "by --frequency HZ"),
        (mesh, "npz", "a scene; format npz takes a data set"),
        ("no-such", "glb", "no such file or name"),
    ):
        suffix = "" if layout == "sionna" else f".{layout}"
        command.refused(["export", source, "--format", layout, "--out", f"{out}{suffix}"], message)
    assert export(mesh, "glb", f"{out}.glb", ExportOptions(material="brick"))["materials"] == 1
    error_line(export, mesh, "obj", out, "unknown; choose from 3dgs")


@pytest.mark.parametrize("frequency_hz", [2.4e9, 0.9e9])
def test_names_of_other_scenes_are_written_as_names_of_files(frequency_hz: float, tmp_path: Path) -> None:
    """ITU materials by names of the scene's own, two of one kind; folders and quotes in the ids of shapes."""
    thickness_m = {"wall.001": 0.2, "wall 001": 0.31, "my-metal": 0.05}
    kinds = dict(zip(thickness_m, ("concrete", "concrete", "metal"), strict=True))
    bsdfs = [
        f'<bsdf type="itu-radio-material" id="mat-{name}"><string name="type" value="{kinds[name]}"/>'
        f'<float name="thickness" value="{depth}"/></bsdf>'
        for name, depth in thickness_m.items()
    ]
    ids = dict(zip(["mesh-../../up", "mesh-a b", "mesh-a&quot;b", "mesh-a_b"], [*thickness_m, "my-metal"], strict=True))
    shapes = [
        f'<shape type="rectangle" id="{shape}"><ref id="mat-{name}"/><transform name="to_world">'
        f'<translate z="{number}"/></transform></shape>'
        for number, (shape, name) in enumerate(ids.items())
    ]
    path = tmp_path / "scene.xml"
    path.write_text("\n".join(['<scene version="3.0.0">', *bsdfs, *shapes, "</scene>"]))
    original_scene = open_scene(path, frequency_hz)
    export(path, "sionna", tmp_path / "for-sionna", ExportOptions(frequency_hz=frequency_hz))
    write_corrected_scene(tmp_path / "corrected", original_scene, {})
    for written in (tmp_path / "for-sionna" / "scene.xml", tmp_path / "corrected"):
        again = open_scene(written, frequency_hz)
        assert list(again.objects) == [".._.._up", "a_b", "a_b_2", "a_b_3"]
        np.testing.assert_allclose([*constants(again).values()], [*constants(original_scene).values()], rtol=1e-4)
    assert not (tmp_path.parent / "up.ply").exists()
