"""Edited scenes: geometry, materials and channels; faces of boxes that a scan could not see."""

from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from calling import call, refused
from hypothesis import example, given, settings
from hypothesis import strategies as st
from wrf_mi_scenes.build_laboratory import sheet
from wrf_mi_scenes.random_rooms import random_room

from wrf_mi.core import InputError, Receiver
from wrf_mi.core.angles import FloatArray
from wrf_mi.core.antenna import UPRIGHT
from wrf_mi.receivers.instruments import Instrument
from wrf_mi.scene.edit import Move, box_of, edit_scene, parts_within, read_surfaces
from wrf_mi.scene.folder import read_scene_folder, write_scene
from wrf_mi.scene.hidden import boxes, with_hidden_faces
from wrf_mi.scene.materials import Materials
from wrf_mi.scene.mesh.surfaces import Kind, Surface
from wrf_mi.tracing import TraceOptions
from wrf_mi.tracing.tracer import RayTracer

SINGLE_M = 1e-5
"""Coordinates of meshes are single precision: 1e-6 of ten metres, with room to spare."""
SAME_CHANNEL = 1e-3
"""Relative difference of channels in the same room from meshes that differ by `SINGLE_M`: k times it, some paths."""
CABINET, SHIFT_M, TURN_DEG = "piece_05", (0.0, 0.8, 0.0), 20.0
PANEL = {"relative_permittivity": 2.9, "conductivity": 0.01, "thickness": 0.08}


def room_folder(folder: Path, moved: trimesh.Trimesh | None = None) -> Path:
    """Scene folder of a random room, one of its cabinets elsewhere if a mesh is given."""
    parts = {name: mesh for name, (_, mesh) in random_room(103).parts.items()}
    if moved is not None:
        parts[CABINET] = moved
    surfaces = [Surface(name, "other", np.asarray(m.vertices), np.asarray(m.faces)) for name, m in parts.items()]
    materials = Materials(surfaces={CABINET: "panel"}, constants={"panel": PANEL})
    return write_scene(folder, surfaces, frame="the room's", source="random room 103", materials=materials)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return room_folder(tmp_path_factory.mktemp("room") / "scene")


def turned(points_m: FloatArray, middle_m: FloatArray) -> FloatArray:
    """The motion of the tests, written out."""
    c, s = np.cos(np.radians(TURN_DEG)), np.sin(np.radians(TURN_DEG))
    x, y, z = (points_m - middle_m).T
    return np.stack([c * x - s * y, s * x + c * y, z], axis=-1) + middle_m + SHIFT_M


def test_moved_part_gives_the_channels_of_the_room_measured_anew(scene, tmp_path):
    """Tracing the edited scene equals tracing a room that was built with the cabinet at its new place."""
    mesh = random_room(103).parts[CABINET][1]
    moved = mesh.copy()
    moved.vertices = turned(np.asarray(mesh.vertices), mesh.bounds.mean(axis=0))
    true = room_folder(tmp_path / "true", moved)
    edited = edit_scene(scene, tmp_path / "edited", [Move((CABINET,), SHIFT_M, TURN_DEG)])
    receiver = Receiver("station", np.array(random_room(103).station_m), np.array(UPRIGHT))
    instrument = Instrument("csi", (receiver,), np.array([2.44e9]))
    options = TraceOptions(transmission=True, depth=2, rays=1 << 14)
    positions = np.array([[1.1, 0.5, 0.9], [2.9, 3.0, 1.1], [5.0, 1.5, 0.7], [0.4, 1.8, 1.3]])
    before, after, new = (RayTracer(folder, instrument, options)(positions) for folder in (scene, edited, true))
    scale = np.abs(new).max()
    assert np.abs(after - new).max() < SAME_CHANNEL * scale
    assert np.abs(before - new).max() > 10 * SAME_CHANNEL * scale


def test_other_parts_and_all_materials_stay(scene, tmp_path):
    edited = edit_scene(scene, tmp_path / "edited", [Move((CABINET,), SHIFT_M)], remove=("piece_1*",))
    before, after = ({part.name: part for part in read_surfaces(folder)[0]} for folder in (scene, edited))
    assert set(before) - set(after) == {name for name in before if name.startswith("piece_1")}
    for name, surface in after.items():
        shift = np.array(SHIFT_M) if name == CABINET else 0.0
        np.testing.assert_allclose(surface.vertices_m, before[name].vertices_m + shift, atol=SINGLE_M)
        np.testing.assert_array_equal(surface.faces, before[name].faces)
    old, new = (read_scene_folder(folder).materials for folder in (scene, edited))
    assert new.constants == old.constants
    assert all(new.of(name, "other") == old.of(name, "other") for name in after)
    # About their common middle: half a turn leaves the box of two parts where it was, and their distance.
    names = ("piece_02", "piece_12")
    edited = edit_scene(scene, tmp_path / "turned", [Move(names, turn_deg=180)])
    still, turned = ([part for part in read_surfaces(f)[0] if part.name in names] for f in (scene, edited))
    np.testing.assert_allclose(box_of(turned), box_of(still), atol=SINGLE_M)
    centres = [np.stack([box_of([part]).mean(axis=0) for part in parts]) for parts in (still, turned)]
    turned_m = 2 * box_of(still).mean(axis=0) - centres[0]
    np.testing.assert_allclose(centres[1][:, :2], turned_m[:, :2], atol=SINGLE_M)
    low, high = random_room(103).parts[CABINET][1].bounds
    assert parts_within(scene, low - 1e-3, high + 1e-3) == (CABINET,)
    assert parts_within(scene, low + 1e-2, high) == ()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--move", "piece_99:0,0,1"], "no surface 'piece_99'"),
        (["--remove", "*"], "at least one"),
        (["--move", "piece_05:nan,0,0"], "finite"),
        ([], "nothing to change"),
        (["--move", "piece_05:0,0,0,360"], "changes nothing"),
        (["--move", "piece_0*:0,0.1,0", "--remove", "piece_05"], r"move piece_0\*: piece_05 is also removed"),
        (["--move", "piece_05:500,0,0"], "move piece_05: moved out of the scene, 49"),
        (["--move", "piece_05:0,0,-4"], "move piece_05: moved out of the scene"),
    ],
)
def test_edits_that_cannot_be_made_are_refused(scene, tmp_path, capsys, arguments, message):
    refused(["edit", scene, *arguments, "--out", tmp_path / "edited"], message, capsys)
    assert not (tmp_path / "edited").exists()


def test_command_lists_moves_and_needs_a_folder(scene, tmp_path, capsys):
    status, out, _ = call(["edit", scene], capsys)
    assert status == 0
    assert CABINET in out
    refused(["edit", scene, "--move", f"{CABINET}:-0.1,0,0"], "--out", capsys)
    moved = ["edit", scene, "--move", f"{CABINET},piece_06:-0.1,0,0,5", "--out", tmp_path / "e"]
    assert call(moved, capsys)[0] == 0
    assert (tmp_path / "e" / "preview.png").exists()
    shift: Any
    for shift in ((0.0, 0.0), (np.inf, 0.0, 0.0)):
        with pytest.raises(InputError, match="three finite numbers"):
            replace(Move((CABINET,)), shift_m=shift)


def box(name: str, low: tuple[float, ...], high: tuple[float, ...], kind: Kind = "other") -> Surface:
    """A box, or with a size of 0 along an axis a sheet, of the given corners."""
    mesh = trimesh.creation.box(bounds=[low, high])
    return Surface(name, kind, np.asarray(mesh.vertices), np.asarray(mesh.faces))


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    return write_scene(tmp_path_factory.mktemp("room") / "scene", ROOM, frame="the room's", source="test")


ROOM = [
    box("floor", (0, 0, 0), (4, 3, 0), "floor"),
    *(box(f"wall_{k}", (x, 0, 0), (x, 3, 2.5), "wall") for k, x in enumerate((0, 4))),
    box("pole", (3, 1.45, 0), (3.05, 1.5, 2.5)),
    box("cabinet", (1, 1, 0), (2, 2, 1.5)),
    box("table", (1, 0.1, 0.7), (1.8, 0.8, 0.7)),
]


@pytest.mark.parametrize(
    ("move", "distances"),
    [
        (Move(("cabinet",), (-1, 0, 0)), []),  # stands at the wall
        (Move(("cabinet",), (-0.3, 0.5, 0), 90), []),
        (Move(("cabinet",), (0, 0, 0.3)), []),
        (Move(("cabinet",), (-1.25, 0, 0)), ["0.25 m out of the scene", "0.25 m through wall_0"]),
        (Move(("cabinet",), (0, 0, -0.2)), ["0.20 m out of the scene", "0.20 m through floor"]),
        (Move(("cabinet",), (0, 1.4, 0)), ["0.40 m out of the scene"]),
        (Move(("cabinet",), (0, -0.6, 0)), ["0.30 m through table"]),
        (Move(("cabinet",), (1.2, 0, 0)), ["1.00 m through pole"]),  # cut at the top of each edge
        (Move(("wall_1",), (0.5, 0, 0)), ["0.50 m out of the scene"]),
        (Move(("*",), (9, 9, 9)), []),
    ],
)
def test_parts_that_leave_the_room_or_stand_in_others_are_named_with_the_distance(
    move, distances, room, tmp_path, caplog
):
    edit_scene(room, tmp_path / "edited", [move])
    with pytest.raises(InputError, match=r"move wall_1: moved out of the scene, 5\.00 m beyond it"):
        edit_scene(room, tmp_path / "far", [Move(("wall_1",), (5, 0, 0))])
    warned = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert warned == [f"move {move.parts[0]}: reaches {distance}" for distance in distances]


def test_parts_that_stood_in_others_before_are_not_named(tmp_path, caplog):
    scan = [*ROOM, box("shelf", (2, 2.5, -0.3), (3, 3, 2))]  # as scans of uneven floors have them
    scene = write_scene(tmp_path / "room", scan, frame="the room's", source="test")
    edit_scene(scene, tmp_path / "edited", [Move(("shelf",), (-0.5, 0, 0))])
    assert caplog.text == ""


EXACT_M = 1e-6
"""Corners of faces of exact boxes, metres, rounding apart."""


def box_faces(size: tuple[float, float, float], turn: float, base: tuple[float, float, float]) -> list[np.ndarray]:
    """Corners [4, 3] of the four sides of an upright box, then of its top."""
    (a, b, h), turned = size, np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    plan = np.array([[0, 0], [a, 0], [a, b], [0, b]]) @ turned
    low, high = (np.column_stack([plan, np.full(4, z)]) + base for z in (0.0, h))
    sides = [np.stack([low[k], low[(k + 1) % 4], high[(k + 1) % 4], high[k]]) for k in range(4)]
    return [*sides, high]


def surface(name: str, corners: np.ndarray, kind: Kind = "other") -> Surface:
    return Surface(name, kind, corners, np.array([[0, 1, 2], [0, 2, 3]]))


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
def test_two_faces_complete_a_box(size, turn, base, seen):
    """Of any size and direction; each missing face is found once."""
    faces = box_faces(size, turn, base)
    hidden_faces = boxes([surface(f"other_{k}", faces[k]) for k in seen]).hidden
    missing = [face for k, face in enumerate(faces) if k not in seen]
    assert len(hidden_faces) == len(missing)
    for face in missing:
        assert min(apart(face, hidden.vertices_m) for hidden in hidden_faces) < EXACT_M * max(1, *map(abs, base))


def test_edges_may_be_seen_to_a_few_centimetres():
    faces = box_faces((0.8, 0.5, 1.2), 0.3, (1, 2, 0))
    middle = faces[0].mean(axis=0)
    hidden_faces = boxes(
        [surface("other_01", middle + 0.94 * (faces[0] - middle)), surface("other_02", faces[1])]
    ).hidden
    assert len(hidden_faces) == 3
    for face in (faces[2], faces[3]):
        assert min(apart(face, hidden.vertices_m) for hidden in hidden_faces) < 0.08


def test_nothing_is_supposed_where_surfaces_lie_or_of_single_faces():
    """A cabinet at a wall has no back of its own, a board no depth, and boards that do not meet make no box."""
    faces = box_faces((0.8, 0.5, 1.2), 0.0, (0, 0.05, 0))
    side, top = surface("other_01", faces[3]), surface("other_02", faces[4])
    wall = surface("wall_01", np.array([[-3, 0, 0], [3, 0, 0], [3, 0, 3], [-3, 0, 3.0]]), "wall")
    hidden_faces = boxes([side, top, wall]).hidden
    assert len(hidden_faces) == 2
    assert min(apart(faces[0], hidden.vertices_m) for hidden in hidden_faces) > 0.1
    front, twisted = surface("other_02", faces[0]), np.array([[0, 0, 0], [1, 0, 0], [1, 1, 1], [0, 1, 0.0]])
    for what, parts in {
        "single": [side],
        "apart": [side, surface("other_02", faces[0] + [0, 2.0, 0])],
        "no furniture": [surface("other_01", faces[0] * 5), surface("other_02", faces[1] * 5)],
        "a point": [surface("other_01", np.zeros((4, 3))), front],
        "not flat": [surface("other_01", twisted), front],
    }.items():
        assert not boxes(parts).hidden, what
    named_faces = [surface("hidden_01", faces[0]), surface("other_01", faces[1])]
    assert [face.name for face in boxes(named_faces).hidden] == ["hidden_02", "hidden_03", "hidden_04"]


def test_a_scene_folder_has_them_for_as_long_as_asked(tmp_path):
    faces = box_faces((0.8, 0.5, 1.2), 0.0, (1, 1, 0))
    mesh = sheet(2, 0.0, (0, 4), (0, 3))
    floor = Surface("floor", "floor", np.asarray(mesh.vertices), np.asarray(mesh.faces))
    plain = write_scene(tmp_path / "plain", [floor], frame="f", source="s")
    sides = [surface(f"other_{k}", faces[k]) for k in (0, 1)]
    with with_hidden_faces(write_scene(tmp_path / "scene", [floor, *sides], frame="f", source="s")) as (
        scene,
        completed,
    ):
        names = [face.name for face in completed.hidden]
        assert names == ["hidden_01", "hidden_02", "hidden_03"]
        assert completed.members == [{"other_0", "other_1", *names}]
        surfaces, materials = read_surfaces(scene)
        assert [stored_surface.name for stored_surface in surfaces][3:] == names
        assert materials.of("hidden_01", "other") == materials.of("other_0", "other")
    assert not Path(scene).exists()
    for other in (plain, "box", tmp_path / "scene" / "meshes" / "floor.ply"):
        with with_hidden_faces(other) as (scene, completed):
            assert scene == other
            assert not completed.hidden
