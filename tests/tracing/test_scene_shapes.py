"""Shapes of Mitsuba scene files as triangles; one line with the shape and the remedy for each that is refused."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from PIL import Image
from traced_rooms import FREQUENCY_HZ, SHOEBOX, THICKNESS_M, receiver, write_xml
from wrf_mi_scenes.build_laboratory import sheet

from wrf_mi.cli.main import main
from wrf_mi.core import InputError
from wrf_mi.scene.mesh.files import mesh_parts
from wrf_mi.tracing import TraceOptions, open_scene, trace_paths
from wrf_mi.tracing.search.surfaces import Surfaces, scene_surfaces
from wrf_mi.tracing.sionna.scenes import SEGMENTS

METAL = '<bsdf type="itu-radio-material" id="mat-metal_of_test"><string name="type" value="metal"/></bsdf>'
USED = '<ref id="mat-metal_of_test" name="bsdf"/>'
CHAIN = (
    '<transform name="to_world"><scale x="2" y="2" z="2"/><rotate x="0.6" y="0.8" angle="40"/>'
    '<translate x="1" y="-2" z="3"/></transform>'
)
PLY = """ply
format ascii 1.0
element vertex {vertices}
property float x
property float y
property float z
element face {faces}
property list uchar int vertex_indices
end_header
"""
CORNERS = "0 0 0\n4 0 0\n4 3 0\n0 3 0\n"
NEGATIVE = "v 0 0 0\nv 4 0 0\nv 4 3 0\nv 0 3 0\nf -4 -3 -2\nf -4 -2 -1\n"
L_SHAPE = "v 1 4 0\nv 0 4 0\nv 0 0 0\nv 4 0 0\nv 4 1 0\nv 1 1 0\nf 1 2 3 4 5 6\n"


def scene_file(folder: Path, shapes: str) -> Path:
    """A scene of a metal and some shapes, with mesh files that they may name."""
    meshes = folder / "meshes"
    meshes.mkdir(parents=True, exist_ok=True)
    (meshes / "quad.ply").write_text(PLY.format(vertices=4, faces=1) + CORNERS + "4 0 1 2 3\n")
    (meshes / "triangle.ply").write_text(PLY.format(vertices=4, faces=1) + CORNERS + "3 0 1 2\n")
    (meshes / "empty.ply").write_text(PLY.format(vertices=4, faces=0) + CORNERS)
    (meshes / "outside.ply").write_text(PLY.format(vertices=4, faces=1) + CORNERS + "3 0 1 9\n")
    (meshes / "negative.obj").write_text(NEGATIVE)
    (meshes / "concave.obj").write_text(L_SHAPE)
    path = folder / "scene.xml"
    path.write_text(f'<scene version="3.0.0">{METAL}{shapes}</scene>')
    return path


def file_shape(kind: str, name: str, more: str = 'id="mesh-wall"') -> str:
    return f'<shape type="{kind}" {more}><string name="filename" value="meshes/{name}"/>{USED}</shape>'


def surfaces_of(path: Path) -> Surfaces:
    return scene_surfaces(open_scene(path, FREQUENCY_HZ))


@pytest.mark.parametrize(
    ("plugin", "parameters", "area_m2"),
    [
        ("rectangle", "", 4.0),
        ("cube", "", 24.0),
        ("disk", "", np.pi),
        ("sphere", '<point name="center" x="1" y="2" z="-1"/><float name="radius" value="0.5"/>', np.pi),
        (
            "cylinder",
            '<point name="p0" value="1, 0, 2"/><point name="p1" value="1, 3, 2"/><float name="radius" value="0.5"/>'
            '<boolean name="flip_normals" value="true"/>',
            3 * np.pi,
        ),
    ],
)
def test_shapes_without_triangles_lie_where_mitsuba_has_them(
    plugin: str, parameters: str, area_m2: float, tmp_path: Path
) -> None:
    """Corners lie on the shape: the mesh is inscribed, and smaller by the facets' share of a circle."""
    shape = f'<shape type="{plugin}" id="mesh-thing">{parameters}{CHAIN}'
    surfaces = surfaces_of(scene_file(tmp_path, f"{shape}{USED}</shape>"))
    assert surfaces.names == ("thing",)
    off = 1 - np.cos(np.pi / SEGMENTS) ** 2
    face_m2 = trimesh.triangles.area(surfaces.triangles)
    area = float(face_m2.sum())
    assert 4 * area_m2 * (1 - 2 * off) < area < 4 * area_m2 * (1 + 1e-5)
    expected = mi.load_string(f'<scene version="3.0.0">{shape}</shape></scene>').bbox()
    corners = surfaces.triangles.reshape(-1, 3)
    # All of the shapes are symmetric about their middle: triangles that overlap and leave a gap are not.
    middle = face_m2 @ surfaces.triangles.mean(axis=1) / area
    np.testing.assert_allclose(middle, np.ravel(np.add(expected.min, expected.max)) / 2, atol=1e-5)
    size = np.max(np.subtract(expected.max, expected.min))
    for mesh_bound, bound in ((corners.min(axis=0), expected.min), (corners.max(axis=0), expected.max)):
        np.testing.assert_allclose(mesh_bound, np.ravel(bound), atol=off * size)


def test_rectangle_is_traced_like_its_mesh(tmp_path: Path) -> None:
    mesh = {"plate": ("itu_brick", sheet(2, 1.5, (1.0, 5.0), (2.0, 4.0)))}
    as_mesh = write_xml(tmp_path / "mesh", {**SHOEBOX, **mesh})
    as_shape = write_xml(tmp_path / "shape", SHOEBOX)
    place = '<transform name="to_world"><scale x="2" y="1" z="1"/><translate x="3" y="3" z="1.5"/></transform>'
    plate = f'<shape type="rectangle" id="plate">{place}<ref id="mat-itu_brick" name="bsdf"/></shape></scene>'
    as_shape.write_text(as_shape.read_text().replace("</scene>", plate))
    traced = []
    for path in (as_mesh, as_shape):
        scene = open_scene(path, FREQUENCY_HZ, THICKNESS_M)
        assert list(scene.objects) == [*SHOEBOX, "plate"]
        traced.append(trace_paths(scene, [[1.3, 2, 1]], receiver([4.4, 3.1, 1.7]), TraceOptions(depth=2)).paths)
    np.testing.assert_allclose(traced[1].length_m, traced[0].length_m, atol=1e-9)
    np.testing.assert_allclose(traced[1].gain, traced[0].gain, atol=1e-6 * np.abs(traced[0].gain).max())


def test_curved_shapes_are_logged_with_their_deviation(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    shape = f'<shape type="sphere" id="mesh-ball"><float name="radius" value="2"/>{USED}</shape>'
    with caplog.at_level(logging.INFO):
        scene = open_scene(scene_file(tmp_path, shape), FREQUENCY_HZ)
    assert "shape 'mesh-ball': a sphere as 960 triangles, up to 0.019 m off it" in caplog.text
    surfaces = scene_surfaces(scene)
    assert len(surfaces.solids) == 0  # a room, by its size
    planes = np.abs(np.einsum("fd,fd->f", surfaces.normal[surfaces.plane], surfaces.triangles[:, 0]))
    assert planes.min() > 2 - 0.02


@pytest.mark.parametrize(
    ("kind", "name"), [("ply", "quad.ply"), ("obj", "negative.obj"), ("obj", "concave.obj"), ("ply", "triangle.ply")]
)
def test_mesh_files_have_the_triangles_of_our_reader(kind: str, name: str, tmp_path: Path) -> None:
    """Also those that Mitsuba refuses or fans, and moved by their transform."""
    turned = file_shape(kind, name).replace(USED, USED + CHAIN).replace("mesh-wall", "mesh-turned")
    path = scene_file(tmp_path, file_shape(kind, name) + turned)
    surfaces = surfaces_of(path)
    (part,) = mesh_parts(tmp_path / "meshes" / name)
    triangles = np.asarray(part.triangles)
    count = len(triangles)
    assert surfaces.names == ("wall", "turned")
    assert surfaces.called(0) == f"'wall' ({name})"
    np.testing.assert_allclose(surfaces.triangles[:count], triangles, atol=1e-6)
    area = trimesh.triangles.area(surfaces.triangles)
    np.testing.assert_allclose(area[count:].sum(), 4 * area[:count].sum(), rtol=1e-5)


def test_triangles_that_mitsuba_reads_alike_stay_in_its_order(tmp_path: Path) -> None:
    """Two materials of an OBJ, which our reader takes one after the other."""
    from sionna import rt

    path = scene_file(tmp_path, file_shape("obj", "parts.obj") + file_shape("ply", "triangle.ply", 'id="mesh-flat"'))
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0.3\nv 1 1 1.7\nusemtl a\nf 1 2 3\nusemtl b\nf 2 3 4\nusemtl a\nf 1 3 4\n"
    (tmp_path / "meshes" / "parts.obj").write_text(text)
    plain = scene_surfaces(rt.load_scene(str(path), merge_shapes=False))
    np.testing.assert_array_equal(surfaces_of(path).triangles, plain.triangles)


def test_names_of_textures_and_shapes_without_ids_stay(tmp_path: Path) -> None:
    """Shapes within a merge shape, and a BSDF with a picture, too."""
    Image.new("RGB", (2, 2)).save(tmp_path / "wood.png")
    picture = '<texture type="bitmap" name="reflectance"><string name="filename" value="wood.png"/></texture>'
    looks = f'<bsdf type="diffuse" id="mat-itu_wood">{picture}</bsdf>'
    shapes = f'<shape type="disk">{looks}</shape>{file_shape("ply", "quad.ply", "")}'
    surfaces = surfaces_of(scene_file(tmp_path, shapes))
    assert surfaces.files == ("disk", "quad.ply")
    assert all(name.startswith("no-name-") for name in surfaces.names)
    merged = (
        f'<shape type="merge" id="all">{file_shape("ply", "quad.ply")}<shape type="rectangle">{USED}</shape></shape>'
    )
    assert trimesh.triangles.area(surfaces_of(scene_file(tmp_path, merged)).triangles).sum() == pytest.approx(16)


def shape_of(plugin: str, content: str, more: str = 'id="a"') -> str:
    return f'<shape type="{plugin}" {more}>{content}</shape>'


@pytest.mark.parametrize(
    ("shape", "words"),
    [
        (shape_of("rectangle", f'<float name="radus" value="2"/>{USED}'), "'a': .*unknown property .*radus"),
        (shape_of("disk", f'<transform name="toWorld"/>{USED}'), "'a': .*unknown property transform \"toWorld\""),
        (shape_of("sphere", f'<float name="radius" value="x"/>{USED}'), "'a': .*floating point value \"x\""),
        (shape_of("sphere", f'<float name="radius" value="0"/>{USED}'), "'a': has no area; give a radius"),
        (shape_of("sphere", f'<float name="radius" value="nan"/>{USED}'), "'a': has no area; give"),
        (file_shape("ply", "none.ply"), r"'mesh-wall': .*none\.ply: cannot be read as a mesh"),
        (file_shape("ply", "outside.ply", ""), r"2 \(ply, no id\): .*outside\.ply: .*a face names a vertex"),
        (file_shape("ply", "empty.ply"), r"'mesh-wall': .*empty\.ply: holds no triangles; remove the shape"),
        (shape_of("ply", USED), "'a': has 0 file names; give one"),
        (shape_of("hair", USED, ""), r"2 \(hair, no id\): plugin 'hair' of <shape> does not belong"),
        (shape_of("shapegroup", shape_of("cube", USED, "")), "'a': Sionna RT has no shapegroup; write the shapes"),
        (shape_of("cube", '<bsdf type="diffuse"/>'), r"'a': its <bsdf> \(diffuse\) has no id; give it"),
        (shape_of("cube", '<bsdf type="diffuse" id="b"/>'), "'a': .*which is not a radio material"),
        (
            shape_of("cube", '<bsdf type="radio-material" id="b"><float name="depth" value="1"/></bsdf>'),
            "'a': .*radio material has an unknown property; known are relative_permittivity",
        ),
        (shape_of("cube", ""), "'a': .*which is not a radio material"),
        (shape_of("cube", '<ref id="none"/>', ""), r"2 \(cube, no id\): .*unresolved reference to \"none\""),
    ],
)
def test_refused_shapes_are_named_with_the_remedy(shape: str, words: str, tmp_path: Path, capsys: Any) -> None:
    path = scene_file(tmp_path, f'<shape type="cube" id="good">{USED}</shape>{shape}')
    with pytest.raises(InputError, match=f"^{path}: shape {words}") as error:
        open_scene(path, FREQUENCY_HZ)
    message = str(error.value)
    assert "\n" not in message
    assert "; " in message
    assert main(["export", str(path), "--format", "ply", "--out", str(tmp_path / "out.ply")]) == 2
    assert capsys.readouterr().err.strip().endswith(message)
    assert not (tmp_path / "out.ply").exists()


def test_material_without_id_beside_the_shapes_is_named(tmp_path: Path) -> None:
    path = scene_file(tmp_path, f'<bsdf type="diffuse"/><shape type="cube" id="a">{USED}</shape>')
    with pytest.raises(InputError, match=r"<bsdf> 2 \(diffuse\) has no id; give it one"):
        open_scene(path, FREQUENCY_HZ)


@pytest.mark.parametrize("name", ["box", "simple_street_canyon_with_cars", "triple_reflector"])
def test_scenes_of_sionna_rt_have_the_same_faces(name: str) -> None:
    from sionna import rt

    path = Path(getattr(rt.scene, name))
    plain = scene_surfaces(rt.load_scene(str(path), merge_shapes=False))
    surfaces = surfaces_of(path)
    assert surfaces.names == plain.names
    assert surfaces.files == plain.files
    np.testing.assert_array_equal(surfaces.triangles, plain.triangles)
