"""Edited scenes: geometry, materials, and the channels that are traced in them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from wrf_mi_scenes.random_rooms import random_room

from wrf_mi.cli.main import main
from wrf_mi.core import InputError, Receiver
from wrf_mi.core.angles import FloatArray
from wrf_mi.core.antenna import UPRIGHT
from wrf_mi.receivers.instruments import ChannelInstrument
from wrf_mi.scene.edit import Move, box_of, edit_scene, parts_within, read_surfaces
from wrf_mi.scene.folder import read_scene_folder, write_scene
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
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return room_folder(tmp_path_factory.mktemp("room") / "scene")


def turned(points_m: FloatArray, middle_m: FloatArray) -> FloatArray:
    """The motion of the tests, written out."""
    c, s = np.cos(np.radians(TURN_DEG)), np.sin(np.radians(TURN_DEG))
    x, y, z = (points_m - middle_m).T
    return np.stack([c * x - s * y, s * x + c * y, z], axis=-1) + middle_m + SHIFT_M


def test_moved_part_gives_the_channels_of_the_room_measured_anew(scene: Path, tmp_path: Path) -> None:
    """Tracing the edited scene equals tracing a room that was built with the cabinet at its new place."""
    mesh = random_room(103).parts[CABINET][1]
    moved = mesh.copy()
    moved.vertices = turned(np.asarray(mesh.vertices), mesh.bounds.mean(axis=0))
    true = room_folder(tmp_path / "true", moved)
    edited = edit_scene(scene, tmp_path / "edited", [Move((CABINET,), SHIFT_M, TURN_DEG)])
    receiver = Receiver("station", np.array(random_room(103).station_m), np.array(UPRIGHT))
    instrument = ChannelInstrument((receiver,), np.array([2.44e9]))
    options = TraceOptions(transmission=True, depth=2, rays=1 << 14)
    positions = np.array([[1.1, 0.5, 0.9], [2.9, 3.0, 1.1], [5.0, 1.5, 0.7], [0.4, 1.8, 1.3]])
    before, after, new = (RayTracer(folder, instrument, options)(positions) for folder in (scene, edited, true))
    scale = np.abs(new).max()
    assert np.abs(after - new).max() < SAME_CHANNEL * scale
    assert np.abs(before - new).max() > 10 * SAME_CHANNEL * scale


def test_other_parts_and_all_materials_stay(scene: Path, tmp_path: Path) -> None:
    edited = edit_scene(scene, tmp_path / "edited", [Move((CABINET,), SHIFT_M)], remove=("piece_1*",))
    before, after = ({one.name: one for one in read_surfaces(folder)[0]} for folder in (scene, edited))
    assert set(before) - set(after) == {name for name in before if name.startswith("piece_1")}
    for name, surface in after.items():
        shift = np.array(SHIFT_M) if name == CABINET else 0.0
        np.testing.assert_allclose(surface.vertices_m, before[name].vertices_m + shift, atol=SINGLE_M)
        np.testing.assert_array_equal(surface.faces, before[name].faces)
    old, new = (read_scene_folder(folder).materials for folder in (scene, edited))
    assert new.constants == old.constants
    assert all(new.of(name, "other") == old.of(name, "other") for name in after)


def test_parts_move_about_their_common_middle(scene: Path, tmp_path: Path) -> None:
    """Half a turn leaves the common box of two parts where it was, and their distance."""
    names = ("piece_02", "piece_12")
    edited = edit_scene(scene, tmp_path / "edited", [Move(names, turn_deg=180)])
    before, after = ([one for one in read_surfaces(f)[0] if one.name in names] for f in (scene, edited))
    np.testing.assert_allclose(box_of(after), box_of(before), atol=SINGLE_M)
    centres = [np.stack([box_of([one]).mean(axis=0) for one in found]) for found in (before, after)]
    np.testing.assert_allclose(
        centres[1][:, :2], 2 * box_of(before).mean(axis=0)[:2] - centres[0][:, :2], atol=SINGLE_M
    )


def test_parts_within_a_box(scene: Path) -> None:
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
        (["--move", "piece_0*:0,0.1,0", "--remove", "piece_05"], "move piece_0*: piece_05 is also removed"),
        (["--move", "piece_05:500,0,0"], "move piece_05: moved out of the scene, 49"),
        (["--move", "piece_05:0,0,-4"], "move piece_05: moved out of the scene"),
    ],
)
def test_edits_that_cannot_be_made_are_refused(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    assert main(["edit", str(scene), *arguments, "--out", str(tmp_path / "edited")]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "edited").exists()


def box(name: str, low: tuple[float, ...], high: tuple[float, ...], kind: Kind = "other") -> Surface:
    """A box, or with a size of 0 along an axis a sheet, of the given corners."""
    mesh = trimesh.creation.box(bounds=[low, high])
    return Surface(name, kind, np.asarray(mesh.vertices), np.asarray(mesh.faces))


ROOM = [
    box("floor", (0, 0, 0), (4, 3, 0), "floor"),
    *(box(f"wall_{k}", (x, 0, 0), (x, 3, 2.5), "wall") for k, x in enumerate((0, 4))),
    box("pole", (3, 1.45, 0), (3.05, 1.5, 2.5)),
    box("cabinet", (1, 1, 0), (2, 2, 1.5)),
    box("table", (1, 0.1, 0.7), (1.8, 0.8, 0.7)),
]


@pytest.mark.parametrize(
    ("move", "warned"),
    [
        (Move(("cabinet",), (-1, 0, 0)), []),  # stands at the wall
        (Move(("cabinet",), (-0.3, 0.5, 0), 90), []),
        (Move(("cabinet",), (0, 0, 0.3)), []),
        (
            Move(("cabinet",), (-1.25, 0, 0)),
            ["move cabinet: reaches 0.25 m out of the scene", "move cabinet: reaches 0.25 m through wall_0"],
        ),
        (
            Move(("cabinet",), (0, 0, -0.2)),
            ["move cabinet: reaches 0.20 m out of the scene", "move cabinet: reaches 0.20 m through floor"],
        ),
        (Move(("cabinet",), (0, 1.4, 0)), ["move cabinet: reaches 0.40 m out of the scene"]),
        (Move(("cabinet",), (0, -0.6, 0)), ["move cabinet: reaches 0.30 m through table"]),
        # The pole is in the cabinet: each of its edges is cut at the top.
        (Move(("cabinet",), (1.2, 0, 0)), ["move cabinet: reaches 1.00 m through pole"]),
        (Move(("wall_1",), (0.5, 0, 0)), ["move wall_1: reaches 0.50 m out of the scene"]),
        (Move(("*",), (9, 9, 9)), []),
    ],
)
def test_parts_that_leave_the_room_or_stand_in_others_are_named_with_the_distance(
    move: Move, warned: list[str], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    scene = write_scene(tmp_path / "room", ROOM, frame="the room's", source="test")
    edit_scene(scene, tmp_path / "edited", [move])
    with pytest.raises(InputError, match=r"move wall_1: moved out of the scene, 5\.00 m beyond it"):
        edit_scene(scene, tmp_path / "far", [Move(("wall_1",), (5, 0, 0))])
    assert [record.getMessage() for record in caplog.records if record.levelname == "WARNING"] == warned


def test_parts_that_stood_in_others_before_are_not_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    scan = [*ROOM, box("shelf", (2, 2.5, -0.3), (3, 3, 2))]  # as scans of uneven floors have them
    scene = write_scene(tmp_path / "room", scan, frame="the room's", source="test")
    edit_scene(scene, tmp_path / "edited", [Move(("shelf",), (-0.5, 0, 0))])
    assert caplog.text == ""


def test_command_lists_moves_and_needs_a_folder(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["edit", str(scene)]) == 0
    assert CABINET in capsys.readouterr().out
    assert main(["edit", str(scene), "--move", f"{CABINET}:-0.1,0,0"]) == 2
    assert "--out" in capsys.readouterr().err
    assert main(["edit", str(scene), "--move", f"{CABINET},piece_06:-0.1,0,0,5", "--out", str(tmp_path / "e")]) == 0
    assert (tmp_path / "e" / "preview.png").exists()


@pytest.mark.parametrize("shift", [(0.0, 0.0), (np.inf, 0.0, 0.0)])
def test_motions_need_three_finite_numbers(shift: tuple[float, ...]) -> None:
    with pytest.raises(InputError, match="three finite numbers"):
        replace(Move((CABINET,)), shift_m=shift)  # type: ignore[arg-type]
