"""The ray-tracing baseline as a run folder: scores, offsets, saved paths, prediction, the command."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calling import call, refused
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from scipy.constants import speed_of_light

from wrf_mi.core import InputError, Record
from wrf_mi.datasets import load
from wrf_mi.models.ray_tracing import TracingSettings
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


@pytest.fixture(scope="module")
def run(flat_folder: Path, room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train(
        flat_folder, tmp_path_factory.mktemp("runs") / "traced", "ray-tracing", scene=room, settings=DIRECT
    ).folder


def friis_dbm(record: Record) -> np.ndarray:
    """Free-space loss between upright isotropic antennas, [n_rx, n]."""
    assert record.frequencies_hz is not None
    rx = np.stack([receiver.position_m for receiver in record.receivers])
    separation = record.tx_pos_m[None] - rx[:, None]
    distance = np.linalg.norm(separation, axis=-1)
    return 20 * np.log10(speed_of_light / record.frequencies_hz[0] / (4 * np.pi * distance))


def test_line_of_sight_in_a_room_is_free_space_with_one_offset_each(flat_folder: Path, run: Path) -> None:
    record, read = load(flat_folder), read_run(run)
    loss, official = friis_dbm(record), record.official
    assert official is not None
    offset = np.median(record.observation[:, official[0]] - loss[:, official[0]], axis=1)
    assert read.prediction == pytest.approx(loss[:, read.row] + offset[:, None], abs=FLOAT32_DB)
    assert read.metrics["model"] == "ray-tracing"
    assert read.metrics["task"] == "rssi"
    assert set(read.metrics["receivers"]) == {"anchor1", "anchor2"}
    assert read.metrics["abs_error_db"]["median"] == pytest.approx(np.median(read.score))


def test_evaluation_reproduces_the_scores_without_tracing(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = json.loads((run / "metrics.json").read_text())
    predictions = (run / "predictions.npz").read_bytes()
    again = evaluate_run(run)
    for key in ("abs_error_db", "reference", "n_test", "trace_seconds", "paths", "rays"):
        assert again[key] == before[key], key
    assert (run / "predictions.npz").read_bytes() == predictions
    other = evaluate_run(run, "trajectory")
    assert other["split"] == "trajectory (rows unseen by official)"
    assert json.loads((run / "metrics.json").read_text())["split"] == "official"


def test_stored_paths_belong_to_the_record(flat_folder: Path, run: Path) -> None:
    stored = load_trace(run / "paths.npz")
    record = load(flat_folder)
    np.testing.assert_array_equal(stored.tx_pos_m, record.tx_pos_m)
    assert stored.paths.n_rx == len(record.receivers)
    assert stored.options == DIRECT


@pytest.fixture(scope="module")
def calibrated(flat_folder: Path, room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train(
        flat_folder, tmp_path_factory.mktemp("runs") / "calibrated", "ray-tracing", scene=room, settings=CALIBRATED
    ).folder


def test_calibration_takes_the_seed_of_rows_and_of_training(
    flat_folder: Path, room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    paths = ["--paths", "line-of-sight", "--depth", "0", "--calibrate", "gain", "--set", "steps=2"]
    asked = ["train", flat_folder, "--model", "ray-tracing", "--scene", room, *paths, "--seed", "2"]
    status, _, err = call([*asked, "--out", tmp_path / "run", "--json"], capsys)
    assert status == 0, err
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["seed"] == 2


def asked_rows(run: Path, record: Record, file: Path, heading: np.ndarray | None) -> Path:
    """The run's test rows as a file of `wrf-mi predict`, CSV or npz by its name."""
    tx_pos = record.tx_pos_m[read_run(run).row]
    if file.suffix == ".npz":
        np.savez(file, tx_pos=tx_pos, **({} if heading is None else {"heading_rad": heading}))
        return file
    table = tx_pos if heading is None else np.column_stack([tx_pos, heading])
    header = "x,y,z" if heading is None else "x,y,z,heading_rad"
    np.savetxt(file, table, "%.17g", ",", header=header, comments="")
    return file


@pytest.mark.parametrize(("option", "name"), [("--tx", "tx.csv"), ("--input", "tx.npz")])
def test_calibrated_run_reproduces_its_predictions_from_positions_and_headings(
    option: str, name: str, flat_folder: Path, calibrated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record, read = load(flat_folder), read_run(calibrated)
    assert record.tx_heading_rad is not None
    heading, out = record.tx_heading_rad[read.row], tmp_path / "p.npz"
    asked = asked_rows(calibrated, record, tmp_path / name, heading)
    status, _, err = call(["predict", calibrated, option, asked, "--out", out], capsys)
    assert status == 0, err
    with np.load(out) as stored:
        assert stored["prediction"] == pytest.approx(read.prediction, abs=FLOAT32_DB)
    # The pattern turns with the heading.
    predict_to_file(calibrated, record.tx_pos_m[read.row], out, heading + 1.0)
    with np.load(out) as stored:
        assert not np.allclose(stored["prediction"], read.prediction, atol=0.1)


def test_headings_are_refused_where_unused_and_required_where_used(
    flat_folder: Path, run: Path, calibrated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record, out = load(flat_folder), tmp_path / "p.npz"
    heading = np.zeros(len(read_run(run).row))
    for folder, headings, message in [
        (calibrated, None, "the model needs headings; give heading_rad"),
        (run, heading, "does not know how the transmitter is turned; omit heading_rad"),
    ]:
        asked = asked_rows(folder, record, tmp_path / "tx.csv", headings)
        status, _, err = call(["predict", folder, "--tx", asked, "--out", out], capsys)
        assert (status, err.count("\n")) == (2, 1)
        assert message in err
        assert not out.exists()
    with pytest.raises(InputError, match=r"6 positions and headings \(5,\); give one finite heading for each"):
        predict_to_file(calibrated, record.tx_pos_m[:6], out, heading[:5])


def test_calibrated_run_of_data_without_headings_predicts_without(
    flat_folder: Path, room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The pattern is fitted in the world frame."""
    record = replace(load(flat_folder), tx_heading_rad=None)
    monkeypatch.setattr("wrf_mi.synthetic.load_record", lambda name: record)
    run = train(record, tmp_path / "run", "ray-tracing", scene=room, settings=CALIBRATED).folder
    read = read_run(run)
    predict_to_file(run, record.tx_pos_m[read.row], tmp_path / "p.npz")
    with np.load(tmp_path / "p.npz") as stored:
        assert stored["prediction"] == pytest.approx(read.prediction, abs=FLOAT32_DB)
    with pytest.raises(InputError, match="omit heading_rad"):
        predict_to_file(run, record.tx_pos_m[:2], tmp_path / "q.npz", np.zeros(2))


def test_calibration_is_kept_and_scores_again(
    flat_folder: Path, room: Path, run: Path, calibrated: Path, tmp_path: Path
) -> None:
    out = calibrated
    read = read_run(out)
    assert read.metrics["calibration"] == "gain,patterns"
    assert read.metrics["train_seconds"] > 0
    assert not np.allclose(read.prediction, read_run(run).prediction, atol=0.1)
    assert evaluate_run(out)["abs_error_db"] == read.metrics["abs_error_db"]
    assert evaluate_run(out, "random")["split"] == "random (rows unseen by official)"
    for setting in ("steps=5", "patience=2"):
        with pytest.raises(InputError, match=f"^setting {setting}: of a training, and nothing is calibrated"):
            train(flat_folder, tmp_path / "other", "ray-tracing", scene=room, settings=[setting])
    with pytest.raises(InputError, match=r"setting holdout_steps_fraction: 2\.0 is out of range, choose 0 to 1"):
        train(
            flat_folder,
            tmp_path / "other",
            "ray-tracing",
            scene=room,
            settings=["calibration=gain", "holdout_steps_fraction=2"],
        )
    with pytest.raises(InputError, match="everything: choose of gain, materials, planes, patterns, pose, surface"):
        train(flat_folder, tmp_path / "other", "ray-tracing", scene=room, settings=["calibration=everything"])


def test_calibrated_planes_are_stored_as_a_scene(flat_folder: Path, room: Path, tmp_path: Path) -> None:
    run = train(flat_folder, tmp_path / "run", "ray-tracing", scene=room, settings=["calibration=planes", "steps=3"])
    before, after = (scene_surfaces(open_scene(place, 2.4e9)) for place in (room, run.folder / "corrected"))
    moved = np.abs(run.field.params["plane.shift"]).max()
    assert moved > 0
    assert before.triangles.shape == after.triangles.shape
    assert 0 < np.abs(before.triangles - after.triangles).max() < 20 * moved
    train(flat_folder, tmp_path / "traced", "ray-tracing", scene=run.folder / "corrected")


def test_number_of_rays_is_searched_once_for_a_run(
    flat_folder: Path, room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Timed samples, evaluation and predictions at new positions use the stored number."""
    calls = []
    converged = solve.converged_rays

    def counted(*arguments: Any) -> int:
        calls.append(arguments)
        return converged(*arguments)

    monkeypatch.setattr(solve, "converged_rays", counted)
    out = train(
        flat_folder, tmp_path / "run", "ray-tracing", scene=room, settings=TraceOptions(depth=1, rays="auto")
    ).folder
    assert len(calls) == 1
    before = read_run(out).metrics
    assert evaluate_run(out)["abs_error_db"] == before["abs_error_db"]
    predict_to_file(out, np.array([[1.0, 1.0, 1.3]]), tmp_path / "p.npz")
    assert len(calls) == 1


def test_command_traces_predicts_and_compares(
    flat_folder: Path, room: Path, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    asked = ["--paths", "line-of-sight, reflection", "--depth", "1", "--rays", "1000", "--seed", "3"]
    status, printed, err = call(["trace", room, flat_folder, "--out", out, "--json", *asked], capsys)
    assert status == 0, err
    metrics = json.loads(printed)
    assert metrics["rays"] == 1000
    assert metrics["paths"] > read_run(run).metrics["paths"]
    record = load(flat_folder)
    positions = tmp_path / "tx.csv"
    rows = [",".join(map(str, p)) for p in record.tx_pos_m[read_run(out).row]]
    positions.write_text("\n".join(["x,y,z", *rows]) + "\n")
    status, _, err = call(["predict", out, "--tx", positions, "--out", tmp_path / "p.npz"], capsys)
    assert status == 0, err
    with np.load(tmp_path / "p.npz") as stored:
        assert stored["prediction"] == pytest.approx(read_run(out).prediction, abs=FLOAT32_DB)
        assert stored["receiver_name"].tolist() == ["anchor1", "anchor2"]
    page = compare([run, out], tmp_path / "compare").read_text()
    assert all(folder.name in page for folder in (run, out))
    assert "idw100" in page


def test_train_and_trace_give_equal_scores(
    flat_folder: Path, room: Path, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    named = ["train", flat_folder, "--model", "ray-tracing", "--out", tmp_path / "run", "--json"]
    status, out, err = call([*named, "--scene", room, "--paths", "line-of-sight", "--depth", "0"], capsys)
    assert status == 0, err
    assert json.loads(out)["abs_error_db"] == read_run(run).metrics["abs_error_db"]
    named[-2] = tmp_path / "other"
    for wrong, message in (
        (named, "ray-tracing needs a scene; give --scene SCENE"),
        ([*named, "--scene", room, "--set", "beta=1"], "unknown setting beta"),
        (["train", flat_folder, "--depth", "1", "--out", tmp_path / "other"], "belong to --model ray-tracing"),
    ):
        refused(wrong, message, capsys)
        assert not (tmp_path / "other").exists()


def test_comparison_shows_the_scene_while_it_exists(
    flat_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = make_scene(flat_folder / "layout.csv", tmp_path / "scene", height_m=2.7)
    run = train(flat_folder, tmp_path / "run", "ray-tracing", scene=scene.folder, settings=DIRECT).folder
    assert "Mesh, traced paths" in compare([run], tmp_path / "with").read_text()
    with Image.open(tmp_path / "with" / "flat-scene.png") as picture:
        assert np.ptp(np.asarray(picture.convert("L"))) > 100
    shutil.rmtree(scene.folder)
    capsys.readouterr()
    assert "Mesh, traced paths" not in compare([run], tmp_path / "without").read_text()
    err = capsys.readouterr().err
    assert err.startswith("no picture of the scene of run: ")
    assert err.count("\n") == 1


def test_spectra_without_array_are_refused(folder: Path, tmp_path: Path) -> None:
    """Ray tracing of spectra needs carrier and array of the data set."""
    with pytest.raises(InputError, match="carrier frequency unknown; state frequency_hz in its gateway_info"):
        train(folder, tmp_path / "run", "ray-tracing", scene="laboratory")
    assert not (tmp_path / "run").exists()


def test_refused_trace_writes_nothing(
    flat_folder: Path, room: Path, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    for arguments, message in [
        (["trace", tmp_path / "no.xml", flat_folder], "no such scene file"),
        (["trace", room, tmp_path / "none"], "no such folder"),
        (["trace", room, flat_folder, "--material", "brick"], "has radio materials of its own"),
        (["trace", room, flat_folder, "--paths", "echo"], "kind of path 'echo': unknown"),
        (["trace", room, flat_folder, "--rays", "many"], "give a whole number"),
        (["trace", room, flat_folder, "--depth", "99"], "depth 99"),
    ]:
        status, _, err = call([*arguments, "--out", out], capsys)
        assert status == 2, err
        assert message in err
        assert err.count("\n") == 1
        assert not out.exists()
    status, _, err = call(["trace", room, flat_folder, "--out", run], capsys)
    assert (status, err.count("\n")) == (2, 1)
    assert "exists and is not empty" in err


@given(
    st.lists(st.floats(-90, -30), min_size=3, max_size=30),
    st.floats(-40, 40),
)
def test_fitted_offset_is_the_median(traced: list[float], shift: float) -> None:
    strength = np.array([traced, traced])
    measured = strength + shift
    measured[1, 0] = np.nan
    offsets = fit_offsets(strength, measured)
    assert offsets.offset_db == pytest.approx([shift, shift], abs=1e-9)
    # No path: the weakest strength that this receiver reports.
    assert offsets([[np.nan], [np.nan]])[:, 0] == pytest.approx(np.nanmin(measured, axis=1))


def test_receiver_that_no_path_reaches_is_named() -> None:
    with pytest.raises(InputError, match="receiver 1: no training row is both received and reached"):
        fit_offsets([[-50.0], [np.nan]], [[-40.0], [-40.0]])


def test_kinds_of_path_are_switched_one_by_one() -> None:
    options = TraceOptions(**stated_kinds("transmission, diffraction"))
    assert options == TraceOptions(line_of_sight=False, reflection=False, transmission=True, diffraction=True)
    with pytest.raises(InputError, match="reflections -1"):
        TraceOptions(reflections=-1)


def test_reflections_bound_the_paths_of_the_command(
    flat_folder: Path, room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for bound in (0, 1):
        asked = ["trace", room, flat_folder, "--depth", "2", "--reflections", bound, "--rays", "1024"]
        status, _, err = call([*asked, "--out", tmp_path / str(bound)], capsys)
        assert status == 0, err
        assert (load_trace(tmp_path / str(bound) / "paths.npz").paths.interactions == 1).sum(axis=1).max() == bound
    status, _, err = call([*asked[:5], "--reflections", "-3", "--out", tmp_path / "out"], capsys)
    assert status == 2
    assert "reflections -3" in err


def test_tracer_predicts_free_space_loss(flat_folder: Path, room: Path) -> None:
    record = load(flat_folder)
    tracer = RayTracer(room, instrument_of(record), DIRECT)
    np.testing.assert_allclose(tracer(record.tx_pos_m[:4]), friis_dbm(record)[:, :4], atol=FLOAT32_DB)


def test_walls_that_nothing_passes_are_suspected(
    flat_folder: Path, room: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A wall through the room hides half of it; the log names the setting, unless it is given or nothing is hidden."""
    walls = "x,y\n0,0\n2.5,0\n2.5,4\n2.5,0\n5,0\n5,4\n0,4\n0,0\n"
    (tmp_path / "walls.csv").write_text(walls)
    divided = make_scene(tmp_path / "walls.csv", tmp_path / "divided", height_m=2.7).folder
    passed = replace(DIRECT, transmission=True, depth=1)
    for name, scene, options in (("off", divided, DIRECT), ("on", divided, passed), ("open", room, DIRECT)):
        caplog.clear()
        train(flat_folder, tmp_path / name, "ray-tracing", scene=scene, settings=options)
        assert ("transmission=true" in caplog.text) == (name == "off")


def test_calibrated_strength_without_a_path_is_that_of_the_weakest_training_row(
    flat_folder: Path, calibrated: Path
) -> None:
    """Below the floor, which nothing passes here."""
    record = load(flat_folder)
    assert record.official is not None
    below = record.tx_pos_m[:2] - np.array([0, 0, 9.0])
    report = open_run(calibrated).predict(below, 0, np.zeros(2)).mean
    np.testing.assert_allclose(report, np.nanmin(record.observation[:, record.official[0]]), atol=FLOAT32_DB)
