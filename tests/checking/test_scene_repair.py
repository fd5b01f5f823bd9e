"""Repair of scenes: what is written opens and traces in plain Sionna RT, and nothing else is written."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml
from calling import call, refused
from changed_folders import DATA, needs
from damaged_scenes import DAMAGES, Damaged, damaged_scene
from wrf_mi_scenes.mitsuba_xml import write_scene
from wrf_mi_scenes.random_rooms import random_room

from wrf_mi.apps.checking import Repair, check_scene, repair_scene
from wrf_mi.apps.checking.triangle_faults import wound_one_way
from wrf_mi.core import InputError
from wrf_mi.scene.material_names import ascii_name, meant
from wrf_mi.tracing.sionna.scenes import open_scene

CARRIER_HZ = 3.5e9
DECIBELS = 1e-3  # largest change of a path by single precision
NOT_REPAIRED = ("xml", "parameter", "transform", "unsupported-shape", "mesh", "not-finite", "far", "material-range")
"""Kinds of faults that need a person, in the damaged scenes: of ``far`` there one wall alone is far away."""
SAME_GEOMETRY = ("missing-file", "duplicate-faces", "mixed-winding", "double-sheet")
"""Some kinds after whose repair the scene is the one that was damaged."""


def gains_db(xml: Path) -> np.ndarray:
    """Gains in dB of the paths between two places of a room, in plain Sionna RT, with transmission."""
    from sionna import rt

    scene = rt.load_scene(str(xml), merge_shapes=False)
    scene.frequency = CARRIER_HZ
    scene.tx_array = scene.rx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="V")
    low, high = np.array(scene.mi_scene.bbox().min).ravel(), np.array(scene.mi_scene.bbox().max).ravel()
    for kind, name, share in ((rt.Transmitter, "tx", 0.23), (rt.Receiver, "rx", 0.71)):
        scene.add(kind(name, (low + (high - low) * [share, 0.61, share + 0.12]).tolist()))
    paths = rt.PathSolver()(scene, max_depth=2, refraction=True)
    gain = np.abs(paths.cir(out_type="numpy")[0]).ravel()
    return np.sort(20 * np.log10(gain[gain > 0]))


def repaired(kind: str, folder: Path, turn: int = 0, material: str | None = "concrete") -> tuple[Repair, Damaged]:
    damaged = damaged_scene(kind, turn, folder / "damaged")
    return repair_scene(damaged.folder / "scene.xml", folder / "repaired", material=material), damaged


@pytest.mark.parametrize("turn", [0, 1])
@pytest.mark.parametrize("kind", [kind for kind in DAMAGES if kind not in (*NOT_REPAIRED, "units")])
def test_repaired_scene_opens_in_sionna(kind, turn, tmp_path):
    from sionna import rt

    repair, damaged = repaired(kind, tmp_path, turn)
    assert repair.folder is not None, repair.lines()
    assert not repair.unrepaired
    assert repair.after is not None
    assert repair.after.ok
    for merged in (True, False):
        assert rt.load_scene(str(repair.folder / "scene.xml"), merge_shapes=merged).objects
    left = {f.kind for f in repair.after.findings} - {"moved", "up-axis", "no-constants", "device-inside"}
    assert left <= {"party-wall"}
    assert damaged.text == (damaged.folder / "scene.xml").read_text("utf-8")


@pytest.mark.parametrize("kind", SAME_GEOMETRY)
def test_repaired_scene_has_the_paths_of_the_whole_one(kind, tmp_path):
    undamaged_scene = damaged_scene(kind, 0, tmp_path / "whole", damage=False)
    expected = gains_db(undamaged_scene.folder / "scene.xml")
    repair, _ = repaired(kind, tmp_path)
    assert repair.folder is not None, repair.lines()
    np.testing.assert_allclose(gains_db(repair.folder / "scene.xml"), expected, atol=DECIBELS)


@pytest.mark.parametrize("kind", [*NOT_REPAIRED, "units"])
def test_nothing_is_written_where_a_fault_stays(kind, tmp_path):
    for turn in range(3):
        repair, _ = repaired(kind, tmp_path / str(turn), turn)
        if repair.folder is None:
            assert kind in {f.kind for f in repair.unrepaired}
            assert [path.name for path in (tmp_path / str(turn)).iterdir()] == ["damaged"]
            assert repair.lines()[-1].startswith("nothing was written")
        else:
            assert kind == "mesh"  # whose file of another name was found


@needs("fdtd-toy")
def test_old_scene_of_blender_opens_after_repair(tmp_path):
    for number, file in enumerate(sorted((DATA / "fdtd-toy").rglob("*.xml"))):
        repair = repair_scene(file, tmp_path / "none")
        assert {f.kind for f in repair.unrepaired} == {"no-material"}
        assert not (tmp_path / "none").exists()
        repair = repair_scene(file, tmp_path / str(number), material="itu_concrete")
        assert repair.folder is not None
        assert len(gains_db(repair.folder / "scene.xml"))


def test_concave_polygons_shapes_and_transforms_keep_their_area(tmp_path):
    (tmp_path / "l.obj").write_text("v 0 0 0\nv 4 0 0\nv 4 1 0\nv 1 1 0\nv 1 4 0\nv 0 4 0\nf 3 4 5 6 1 2\n")
    bsdf = '<bsdf type="itu-radio-material" id="mat-w"><string name="type" value="wood"/></bsdf>'
    ref = '<ref id="mat-w" name="bsdf"/>'
    moved = '<transform name="to_world"><rotate x="1" angle="90"/><scale value="2"/><translate z="1"/></transform>'
    shapes = (
        f'<shape type="obj" id="mesh-l"><string name="filename" value="l.obj"/>{moved}{ref}</shape>'
        f'<shape type="rectangle" id="mesh-r">{moved}{ref}</shape><shape type="cube" id="mesh-c">{ref}</shape>'
        f'<shape type="sphere" id="mesh-s"><point name="center" x="9" y="0" z="0"/>{ref}</shape>'
    )
    path = tmp_path / "scene.xml"
    path.write_text(f'<scene version="3.0.0">{bsdf}{shapes}</scene>', encoding="utf-8")
    repair = repair_scene(path, tmp_path / "out")
    assert repair.folder is not None
    meshes = {name: trimesh.load_mesh(repair.folder / "meshes" / f"{name}.ply") for name in "lrcs"}
    np.testing.assert_allclose([meshes[name].area for name in "lrc"], [4 * 7, 4 * 4, 24], rtol=1e-6)
    np.testing.assert_allclose(meshes["l"].bounds, [[0, 0, 1], [8, 0, 9]], atol=1e-5)
    assert 0.97 < meshes["s"].area / (4 * np.pi) < 1
    np.testing.assert_allclose(meshes["s"].bounds.mean(axis=0), [9, 0, 0], atol=1e-5)


def test_national_grid_is_shifted_and_stated(tmp_path):
    box = trimesh.creation.box((5.3, 4.2, 2.5))
    box.apply_translation([701_302.65, 4_485_502.1, 612.25])
    rows = [("v", *(f"{value:.3f}" for value in vertex)) for vertex in box.vertices]
    rows += [("f", *map(str, face)) for face in box.faces + 1]
    (tmp_path / "utm.obj").write_text("\n".join(map(" ".join, rows)))
    assert [f.kind for f in check_scene(tmp_path / "utm.obj").of_level("fault")] == ["far"]
    repair = repair_scene(tmp_path / "utm.obj", tmp_path / "out", material="brick")
    facts = yaml.safe_load((tmp_path / "out" / "scene.yml").read_text())
    assert facts["origin_m"] == [701_300, 4_485_500, 0]
    mesh = trimesh.load_mesh(tmp_path / "out" / "meshes" / "utm.ply")
    np.testing.assert_allclose(mesh.bounds, [[0.0, 0, 611], [5.3, 4.2, 613.5]], atol=1e-3)
    assert repair.done[0].startswith("origin: 701300, 4485500, 0 m subtracted")


def test_units_and_up_are_taken_from_options_alone(tmp_path):
    box = trimesh.creation.box((5000, 2600, 6000))
    box.export(tmp_path / "room.stl")
    assert {f.kind for f in check_scene(tmp_path / "room.stl").findings} == {"format", "units"}
    refused_repair = repair_scene(tmp_path / "room.stl", tmp_path / "no", material="brick")
    assert [f.kind for f in refused_repair.unrepaired] == ["units"]
    repair_scene(tmp_path / "room.stl", tmp_path / "out", material="brick", units="mm", up="y")
    mesh = trimesh.load_mesh(tmp_path / "out" / "meshes" / "room.ply")
    np.testing.assert_allclose(mesh.extents, [5, 6, 2.6], atol=1e-6)


def use(text: str, shape: str, bsdf: str) -> str:
    """A scene file in which a shape refers to another BSDF."""
    at = text.index("<ref id=", text.index(f'id="mesh-{shape}"'))
    return f'{text[:at]}<ref id="{bsdf}" name="bsdf"/>{text[text.index("/>", at) + 2 :]}'


def test_materials_are_guessed_by_names_and_kept_where_they_are_radio(tmp_path):
    xml = write_scene(tmp_path / "room", random_room(5).parts, "room")
    text = xml.read_text("utf-8")
    shapes = ("floor", "ceiling", "wall_west", "wall_east")
    for shape, name in zip(shapes, ("Brick Wall.001", "Window.003", "cabinet_steel", "Fabric"), strict=True):
        text = use(text.replace("</scene>", f'<bsdf type="diffuse" id="{name}"/></scene>'), shape, name)
    xml.write_text(text, encoding="utf-8")
    repair = repair_scene(xml, tmp_path / "out", material="wood")
    scene = open_scene(tmp_path / "out", CARRIER_HZ)
    types = [scene.objects[shape].radio_material.itu_type for shape in shapes]
    assert types == ["brick", "glass", "metal", "wood"]
    assert "mesh-floor: material brick by its name" in repair.done
    assert [ascii_name(name) for name in ("Wänd", "mesh-é.001", "壁")] == ["Wand", "mesh-e.001", ""]
    words = {"mat-Concrete.001": "concrete", "ceiling board": "ceiling_board", "Window": "glass", "Material": None}
    assert {name: meant(name) for name in words} == words


def test_constants_and_values_of_radio_materials_stay(tmp_path):
    xml = write_scene(tmp_path / "room", random_room(1).parts, "room")
    values = {"relative_permittivity": 2.9, "conductivity": 0.01, "thickness": 0.08, "scattering_coefficient": 0.3}
    floats = "".join(f'<float name="{name}" value="{value}"/>' for name, value in values.items())
    radio = f'<bsdf type="radio-material">{floats}<rgb name="color" value="1 0 0"/></bsdf>'
    text = xml.read_text("utf-8").replace("</scene>", f'<bsdf type="twosided" id="mat-panel">{radio}</bsdf></scene>')
    xml.write_text(use(text, "floor", "mat-panel"))
    repair_scene(xml, tmp_path / "out")
    material = open_scene(tmp_path / "out", CARRIER_HZ).objects["floor"].radio_material
    assert [float(getattr(material, name)[0]) for name in values] == pytest.approx(list(values.values()), rel=1e-6)
    # Materials below their range get constants, and keep the thickness of scene.yml.
    xml = write_scene(tmp_path / "box", {"box": ("itu_concrete", trimesh.creation.box((4, 3, 2.5)))}, "room")
    repair_scene(xml.parent, tmp_path / "low", frequency_hz=868e6)
    material = open_scene(tmp_path / "low", 868e6).objects["box"].radio_material
    assert [float(material.relative_permittivity[0]), float(material.thickness[0])] == pytest.approx([5.24, 0.25])


def test_stated_materials_of_shapes_replace_their_own(tmp_path):
    xml = write_scene(tmp_path / "room", random_room(5).parts, "room")
    repair_scene(xml, tmp_path / "out", shape_materials={"mesh-floor": "metal"})
    scene = open_scene(tmp_path / "out", CARRIER_HZ)
    assert scene.objects["floor"].radio_material.itu_type == "metal"
    assert scene.objects["ceiling"].radio_material.itu_type != "metal"
    with pytest.raises(InputError, match="no shape 'mesh-flor'"):
        repair_scene(xml, tmp_path / "other", shape_materials={"mesh-flor": "metal"})


def test_winding_follows_the_first_face_of_each_body():
    rng = np.random.default_rng(0)
    solids = [trimesh.creation.icosphere(subdivisions=2), trimesh.creation.box((1, 1, 1)).apply_translation([5, 0, 0])]
    corners = np.concatenate([solid.triangles for solid in solids])
    flipped = rng.random(len(corners)) < 0.4
    fixed = wound_one_way(np.where(flipped[:, None, None], corners[:, ::-1], corners))
    ends = np.cumsum([0, *(len(solid.faces) for solid in solids)])
    for solid, first, last in zip(solids, ends[:-1], ends[1:], strict=True):
        volume = np.linalg.det(fixed[first:last]).sum() / 6
        assert volume == pytest.approx(solid.volume * (-1 if flipped[first] else 1))


def test_shapes_of_one_id_keep_their_materials_and_none_is_lost(tmp_path):
    body = ""
    for name, kind, at in (("a", "wood", 0), ("b", "metal", 5)):
        trimesh.creation.box((1, 1, 1)).apply_translation([at, 0, 0]).export(tmp_path / f"{name}.ply")
        body += f'<bsdf type="itu-radio-material" id="mat-{name}"><string name="type" value="{kind}"/></bsdf>'
        file = f'<string name="filename" value="{name}.ply"/>'
        body += f'<shape type="ply" id="same">{file}<ref id="mat-{name}"/></shape>'
    path = tmp_path / "scene.xml"
    path.write_text(f'<scene version="3.0.0">{body}</scene>', encoding="utf-8")
    assert repair_scene(path, tmp_path / "out").folder is not None
    objects = open_scene(tmp_path / "out", CARRIER_HZ).objects
    types = {float(o.mi_mesh.bbox().min.x): o.radio_material.itu_type for o in objects.values()}
    assert types == {-0.5: "wood", 4.5: "metal"}
    (tmp_path / "c.serialized").write_bytes(b"")
    more = '<shape type="serialized" id="c"><string name="filename" value="c.serialized"/><ref id="mat-a"/></shape>'
    path.write_text(f'<scene version="3.0.0">{body}{more}</scene>', encoding="utf-8")
    assert [f.shape for f in repair_scene(path, tmp_path / "none").unrepaired] == ["c"]


def test_command_repairs_a_copy(tmp_path, capsys):
    damaged = damaged_scene("no-material", 0, tmp_path / "damaged")
    xml, out = damaged.folder / "scene.xml", tmp_path / "out"
    status, printed, _ = call(["check", xml, "--repair", out], capsys)
    assert status == 2
    assert "unrepaired no-material" in printed
    assert not out.exists()
    status, printed, _ = call(["check", xml, "--repair", out, "--material", "brick"], capsys)
    assert status == 0
    assert printed.splitlines()[-1] == f"scene: {out}"
    refused(["check", xml, "--repair", out, "--material", "brick"], "exists", capsys)
    assert call(["check", xml, "--repair", out, "--material", "brick", "--replace", "--json"], capsys)[0] == 0
    refused(["check", xml, "--repair", out, "--replace", "--material", "jelly"], "unknown", capsys)
    refused(["check", xml, "--repair", out, "--strict"], "no effect beside --repair", capsys)
    points = tmp_path / "scan.xyz"
    np.savetxt(points, np.random.default_rng(0).uniform(0, 4, (2000, 3)))
    with pytest.raises(InputError, match="make a scene of it by wrf-mi mesh"):
        repair_scene(points, tmp_path / "scan")
