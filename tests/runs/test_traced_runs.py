"""The ray-tracing baseline as a run folder: scores, offsets, saved paths, prediction, the command."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calling import scored_again_as_before
from commands import Command, arrays_in, positions_file
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from scipy.constants import speed_of_light

from wrf_mi.core import InputError, Record
from wrf_mi.datasets import load
from wrf_mi.estimators.ray_tracing import TracingSettings
from wrf_mi.runs.api import evaluate_run, predict_to_file, train
from wrf_mi.runs.compare import compare
from wrf_mi.runs.results import read_run
from wrf_mi.runs.run import open_run
from wrf_mi.scene.make import make_scene
from wrf_mi.tasks import instrument_of
from wrf_mi.tracing import TraceOptions, load_trace, open_scene
from wrf_mi.tracing.options import stated_kinds
from wrf_mi.tracing.paths import solve
from wrf_mi.tracing.search.surfaces import scene_surfaces
from wrf_mi.tracing.tracer import RayTracer, fit_offsets

DIRECT = TraceOptions(reflection=False, transmission=False, depth=0)
CALIBRATED = TracingSettings(reflection=False, depth=0, calibration="gain,patterns", steps=60)
FLOAT32_DB = 1e-4
"""Predictions are stored as float32; gains come from float32 amplitudes."""


def traced(data: Path | Record, scene: Path, out: Path, settings: Any = DIRECT) -> Path:
    return train(data, "ray-tracing", out=out, scene=scene, settings=settings).folder


@pytest.fixture(scope="module")
def run(flat_folder: Path, room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return traced(flat_folder, room, tmp_path_factory.mktemp("runs") / "traced")


@pytest.fixture(scope="module")
def calibrated(flat_folder: Path, room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return traced(flat_folder, room, tmp_path_factory.mktemp("runs") / "calibrated", CALIBRATED)


@pytest.fixture(scope="module")
def record(flat_folder: Path) -> Record:
    return load(flat_folder)


def friis_dbm(record: Record) -> np.ndarray:
    """Free-space loss between upright isotropic antennas, [n_rx, n]."""
    assert record.frequencies_hz is not None
    rx = np.stack([receiver.position_m for receiver in record.receivers])
    distance = np.linalg.norm(record.tx_pos_m[None] - rx[:, None], axis=-1)
    return 20 * np.log10(speed_of_light / record.frequencies_hz[0] / (4 * np.pi * distance))


def test_line_of_sight_in_a_room_is_free_space_with_one_offset_each(record: Record, room: Path, run: Path) -> None:
    read, loss, (training, _) = read_run(run), friis_dbm(record), record.official
    offset = np.median(record.observation[:, training] - loss[:, training], axis=1)
    assert read.prediction == pytest.approx(loss[:, read.row] + offset[:, None], abs=FLOAT32_DB)
    assert (read.metrics["model"], read.metrics["task"]) == ("ray-tracing", "rssi")
    assert set(read.metrics["receivers"]) == {"anchor1", "anchor2"}
    assert read.metrics["abs_error_db"]["median"] == pytest.approx(np.median(read.score))
    tracer = RayTracer(room, instrument_of(record), DIRECT)
    np.testing.assert_allclose(tracer(record.tx_pos_m[:4]), loss[:, :4], atol=FLOAT32_DB)


def test_evaluation_reproduces_the_scores_from_stored_paths(record, run, capsys):
    scored_again_as_before(run, capsys)
    assert evaluate_run(run, "trajectory")["split"] == "trajectory (rows unseen by official)"
    assert json.loads((run / "metrics.json").read_text())["split"] == "official"
    stored = load_trace(run / "paths.npz")
    np.testing.assert_array_equal(stored.tx_pos_m, record.tx_pos_m)
    assert (stored.paths.n_rx, stored.options) == (len(record.receivers), DIRECT)


def test_calibration_takes_the_seed_of_rows_and_of_training(flat_folder, room, tmp_path, command):
    paths = ["--paths", "line-of-sight", "--depth", "0", "--calibrate", "gain", "--set", "steps=2"]
    asked = ["train", flat_folder, "--model", "ray-tracing", "--scene", room, *paths, "--seed", "2"]
    assert command.json([*asked, "--out", tmp_path / "run"])["seed"] == 2


@pytest.mark.parametrize("name", ["tx.csv", "tx.npz"])
def test_calibrated_run_reproduces_its_predictions_from_positions_and_headings(
    name: str, record: Record, calibrated: Path, tmp_path: Path, command: Command
) -> None:
    read = read_run(calibrated)
    assert record.tx_heading_rad is not None
    tx_pos_m, heading = record.tx_pos_m[read.row], record.tx_heading_rad[read.row]
    predicted = command.predicted(calibrated, positions_file(tmp_path / name, tx_pos_m, heading))
    assert predicted["prediction"] == pytest.approx(read.prediction, abs=FLOAT32_DB)
    # The pattern turns with the heading.
    predict_to_file(calibrated, tx_pos_m, tmp_path / "turned.npz", heading + 1.0)
    assert not np.allclose(arrays_in(tmp_path / "turned.npz")["prediction"], read.prediction, atol=0.1)


def test_headings_are_refused_where_unused_and_required_where_used(record, run, calibrated, tmp_path, command):
    for folder, heading, message in (
        (calibrated, None, "the model needs headings; give heading_rad"),
        (run, np.zeros(6), "does not know how the transmitter is turned; omit heading_rad"),
    ):
        asked = positions_file(tmp_path / "tx.csv", record.tx_pos_m[:6], heading)
        command.refused(["predict", folder, "--tx", asked, "--out", tmp_path / "p.npz"], message)
        assert not (tmp_path / "p.npz").exists()
    with pytest.raises(InputError, match=r"6 positions and headings \(5,\); give one finite heading for each"):
        predict_to_file(calibrated, record.tx_pos_m[:6], tmp_path / "p.npz", np.zeros(5))


def test_calibrated_run_of_data_without_headings_predicts_without(record, room, tmp_path, monkeypatch):
    """The pattern is fitted in the world frame."""
    unturned = replace(record, tx_heading_rad=None)
    monkeypatch.setattr("wrf_mi.synthetic.load_record", lambda name: unturned)
    run = traced(unturned, room, tmp_path / "run", CALIBRATED)
    read = read_run(run)
    predict_to_file(run, record.tx_pos_m[read.row], tmp_path / "p.npz")
    assert arrays_in(tmp_path / "p.npz")["prediction"] == pytest.approx(read.prediction, abs=FLOAT32_DB)
    with pytest.raises(InputError, match="omit heading_rad"):
        predict_to_file(run, record.tx_pos_m[:2], tmp_path / "q.npz", np.zeros(2))


def test_calibration_is_kept_and_scores_again(run: Path, calibrated: Path) -> None:
    read = read_run(calibrated)
    assert read.metrics["calibration"] == "gain,patterns"
    assert read.metrics["train_seconds"] > 0
    assert not np.allclose(read.prediction, read_run(run).prediction, atol=0.1)
    assert evaluate_run(calibrated)["abs_error_db"] == read.metrics["abs_error_db"]
    assert evaluate_run(calibrated, "random")["split"] == "random (rows unseen by official)"


def test_calibrated_planes_are_stored_as_a_scene(flat_folder: Path, room: Path, tmp_path: Path) -> None:
    run = traced(flat_folder, room, tmp_path / "run", ["calibration=planes", "steps=3"])
    before, after = (scene_surfaces(open_scene(place, 2.4e9)) for place in (room, run / "corrected"))
    moved = np.abs(open_run(run).field.params["plane.shift"]).max()
    assert moved > 0
    assert before.triangles.shape == after.triangles.shape
    assert 0 < np.abs(before.triangles - after.triangles).max() < 20 * moved
    traced(flat_folder, run / "corrected", tmp_path / "traced")


def test_number_of_rays_is_searched_once_for_a_run(flat_folder, room, tmp_path, monkeypatch):
    """Timed samples, evaluation and predictions at new positions use the stored number."""
    calls, converged = [], solve.converged_rays

    def counted(*arguments: Any) -> int:
        calls.append(arguments)
        return converged(*arguments)

    monkeypatch.setattr(solve, "converged_rays", counted)
    out = traced(flat_folder, room, tmp_path / "run", TraceOptions(depth=1, rays="auto"))
    assert len(calls) == 1
    assert evaluate_run(out)["abs_error_db"] == read_run(out).metrics["abs_error_db"]
    predict_to_file(out, np.array([[1.0, 1.0, 1.3]]), tmp_path / "p.npz")
    assert len(calls) == 1


def test_command_traces_and_predicts(flat_folder, room, record, run, tmp_path, command):
    out = tmp_path / "run"
    asked = ["--paths", "line-of-sight, reflection", "--depth", "1", "--rays", "1000", "--seed", "3"]
    metrics = command.json(["trace", flat_folder, "--scene", room, "--out", out, *asked])
    assert metrics["rays"] == 1000
    assert metrics["paths"] > read_run(run).metrics["paths"]
    read = read_run(out)
    predicted = command.predicted(out, positions_file(tmp_path / "tx.csv", record.tx_pos_m[read.row]))
    assert predicted["prediction"] == pytest.approx(read.prediction, abs=FLOAT32_DB)
    assert predicted["receiver_name"].tolist() == ["anchor1", "anchor2"]


def test_train_and_trace_give_equal_scores(flat_folder, room, run, tmp_path, command):
    named = ["train", flat_folder, "--model", "ray-tracing", "--out", tmp_path / "run", "--scene", room]
    metrics = command.json([*named, "--paths", "line-of-sight", "--depth", "0"])
    assert metrics["abs_error_db"] == read_run(run).metrics["abs_error_db"]


def test_comparison_shows_the_scene_while_it_exists(flat_folder, tmp_path, capsys):
    scene = make_scene(flat_folder / "layout.csv", tmp_path / "scene", height_m=2.7).folder
    run = traced(flat_folder, scene, tmp_path / "run")
    assert "Mesh, traced paths" in compare([run], tmp_path / "with").read_text()
    with Image.open(tmp_path / "with" / "flat-scene.png") as picture:
        assert np.ptp(np.asarray(picture.convert("L"))) > 100
    shutil.rmtree(scene)
    capsys.readouterr()
    assert "Mesh, traced paths" not in compare([run], tmp_path / "without").read_text()
    err = capsys.readouterr().err
    assert err.startswith("no picture of the scene of run: ")
    assert err.count("\n") == 1


@given(st.lists(st.floats(-90, -30), min_size=3, max_size=30), st.floats(-40, 40))
def test_fitted_offset_is_the_median(levels: list[float], shift: float) -> None:
    strength = np.array([levels, levels])
    measured = strength + shift
    measured[1, 0] = np.nan
    offsets = fit_offsets(strength, measured)
    assert offsets.offset_db == pytest.approx([shift, shift], abs=1e-9)
    # No path: the weakest strength that this receiver observes.
    assert offsets([[np.nan], [np.nan]])[:, 0] == pytest.approx(np.nanmin(measured, axis=1))


def test_kinds_of_path_are_switched_one_by_one() -> None:
    options = TraceOptions(**stated_kinds("transmission, diffraction"))
    assert options == TraceOptions(line_of_sight=False, reflection=False, transmission=True, diffraction=True)


def test_reflections_bound_the_paths_of_the_command(flat_folder, room, tmp_path, command):
    for bound in (0, 1):
        out = tmp_path / str(bound)
        limits = ["--depth", "2", "--reflections", bound, *(["--rays", "1024"] if bound else [])]
        command.done(["trace", flat_folder, "--scene", room, *limits, "--out", out])
        assert (load_trace(out / "paths.npz").paths.interactions == 1).sum(axis=1).max() == bound


def test_walls_that_nothing_passes_are_suspected(flat_folder, room, tmp_path, caplog):
    """A wall through the room hides half of it; the log names the setting, unless it is given or nothing is hidden."""
    (tmp_path / "walls.csv").write_text("x,y\n0,0\n2.5,0\n2.5,4\n2.5,0\n5,0\n5,4\n0,4\n0,0\n")
    divided = make_scene(tmp_path / "walls.csv", tmp_path / "divided", height_m=2.7).folder
    passed = replace(DIRECT, transmission=True, depth=1)
    for name, scene, options in (("off", divided, DIRECT), ("on", divided, passed), ("open", room, DIRECT)):
        caplog.clear()
        traced(flat_folder, scene, tmp_path / name, options)
        assert ("transmission=true" in caplog.text) == (name == "off")


def test_calibrated_strength_without_a_path_is_that_of_the_weakest_training_row(record, calibrated):
    """Below the floor, which nothing passes here."""
    assert record.official is not None
    below = record.tx_pos_m[:2] - np.array([0, 0, 9.0])
    predicted = open_run(calibrated).predict(below, 0, np.zeros(2)).mean
    np.testing.assert_allclose(predicted, np.nanmin(record.observation[:, record.official[0]]), atol=FLOAT32_DB)
