"""One building of two storeys in every format of meshes, with y or z up, in metres and millimetres."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import collada
import numpy as np
import pytest
import trimesh
from collada.source import FloatSource, InputList
from pxr import Gf, Usd, UsdGeom

from wrf_mi.core import InputError
from wrf_mi.scene.coordinates import Y_UP
from wrf_mi.scene.make import make_scene
from wrf_mi.scene.mesh.facets import planes_of_mesh
from wrf_mi.scene.mesh.files import mesh_parts, read_mesh

EQUAL = 1e-6
"""Of areas, normals and offsets: coordinates are multiples of a quarter metre, which single precision holds."""
OUTLINE = ((0, 0), (6, 0), (6, 2.5), (3, 2.5), (3, 5), (0, 5))
STOREYS = ((0.0, 2.75), (3.0, 5.75))
FLOOR_M2, PERIMETER_M = 22.5, 22.0

Polygons = list[tuple[int, ...]]


def building() -> tuple[np.ndarray, Polygons]:
    """Vertices, metres, and polygons: an L-shaped floor and ceiling and six walls in each storey."""
    vertices, polygons = list[tuple[float, ...]](), Polygons()
    count = len(OUTLINE)
    for low, high in STOREYS:
        first = len(vertices)
        vertices += [(x, y, z) for z in (low, high) for x, y in OUTLINE]
        floor = tuple(first + k for k in range(count))
        polygons += [floor[::-1], tuple(k + count for k in floor)]
        polygons += [(a, b, b + count, a + count) for a, b in zip(floor, np.roll(floor, -1).tolist(), strict=True)]
    return np.array(vertices), polygons


def triangles(vertices: np.ndarray, polygons: Polygons) -> trimesh.Trimesh:
    """Polygons as triangles, the L as two rectangles of two each."""
    faces = list[tuple[int, ...]]()
    for polygon in polygons:
        corners = polygon if len(polygon) == 4 or polygon[0] < polygon[-1] else polygon[::-1]
        cuts = ((0, 1, 2), (0, 2, 3)) if len(polygon) == 4 else ((0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5))
        faces += [tuple(corners[k] for k in cut) for cut in cuts]
    return trimesh.Trimesh(vertices, faces, process=False)


def write_obj(file: Path, vertices: np.ndarray, polygons: Polygons, unit_m: float, up: str) -> None:
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
    file.write_text("\n".join([*lines, *("f " + " ".join(str(k + 1) for k in polygon) for polygon in polygons)]))


def write_ply(file: Path, vertices: np.ndarray, polygons: Polygons, unit_m: float, up: str) -> None:
    """With polygons in text, with triangles in binary."""
    if "binary" in file.name:
        triangles(vertices, polygons).export(file, encoding="binary")
        return
    header = ["ply", "format ascii 1.0", f"element vertex {len(vertices)}", *(f"property double {a}" for a in "xyz")]
    header += [f"element face {len(polygons)}", "property list uchar int vertex_indices", "end_header"]
    lines = [f"{x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
    faces = [" ".join(map(str, (len(polygon), *polygon))) for polygon in polygons]
    file.write_text("\n".join([*header, *lines, *faces]) + "\n")


def write_triangles(file: Path, vertices: np.ndarray, polygons: Polygons, unit_m: float, up: str) -> None:
    triangles(vertices, polygons).export(file)


def write_gltf(file: Path, vertices: np.ndarray, polygons: Polygons, unit_m: float, up: str) -> None:
    """With its numbers in a file beside it, and a material whose texture is missing."""
    content = trimesh.exchange.gltf.export_gltf(trimesh.Scene(triangles(vertices, polygons)))
    for name, part in content.items():
        (file if name.endswith(".gltf") else file.parent / name).write_bytes(part)
    facts = json.loads(file.read_text())
    facts |= {"images": [{"uri": "no_such_picture.png"}], "textures": [{"source": 0}]}
    facts["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
    facts["meshes"][0]["primitives"][0]["material"] = 0
    file.write_text(json.dumps(facts))


def write_dae(file: Path, vertices: np.ndarray, polygons: Polygons, unit_m: float, up: str) -> None:
    """Moved by its node; its corners are those of a polygon list."""
    content = collada.Collada()
    content.assetInfo.unitmeter, content.assetInfo.unitname = unit_m, "unit"
    content.assetInfo.upaxis = {"y": collada.asset.UP_AXIS.Y_UP, "z": collada.asset.UP_AXIS.Z_UP}[up]
    shift = np.array([1.0, 2.0, 4.0])
    source = FloatSource("places", (vertices - shift).astype(np.float32).ravel(), ("X", "Y", "Z"))
    geometry = collada.geometry.Geometry(content, "building", "building", [source])
    inputs = InputList()
    inputs.addInput(0, "VERTEX", "#places")
    corners, sizes = np.concatenate(polygons), np.array([len(polygon) for polygon in polygons])
    geometry.primitives.append(geometry.createPolylist(corners, sizes, inputs, "material"))
    content.geometries.append(geometry)
    node = collada.scene.Node("node", children=[collada.scene.GeometryNode(geometry, [])])
    node.transforms.append(collada.scene.TranslateTransform(*shift))
    content.scenes.append(collada.scene.Scene("scene", [node]))
    content.scene = content.scenes[0]
    with file.open("wb") as stream:
        content.write(stream)


def write_usd(file: Path, vertices: np.ndarray, polygons: Polygons, unit_m: float, up: str) -> None:
    """Turned and moved by its parents; a guide and an invisible mesh are none of it."""
    stage = Usd.Stage.CreateNew(str(file))
    UsdGeom.SetStageMetersPerUnit(stage, unit_m)
    UsdGeom.SetStageUpAxis(stage, {"y": UsdGeom.Tokens.y, "z": UsdGeom.Tokens.z}[up])
    parent = UsdGeom.Xform.Define(stage, "/Building")
    parent.AddTranslateOp().Set(Gf.Vec3d(1, 2, 4))
    parent.AddRotateZOp().Set(90.0)
    local = (vertices - (1, 2, 4)) @ np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    for name in ("Storeys", "Guide", "Hidden"):
        mesh = UsdGeom.Mesh.Define(stage, f"/Building/{name}")
        mesh.CreatePointsAttr([Gf.Vec3f(*row) for row in (local if name == "Storeys" else 9 * local).tolist()])
        mesh.CreateFaceVertexCountsAttr([len(polygon) for polygon in polygons])
        mesh.CreateFaceVertexIndicesAttr([k for polygon in polygons for k in polygon])
    UsdGeom.Mesh.Get(stage, "/Building/Guide").CreatePurposeAttr("guide")
    UsdGeom.Mesh.Get(stage, "/Building/Hidden").MakeInvisible()
    stage.Save()


Writer = Callable[[Path, np.ndarray, Polygons, float, str], None]
WRITERS: dict[str, Writer] = {
    **{"room.obj": write_obj, "room.ply": write_ply, "binary.ply": write_ply},
    **{"room.stl": write_triangles, "room.glb": write_triangles, "room.gltf": write_gltf, "room.dae": write_dae},
    **{"room.usda": write_usd, "room.usdc": write_usd},
}
STATING = (".dae", ".usda", ".usdc")


@pytest.mark.parametrize("unit", ["m", "mm"])
@pytest.mark.parametrize("up", ["y", "z"])
@pytest.mark.parametrize("name", WRITERS)
def test_every_format_has_the_same_floors_walls_and_ceilings(name: str, up: str, unit: str, tmp_path: Path) -> None:
    vertices, polygons = building()
    unit_m = {"m": 1.0, "mm": 0.001}[unit]
    in_file = np.round(vertices / unit_m, 9) @ (Y_UP[:3, :3].T if up == "y" else np.eye(3))
    file = tmp_path / name
    WRITERS[name](file, in_file, polygons, unit_m, up)
    # COLLADA and USD state their unit and axis; glTF has y up.
    stated = file.suffix in STATING
    axis = None if stated or (up == "y" and file.suffix in (".glb", ".gltf")) else up
    surfaces = planes_of_mesh(read_mesh(file, None if stated else unit, axis))
    facts = []
    for surface in surfaces:
        normals = np.abs(surface.mesh.face_normals)
        assert np.ptp(normals, axis=0).max() < EQUAL
        facts.append((surface.kind, surface.mesh.area, normals[0], surface.vertices_m.min(axis=0)))
    assert [kind for kind, *_ in facts] == ["floor"] * 2 + ["ceiling"] * 2 + ["wall"] * 12
    for kind, area, normal, low in facts[:4]:
        assert area == pytest.approx(FLOOR_M2, rel=EQUAL)
        np.testing.assert_allclose(normal, [0, 0, 1], atol=EQUAL)
        heights = [levels[kind == "ceiling"] for levels in STOREYS]
        assert min(abs(low[2] - height) for height in heights) < EQUAL
    walls = facts[4:]
    assert sum(area for _, area, _, _ in walls) == pytest.approx(2 * PERIMETER_M * 2.75, rel=EQUAL)
    sides = np.linalg.norm(np.roll(OUTLINE, -1, axis=0) - OUTLINE, axis=1)
    areas = sorted(area for _, area, _, _ in walls)
    np.testing.assert_allclose(areas, np.sort(np.repeat(sides, 2)) * 2.75, rtol=EQUAL)
    for _, _, normal, low in walls:
        assert min(np.abs(normal - axis).max() for axis in np.eye(3)[:2]) < EQUAL
        assert min(abs(low[2] - height) for height, _ in STOREYS) < EQUAL


def test_options_replace_the_unit_and_axis_that_a_file_states(tmp_path: Path) -> None:
    vertices, polygons = building()
    write_usd(tmp_path / "room.usda", vertices, polygons, 0.001, "y")
    (surface,) = read_mesh(tmp_path / "room.usda", "m", "z")
    np.testing.assert_allclose(np.ptp(surface.vertices_m, axis=0), np.ptp(vertices, axis=0), atol=EQUAL)
    (part,) = mesh_parts(tmp_path / "room.usda")
    np.testing.assert_allclose(np.ptp(part.vertices, axis=0), np.ptp(vertices, axis=0)[[0, 2, 1]] / 1000, atol=EQUAL)


@pytest.mark.parametrize("name", WRITERS)
def test_files_that_are_cut_off_are_refused_in_one_line(name: str, tmp_path: Path) -> None:
    WRITERS[name](tmp_path / name, *building(), 1.0, "z")
    content = (tmp_path / name).read_bytes()
    for share in (0.1, 0.5, 0.9):
        (tmp_path / name).write_bytes(content[: int(share * len(content))])
        if name == "room.obj":
            continue  # each line stands alone, and a scene of the first is as good as any
        with pytest.raises(InputError, match=rf"{name}: ") as caught:
            make_scene(tmp_path / name, tmp_path / "scene")
        assert "\n" not in str(caught.value)
        assert not (tmp_path / "scene").exists()


def test_names_of_other_files_stay_in_the_folder_and_entities_are_refused(tmp_path: Path) -> None:
    inner = tmp_path / "inner"
    inner.mkdir()
    write_usd(tmp_path / "other.usda", *building(), 1.0, "z")
    stage = Usd.Stage.CreateNew(str(inner / "room.usda"))
    stage.OverridePrim("/Room").GetReferences().AddReference("../other.usda", "/Building")
    stage.Save()
    with pytest.raises(InputError, match="has a layer outside its folder"):
        read_mesh(inner / "room.usda")
    write_gltf(inner / "room.gltf", *building(), 1.0, "y")
    facts = json.loads((inner / "room.gltf").read_text())
    facts["buffers"][0]["uri"] = "../other.usda"
    (inner / "room.gltf").write_text(json.dumps(facts))
    with pytest.raises(InputError, match="outside its folder"):
        read_mesh(inner / "room.gltf")
    (inner / "room.dae").write_text('<!DOCTYPE a [<!ENTITY b "c">]><COLLADA>&b;</COLLADA>')
    with pytest.raises(InputError, match="has a document type or entities"):
        read_mesh(inner / "room.dae")


def test_shapes_of_usd_that_are_no_meshes_are_named(tmp_path: Path) -> None:
    """Left out, they would be missing in the scene."""
    stage = Usd.Stage.CreateNew(str(tmp_path / "room.usda"))
    UsdGeom.Cube.Define(stage, "/Column")
    stage.Save()
    with pytest.raises(InputError, match=r"/Column is a Cube; export it as a mesh"):
        read_mesh(tmp_path / "room.usda")


def test_copies_of_copies_in_usd_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten copies of ten copies; a file of a few lines could hold more than memory does."""
    monkeypatch.setattr("wrf_mi.scene.mesh.scene_files.MOST_PARTS", 99)
    stage = Usd.Stage.CreateNew(str(tmp_path / "room.usda"))
    mesh = UsdGeom.Mesh.Define(stage, "/Leaf/Mesh")
    mesh.CreatePointsAttr([(0, 0, 0), (1, 0, 0), (0, 1, 0)])
    mesh.CreateFaceVertexCountsAttr([3])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2])
    for parent, child in (("/Branch", "/Leaf"), ("/Tree", "/Branch")):
        for k in range(10):
            prim = stage.DefinePrim(f"{parent}/copy_{k}")
            prim.GetReferences().AddInternalReference(child)
            prim.SetInstanceable(True)
    stage.Save()
    with pytest.raises(InputError, match="has more than 99 parts with its copies written out"):
        read_mesh(tmp_path / "room.usda")
