"""Shapes of Mitsuba scene files as triangles; one line with the shape and the remedy for each that is refused."""

import logging
import re
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from PIL import Image
from traced_rooms import FREQUENCY_HZ, SHOEBOX, THICKNESS_M, receiver, write_xml
from wrf_mi_scenes.build_laboratory import sheet

from wrf_mi.core import InputError
from wrf_mi.scene.mesh.files import mesh_parts
from wrf_mi.tracing import TraceOptions, open_scene, trace_paths
from wrf_mi.tracing.search.surfaces import scene_surfaces
from wrf_mi.tracing.sionna.scenes import SEGMENTS

METAL = '<bsdf type="itu-radio-material" id="mat-metal_of_test"><string name="type" value="metal"/></bsdf>'
USED = '<ref id="mat-metal_of_test" name="bsdf"/>'
CHAIN = (
    '<transform name="to_world"><scale x="2" y="2" z="2"/><rotate x="0.6" y="0.8" angle="40"/>'
    '<translate x="1" y="-2" z="3"/></transform>'
)
HEAD = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
FACES = "element face {count}\nproperty list uchar int vertex_indices\nend_header\n"
CORNERS = "0 0 0\n4 0 0\n4 3 0\n0 3 0\n"
CYLINDER = (
    '<point name="p0" value="1, 0, 2"/><point name="p1" value="1, 3, 2"/><float name="radius" value="0.5"/>'
    '<boolean name="flip_normals" value="true"/>'
)
NEGATIVE = "v 0 0 0\nv 4 0 0\nv 4 3 0\nv 0 3 0\nf -4 -3 -2\nf -4 -2 -1\n"
L_SHAPE = "v 1 4 0\nv 0 4 0\nv 0 0 0\nv 4 0 0\nv 4 1 0\nv 1 1 0\nf 1 2 3 4 5 6\n"


def scene_file(folder, shapes):
    """A scene of a metal and some shapes, with mesh files that they may name."""
    meshes = folder / "meshes"
    meshes.mkdir(parents=True, exist_ok=True)
    for name, face in {"quad": "4 0 1 2 3\n", "triangle": "3 0 1 2\n", "empty": "", "outside": "3 0 1 9\n"}.items():
        (meshes / f"{name}.ply").write_text(HEAD + FACES.format(count=int(face != "")) + CORNERS + face)
    (meshes / "negative.obj").write_text(NEGATIVE)
    (meshes / "concave.obj").write_text(L_SHAPE)
    (folder / "scene.xml").write_text(f'<scene version="3.0.0">{METAL}{shapes}</scene>')
    return folder / "scene.xml"


def file_shape(kind, name, more='id="mesh-wall"'):
    return f'<shape type="{kind}" {more}><string name="filename" value="meshes/{name}"/>{USED}</shape>'


def shape_of(plugin, content, more='id="a"'):
    return f'<shape type="{plugin}" {more}>{content}</shape>'


def radius(value, name="radius"):
    return f'<float name="{name}" value="{value}"/>{USED}'


def surfaces_of(path):
    return scene_surfaces(open_scene(path, FREQUENCY_HZ))


SPHERE = '<point name="center" x="1" y="2" z="-1"/><float name="radius" value="0.5"/>'


@pytest.mark.parametrize(
    ("plugin", "parameters", "area_m2"),
    [
        *(("rectangle", "", 4.0), ("cube", "", 24.0), ("disk", "", np.pi)),
        *(("sphere", SPHERE, np.pi), ("cylinder", CYLINDER, 3 * np.pi)),
    ],
)
def test_shapes_without_triangles_lie_where_mitsuba_has_them(plugin, parameters, area_m2, tmp_path):
    """Corners lie on the shape: the mesh is inscribed, and smaller by the facets' share of a circle."""
    shape = f'<shape type="{plugin}" id="mesh-thing">{parameters}{CHAIN}'
    surfaces = surfaces_of(scene_file(tmp_path, f"{shape}{USED}</shape>"))
    assert surfaces.names == ("thing",)
    off, face_m2 = 1 - np.cos(np.pi / SEGMENTS) ** 2, trimesh.triangles.area(surfaces.triangles)
    assert 4 * area_m2 * (1 - 2 * off) < face_m2.sum() < 4 * area_m2 * (1 + 1e-5)
    bounds = mi.load_string(f'<scene version="3.0.0">{shape}</shape></scene>').bbox()
    low, high, corners = np.ravel(bounds.min), np.ravel(bounds.max), surfaces.triangles.reshape(-1, 3)
    # All of the shapes are symmetric about their middle: triangles that overlap and leave a gap are not.
    middle = face_m2 @ surfaces.triangles.mean(axis=1) / face_m2.sum()
    np.testing.assert_allclose(middle, (low + high) / 2, atol=1e-5)
    for mesh_bound, bound in ((corners.min(axis=0), low), (corners.max(axis=0), high)):
        np.testing.assert_allclose(mesh_bound, bound, atol=off * np.max(high - low))


def test_rectangle_is_traced_like_its_mesh(tmp_path):
    mesh = {"plate": ("itu_brick", sheet(2, 1.5, (1.0, 5.0), (2.0, 4.0)))}
    as_mesh, as_shape = write_xml(tmp_path / "mesh", {**SHOEBOX, **mesh}), write_xml(tmp_path / "shape", SHOEBOX)
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


def test_curved_shapes_are_logged_with_their_deviation(tmp_path, caplog):
    with caplog.at_level(logging.INFO):
        surfaces = surfaces_of(scene_file(tmp_path, shape_of("sphere", radius(2), 'id="mesh-ball"')))
    assert "shape 'mesh-ball': a sphere as 960 triangles, up to 0.019 m off it" in caplog.text
    assert len(surfaces.solids) == 0  # a room, by its size
    planes = np.abs(np.einsum("fd,fd->f", surfaces.normal[surfaces.plane], surfaces.triangles[:, 0]))
    assert planes.min() > 2 - 0.02


@pytest.mark.parametrize("name", ["quad.ply", "negative.obj", "concave.obj", "triangle.ply"])
def test_mesh_files_have_the_triangles_of_our_reader(name, tmp_path):
    """Also those that Mitsuba refuses or fans, and moved by their transform."""
    shape = file_shape(name[-3:], name)
    turned = shape.replace(USED, USED + CHAIN).replace("mesh-wall", "mesh-turned")
    surfaces = surfaces_of(scene_file(tmp_path, shape + turned))
    (part,) = mesh_parts(tmp_path / "meshes" / name)
    count, area = len(part.triangles), trimesh.triangles.area(surfaces.triangles)
    assert surfaces.names == ("wall", "turned")
    assert surfaces.called(0) == f"'wall' ({name})"
    np.testing.assert_allclose(surfaces.triangles[:count], part.triangles, atol=1e-6)
    np.testing.assert_allclose(area[count:].sum(), 4 * area[:count].sum(), rtol=1e-5)


def test_triangles_that_mitsuba_reads_alike_stay_in_its_order(tmp_path):
    """Two materials of an OBJ, which our reader takes one after the other."""
    from sionna import rt

    path = scene_file(tmp_path, file_shape("obj", "parts.obj") + file_shape("ply", "triangle.ply", 'id="mesh-flat"'))
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0.3\nv 1 1 1.7\nusemtl a\nf 1 2 3\nusemtl b\nf 2 3 4\nusemtl a\nf 1 3 4\n"
    (tmp_path / "meshes" / "parts.obj").write_text(text)
    plain = scene_surfaces(rt.load_scene(str(path), merge_shapes=False))
    np.testing.assert_array_equal(surfaces_of(path).triangles, plain.triangles)


def test_names_of_textures_and_shapes_without_ids_stay(tmp_path):
    """Shapes within a merge shape, and a BSDF with a picture, too."""
    Image.new("RGB", (2, 2)).save(tmp_path / "wood.png")
    picture = '<texture type="bitmap" name="reflectance"><string name="filename" value="wood.png"/></texture>'
    disk, quad = f'<bsdf type="diffuse" id="mat-itu_wood">{picture}</bsdf>', file_shape("ply", "quad.ply", "")
    surfaces = surfaces_of(scene_file(tmp_path, shape_of("disk", disk, "") + quad))
    assert surfaces.files == ("disk", "quad.ply")
    assert all(name.startswith("no-name-") for name in surfaces.names)
    merged = shape_of("merge", file_shape("ply", "quad.ply") + shape_of("rectangle", USED, ""), 'id="all"')
    assert trimesh.triangles.area(surfaces_of(scene_file(tmp_path, merged)).triangles).sum() == pytest.approx(16)


RADIO = '<bsdf type="radio-material" id="b"><float name="depth" value="1"/></bsdf>'


@pytest.mark.parametrize(
    ("shape", "words"),
    [
        (shape_of("rectangle", radius(2, "radus")), "'a': .*unknown property .*radus"),
        (shape_of("disk", f'<transform name="toWorld"/>{USED}'), "'a': .*unknown property transform \"toWorld\""),
        (shape_of("sphere", radius("x")), "'a': .*floating point value \"x\""),
        *((shape_of("sphere", radius(value)), "'a': has no area; give a radius") for value in ("0", "nan")),
        (file_shape("ply", "none.ply"), r"'mesh-wall': .*none\.ply: cannot be read as a mesh"),
        (file_shape("ply", "outside.ply", ""), r"2 \(ply, no id\): .*outside\.ply: .*a face names a vertex"),
        (file_shape("ply", "empty.ply"), r"'mesh-wall': .*empty\.ply: holds no triangles; remove the shape"),
        (shape_of("ply", USED), "'a': has 0 file names; give one"),
        (shape_of("hair", USED, ""), r"2 \(hair, no id\): plugin 'hair' of <shape> does not belong"),
        (shape_of("shapegroup", shape_of("cube", USED, "")), "'a': Sionna RT has no shapegroup; write the shapes"),
        (shape_of("cube", '<bsdf type="diffuse"/>'), r"'a': its <bsdf> \(diffuse\) has no id; give it"),
        *(
            (shape_of("cube", bsdf), "'a': .*which is not a radio material")
            for bsdf in ('<bsdf type="diffuse" id="b"/>', "")
        ),
        (shape_of("cube", RADIO), "'a': .*radio material has an unknown property; known are relative_permittivity"),
        (shape_of("cube", '<ref id="none"/>', ""), r"2 \(cube, no id\): .*unresolved reference to \"none\""),
    ],
)
def test_refused_shapes_are_named_with_the_remedy(shape, words, tmp_path, command):
    path = scene_file(tmp_path, f'<shape type="cube" id="good">{USED}</shape>{shape}')
    with pytest.raises(InputError, match=f"^{path}: shape {words}") as error:
        open_scene(path, FREQUENCY_HZ)
    message, out = str(error.value), tmp_path / "out.ply"
    assert "; " in message
    command.refused(["export", path, "--format", "ply", "--out", out], f"{re.escape(message)}$")
    assert not out.exists()


def test_material_without_id_beside_the_shapes_is_named(tmp_path):
    path = scene_file(tmp_path, f'<bsdf type="diffuse"/><shape type="cube" id="a">{USED}</shape>')
    with pytest.raises(InputError, match=r"<bsdf> 2 \(diffuse\) has no id; give it one"):
        open_scene(path, FREQUENCY_HZ)


@pytest.mark.parametrize("name", ["box", "simple_street_canyon_with_cars", "triple_reflector"])
def test_scenes_of_sionna_rt_have_the_same_faces(name):
    from sionna import rt

    path = Path(getattr(rt.scene, name))
    plain = scene_surfaces(rt.load_scene(str(path), merge_shapes=False))
    surfaces = surfaces_of(path)
    assert surfaces.names == plain.names
    assert surfaces.files == plain.files
    np.testing.assert_array_equal(surfaces.triangles, plain.triangles)
