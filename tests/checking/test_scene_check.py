"""Check of scenes: each kind of fault is named at its shape, and whole scenes raise no alarm."""

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from calling import call, refused
from changed_folders import DATA, needs
from damaged_scenes import DAMAGES, damaged_scene, whole_scenes
from wrf_mi_scenes.mitsuba_xml import write_scene
from wrf_mi_scenes.random_rooms import random_room

from wrf_mi.apps.checking import check_scene
from wrf_mi.apps.checking.scene_findings import KINDS, LEVELS
from wrf_mi.apps.checking.scene_geometry import ShapePart, scene_parts
from wrf_mi.apps.checking.scene_xml_faults import SceneXml, read_xml
from wrf_mi.apps.checking.triangle_faults import FARTHEST_M
from wrf_mi.apps.commands.main import main as cli
from wrf_mi.core import InputError
from wrf_mi.scene.make import make_scene
from wrf_mi.tracing.sionna.scenes import load_scene

TURNS = 12  # rooms, and ways, in which a fault of each kind is made
SECONDS = 60.0  # bound of the time that hostile meshes take on a busy machine
PLACED_M = 2e-6  # largest difference to corners of Mitsuba, which computes in single precision
VALUES = '<string name="type" value="concrete"/><float name="thickness" value="0.1"/>'
CONCRETE = f'<bsdf type="itu-radio-material" id="mat-wall">{VALUES}</bsdf>'
TURN = '<rotate x="0.6" z="0.8" angle="35"/>'


def scene_file(folder: Path, shape: str, parameters: str = "", version: str = "3.0.0") -> Path:
    """A scene of one shape with a mesh ``meshes/a.ply``, a box."""
    (folder / "meshes").mkdir(exist_ok=True)
    trimesh.creation.box((3, 2, 2)).export(folder / "meshes" / "a.ply", vertex_normal=False)
    file = '<string name="filename" value="meshes/a.ply"/>' if shape == "ply" else ""
    body = f'<shape type="{shape}" id="mesh-a">{file}{parameters}<ref id="mat-wall" name="bsdf"/></shape>'
    path = folder / "scene.xml"
    path.write_text(f'<scene version="{version}">{CONCRETE}{body}</scene>', encoding="utf-8")
    return path


def alarms(report) -> list[str]:
    return [f"{f.kind}: {f.shape}: {f.text}" for f in report.findings if f.level != "note"]


def kinds(path: Path, level: str = "", **options: Any) -> list[str]:
    """Kinds of the findings, perhaps of one level."""
    return [f.kind for f in check_scene(path, **options).findings if level in ("", f.level)]


def in_sionna(path: Path) -> np.ndarray:
    """Corners [n, 3, 3] of the triangles of the box, as Sionna RT reads them."""
    from sionna import rt

    mesh = rt.load_scene(str(path), merge_shapes=False).objects["a"].mi_mesh
    vertices = mesh.vertex_positions_buffer().numpy().reshape(-1, 3)
    return vertices[mesh.faces_buffer().numpy().reshape(-1, 3)]


@pytest.mark.parametrize("turns", [2, pytest.param(TURNS, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", DAMAGES)
def test_damage_is_named_at_its_shape(kind, turns, tmp_path):
    for turn in range(turns):
        damaged = damaged_scene(kind, turn, tmp_path / str(turn))
        report = check_scene(damaged.folder / "scene.xml", data=damaged.record)
        shapes = [finding.shape for finding in report.findings if finding.kind == kind]
        assert damaged.at in shapes if damaged.at else shapes, (turn, damaged.at, report.lines())


def test_whole_scenes_and_the_city_of_sionna_raise_no_alarm(tmp_path):
    files = list(whole_scenes(tmp_path))
    assert len(files) >= 40
    for file in files:
        assert alarms(check_scene(file)) == [], file
    report = check_scene("etoile")
    assert alarms(report) == []
    assert (report.shapes, report.faces) == (565, 13098)


@needs("fdtd-toy")
def test_old_scene_of_blender_has_no_radio_materials():
    for file in sorted((DATA / "fdtd-toy").rglob("*.xml")):
        shapes = {f.shape for f in check_scene(file).findings if f.kind == "not-radio"}
        assert shapes == {"mesh-upper_wall", "mesh-lower_wall", "mesh-blocker"}


@pytest.mark.parametrize(
    "steps",
    [
        '<translate x="1" z="-2"/>',
        '<scale value="2"/>',
        '<scale x="-1" y="3"/>',
        f'{TURN}<translate value="1, 2, 3"/>',
        f'<translate x="4"/>{TURN}<scale z="0.5"/>',
        '<matrix value="1 0 0 5 0 0 -1 6 0 1 0 7 0 0 0 1"/>',
        '<matrix value="0 1 0 1 0 0 0 0 2"/>',
        '<lookat origin="1, 2, 3" target="4, 0, 1" up="0, 0, 1"/>',
    ],
)
def test_transforms_are_those_of_mitsuba(steps, tmp_path):
    path = scene_file(tmp_path, "ply", f'<transform name="to_world">{steps}</transform>')
    scene = read_xml(path)
    assert isinstance(scene, SceneXml)
    (part,) = [result for result in scene_parts(scene) if isinstance(result, ShapePart)]
    expected = in_sionna(path)
    np.testing.assert_allclose(part.corners_m, expected, atol=PLACED_M * np.abs(expected).max())
    assert set(kinds(path)) <= {"moved"}


def test_skewed_axes_camel_case_and_unknown_parameters_are_faults(tmp_path):
    steps = '<rotate x="1" y="1" z="0.5" angle="35"/>'
    path = scene_file(tmp_path, "ply", f'<transform name="to_world">{steps}</transform>')
    assert kinds(path, "fault") == ["transform"]
    turned = trimesh.Trimesh(**trimesh.triangles.to_kwargs(in_sionna(path)))
    assert abs(turned.volume / 12 - 1) > 0.05
    moved = '<transform name="toWorld"><translate x="1"/></transform>'
    assert alarms(check_scene(scene_file(tmp_path, "ply", moved, "0.6.0"))) == []
    assert kinds(scene_file(tmp_path, "ply", moved), "fault") == ["unknown-parameter"]
    path = scene_file(tmp_path, "ply", '<float name="size" value="1"/>')
    with pytest.raises(InputError, match=r"wrf-mi check .*scene\.xml names every fault"):
        load_scene(path)


def with_defaults(folder: Path, defaults: str) -> Path:
    """A scene as Blender's exporter writes it: values of the sensor, and here of the shape's transform, by name."""
    moved = '<transform name="to_world"><translate x="$shift"/></transform>'
    path = scene_file(folder, "ply", moved)
    sensor = (
        '<sensor type="perspective"><sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>'
    )
    path.write_text(path.read_text().replace("<bsdf", f"{defaults}{sensor}</sensor><bsdf", 1))
    return path


def test_cameras_of_a_scene_cause_no_warning_of_mitsuba(tmp_path, capfd):
    path = scene_file(tmp_path, "ply")
    camera = '<sensor type="perspective"><film type="hdrfilm"/></sensor>'
    path.write_text(path.read_text().replace("<bsdf", f"{camera}<bsdf", 1))
    assert alarms(check_scene(path)) == []
    assert load_scene(path)[0].objects
    assert "onochrome" not in "".join(capfd.readouterr())


def test_defaults_of_a_scene_file_are_its_values(tmp_path):
    defaults = '<default name="spp" value="64"/><default name="shift" value="5"/><default name="shift" value="7"/>'
    path = with_defaults(tmp_path, defaults)
    assert alarms(check_scene(path)) == []
    scene = read_xml(path)
    assert isinstance(scene, SceneXml)
    (part,) = [result for result in scene_parts(scene) if isinstance(result, ShapePart)]
    np.testing.assert_allclose(part.corners_m, in_sionna(path), atol=8 * PLACED_M)
    assert part.corners_m[..., 0].mean() == pytest.approx(5)
    assert list(load_scene(path)[0].objects) == ["a"]


def test_a_value_without_a_default_is_a_fault(tmp_path):
    path = with_defaults(tmp_path, '<default name="spp" value="64"/>')
    assert kinds(path, "fault") == ["transform"]
    path = with_defaults(tmp_path, '<default name="shift" value="5"/>')
    assert kinds(path, "fault") == ["parameter"]


@pytest.mark.parametrize(("gap_m", "lost"), [(0.0, False), (1e-3, True), (0.9 * FARTHEST_M, True), (0.02, False)])
def test_paths_through_double_sheets_are_lost_in_sionna(gap_m, lost, tmp_path):
    from sionna import rt

    path = scene_file(tmp_path, "ply")
    sheet, faces = np.array([[0, -3, -3], [0, 3, -3], [0, 3, 3], [0, -3, 3]], float), np.array([[0, 1, 2], [0, 2, 3]])
    corners = np.concatenate([sheet, sheet + np.array([gap_m, 0, 0])])
    both = trimesh.Trimesh(corners, np.concatenate([faces, faces[:, ::-1] + 4]), process=False)
    both.export(tmp_path / "meshes" / "a.ply", vertex_normal=False)
    scene = rt.load_scene(str(path))
    scene.tx_array = scene.rx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="V")
    scene.add(rt.Transmitter("tx", [-2, 0.3, 0.2]))
    scene.add(rt.Receiver("rx", [2, 0.1, 0.1]))
    paths = rt.PathSolver()(scene, max_depth=3, refraction=True)
    gain = np.abs(paths.cir(out_type="numpy")[0]).sum()
    assert (gain == 0) == lost == ("double-sheet" in kinds(path))


def test_sheet_before_a_solid_is_a_fault_and_neighbouring_houses_are_not(tmp_path):
    house, wall = trimesh.creation.box((4, 4, 3)), trimesh.creation.box((4, 4, 3))
    wall.apply_translation([4.001, 0.5, 0])
    xml = write_scene(tmp_path / "houses", {"a": ("itu_brick", house), "b": ("itu_brick", wall)}, "houses")
    assert alarms(check_scene(xml)) == []
    assert "party-wall" in kinds(xml)
    sheet = trimesh.Trimesh([[2.001, -1, -1], [2.001, 1, -1], [2.001, 1, 1]], [[0, 1, 2]], process=False)
    for material, expected in (("itu_brick", ["double-sheet"]), ("itu_wood", [])):
        xml = write_scene(tmp_path / material, {"a": ("itu_brick", house), "b": (material, sheet)}, "sheet")
        assert kinds(xml, "fault") == expected


def test_equal_faults_are_printed_once(tmp_path):
    path = scene_file(tmp_path, "ply")
    gone = '<string name="filename" value="gone.ply"/>'
    body = "".join(f'<shape type="ply" id="s{k}">{gone}</shape>' for k in range(500))
    path.write_text(f'<scene version="3.0.0">{body}</scene>', encoding="utf-8")
    report = check_scene(path)
    assert len(report.of_level("fault")) == 1000
    lines = report.lines()
    assert len(lines) == 4
    assert all("s0, s1, s2 and 497 more: " in line for line in lines[1:3])
    assert lines[-1] == f"{path}: 1000 faults, no warnings, no notes; 500 shapes, 0 triangles"


def test_hostile_meshes_take_seconds(tmp_path):
    begun = time.perf_counter()
    properties = "".join(f"property float {axis}\n" for axis in "xyz")
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {{}}\n{properties}element face {{}}\n"
    head += "property list uchar int vertex_indices\nend_header\n"
    for number, counts in enumerate([(3, 10**12), (10**12, 1)]):
        file = tmp_path / f"huge_{number}.ply"
        file.write_bytes(head.format(*counts).encode() + bytes(1000))
        assert set(kinds(file, "fault")) & {"mesh", "empty-mesh"}
    star = np.random.default_rng(0).uniform(0, 5, (30_000, 3))
    lines = [*(f"v {x} {y} 0" for x, y, _ in star), "f " + " ".join(map(str, range(1, 30_001)))]
    for name, text, kind in (("star", "\n".join(lines), "mesh"), ("endless", "\\\n" * 1_000_000, "empty-mesh")):
        (tmp_path / f"{name}.obj").write_text(text)
        assert kinds(tmp_path / f"{name}.obj", "fault") == [kind]
    assert time.perf_counter() - begun < SECONDS


def test_scan_is_judged_by_its_points(tmp_path):
    rng = np.random.default_rng(1)
    points = rng.uniform(0, 1, (4000, 3)) * [6, 4, 2.5]
    points[np.arange(4000), rng.integers(3, size=4000)] = 0
    file, grid, lost = tmp_path / "scan.xyz", np.array([7e5, 4e6, 0]), points.copy()
    lost[7, 1] = np.nan
    for scan, level, expected in (
        (points, "", []),
        (1000 * points, "fault", ["units"]),
        (points * [100, 150, 50] + grid, "fault", ["units"]),
        (np.round(points * 2) / 2 + grid, "fault", ["coarse-steps"]),
        (lost, "fault", ["not-finite"]),
    ):
        np.savetxt(file, scan)
        assert kinds(file, level) == expected
        if expected in (["units"], ["coarse-steps"]):
            with pytest.raises(InputError):
                make_scene(file, tmp_path / "scene")
    np.savetxt(file, 1000 * points)
    assert alarms(check_scene(file, units="mm")) == []


def test_carrier_decides_materials_and_phase(tmp_path):
    path = scene_file(tmp_path, "ply", '<transform name="to_world"><translate x="900"/></transform>')
    for hz, expected in (
        (2.4e9, []),
        (868e6, ["below-range"]),
        (105e9, ["material-range", "coarse-phase"]),
        (140e9, ["coarse-phase"]),
        (1e8, ["material-range"]),
    ):
        findings = check_scene(path, frequency_hz=hz).findings
        assert [f.kind for f in findings if f.level != "note"] == expected, hz


def test_help_lists_kinds_of_findings(capsys):
    with pytest.raises(SystemExit, match="0"):
        cli(["check", "--help"])
    lines = [line.split(maxsplit=2) for line in capsys.readouterr().out.splitlines()]
    for kind, (level, description) in KINDS.items():
        assert level in LEVELS
        assert [kind, level, description] in lines


def test_command_ends_with_two_at_faults(tmp_path, capsys):
    xml = write_scene(tmp_path / "room", random_room(2).parts, "room")
    status, out, err = call(["check", xml.parent], capsys)
    assert (status, err) == (0, "")
    assert out.splitlines()[-1].startswith(f"{xml.parent}: no faults, no warnings")
    (tmp_path / "room" / "meshes" / "floor.ply").unlink()
    status, out, _ = call(["check", xml], capsys)
    assert status == 2
    assert "fault    missing-file       mesh-floor: 'meshes/floor.ply' is not in its place; correct the name" in out
    status, out, _ = call(["check", xml, "--json"], capsys)
    assert status == 2
    assert '"kind": "missing-file"' in out
    small = scene_file(tmp_path, "ply", '<transform name="to_world"><scale value="0.01"/></transform>')
    assert [call(["check", small, *more], capsys)[0] for more in ([], ["--strict"])] == [0, 1]
    refused(["check", tmp_path / "none.xml"], "no such scene", capsys)
    refused(["check", small, "--material", "wood"], "belongs to --repair", capsys)
