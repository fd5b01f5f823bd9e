"""Faces of OBJ and PLY with more than three corners, and the many ways to write them."""

import json
import struct
from collections.abc import Callable, Iterable
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from calling import call
from hypothesis import given, settings
from hypothesis import strategies as st

from wrf_mi.core import InputError
from wrf_mi.scene.mesh.files import mesh_parts, triangles_of
from wrf_mi.scene.mesh.polygon_files import Polygons

ROUNDING = 1e-6
"""Relative error of areas of float32 coordinates."""
L_SHAPE = ((1, 4), (0, 4), (0, 0), (4, 0), (4, 1), (1, 1))
L_AREA = 7.0
BOX = ((0, 0, 0), (4, 0, 0), (4, 3, 0), (0, 3, 0), (0, 0, 2.5), (4, 0, 2.5), (4, 3, 2.5), (0, 3, 2.5))
QUADS = ((1, 4, 3, 2), (5, 6, 7, 8), (1, 2, 6, 5), (2, 3, 7, 6), (3, 4, 8, 7), (4, 1, 5, 8))
BOX_AREA = 59.0


def obj(vertices: Iterable[Iterable[object]], faces: Iterable[Iterable[object]]) -> str:
    lines = ["v " + " ".join(map(str, vertex)) for vertex in vertices]
    return "\n".join([*lines, *("f " + " ".join(map(str, face)) for face in faces)]) + "\n"


def read(folder: Path, name: str, content: str | bytes) -> list[trimesh.Trimesh]:
    (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)
    return mesh_parts(folder / name)


def refused(folder: Path, name: str, content: str | bytes, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        read(folder, name, content)
    assert "\n" not in str(caught.value)


def triangles(corners) -> np.ndarray:
    """Indices [n, 3] of the triangles of one face with corners [k, 3]."""
    vertices, count = np.asarray(corners, float), len(corners)
    face = Polygons(vertices, np.arange(count), np.array([count]), np.zeros(1, int), lambda _: "face 1")
    faces, owner = triangles_of(face)
    assert (owner == 0).all()
    return faces


def area(corners, seen=(1, 1, 1)) -> float:
    """Area of the triangles of one face, perhaps as seen along an axis."""
    return float(trimesh.triangles.area(np.asarray(corners, float)[triangles(corners)] * seen).sum())


def shoelace(corners: np.ndarray) -> float:
    x, y = corners.T
    return abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1))) / 2


@settings(max_examples=60, deadline=None)
@given(
    gaps=st.lists(st.floats(0.2, 1.0), min_size=4, max_size=12),
    radii=st.lists(st.floats(0.3, 5.0), min_size=12, max_size=12),
    turn=st.integers(0, 5),
    split=st.integers(0, 11),
    reverse=st.booleans(),
    rotation=st.integers(0, 2**32 - 1),
)
def test_triangles_fill_a_simple_polygon_and_no_more(gaps, radii, turn, split, reverse, rotation):
    """In any plane and order, with a corner in a straight side, and one written twice."""
    angles = np.cumsum(gaps) / sum(gaps) * 2 * np.pi
    corners = np.stack([np.cos(angles), np.sin(angles)], axis=1) * np.array(radii[: len(gaps)])[:, None]
    expected, at = shoelace(corners), split % len(corners)
    if np.diff(angles, append=angles[0] + 2 * np.pi).max() >= np.pi:
        return  # the centre lies outside: not a star about it
    middle = (corners[at - 1] + corners[at]) / 2
    corners = np.insert(corners, at, [middle, middle], axis=0)
    corners = np.roll(corners[::-1] if reverse else corners, turn, axis=0)
    spin = trimesh.transformations.random_rotation_matrix(np.random.default_rng(rotation).random(3))[:3, :3]
    in_space = np.column_stack([corners, np.full(len(corners), 2.0)]) @ spin.T
    assert area(in_space) == pytest.approx(expected, rel=ROUNDING)
    # Every corner stays one, so that neighbours share their edges.
    assert len(np.unique(in_space[triangles(in_space)].reshape(-1, 3).round(9), axis=0)) == len(gaps) + 1


@pytest.mark.parametrize(
    ("corners", "expected"),
    [
        ([(0, 0), (4, 0), (1, 1), (0, 4)], 4.0),  # a quad, whose fan about the first corner is right
        ([(4, 0), (1, 1), (0, 4), (0, 0)], 4.0),  # and wrong about this one
        ([*L_SHAPE, L_SHAPE[-1]], L_AREA),  # the concave corner twice
        ([*L_SHAPE, L_SHAPE[0]], L_AREA),
        # A hole, joined by an edge there and back.
        ([(0, 0), (4, 0), (4, 4), (0, 4), (0, 0), (1, 1), (1, 3), (3, 3), (3, 1), (1, 1)], 12.0),
        ([(0, 0), (4, 0), (4, 5), (4, 3), (0, 3)], 12.0),  # a spike
        ([(0, 0), (4, 0), (4, 3), (2, 3), (2, 1), (2, 3), (0, 3)], 12.0),  # and one inwards
        ([(0, 0), (4, 0), (4, 4), (2, 0), (0, 4)], 8.0),  # a corner on another side
        ([(0, 0), (1, 0), (1, 2.5), (2, 2.5), (2, 0), (4, 0), (4, 2.5), (0, 2.5)], 7.5),  # a door up to the ceiling
        ([(0, 0), (4, 0), (4, 4), (0, 4), (0, 0), (2, 0), (1, 2), (3, 2), (2, 0)], 14.0),  # a hole at the outline
        ([(0, 0), (1, 0), (2, 0), (3, 0)], 0.0),
        ([(1, 1)] * 4, 0.0),
    ],
)
def test_concave_faces_holes_and_faces_without_area(corners, expected):
    """Upright, and in sloping planes, in which float32 does not keep corners on sides."""
    rng = np.random.default_rng(3)
    spins = [np.eye(3), *(trimesh.transformations.random_rotation_matrix(rng.random(3))[:3, :3] for _ in range(20))]
    for spin in spins:
        places = np.array([(x, 0.5, z) for x, z in corners]) @ spin.T + rng.uniform(-20, 20, 3)
        assert area(places.astype(np.float32)) == pytest.approx(expected, abs=1e-4)


def test_faces_that_are_not_flat_or_have_corners_within_sides_keep_their_triangles():
    for uneven_m in (0.01, 0.3):
        warped = [(x, y, uneven_m * (k in (1, 4))) for k, (x, y) in enumerate(L_SHAPE)]
        assert area(warped, seen=(1, 1, 0)) == pytest.approx(L_AREA), uneven_m
    # A strip whose corners lie farther apart across its plane than it is wide.
    strip = [(0, 0, 0.3), (5, 0, -0.3), (10, 0, 0.3), (10, 0.1, -0.3), (5, 0.05, 0.3), (0, 0.1, -0.3)]
    assert area(strip, seen=(1, 1, 0)) == pytest.approx(0.75)
    # Triangles without area would be dropped, and with them the connection to the faces that meet there.
    sides = [(0, 0), (1, 0), (2, 0), (4, 0), (4, 3), (2, 3), (0, 3), (0, 1)]
    for turn in range(len(sides)):
        corners = np.array([(x, y, 1) for x, y in np.roll(sides, turn, axis=0)])
        faces = triangles(corners)
        assert len(faces) == len(sides) - 2
        assert trimesh.triangles.area(corners[faces]).min() > 0.1


@pytest.mark.parametrize(
    "corners",
    [
        [(0, 0), (4, 0), (0, 3), (4, 3)],  # a bow tie
        [(0, 0), (4, 0), (1, 3), (2, -1)],
        [(np.cos(0.8 * np.pi * k), np.sin(0.8 * np.pi * k)) for k in range(5)],  # a star in one line
        [(0, 0), (4, 0), (4, 3), (0, 3)] * 2,
    ],
)
def test_a_face_whose_edges_cross_is_refused_by_its_line(corners, tmp_path):
    content = obj([(x, y, 0) for x, y in corners], [range(1, len(corners) + 1)])
    refused(tmp_path, "cross.obj", content, rf"cross.obj: .*line {len(corners) + 1}: the edges of the face cross")


def test_doorways_stay_open(tmp_path, capsys):
    """The front of a room, to the right and the left of its door, is one face."""
    door = [(0, 0, 0), (1, 0, 0), (1, 0, 2), (2, 0, 2), (2, 0, 0), (4, 0, 0), (4, 0, 2.5), (0, 0, 2.5)]
    back = [(x, 3, z) for x, _, z in door]
    floor, ceiling = (0, 5, 13, 8), (7, 6, 14, 15)
    sides = [(0, 7, 15, 8), (5, 6, 14, 13)]
    faces = [range(8), floor, ceiling, *sides, range(8, 16)]
    (tmp_path / "room.obj").write_text(obj([*door, *back], [[k + 1 for k in face] for face in faces]))
    status, out, err = call(["mesh", tmp_path / "room.obj", "--out", tmp_path / "scene"], capsys)
    assert (status, err) == (0, "")
    assert out.startswith("1 floor, 1 ceiling, 4 wall, 0 other")
    walls = sorted((tmp_path / "scene" / "meshes").glob("wall_*.ply"))
    fronts = [part for path in walls for part in mesh_parts(path) if np.ptp(part.vertices[:, 1]) == 0]
    assert [float(part.area) for part in fronts] == pytest.approx([8.0, 8.0])


WRITTEN = obj(BOX, QUADS)


@pytest.mark.parametrize(
    "content",
    [
        WRITTEN.replace(" ", "\t"),
        "\n".join(f"  {line} " for line in WRITTEN.splitlines()),
        WRITTEN.replace("\n", "\r"),
        WRITTEN.replace("\n", "\r\n"),
        "\ufeff" + WRITTEN,
        WRITTEN.replace("\n", " # by hand\n"),
        WRITTEN.replace("f 1 4 3 2", "f 1 4 \\\r\n 3 2"),
        WRITTEN.replace("f 1 4 3 2", "f 1/1/1 4//1 3/2 2/"),
        "".join(f"{line}\n" for line in reversed(WRITTEN.splitlines()) if line[0] == "f") + obj(BOX, []),
        obj(BOX, []) + obj([], [[k - 9 for k in face] for face in QUADS]),
        "mtllib no.mtl\no room\ng walls\ns off\nvt 0 0\nvn 0 0 1\nl 1 2\np 1\n" + WRITTEN,
        WRITTEN.encode() + b"# caf\xe9\n",
    ],
    ids=["tabs", "blanks", "cr", "crlf", "bom", "comments", "continued", "textured", "before", "back", "rest", "latin"],
)
def test_every_way_to_write_obj_gives_the_same_box(content, tmp_path):
    (part,) = read(tmp_path, "box.obj", content)
    assert part.area == pytest.approx(BOX_AREA)
    assert part.is_watertight
    np.testing.assert_array_equal(part.bounds, [[0, 0, 0], [4, 3, 2.5]])


def test_negative_indices_materials_and_stray_vertices(tmp_path):
    floor, ceiling = BOX[:4], BOX[4:]
    (part,) = read(tmp_path, "two.obj", obj(floor, [(-4, -3, -2, -1)]) + obj(ceiling, [("-4/1", "-3/1", "-2/1", 8)]))
    assert part.area == pytest.approx(24.0)
    assert sorted(part.triangles[:, :, 2].mean(axis=1)) == [0, 0, 2.5, 2.5]
    faces = [f"usemtl {'brick' if k % 2 else 'glass'}\nf {' '.join(map(str, face))}" for k, face in enumerate(QUADS)]
    parts = read(tmp_path, "box.obj", obj(BOX, []) + "\n".join(faces))
    assert [len(part.faces) for part in parts] == [6, 6]
    assert sum(part.area for part in parts) == pytest.approx(BOX_AREA)
    stray = "v 9e9 nan 0\n"
    for content, name in ((stray + obj(BOX, [(2, 3, 4)]), "a.obj"), (ply("ascii", [(0, 1, 2)]), "a.ply")):
        (part,) = read(tmp_path, name, content)
        assert len(part.vertices) == 3
    refused(tmp_path, "nan.obj", stray + obj(BOX, [(1, 2, 3, 4)]), "nan.obj: vertex 1 of mesh is not finite")


@pytest.mark.parametrize(
    ("face", "message"),
    [
        ("0 1 2", r"line 9: names vertex 0, and OBJ counts from 1; add 1 to the indices of all faces"),
        ("1 2 -9", r"line 9: names vertex -9, and only 8 are above it"),
        ("1 2 9", r"a face names a vertex that is not among its 8: line 9"),
        ("1 2", r"line 9 has 2 corners; a face has three or more"),
        ("1 2 3.0", r"line 9: '3.0' is no number of a vertex"),
    ],
)
def test_faces_without_their_vertices_name_the_line(face, message, tmp_path):
    refused(tmp_path, "bad.obj", obj(BOX, [[face]]), message)


PLY = {"char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I", "float": "f", "double": "d"}
ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
MIXED = [tuple(k - 1 for k in face) for face in QUADS[:3]]
MIXED += [tuple(face[k] - 1 for k in corners) for face in QUADS[3:] for corners in ((0, 1, 2), (0, 2, 3))]


TYPES = ("float", "uchar", "int")
"""Of coordinates, lengths of lists and indices."""


def ply(form, faces, types=TYPES, name="vertex_indices", order="vertex face", end="\n", quality=False, vertices=BOX):
    """A PLY file, perhaps with a further element or property."""
    number, count, index = types
    quality_lines = ["property float quality"] if quality else []
    header = {
        "vertex": [f"element vertex {len(vertices)}", *(f"property {number} {axis}" for axis in "xyz")],
        "face": [f"element face {len(faces)}", *quality_lines, f"property list {count} {index} {name}", *quality_lines],
        "edge": ["element edge 1", "property int vertex1", "property int vertex2"],
    }
    first = [("float", 0.5)] if quality else []
    rows = {
        "vertex": [[(number, value) for value in vertex] for vertex in vertices],
        "face": [[*first, (count, len(face)), *((index, k) for k in face), *first] for face in faces],
        "edge": [[("int", 0), ("int", 1)]],
    }
    lines = ["ply", f"format {form} 1.0", "comment a box", "obj_info by hand"]
    lines += [line for element in order.split() for line in header[element]]
    body = b""
    for row in (row for element in order.split() for row in rows[element]):
        if form == "ascii":
            body += (" ".join(str(value) for _, value in row) + end).encode()
        else:
            body += b"".join(struct.pack(ORDERS[form] + PLY[kind], value) for kind, value in row)
    return end.join([*lines, "end_header", ""]).encode() + body


WAYS: tuple[dict[str, Any], ...] = (
    {},
    {"types": ("double", "uint", "ushort"), "name": "vertex_index"},
    {"types": ("float", "char", "uint"), "quality": True},
    {"order": "edge face vertex"},
    {"end": "\r\n"},
)


@pytest.mark.parametrize("form", ORDERS)
def test_every_way_to_write_ply_gives_the_same_box(form, tmp_path):
    for faces, way in product((MIXED, [tuple(k - 1 for k in face) for face in QUADS]), WAYS):
        (part,) = read(tmp_path, "box.ply", ply(form, faces, **way))
        assert part.area == pytest.approx(BOX_AREA), way
        assert part.is_watertight
        np.testing.assert_array_equal(part.vertices, np.array(BOX, float))
    upright = [(x, 0.5, z) for x, z in L_SHAPE]
    (part,) = read(tmp_path, "L.ply", ply(form, [tuple(range(6)), (0, 1, 2)], vertices=upright))
    assert part.area == pytest.approx(L_AREA + 2.0)


def test_a_file_that_is_cut_off_is_never_a_smaller_mesh(tmp_path):
    """Text may lose its last line."""
    box = trimesh.creation.box((4, 3, 2.5))
    text = trimesh.exchange.stl.export_stl_ascii(box).encode()
    files = {
        "mixed.ply": ply("binary_little_endian", MIXED),
        "text.ply": ply("ascii", MIXED).rstrip()[:-1],
        "box.glb": box.export(file_type="glb"),
        "box.stl": box.export(file_type="stl"),
        "text.stl": text,
        "two.stl": text + b"\n" + text,
        "named.stl": b"solid" + box.export(file_type="stl")[5:],
    }
    for name, content in files.items():
        if name != "text.ply":
            assert sum(part.area for part in read(tmp_path, name, content)) > 0
        end = content.rfind(b"endsolid") if name in ("text.stl", "two.stl") else len(content)
        for length in {*range(0, end, 37), *range(end - 9, end)}:
            refused(tmp_path, name, content[:length], f"{name}: cannot be read as a mesh")
    cut = files["box.stl"][: 84 + 50 * 5]
    refused(tmp_path, "cut.stl", cut, "fewer triangles than it states; it is cut off")
    refused(tmp_path, "cut.stl", text[: len(text) // 2], "fewer triangles than it states; it is cut off")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"property float z", b"property float w", "no vertices with x, y and z"),
        (b"vertex_indices", b"corners", "faces without a list vertex_indices or vertex_index"),
        (b"property float x", b"property real x", "line 'property real x' of the header is none of PLY"),
        (b"format ascii 1.0", b"format words 1.0", "of the header is none of PLY"),
        (b"element face", b"element tristrips", "its faces are triangle strips"),
        (b"end_header", b"end_headers", "no header of a PLY file, or none that ends"),
        (b"vertex 8", b"vertex 99999999999", "states 99999999999 of vertex and ends before the last"),
    ],
)
def test_damaged_ply_is_refused_in_one_line(old, new, message, tmp_path):
    content = ply("ascii", MIXED)
    assert old in content
    refused(tmp_path, "bad.ply", content.replace(old, new), message)


def changed_glb(file: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    """A box as GLB whose description is changed."""
    content = trimesh.creation.box((4, 3, 2.5)).export(file_type="glb")
    length = int.from_bytes(content[12:16], "little")
    facts = json.loads(content[20 : 20 + length])
    change(facts)
    text = json.dumps(facts).encode()
    text += b" " * (-len(text) % 4)
    body = len(text).to_bytes(4, "little") + content[16:20] + text + content[20 + length :]
    file.write_bytes(content[:8] + (12 + len(body)).to_bytes(4, "little") + body)
    return file


INSTANCES: dict[str, Any] = {"extensions": {"EXT_mesh_gpu_instancing": {"attributes": {}}}}
GLB_FAULTS = {
    "instances": (lambda f: f["nodes"][-1].update(INSTANCES), "needs the extension EXT_mesh_gpu_instancing"),
    "required": (lambda f: f.update(extensionsRequired=["ACME_shape"]), "needs the extension ACME_shape"),
    "draco": (
        lambda f: f["meshes"][0]["primitives"][0].update(extensions={"KHR_draco_mesh_compression": {}}),
        "needs the extension KHR_draco_mesh_compression",
    ),
    "meshopt": (
        lambda f: f["bufferViews"][0].update(extensions={"EXT_meshopt_compression": {}}),
        "needs the extension EXT_meshopt_compression",
    ),
    "sparse": (lambda f: f["accessors"][0].update(sparse={"count": 1}), "has sparse accessors"),
    "normalised": (
        lambda f: f["accessors"][f["meshes"][0]["primitives"][0]["attributes"]["POSITION"]].update(normalized=True),
        "has positions in normalised integers",
    ),
}


@pytest.mark.parametrize("case", GLB_FAULTS)
def test_glb_whose_geometry_is_not_read_is_refused_by_name(case: str, tmp_path: Path) -> None:
    change, message = GLB_FAULTS[case]
    with pytest.raises(InputError, match=rf"box\.glb: .*{message}; export it without"):
        mesh_parts(changed_glb(tmp_path / "box.glb", change))


def test_extensions_beside_the_geometry_are_left_out(tmp_path: Path) -> None:
    def change(facts: dict[str, Any]) -> None:
        facts.update(extensionsUsed=["KHR_materials_unlit", "ACME_sound"], extensions={"ACME_sound": {}})
        facts.update(extensionsRequired=["KHR_materials_unlit"])

    (part,) = mesh_parts(changed_glb(tmp_path / "box.glb", change))
    assert part.area == pytest.approx(2 * (4 * 3 + 4 * 2.5 + 3 * 2.5))
