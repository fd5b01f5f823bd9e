"""Floor, ceiling and walls of meshes that others made, and one building of two storeys in every format of meshes."""

import json
from pathlib import Path

import collada
import numpy as np
import pytest
import shapely
import trimesh
from calling import call
from collada.source import FloatSource, InputList
from made_rooms import Mesh, attic, by_kind, joined, l_shape
from pxr import Gf, Usd, UsdGeom

from wrf_mi.core import InputError
from wrf_mi.scene.coordinates import Y_UP
from wrf_mi.scene.make import make_scene
from wrf_mi.scene.mesh import outline
from wrf_mi.scene.mesh.facets import planes_of_mesh
from wrf_mi.scene.mesh.files import mesh_parts, read_mesh
from wrf_mi.scene.mesh.planes import Plane, with_axes
from wrf_mi.scene.mesh.surfaces import Surface


def solid(low: tuple[float, ...], high: tuple[float, ...], inward: bool = False) -> Mesh:
    mesh = trimesh.creation.box(bounds=[low, high])
    if inward:
        mesh.invert()
    return mesh


def split(*parts: Mesh) -> tuple[dict[str, int], list[Surface]]:
    """How many surfaces of each kind, and the surfaces; no triangle is lost or added."""
    mesh = joined(parts)
    surfaces = planes_of_mesh([Surface("mesh", "other", np.asarray(mesh.vertices), np.asarray(mesh.faces))])
    before = sorted(mesh.triangles.reshape(len(mesh.faces), 9).tolist())
    after = np.concatenate([surface.vertices_m[surface.faces] for surface in surfaces])
    assert sorted(after.reshape(len(after), 9).tolist()) == before
    return {kind: len(members) for kind, members in by_kind(surfaces).items()}, surfaces


ROOM = (0.0, 0.0, 0.0), (5.0, 4.0, 2.5)
EMPTY = {"floor": 1, "ceiling": 1, "wall": 4, "other": 0}
FURNISHED = EMPTY | {"other": 1}


@pytest.mark.parametrize("ending", ["ply", "stl", "obj", "glb"])
@pytest.mark.parametrize("inward", [False, True])
def test_a_closed_box_from_a_file_is_a_room(ending, inward, tmp_path, capsys):
    solid(*ROOM, inward).export(tmp_path / f"box.{ending}")
    status, out, err = call(["mesh", tmp_path / f"box.{ending}", "--out", tmp_path / "scene"], capsys)
    assert status == 0, err
    assert out.startswith("1 floor, 1 ceiling, 4 wall, 0 other")


@pytest.mark.parametrize("inward", [(False, False), (False, True), (True, False), (True, True)])
@pytest.mark.parametrize(
    ("low", "high"),
    [((1, 1, 0), (2, 1.6, 1)), ((0, 0, 0), (1, 0.6, 2)), ((1, 1, 0), (4, 3, 2.2))],
    ids=["cupboard", "wardrobe in a corner", "block as large as a room"],
)
def test_a_closed_solid_in_a_room_is_furniture(low, high, inward):
    counts, surfaces = split(solid(*ROOM, inward[0]), solid(low, high, inward[1]))
    assert counts == FURNISHED
    assert surfaces[-1].mesh.area == pytest.approx(solid(low, high).area)


def test_solid_slabs_are_walls_and_solid_buildings_have_floors_of_both_faces():
    slabs = [
        solid((0, 0, -0.2), (5, 4, -0.01)),
        solid((0, 0, 2.51), (5, 4, 2.7)),
        *(solid((0.11, y, 0), (4.89, y + 0.1, 2.5)) for y in (0.0, 3.9)),
        *(solid((x, 0, 0), (x + 0.1, 4, 2.5)) for x in (0.0, 4.9)),
    ]
    counts, _ = split(*slabs, solid((0.2, 0.2, 0), (1, 0.8, 2.1)))
    assert counts == FURNISHED
    rooms = [solid((0.2, 0.2, 0.2), (4.2, 4.2, 2.8), True), solid((4.4, 0.2, 0.2), (8.8, 4.2, 2.8), True)]
    counts, surfaces = split(solid((0, 0, 0), (9, 4.4, 3)), *rooms)
    assert counts == {"floor": 3, "ceiling": 3, "wall": 12, "other": 0}
    heights = {kind: {round(float(s.vertices_m[:, 2].mean()), 6) for s in of} for kind, of in by_kind(surfaces).items()}
    assert heights["floor"] == {0.0, 0.2}
    assert heights["ceiling"] == {2.8, 3.0}


def test_rooms_storeys_and_slopes_and_what_is_no_building(tmp_path):
    storeys = solid(*ROOM), solid((0, 0, 2.7), (5, 4, 5.2))
    assert split(*storeys)[0] == {"floor": 2, "ceiling": 2, "wall": 8, "other": 0}
    assert split(*l_shape())[0] == EMPTY | {"wall": 6}
    assert split(*attic())[0] == EMPTY
    assert split(solid(*ROOM), solid((2, 2, 0), (2.4, 2.4, 2.5)))[0]["wall"] == 8  # a column
    mesh = solid(*ROOM).subdivide().subdivide()
    mesh.apply_transform(trimesh.transformations.rotation_matrix(0.5, (0, 0, 1)))
    mesh.apply_translation((3000.0, -2000.0, 120.0))
    assert split(mesh)[0] == EMPTY
    ball = trimesh.creation.icosphere(3, 1.0)
    ball.export(tmp_path / "ball.stl")
    (ball_mesh,) = read_mesh(tmp_path / "ball.stl")
    assert planes_of_mesh([ball_mesh]) == [ball_mesh]
    solid((0, 0, 0), (1, 0.6, 1)).export(tmp_path / "cupboard.ply")
    new_scene = make_scene(tmp_path / "cupboard.ply", tmp_path / "scene")  # drawn without a free edge
    assert new_scene.materials.surfaces == {"mesh": "other"}
    assert (new_scene.folder / "preview.png").stat().st_size > 1000


def test_pairs_out_of_reach_change_nothing(monkeypatch):
    rng = np.random.default_rng(0)
    planes, areas = [], []
    for number in range(24):
        normal = np.eye(3)[number % 3]
        offset = float(rng.choice([0.0, 3.0]) + rng.normal(0, 0.02))
        plane = Plane(normal, offset, np.zeros((0, 4, 3)), normal * offset, 1e-3)
        planes.append(with_axes(plane))
        low = rng.uniform(-3.2, 2, 2)
        areas.append(shapely.box(*low, *(low + rng.uniform(0.3, 3, 2))))
    reach = [0.15] * len(planes)
    skipped = outline.join(planes, areas, reach)
    monkeypatch.setattr(outline, "_beside", lambda *arguments: False)
    assert [polygon.wkb for polygon in skipped] == [polygon.wkb for polygon in outline.join(planes, areas, reach)]
    assert any(polygon.wkb != area.wkb for polygon, area in zip(skipped, areas, strict=True))


EQUAL = 1e-6
"""Of areas, normals and offsets: coordinates are multiples of a quarter metre, which single precision holds."""
OUTLINE = ((0, 0), (6, 0), (6, 2.5), (3, 2.5), (3, 5), (0, 5))
STOREYS = ((0.0, 2.75), (3.0, 5.75))
FLOOR_M2, PERIMETER_M = 22.5, 22.0

Polygons = list[tuple[int, ...]]


def building() -> tuple[np.ndarray, Polygons]:
    """Vertices, metres, and polygons: an L-shaped floor and ceiling and six walls in each storey."""
    vertices, polygons, count = list[tuple[float, ...]](), Polygons(), len(OUTLINE)
    for low, high in STOREYS:
        floor = tuple(len(vertices) + k for k in range(count))
        vertices += [(x, y, z) for z in (low, high) for x, y in OUTLINE]
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


def write_obj(file, vertices, polygons, unit_m, up):
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
    file.write_text("\n".join([*lines, *("f " + " ".join(str(k + 1) for k in polygon) for polygon in polygons)]))


def write_ply(file, vertices, polygons, unit_m, up):
    """With polygons in text, with triangles in binary."""
    if "binary" in file.name:
        triangles(vertices, polygons).export(file, encoding="binary")
        return
    header = ["ply", "format ascii 1.0", f"element vertex {len(vertices)}", *(f"property double {a}" for a in "xyz")]
    header += [f"element face {len(polygons)}", "property list uchar int vertex_indices", "end_header"]
    rows = [*vertices.tolist(), *((len(polygon), *polygon) for polygon in polygons)]
    file.write_text("\n".join([*header, *(" ".join(map(repr, row)) for row in rows)]) + "\n")


def write_gltf(file, vertices, polygons, unit_m, up):
    """With its numbers in a file beside it, and a material whose texture is missing."""
    content = trimesh.exchange.gltf.export_gltf(trimesh.Scene(triangles(vertices, polygons)))
    for name, part in content.items():
        (file if name.endswith(".gltf") else file.parent / name).write_bytes(part)
    facts = json.loads(file.read_text())
    facts |= {"images": [{"uri": "no_such_picture.png"}], "textures": [{"source": 0}]}
    facts["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
    facts["meshes"][0]["primitives"][0]["material"] = 0
    file.write_text(json.dumps(facts))


def write_dae(file, vertices, polygons, unit_m, up):
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


WRITERS = {
    **{"room.obj": write_obj, "room.ply": write_ply, "binary.ply": write_ply},
    **dict.fromkeys(("room.stl", "room.glb"), lambda file, *parts: triangles(*parts[:2]).export(file)),
    **{"room.gltf": write_gltf, "room.dae": write_dae, "room.usda": write_usd, "room.usdc": write_usd},
}
"""Functions of a file, vertices, polygons, the unit in metres and the axis that is up, the last two where stated."""


@pytest.mark.parametrize("unit", ["m", "mm"])
@pytest.mark.parametrize("up", ["y", "z"])
@pytest.mark.parametrize("name", WRITERS)
def test_every_format_has_the_same_floors_walls_and_ceilings(name, up, unit, tmp_path):
    vertices, polygons = building()
    unit_m = {"m": 1.0, "mm": 0.001}[unit]
    in_file = np.round(vertices / unit_m, 9) @ (Y_UP[:3, :3].T if up == "y" else np.eye(3))
    file = tmp_path / name
    WRITERS[name](file, in_file, polygons, unit_m, up)
    # COLLADA and USD state their unit and axis; glTF has y up.
    states_axes = file.suffix in (".dae", ".usda", ".usdc")
    axis = None if states_axes or (up == "y" and file.suffix in (".glb", ".gltf")) else up
    surfaces = planes_of_mesh(read_mesh(file, None if states_axes else unit, axis))
    assert [s.kind for s in surfaces] == ["floor"] * 2 + ["ceiling"] * 2 + ["wall"] * 12
    levels = {"floor": [low for low, _ in STOREYS], "ceiling": [high for _, high in STOREYS]}
    levels["wall"] = levels["floor"]
    for surface in surfaces:
        normals = np.abs(surface.mesh.face_normals)
        assert np.ptp(normals, axis=0).max() < EQUAL
        axes = np.eye(3)[:2] if surface.kind == "wall" else np.eye(3)[2:]
        assert np.abs(normals[0] - axes).max(axis=1).min() < EQUAL
        assert np.abs(surface.vertices_m[:, 2].min() - levels[surface.kind]).min() < EQUAL
    areas = [surface.mesh.area for surface in surfaces]
    assert areas[:4] == pytest.approx([FLOOR_M2] * 4, rel=EQUAL)
    assert sum(areas[4:]) == pytest.approx(2 * PERIMETER_M * 2.75, rel=EQUAL)
    sides = np.linalg.norm(np.roll(OUTLINE, -1, axis=0) - OUTLINE, axis=1)
    np.testing.assert_allclose(sorted(areas[4:]), np.sort(np.repeat(sides, 2)) * 2.75, rtol=EQUAL)


def test_options_replace_the_unit_and_axis_that_a_file_states(tmp_path):
    vertices, polygons = building()
    write_usd(tmp_path / "room.usda", vertices, polygons, 0.001, "y")
    (surface,) = read_mesh(tmp_path / "room.usda", "m", "z")
    (part,) = mesh_parts(tmp_path / "room.usda")
    size = np.ptp(vertices, axis=0)
    np.testing.assert_allclose(np.ptp(surface.vertices_m, axis=0), size, atol=EQUAL)
    np.testing.assert_allclose(np.ptp(part.vertices, axis=0), size[[0, 2, 1]] / 1000, atol=EQUAL)


@pytest.mark.parametrize("name", [name for name in WRITERS if name != "room.obj"])
def test_files_that_are_cut_off_are_refused_in_one_line(name, tmp_path):
    """But OBJ, each line of which stands alone, so that a scene of the first is as good as any."""
    WRITERS[name](tmp_path / name, *building(), 1.0, "z")
    content = (tmp_path / name).read_bytes()
    for share in (0.1, 0.5, 0.9):
        (tmp_path / name).write_bytes(content[: int(share * len(content))])
        with pytest.raises(InputError, match=rf"{name}: ") as caught:
            make_scene(tmp_path / name, tmp_path / "scene")
        assert "\n" not in str(caught.value)
        assert not (tmp_path / "scene").exists()


def test_other_folders_entities_and_shapes_that_are_no_meshes_are_refused(tmp_path):
    """Shapes that were left out would be missing in the scene."""
    inner = tmp_path / "inner"
    inner.mkdir()
    write_usd(tmp_path / "other.usda", *building(), 1.0, "z")
    stage = Usd.Stage.CreateNew(str(inner / "room.usda"))
    stage.OverridePrim("/Room").GetReferences().AddReference("../other.usda", "/Building")
    stage.Save()
    stage = Usd.Stage.CreateNew(str(inner / "cube.usda"))
    UsdGeom.Cube.Define(stage, "/Column")
    stage.Save()
    write_gltf(inner / "room.gltf", *building(), 1.0, "y")
    facts = json.loads((inner / "room.gltf").read_text())
    facts["buffers"][0]["uri"] = "../other.usda"
    (inner / "room.gltf").write_text(json.dumps(facts))
    (inner / "room.dae").write_text('<!DOCTYPE a [<!ENTITY b "c">]><COLLADA>&b;</COLLADA>')
    for name, message in (
        ("room.usda", "has a layer outside its folder"),
        ("room.gltf", "outside its folder"),
        ("room.dae", "has a document type or entities"),
        ("cube.usda", "/Column is a Cube; export it as a mesh"),
    ):
        with pytest.raises(InputError, match=message):
            read_mesh(inner / name)


def test_copies_of_copies_in_usd_are_refused(tmp_path, monkeypatch):
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
