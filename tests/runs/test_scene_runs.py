"""Runs in scenes: Gaussians trained jointly with traced paths, and predictions in edited scenes."""

import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from calling import stored
from commands import Command, positions_file
from scipy.spatial.transform import Rotation
from small_fits import stop_after
from traced_rooms import SHOEBOX, write_xml
from wrf_mi_scenes.build_laboratory import box, sheet

import wrf_mi
from wrf_mi.core import InputError, Receiver, Record, Split
from wrf_mi.core.antenna import UPRIGHT
from wrf_mi.core.arrays import planar_array
from wrf_mi.core.settings import with_settings
from wrf_mi.datasets import make_splits, write_spectrum_folder
from wrf_mi.models import MODELS
from wrf_mi.receivers.device_paths import TracedPaths
from wrf_mi.receivers.instruments import Instrument
from wrf_mi.runs.api import Interrupted, evaluate_run, open_run, resume, train
from wrf_mi.runs.folder import read_fitted, write_fitted
from wrf_mi.runs.run import Run
from wrf_mi.scene.edit import Move, edit_scene
from wrf_mi.scene.folder import write_scene
from wrf_mi.scene.materials import Materials
from wrf_mi.scene.mesh.surfaces import Surface
from wrf_mi.tasks import instrument_of
from wrf_mi.tracing import TraceOptions, open_scene, trace_paths
from wrf_mi.tracing.options import DISC, FACTOR
from wrf_mi.tracing.paths.corrected_scene import write_corrected_scene
from wrf_mi.tracing.paths.edited_scene import parameters_in
from wrf_mi.tracing.paths.traced_field import TracedField, TracedOptions
from wrf_mi.tracing.tracer import RayTracer
from wrf_mi.training.config import TrainConfig, default_config
from wrf_mi.training.trainer import Trainer

HZ = 920e6
SIZE = (24, 48)
WHOLE = SHOEBOX | {"ceiling": ("itu_metal", SHOEBOX["ceiling"][1])}
KNOWN = {name: part for name, part in SHOEBOX.items() if name != "ceiling"}
STANDING = Rotation.from_matrix([[0, 0, -1], [-1, 0, 0], [0, 1, 0]])
ARRAY = Receiver("gateway1", np.array([5.2, 2.4, 1.1]), STANDING.as_quat(), array_m=planar_array(4, 4, 0.16))
FIELD_ALONE = (
    *("steps=300", "validate_every=80", "log_every=40", "checkpoint_every=80", "deterministic=true"),
    *("initial.gaussians=24", "density.every=60", "density.max_gaussians=30", "network.width=32", "network.layers=2"),
)
SETTINGS = (*FIELD_ALONE, "traced.reflections=1", "traced.depth=1", "traced.rays=4096")
SHORT = ("steps=20",)
FLOAT32_GREY = 1e-4
"""Of greys that a batch of transmitters and a single one give: sums in single precision."""


def _base(with_scene: bool, settings: Sequence[str]) -> list[str]:
    """Settings of all fits; no round of growth follows in few steps, and its limit would be refused."""
    base = SETTINGS if with_scene else FIELD_ALONE
    return [setting for setting in base if "max_gaussians" not in setting or SHORT[0] not in settings]


@pytest.fixture(scope="module")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A room with a ceiling of metal, and what is known of it: floor and walls."""
    folder = tmp_path_factory.mktemp("rooms")
    return {"whole": write_xml(folder / "whole", WHOLE), "known": write_xml(folder / "known", KNOWN)}


@pytest.fixture(scope="module")
def data(rooms: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Spectra of the whole room, traced by Sionna RT; the test rows are on one side."""
    tx = np.random.default_rng(4).uniform([1.7, 2.6, 1.4], [2.1, 3.2, 1.7], (60, 3))
    tx = tx[np.argsort(tx[:, 0] + tx[:, 1])]
    empty = np.zeros((1, len(tx), *SIZE), np.float32)
    rows = np.arange(len(tx))
    split = rows[12:], rows[:12]
    record = Record("room", "spectrum", tx, (ARRAY,), empty, official=split, frequencies_hz=np.array([HZ]))
    paths = trace_paths(open_scene(rooms["whole"], HZ), tx, ARRAY, TraceOptions(depth=2, rays=1 << 13)).paths
    spectra = instrument_of(record).observe(paths)
    return write_spectrum_folder(tmp_path_factory.mktemp("data") / "room", replace(record, observation=spectra))


def config(*settings: str, with_scene: bool = True) -> TrainConfig:
    return with_settings(default_config("spectrum", with_scene), [*_base(with_scene, settings), *settings])


Fit = Callable[..., Run]


@pytest.fixture(scope="module")
def fit(rooms: dict[str, Path], data: Path) -> Fit:
    """Trains Gaussians and paths of the known room together."""
    scene = rooms["known"]
    return lambda out, *settings, **more: train(
        str(data), "wrf-gs+", out=out, settings=config(*settings), scene=scene, **more
    )


@pytest.fixture(scope="module")
def run(fit: Fit, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fit(tmp_path_factory.mktemp("runs") / "joint").folder


def median(run: Path) -> float:
    return float(json.loads((run / "metrics.json").read_text())["ssim"]["median"])


def test_joint_training_predicts_better_than_paths_or_gaussians_alone(rooms, data, run, tmp_path, command):
    train(str(data), "wrf-gs+", out=tmp_path / "field", settings=config(with_scene=False))
    command.done(
        ["trace", data, "--scene", rooms["known"], "--depth", "1", "--rays", "4096", "--out", tmp_path / "traced"]
    )
    assert median(run) > median(tmp_path / "field") + 0.03
    assert median(run) > median(tmp_path / "traced") + 0.03


def test_run_folder_states_scene_and_trained_parameters(rooms: dict[str, Path], run: Path) -> None:
    run_config = yaml.safe_load((run / "config.yaml").read_text())
    assert run_config["scene"] == str(rooms["known"])
    params = open_run(run).field.params
    moved = {name for name in params if name.startswith(("material", "receiver", "surface"))}
    # A pose is held unless a rate is given for it, and costs nothing.
    assert not any("position" in name or "turn" in name for name in moved)
    for name in ("receiver.gateway1.gain", "material.surface.permittivity", "surface.factor"):
        assert params[name].any()


def test_new_predictions_reproduce_the_scored_ones(data: Path, run: Path) -> None:
    before, score = (run / "predictions.npz").read_bytes(), median(run)
    assert evaluate_run(run)["ssim"]["median"] == score
    assert (run / "predictions.npz").read_bytes() == before
    record, predictor, arrays = wrf_mi.load(str(data)), open_run(run).predictor(), stored(run)
    rows, prediction = arrays["row"], arrays["prediction"]
    np.testing.assert_allclose(predictor(record.tx_pos_m[rows[:3]], "gateway1"), prediction[:3], atol=FLOAT32_GREY)


def test_resumed_run_is_bit_identical(fit: Fit, run: Path, tmp_path: Path) -> None:
    with pytest.raises(Interrupted):
        fit(tmp_path / "run", stop=stop_after(100))
    resume(tmp_path / "run")
    uninterrupted, resumed = (open_run(folder).field.arrays() for folder in (run, tmp_path / "run"))
    for key in uninterrupted:
        np.testing.assert_array_equal(uninterrupted[key], resumed[key], err_msg=key)


def test_run_that_validated_no_step_opens_with_an_infinite_reach(fit: Fit, tmp_path: Path) -> None:
    run = fit(tmp_path / "run", "steps=20", "validate_every=1000", "patience=0", "optimiser.warm_up=5")
    assert np.isinf(run.field.reach.length_m)
    position = np.array([[1.9, 2.9, 1.5]])
    assert np.isfinite(run.predict(position).mean).all()
    arrays, seconds = read_fitted(run.folder, MODELS["wrf-gs+"].serving("spectrum", True))
    write_fitted(run.folder, arrays | {"reach/length_m": np.array(np.nan)}, seconds)
    with pytest.raises(InputError, match="reach/length_m: not a number"):
        open_run(run.folder).predict(position)


def test_receiver_model_of_a_field_alone_is_a_choice(data: Path, tmp_path: Path, command: Command) -> None:
    settings = [part for setting in ("steps=20", *_base(False, SHORT)[1:]) for part in ("--set", setting)]
    receiver = ["--receiver-model", "array", "--out", tmp_path / "run"]
    command.done(["train", data, "--model", "wrf-gs+", *receiver, *settings])
    prediction = stored(tmp_path / "run")["prediction"]
    # The instrument's scale is part of this receiver.
    np.testing.assert_allclose(prediction.max(axis=(1, 2)), 1, atol=1e-6)
    np.testing.assert_allclose(prediction.min(axis=(1, 2)), 0, atol=1e-6)


def test_a_scene_needs_array_and_carrier(rooms: dict[str, Path], data: Path) -> None:
    record = wrf_mi.load(str(data)).with_array(None)
    scene = open_scene(rooms["known"], HZ)
    with pytest.raises(InputError, match="a scene needs the antenna array and the carrier"):
        Trainer(record, make_splits(record, "official")[0], config(), scene=scene)


CARRIER_HZ = np.array([920e6])
ROUNDED = 1e-3
"""Of channels in scenes whose corners (single precision) and constants (five digits) were written to files."""
EXACT_M = 1e-6  # coordinates of meshes and discs in single precision
MOVES = (Move(("cabinet",), (1.2, 0.7, 0.0), 30.0),)
UPRIGHT_ARRAY = Receiver("rx", np.array([5.2, 2.4, 1.1]), np.asarray(UPRIGHT), array_m=planar_array(4, 4, 0.16))
TX = np.random.default_rng(3).uniform([0.3, 0.3, 0.8], [1.8, 4.5, 2.2], (24, 3))
QUICK: dict[str, tuple[str, ...]] = {
    "ray-tracing": (),
    "wrf-gs+": (*FIELD_ALONE[-2:], "steps=6", "initial.gaussians=8", "optimiser.warm_up=2", *SETTINGS[-2:]),
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
    record = Record("room", task, TX, instrument.receivers, observed, frequencies_hz=CARRIER_HZ)
    return record, Split("first", 0, rows[:20], rows[:0], rows[20:])


@pytest.fixture(scope="module")
def spectra(scene: Path) -> tuple[Record, Split]:
    record, split = measured(scene, Instrument("array", (UPRIGHT_ARRAY,), CARRIER_HZ, size=(12, 24)), "spectrum")
    return replace(record, observation=record.observation.astype(np.float32)), split


@pytest.mark.parametrize("model", ["ray-tracing", "hybrid"])
def test_predictions_in_a_copy_of_the_scene_are_equal_and_in_an_edited_one_are_not(model, scene, spectra, tmp_path):
    record, split = spectra
    run = wrf_mi.train(record, model, scene, split=split, settings=QUICK[model])
    shutil.copytree(scene, tmp_path / "copy")
    before = run.predict(TX[20:]).mean
    np.testing.assert_array_equal(run.in_scene(tmp_path / "copy").predict(TX[20:]).mean, before)
    edited = run.in_scene(wrf_mi.Scene.open(scene).edit(MOVES))
    assert np.abs(edited.predict(TX[20:]).mean - before).max() > ROUNDED


def test_strengths_keep_what_was_measured_beyond_the_traced_power(scene: Path, tmp_path: Path) -> None:
    record, split = measured(scene, Instrument("power", (replace(UPRIGHT_ARRAY, array_m=None),), CARRIER_HZ), "rssi")
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

    opened = open_scene(folder, CARRIER_HZ[0])
    if params is not None:
        params = parameters_in(opened, open_scene(stated, CARRIER_HZ[0]), params)
    options = TracedOptions(TraceOptions(depth=2, rays=1 << 13), materials="surface")
    field = TracedField(opened, TX, UPRIGHT_ARRAY, options)
    paths: TracedPaths = field({name: to_tensor(values) for name, values in (params or {}).items()})
    gain = (paths.gain[0].numpy() + 1j * paths.gain[1].numpy()) * field.exists
    return np.asarray(gain.reshape(len(TX), -1).sum(axis=1))


def test_fitted_materials_move_with_their_surfaces(scene: Path, tmp_path: Path) -> None:
    """Fitted parameters in the edited scene are the edited corrected scene, which has them in its files."""
    opened = open_scene(scene, CARRIER_HZ[0])
    params = TracedField(opened, TX, UPRIGHT_ARRAY, TracedOptions(materials="surface")).parameters()
    rng = np.random.default_rng(0)
    drawn = {k: v + rng.normal(0, 0.5, v.shape) for k, v in params.items() if k.startswith("material")}
    params = {name: values.astype(np.float32) for name, values in drawn.items()}
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
    result = parameters_in(open_scene(edited, CARRIER_HZ[0]), open_scene(scene, CARRIER_HZ[0]), params)
    np.testing.assert_array_equal(result[DISC][:, 0], params[DISC][:, 0])
    np.testing.assert_array_equal(result[FACTOR], params[FACTOR][:, :2])
    matrix = MOVES[0].matrix(np.array([[2.4, 2.0, 0.05], [2.9, 3.0, 1.6]]))
    np.testing.assert_allclose(result[DISC][:3, 1], matrix[:3, :3] @ side[:3] + matrix[:3, 3], atol=EXACT_M)
    normal = matrix[:3, :3] @ side[3:]
    np.testing.assert_allclose(np.abs(result[DISC][3:, 1] @ normal), 1, atol=EXACT_M)


def test_command_predicts_in_the_edited_scene_and_refuses_others(scene, spectra, tmp_path, command):
    record, split = spectra
    data = write_spectrum_folder(tmp_path / "data", replace(record, official=(split.train, split.test)))
    run = wrf_mi.train(str(data), "wrf-gs+", scene, settings=QUICK["wrf-gs+"], out=tmp_path / "run")
    shutil.copytree(scene, tmp_path / "copy")
    before = run.predict(TX[:2]).mean
    np.testing.assert_array_equal(run.in_scene(tmp_path / "copy").predict(TX[:2]).mean, before)
    edited, tx = edit_scene(scene, tmp_path / "edited", MOVES), positions_file(tmp_path / "tx.csv", TX[:2])
    predict = ["predict", run.folder, "--tx", tx, "--out", tmp_path / "out.npz", "--scene"]
    command.done([*predict, edited])
    want = wrf_mi.open_run(run.folder, scene=edited).predict(TX[:2]).mean
    np.testing.assert_allclose(np.load(tmp_path / "out.npz")["prediction"], want, atol=ROUNDED)
    assert np.abs(want - before).max() > ROUNDED
    command.refused([*predict, "laboratory"], f"not one of the scene of the fit; edit that scene; trained in {scene}")
    idw = wrf_mi.train(record, "idw", split=split)
    with pytest.raises(wrf_mi.InputError, match="its predictions use no scene"):
        _ = idw.in_scene(edited).fitted
