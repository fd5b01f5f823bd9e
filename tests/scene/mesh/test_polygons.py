"""Faces of OBJ and PLY with more than three corners, and the many ways to write them."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from pathlib import Path

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


def area(parts: list[trimesh.Trimesh]) -> float:
    return sum(float(part.area) for part in parts)


def polygon(corners: object) -> Polygons:
    vertices = np.asarray(corners, float)
    count = len(vertices)
    return Polygons(vertices, np.arange(count), np.array([count]), np.zeros(1, int), lambda _: "face 1")


def filled_area(corners: object) -> float:
    vertices = np.asarray(corners, float)
    return float(trimesh.triangles.area(vertices[triangles_of(polygon(vertices))[0]]).sum())


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
def test_triangles_fill_a_simple_polygon_and_no_more(
    gaps: list[float], radii: list[float], turn: int, split: int, reverse: bool, rotation: int
) -> None:
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
    triangles, owner = triangles_of(polygon(in_space))
    assert trimesh.triangles.area(in_space[triangles]).sum() == pytest.approx(expected, rel=ROUNDING)
    assert (owner == 0).all()
    # Every corner stays one, so that neighbours share their edges.
    assert len(np.unique(in_space[triangles].reshape(-1, 3).round(9), axis=0)) == len(gaps) + 1


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
def test_concave_faces_holes_and_faces_without_area(corners: list[tuple[float, float]], expected: float) -> None:
    """Upright, and in sloping planes, in which float32 does not keep corners on sides."""
    rng = np.random.default_rng(3)
    spins = [np.eye(3), *(trimesh.transformations.random_rotation_matrix(rng.random(3))[:3, :3] for _ in range(20))]
    for spin in spins:
        places = np.array([(x, 0.5, z) for x, z in corners]) @ spin.T + rng.uniform(-20, 20, 3)
        assert filled_area(places.astype(np.float32)) == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("uneven_m", [0.01, 0.3])
def test_a_face_that_is_not_quite_flat_keeps_its_shape(uneven_m: float) -> None:
    warped = np.array([(x, y, uneven_m * (k in (1, 4))) for k, (x, y) in enumerate(L_SHAPE)])
    triangles, _ = triangles_of(polygon(warped))
    seen = warped[triangles] * (1, 1, 0)
    assert trimesh.triangles.area(seen).sum() == pytest.approx(L_AREA)


def test_a_long_face_that_is_twisted_is_seen_from_its_broad_side() -> None:
    """Its corners lie farther apart across its plane than it is wide."""
    strip = np.array([(0, 0, 0.3), (5, 0, -0.3), (10, 0, 0.3), (10, 0.1, -0.3), (5, 0.05, 0.3), (0, 0.1, -0.3)])
    triangles, _ = triangles_of(polygon(strip))
    assert trimesh.triangles.area(strip[triangles] * (1, 1, 0)).sum() == pytest.approx(0.75)


def test_corners_within_sides_leave_no_triangle_without_area() -> None:
    """Those would be dropped, and with them the connection to the faces that meet there."""
    sides = [(0, 0), (1, 0), (2, 0), (4, 0), (4, 3), (2, 3), (0, 3), (0, 1)]
    for turn in range(len(sides)):
        corners = np.array([(x, y, 1) for x, y in np.roll(sides, turn, axis=0)])
        triangles, _ = triangles_of(polygon(corners))
        assert len(triangles) == len(sides) - 2
        assert trimesh.triangles.area(corners[triangles]).min() > 0.1


@pytest.mark.parametrize(
    "corners",
    [
        [(0, 0), (4, 0), (0, 3), (4, 3)],  # a bow tie
        [(0, 0), (4, 0), (1, 3), (2, -1)],
        [(np.cos(0.8 * np.pi * k), np.sin(0.8 * np.pi * k)) for k in range(5)],  # a star in one line
        [(0, 0), (4, 0), (4, 3), (0, 3)] * 2,
    ],
)
def test_a_face_whose_edges_cross_is_refused_by_its_line(corners: list[tuple[float, float]], tmp_path: Path) -> None:
    content = obj([(x, y, 0) for x, y in corners], [range(1, len(corners) + 1)])
    with pytest.raises(InputError, match=rf"cross.obj: .*line {len(corners) + 1}: the edges of the face cross"):
        read(tmp_path, "cross.obj", content)


def test_doorways_stay_open(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
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
def test_every_way_to_write_obj_gives_the_same_box(content: str | bytes, tmp_path: Path) -> None:
    (part,) = read(tmp_path, "box.obj", content)
    assert part.area == pytest.approx(BOX_AREA)
    assert part.is_watertight
    np.testing.assert_array_equal(part.bounds, [[0, 0, 0], [4, 3, 2.5]])


def test_negative_indices_count_back_from_the_face(tmp_path: Path) -> None:
    floor, ceiling = BOX[:4], BOX[4:]
    (part,) = read(tmp_path, "two.obj", obj(floor, [(-4, -3, -2, -1)]) + obj(ceiling, [("-4/1", "-3/1", "-2/1", 8)]))
    assert area([part]) == pytest.approx(24.0)
    assert sorted(part.triangles[:, :, 2].mean(axis=1)) == [0, 0, 2.5, 2.5]


def test_materials_of_obj_are_parts(tmp_path: Path) -> None:
    faces = [f"usemtl {'brick' if k % 2 else 'glass'}\nf {' '.join(map(str, face))}" for k, face in enumerate(QUADS)]
    parts = read(tmp_path, "box.obj", obj(BOX, []) + "\n".join(faces))
    assert [len(part.faces) for part in parts] == [6, 6]
    assert area(parts) == pytest.approx(BOX_AREA)


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
def test_faces_without_their_vertices_name_the_line(face: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message) as caught:
        read(tmp_path, "bad.obj", obj(BOX, [[face]]))
    assert "\n" not in str(caught.value)


PLY = {"char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I", "float": "f", "double": "d"}
ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
MIXED = [tuple(k - 1 for k in face) for face in QUADS[:3]]
MIXED += [tuple(face[k] - 1 for k in corners) for face in QUADS[3:] for corners in ((0, 1, 2), (0, 2, 3))]


def ply(
    form: str,
    faces: list[tuple[int, ...]],
    types: tuple[str, str, str] = ("float", "uchar", "int"),
    name: str = "vertex_indices",
    order: str = "vertex face",
    end: str = "\n",
    quality: bool = False,
    vertices: Sequence[tuple[float, float, float]] = BOX,
) -> bytes:
    """A PLY file, perhaps with a further element or property."""
    number, count, index = types
    quality_lines = ["property float quality"] if quality else []
    header = {
        "vertex": [f"element vertex {len(vertices)}", *(f"property {number} {axis}" for axis in "xyz")],
        "face": [f"element face {len(faces)}", *quality_lines, f"property list {count} {index} {name}", *quality_lines],
        "edge": ["element edge 1", "property int vertex1", "property int vertex2"],
    }
    first = [("float", 0.5)] if quality else []
    rows: dict[str, list[list[tuple[str, float]]]] = {
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


@pytest.mark.parametrize("form", ORDERS)
@pytest.mark.parametrize("faces", [MIXED, [tuple(k - 1 for k in face) for face in QUADS]], ids=["mixed", "quads"])
def test_every_way_to_write_ply_gives_the_same_box(form: str, faces: list[tuple[int, ...]], tmp_path: Path) -> None:
    ways = (
        {},
        {"types": ("double", "uint", "ushort"), "name": "vertex_index"},
        {"types": ("float", "char", "uint"), "quality": True},
        {"order": "edge face vertex"},
        {"end": "\r\n"},
    )
    for way in ways:
        (part,) = read(tmp_path, "box.ply", ply(form, faces, **way))  # type: ignore[arg-type]
        assert part.area == pytest.approx(BOX_AREA)
        assert part.is_watertight
        np.testing.assert_array_equal(part.vertices, np.array(BOX, float))


@pytest.mark.parametrize("form", ORDERS)
def test_concave_faces_of_ply_keep_their_area(form: str, tmp_path: Path) -> None:
    upright = [(x, 0.5, z) for x, z in L_SHAPE]
    (part,) = read(tmp_path, "L.ply", ply(form, [tuple(range(6)), (0, 1, 2)], vertices=upright))
    assert part.area == pytest.approx(L_AREA + 2.0)


def test_a_file_that_is_cut_off_is_never_a_smaller_mesh(tmp_path: Path) -> None:
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
            assert area(read(tmp_path, name, content)) > 0
        end = content.rfind(b"endsolid") if name in ("text.stl", "two.stl") else len(content)
        for length in {*range(0, end, 37), *range(end - 9, end)}:
            with pytest.raises(InputError, match=f"{name}: cannot be read as a mesh") as caught:
                read(tmp_path, name, content[:length])
            assert "\n" not in str(caught.value)
    cut = (files["box.stl"][: 84 + 50 * 5], "states 12 triangles and has bytes for 5; it is cut off")
    for content, message in (cut, (text[: len(text) // 2], "a solid without its endsolid; it is cut off")):
        (tmp_path / "cut.stl").write_bytes(content)
        with pytest.raises(InputError, match=message):
            mesh_parts(tmp_path / "cut.stl")


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
def test_damaged_ply_is_refused_in_one_line(old: bytes, new: bytes, message: str, tmp_path: Path) -> None:
    content = ply("ascii", MIXED)
    assert old in content
    with pytest.raises(InputError, match=message):
        read(tmp_path, "bad.ply", content.replace(old, new))


def test_vertices_that_no_face_names_are_left_out(tmp_path: Path) -> None:
    stray = "v 9e9 nan 0\n"
    for content, name in ((stray + obj(BOX, [(2, 3, 4)]), "a.obj"), (ply("ascii", [(0, 1, 2)]), "a.ply")):
        (part,) = read(tmp_path, name, content)
        assert len(part.vertices) == 3
    with pytest.raises(InputError, match=r"nan.obj: vertex 1 of mesh is not finite"):
        read(tmp_path, "nan.obj", stray + obj(BOX, [(1, 2, 3, 4)]))
