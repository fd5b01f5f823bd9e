"""Scene folders: written whole, opened by both tracers, materials that follow one file, paths as in the real room."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from made_rooms import closed_box, sampled, scene_file
from wrf_mi_scenes.build_laboratory import sheet
from wrf_mi_scenes.mitsuba_xml import THICKNESS_M

from wrf_mi import backend
from wrf_mi.core import InputError
from wrf_mi.scene.folder import read_scene_folder, write_scene
from wrf_mi.scene.make import make_scene
from wrf_mi.scene.materials import Materials, read_materials
from wrf_mi.scene.mesh.surfaces import Surface, number_names
from wrf_mi.scene.scan import simulate_scan
from wrf_mi.tracing import open_scene
from wrf_mi.tracing.sionna.materials import perfect_reflector

FREQUENCY_HZ = 2.4e9


def surface(name: str, kind: Any, z: float) -> Surface:
    mesh = sheet(2, z, (0.0, 4.0), (0.0, 3.0))
    return Surface(name, kind, np.asarray(mesh.vertices), np.asarray(mesh.faces))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    surfaces = [surface("floor", "floor", 0.0), surface("ceiling", "ceiling", 2.5), surface("table", "other", 0.7)]
    return write_scene(tmp_path / "scene", surfaces, frame="made up", source="test", counts={"points": 7})


def test_a_folder_is_read_as_written(folder: Path) -> None:
    read = read_scene_folder(folder)
    assert sorted(path.name for path in folder.iterdir()) == [
        "materials.yml",
        "meshes",
        "preview.png",
        "scene.xml",
        "scene.yml",
    ]
    facts = yaml.safe_load((folder / "scene.yml").read_text())
    assert (facts["frame"], facts["source"], facts["registration"]) == ("made up", "test", None)
    assert read.counts == {"surfaces": 3, "faces": 6, "points": 7}
    assert read.materials.of("table", "other") == "itu_wood"
    assert read.materials.thickness_m["itu_concrete"] == THICKNESS_M["itu_concrete"]


def test_mitsuba_and_sionna_open_it(folder: Path) -> None:
    backend.init()
    import mitsuba as mi
    from sionna import rt

    low_high = [[0, 0, 0], [4, 3, 2.5]]
    box = mi.load_file(str(folder / "scene.xml")).bbox()
    np.testing.assert_allclose([np.array(box.min), np.array(box.max)], low_high)
    scene = rt.load_scene(str(folder / "scene.xml"), merge_shapes=False)
    materials = {name: one.radio_material.name for name, one in scene.objects.items()}
    assert materials == {"floor": "itu_concrete", "ceiling": "itu_ceiling_board", "table": "itu_wood"}


def test_editing_the_materials_changes_the_scene(folder: Path) -> None:
    facts = yaml.safe_load((folder / "materials.yml").read_text())
    facts["rules"]["floor"] = "itu_marble"
    facts["surfaces"]["table"] = "itu_metal"
    facts["thickness_m"]["itu_metal"] = 0.005
    (folder / "materials.yml").write_text(yaml.safe_dump(facts))
    scene = open_scene(folder, FREQUENCY_HZ)
    materials = {name: one.radio_material for name, one in scene.objects.items()}
    assert {name: one.name for name, one in materials.items()} == {
        "floor": "itu_marble",
        "ceiling": "itu_ceiling_board",
        "table": "itu_metal",
    }
    assert float(materials["table"].thickness[0]) == pytest.approx(0.005)
    assert float(materials["floor"].thickness[0]) == pytest.approx(THICKNESS_M["itu_marble"])
    before = (folder / "scene.xml").stat().st_mtime_ns
    read_scene_folder(folder)
    assert (folder / "scene.xml").stat().st_mtime_ns == before


def test_a_perfect_conductor_is_a_material_of_a_scene_folder(folder: Path) -> None:
    """As ``--material perfect`` is of a bare mesh; Sionna RT opens the scene file by itself, too."""
    facts = yaml.safe_load((folder / "materials.yml").read_text())
    facts["rules"]["floor"] = facts["surfaces"]["table"] = "perfect"
    facts["thickness_m"] = {"perfect": 0.3}
    (folder / "materials.yml").write_text(yaml.safe_dump(facts))
    scene = open_scene(folder, FREQUENCY_HZ)
    of = {name: one.radio_material for name, one in scene.objects.items()}
    assert [of[name].name for name in ("floor", "table", "ceiling")] == ["perfect", "perfect", "itu_ceiling_board"]
    expected = perfect_reflector()
    for key in ("relative_permittivity", "conductivity"):
        assert float(getattr(of["floor"], key)[0]) == float(getattr(expected, key)[0])
    assert float(of["floor"].thickness[0]) == pytest.approx(0.3)
    from sionna import rt

    assert len(rt.load_scene(str(folder / "scene.xml"), merge_shapes=False).objects) == 3


PANEL = "constants: {{panel: {{relative_permittivity: 2.9, conductivity: 0.01, thickness: 0.08, {}}}}}"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "rules: {floor: marble}",
            r"floor: unknown material 'marble'; known are itu_vacuum, .*itu_wet_ground, perfect",
        ),
        ("rules: {roof: itu_wood}", r"rules: no kind 'roof'; known are floor, ceiling, wall, other"),
        ("surfaces: {table: iron}", r"surfaces: table: unknown material 'iron'; known are floor, .*itu_metal"),
        ("thickness_m: {itu_wood: -1}", r"thickness_m: itu_wood is -1; give metres above 0"),
        ("thickness_m: {itu_wood: thin}", r"thickness_m: itu_wood is 'thin'; give metres above 0"),
        ("walls: {}", r"give the keys rules, surfaces, thickness_m, constants, no others"),
        ("rules: itu_wood", r"rules must be a mapping"),
        ("rules: {", r"not YAML"),
        (
            PANEL.format("conductivity_exponent: 1"),
            r"panel: give relative_permittivity, .* with",
        ),
        (PANEL.format("conductivity_exponent: 9, carrier_hz: 1.0e+9"), r"conductivity_exponent is 9; give -5 to 5"),
        (PANEL.format("conductivity_exponent: 1, carrier_hz: 0"), r"carrier_hz is 0; give a number from 0 upwards"),
    ],
)
def test_unusable_materials_are_refused(text: str, message: str, folder: Path) -> None:
    (folder / "materials.yml").write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        read_scene_folder(folder)
    assert "\n" not in str(caught.value)
    assert "materials.yml" in str(caught.value)


def test_every_material_is_known_to_sionna() -> None:
    backend.init()
    from sionna.rt.radio_materials.itu import ITU_MATERIALS_PROPERTIES

    assert {name.removeprefix("itu_") for name in THICKNESS_M} == set(ITU_MATERIALS_PROPERTIES)


def test_incomplete_folders_are_refused(folder: Path) -> None:
    (folder / "meshes" / "table.ply").unlink()
    with pytest.raises(InputError, match=r"surface 'table' has no mesh"):
        read_scene_folder(folder)
    (folder / "scene.yml").write_text("frame: x\n")
    with pytest.raises(InputError, match=r"scene.yml: no xml in it"):
        read_scene_folder(folder)
    (folder / "scene.yml").unlink()
    with pytest.raises(InputError, match=r"scene.yml: missing"):
        read_scene_folder(folder)


def test_scene_folder_is_written_atomically(tmp_path: Path) -> None:
    out = tmp_path / "scene"
    with pytest.raises(InputError, match=r"no surface was found"):
        write_scene(out, [], frame="", source="scan.ply")
    floor = surface("floor", "floor", 0.0)
    with pytest.raises(InputError, match=r"materials: no surface 'wall' in this scene; it has floor"):
        write_scene(out, [floor], frame="", source="", materials=Materials(surfaces={"wall": "itu_glass"}))
    broken = Surface("bad", "other", np.empty((0, 3)), np.array([[0, 1, 2]]))
    with pytest.raises(IndexError):
        write_scene(out, [floor, broken], frame="", source="")
    assert list(tmp_path.iterdir()) == []


def test_names() -> None:
    assert number_names(["wall", "floor", "wall"]) == ["wall_01", "floor", "wall_02"]


def test_a_scan_becomes_a_folder_in_a_registered_frame(tmp_path: Path) -> None:
    np.savez(tmp_path / "scan.npz", points=1000 * sampled(closed_box(), 20_000))
    (tmp_path / "mine.yml").write_text("rules: {wall: itu_brick}\nthickness_m: {itu_brick: 0.12}\n")
    quarter = np.array([[0, -1, 0, 10], [1, 0, 0, 20], [0, 0, 1, 1], [0, 0, 0, 1.0]])
    made = make_scene(
        tmp_path / "scan.npz",
        tmp_path / "out",
        units="mm",
        materials=tmp_path / "mine.yml",
        registration=quarter,
    )
    assert made.counts == {"surfaces": 6, "faces": 12, "points": 20_200}
    np.testing.assert_array_equal(yaml.safe_load((made.folder / "scene.yml").read_text())["registration"], quarter)
    assert made.materials.of("wall_01", "wall") == "itu_brick"
    assert made.materials.thickness_m["itu_brick"] == 0.12
    scene = open_scene(made.folder, FREQUENCY_HZ)
    box = scene.mi_scene.bbox()
    np.testing.assert_allclose([np.array(box.min), np.array(box.max)], [[6, 20, 1], [10, 25, 3.8]], atol=0.01)
    read_materials(made.folder)  # a folder stands for its file


def test_a_mesh_becomes_a_folder(tmp_path: Path) -> None:
    closed_box()[0].export(tmp_path / "room.stl")
    made = make_scene(tmp_path / "room.stl", tmp_path / "out")
    assert made.counts == {"surfaces": 6, "faces": 12}
    assert made.materials.surfaces == {"floor": "floor", "ceiling": "ceiling"} | {
        f"wall_0{i}": "wall" for i in range(1, 5)
    }


def test_a_layout_becomes_a_folder(tmp_path: Path) -> None:
    (tmp_path / "layout.csv").write_text("x,y\n0,0\n5,0\n5,4\n0,4\n0,0\n")
    made = make_scene(tmp_path / "layout.csv", tmp_path / "out", height_m=2.5, floor_m=1.0)
    assert made.counts == {"surfaces": 6, "faces": 12}
    box = open_scene(made.folder, FREQUENCY_HZ).mi_scene.bbox()
    np.testing.assert_allclose([np.array(box.min), np.array(box.max)], [[0, 0, 1], [5, 4, 3.5]], atol=1e-6)


def test_simulated_scan_has_the_stated_noise_and_strays(tmp_path: Path) -> None:
    xml = scene_file(tmp_path, closed_box())
    pose = np.array([2.0, 1.5, 1.3])
    points = simulate_scan(xml, pose, rays_per_pose=20_000, seed=3)
    again = simulate_scan(xml, pose, rays_per_pose=20_000, seed=3)
    np.testing.assert_array_equal(points, again)
    assert len(points) == 20_000
    direction = points - pose
    distance = np.linalg.norm(direction, axis=1)
    direction /= distance[:, None]
    # Along each ray the box's nearest face in closed form.
    with np.errstate(divide="ignore"):
        to_walls = np.where(direction > 0, ([5, 4, 2.8] - pose) / direction, -pose / direction)
    error = distance - to_walls.min(axis=1)
    near = np.abs(error) < 0.1
    # Of the 1 % strays, uniform over the range, a few lie within 0.1 m of their surface.
    assert 0.988 <= near.mean() <= 0.993
    assert error[near].std() == pytest.approx(0.02, rel=0.05)
    with pytest.raises(InputError, match="no ray met the scene"):
        simulate_scan(scene_file(tmp_path / "sheet", [sheet(2, 0.0, (0, 1), (0, 1))]), [9.0, 9.0, 9.0], rays_per_pose=9)
