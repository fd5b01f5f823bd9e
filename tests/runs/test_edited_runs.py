"""Runs in edited scenes: equal where nothing has moved, as traced where something has, refusals."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calling import call, refused
from commands import positions_file
from traced_rooms import SHOEBOX
from wrf_mi_scenes.build_laboratory import box, sheet

import wrf_mi
from wrf_mi.core import Receiver, Record, Split
from wrf_mi.core.antenna import UPRIGHT
from wrf_mi.core.arrays import planar_array
from wrf_mi.datasets import write_spectrum_folder
from wrf_mi.receivers.device_paths import TracedPaths
from wrf_mi.receivers.instruments import Instrument
from wrf_mi.scene.edit import Move, edit_scene
from wrf_mi.scene.folder import write_scene
from wrf_mi.scene.materials import Materials
from wrf_mi.scene.mesh.surfaces import Surface
from wrf_mi.tracing import TraceOptions, open_scene
from wrf_mi.tracing.options import DISC, FACTOR
from wrf_mi.tracing.paths.corrected_scene import write_corrected_scene
from wrf_mi.tracing.paths.edited_scene import parameters_in
from wrf_mi.tracing.paths.traced_field import TracedField, TracedOptions
from wrf_mi.tracing.tracer import RayTracer

HZ = np.array([920e6])
ROUNDED = 1e-3
"""Of channels in scenes whose corners (single precision) and constants (five digits) were written to files."""
EXACT_M = 1e-6  # coordinates of meshes and discs in single precision
MOVES = (Move(("cabinet",), (1.2, 0.7, 0.0), 30.0),)
ARRAY = Receiver("rx", np.array([5.2, 2.4, 1.1]), np.asarray(UPRIGHT), array_m=planar_array(4, 4, 0.16))
TX = np.random.default_rng(3).uniform([0.3, 0.3, 0.8], [1.8, 4.5, 2.2], (24, 3))
QUICK: dict[str, tuple[str, ...]] = {
    "ray-tracing": (),
    "wrf-gs+": ("steps=6", "initial.gaussians=8", "optimiser.warm_up=2", "traced.depth=1", "traced.rays=4096"),
    "hybrid": ("steps=6", "stages=mean,surfaces"),
}


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A room with a cabinet and a board."""
    parts = SHOEBOX | {
        "cabinet": ("itu_wood", box((2.4, 2.0, 0.05), (2.9, 3.0, 1.6))),
        "board": ("itu_metal", sheet(1, 4.0, (2.5, 4.0), (0.5, 2.0))),
    }
    surfaces = [Surface(name, "other", np.asarray(m.vertices), np.asarray(m.faces)) for name, (_, m) in parts.items()]
    materials = Materials(surfaces={name: material for name, (material, _) in parts.items()})
    folder = tmp_path_factory.mktemp("scenes") / "room"
    return write_scene(folder, surfaces, frame="the room's", source="test", materials=materials)


def measured(scene: Path, instrument: Instrument, task: str) -> tuple[Record, Split]:
    observed = RayTracer(scene, instrument, TraceOptions(depth=1, rays=1 << 12))(TX)
    rows = np.arange(len(TX))
    record = Record("room", task, TX, instrument.receivers, observed, frequencies_hz=HZ)
    return record, Split("first", 0, rows[:20], rows[:0], rows[20:])


@pytest.fixture(scope="module")
def spectra(scene: Path) -> tuple[Record, Split]:
    record, split = measured(scene, Instrument("array", (ARRAY,), HZ, size=(12, 24)), "spectrum")
    return replace(record, observation=record.observation.astype(np.float32)), split


@pytest.mark.parametrize("model", ["ray-tracing", "wrf-gs+", "hybrid"])
def test_predictions_in_a_copy_of_the_scene_are_equal_and_in_an_edited_one_are_not(
    model: str, scene: Path, spectra: tuple[Record, Split], tmp_path: Path
) -> None:
    record, split = spectra
    run = wrf_mi.train(record, model, scene, split=split, settings=QUICK[model])
    shutil.copytree(scene, tmp_path / "copy")
    before = run.predict(TX[20:]).mean
    np.testing.assert_array_equal(run.in_scene(tmp_path / "copy").predict(TX[20:]).mean, before)
    edited = run.in_scene(wrf_mi.Scene.open(scene).edit(MOVES))
    assert np.abs(edited.predict(TX[20:]).mean - before).max() > ROUNDED


def test_strengths_keep_what_was_measured_beyond_the_traced_power(scene: Path, tmp_path: Path) -> None:
    record, split = measured(scene, Instrument("power", (replace(ARRAY, array_m=None),), HZ), "rssi")
    # Six decibels more than traced, which the traced scene cannot know, are known in the edited one.
    record = replace(record, observation=record.observation + 6)
    run = wrf_mi.train(record, "hybrid", scene, split=split, settings=("stages=mean",))
    shutil.copytree(scene, tmp_path / "copy")
    before = run.predict(TX[20:]).mean
    np.testing.assert_array_equal(run.in_scene(tmp_path / "copy").predict(TX[20:]).mean, before)
    edited = run.in_scene(edit_scene(scene, tmp_path / "edited", MOVES))
    assert 0 < np.abs(edited.predict(TX[20:]).mean - before).max() < 6
    with pytest.raises(wrf_mi.InputError, match="omit the edited scene"):
        edited.locate(np.array([[-50.0]]))


def channels(folder: Path, params: dict[str, Any] | None = None, stated: Path | None = None) -> np.ndarray:
    """Gains of all paths of all transmitters, with parameters of another scene."""
    from wrf_mi.backend.device import to_tensor

    opened = open_scene(folder, HZ[0])
    if params is not None:
        params = parameters_in(opened, open_scene(stated, HZ[0]), params)
    options = TracedOptions(TraceOptions(depth=2, rays=1 << 13), materials="surface")
    field = TracedField(opened, TX, ARRAY, options)
    paths: TracedPaths = field({name: to_tensor(values) for name, values in (params or {}).items()})
    gain = (paths.gain[0].numpy() + 1j * paths.gain[1].numpy()) * field.exists
    return np.asarray(gain.reshape(len(TX), -1).sum(axis=1))


def test_fitted_materials_move_with_their_surfaces(scene: Path, tmp_path: Path) -> None:
    """Fitted parameters in the edited scene are the edited corrected scene, which has them in its files."""
    opened = open_scene(scene, HZ[0])
    params = TracedField(opened, TX, ARRAY, TracedOptions(materials="surface")).parameters()
    rng = np.random.default_rng(0)
    params = {k: v + rng.normal(0, 0.5, v.shape) for k, v in params.items() if k.startswith("material")}
    corrected = write_corrected_scene(tmp_path / "corrected", opened, params, grouping="surface")
    cabinet = Move(("cabinet*",), MOVES[0].shift_m, MOVES[0].turn_deg)
    want = channels(edit_scene(corrected, tmp_path / "want", (cabinet,), remove=("board*",)))
    edited = edit_scene(scene, tmp_path / "edited", MOVES, remove=("board",))
    scale = np.abs(want).max()
    assert np.abs(channels(edited, params, scene) - want).max() < ROUNDED * scale
    assert np.abs(channels(scene, params, scene) - want).max() > 10 * ROUNDED * scale
    assert np.abs(channels(edited) - want).max() > 10 * ROUNDED * scale


def test_gaussians_on_surfaces_move_with_these_and_go_with_them(scene: Path, tmp_path: Path) -> None:
    edited = edit_scene(scene, tmp_path / "edited", MOVES, remove=("board",))
    floor, side, board = [1.0, 1.0, 0.0, 0.0, 0.0, 1.0], [2.4, 2.3, 0.9, 1.0, 0.0, 0.0], [3.0, 4.0, 1.0, 0, 1, 0]
    params = {DISC: np.array([floor, side, board], np.float32).T, FACTOR: np.arange(6.0).reshape(2, 3)}
    result = parameters_in(open_scene(edited, HZ[0]), open_scene(scene, HZ[0]), params)
    np.testing.assert_array_equal(result[DISC][:, 0], params[DISC][:, 0])
    np.testing.assert_array_equal(result[FACTOR], params[FACTOR][:, :2])
    matrix = MOVES[0].matrix(np.array([[2.4, 2.0, 0.05], [2.9, 3.0, 1.6]]))
    np.testing.assert_allclose(result[DISC][:3, 1], matrix[:3, :3] @ side[:3] + matrix[:3, 3], atol=EXACT_M)
    normal = matrix[:3, :3] @ side[3:]
    np.testing.assert_allclose(np.abs(result[DISC][3:, 1] @ normal), 1, atol=EXACT_M)


def test_command_predicts_in_the_edited_scene_and_refuses_others(
    scene: Path, spectra: tuple[Record, Split], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record, split = spectra
    data = write_spectrum_folder(tmp_path / "data", replace(record, official=(split.train, split.test)))
    run = wrf_mi.train(str(data), "wrf-gs+", scene, settings=QUICK["wrf-gs+"], out=tmp_path / "run")
    edited, tx = edit_scene(scene, tmp_path / "edited", MOVES), positions_file(tmp_path / "tx.csv", TX[:2])
    predict = ["predict", run.folder, "--tx", tx, "--out", tmp_path / "out.npz", "--scene"]
    assert call([*predict, edited], capsys)[0] == 0
    want = wrf_mi.open_run(run.folder, scene=edited).predict(TX[:2]).mean
    np.testing.assert_allclose(np.load(tmp_path / "out.npz")["prediction"], want, atol=ROUNDED)
    refused([*predict, "laboratory"], f"not one of the scene of the fit; edit that scene; trained in {scene}", capsys)
    idw = wrf_mi.train(record, "idw", split=split)
    with pytest.raises(wrf_mi.InputError, match="its predictions use no scene"):
        _ = idw.in_scene(edited).fitted
