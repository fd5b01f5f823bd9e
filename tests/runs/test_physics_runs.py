"""Runs of the physics model: what is in their folders, the command, and what is refused."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from calling import call, contents, refused, scored_again_as_before, stored
from made_waves import SIZE, wave_record
from traced_rooms import FREQUENCY_HZ, inside, write_xml
from traced_rooms import SHOEBOX as ROOM
from wrf_mi_scenes.build_laboratory import box

from wrf_mi.core import Receiver, Record
from wrf_mi.datasets import load, write_spectrum_folder
from wrf_mi.runs.api import evaluate_run, train
from wrf_mi.runs.compare import compare
from wrf_mi.runs.folder import FORMAT
from wrf_mi.runs.results import read_run
from wrf_mi.scene.make import make_scene
from wrf_mi.tasks.scores import inside_interval, ssim

QUICK = ("directions=20", "lengths=2")
"""Of spectra without a mesh: a fit of a second."""
SET = [part for setting in QUICK for part in ("--set", setting)]
FILES = {"config.yaml", "split.npz", "model.npz", "metrics.json", "predictions.npz"}
ROUNDING = 1e-5
"""Predictions are float32."""


@pytest.fixture(scope="module")
def waves(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Spectra at two receivers, 36 rows in two folds."""
    return write_spectrum_folder(tmp_path_factory.mktemp("data") / "waves", wave_record(36, 10))


@pytest.fixture(scope="module")
def run(waves: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train(waves, tmp_path_factory.mktemp("runs") / "run", "physics", settings=QUICK).folder


@pytest.fixture(scope="module")
def strengths(flat_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run on signal strengths with headings, without a mesh."""
    return train(flat_folder, tmp_path_factory.mktemp("runs") / "strengths", "physics").folder


def test_run_folder_holds_model_and_standard_deviation(waves: Path, run: Path) -> None:
    assert contents(run) == FILES
    config = yaml.safe_load((run / "config.yaml").read_text())
    known = {"model": "physics", "dataset": str(waves), "scene": None, "split": "official", "n_train": None, "seed": 0}
    known |= {"format": FORMAT, "task": "spectrum", "material": None, "deterministic": False}
    assert known.items() <= config.items()
    assert (config["settings"]["directions"], config["settings"]["lengths"]) == (20, 2)
    record, arrays = load(waves), stored(run)
    assert record.official is not None
    np.testing.assert_array_equal(arrays["row"], record.official[1])
    assert arrays["std"].shape == arrays["prediction"].shape == (2, 10, *SIZE)
    assert arrays["std"].dtype == np.float32
    assert arrays["std"].min() > 0
    metrics = json.loads((run / "metrics.json").read_text())
    assert (metrics["model"], metrics["task"], metrics["n_train"], metrics["n_test"]) == ("physics", "spectrum", 26, 10)
    assert metrics["ssim"]["median"] == pytest.approx(np.median(ssim(arrays["prediction"], arrays["truth"])))
    assert metrics["ssim"]["median"] > metrics["reference"]["idw4"]["median"]
    inside = inside_interval(arrays["prediction"], arrays["std"], arrays["truth"])
    assert metrics["inside_90"] == pytest.approx(inside)
    assert 0.5 < inside < 1
    assert set(metrics["receivers"]) == {"one", "two"}
    assert metrics["fitted"]["parts"] == "signals, nearby"
    assert metrics["train_seconds"] > 0
    assert metrics["peak_memory_mb"] > 10


def test_command_trains_as_the_function_does(
    waves: Path, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    status, table, err = call(["train", waves, "--model", "physics", "--out", out, *SET], capsys)
    assert status == 0, err
    lines = table.splitlines()
    assert [line.split()[0] for line in lines[:3]] == ["SSIM", "physics", "IDW"]
    assert "of the test values lie inside the predicted 90 % intervals, CRPS " in lines[3]
    assert lines[-1] == f"results: {out}"
    assert "one: element signals of spectra" in err.splitlines()
    np.testing.assert_allclose(stored(out)["prediction"], stored(run)["prediction"], atol=ROUNDING)
    np.testing.assert_allclose(stored(out)["std"], stored(run)["std"], atol=ROUNDING)


def test_evaluation_reproduces_the_scores(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scored_again_as_before(run, capsys)


def test_predictions_at_new_positions_have_standard_deviations(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    held_out = stored(run)
    rows = [",".join(repr(float(v)) for v in p) for p in held_out["tx_pos"]]
    (tmp_path / "tx.csv").write_text("\n".join(["x,y,z", *rows]) + "\n")
    (tmp_path / "turned.csv").write_text("\n".join(["heading_rad,x,y,z", *(f"0.5,{row}" for row in rows)]) + "\n")
    out = tmp_path / "tx.npz"
    status, printed, err = call(["predict", run, "--tx", tmp_path / "tx.csv", "--out", out, "--json"], capsys)
    assert (status, err) == (0, "")
    assert json.loads(printed)["arrays"]["std"] == [2, 10, *SIZE]
    with np.load(out) as arrays:
        np.testing.assert_allclose(arrays["prediction"], held_out["prediction"], atol=ROUNDING)
        np.testing.assert_allclose(arrays["std"], held_out["std"], atol=ROUNDING)
        assert arrays["receiver_name"].tolist() == ["one", "two"]
    # How the transmitter is turned changes no spectrum: a model that cannot use it says so.
    turned = ["predict", run, "--tx", tmp_path / "turned.csv", "--out", tmp_path / "turned.npz"]
    refused(turned, "does not know how the transmitter is turned", capsys)
    assert not (tmp_path / "turned.npz").exists()


def test_heading_changes_signal_strengths(
    flat_folder: Path, strengths: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    held_out, record = stored(strengths), load(flat_folder)
    assert record.tx_heading_rad is not None
    metrics = json.loads((strengths / "metrics.json").read_text())
    assert metrics["task"] == "rssi"
    assert 0.5 < metrics["inside_90"] <= 1
    turned = record.tx_heading_rad[held_out["row"]]
    np.savez(tmp_path / "turned.npz", tx_pos=held_out["tx_pos"], heading_rad=turned)
    np.savez(tmp_path / "tx.npz", tx_pos=held_out["tx_pos"])
    found = {}
    for name in ("tx", "turned"):
        out = tmp_path / f"{name}-out.npz"
        status, _, err = call(["predict", strengths, "--input", tmp_path / f"{name}.npz", "--out", out], capsys)
        assert status == 0, err
        with np.load(out) as arrays:
            found[name] = dict(arrays)
    np.testing.assert_allclose(found["turned"]["prediction"], held_out["prediction"], atol=1e-3)
    assert np.abs(found["tx"]["prediction"] - held_out["prediction"]).max() > 0.01
    assert found["tx"]["std"].shape == found["tx"]["prediction"].shape == (2, 6)


def test_standard_deviations_of_folds_are_pooled(waves: Path, tmp_path: Path) -> None:
    run = train(waves, tmp_path / "run", "physics", split="blocked", settings=QUICK)
    arrays = stored(run.folder)
    assert run.metrics["inside_90"] == inside_interval(arrays["prediction"], arrays["std"], arrays["truth"])


def test_comparison_shows_physics_and_reference(run: Path, tmp_path: Path) -> None:
    page = compare([run], tmp_path / "page").read_text()
    assert "inside 90 %" in page
    with (tmp_path / "page" / "compare.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["model"] for row in rows] == ["physics", "idw4"]
    metrics = json.loads((run / "metrics.json").read_text())
    assert float(rows[0]["inside_90"]) == metrics["inside_90"]
    assert rows[1]["inside_90"] == ""
    assert (tmp_path / "page" / "waves-samples.png").is_file()


# With a mesh


@pytest.fixture(scope="module")
def flat_scene(flat_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_scene(flat_folder / "layout.csv", tmp_path_factory.mktemp("scenes") / "flat", height_m=2.7).folder


def test_mesh_alone_predicts_signal_strengths(
    flat_folder: Path, flat_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    asked = ["--scene", flat_scene, "--n-train", 0, "--set", "max_depth=2", "--set", "spacing_m=0.5"]
    status, printed, err = call(["train", flat_folder, "--model", "physics", "--out", out, "--json", *asked], capsys)
    assert status == 0, err
    metrics = json.loads(printed)
    assert (metrics["n_train"], metrics["scene"]) == (0, str(flat_scene))
    assert metrics["reference"]["idw100"]["median"] > 0  # the blend keeps its rows
    again = evaluate_run(out)
    assert (again["n_train"], again["abs_error_db"]) == (0, metrics["abs_error_db"])
    assert evaluate_run(out, "random")["n_test"] == 6  # it has seen no row: a fifth of all
    # Strengths are not calibrated: without any row the scale is not known.
    assert stored(out)["std"].min() > 5


def test_mesh_alone_predicts_spectra(tmp_path: Path) -> None:
    """Predictions without training rows depend on the mesh."""
    record = wave_record(30, 10, receivers=1)
    middle = np.array([2.0, 2.0, 1.2])
    receiver = replace(record.receivers[0], position_m=np.array([4.4, 3.1, 0.8]))
    record = replace(record, tx_pos_m=record.tx_pos_m + middle, receivers=(receiver,))
    folder = write_spectrum_folder(tmp_path / "waves", record)
    found = []
    for name, parts in (("room", ROOM), ("half", {k: v for k, v in ROOM.items() if k in ("floor", "west")})):
        scene = write_xml(tmp_path / name, parts)
        out = train(folder, tmp_path / f"run-{name}", "physics", scene=scene, n_train=0, settings=("rays=4096",)).folder
        assert json.loads((out / "metrics.json").read_text())["n_train"] == 0
        assert evaluate_run(out)["ssim"] == read_run(out).metrics["ssim"]
        found.append(stored(out)["prediction"])
    assert np.abs(found[0] - found[1]).mean() > 0.02


def test_antennas_are_checked_once_and_as_the_ray_tracer_does(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    """Five folds warn once; a receiver or a transmitter in a column is refused in the words of `wrf-mi trace`."""
    record = wave_record(40, 10, receivers=1)
    record = replace(
        record, tx_pos_m=record.tx_pos_m + np.array([2.0, 2.0, 1.2]), receivers=(_at([4.4, 3.1, -2e-3], record),)
    )
    scene = write_xml(tmp_path / "hall", {**ROOM, "column": ("itu_concrete", box((4.8, 3.6, 0), (5.3, 4.1, 3)))})
    plain = ("rays=1024", "reflections=1", "surfaces=0", "amplitudes=false", "rest=false", "steps=1")
    folder = write_spectrum_folder(tmp_path / "waves", record)
    train(folder, tmp_path / "run", "physics", scene=scene, split="blocked", settings=plain)
    said = [one.getMessage() for one in caplog.records if one.levelname == "WARNING"]
    assert [text.partition(" (first: receiver one)")[0] for text in said] == [
        "1 of 1 antennas lie up to 1 cm behind a surface",
    ]
    moved = record.tx_pos_m.copy()
    moved[7] = [5.0, 4.0, 1.0]
    for name, wrong, antenna in (
        ("rx", replace(record, receivers=(_at([5.0, 4.0, 1.0], record),)), "receiver one"),
        ("tx", replace(record, tx_pos_m=moved), "transmitter 8"),
    ):
        data = write_spectrum_folder(tmp_path / name, wrong)
        message = rf"{antenna} at \(5.00, 4.00, 1.00\) m is inside the solid 'column'; move one of them"
        for command in (["train", data, "--model", "physics", "--scene", scene], ["trace", scene, data]):
            refused([*command, "--out", tmp_path / "out"], message, capsys)
            assert not (tmp_path / "out").exists()


def _at(position: Any, record: Record) -> Receiver:
    return replace(record.receivers[0], position_m=np.array(position, float))


def test_channels_are_predicted_from_a_mesh(tmp_path: Path) -> None:
    scene = write_xml(tmp_path / "room", {"floor": ROOM["floor"]})
    where, tx_pos = inside(30, seed=4), np.array([1.0, 1.5, 2.0])
    wavenumber = 2 * np.pi * FREQUENCY_HZ / 299792458.0
    csi = np.zeros(30, complex)
    for source in (tx_pos, tx_pos * [1, 1, -1]):  # a floor that reflects all
        distance = np.linalg.norm(where - source, axis=1)
        csi += np.exp(-1j * wavenumber * distance) / (2 * wavenumber * distance)
    np.savez(tmp_path / "hall.npz", tx_pos=tx_pos, rx_pos=where, frequency_hz=FREQUENCY_HZ, csi=csi)
    quick = ("rays=8192", "reflections=1", "repair_rounds=2", "visibility_rounds=1", "folds=2")
    out = train(tmp_path / "hall.npz", tmp_path / "run", "physics", scene=scene, settings=quick).folder
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["cea_db"]["median"] > 20
    assert metrics["cea_db"]["median"] > metrics["reference"]["idw4"]["median"] + 15
    arrays = stored(out)
    assert arrays["prediction"].dtype == np.complex64
    assert arrays["std"].dtype == np.float32
    assert arrays["std"].shape == arrays["prediction"].shape == (6, 1)
    assert metrics["inside_90"] == inside_interval(arrays["prediction"], arrays["std"], arrays["truth"])


# What is refused


def test_bad_calls_are_refused(
    waves: Path, run: Path, flat_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    train = ["train", waves, "--model", "physics", "--out", tmp_path / "out"]
    for arguments, message in (
        ([*train, "--n-train", 0], "--n-train 0: nothing to predict from; give training rows or a scene"),
        ([*train, "--n-train", 7], "waves: 7 training rows without a mesh; give 8 or more, or a scene"),
        ([*train, "--n-train", -1], "n_train -1; choose 1 to 26"),
        ([*train, "--split", "nowhere"], "split 'nowhere'"),
        ([*train, "--split", ""], "split ''"),
        ([*train, "--seed", -1], "seed -1"),
        ([*train, "--set", "lengths=0"], "setting lengths: 0 is out of range, choose 1 or more"),
        ([*train, "--set", "lengths=many"], "expected int, got 'many'"),
        (
            [*train, "--material", "concrete"],
            "--material and antenna options belong to a scene that is traced; give --scene",
        ),
        ([*train, "--scene", tmp_path / "none.xml"], "none.xml"),
        (
            [*train, "--depth", 2],
            "--paths, --depth, --reflections, --rays, --phase-error and --calibrate belong to --model ray-tracing",
        ),
        (["train", "--resume", run, "--scene", "x"], "omit data set and settings"),
        (["train", "--resume", run, "--set", "lengths=2"], "omit data set and settings"),
        (["train", waves, "--scene", "x", "--out", tmp_path / "out"], "x: no such scene file"),
        (["evaluate", run, "--split", "nowhere"], "split 'nowhere'"),
    ):
        refused(arguments, message, capsys)
        assert not (tmp_path / "out").exists(), arguments


BAD_HEADINGS = {
    "nan.csv": ("x,y,z,heading_rad\n0,0,0,nan\n", "row 1: heading_rad is 'nan'; give a finite number"),
    "short.csv": ("x,y,z,heading_rad\n0,0,0\n", "row 1: 3 fields, but the header has 4"),
}


@pytest.mark.parametrize("name", BAD_HEADINGS)
def test_bad_headings_are_refused(name: str, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    content, message = BAD_HEADINGS[name]
    (tmp_path / name).write_text(content)
    refused(["predict", run, "--tx", tmp_path / name, "--out", tmp_path / "out.npz"], message, capsys)
    np.savez(tmp_path / "tx.npz", tx_pos=np.zeros((2, 3)), heading_rad=np.zeros(3))
    refused(["predict", run, "--input", tmp_path / "tx.npz", "--out", tmp_path / "out.npz"], "heading_rad must", capsys)


# In Python


def test_record_in_memory_and_progress(tmp_path: Path) -> None:
    heard: list[tuple[str, float]] = []
    record = wave_record(36, 10, receivers=1)
    out = train(
        record, tmp_path / "run", "physics", settings=QUICK, on_progress=lambda *told: heard.append(told[:2])
    ).folder
    assert {what for what, _ in heard} == {"one: element signals of spectra", "one: signals", "one: weights"}
    assert stored(out)["std"].shape == (10, *SIZE)  # one receiver: no axis for it


def test_settings_of_every_physics_model_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    status, out, _ = call(["train", "--help-settings"], capsys)
    assert status == 0
    for line in (
        "physics, spectra with --scene:",
        "physics, spectra without:",
        "cone_deg=80.0",
        "shadow_db=",
        "folds=",
    ):
        assert line in out
