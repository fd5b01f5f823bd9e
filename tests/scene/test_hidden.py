"""Faces of boxes that a scan could not see, from those that it saw."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from wrf_mi_scenes.build_laboratory import sheet

from wrf_mi.scene.edit import read_surfaces
from wrf_mi.scene.folder import write_scene
from wrf_mi.scene.hidden import boxes, with_hidden_faces
from wrf_mi.scene.mesh.surfaces import Surface

EXACT_M = 1e-6
"""Corners of faces of exact boxes, metres, rounding apart."""


def box_faces(size: tuple[float, float, float], turn: float, base: tuple[float, float, float]) -> list[np.ndarray]:
    """Corners [4, 3] of the four sides of an upright box, then of its top."""
    (a, b, h), turned = size, np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    plan = np.array([[0, 0], [a, 0], [a, b], [0, b]]) @ turned
    low, high = (np.column_stack([plan, np.full(4, z)]) + base for z in (0.0, h))
    sides = [np.stack([low[k], low[(k + 1) % 4], high[(k + 1) % 4], high[k]]) for k in range(4)]
    return [*sides, high]


def surface(name: str, corners: np.ndarray, kind: str = "other") -> Surface:
    return Surface(name, kind, corners, np.array([[0, 1, 2], [0, 2, 3]]))  # type: ignore[arg-type]


def apart(one: np.ndarray, other: np.ndarray) -> float:
    """Largest distance of a corner of a face from the nearest one of another."""
    return float(np.linalg.norm(one[:, None] - other[None], axis=2).min(axis=1).max())


@settings(max_examples=60, deadline=None)
@example(size=(2.3290283453060274, 1.9, 1.0), turn=2.2887217938748314, base=(-0.5625, 0.0, 0.0), seen=(0, 4))
@given(
    size=st.tuples(*[st.floats(0.3, 2.5)] * 3),
    turn=st.floats(-3, 3),
    base=st.tuples(*[st.floats(-5, 5)] * 3),
    seen=st.sampled_from(list(combinations(range(5), 2))),
)
def test_two_faces_complete_a_box(
    size: tuple[float, float, float], turn: float, base: tuple[float, float, float], seen: tuple[int, int]
) -> None:
    """Of any size and direction; each missing face is found once."""
    faces = box_faces(size, turn, base)
    found = boxes([surface(f"other_{k}", faces[k]) for k in seen]).hidden
    missing = [face for k, face in enumerate(faces) if k not in seen]
    assert len(found) == len(missing)
    for face in missing:
        assert min(apart(face, one.vertices_m) for one in found) < EXACT_M * max(1, *map(abs, base))


def test_edges_may_be_seen_to_a_few_centimetres() -> None:
    faces = box_faces((0.8, 0.5, 1.2), 0.3, (1, 2, 0))
    middle = faces[0].mean(axis=0)
    found = boxes([surface("other_01", middle + 0.94 * (faces[0] - middle)), surface("other_02", faces[1])]).hidden
    assert len(found) == 3
    for face in (faces[2], faces[3]):
        assert min(apart(face, one.vertices_m) for one in found) < 0.08


def test_nothing_is_supposed_where_surfaces_lie_or_of_single_faces() -> None:
    """A cabinet at a wall has no back of its own, a board no depth, and boards that do not meet make no box."""
    faces = box_faces((0.8, 0.5, 1.2), 0.0, (0, 0.05, 0))
    seen = [surface("other_01", faces[3]), surface("other_02", faces[4])]
    wall = surface("wall_01", np.array([[-3, 0, 0], [3, 0, 0], [3, 0, 3], [-3, 0, 3.0]]), "wall")
    found = boxes([*seen, wall]).hidden
    assert len(found) == 2
    assert min(apart(faces[0], one.vertices_m) for one in found) > 0.1
    assert not boxes([seen[0]]).hidden
    assert not boxes([seen[0], surface("other_02", faces[0] + [0, 2.0, 0])]).hidden
    assert not boxes([surface("other_01", faces[0] * 5), surface("other_02", faces[1] * 5)]).hidden  # no furniture


def test_names_are_new() -> None:
    faces = box_faces((0.8, 0.5, 1.2), 0.0, (0, 0, 0))
    seen = [surface("hidden_01", faces[0]), surface("other_01", faces[1])]
    assert [one.name for one in boxes(seen).hidden] == ["hidden_02", "hidden_03", "hidden_04"]


def test_a_scene_folder_has_them_for_as_long_as_asked(tmp_path: Path) -> None:
    faces = box_faces((0.8, 0.5, 1.2), 0.0, (1, 1, 0))
    floor = sheet(2, 0.0, (0, 4), (0, 3))
    parts = [
        Surface("floor", "floor", np.asarray(floor.vertices), np.asarray(floor.faces)),
        *(surface(f"other_{k}", faces[k]) for k in (0, 1)),
    ]
    plain = write_scene(tmp_path / "plain", parts[:1], frame="f", source="s")
    folder = write_scene(tmp_path / "scene", parts, frame="f", source="s")
    with with_hidden_faces(folder) as (scene, found):
        names = [face.name for face in found.hidden]
        assert names == ["hidden_01", "hidden_02", "hidden_03"]
        assert found.members == [{"other_0", "other_1", *names}]
        surfaces, materials = read_surfaces(scene)
        assert [one.name for one in surfaces][3:] == names
        assert materials.of("hidden_01", "other") == materials.of("other_0", "other")
    assert not Path(scene).exists()
    for other in (plain, "box", tmp_path / "scene" / "meshes" / "floor.ply"):
        with with_hidden_faces(other) as (scene, found):
            assert scene == other
            assert not found.hidden


@pytest.mark.parametrize("corners", [np.zeros((4, 3)), np.array([[0, 0, 0], [1, 0, 0], [1, 1, 1], [0, 1, 0.0]])])
def test_what_is_not_flat_upright_or_level_makes_no_box(corners: np.ndarray) -> None:
    faces = box_faces((0.8, 0.5, 1.2), 0.0, (0, 0, 0))
    assert not boxes([surface("other_01", corners), surface("other_02", faces[0])]).hidden
