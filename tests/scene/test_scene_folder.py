"""Scene folders: written whole, opened by both tracers, materials that follow one file; pictures of scenes."""

import logging
from typing import Any

import numpy as np
import pytest
import yaml
from calling import contents
from made_plans import L_ROOM_M
from made_rooms import closed_box, sampled, scene_file
from matplotlib.collections import LineCollection, PolyCollection
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from PIL import Image
from wrf_mi_scenes.build_laboratory import sheet
from wrf_mi_scenes.mitsuba_xml import THICKNESS_M

from wrf_mi import backend
from wrf_mi.apps.checking import check_scene
from wrf_mi.core import InputError, Receiver
from wrf_mi.core.antenna import UPRIGHT
from wrf_mi.core.files import write_figure
from wrf_mi.core.paths import Paths
from wrf_mi.scene.folder import read_scene_folder, write_scene
from wrf_mi.scene.make import make_scene
from wrf_mi.scene.materials import Materials, read_materials
from wrf_mi.scene.mesh.files import mesh_parts
from wrf_mi.scene.mesh.surfaces import Surface, number_names, with_area
from wrf_mi.scene.plan.storey import plan_surfaces
from wrf_mi.scene.preview import GaussianCloud, draw_scene
from wrf_mi.scene.scan import simulate_scan
from wrf_mi.tracing import TraceOptions, open_scene, trace_paths
from wrf_mi.tracing.sionna.materials import perfect_reflector

FREQUENCY_HZ = 2.4e9


def surface(name: str, kind: Any, z: float) -> Surface:
    mesh = sheet(2, z, (0.0, 4.0), (0.0, 3.0))
    return Surface(name, kind, np.asarray(mesh.vertices), np.asarray(mesh.faces))


@pytest.fixture
def folder(tmp_path):
    surfaces = [surface("floor", "floor", 0.0), surface("ceiling", "ceiling", 2.5), surface("table", "other", 0.7)]
    return write_scene(tmp_path / "scene", surfaces, frame="made up", source="test", counts={"points": 7})


def test_a_folder_is_read_as_written_and_opened_by_mitsuba_and_sionna(folder):
    read = read_scene_folder(folder)
    assert contents(folder) == {"materials.yml", "meshes", "preview.png", "scene.xml", "scene.yml"}
    facts = yaml.safe_load((folder / "scene.yml").read_text())
    assert (facts["frame"], facts["source"], facts["registration"]) == ("made up", "test", None)
    assert read.counts == {"surfaces": 3, "faces": 6, "points": 7}
    assert read.materials.of("table", "other") == "itu_wood"
    assert read.materials.thickness_m["itu_concrete"] == THICKNESS_M["itu_concrete"]
    backend.init()
    import mitsuba as mi
    from sionna import rt
    from sionna.rt.radio_materials.itu import ITU_MATERIALS_PROPERTIES

    assert bounds(mi.load_file(str(folder / "scene.xml"))) == pytest.approx(np.array([[0, 0, 0], [4, 3, 2.5]]))
    scene = rt.load_scene(str(folder / "scene.xml"), merge_shapes=False)
    materials = {name: scene_object.radio_material.name for name, scene_object in scene.objects.items()}
    assert materials == {"floor": "itu_concrete", "ceiling": "itu_ceiling_board", "table": "itu_wood"}
    assert {name.removeprefix("itu_") for name in THICKNESS_M} == set(ITU_MATERIALS_PROPERTIES)


def test_editing_the_materials_changes_the_scene(folder):
    facts = yaml.safe_load((folder / "materials.yml").read_text())
    facts["rules"]["floor"] = "itu_marble"
    facts["surfaces"]["table"] = "itu_metal"
    facts["thickness_m"]["itu_metal"] = 0.005
    (folder / "materials.yml").write_text(yaml.safe_dump(facts))
    scene = open_scene(folder, FREQUENCY_HZ)
    materials = {name: scene_object.radio_material for name, scene_object in scene.objects.items()}
    names = {name: material.name for name, material in materials.items()}
    assert names == {"floor": "itu_marble", "ceiling": "itu_ceiling_board", "table": "itu_metal"}
    assert float(materials["table"].thickness[0]) == pytest.approx(0.005)
    assert float(materials["floor"].thickness[0]) == pytest.approx(THICKNESS_M["itu_marble"])
    before = (folder / "scene.xml").stat().st_mtime_ns
    read_scene_folder(folder)
    assert (folder / "scene.xml").stat().st_mtime_ns == before


def test_a_perfect_conductor_is_a_material_of_a_scene_folder(folder):
    """As ``--material perfect`` is of a bare mesh; Sionna RT opens the scene file by itself, too."""
    from sionna import rt

    facts = yaml.safe_load((folder / "materials.yml").read_text())
    facts["rules"]["floor"] = facts["surfaces"]["table"] = "perfect"
    facts["thickness_m"] = {"perfect": 0.3}
    (folder / "materials.yml").write_text(yaml.safe_dump(facts))
    of = {name: scene_object.radio_material for name, scene_object in open_scene(folder, FREQUENCY_HZ).objects.items()}
    assert [of[name].name for name in ("floor", "table", "ceiling")] == ["perfect", "perfect", "itu_ceiling_board"]
    expected = perfect_reflector()
    for key in ("relative_permittivity", "conductivity"):
        assert float(getattr(of["floor"], key)[0]) == float(getattr(expected, key)[0])
    assert float(of["floor"].thickness[0]) == pytest.approx(0.3)
    assert len(rt.load_scene(str(folder / "scene.xml"), merge_shapes=False).objects) == 3


@pytest.mark.parametrize(("loss_db", "carrier_hz", "slack_db"), [(6, 2.4e9, 0.02), (20, 2.4e9, 0.02), (6, 5.2e9, 0.5)])
def test_a_stated_loss_weakens_the_direct_path(loss_db, carrier_hz, slack_db, folder):
    """At its carrier to the three digits of the conductivity, at another one above within half a decibel."""

    def power_db(loss_db):
        facts = yaml.safe_load((folder / "materials.yml").read_text())
        facts["surfaces"]["table"], facts["constants"] = "top", {"top": {"loss_db": loss_db}}
        (folder / "materials.yml").write_text(yaml.safe_dump(facts))
        receiver = Receiver("below", np.array([2.0, 1.5, 0.2]), np.array(UPRIGHT))
        options = TraceOptions(transmission=True, reflections=0)
        paths = trace_paths(open_scene(folder, carrier_hz), [[2.0, 1.5, 2.0]], receiver, options).paths
        return 20 * np.log10(np.abs(paths.gain).item())

    assert power_db(1e-3) - power_db(loss_db) == pytest.approx(loss_db, abs=slack_db)


PANEL = "constants: {{panel: {{relative_permittivity: 2.9, conductivity: 0.01, thickness: 0.08, {}}}}}"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("rules: {floor: marble}", "floor: unknown material 'marble'; known are itu_vacuum, .*itu_wet_ground, perfect"),
        ("rules: {roof: itu_wood}", "rules: no kind 'roof'; known are floor, ceiling, wall, other"),
        ("surfaces: {table: iron}", "surfaces: table: unknown material 'iron'; known are floor, .*itu_metal"),
        ("thickness_m: {itu_wood: -1}", "thickness_m: itu_wood is -1; give metres above 0"),
        ("thickness_m: {itu_wood: thin}", "thickness_m: itu_wood is 'thin'; give metres above 0"),
        ("walls: {}", "give the keys rules, surfaces, thickness_m, constants, scattering, no others"),
        ("rules: itu_wood", "rules must be a mapping"),
        ("rules: {", "not YAML"),
        (PANEL.format("conductivity_exponent: 1"), "panel: give relative_permittivity, .* with"),
        (PANEL.format("conductivity_exponent: 9, carrier_hz: 1.0e+9"), "conductivity_exponent is 9; give -5 to 5"),
        (PANEL.format("conductivity_exponent: 1, carrier_hz: 0"), "carrier_hz is 0; give a number from 0 upwards"),
        ("constants: {front: {loss_db: -3}}", "front: loss_db is -3; give dB above 0, 60 at most"),
        ("constants: {front: {loss_db: 3, thickness: 1}}", "front: give relative_permittivity, .* or loss_db"),
    ],
)
def test_unusable_materials_are_refused(text, message, folder):
    (folder / "materials.yml").write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        read_scene_folder(folder)
    assert "\n" not in str(caught.value)
    assert "materials.yml" in str(caught.value)


def test_velocities_of_an_earlier_version_are_not_read(folder):
    materials = read_scene_folder(folder).materials
    with (folder / "materials.yml").open("a") as file:
        file.write("velocities_mps: {table: [0, 1.5, 0]}\n")
    assert read_scene_folder(folder).materials == materials


def test_incomplete_folders_are_refused(folder):
    facts = folder / "scene.yml"
    for damage, message in (
        ((folder / "meshes" / "table.ply").unlink, "surface 'table' has no mesh"),
        (lambda: facts.write_text("frame: x\n"), "scene.yml: no xml in it"),
        (facts.unlink, "scene.yml: missing"),
    ):
        damage()
        with pytest.raises(InputError, match=message):
            read_scene_folder(folder)


def test_scene_folder_is_written_atomically(tmp_path):
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


def test_a_scan_becomes_a_folder_in_a_registered_frame(tmp_path):
    np.savez(tmp_path / "scan.npz", points=1000 * sampled(closed_box(), 20_000))
    (tmp_path / "mine.yml").write_text("rules: {wall: itu_brick}\nthickness_m: {itu_brick: 0.12}\n")
    quarter = np.array([[0, -1, 0, 10], [1, 0, 0, 20], [0, 0, 1, 1], [0, 0, 0, 1.0]])
    options = {"units": "mm", "materials": tmp_path / "mine.yml", "registration": quarter}
    new_scene = make_scene(tmp_path / "scan.npz", tmp_path / "out", **options)
    assert new_scene.counts == {"surfaces": 6, "faces": 12, "points": 20_200}
    np.testing.assert_array_equal(yaml.safe_load((new_scene.folder / "scene.yml").read_text())["registration"], quarter)
    assert new_scene.materials.of("wall_01", "wall") == "itu_brick"
    assert new_scene.materials.thickness_m["itu_brick"] == 0.12
    scene = open_scene(new_scene.folder, FREQUENCY_HZ).mi_scene
    np.testing.assert_allclose(bounds(scene), [[6.0, 20, 1], [10, 25, 3.8]], atol=0.01)
    read_materials(new_scene.folder)  # a folder stands for its file


def test_a_mesh_and_a_layout_become_folders(tmp_path):
    closed_box()[0].export(tmp_path / "room.stl")
    (tmp_path / "layout.csv").write_text("x,y\n0,0\n5,0\n5,4\n0,4\n0,0\n")
    mesh = make_scene(tmp_path / "room.stl", tmp_path / "mesh")
    walls = {f"wall_0{i}": "wall" for i in range(1, 5)}
    assert mesh.materials.surfaces == {"floor": "floor", "ceiling": "ceiling"} | walls
    layout = make_scene(tmp_path / "layout.csv", tmp_path / "layout", height_m=2.5, floor_m=1.0)
    assert mesh.counts == layout.counts == {"surfaces": 6, "faces": 12}
    scene = open_scene(layout.folder, FREQUENCY_HZ).mi_scene
    np.testing.assert_allclose(bounds(scene), [[0.0, 0, 1], [5, 4, 3.5]], atol=1e-6)
    assert number_names(["wall", "floor", "wall"]) == ["wall_01", "floor", "wall_02"]


def test_triangles_that_lose_their_area_in_single_precision_are_not_written(tmp_path, caplog):
    """A floor with a corner 4 um off its side has a sliver there, 300 m from the origin a line."""
    plan = ((0, 300), (4, 300), (4, 303), (0, 303), (2, 300 + 4e-6))
    corners = [(x, y, z) for z in (0.0, 2.5) for x, y in plan]
    floor = [(0, 4, 3), (4, 2, 3), (4, 1, 2), (0, 1, 4)]
    faces = [(5, 6, 7), (5, 7, 8)] + [(k, (k + 1) % 4, (k + 1) % 4 + 5) for k in range(4)]
    faces += [(k, (k + 1) % 4 + 5, k + 5) for k in range(4)]
    lines = ["v {:.9f} {:.9f} {:.9f}".format(*corner) for corner in corners]
    lines += ["f {} {} {}".format(*np.add(face, 1)) for face in floor + faces]
    (tmp_path / "room.obj").write_text("\n".join(lines))
    with caplog.at_level(logging.WARNING):
        new_scene = make_scene(tmp_path / "room.obj", tmp_path / "room")
    assert "room.obj: 1 of 14 triangles have no area and are left out" in caplog.text
    assert new_scene.counts == {"surfaces": 6, "faces": 13}
    (written,) = mesh_parts(new_scene.folder / "meshes" / "floor.ply")
    assert written.area == pytest.approx(12.0, rel=1e-6)
    assert "zero-area" not in {finding.kind for finding in check_scene(new_scene.folder).findings}


def test_surface_of_lines_is_left_out():
    corners = np.array([[0, 0, 0], [2, 0, 0], [4, 0, 0], [0, 1, 0.0]])
    sound, line = Surface("a", "other", corners, np.array([[0, 1, 3]])), np.array([[0, 1, 2], [1, 1, 3]])
    assert [part.name for part in with_area([sound, Surface("b", "other", corners, line)], "test")] == ["a"]


def bounds(scene):
    """Lowest and highest corner of a scene of Mitsuba."""
    return np.array([scene.bbox().min, scene.bbox().max])


def test_simulated_scan_has_the_stated_noise_and_strays(tmp_path):
    xml, pose = scene_file(tmp_path, closed_box()), np.array([2.0, 1.5, 1.3])
    points, again = (simulate_scan(xml, pose, rays_per_pose=20_000, seed=3) for _ in range(2))
    np.testing.assert_array_equal(points, again)
    assert len(points) == 20_000
    distance = np.linalg.norm(points - pose, axis=1)
    direction = (points - pose) / distance[:, None]
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


def room():
    return plan_surfaces(L_ROOM_M, height_m=2.5)


def cloud(n=5):
    rng = np.random.default_rng(0)
    still = np.tile([0.0, 0.0, 0.0, 1.0], (n, 1))
    return GaussianCloud(rng.uniform(0, 4, (n, 3)), np.tile([0.3, 0.2, 0.1], (n, 1)), still, np.linspace(-60, -20, n))


def one_path():
    end: dict[str, Any] = {"tx": np.array([0]), "rx": np.array([0]), "n_tx": 1, "n_rx": 1}
    way: dict[str, Any] = dict.fromkeys(("departure", "arrival"), np.array([[1.0, 0, 0]]))
    met: dict[str, Any] = {"interactions": np.array([[1, 0]], np.uint8), "objects": np.array([[0, -1]], np.int32)}
    vertices_m = np.array([[[3.0, 0.0, 1.0], [np.nan] * 3]])
    gain, length_m = np.array([1e-3 + 0j]), np.array([5.0])
    return Paths(gain=gain, length_m=length_m, vertices_m=vertices_m, object_names=("wall",), **end, **way, **met)


def test_preview_is_written_whole(tmp_path):
    figure = draw_scene(room(), points_m=np.random.default_rng(0).uniform(0, 4, (100, 3)))
    path = write_figure(tmp_path / "preview.png", figure)
    with Image.open(path) as picture:
        assert picture.size[0] > 1000
        grey = np.asarray(picture.convert("L"))
    assert grey.std() > 20
    assert [p.name for p in tmp_path.iterdir()] == ["preview.png"]


def test_plan_shows_the_walls_where_they_are():
    plan = draw_scene(room()).axes[1]
    cuts = [c for c in plan.collections if isinstance(c, LineCollection)]
    shown = np.concatenate([segment for c in cuts for segment in c.get_segments()])
    assert [*shown.min(axis=0), *shown.max(axis=0)] == pytest.approx([0, 0, 5, 4.5])
    assert len(cuts) == len(L_ROOM_M) - 1
    names = {text.get_text(): text.get_position() for text in plan.texts}
    wall = next(surface for surface in room() if surface.kind == "wall")
    middle = (wall.vertices_m.min(axis=0) + wall.vertices_m.max(axis=0))[:2] / 2
    assert names[wall.name] == pytest.approx(middle)
    assert not {text.get_text() for text in draw_scene(room() * 11).axes[1].texts} & {wall.name}
    high = [Surface(s.name, s.kind, s.vertices_m + np.array([0, 0, 412.0]), s.faces) for s in room()]
    assert 412.0 < float(draw_scene(high).axes[1].get_title().split()[-2]) < 414.5


def faces_drawn(surfaces):
    """How many faces the slanted view shows: each has a colour of its own."""
    slant = draw_scene(surfaces).axes[0]
    return sum(len(c.get_facecolor()) for c in slant.collections if isinstance(c, Poly3DCollection))


def test_ceiling_is_taken_off_and_floor_stays():
    floor, ceiling, *walls = room()
    assert {s.kind for s in walls} == {"wall"}
    assert faces_drawn([floor]) == len(floor.faces)
    assert faces_drawn([ceiling]) == 0
    assert faces_drawn(room()) == len(floor.faces) + 2 * len(walls)
    vertices = np.array([[x, y, z] for z in (0, 2) for y in (0, 3) for x in (0, 4)], float)
    faces = np.array([[0, 1, 2], [1, 3, 2], [4, 5, 6], [5, 7, 6], [0, 1, 4], [1, 5, 4]])
    assert faces_drawn([Surface("mesh", "other", vertices, faces)]) == 4  # two are level, near the top


def test_paths_gaussians_and_devices_are_in_both_views():
    ends: dict[str, Any] = {"transmitters_m": np.array([[1.0, 1, 1]]), "receivers_m": np.array([[5.0, 1, 1]])}
    figure = draw_scene(room(), points_m=np.zeros((3, 2)), paths=one_path(), gaussians=cloud(), title="all", **ends)
    slant, plan = figure.axes[:2]
    bounced = [c.get_segments()[0] for c in plan.collections if isinstance(c, LineCollection) and c.zorder == 6]
    assert np.allclose(bounced[0], [[1, 1], [3, 0], [5, 1]])
    ellipses = next(c for c in plan.collections if isinstance(c, PolyCollection) and c.zorder == 4).get_paths()
    # The strongest is drawn last; seen from above it spans its standard deviations.
    outline = ellipses[-1].vertices - cloud().position_m[-1, :2]
    assert np.abs(outline).max(axis=0) == pytest.approx([0.3, 0.2], rel=0.02)
    assert len(ellipses) == 5
    assert {c.zorder for c in slant.collections} >= {1, 2, 5, 6}
    assert [t.get_text() for t in figure.legends[0].get_texts()] == ["floor", "wall", "transmitter", "receiver"]
    assert {axes.get_ylabel() for axes in figure.axes[2:]} == {"gain of a path (dB)", "signal of a Gaussian (dB)"}


def test_scenes_without_surfaces_or_path_ends_are_refused():
    with pytest.raises(ValueError, match="no surface"):
        draw_scene([])
    with pytest.raises(ValueError, match="paths need"):
        draw_scene(plan_surfaces(L_ROOM_M, height_m=2), paths=one_path())
