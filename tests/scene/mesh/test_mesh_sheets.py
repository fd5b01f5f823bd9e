"""Panels and doubled faces as single sheets, and rooms whose unit is asked for."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from made_rooms import by_kind

from wrf_mi.core import InputError
from wrf_mi.scene.mesh.facets import planes_of_mesh
from wrf_mi.scene.mesh.files import read_mesh

SIZE_M = (4.0, 3.0, 2.5)
BOX_M2 = 2 * (4 * 3 + 4 * 2.5 + 3 * 2.5)
DIAGONALS = ([[0, 1, 2], [0, 2, 3]], [[0, 1, 3], [1, 2, 3]])
ROUNDING = 1e-5
TURN = trimesh.transformations.rotation_matrix(0.4, (0.3, 0.2, 1.0))


def quads(box: trimesh.Trimesh) -> np.ndarray:
    """Corners [6, 4, 3] of the sides of a box, counter-clockwise from outside."""
    sides = []
    for axis in range(3):
        for sign in (-1, 1):
            normal = sign * np.eye(3)[axis]
            u = np.roll(np.eye(3), 1, axis=0)[axis]
            v = np.cross(normal, u)
            half = box.extents / 2
            sides.append([half * (normal + a * u + b * v) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
    return np.array(sides) + box.bounds.mean(axis=0)


def two_faced(corners: np.ndarray, second_diagonal: bool) -> trimesh.Trimesh:
    """Each side twice with vertices of its own, the second copy turned over, perhaps cut along the other diagonal."""
    vertices, faces = list[np.ndarray](), list[np.ndarray]()
    for side in corners:
        for copy, diagonal in enumerate((DIAGONALS[0], DIAGONALS[second_diagonal])):
            triangles = np.array(diagonal) + 4 * len(vertices)
            vertices.append(side)
            faces.append(triangles[:, ::-1] if copy else triangles)
    return trimesh.Trimesh(np.concatenate(vertices), np.concatenate(faces), process=False)


def area_m2(file: Path, **options: Any) -> float:
    return float(sum(surface.mesh.area for surface in read_mesh(file, **options)))


@pytest.mark.parametrize("second_diagonal", [False, True])
@pytest.mark.parametrize("turned", [False, True])
def test_faces_drawn_on_both_sides_count_once(second_diagonal, turned, tmp_path):
    mesh = two_faced(quads(trimesh.creation.box(SIZE_M)), second_diagonal)
    if turned:
        mesh.apply_transform(TURN)
    mesh.export(tmp_path / "room.obj")
    assert area_m2(tmp_path / "room.obj") == pytest.approx(BOX_M2, rel=ROUNDING)


def panel(size_m, middle_m):
    return trimesh.creation.box(size_m, trimesh.transformations.translation_matrix(middle_m))


PANELS = [
    *(panel((0.001, 3, 2.5), (x, 1.5, 1.25)) for x in (0, 4)),
    *(panel((4, 0.001, 2.5), (2, y, 1.25)) for y in (0, 3)),
    panel((4, 3, 0.001), (2, 1.5, 0)),
]


def test_panels_of_a_millimetre_are_sheets_in_their_middle(tmp_path):
    trimesh.util.concatenate(PANELS).export(tmp_path / "room.obj")
    surfaces = by_kind(planes_of_mesh(read_mesh(tmp_path / "room.obj")))
    assert [len(surfaces[kind]) for kind in ("floor", "wall", "other")] == [1, 4, 0]
    assert sum(wall.mesh.area for wall in surfaces["wall"]) == pytest.approx(2 * (4 + 3) * 2.5, rel=ROUNDING)
    (floor,) = surfaces["floor"]
    np.testing.assert_allclose(floor.vertices_m[:, 2], 0, atol=ROUNDING)


def test_walls_with_a_thickness_keep_both_faces(tmp_path):
    panel((0.1, 3, 2.5), (0, 1.5, 1.25)).export(tmp_path / "wall.obj")
    assert area_m2(tmp_path / "wall.obj") == pytest.approx(2 * (3 * 2.5 + 0.1 * 3 + 0.1 * 2.5), rel=ROUNDING)


def test_coplanar_faces_side_by_side_are_no_copies(tmp_path):
    """Two boxes that stand on one level, one upside down: their coplanar faces look both ways and do not overlap."""
    boxes = [panel((1, 1, 1), (0, 0, 0.5)), panel((1, 1, 1), (3, 0, -0.5))]
    trimesh.util.concatenate(boxes).export(tmp_path / "boxes.obj")
    assert area_m2(tmp_path / "boxes.obj") == pytest.approx(12, rel=ROUNDING)


@pytest.mark.parametrize(("unit_m", "height"), [(0.0254, "in \\(2.5 m\\)"), (0.1, "dm \\(2.5 m\\)")])
def test_the_unit_of_a_room_of_many_metres_is_asked_for(unit_m, height, tmp_path):
    trimesh.creation.box(np.array(SIZE_M) / unit_m).export(tmp_path / "room.obj")
    with pytest.raises(InputError, match=rf"room\.obj: a room .* units high; give --units: .*{height}"):
        read_mesh(tmp_path / "room.obj")
    unit = {0.0254: "in", 0.1: "dm"}[unit_m]
    assert area_m2(tmp_path / "room.obj", units=unit) == pytest.approx(BOX_M2, rel=ROUNDING)


def test_houses_of_several_floors_are_not_asked_for_their_unit(tmp_path):
    floors = [panel((20, 30, 0.2), (0, 0, 3 * storey)) for storey in range(9)]
    trimesh.util.concatenate(floors).export(tmp_path / "house.stl")
    assert read_mesh(tmp_path / "house.stl")


@pytest.mark.parametrize("name", ["a.dwg", "a.fbx", "a.dxf", "a.skp", "a.step", "a.rcp", "a.b3dm"])
def test_formats_that_are_not_read_are_refused_with_their_conversion(name, tmp_path):
    (tmp_path / name).write_bytes(b"\0content")
    with pytest.raises(InputError, match=rf"{name}: \.\w+ is not read; .*(convert|export|make)"):
        read_mesh(tmp_path / name)


def test_furniture_on_a_floor_stays_closed(tmp_path):
    """The lower side of a cupboard lies on the floor and looks the other way."""
    room = trimesh.creation.box(bounds=[[0.0, 0, 0], [4, 3, 2.5]])
    room.invert()
    trimesh.util.concatenate([room, panel((1, 0.5, 2), (2, 1, 1))]).export(tmp_path / "room.obj")
    surfaces = by_kind(planes_of_mesh(read_mesh(tmp_path / "room.obj")))
    assert [len(surfaces[kind]) for kind in ("floor", "ceiling", "wall", "other")] == [1, 1, 4, 1]
    assert surfaces["other"][0].mesh.is_watertight
