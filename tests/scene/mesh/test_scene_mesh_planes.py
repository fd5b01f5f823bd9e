"""Floor, ceiling and walls of meshes that others made."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from calling import call
from made_rooms import Mesh, attic, by_kind, l_shape

from wrf_mi.scene.make import make_scene
from wrf_mi.scene.mesh.facets import planes_of_mesh
from wrf_mi.scene.mesh.files import read_mesh
from wrf_mi.scene.mesh.surfaces import Surface


def solid(low: tuple[float, ...], high: tuple[float, ...], inward: bool = False) -> Mesh:
    mesh = trimesh.creation.box(bounds=[low, high])
    if inward:
        mesh.invert()
    return mesh


def split(*parts: Mesh) -> tuple[dict[str, int], list[Surface]]:
    """How many surfaces of each kind, and the surfaces; no triangle is lost or added."""
    mesh = trimesh.util.concatenate(list(parts))
    surfaces = planes_of_mesh([Surface("mesh", "other", np.asarray(mesh.vertices), np.asarray(mesh.faces))])
    before = sorted(mesh.triangles.reshape(len(mesh.faces), 9).tolist())
    after = np.concatenate([surface.vertices_m[surface.faces] for surface in surfaces])
    assert sorted(after.reshape(len(after), 9).tolist()) == before
    return {kind: len(found) for kind, found in by_kind(surfaces).items()}, surfaces


ROOM = (0.0, 0.0, 0.0), (5.0, 4.0, 2.5)
EMPTY = {"floor": 1, "ceiling": 1, "wall": 4, "other": 0}
FURNISHED = EMPTY | {"other": 1}


@pytest.mark.parametrize("ending", ["ply", "stl", "obj", "glb"])
@pytest.mark.parametrize("inward", [False, True])
def test_a_closed_box_from_a_file_is_a_room(
    ending: str, inward: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    solid(*ROOM, inward).export(tmp_path / f"box.{ending}")
    status, out, err = call(["mesh", tmp_path / f"box.{ending}", "--out", tmp_path / "scene"], capsys)
    assert status == 0, err
    assert out.startswith("1 floor, 1 ceiling, 4 wall, 0 other")


def test_a_closed_mesh_of_one_body_is_drawn(tmp_path: Path) -> None:
    """It has no free edge, so no rim."""
    solid((0, 0, 0), (1, 0.6, 1)).export(tmp_path / "cupboard.ply")
    made = make_scene(tmp_path / "cupboard.ply", tmp_path / "scene")
    assert made.materials.surfaces == {"mesh": "other"}
    assert (made.folder / "preview.png").stat().st_size > 1000


@pytest.mark.parametrize("inward", [(False, False), (False, True), (True, False), (True, True)])
@pytest.mark.parametrize(
    ("low", "high"),
    [((1, 1, 0), (2, 1.6, 1)), ((0, 0, 0), (1, 0.6, 2)), ((1, 1, 0), (4, 3, 2.2))],
    ids=["cupboard", "wardrobe in a corner", "block as large as a room"],
)
def test_a_closed_solid_in_a_room_is_furniture(
    low: tuple[float, ...], high: tuple[float, ...], inward: tuple[bool, bool]
) -> None:
    counts, surfaces = split(solid(*ROOM, inward[0]), solid(low, high, inward[1]))
    assert counts == FURNISHED
    assert surfaces[-1].mesh.area == pytest.approx(solid(low, high).area)


def test_walls_that_are_solid_slabs_are_walls_and_what_stands_between_them_is_not() -> None:
    slabs = [
        solid((0, 0, -0.2), (5, 4, -0.01)),
        solid((0, 0, 2.51), (5, 4, 2.7)),
        *(solid((0.11, y, 0), (4.89, y + 0.1, 2.5)) for y in (0.0, 3.9)),
        *(solid((x, 0, 0), (x + 0.1, 4, 2.5)) for x in (0.0, 4.9)),
    ]
    counts, _ = split(*slabs, solid((0.2, 0.2, 0), (1, 0.8, 2.1)))
    assert counts == FURNISHED


def test_rooms_in_a_solid_building_have_floors_and_ceilings_of_both_faces() -> None:
    rooms = [solid((0.2, 0.2, 0.2), (4.2, 4.2, 2.8), True), solid((4.4, 0.2, 0.2), (8.8, 4.2, 2.8), True)]
    counts, surfaces = split(solid((0, 0, 0), (9, 4.4, 3)), *rooms)
    assert counts == {"floor": 3, "ceiling": 3, "wall": 12, "other": 0}
    heights = {kind: {round(float(s.vertices_m[:, 2].mean()), 6) for s in of} for kind, of in by_kind(surfaces).items()}
    assert heights["floor"] == {0.0, 0.2}
    assert heights["ceiling"] == {2.8, 3.0}


def test_storeys_open_rooms_and_slopes() -> None:
    storeys = solid(*ROOM), solid((0, 0, 2.7), (5, 4, 5.2))
    assert split(*storeys)[0] == {"floor": 2, "ceiling": 2, "wall": 8, "other": 0}
    assert split(*l_shape())[0] == EMPTY | {"wall": 6}
    assert split(*attic())[0] == EMPTY
    assert split(solid(*ROOM), solid((2, 2, 0), (2.4, 2.4, 2.5)))[0]["wall"] == 8  # a column


def test_a_turned_fine_mesh_far_from_the_origin_gives_the_same_room() -> None:
    mesh = solid(*ROOM).subdivide().subdivide()
    mesh.apply_transform(trimesh.transformations.rotation_matrix(0.5, (0, 0, 1)))
    mesh.apply_translation((3000.0, -2000.0, 120.0))
    assert split(mesh)[0] == EMPTY


def test_meshes_without_a_building_stay_unchanged(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(3, 1.0)
    ball.export(tmp_path / "ball.stl")
    (given,) = read_mesh(tmp_path / "ball.stl")
    assert planes_of_mesh([given]) == [given]
